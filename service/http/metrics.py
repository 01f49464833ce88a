"""What Prometheus reads: requests, as the instrumentator counts them, and jobs by state."""

from collections.abc import Callable, Iterator
from typing import Any

from fastapi import FastAPI
from fastapi.responses import PlainTextResponse
from prometheus_client import CollectorRegistry
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector
from prometheus_fastapi_instrumentator import Instrumentator

from ..index.records import StoreError
from ..jobs.engine import Engine


class Jobs(Collector):
    """Gauges that are read from the index when they are asked for."""

    def __init__(self, engine: Callable[[], Engine]) -> None:
        self.engine = engine

    def describe(self) -> list[GaugeMetricFamily]:
        """Nothing to be read at registration."""
        return []

    def collect(self) -> Iterator[GaugeMetricFamily]:
        """Read now."""
        engine = self.engine()
        try:
            counts = engine.store.counts()
        except StoreError:
            counts = {}
        jobs = GaugeMetricFamily("frit_jobs", "Jobs in the index, by state.", labels=["state"])
        for state, number in counts.items():
            jobs.add_metric([state], number)
        yield jobs
        ready = GaugeMetricFamily("frit_ready", "1 where jobs can be started and recorded.")
        ready.add_metric([], float(engine.trouble() is None))
        yield ready
        scheduler = engine.scheduler
        total, stuck = scheduler.backend.total, scheduler.stuck_cores()
        for name, words, value in (
            ("frit_cores", "Processors given to jobs.", total),
            ("frit_cores_busy", "Processors that jobs have now.", total - scheduler.backend.free),
            ("frit_cores_stuck", "Processors of jobs of which nobody knows whether they live.", stuck),
        ):
            cores = GaugeMetricFamily(name, words)
            cores.add_metric([], value)
            yield cores


def expose(app: FastAPI, engine: Callable[[], Engine], **route: Any) -> None:
    """Count requests, and answer GET /metrics."""
    registry = CollectorRegistry()
    registry.register(Jobs(engine))
    Instrumentator(registry=registry, excluded_handlers=["/metrics", "/livez", "/readyz"]).instrument(app).expose(
        app, include_in_schema=True, response_class=PlainTextResponse, **route
    )
