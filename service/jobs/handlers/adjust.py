"""Jobs of the kind ``adjust``: all stations and marks of a survey together.

Centres of an earlier run with the same configuration, rig and code are taken from its rows; other
logs are processed, with the rows that a job of the kind ``process`` gives.
"""

from __future__ import annotations

import json
import secrets
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import TYPE_CHECKING, Any

from pydantic import Field

from spheremark.pipelines.errors import RigError, SolveError, SpheremarkError
from spheremark.pipelines.progress import Progress, part_of
from spheremark.pipelines.scan.rigs import rig_digest
from spheremark.service.jobs.handlers.calibrate import calibration_results, logs_of
from spheremark.service.jobs.handlers.process import process_log
from spheremark.service.jobs.specification import JobResult, JobSpecification, Log, Options
from spheremark.service.provenance import code_version
from spheremark.storage.catalogue.centres import CENTRES

if TYPE_CHECKING:
    import pyarrow as pa

    from spheremark.pipelines.calibration import Calibration
    from spheremark.pipelines.model import MarkerFits
    from spheremark.pipelines.network import AdjustedNetwork, Refusal
    from spheremark.storage.catalogue.catalogue import Catalogue

Row = dict[str, Any]

_SCANS = 0.9  # share of the time that the scans take
_RUNS = """
SELECT r.run_id, r.recording_id, r.rig_digest, r.config, r.code_version
FROM runs AS r JOIN jobs AS j USING (job_id)
WHERE r.survey_id = $survey AND list_contains($recordings::VARCHAR[], r.recording_id)
    AND (json_extract_string(j.options, '$.rig') IS NOT DISTINCT FROM $rig::VARCHAR)
ORDER BY r.finished_at DESC
"""
_ROWS = "SELECT * FROM {} WHERE list_contains($runs::VARCHAR[], run_id) ORDER BY run_id, stop"


class AdjustOptions(Options):
    """Options of an adjustment."""

    control: bool = Field(
        default=True, description="Use the survey's control marks, if it has any; else free."
    )
    calibrate: bool = Field(
        default=False, description="Estimate the rig in the same adjustment; reads all logs anew."
    )
    reprocess: bool = Field(
        default=False, description="Fit all centres anew, even those that were fitted before."
    )


def gather(catalogue: Catalogue, spec: JobSpecification) -> Mapping[str, pa.Table]:
    """Return the runs with the centres that this job would fit, newest first, and their rows.

    The worker chooses among them those of its own version of the code.
    """
    parameters = {
        "survey": spec.survey_id,
        "recordings": [log.recording_id for log in spec.logs],
        "rig": None if spec.rig is None else rig_digest(spec.rig),
    }
    runs = catalogue.table(_RUNS, parameters)
    if spec.options.get("reprocess"):
        runs = runs.slice(0, 0)
    keep = [row["run_id"] for row in runs.to_pylist() if _is_alike(row, spec)]
    tables = {name: catalogue.table(_ROWS.format(name), {"runs": keep}) for name in CENTRES}
    return {"runs": runs, **tables}


def _is_alike(run: Row, spec: JobSpecification) -> bool:
    """Whether a run fitted centres with the method and configuration of this job."""
    done, own = json.loads(run["config"]), spec.config.to_mapping()
    method = own["fitting"]["methods"][0]
    return method in done["fitting"]["methods"] and _fit_options(done) == _fit_options(own)


def _fit_options(config: Mapping[str, Any]) -> str:
    """Return all options that centres depend on, but for the names of methods."""
    fitting = {key: value for key, value in config["fitting"].items() if key != "methods"}
    parts = {key: config[key] for key in ("marker_radius", "stitching", "extraction")}
    return json.dumps(parts | {"fitting": fitting}, sort_keys=True)


@dataclass(slots=True)
class _Book:
    """Stations so far: centres, their runs, refused logs, and the tables of new runs."""

    scans: list[tuple[str, MarkerFits]] = field(default_factory=list)
    sources: dict[str, Row] = field(default_factory=dict)
    refused: list[Refusal] = field(default_factory=list)
    tables: list[dict[str, pa.Table]] = field(default_factory=list)

    def add(self, name: str, stop: str, fits: MarkerFits, source: Row) -> None:
        """Add a station under a unique name."""
        self.scans.append((name, fits))
        self.sources[name] = {"station": name, "stop": stop, **source}


def handle(spec: JobSpecification, progress: Progress) -> JobResult:
    """Adjust the stations of all logs of a job."""
    from spheremark.service.jobs.handlers.network_rows import network_rows
    from spheremark.service.log_files import Fieldbook, adjust_scans, adjusted_rig
    from spheremark.service.serialise.network import serialise_network
    from spheremark.storage.catalogue.adjustments import TABLES
    from spheremark.storage.catalogue.products import documents
    from spheremark.storage.catalogue.schema import tables_of

    start = perf_counter()
    with_rig = bool(spec.options.get("calibrate"))
    book = _read(spec, part_of(progress, 0.0, 0.5 * _SCANS if with_rig else _SCANS))
    rig, why = None, ""
    if with_rig:
        rig, why = _rig(spec, book, part_of(progress, 0.5 * _SCANS, 0.8))
    progress(_SCANS, f"Adjusting {len(book.scans)} stations")
    marks = spec.marks if spec.options.get("control", True) else None
    scans = Fieldbook(scans=tuple(book.scans), refused=tuple(book.refused), calibration=rig)
    result = adjust_scans(scans, marks, spec.config)
    found = adjusted_rig(result, scans)
    plain = serialise_network(result, spec.config, rig=found, uncalibrated=why)
    rows = network_rows(plain, book.sources)
    rows["adjustments"][0] |= spec.columns(start)
    made = [*book.tables, tables_of(TABLES, rows, adjustment_id=spec.result_id)]
    files, message = _files(result, plain), _summary(plain, rows["control_checks"])
    if found is not None:
        left = part_of(progress, _SCANS, 1.0)
        tables, more, sentence = calibration_results(spec, found, left, start)
        made, files, message = [*made, tables], files | more, f"{message} {sentence}"
    made.append({"documents": documents(spec.result_id, files)})
    return JobResult(tables=_joined(made), message=message)


def _rig(spec: JobSpecification, book: _Book, progress: Progress) -> tuple[Calibration | None, str]:
    """Calibrate the rig of the logs with stations; return the reason where they cannot."""
    from spheremark.pipelines.calibration import calibrate

    used = {source["recording_id"] for source in book.sources.values()}
    named = zip(spec.logs, spec.log_names, strict=True)
    good = tuple(replace(log, name=name) for log, name in named if log.recording_id in used)
    logs = logs_of(replace(spec, logs=good))
    try:
        return calibrate(logs, config=spec.config, rig=spec.rig, progress=progress), ""
    except (SolveError, RigError) as error:
        return None, str(error)


def _joined(parts: list[dict[str, pa.Table]]) -> dict[str, pa.Table]:
    """Return the rows of several results as one table each."""
    import pyarrow as pa

    names = dict.fromkeys(name for part in parts for name in part)
    return {
        name: pa.concat_tables([part[name] for part in parts if name in part]) for name in names
    }


def _read(spec: JobSpecification, progress: Progress) -> _Book:
    """Return the centres of each log; refuse logs that fail, and raise if all do."""
    from spheremark.pipelines.network import Refusal

    book, first = _Book(), None
    for i, (log, name) in enumerate(zip(spec.logs, spec.log_names, strict=True)):
        try:
            part = part_of(progress, i / len(spec.logs), (i + 1) / len(spec.logs))
            for stop, fits, source in _centres(spec, log, book, part):
                book.add(name + stop.removeprefix(log.name), stop, fits, source)
        except SpheremarkError as error:
            first = first or error
            book.refused.append(Refusal(station=name, code=error.code, reason=str(error)))
    if not book.scans and first is not None:
        raise first
    return book


def _centres(
    spec: JobSpecification, log: Log, book: _Book, progress: Progress
) -> Iterator[tuple[str, MarkerFits, Row]]:
    """Yield the stops of a log with their centres: those of an earlier run, or new ones."""
    from spheremark.storage.catalogue.centres import read_centres

    method = spec.config.fitting.methods[0]
    known = set(spec.known["stops"].column("run_id").to_pylist())
    own = (log.recording_id, code_version())
    run = next(
        (
            row
            for row in spec.known["runs"].to_pylist()
            if row["run_id"] in known and (row["recording_id"], row["code_version"]) == own
        ),
        None,
    )
    if run is not None:
        progress(0.0, f"Taking the centres of {log.name} from an earlier run")
        source = {key: run[key] for key in ("run_id", "recording_id", "rig_digest")}
        tables = {name: spec.known[name] for name in CENTRES}
        for stop, found in read_centres(tables, run["run_id"], method):
            yield stop, _with_sample(found, tables["stops"], run["run_id"], stop), source
        return
    run_id = secrets.token_hex(8)
    done, tables = process_log(spec, log, run_id, progress)
    book.tables.append(tables)
    for one in done:
        digest = rig_digest(one.cloud.rig)
        source = {"run_id": run_id, "recording_id": log.recording_id, "rig_digest": digest}
        yield one.name, _with_sample(one.fits[method], tables["stops"], run_id, one.name), source


def _with_sample(fits: MarkerFits, stops: pa.Table, run_id: str, stop: str) -> MarkerFits:
    """Return centres with the returns of the kept cloud of their stop, if there is one."""
    from spheremark.pipelines.geometry import levelling_rotation
    from spheremark.storage.clouds.stop import read_sample

    (url,) = (
        row["cloud_url"]
        for row in stops.select(["run_id", "stop", "cloud_url"]).to_pylist()
        if (row["run_id"], row["stop"]) == (run_id, stop)
    )
    R_station_base = levelling_rotation(fits.levelling).astype("float32")
    return replace(fits, sample_base=read_sample(url) @ R_station_base)


def _files(result: AdjustedNetwork, plain: Row) -> dict[str, str]:
    """Return the files of a network by name."""
    from spheremark.service.serialise.network_report import report
    from spheremark.storage.exports.network import (
        format_coordinates,
        format_evidence,
        format_gama,
        network_points,
    )
    from spheremark.storage.exports.points import format_points

    points = network_points(result)
    return {
        "adjustment.json": json.dumps(plain),
        "report.txt": report(plain),
        "coordinates.csv": format_coordinates(result),
        "evidence.csv": format_evidence(result),
        "coordinates.dxf": format_points(points, ".dxf"),
        "coordinates.xml": format_points(points, ".xml"),
        "gama.xml": format_gama(result),
    }


def _summary(plain: Row, checks: list[Row]) -> str:
    """Return the results of an adjustment in sentences, and what is missing or weak."""
    kind = "with control" if plain["datum"]["kind"] == "control" else "as a free network"
    sigmas = [one["sigma_3d_m"] for one in plain["stations"]]
    n = len(sigmas)
    test = "passed" if plain["passes_global_test"] else "FAILED"
    parts = [
        f"{n} station{'' if n == 1 else 's'} and {len(plain['marks'])} marks adjusted {kind}: "
        f"stations with sigmas to {1000 * max(sigmas):.1f} mm (3-D), global test {test}."
    ]
    if checks:
        worst = max(checks, key=lambda row: float(row["difference_3d_m"]))
        parts.append(
            f"Left out in turn, control marks are met to {1000 * worst['difference_3d_m']:.1f} mm."
        )
    if dropped := [one["mark"] for one in plain["excluded"] if one["kind"] == "control"]:
        parts.append(f"Control that contradicts the rest was left out: {', '.join(dropped)}.")
    if plain["refused"]:
        parts.append("Without " + ", ".join(one["station"] for one in plain["refused"]) + ".")
    return " ".join([*parts, *plain["warnings"]])
