"""The report of a survey, to be printed and signed: what it holds, and what it lacks.

Made from the adjusted network if there is one, else from the stations one by one.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np

from spheremark.pipelines.accuracy.acceptance import (
    Decision,
    SolutionQuality,
    check_control,
    decide,
    rule,
)
from spheremark.pipelines.errors import InputError, NotFoundError
from spheremark.pipelines.tables import Column, Table
from spheremark.service.provenance import code_version
from spheremark.service.serialise import network_report
from spheremark.service.serialise.solution import survey_result
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.catalogue.solutions import Solution

Plain = dict[str, Any]
Pairs = list[list[str]]

_ROWS_MOST = 1000  # observations of a report; the interface has all
_ADJUSTMENT = """
SELECT a.*, d.text AS document FROM adjustments AS a
JOIN documents AS d ON d.result_id = a.adjustment_id AND d.name = 'adjustment.json'
WHERE a.survey_id = $survey AND ($id::VARCHAR IS NULL OR a.adjustment_id = $id)
ORDER BY a.finished_at DESC LIMIT 1
"""
_CONTROL = """
SELECT mark, x_m, y_m, z_m, sigma_x_m, sigma_y_m, sigma_z_m FROM control_marks
WHERE survey_id = $survey ORDER BY place
"""
_LOGS = """
SELECT name, recording_id, size_bytes, uploaded_at, verdict FROM recordings
WHERE list_contains($ids::VARCHAR[], recording_id) ORDER BY name, recording_id
"""
_RUNS = """
SELECT DISTINCT code_version, config_digest, rig_digest FROM latest_runs WHERE survey_id = $survey
ORDER BY ALL
"""
_METHOD = """
SELECT fit_method FROM latest_station_fixes WHERE survey_id = $survey
ORDER BY fit_method <> 'along_beam', fit_method LIMIT 1
"""
_STATIONS = """
SELECT stop AS name, status, reason, n_markers, x_m, y_m, z_m, sqrt(cov_xx_m2) AS sigma_x_m,
    sqrt(cov_yy_m2) AS sigma_y_m, sqrt(cov_zz_m2) AS sigma_z_m, sigma_3d_m, ellipse_major_95_m,
    ellipse_minor_95_m, ellipse_bearing_deg, included_angle_min_deg, included_angle_max_deg
FROM latest_station_fixes WHERE survey_id = $survey AND fit_method = $method
    AND resection_method = 'free_station' ORDER BY stop
"""
_OBSERVED = """
SELECT o.stop, o.marker, o.mark, o.residual_x_m, o.residual_y_m, o.residual_z_m, o.redundancy, o.w,
    o.minimal_detectable_bias_m, o.external_reliability_m, o.used
FROM observations AS o JOIN latest_runs AS r USING (run_id)
WHERE r.survey_id = $survey AND o.fit_method = $method AND o.resection_method = 'free_station'
ORDER BY o.w DESC NULLS LAST
"""
_XYZ = tuple(Column(f"{axis}_m", axis.upper(), "m", "12.4f") for axis in "xyz")
_SIGMAS = tuple(Column(f"sigma_{axis}_m", f"s{axis.upper()}", "mm", ".2f") for axis in "xyz")
_GIVEN = (Column("mark", "Mark"), *_XYZ, *_SIGMAS)
_ALONE = (
    Column("name", "Station"),
    *_XYZ,
    *_SIGMAS,
    Column("ellipse_major_95_m", "a95", "mm", ".2f"),
    Column("ellipse_minor_95_m", "b95", "mm", ".2f"),
    Column("ellipse_bearing_deg", "bearing", "deg", ".0f"),
    Column("n_markers", "seen", "", "d"),
    Column("status", ""),
)
_SEEN = (
    Column("stop", "Station"),
    Column("marker", "Marker"),
    Column("mark", "Mark"),
    *(Column.mm(f"residual_{axis}_m", f"v{axis.upper()}") for axis in "xyz"),
    Column("redundancy", "r", "", ".2f"),
    Column("w", "w", "", ".2f"),
    Column.mm("minimal_detectable_bias_m", "MDB"),
    Column.mm("external_reliability_m", "EX"),
    Column(lambda row: "" if row["used"] else "left out", ""),
)
_LOG = (
    Column("name", "Log"),
    Column("size_bytes", "Size", "MB", ".1f"),
    Column(lambda row: f"{row['uploaded_at']:%Y-%m-%d %H:%M}", "Uploaded (UTC)"),
    Column("verdict", "Preflight"),
    Column("recording_id", "SHA-256"),
)
_FOR_SIGNATURE = ("Surveyed by", "Computed by", "Checked by")


def survey_report(catalogue: Catalogue, survey: str, adjustment: str | None = None) -> Plain:
    """Return the report of a survey as plain values."""
    found = catalogue.get_survey(survey)
    key = {"survey": found.survey_id}
    result = survey_result(catalogue, found.survey_id)
    chosen = result.solution and result.solution.adjustment_id
    decision, networks = result.decision, []
    if adjustment or chosen or result.solution is None:
        networks = catalogue.rows(_ADJUSTMENT, key | {"id": adjustment or chosen})
    if adjustment is not None and not networks:
        raise NotFoundError(f"The survey {found.name} has no adjustment {adjustment!r}.")
    about = [
        ["Survey", found.name],
        ["Begun", f"{found.created_at.astimezone(UTC):%Y-%m-%d}"],
        ["Tolerance of a station (3-D)", f"{1e3 * found.tolerance:g} mm"],
    ]
    given = catalogue.rows(_CONTROL, key)
    logs = catalogue.rows(_LOGS, {"ids": list(catalogue.recordings_of_survey(found.survey_id))})
    if networks:
        row = networks[0]
        network = json.loads(row["document"])
        report = network_part(network)
        if row["adjustment_id"] != chosen:
            decision = _network_decision(network, found.tolerance)
        when = f"{row['finished_at'].astimezone(UTC):%Y-%m-%d %H:%M:%S} UTC"
        report["digests"] = [*_digests([row]), ["Adjustment", f"{row['adjustment_id']}, {when}"]]
    else:
        report = _stations_part(catalogue, found.survey_id, result.solution)
        report["digests"] = _digests(catalogue.rows(_RUNS, key))
    control = Table(title="Control marks as given", columns=_GIVEN, rows=given)
    report["sections"] = [control.to_texts(), *report["sections"]] if given else report["sections"]
    if not given:
        report["missing"].append(
            "No control marks: coordinates are in a frame of the survey, not in that of a site."
        )
    table = Table(title="Logs", columns=_LOG, rows=logs, notes=[] if logs else ["None."])
    report["sections"].append(table.to_texts())
    return _complete(report | _decided(decision, found.tolerance), about)


def report_of_document(text: str, name: str) -> Plain:
    """Return the report of a file that ``spheremark adjust --json`` wrote."""
    try:
        network = json.loads(text)
        tolerance = float(network["config"]["tolerance"])
        report = network_part(network) | _decided(_network_decision(network, tolerance), tolerance)
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{name} is not the JSON of a network ({type(error).__name__}: {error}); "
            "write one with `spheremark adjust ... --json`, or name a survey."
        ) from error
    report["digests"] = [["Configuration", str(network["config"].get("digest", "-"))]]
    report["missing"].append("Names and digests of the logs: the file does not hold them.")
    return _complete(report, [["File", name]])


def network_part(network: Mapping[str, Any]) -> Plain:
    """Return what a report shows of a network."""
    is_checked = any(one["predicted_minus_given_m"] is not None for one in network["control"])
    missing = [] if is_checked else ["No independent check: no control mark could be left out."]
    return {
        "title": "Network adjustment report",
        "tests": network_report.summary(network),
        "warnings": list(network["warnings"]),
        "missing": missing,
        "places": _places(network),
        "lines": [[one["station"], one["mark"]] for one in network["observations"] if one["used"]],
        "sections": [_shortened(one.to_texts()) for one in network_report.tables(network)],
    }


def _decided(decision: Decision, tolerance: float) -> Plain:
    """Return the decision of a report with its reasons and the rule."""
    return {
        "is_accepted": decision.status == "accepted",
        "grade": f"{decision.grade.capitalize()}.",
        "decision": f"{decision.summary}. {' '.join(decision.reasons)}".strip(),
        "rule": rule(tolerance),
    }


def _network_decision(network: Mapping[str, Any], tolerance: float) -> Decision:
    """Return the decision on a network, from its JSON."""
    names = [one["name"] for one in network["stations"]]
    checks = [one for one in network["control"] if one["predicted_minus_given_m"] is not None]
    off, sigmas = (
        np.array([one[key] for one in checks])
        for key in ("predicted_minus_given_m", "sigma_predicted_minus_given_m")
    )
    quality = SolutionQuality(
        stations=names,
        covariances=np.array([one["position_covariance_m2"] for one in network["stations"]]),
        failed=[] if network["passes_global_test"] else names,
        missing=[one["station"] for one in network["refused"]],
        control=check_control([one["mark"] for one in checks], off, sigmas) if checks else None,
        warnings=network["warnings"],
        is_free=network["datum"]["kind"] == "free",
    )
    return decide(quality, tolerance)


def _stations_part(catalogue: Catalogue, survey_id: str, solution: Solution | None) -> Plain:
    """Return what a report shows of stations that were positioned one by one."""
    methods = [] if solution else catalogue.rows(_METHOD, {"survey": survey_id})
    method = solution.fit_method if solution else methods[0]["fit_method"] if methods else ""
    key = {"survey": survey_id, "method": method}
    rows = catalogue.rows(_STATIONS, key)
    known = [row for row in rows if row["x_m"] is not None]
    weak = [row for row in rows if row["status"] != "ok"]
    missing = "No stations: no log of this survey has been processed with control marks."
    if rows:
        missing = (
            "No network: each station was positioned alone, and no observation checks two stations "
            "together. Start an adjustment and report again."
        )
    observed = catalogue.rows(_OBSERVED, key)
    tables = [
        Table(
            title="Stations, positioned alone",
            columns=_ALONE,
            rows=rows,
            notes=[f"{row['name']}: {row['reason']}" for row in weak if row["reason"]],
        ),
        Table(title="Observed centres, largest w first", columns=_SEEN, rows=observed),
    ]
    return {
        "title": "Station report",
        "tests": [],
        "warnings": [],
        "missing": [missing],
        "places": [_alone(row) for row in known] + _marks_alone(catalogue, survey_id),
        "lines": [[row["stop"], row["mark"]] for row in observed if row["used"]],
        "sections": [_shortened(one.to_texts()) for one in tables if one.rows],
    }


def _places(network: Mapping[str, Any]) -> list[Plain]:
    """Return stations and marks as the map shows them."""
    kinds = [("station", one) for one in network["stations"]]
    kinds += [("control" if one["is_control"] else "mark", one) for one in network["marks"]]
    return [
        {
            "name": one["name"],
            "kind": kind,
            "x_m": one["position_m"][0],
            "y_m": one["position_m"][1],
            "major_m": one["ellipse_major_95_m"],
            "minor_m": one["ellipse_minor_95_m"],
            "bearing_deg": one["ellipse_bearing_deg"],
        }
        for kind, one in kinds
    ]


def _alone(row: Mapping[str, Any]) -> Plain:
    """Return a station as the map shows it."""
    ellipse = ("ellipse_major_95_m", "ellipse_minor_95_m", "ellipse_bearing_deg")
    values = dict(
        zip(("major_m", "minor_m", "bearing_deg"), (row[key] for key in ellipse), strict=True)
    )
    return {"name": row["name"], "kind": "station", "x_m": row["x_m"], "y_m": row["y_m"], **values}


def _marks_alone(catalogue: Catalogue, survey_id: str) -> list[Plain]:
    """Return the control marks as the map shows them."""
    blank = {"major_m": None, "minor_m": None, "bearing_deg": None}
    return [
        {"name": row["mark"], "kind": "control", "x_m": row["x_m"], "y_m": row["y_m"], **blank}
        for row in catalogue.rows(_CONTROL, {"survey": survey_id})
    ]


def _digests(rows: Sequence[Mapping[str, Any]]) -> Pairs:
    """Return what results were made with, as pairs of name and value."""
    names = {"code_version": "Code", "config_digest": "Configuration", "rig_digest": "Rig"}
    return [
        [name, ", ".join(sorted({str(row[key] or "several") for row in rows})) or "-"]
        for key, name in names.items()
    ]


def _shortened(table: Plain) -> Plain:
    """Return a table with the rows that a report prints, and a note where it has more."""
    n = len(table["rows"])
    if n <= _ROWS_MOST:
        return table
    note = f"The first {_ROWS_MOST:,} of {n:,} rows; the files of the adjustment have all."
    return table | {"rows": table["rows"][:_ROWS_MOST], "notes": [note, *table["notes"]]}


def _complete(report: Plain, about: Pairs) -> Plain:
    """Return a report with its project, its origin and the places of signatures."""
    written = f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC"
    origin = [["Report written", written], ["Software", f"spheremark {code_version()}"]]
    return report | {
        "about": about,
        "digests": origin + report["digests"],
        "signatures": list(_FOR_SIGNATURE),
        "written": written,
    }
