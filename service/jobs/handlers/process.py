"""Jobs of the kind ``process``: one log through the chain, into tables and a stored cloud."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from time import perf_counter
from typing import TYPE_CHECKING

from spheremark.pipelines.model import (
    ControlMarks,
    NoFix,
    Origin,
    ScanLog,
    StationFix,
    Status,
    StopResult,
)
from spheremark.service.jobs.specification import Log, Order, Outcome
from spheremark.service.provenance import code_version, forget_peak_memory, peak_memory

if TYPE_CHECKING:
    import pyarrow as pa

    from spheremark.pipelines.survey import Progress


def work(order: Order, progress: Progress) -> Outcome:
    """Process the one log of an order."""
    stops, rows = process_log(order, order.logs[0], order.result_id, progress)
    return Outcome(tables=rows, message=summary(stops, order.marks))


def process_log(
    order: Order, recording: Log, run_id: str, progress: Progress
) -> tuple[tuple[StopResult, ...], dict[str, pa.Table]]:
    """Read a log, run the chain, store the clouds, make the tables of a run."""
    from spheremark.pipelines.survey import process
    from spheremark.storage.catalogue.results import RunInfo, tables
    from spheremark.storage.clouds.stop import write_cloud

    start = perf_counter()
    forget_peak_memory()
    progress(0.0, f"Reading {recording.name}")
    stops = process(
        _read(recording),  # and not kept: it is let go once it is stitched
        config=order.config,
        rig=order.rig,
        marks=order.marks,
        progress=lambda share, what: progress(0.1 + 0.8 * share, what),
    )
    progress(0.9, "Storing the results")
    clouds = {stop.name: write_cloud(stop, order.clouds_url) for stop in stops}
    run = RunInfo(
        run_id=run_id,
        job_id=order.job_id,
        survey_id=order.survey_id,
        recording_id=recording.recording_id,
        config=order.config,
        code_version=code_version(),
        finished_at=datetime.now(UTC),
        duration=perf_counter() - start,
        peak_memory_bytes=peak_memory(),
    )
    return stops, tables(run, stops, marks=order.marks, clouds=clouds)


def summary(stops: Sequence[StopResult], marks: ControlMarks | None) -> str:
    """Say in a sentence or two what a log gave, and what is missing, weak or contradicted."""
    sentences = [_stop_summary(stop) for stop in stops]
    if marks is not None:
        sentences += [text for stop in stops if (text := _contradiction(stop, marks))]
    return " ".join(sentences)


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


def _contradiction(stop: StopResult, marks: ControlMarks) -> str:
    """Say which control marks the distances in a scan contradict, if any."""
    checks = stop.distances
    is_fixed = any(isinstance(fix, StationFix) for fix in stop.fixes.values())
    if checks is None or not checks.suspects or not is_fixed:
        return ""
    names = ", ".join(marks.names[mark] for mark in checks.suspects)
    return (
        f"{int(checks.is_off.sum())} of {len(checks.is_off)} distances between marks in "
        f"{stop.name} are not those of the control: look at {names}."
    )


def _read(recording: Log) -> ScanLog:
    """Read a log; it is called as the service calls the recording."""
    from spheremark.storage.recordings import read_log

    log = read_log(recording.url, digest=recording.recording_id)
    return replace(log, origin=Origin(name=recording.name, digest=recording.recording_id))
