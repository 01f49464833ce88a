"""What an exception that ends a run tells: of the case or of frit itself, and so the same again, or of the machine."""

import errno

from .slots import SlotError

# Numbers and code decide about these. Not among them: OSError, MPI's own errors, a library that cannot be loaded, a
# damaged cache of compiled code, signals: another time, or elsewhere, the same run may go well.
DECIDED = (
    ArithmeticError, AssertionError, AttributeError, LookupError, MemoryError, NameError, NotImplementedError,
    RecursionError, SlotError, TypeError, ValueError,
)  # fmt: skip


def comes_again(error: BaseException) -> bool:
    """Whether the same case would end in the same way."""
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    return isinstance(error, DECIDED) or type(error).__module__.startswith("numba.")  # what cannot be compiled


def told(error: BaseException) -> str:
    """One line: what happened, without the path that an error of the system may have."""
    text = " ".join(str(error).split())
    if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM):
        return f"there is not enough memory{f': {text}' if isinstance(error, MemoryError) and text else ''}"
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        text = error.strerror
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
