"""How much may wait, run and lie on the disk: for all together, and for each token."""

import math
import time
from dataclasses import dataclass, field

from ..index.records import Usage
from ..index.store import Store
from ..jobs.states import State
from ..settings import Settings
from .problems import HttpError, WrongField
from .security import Who
from .stored import Stored

COUNTED = 1.0  # seconds for which a count holds


@dataclass
class Count:
    """What is queued or used, counted at most once a second, and what came in since; so never too much is let in."""

    usage: Usage = field(default_factory=lambda: Usage(0, 0, 0.0, 0))
    at: float = field(default=-math.inf)


class Quotas:
    """Refuses what goes beyond the limits of the queue, or of a token."""

    def __init__(self, settings: Settings, store: Store, stored: Stored) -> None:
        self.settings, self.store, self.stored = settings, store, stored
        self._queue, self._of = Count(), dict[str, Count]()

    def admit(self, who: Who, jobs: int, ranks: int = 1) -> None:
        """Jobs of that many ranks each. Raises `HttpError`."""
        queue = self._fresh(self._queue, None)
        if queue.usage.queued + jobs > self.settings.queue_limit:
            detail = f"{queue.usage.queued} jobs are queued and {jobs} more came"
            detail += f", must be at most {self.settings.queue_limit} together"
            raise HttpError(429, "queue-full", "The queue is full", detail, headers={"Retry-After": "30"})
        if who.label is not None and self.any:
            self._admit(who.label, jobs, ranks)
        queue.usage = queue.usage._replace(queued=queue.usage.queued + jobs)

    def _admit(self, label: str, jobs: int, ranks: int) -> None:
        s, count = self.settings, self._fresh(self._of.setdefault(label, Count()), label)
        used = count.usage
        if s.quota_cores is not None and ranks > s.quota_cores:
            wrong = WrongField(pointer="/ranks", value=ranks, detail=f"must be at most {s.quota_cores} for this token")
            raise HttpError(422, "over-limit", "More than this token may have", wrong.detail, [wrong])
        for name, after, most in (
            ("queued jobs", used.queued + jobs, s.quota_queued),
            ("core-hours", used.core_seconds / 3600, s.quota_core_hours),
            ("bytes", used.bytes, s.quota_bytes),
        ):
            if most is not None and after > most:
                detail = f"{name} of token {label!r}: {after:.6g}, must be at most {most:.6g}"
                raise HttpError(429, "over-quota", "The quota of the token is used up", detail)
        count.usage = used._replace(queued=used.queued + jobs)

    @property
    def any(self) -> bool:
        """Whether tokens have quotas at all."""
        s = self.settings
        return any(q is not None for q in (s.quota_queued, s.quota_cores, s.quota_core_hours, s.quota_bytes))

    def usage(self, label: str) -> Usage:
        """What a token has now, files that it uploaded among it."""
        used = self.store.usage(label)
        return used._replace(bytes=used.bytes + sum(file.bytes for file in self.stored.listed(lambda o: o == label)))

    def _fresh(self, count: Count, label: str | None) -> Count:
        if (now := time.monotonic()) > count.at + COUNTED:
            count.at = now
            queued = Usage(self.store.count(State.QUEUED), 0, 0.0, 0)
            count.usage = queued if label is None else self.usage(label)
        return count
