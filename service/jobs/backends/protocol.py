"""What the scheduler asks of a place where jobs run. It owns the resources there, and knows whether a runner lives."""

import signal
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

from ..runner import Order
from ..states import Exit, Waiting

Handle = dict[str, Any]
"""By what a backend finds a runner again, as JSON: the index keeps it, and nobody else looks into it."""


class BackendError(RuntimeError):
    """No runner was started; the message says why."""


class FolderError(RuntimeError):
    """The folder of a run is gone, or another stands in its place; a runner may still live."""

    def __init__(self) -> None:
        super().__init__("its run folder was deleted, moved away or replaced while it had cores")


class Backend(Protocol):
    """Belongs to one event loop. A run directory is where a runner leaves its records, wherever it runs."""

    @property
    def total(self) -> int:
        """Ranks of the largest job that can ever run here."""

    @property
    def free(self) -> int:
        """Ranks that could be started now, at most."""

    def may_start(self, queue: Sequence[Waiting]) -> list[tuple[int, tuple[int, ...]]]:
        """Which jobs of the queue, by priority and age, are to start now, by seq, and the numbers of the cores of each.

        Nothing is taken yet: `hold` is called for those that are claimed.
        """

    def hold(self, job: str, ranks: int, cores: Sequence[int]) -> tuple[int, ...]:
        """Take for a job what `may_start` said, or an earlier service recorded; what it is told of as its cores."""

    def release(self, job: str) -> None:
        """Give back what a job that has ended had."""

    async def start(self, order: Order) -> Handle | None:
        """Start the runner of an attempt; None: it has ended already. Raises `BackendError`, `FolderError`."""

    async def find(self, directory: Path, attempt: int) -> Handle | None:
        """The attempt's runner, once it has recorded itself; None: there is none. Raises `FolderError`."""

    async def ended(
        self, directory: Path, attempt: int, handle: Handle | None, alive: Callable[[], None]
    ) -> Exit | None:
        """Wait for the end of the attempt's runner; its exit record, None where it left none.

        alive: called after every look at a runner that lives. Raises `FolderError`.
        """

    async def clear(self, directory: Path, handle: Handle | None) -> None:
        """End the runner without asking, and all that runners have started in a folder that may be gone."""

    def tell(self, directory: Path, attempt: int, number: signal.Signals) -> None:
        """Send the attempt's runner a signal, if it lives."""

    def close(self) -> None:
        """Leave; runners go on."""
