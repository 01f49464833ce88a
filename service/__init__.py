"""The job service; `Client` speaks to one. Importing this package imports nothing else."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .client import Client, ProblemError
    from .remote import RemoteJob, RemoteSweep

__all__ = ["Client", "ProblemError", "RemoteJob", "RemoteSweep"]


def __getattr__(name: str) -> Any:
    if name in __all__:
        from . import client

        return getattr(client, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
