"""The state of the running service, and its dependency for routes."""

from __future__ import annotations

import asyncio
import contextvars
import threading
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from importlib import import_module
from typing import Annotated, Any, TypeVar

from fastapi import Depends, Request

from spheremark.pipelines.errors import NotFoundError
from spheremark.service.http.places import Places
from spheremark.service.http.samples import Samples
from spheremark.service.http.uploads import Inbox, Resumable, adopt_orphans
from spheremark.service.jobs.queue import JobQueue
from spheremark.service.planning.predictions import Predictions
from spheremark.service.planning.requests import Planner
from spheremark.service.planning.searches import Searches
from spheremark.service.settings import Settings
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.catalogue.sandbox import keep_queries_ready
from spheremark.storage.confined import end_children, start_readers
from spheremark.storage.scratch import remove_abandoned as remove_scratch
from spheremark.storage.upkeep import remove_abandoned

_PLANS = 2  # that are computed at once
_WARM_SECONDS = 20.0  # that the end waits for what the start still loads; seconds, once compiled
_Result = TypeVar("_Result")


@dataclass(frozen=True, slots=True)
class Service:
    """The parts of the running service that requests use."""

    settings: Settings
    catalogue: Catalogue
    inbox: Inbox
    uploads: Resumable
    terrains: Inbox
    jobs: JobQueue
    planner: Planner
    predictions: Predictions
    searches: Searches
    readers: Places = field(default_factory=lambda: Places("foreign files", 2, 8))
    queries: Places = field(default_factory=lambda: Places("queries", 4, 12))
    plans: Places = field(default_factory=lambda: Places("plans", _PLANS, 6))
    arrivals: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(2, "arrivals"))
    samples: Samples = field(default_factory=Samples)
    keys: threading.Lock = field(default_factory=threading.Lock)  # of requests that must be one

    async def inspect(self, function: Callable[..., _Result], *arguments: Any) -> _Result:
        """Return what a function returns that inspects a log which has arrived.

        On threads of its own: logs whose reading takes long keep nothing waiting but each other.
        """
        loop, context = asyncio.get_running_loop(), contextvars.copy_context()
        return await loop.run_in_executor(self.arrivals, context.run, function, *arguments)

    def row(self, sql: str, key: str, what: str) -> dict[str, Any]:
        """Return the row of a query that takes ``$id``; NotFoundError without one."""
        rows = self.catalogue.rows(sql, {"id": key})
        if not rows:
            raise NotFoundError(f"There is no {what} {key!r}.")
        return rows[0]


@asynccontextmanager
async def opened(settings: Settings) -> AsyncIterator[Service]:
    """Open the database, the inbox and the cluster; close them in the opposite order."""
    settings = settings.model_copy(update={"data": settings.data.resolve()})
    with suppress(ImportError):  # Plotly uses what it finds of it, while a thread still imports it
        import_module("pandas")
    data = settings.data
    data.mkdir(parents=True, exist_ok=True)
    data.chmod(0o700)  # for its user alone: logs, results and digests of tokens
    inbox = Inbox(data / "recordings", settings.min_free_bytes, settings.quota_bytes)
    terrains = Inbox(data / "terrains", settings.min_free_bytes)
    uploads = Resumable(inbox)
    with Catalogue(settings.database, snapshots=settings.snapshots) as catalogue:
        for one in (inbox, terrains, uploads):  # by the owner of the database alone
            one.open()
        remove_scratch()
        await asyncio.to_thread(remove_abandoned, catalogue, data)
        async with JobQueue(settings, catalogue, data / "clouds") as jobs:
            warming = threading.Thread(target=_warm_up, name="warm-up", daemon=True)
            warming.start()
            await asyncio.to_thread(adopt_orphans, catalogue, inbox)
            planner = Planner(catalogue)
            predictions = Predictions(
                n_processes=_PLANS,
                seconds=settings.prediction_seconds,
                memory_bytes=settings.prediction_memory_bytes,
            )
            searching = Predictions(
                n_processes=_PLANS,
                seconds=settings.job_seconds,
                memory_bytes=settings.prediction_memory_bytes,
            )
            searches = Searches(searching, data / "searches")
            searches.open()
            parts = (settings, catalogue, inbox, uploads, terrains, jobs)
            service = Service(*parts, planner, predictions, searches)
            try:
                yield service
            finally:
                await asyncio.to_thread(service.samples.close)
                for places in (service.readers, service.queries, service.plans):
                    places.close()
                service.arrivals.shutdown(wait=False, cancel_futures=True)
                await asyncio.to_thread(warming.join, _WARM_SECONDS)
                end_children()
                await asyncio.to_thread(service.arrivals.shutdown)  # no row after the database
                await asyncio.to_thread(predictions.close)
                await asyncio.to_thread(searching.close)


def _warm_up() -> None:
    """Start the processes that read logs and run queries, and load plots: no first one is slow."""
    from spheremark.web.figures.accuracy import Shown, distribution

    with suppress(RuntimeError):  # each upload tries again, and says so
        keep_queries_ready()
        start_readers()
    distribution([], Shown(is_error=True, tolerance_m=1.0)).to_plotly_json()


def current(request: Request) -> Service:
    """Return the service that a request is for."""
    service: Service = request.app.state.service
    return service


Current = Annotated[Service, Depends(current)]
