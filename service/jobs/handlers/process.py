"""Jobs of the kind ``process``: one log through the chain, into tables and a stored cloud."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from time import perf_counter
from typing import TYPE_CHECKING

from spheremark.pipelines.errors import NoMarkersError
from spheremark.pipelines.model import (
    ControlMarks,
    NoFix,
    StationFix,
    Status,
    StopResult,
)
from spheremark.pipelines.progress import Progress, part_of
from spheremark.service.jobs.specification import JobResult, JobSpecification, Log
from spheremark.service.provenance import code_version, forget_peak_memory, peak_memory

if TYPE_CHECKING:
    import pyarrow as pa


def handle(spec: JobSpecification, progress: Progress) -> JobResult:
    """Process the one log of a job."""
    stops, rows = process_log(spec, spec.logs[0], spec.result_id, progress)
    return JobResult(tables=rows, message=summary(stops, spec.marks))


def process_log(
    spec: JobSpecification, recording: Log, run_id: str, progress: Progress
) -> tuple[tuple[StopResult, ...], dict[str, pa.Table]]:
    """Read a log, run the chain, store the clouds, make the tables of a run."""
    from spheremark.pipelines.survey import process
    from spheremark.service.log_files import explained
    from spheremark.storage.catalogue.results import RunInfo, tables
    from spheremark.storage.clouds.stop import write_cloud

    start = perf_counter()
    forget_peak_memory()
    progress(0.0, f"Reading {recording.name}")
    try:
        stops = process(
            recording.read(),  # released once it is stitched: no reference is kept
            config=spec.config,
            rig=spec.rig,
            marks=spec.marks,
            progress=part_of(progress, 0.1, 0.9),
        )
    except NoMarkersError as error:
        progress(0.9, "Trying other signs, units and clocks")
        raise explained(error, recording.read, spec.rig) from error
    progress(0.9, "Storing the results")
    clouds = {stop.name: write_cloud(stop, spec.clouds_url) for stop in stops}
    run = RunInfo(
        run_id=run_id,
        job_id=spec.job_id,
        survey_id=spec.survey_id,
        recording_id=recording.recording_id,
        config=spec.config,
        code_version=code_version(),
        finished_at=datetime.now(UTC),
        duration=perf_counter() - start,
        peak_memory_bytes=peak_memory(),
    )
    return stops, tables(run, stops, marks=spec.marks, clouds=clouds)


def summary(stops: Sequence[StopResult], marks: ControlMarks | None) -> str:
    """Return the results of a log in sentences: markers, station, contradictions with control."""
    sentences = [_stop_summary(stop) for stop in stops]
    if marks is not None:
        sentences += [text for stop in stops if (text := _contradiction(stop, marks))]
    return " ".join(sentences)


def _stop_summary(stop: StopResult) -> str:
    """Return the result of one stop by the first methods in a sentence."""
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


def _contradiction(stop: StopResult, marks: ControlMarks) -> str:
    """Name the control marks that the distances in a scan contradict, if any."""
    checks = stop.distances
    is_fixed = any(isinstance(fix, StationFix) for fix in stop.fixes.values())
    if checks is None or not checks.suspects or not is_fixed:
        return ""
    names = ", ".join(marks.names[mark] for mark in checks.suspects)
    return (
        f"{int(checks.is_off.sum())} of {len(checks.is_off)} distances between marks in "
        f"{stop.name} are not those of the control: look at {names}."
    )
