"""The worker process: runs the handler of a job and reports its progress.

Runs in processes of the cluster: takes paths and small values, returns Arrow tables. Nothing here
writes to the catalogue; errors are raised here and recorded by the service.
"""

from __future__ import annotations

import logging
import os
import signal
import threading
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import TYPE_CHECKING

from distributed import WorkerPlugin, get_worker

from spheremark.pipelines.compilation import watch_compilation
from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.threads import in_processes
from spheremark.service.jobs.handlers import KINDS, JobResult, JobSpecification
from spheremark.service.jobs.memory import keep_memory
from spheremark.storage.confined import start_readers

if TYPE_CHECKING:
    from collections.abc import Callable

    from distributed import Worker

_LOG = logging.getLogger(__name__)
TOPIC = "spheremark"  # of the events that report progress
_SHORT_TURN = 1.0  # [s] of the gimbal, where only the code that runs matters
_TICK = 0.1  # [s] between two reports of progress
_NICE = 10  # a tenth of the processor's time where pages and queries want all of it


class DismissedError(Exception):
    """The job was dismissed while it ran."""


class Reporter:
    """Reports the progress of a job, and stops it between steps once it is dismissed."""

    def __init__(self, job_id: str) -> None:
        self._worker = get_worker()
        self._key = self._worker.get_current_task()
        self._job_id = job_id
        self._last = 0.0

    def send(self, event: str, share: float = 0.0, message: str = "") -> None:
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
        """Report a step; raise DismissedError if the job was dismissed."""
        task = self._worker.state.tasks.get(self._key)
        if task is None or task.state == "cancelled":
            raise DismissedError(self._job_id)
        if perf_counter() - self._last >= _TICK:
            self._last = perf_counter()
            self.send("progress", share, message)


def run(spec: JobSpecification) -> JobResult:
    """Run the handler of a job and report its progress."""
    reporter = Reporter(spec.job_id)
    reporter.send("started", 0.0, "Started.")
    try:
        return KINDS[spec.kind].handle(spec, reporter.progress)
    finally:
        reporter.send("stopped")


def end_worker(key: str, dask_worker: Worker) -> None:
    """End this process if it still runs a task: the next one has perhaps begun."""
    if any(task.key == key for task in dask_worker.state.executing):
        os._exit(1)


class WarmUp(WorkerPlugin):  # type: ignore[misc]  # distributed ships no types
    """Loads modules and compiled kernels in a new worker, beside its first job."""

    name = "spheremark-warm-up"
    idempotent = True

    def __init__(self, *, is_ours: bool) -> None:
        self.is_ours = is_ours

    def setup(self, worker: Worker) -> None:  # noqa: ARG002  the protocol of Dask
        """Begin, without delaying the first job."""
        keep_memory()
        watch_compilation(_log_compilation)
        if self.is_ours:  # Ctrl-C is for the service, which then ends its workers
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            os.nice(_NICE)  # threads and readers that begin from here on inherit it
        threading.Thread(target=warm_up, name="warm-up", daemon=True).start()


def _log_compilation(n_compiled: int) -> None:
    """Log why the first job of a new version takes longer."""
    if n_compiled == 0:
        _LOG.warning("Compiling numerical kernels, once: the first job takes a minute longer.")


def warm_up() -> None:
    """Load the modules of a job, and the kernels compiled by earlier processes."""
    from spheremark.service.jobs import loaded  # noqa: F401

    start_readers()


def compile_kernels() -> None:
    """Run a survey and a plan, each in its process, so that later runs find compiled kernels."""
    in_processes(_call, (_compile_survey, _compile_planner))


def _call(work: Callable[[], None]) -> None:
    """Do some work."""
    work()


def _compile_survey() -> None:
    """Run the whole chain on a small simulated log."""
    from spheremark.pipelines.interface import adjust
    from spheremark.pipelines.simulation import SimulationConfig, scenario, simulate_stop
    from spheremark.pipelines.survey import process
    from spheremark.storage.clouds.stop import view
    from spheremark.storage.recordings import inspect_log, read_log, write_log

    field = scenario("paper-field", 0)
    quick = SimulationConfig(only_near_spheres=True)
    stop = simulate_stop(field, field.stops[0].name, quick)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "small.mcap"
        write_log(stop.log, path, firings=stop.firings)
        inspect_log(path)
        write_log(stop.log, path)
        inspect_log(path)
        results = process(read_log(path), config=SurveyConfig(), marks=field.marks)
    for result in results:
        view(result, 1000)
    adjust(results, field.marks)
    simulate_stop(field, field.stops[0].name, SimulationConfig(turn=_SHORT_TURN))


def _compile_planner() -> None:
    """Evaluate and optimise a small plan, so that the planner's page responds at once."""
    from spheremark.pipelines.placement import Goal, PlaceRules, Requirement, Sensor, sensor_model
    from spheremark.service.planning import plans
    from spheremark.service.planning.requests import Plan, simulated_ground

    ground = simulated_ground("paper-field")
    plan = Plan(
        ground=ground,
        stops=ground.stops,
        marks=ground.marks,
        model=sensor_model(Sensor(), ground.site.marker_radius),
        requirement=Requirement(),
    )
    plans.evaluate(plan)
    plans.optimise(plan, plans.Aim(rules=PlaceRules(spacing=4.0), goal=Goal(n_marks=3)))


if __name__ == "__main__":
    compile_kernels()
