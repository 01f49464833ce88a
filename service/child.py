"""A child process with a session of its own, whose words come through a pipe: forked by hand.

`subprocess` does the same at three times the processor time where something is to be called before the exec, and a
runner does nothing else.
"""

import os
import signal
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import NoReturn

UNHEARD = 127  # exit status where the program cannot be executed


class Child:
    """A program from its start on. `words`: what it and its own children say, until none of them holds the pipe."""

    def __init__(
        self, command: Sequence[str], environment: Mapping[str, str], first: Callable[[], None] | None = None
    ) -> None:
        """first: called in the new process before it is the program. Raises `OSError` where nothing can be forked."""
        read, write = os.pipe()
        self.returncode: int | None = None  # negative: the signal that ended it
        self.pid = os.fork()
        if self.pid == 0:
            become(command, environment, write, first)
        os.close(write)
        self._process = os.pidfd_open(self.pid)
        self.words = open(read, encoding="utf-8", errors="replace")  # noqa: SIM115 - closed with the child

    def wait(self) -> int:
        """Until it has ended; by one thread only."""
        if self.returncode is None:
            self.returncode = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
        return self.returncode

    def send(self, number: signal.Signals) -> None:
        """A signal, if it lives: a reused pid is never hit."""
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(self._process, number)

    def close(self) -> None:
        """Once it has ended."""
        self.words.close()
        os.close(self._process)


def become(
    command: Sequence[str], environment: Mapping[str, str], output: int, first: Callable[[], None] | None
) -> NoReturn:
    """Turn the process that was just forked into the program."""
    try:
        if first is not None:
            first()
        os.setsid()
        nothing = os.open(os.devnull, os.O_RDONLY)
        for source, target in ((nothing, 0), (output, 1), (output, 2)):
            os.dup2(source, target)
        for ignored in (signal.SIGPIPE, signal.SIGXFSZ):  # by Python, not by who starts it
            signal.signal(ignored, signal.SIG_DFL)
        os.execvpe(command[0], list(command), dict(environment))
    except OSError as error:
        os.write(2, f"{command[0]}: {error.strerror}\n".encode())
    finally:
        os._exit(UNHEARD)
