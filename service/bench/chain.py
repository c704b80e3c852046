"""What the chain from log to committed rows costs, step by step, as a worker runs it."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from time import perf_counter, process_time

from spheremark.pipelines.config import FittingConfig, SurveyConfig
from spheremark.pipelines.evaluation.experiment import Plain, Progress
from spheremark.pipelines.model import Array, ControlMarks, ScanLog, StopResult
from spheremark.pipelines.survey import process
from spheremark.service.bench.yardstick import Cost, least, read_cost
from spheremark.service.jobs.memory import keep_memory
from spheremark.service.provenance import forget_peak_memory, peak_memory
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.catalogue.results import RunInfo, tables
from spheremark.storage.recordings import inspect_log, read_log

METHOD = "along_beam"
CONFIG = SurveyConfig(fitting=FittingConfig(methods=(METHOD,)))
CHAIN = "log to rows committed"
"""The step that is the sum of all."""

_DIGEST = "0" * 64  # as from the upload
Costs = dict[str, Cost]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Scan:
    """A log on disk with what is known of it; marks and true centres when it was simulated."""

    log: Path
    marks: ControlMarks | None = None
    true_base: Array | None = None


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Measured:
    """The least cost of each step, the result of a run, and the number of its returns."""

    costs: Costs
    result: StopResult
    n_returns: int


def measure(
    scans: Mapping[str, Scan], folder: Path, repeats: int, progress: Progress
) -> tuple[Cost, dict[str, Measured]]:
    """Run the chain on scans in turn, a few times; return the yardstick and the least costs.

    The first round compiles kernels and fills the cache of the files; it does not count. Yardstick
    and scans take turns, so that other load on the machine slows all of them alike. The database
    stays open, as that of the service does.
    """
    plain = next(iter(scans.values()))
    reads: list[Cost] = []
    found: dict[str, Measured] = {}
    with _catalogue(folder) as catalogue:
        for i in range(repeats + 1):
            progress(0.6 * i / (repeats + 1), f"Run {i} of {repeats}" if i else "A first run")
            reads.append(read_cost(plain.log))
            for name, scan in scans.items():
                one = _chain(scan, catalogue)
                found[name] = _better(found[name], one) if i > 1 else one
    return least(reads), found


def _better(known: Measured, other: Measured) -> Measured:
    """Return the least cost of each step; the clouds of all runs would fill the memory."""
    costs = {step: least((cost, other.costs[step])) for step, cost in known.costs.items()}
    return replace(known, costs=costs)


def _chain(scan: Scan, catalogue: Catalogue) -> Measured:
    """Run everything once."""
    costs: Costs = {}
    with _timed(costs, "preflight"):
        preflight = inspect_log(scan.log)
    stops = _committed(scan, catalogue, costs)
    return Measured(costs=_in_order(costs, stops), result=stops[0], n_returns=preflight.n_returns)


def _committed(scan: Scan, catalogue: Catalogue, costs: Costs) -> tuple[StopResult, ...]:
    """Bring a log into a database; return its stops."""
    job = _job(catalogue)
    run = _run(catalogue, job)
    with _timed(costs, CHAIN):
        stops = process(_read(scan.log, costs), config=CONFIG, marks=scan.marks)
        with _timed(costs, "rows"):
            rows = tables(run, stops, marks=scan.marks)
        with _timed(costs, "commit"):
            catalogue.finish_job(job, rows)
    return stops


def _read(log: Path, costs: Costs) -> ScanLog:
    """Read a log as the service does, with the digest from the upload."""
    with _timed(costs, "read log"):
        return read_log(log, digest=_DIGEST)


@contextmanager
def _catalogue(folder: Path) -> Iterator[Catalogue]:
    """Open a new database with the survey and the recording that rows of a run refer to."""
    place = Path(tempfile.mkdtemp(dir=folder))
    with Catalogue(place / "bench.duckdb", snapshots=place / "snapshots") as catalogue:
        catalogue.create_survey("bench")
        catalogue.add_recording(
            _DIGEST, name="bench", size_bytes=0, url="", preflight={"verdict": "ok"}
        )
        yield catalogue


def _job(catalogue: Catalogue) -> str:
    """Return the id of a new job that runs."""
    job = catalogue.create_job("process", survey="bench", recording_id=_DIGEST, config={})
    return catalogue.start_job(job.job_id).job_id


def _run(catalogue: Catalogue, job_id: str) -> RunInfo:
    """Return the identity of a run in its rows."""
    job = catalogue.get_job(job_id)
    return RunInfo(
        run_id=job_id,
        job_id=job_id,
        survey_id=job.survey_id,
        recording_id=job.recording_id or "",
        config=CONFIG,
        code_version="bench",
        finished_at=datetime.now(UTC),
        duration=0.0,
    )


def _in_order(costs: Costs, stops: Sequence[StopResult]) -> Costs:
    """Put the times of the chain's own steps, summed over stops, between reading and rows."""
    steps: dict[str, float] = {}
    for stop in stops:
        for step, seconds in stop.timings.items():
            steps[step] = steps.get(step, 0.0) + seconds
    first = {name: costs[name] for name in ("preflight", "read log")}
    no_cpu = float("nan")  # not measured inside the chain
    middle = {name: Cost(seconds, no_cpu) for name, seconds in steps.items()}
    last = {name: costs[name] for name in ("rows", "commit", CHAIN)}
    return first | middle | last


def memory(log: Path, folder: Path) -> Plain:
    """Run one scan in a fresh process; return its resident memory before and at the most."""
    command = [sys.executable, "-m", "spheremark.service.bench.chain", str(log), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found: Plain = json.loads(done.stdout)
    return found


def _fresh(log: Path, folder: Path) -> Plain:
    """Run one scan in this process, which has only imported before."""
    keep_memory()
    before = _resident()
    forget_peak_memory()
    with _catalogue(folder) as catalogue:
        _committed(Scan(log=log), catalogue, {})
    peak = peak_memory()
    return {"before_bytes": before, "peak_bytes": peak, "scan_bytes": peak - before}


def _resident() -> int:
    """Return the resident size of this process [bytes]."""
    forget_peak_memory()
    return peak_memory()


@contextmanager
def _timed(costs: Costs, step: str) -> Iterator[None]:
    """Record what a step costs."""
    start, cpu = perf_counter(), process_time()
    yield
    costs[step] = Cost(perf_counter() - start, process_time() - cpu)


if __name__ == "__main__":
    sys.stdout.write(json.dumps(_fresh(Path(sys.argv[1]), Path(sys.argv[2]))))
