"""What a worker process does: one log through the chain, into tables and a stored cloud.

Runs in processes of the cluster: takes paths and small values, returns Arrow tables. Nothing here
knows the catalogue; what goes wrong is raised and recorded by the service.
"""

from __future__ import annotations

import resource
import signal
import subprocess
import threading
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import TYPE_CHECKING

from distributed import WorkerPlugin, get_worker

from pipelines.config import SurveyConfig
from pipelines.values import ControlMarks, NoFix, Origin, Status, StopResult

if TYPE_CHECKING:
    import pyarrow as pa
    from distributed import Worker

TOPIC = "spheremark"  # of the events by which workers tell how far they are
_TICK = 0.1  # [s] between two reports of progress


class DismissedError(Exception):
    """The job was dismissed while it ran."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """What a worker is asked to do: values and places, never arrays of a scan, never truth."""

    job_id: str
    run_id: str
    survey_id: str
    recording_id: str
    recording_url: str
    recording_name: str
    config: SurveyConfig
    marks: ControlMarks | None
    clouds_url: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What a job gave: rows named as the tables of the database, and a sentence for people."""

    tables: dict[str, pa.Table]
    message: str


class Reporter:
    """Tells the service how far a job is, and stops it between steps once it is dismissed."""

    def __init__(self, job_id: str) -> None:
        self._worker = get_worker()
        self._key = self._worker.get_current_task()
        self._job_id = job_id
        self._last = 0.0

    def tell(self, event: str, share: float = 0.0, message: str = "") -> None:
        """Send one event to the service."""
        self._worker.log_event(
            TOPIC,
            {
                "job": self._job_id,
                "event": event,
                "percent": round(100 * share, 1),
                "message": message,
                "worker": self._worker.address,
            },
        )

    def progress(self, share: float, message: str) -> None:
        """Report a step; raise DismissedError if nobody wants the result any more."""
        task = self._worker.state.tasks.get(self._key)
        if task is None or task.state == "cancelled":
            raise DismissedError(self._job_id)
        if perf_counter() - self._last >= _TICK:
            self._last = perf_counter()
            self.tell("progress", share, message)


def process_recording(order: Order) -> Outcome:
    """Run the chain on one stored log."""
    reporter = Reporter(order.job_id)
    reporter.tell("started", 0.0, f"Reading {order.recording_name}")
    try:
        return _process(order, reporter)
    finally:
        reporter.tell("stopped")


def _process(order: Order, reporter: Reporter) -> Outcome:
    """Read the log, run the chain, store the clouds, make the tables."""
    from pipelines.survey import process
    from storage.clouds import write_cloud
    from storage.recordings import read_log
    from storage.results import RunInfo, tables

    start = perf_counter()
    forget_peak_memory()
    log = read_log(order.recording_url, digest=order.recording_id)
    stops = process(
        replace(log, origin=Origin(name=order.recording_name, digest=order.recording_id)),
        config=order.config,
        marks=order.marks,
        progress=lambda share, what: reporter.progress(0.1 + 0.8 * share, what),
    )
    reporter.progress(0.9, "Storing the results")
    clouds = {stop.name: write_cloud(stop, order.clouds_url) for stop in stops}
    run = RunInfo(
        run_id=order.run_id,
        job_id=order.job_id,
        survey_id=order.survey_id,
        recording_id=order.recording_id,
        config=order.config,
        code_version=code_version(),
        finished_at=datetime.now(UTC),
        duration=perf_counter() - start,
        peak_memory_bytes=peak_memory(),
    )
    rows = tables(run, stops, marks=order.marks, clouds=clouds)
    return Outcome(tables=rows, message=summary(stops))


def summary(stops: Sequence[StopResult]) -> str:
    """Say in a sentence or two what a log gave, and what is missing or weak."""
    return " ".join(_stop_summary(stop) for stop in stops)


def _stop_summary(stop: StopResult) -> str:
    """Say what one stop gave, by the first methods."""
    n_markers = len(next(iter(stop.fits.values())).fits)
    text = f"{stop.name}: {n_markers} marker{'' if n_markers == 1 else 's'}"
    if not stop.fixes:
        return f"{text}; no control marks, so no position."
    fix = next(iter(stop.fixes.values()))
    if isinstance(fix, NoFix):
        return f"{text}; no position: {fix.reason}"
    sigma = (
        f"{text}, {len(fix.matches)} of them on marks; station with a sigma of "
        f"{1000 * fix.sigma_3d:.1f} mm (3-D)"
    )
    return f"{sigma}; weak: {fix.reason}" if fix.status is Status.WEAK else f"{sigma}."


def forget_peak_memory() -> None:
    """Let the kernel count this process's peak memory from here, where it can (Linux)."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_memory() -> int:
    """Return the largest resident size of this process since it was last forgotten [bytes]."""
    with suppress(OSError, StopIteration):
        lines = Path("/proc/self/status").read_text().splitlines()
        line = next(line for line in lines if line.startswith("VmHWM:"))
        return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


@lru_cache
def code_version() -> str:
    """Return the version that made a number: the release, and the commit in a checkout."""
    release = metadata.version("spheremark")
    root = Path(__file__).parent.parent
    if not (root / ".git").exists():
        return release
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--exclude=*"]
    with suppress(OSError):  # without git, the release has to do
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode == 0:
            return f"{release}+g{done.stdout.strip().replace('-', '.')}"
    return release


class WarmUp(WorkerPlugin):  # type: ignore[misc]  # distributed ships no types
    """Makes a new worker ready beside its first job: imports and compiled kernels."""

    name = "spheremark-warm-up"
    idempotent = True

    def __init__(self, *, is_ours: bool) -> None:
        self.is_ours = is_ours

    def setup(self, worker: Worker) -> None:  # noqa: ARG002  the protocol of Dask
        """Begin, without keeping the worker from work."""
        if self.is_ours:  # Ctrl-C is for the service, which then ends its workers
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        threading.Thread(target=warm_up, name="warm-up", daemon=True).start()


def warm_up() -> None:
    """Load what a job needs beside the first one."""
    import open3d  # noqa: F401

    from pipelines import survey  # noqa: F401
    from storage import clouds, recordings, results  # noqa: F401


def compile_kernels() -> None:
    """Run the whole chain on a small simulated log, so that later runs find compiled kernels."""
    from pipelines.simulation import SimulationConfig, scenario, simulate_stop
    from pipelines.survey import process
    from storage.clouds import view
    from storage.recordings import inspect_log, read_log, write_log

    field = scenario("paper-field", 0)
    quick = SimulationConfig(only_near_spheres=True)
    stop = simulate_stop(field, field.stops[0].name, quick)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "small.mcap"
        write_log(stop.log, path, firings=stop.firings)
        inspect_log(path)
        write_log(stop.log, path)
        inspect_log(path)
        for result in process(read_log(path), config=SurveyConfig(), marks=field.marks):
            view(result, 1000)


if __name__ == "__main__":
    compile_kernels()
