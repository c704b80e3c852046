"""Jobs: accepted in the catalogue, run by a Dask cluster, recorded once.

Hides the cluster: submission, progress, the death of a worker, dismissal, and the restart of the
service. Everything but ``submit`` runs on the event loop of the service.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import traceback
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from time import monotonic
from typing import Any, Self, TypeVar

import dask
from distributed import Client, Future, LocalCluster, Security
from distributed.client import FutureCancelledError
from distributed.core import Status
from distributed.scheduler import KilledWorker
from distributed.utils import get_mp_context

from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.errors import ConflictError, SpheremarkError
from spheremark.service.jobs import clock
from spheremark.service.jobs import worker as tasks
from spheremark.service.jobs.events import EventLog
from spheremark.service.jobs.handlers import (
    KINDS,
    JobKind,
    JobResult,
    JobSpecification,
    Log,
    Reading,
)
from spheremark.service.logs import event_level
from spheremark.service.processes import METHOD, forked
from spheremark.service.settings import Settings
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.catalogue.records import JobRecord
from spheremark.storage.files import StorageError

logger = logging.getLogger(__name__)

_Result = TypeVar("_Result")

INTERNAL = "internal"
WORKER_DIED = "worker_died"
TOO_LONG = "job_timeout"
_RECORD_EVERY = 0.5  # [s] between two reports of progress that reach the database
_STORE_AGAIN, _STORE_AGAIN_MAX = 1.0, 30.0  # [s] until a result is written again
_COUNT_EVERY, _COUNT_FIRST = 2.0, 0.2  # [s] between two counts of the workers, and without any
_PARTING = 10.0  # [s] that a scheduler has to answer
_SCHEDULER_LOST = "scheduler-connection-lost"  # as Dask gives it for a reason
_LOST = (OSError, TimeoutError, RuntimeError, ValueError)  # what Dask raises without a scheduler
_GRACE = 1.0  # [s] that a dismissed job has to stop between two steps
_NEVER = "10000 days"
_GIVEN_UP = (Status.closed, Status.failed)  # of what starts a worker again where it dies


@dataclass(slots=True)
class _Live:
    """The state of a job that was submitted to the cluster."""

    job: JobRecord
    future: Future | None = None
    worker: str = ""
    has_begun: bool = False
    is_running: bool = False
    recorded_at: float = 0.0
    rank: int = 0
    deadline: asyncio.TimerHandle | None = None
    stopped: asyncio.Event = field(default_factory=asyncio.Event)
    ended: asyncio.Event = field(default_factory=asyncio.Event)
    turn: asyncio.Lock = field(default_factory=asyncio.Lock)  # beginning and end, one at a time

    @property
    def is_over(self) -> bool:
        """Whether its handler has ended, so that later events are ignored."""
        return self.future is not None and self.future.done()


class JobQueue:
    """The jobs of one service and the cluster that runs them.

    Use as an asynchronous context manager: entering starts the cluster and resumes the open jobs
    of an earlier process; leaving ends the cluster and keeps open jobs open.
    """

    def __init__(self, settings: Settings, catalogue: Catalogue, clouds: Path) -> None:
        self.events = EventLog()
        self._settings = settings
        self._catalogue = catalogue
        self._clouds = clouds
        self.n_ended: Counter[tuple[str, str]] = Counter()  # jobs by kind and status
        self._n_workers = 0
        self._ranks: dict[str, int] = {}  # of the last job of each survey
        self._rank = 0  # highest of those that have begun
        self._live: dict[str, _Live] = {}
        self._followers: set[asyncio.Task[None]] = set()
        self._events_in: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        self._stack = AsyncExitStack()
        self._cluster = AsyncExitStack()
        self._own: LocalCluster | None = None
        self._connecting = asyncio.Lock()

    async def __aenter__(self) -> Self:
        self._loop = asyncio.get_running_loop()
        self._client = await self._connect()
        self._stack.push_async_callback(self._disconnect)
        for task in (self._record(), self._count_workers()):
            self._stack.callback(asyncio.create_task(task).cancel)
        most = self._settings.job_attempts
        for job in await asyncio.to_thread(self._catalogue.take_up_jobs, most, self._why_killed()):
            self._start(job)
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.events.close()
        for follower in self._followers:
            follower.cancel()
        await asyncio.gather(*self._followers, return_exceptions=True)
        with suppress(StorageError):
            await asyncio.to_thread(self._catalogue.release_jobs)
        await self._stack.aclose()

    async def _connect(self) -> Client:
        """Start a cluster, or use the one that the settings name."""
        address: str | LocalCluster = self._settings.scheduler
        if not address:
            self._cluster.enter_context(
                dask.config.set(
                    {
                        "distributed.scheduler.allowed-failures": self._settings.job_attempts - 1,
                        # one task per worker: a worker that dies takes no waiting job with it
                        "distributed.scheduler.worker-saturation": 1.0,
                        # else, so long after the death of a worker, Dask ends the process that
                        # starts it again if it is just then without one, and forgets it
                        "distributed.deploy.lost-worker-timeout": _NEVER,
                        # no samples of what runs, and a look at each loop every second: at rest
                        # service and worker take 3 % of a processor, not 8
                        "distributed.worker.profile.enabled": False,
                        "distributed.admin.tick.interval": "1s",
                        # no history of processor and memory, which grows for an hour
                        "distributed.admin.system-monitor.log-length": 10,
                        "distributed.worker.multiprocessing-method": METHOD,
                        # no pages of Dask
                        "distributed.scheduler.http.routes": [],
                        "distributed.worker.http.routes": [],
                    }
                )
            )
            get_mp_context()  # Dask sets, once, what new processes have loaded: forked replaces it
            forked()
            address = self._own = await self._cluster.enter_async_context(
                LocalCluster(
                    n_workers=0,  # the first takes seconds, which pages need not wait for
                    threads_per_worker=1,
                    memory_limit=self._settings.job_memory_bytes or "auto",
                    processes=True,
                    host="127.0.0.1",
                    protocol="tls://",
                    security=Security.temporary(),  # for this service alone
                    dashboard_address="127.0.0.1:0",
                    worker_dashboard_address="127.0.0.1:0",
                    preload=[clock.__name__],
                    asynchronous=True,
                    silence_logs=logging.ERROR,
                )
            )
        client: Client = await Client(address, asynchronous=True)
        # not as a context: its end would fail outside the task of its beginning, and close nothing
        self._cluster.push_async_callback(client.close)
        client.subscribe_topic(tasks.TOPIC, lambda event: self._events_in.put_nowait(event[1]))
        await client.register_plugin(tasks.WarmUp(is_ours=not self._settings.scheduler))
        self._replace_workers()
        return client

    async def _disconnect(self) -> None:
        """End the cluster that the service started, or leave the other one."""
        cluster, self._cluster = self._cluster, AsyncExitStack()
        with suppress(*_LOST):
            await asyncio.wait_for(cluster.aclose(), _PARTING)

    async def _reconnect(self, lost: Client) -> None:
        """Connect again in place of a client that has lost its scheduler; start a new cluster."""
        async with self._connecting:
            while self._client is lost:
                logger.error("The scheduler of the jobs is lost; connecting again.")
                self._n_workers = 0
                await self._disconnect()
                try:
                    self._client = await self._connect()
                except _LOST:
                    await asyncio.sleep(_COUNT_EVERY)

    def n_workers(self) -> int:
        """Return the number of worker processes that were ready a few seconds ago."""
        return self._n_workers

    def count_live(self) -> dict[str, int]:
        """Return the number of jobs that wait and that run."""
        running = sum(live.is_running for live in self._live.values())
        return {"waiting": len(self._live) - running, "running": running}

    async def _count_workers(self) -> None:
        """Keep the number of workers: Dask's own copy of it may be minutes old."""
        while True:
            client = self._client
            if client.status != "running":  # one that is closed has no scheduler to ask
                await self._reconnect(client)
            with suppress(*_LOST):
                known = await asyncio.wait_for(
                    self._client.scheduler.identity(n_workers=-1), _PARTING
                )
                self._n_workers = len(known["workers"])
                self._replace_workers()
            await asyncio.sleep(_COUNT_EVERY if self._n_workers else _COUNT_FIRST)

    def _replace_workers(self) -> None:
        """Start workers in place of those that could not start again."""
        if self._own is None or self._n_workers >= self._settings.workers:
            return
        for name, nanny in tuple(self._own.workers.items()):
            if nanny.status in _GIVEN_UP:
                logger.warning("Starting a worker in place of one that could not start again.")
                del self._own.workers[name]
        self._own.scale(self._settings.workers)

    def submit(self, job: JobRecord) -> None:
        """Submit an accepted job to the cluster; may be called from any thread."""
        self._loop.call_soon_threadsafe(self._start, job)

    async def dismiss(self, job_id: str) -> JobRecord:
        """Dismiss a job: it stops between two steps, or its worker process is ended."""
        job = await asyncio.to_thread(self._catalogue.dismiss_job, job_id)
        await self.events.add(job)
        live = self._live.get(job_id)
        if live is not None and live.future is not None:
            await live.future.cancel(force=True)
            if live.is_running:
                self._keep(self._stop(live))
        return job

    async def _stop(self, live: _Live) -> None:
        """Wait for a dismissed job to stop, then end the process that runs it."""
        with suppress(asyncio.TimeoutError):
            await asyncio.wait_for(live.stopped.wait(), _GRACE)
            return
        if live.future is None:
            return
        logger.warning("Ending a worker", extra={"job": live.job.job_id, "worker": live.worker})
        arguments = {"workers": [live.worker], "on_error": "ignore"}
        await self._client.run(tasks.end_worker, live.future.key, **arguments)

    def _start(self, job: JobRecord) -> None:
        """Follow a job from here to its end; surveys take turns, however many jobs each has."""
        rank = max(self._ranks.get(job.survey_id, 0) + 1, self._rank)
        self._ranks[job.survey_id] = rank
        self._live[job.job_id] = _Live(job, rank=rank)
        self._keep(self._follow(self._live[job.job_id]))

    def _keep(self, coroutine: Any) -> None:
        """Run a coroutine as a task and hold a reference to it until it ends."""
        task = asyncio.create_task(coroutine)
        self._followers.add(task)
        task.add_done_callback(self._followers.discard)

    async def _follow(self, live: _Live) -> None:
        """Run a job and record its end: the one place where every error is caught."""
        job = live.job
        try:
            await self.events.add(job)
            if job.waits_for:
                await self._wait_for(job)
            result = await self._result(live)
            async with live.turn:
                if not live.has_begun:
                    await self._begin(live)
                ended = await self._stored(self._finish, live, result)
        except FutureCancelledError:
            ended = await asyncio.to_thread(self._catalogue.get_job, job.job_id)
        except KilledWorker:
            ended = await self._fail(live, WORKER_DIED, self._why_killed())
        except SpheremarkError as error:
            ended = await self._fail(live, error.code, str(error))
        except Exception as error:
            logger.exception("Job failed", extra={"job": job.job_id})
            text = "".join(traceback.format_exception(error))
            ended = await self._fail(live, INTERNAL, f"{type(error).__name__}: {error}", text)
        self._live.pop(job.job_id, None)
        live.ended.set()
        self.n_ended[job.kind, ended.status.value] += 1
        about = (ended.status, ended.error_reason or ended.message)
        level = event_level(self._settings.log_format)
        logger.log(level, "Job ended: %s. %s", *about, extra={"job": job.job_id})
        if live.deadline is not None:
            live.deadline.cancel()
        if ended.status.is_final:
            await self.events.add(ended)

    async def _wait_for(self, job: JobRecord) -> None:
        """Wait for the end of the jobs whose results a job reads, however they end."""
        for live in [self._live[one] for one in job.waits_for if one in self._live]:
            await live.ended.wait()
        if (await asyncio.to_thread(self._catalogue.get_job, job.job_id)).status.is_final:
            raise FutureCancelledError(job.job_id, "dismissed")

    async def _result(self, live: _Live) -> JobResult:
        """Return the result of a job; run it again where its scheduler was lost."""
        while True:
            client = self._client
            spec = await asyncio.to_thread(self._specification, live.job)
            live.future = client.submit(
                tasks.run,
                spec,
                # Dask keeps statistics of each key's beginning for ever: one for all jobs
                key=f"job-{live.job.job_id}-{spec.result_id}",
                pure=False,
                priority=-live.rank,
            )
            try:
                result: JobResult = await live.future
            except FutureCancelledError as error:
                if error.reason != _SCHEDULER_LOST:
                    raise
                live.is_running = False
                await self._reconnect(client)
            else:
                return result

    def _specification(self, job: JobRecord) -> JobSpecification:
        """Return the input of a worker for a job."""
        catalogue, kind = self._catalogue, JobKind(job.kind)
        rig = job.options.get("rig")
        spec = JobSpecification(
            job_id=job.job_id,
            kind=kind,
            result_id=secrets.token_hex(8),
            survey_id=job.survey_id,
            logs=tuple(self._log(one, job.options) for one in recordings_of(job)),
            config=SurveyConfig.from_mapping(job.config),
            marks=catalogue.control_marks(job.survey_id),
            rig=None if rig is None else catalogue.get_rig(rig),
            clouds_url=str(self._clouds),
            options=job.options,
        )
        return replace(spec, known=KINDS[kind].gather(catalogue, spec))

    def _log(self, recording_id: str, options: Mapping[str, Any]) -> Log:
        """Return address and name of a log, and how to read it: as uploaded, or as the job says."""
        known = self._catalogue.get_recording(recording_id)
        given = ((name, options.get(name)) for name in Reading.model_fields)
        chosen = {name: value for name, value in given if value is not None}
        reading = {**known.preflight.get("reading", {}), **chosen}
        return Log(recording_id=recording_id, name=known.name, url=known.url, reading=reading)

    async def _begin(self, live: _Live) -> None:
        """Record that a worker began; again, if the one before died."""
        job_id = live.job.job_id
        if live.has_begun:
            reason = "The worker died; tried again."
            await self._stored(self._catalogue.requeue_job, job_id, reason)
        live.has_begun = True
        self._rank = max(self._rank, live.rank)
        if live.deadline is not None:
            live.deadline.cancel()
        live.deadline = asyncio.get_running_loop().call_later(
            self._settings.job_seconds, lambda: self._keep(self._end_late(live))
        )
        live.job = await self._stored(self._catalogue.start_job, job_id)
        if live.job.attempts > self._settings.job_attempts:  # those before a restart count too
            await self._fail(live, WORKER_DIED, self._why_killed())
            if live.future is not None:
                await live.future.cancel(force=True)

    async def _end_late(self, live: _Live) -> None:
        """Fail a job that runs too long, and end it."""
        reason = (
            f"The job was ended after {self._settings.job_seconds:g} s, its time limit. Process "
            "fewer logs at once, or raise SPHEREMARK_JOB_SECONDS."
        )
        await self._fail(live, TOO_LONG, reason)
        if live.future is not None:
            await live.future.cancel(force=True)
        if live.is_running:
            await self._stop(live)

    async def _stored(self, store: Callable[..., _Result], *arguments: Any) -> _Result:
        """Write to the catalogue; while the disk refuses, try again: no result is lost by it."""
        pause = _STORE_AGAIN
        while True:
            try:
                return await asyncio.to_thread(store, *arguments)
            except StorageError as error:
                logger.warning("Not stored, trying again in %g s: %s", pause, error)
                await asyncio.sleep(pause)
                pause = min(2.0 * pause, _STORE_AGAIN_MAX)

    def _finish(self, live: _Live, result: JobResult) -> JobRecord:
        """Write results and end of a job in one transaction; a dismissed job keeps none."""
        job_id = live.job.job_id
        with suppress(ConflictError):
            self._catalogue.finish_job(job_id, result.tables, message=result.message)
        return self._catalogue.get_job(job_id)

    async def _fail(
        self, live: _Live, code: str, reason: str, trace: str | None = None
    ) -> JobRecord:
        """Record why a job failed, unless it was dismissed before."""
        job_id = live.job.job_id
        try:
            fail = partial(self._catalogue.fail_job, code=code, reason=reason, traceback=trace)
            return await self._stored(fail, job_id)
        except ConflictError:
            return await asyncio.to_thread(self._catalogue.get_job, job_id)

    def _why_killed(self) -> str:
        """Return the reason for a job whose workers died."""
        return (
            f"The worker process died {self._settings.job_attempts} times at this job, most likely "
            "because memory ran out; add memory to the machine, or use fewer workers."
        )

    async def _record(self) -> None:
        """Record the events of workers, one after the other."""
        while True:
            event = await self._events_in.get()
            live = self._live.get(event["job"])
            if live is not None:
                with suppress(ConflictError):  # dismissed in the meantime
                    await self._note(live, event)

    async def _note(self, live: _Live, event: dict[str, Any]) -> None:
        """Record one event of a worker."""
        live.is_running = event["event"] != "stopped"
        live.worker = event["worker"]
        if event["event"] == "stopped":
            live.stopped.set()
            return
        if event["event"] == "started":
            async with live.turn:
                if not live.is_over:  # else the coroutine that awaits it has begun it
                    await self._begin(live)
        if live.is_over:
            return
        live.job = replace(live.job, progress_percent=event["percent"], message=event["message"])
        await self.events.add(live.job)
        if monotonic() - live.recorded_at >= _RECORD_EVERY:
            live.recorded_at = monotonic()
            report = (live.job.job_id, event["percent"], event["message"])
            with suppress(StorageError):  # the next one may succeed
                await asyncio.to_thread(self._catalogue.report_progress, *report)


def recordings_of(job: JobRecord) -> tuple[str, ...]:
    """Return the logs that a job reads, in the order of the request."""
    if job.recording_id is not None:
        return (job.recording_id,)
    return tuple(job.options.get("recordings", ()))
