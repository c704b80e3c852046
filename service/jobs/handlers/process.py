"""Jobs of the kind ``process``: one log through the chain, into tables and a stored cloud."""

from __future__ import annotations

from datetime import UTC, datetime
from time import perf_counter
from typing import TYPE_CHECKING

from spheremark.pipelines.errors import NoMarkersError
from spheremark.pipelines.model import StopResult
from spheremark.pipelines.progress import Progress, part_of
from spheremark.service.jobs.specification import JobResult, JobSpecification, Log
from spheremark.service.provenance import code_version, forget_peak_memory, peak_memory

if TYPE_CHECKING:
    import pyarrow as pa


def handle(spec: JobSpecification, progress: Progress) -> JobResult:
    """Process the one log of a job."""
    from spheremark.pipelines.stop_decisions import decide

    stops, rows = process_log(spec, spec.logs[0], spec.result_id, progress)
    decisions = (decide(stop, spec.config, spec.marks) for stop in stops)
    return JobResult(tables=rows, message=" ".join(one.text for one in decisions))


def process_log(
    spec: JobSpecification, recording: Log, run_id: str, progress: Progress
) -> tuple[tuple[StopResult, ...], dict[str, pa.Table]]:
    """Read a log, run the chain, store the clouds, make the tables of a run."""
    from spheremark.pipelines.survey import process
    from spheremark.service.log_files import explained
    from spheremark.storage.catalogue.results import RunInfo, tables
    from spheremark.storage.clouds.stop import write_cloud
    from spheremark.storage.exports.result_log import write_result_log

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
        raise explained(error, recording.read_with, recording.options, spec.rig) from error
    progress(0.9, "Storing the results")
    clouds = {stop.name: write_cloud(stop, spec.clouds_url) for stop in stops}
    write_result_log(stops, spec.clouds_url, run_id)
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
