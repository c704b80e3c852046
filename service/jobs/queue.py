"""Jobs: accepted in the catalogue, done by a Dask cluster, recorded once.

Hides the cluster: how work reaches it, how far it is, what happens when a worker dies, when a job
is dismissed or when the service itself is restarted. Everything but ``submit`` runs on the event
loop of the service.
"""

from __future__ import annotations

import asyncio
import logging
import os
import secrets
import traceback
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import monotonic
from typing import Any, Self

import dask
from distributed import Client, Future, LocalCluster, Security
from distributed.client import FutureCancelledError
from distributed.scheduler import KilledWorker

from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.errors import ConflictError, SpheremarkError
from spheremark.service.jobs import worker as tasks
from spheremark.service.jobs.events import EventLog
from spheremark.service.jobs.handlers import KINDS, JobKind, Log, Order, Outcome
from spheremark.service.settings import Settings
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.catalogue.records import JobRecord

logger = logging.getLogger(__name__)

INTERNAL = "internal"
WORKER_DIED = "worker_died"
_RECORD_EVERY = 0.5  # [s] between two reports of progress that reach the database
_GRACE = 1.0  # [s] that a dismissed job has to stop between two steps


@dataclass(slots=True)
class _Live:
    """What the queue knows of a job that it handed out."""

    job: JobRecord
    future: Future | None = None
    worker: str = ""
    has_begun: bool = False
    is_running: bool = False
    recorded_at: float = 0.0
    stopped: asyncio.Event = field(default_factory=asyncio.Event)
    turn: asyncio.Lock = field(default_factory=asyncio.Lock)  # beginning and end, one at a time

    @property
    def is_over(self) -> bool:
        """Whether its work is done, so that news of it come too late."""
        return self.future is not None and self.future.done()


class JobQueue:
    """The jobs of one service and the cluster that does them.

    Use as an asynchronous context manager: entering starts the cluster and takes up what an
    earlier life of the service left open; leaving ends the cluster and leaves open jobs open.
    """

    def __init__(self, settings: Settings, catalogue: Catalogue, clouds: Path) -> None:
        self.events = EventLog()
        self._settings = settings
        self._catalogue = catalogue
        self._clouds = clouds
        self._live: dict[str, _Live] = {}
        self._followers: set[asyncio.Task[None]] = set()
        self._heard: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        self._stack = AsyncExitStack()

    async def __aenter__(self) -> Self:
        self._loop = asyncio.get_running_loop()
        self._client = await self._connect()
        self._client.subscribe_topic(tasks.TOPIC, lambda event: self._heard.put_nowait(event[1]))
        await self._client.register_plugin(tasks.WarmUp(is_ours=not self._settings.scheduler))
        recorder = asyncio.create_task(self._record())
        self._stack.callback(recorder.cancel)
        for job in await asyncio.to_thread(self._catalogue.take_up_jobs):
            self._hand_out(job)
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.events.close()
        for follower in self._followers:
            follower.cancel()
        await asyncio.gather(*self._followers, return_exceptions=True)
        await self._stack.aclose()

    async def _connect(self) -> Client:
        """Start a cluster of our own, or use the one that the settings name."""
        address: str | LocalCluster = self._settings.scheduler
        if not address:
            self._stack.enter_context(
                dask.config.set(
                    {
                        "distributed.scheduler.allowed-failures": self._settings.job_attempts - 1,
                        # one task per worker: a worker that dies takes no waiting job with it
                        "distributed.scheduler.worker-saturation": 1.0,
                        # nothing of Dask answers to a browser
                        "distributed.scheduler.http.routes": [],
                        "distributed.worker.http.routes": [],
                    }
                )
            )
            address = await self._stack.enter_async_context(
                LocalCluster(
                    n_workers=self._settings.workers,
                    threads_per_worker=1,
                    processes=True,
                    host="127.0.0.1",
                    protocol="tls://",
                    security=Security.temporary(),  # others on this machine may not give it tasks
                    dashboard_address="127.0.0.1:0",
                    worker_dashboard_address="127.0.0.1:0",
                    asynchronous=True,
                    silence_logs=logging.ERROR,
                )
            )
        client: Client = await self._stack.enter_async_context(Client(address, asynchronous=True))
        return client

    def n_workers(self) -> int:
        """Return the number of worker processes that are ready."""
        return len(self._client.scheduler_info(n_workers=-1)["workers"])

    def submit(self, job: JobRecord) -> None:
        """Hand an accepted job to the cluster; may be called from any thread."""
        self._loop.call_soon_threadsafe(self._hand_out, job)

    async def dismiss(self, job_id: str) -> JobRecord:
        """Give a job up: between two steps if it stops by itself, else with its worker."""
        job = await asyncio.to_thread(self._catalogue.dismiss_job, job_id)
        await self.events.add(job)
        live = self._live.get(job_id)
        if live is not None and live.future is not None:
            await live.future.cancel(force=True)
            if live.is_running:
                self._keep(self._stop(live))
        return job

    async def _stop(self, live: _Live) -> None:
        """Wait a little for a dismissed job to stop, then end the process that runs it."""
        with suppress(asyncio.TimeoutError):
            await asyncio.wait_for(live.stopped.wait(), _GRACE)
            return
        logger.warning("Ending a worker", extra={"job": live.job.job_id, "worker": live.worker})
        await self._client.run(os._exit, 1, workers=[live.worker], on_error="ignore")

    def _hand_out(self, job: JobRecord) -> None:
        """Follow a job from here to its end."""
        self._live[job.job_id] = _Live(job)
        self._keep(self._follow(self._live[job.job_id]))

    def _keep(self, work: Any) -> None:
        """Run something beside everything else, and remember it until it is done."""
        task = asyncio.create_task(work)
        self._followers.add(task)
        task.add_done_callback(self._followers.discard)

    async def _follow(self, live: _Live) -> None:
        """Have a job done and record how it ended: the one place where every error is caught."""
        job = live.job
        try:
            await self.events.add(job)
            order = await asyncio.to_thread(self._order, job)
            live.future = self._client.submit(
                tasks.do, order, key=f"{job.job_id}-{order.result_id}", pure=False
            )
            outcome = await live.future
            async with live.turn:
                if not live.has_begun:
                    await self._begin(live)
                ended = await asyncio.to_thread(self._finish, live, outcome)
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
        if ended.status.is_final:
            await self.events.add(ended)

    def _order(self, job: JobRecord) -> Order:
        """Put together what a worker needs for a job."""
        catalogue, kind = self._catalogue, JobKind(job.kind)
        rig = job.options.get("rig")
        order = Order(
            job_id=job.job_id,
            kind=kind,
            result_id=secrets.token_hex(8),
            survey_id=job.survey_id,
            logs=tuple(self._log(one) for one in recordings_of(job)),
            config=SurveyConfig.from_mapping(job.config),
            marks=catalogue.control_marks(job.survey_id),
            rig=None if rig is None else catalogue.get_rig(rig),
            clouds_url=str(self._clouds),
            options=job.options,
        )
        return replace(order, known=KINDS[kind].gather(catalogue, order))

    def _log(self, recording_id: str) -> Log:
        """Return where a log is and what it is called."""
        known = self._catalogue.get_recording(recording_id)
        return Log(recording_id=recording_id, name=known.name, url=known.url)

    async def _begin(self, live: _Live) -> None:
        """Record that a worker began; again, if the one before died."""
        job_id = live.job.job_id
        if live.has_begun:
            reason = "The worker died; tried again."
            await asyncio.to_thread(self._catalogue.requeue_job, job_id, reason)
        live.has_begun = True
        live.job = await asyncio.to_thread(self._catalogue.start_job, job_id)

    def _finish(self, live: _Live, outcome: Outcome) -> JobRecord:
        """Write results and end of a job in one transaction; a dismissed job keeps none."""
        job_id = live.job.job_id
        with suppress(ConflictError):
            self._catalogue.finish_job(job_id, outcome.tables, message=outcome.message)
        return self._catalogue.get_job(job_id)

    async def _fail(
        self, live: _Live, code: str, reason: str, trace: str | None = None
    ) -> JobRecord:
        """Record why a job failed, unless it was dismissed before."""
        job_id = live.job.job_id
        try:
            return await asyncio.to_thread(
                self._catalogue.fail_job, job_id, code=code, reason=reason, traceback=trace
            )
        except ConflictError:
            return await asyncio.to_thread(self._catalogue.get_job, job_id)

    def _why_killed(self) -> str:
        """Say what is known of a job whose workers died."""
        return (
            f"The worker process died {self._settings.job_attempts} times at this job, most likely "
            "for want of memory; give the machine more of it, or use fewer workers."
        )

    async def _record(self) -> None:
        """Take down what workers tell, one thing after the other."""
        while True:
            heard = await self._heard.get()
            live = self._live.get(heard["job"])
            if live is not None:
                with suppress(ConflictError):  # dismissed in the meantime
                    await self._note(live, heard)

    async def _note(self, live: _Live, heard: dict[str, Any]) -> None:
        """Take down one thing that a worker told."""
        live.is_running = heard["event"] != "stopped"
        live.worker = heard["worker"]
        if heard["event"] == "stopped":
            live.stopped.set()
            return
        if heard["event"] == "started":
            async with live.turn:
                if not live.is_over:  # else whoever awaits it has begun it
                    await self._begin(live)
        if live.is_over:
            return
        live.job = replace(live.job, progress_percent=heard["percent"], message=heard["message"])
        await self.events.add(live.job)
        if monotonic() - live.recorded_at >= _RECORD_EVERY:
            live.recorded_at = monotonic()
            await asyncio.to_thread(
                self._catalogue.report_progress,
                live.job.job_id,
                heard["percent"],
                heard["message"],
            )


def recordings_of(job: JobRecord) -> tuple[str, ...]:
    """Return the logs that a job reads, in the order in which they were named."""
    if job.recording_id is not None:
        return (job.recording_id,)
    return tuple(job.options.get("recordings", ()))
