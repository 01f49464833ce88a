"""Settings of the service: from the environment (FRIT_...) and the command line, complete and checked at birth."""

import os
from pathlib import Path
from typing import Annotated

from pydantic import Field
from pydantic_settings import BaseSettings, SettingsConfigDict

from .jobs.memory import memory_per_core

AtLeastOne = Annotated[int, Field(ge=1)]
Seconds = Annotated[float, Field(gt=0, allow_inf_nan=False)]


def own_cores() -> tuple[int, ...]:
    """The processors that this process may use."""
    return tuple(sorted(os.sched_getaffinity(0)))


class Settings(BaseSettings):
    """One frozen set for the life of a service."""

    model_config = SettingsConfigDict(env_prefix="FRIT_", frozen=True, extra="forbid", use_attribute_docstrings=True)

    data: Path = Path("data")
    """folder of the index, the run directories and the uploaded files"""
    cores: AtLeastOne = Field(default_factory=lambda: len(own_cores()))
    """processors given to jobs; a job takes as many as it has ranks"""
    host: str = "127.0.0.1"
    """address to listen on; any but a loopback address needs tokens"""
    port: Annotated[int, Field(ge=0, le=65535)] = 8000
    """port to listen on; 0: any free one"""
    attempts: AtLeastOne = 5
    """attempts in a row that may break or get lost before a job stays in `error` or `lost`; one that got further than
    the checkpoint it began from does not count"""
    backoff: Seconds = 2.0
    """seconds before the second attempt; doubles with each one after"""
    backoff_limit: Seconds = 300.0
    """longest pause between two attempts, seconds"""
    patience: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 60.0
    """seconds for which smaller jobs may overtake the first in the queue while it waits for more cores"""
    grace: Seconds = 60.0
    """seconds for each step of the ladder checkpoint, end, kill when a job is stopped"""
    memory_limit: AtLeastOne = Field(default_factory=memory_per_core)
    """bytes of memory for each rank of a job; one whose ranks together take more is ended and has failed"""
    release: bool = False
    """at the end of the service, jobs write a checkpoint and go back into the queue instead of running on"""
    poll: Seconds = 0.5
    """seconds between two looks at what running jobs have written"""
    free_disk: Annotated[int, Field(ge=0)] = 200_000_000
    """bytes free in the data folder below which no job is started"""
    connections_limit: AtLeastOne = 500
    """connections at once, at most, those that follow events among them"""
    body_limit: AtLeastOne = 20_000_000
    """bytes of a request's body, at most"""
    values_limit: AtLeastOne = 300_000
    """values of a request's JSON, at most; the content of a file is one"""
    points_limit: AtLeastOne = 100_000
    """points of a sweep, at most"""
    nodes_limit: AtLeastOne = 20_000_000
    """nodes of a case, at most"""
    queue_limit: AtLeastOne = 200_000
    """jobs waiting in the queue, at most"""
    particles_limit: AtLeastOne = 50_000
    """particles of a case, at most; of a packing, as many as are reckoned before it is drawn"""
    rows_limit: AtLeastOne = 1_000_000
    """history rows of a case, at most"""
    snapshots_limit: AtLeastOne = 10_000
    """snapshots of a case, at most"""
    disk_limit: AtLeastOne = 100_000_000_000
    """bytes that the results of a case take on disk, at most"""
    sweep_limit: AtLeastOne = 300_000_000
    """bytes of all resolved cases of a sweep together, at most"""
    upload_memory: AtLeastOne = 2_000_000_000
    """bytes of memory for reading the meshes of a request, at most"""
    upload_seconds: Seconds = 10.0
    """seconds for reading the meshes of a request, at most, by the clock and of the processor"""
    upload_bytes: AtLeastOne = 500_000_000
    """bytes of a mesh once it is converted, at most"""
    conversions: AtLeastOne = 2
    """requests whose files are read at the same time"""

    file_limit: AtLeastOne = 500_000_000
    """bytes of a file that is uploaded by itself, at most"""
    private: bool = False
    """jobs, sweeps and files are seen by the token that made them and by tokens of scope admin only"""
    quota_queued: AtLeastOne | None = None
    """jobs of a token that wait in the queue, at most"""
    quota_cores: AtLeastOne | None = None
    """cores that the jobs of a token have at once, at most"""
    quota_core_hours: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    """core-hours that the jobs of a token have taken, also those that are deleted, above which it submits no more"""
    quota_bytes: AtLeastOne | None = None
    """bytes that run directories and files of a token take, above which it submits no more"""

    @property
    def runs(self) -> Path:
        """Parent of the run directories."""
        return self.data.absolute() / "runs"

    def pause(self, failures: int) -> float:
        """Seconds before the next attempt after that many failures in a row."""
        doublings = min(max(failures - 1, 0), 60)
        return float(min(self.backoff * 2.0**doublings, self.backoff_limit))
