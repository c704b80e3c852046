"""The state of the running service, and its dependency for routes."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Annotated, Any, TypeVar

from fastapi import Depends, Request

from spheremark.pipelines.errors import NotFoundError
from spheremark.service.errors import BusyError
from spheremark.service.http.uploads import Inbox, Resumable, adopt_orphans
from spheremark.service.jobs.queue import JobQueue
from spheremark.service.planning.requests import Planner
from spheremark.service.settings import Settings
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.imports.confined import end_children

_Result = TypeVar("_Result")

_READERS = 2  # foreign files that are read at once, each in a process of its own
_READERS_WAITING = 8  # uploads that wait for one of them; others are refused


class Readers:
    """Threads that wait for the processes in which foreign files are read.

    They are threads of their own: a slow file keeps neither jobs nor uploads of logs waiting.
    """

    def __init__(self) -> None:
        self._threads = ThreadPoolExecutor(_READERS, "reader")
        self._n = 0

    async def run(self, function: Callable[..., _Result], *arguments: Any) -> _Result:
        """Return what a function returns; raise BusyError where too many wait already."""
        if self._n >= _READERS + _READERS_WAITING:
            raise BusyError(
                f"{self._n} files are being read or wait for it; {_READERS + _READERS_WAITING} are "
                "the most. Try again in a minute."
            )
        self._n += 1
        future = asyncio.get_running_loop().run_in_executor(self._threads, function, *arguments)
        future.add_done_callback(self._leave)
        return await future

    def _leave(self, _: asyncio.Future[Any]) -> None:
        """Count one less."""
        self._n -= 1

    def close(self) -> None:
        """End what is being read, and start nothing that waits."""
        self._threads.shutdown(wait=False, cancel_futures=True)
        end_children()


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
    readers: Readers = field(default_factory=Readers)
    keys: threading.Lock = field(default_factory=threading.Lock)  # of requests that must be one

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
    data = settings.data
    data.mkdir(parents=True, exist_ok=True)
    data.chmod(0o700)  # nobody else's: logs, results and digests of tokens
    inbox, terrains = (
        Inbox(data / name, settings.min_free_bytes) for name in ("recordings", "terrains")
    )
    uploads = Resumable(inbox)
    for one in (inbox, terrains, uploads):
        one.open()
    with Catalogue(settings.database, snapshots=settings.snapshots) as catalogue:
        async with JobQueue(settings, catalogue, data / "clouds") as jobs:
            threading.Thread(target=_warm_up, name="warm-up", daemon=True).start()
            await asyncio.to_thread(adopt_orphans, catalogue, inbox)
            planner = Planner(catalogue)
            service = Service(settings, catalogue, inbox, uploads, terrains, jobs, planner)
            try:
                yield service
            finally:
                service.readers.close()


def _warm_up() -> None:
    """Load the compiled kernels that read a log, so that the first upload is as fast as others."""
    from spheremark.pipelines.compilation import load_kernels

    for package in ("spheremark.storage.recordings", "spheremark.pipelines.scan"):
        load_kernels(package)


def current(request: Request) -> Service:
    """Return the service that a request is for."""
    service: Service = request.app.state.service
    return service


Current = Annotated[Service, Depends(current)]
