"""How long each step takes, as a multiple of one read of the file with a checksum in the same run.

The yardstick makes machines comparable: it is what any program must pay that looks at each byte.
"""

from __future__ import annotations

import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from time import perf_counter
from typing import Any

from pipelines.config import SurveyConfig
from pipelines.simulation import SimulationConfig
from pipelines.survey import Progress, process
from pipelines.values import ControlMarks, StopResult
from service.fieldwork import Assignment, survey
from service.tasks import forget_peak_memory, peak_memory
from storage.catalogue import Catalogue
from storage.recordings import inspect_log, read_log
from storage.results import RunInfo, tables
from storage.site_files import read_control

_BLOCK = 4 << 20  # [bytes] read at once
_STOP = "lane3-stop4"  # the centre of the field
Timings = dict[str, float]


def run(log: Path | None, repeats: int, progress: Progress) -> dict[str, Any]:
    """Measure the chain on a log, or on a simulated stop; the best of each step counts."""
    with tempfile.TemporaryDirectory() as folder:
        marks = None
        if log is None:
            log, marks = _simulated(Path(folder), progress)
        read_log(log)  # compiles the kernels, fills the cache of the file
        _chain(log, marks, Path(folder) / "warm")
        forget_peak_memory()
        found = []
        for i in range(repeats):
            progress(i / repeats, f"Run {i + 1} of {repeats}")
            found.append(_chain(log, marks, Path(folder) / str(i)))
        return _report(log, found)


def _simulated(folder: Path, progress: Progress) -> tuple[Path, ControlMarks]:
    """Simulate one stop of the study's field."""
    wanted = Assignment(
        scenario="paper-field",
        stops=_STOP,
        seed=0,
        config=SimulationConfig(),
        compression="none",
    )
    (made,) = survey(folder, wanted, progress=progress)
    return made.log, read_control(folder / "control.csv")


def _chain(log: Path, marks: ControlMarks | None, folder: Path) -> tuple[Timings, int]:
    """Run everything once; return the time of each step [s] and the number of returns."""
    times: Timings = {}
    with _timed(times, "read+CRC"):
        _checksum(log)
    with _timed(times, "preflight"):
        inspect_log(log)
    with Catalogue(folder / "bench.duckdb", snapshots=folder / "snapshots") as catalogue:
        job = _job(catalogue, log)
        with _timed(times, "log to rows committed"):
            with _timed(times, "read log"):
                scan = read_log(log)
            stops = process(scan, config=SurveyConfig(), marks=marks)
            with _timed(times, "rows"):
                rows = tables(_run(catalogue, job), stops, marks=marks)
            with _timed(times, "commit"):
                catalogue.finish_job(job, rows)
    return _in_order(times, stops), len(scan.p_lidar)


def _checksum(log: Path) -> int:
    """Read a file once, with a CRC-32."""
    crc = 0
    with log.open("rb") as file:
        while block := file.read(_BLOCK):
            crc = zlib.crc32(block, crc)
    return crc


def _job(catalogue: Catalogue, log: Path) -> str:
    """Enter what the rows of a run refer to; return the id of a job that runs."""
    catalogue.create_survey("bench")
    recording = catalogue.add_recording(
        "0" * 64, name=log.stem, size_bytes=0, url=str(log), preflight={"verdict": "ok"}
    )
    job = catalogue.create_job(
        "process", survey="bench", recording_id=recording.recording_id, config={}
    )
    return catalogue.start_job(job.job_id).job_id


def _run(catalogue: Catalogue, job_id: str) -> RunInfo:
    """Return what names the rows of a run."""
    job = catalogue.get_job(job_id)
    return RunInfo(
        run_id=job_id,
        job_id=job_id,
        survey_id=job.survey_id,
        recording_id=job.recording_id or "",
        config=SurveyConfig(),
        code_version="bench",
        finished_at=datetime.now(UTC),
        duration=0.0,
    )


def _in_order(times: Timings, stops: tuple[StopResult, ...]) -> Timings:
    """Put the times of the chain's own steps, summed over stops, between reading and rows."""
    steps: Timings = {}
    for stop in stops:
        for step, seconds in stop.timings.items():
            steps[step] = steps.get(step, 0.0) + seconds
    first = {name: times[name] for name in ("read+CRC", "preflight", "read log")}
    last = {name: times[name] for name in ("rows", "commit", "log to rows committed")}
    return first | steps | last


def _report(log: Path, found: list[tuple[Timings, int]]) -> dict[str, Any]:
    """Return the best time of each step, and its ratio to the yardstick."""
    best = {step: min(times[step] for times, _ in found) for step in found[0][0]}
    return {
        "log": {
            "name": log.name,
            "size_bytes": log.stat().st_size,
            "n_returns": found[0][1],
        },
        "repeats": len(found),
        "steps": [
            {"step": step, "seconds": seconds, "ratio": seconds / best["read+CRC"]}
            for step, seconds in best.items()
        ],
        "peak_memory_bytes": peak_memory(),
    }


@contextmanager
def _timed(times: Timings, step: str) -> Iterator[None]:
    """Record how long a step takes [s]."""
    start = perf_counter()
    yield
    times[step] = perf_counter() - start
