"""Marks and truth of a survey as rows, and rows as marks and truth."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa

from spheremark.pipelines.errors import ControlError
from spheremark.pipelines.geometry import rigid, rot_x, rot_y, rot_z, yaw_pitch_roll
from spheremark.pipelines.model import Array, ControlMarks, StopTruth, Truth
from spheremark.pipelines.scan.rigs import rig_from_mapping, rig_to_mapping
from spheremark.storage.catalogue.database import fetch
from spheremark.storage.catalogue.records import json_text
from spheremark.storage.catalogue.rows import PLACE, named, places
from spheremark.storage.catalogue.schema import SCHEMAS, table_of

_SIGMAS = tuple(f"sigma_{name}" for name in PLACE)
_TRUE_MARKS = "SELECT * FROM true_marks WHERE survey_id = $id ORDER BY place"
_TRUE_STOPS = "SELECT * FROM true_stops WHERE survey_id = $id ORDER BY stop"
_TRUE_WORLD = "SELECT rig, about FROM true_worlds WHERE survey_id = $id"


def check_marks(marks: ControlMarks) -> None:
    """Refuse marks that a table cannot hold or a survey cannot use."""
    if len(set(marks.names)) < len(marks.names) or not all(marks.names):
        raise ControlError("Marks must have names, all different.")
    if not np.isfinite(marks.p_site).all():
        raise ControlError("Marks must have finite coordinates [m].")
    variances = np.diagonal(marks.cov_p_site, axis1=1, axis2=2)
    if not (variances >= 0.0).all() or not np.isfinite(variances).all():
        raise ControlError("Marks must have standard deviations that are finite and not negative.")
    if (marks.cov_p_site != np.eye(3) * variances[:, None, :]).any():
        raise ControlError("Marks must have independent coordinates: correlations are not kept.")


def marks_table(survey_id: str, marks: ControlMarks) -> pa.Table:
    """Return marks as rows, in their order."""
    x, y, z = marks.p_site.T
    n = len(marks.names)
    columns = {"survey_id": [survey_id] * n, "mark": list(marks.names), "place": range(n)}
    return pa.table(columns | {"x_m": x, "y_m": y, "z_m": z})


def control_table(survey_id: str, marks: ControlMarks) -> pa.Table:
    """Return control marks as rows, in their order."""
    table = marks_table(survey_id, marks)
    sigmas = np.sqrt(np.diagonal(marks.cov_p_site, axis1=1, axis2=2))
    for axis, name in enumerate(_SIGMAS):
        table = table.append_column(name, pa.array(sigmas[:, axis]))
    return table


def control_marks_of(rows: list[dict[str, Any]]) -> ControlMarks:
    """Return the control marks of rows."""
    sigmas = np.array([[row[name] for name in _SIGMAS] for row in rows])
    return _marks_of(rows, np.eye(3) * np.square(sigmas)[:, None, :])


def true_stops_table(survey_id: str, stops: tuple[StopTruth, ...]) -> pa.Table:
    """Return true poses as rows."""
    rows = []
    for stop in stops:
        angles = np.degrees(yaw_pitch_roll(stop.T_site_base[:3, :3]))
        values = (survey_id, stop.name, *stop.T_site_base[:3, 3], *angles)
        rows.append(named(SCHEMAS["true_stops"].names, values))
    return table_of("true_stops", rows)


def rig_text(truth: Truth) -> str | None:
    """Return the true rig as JSON, when known."""
    return None if truth.rig is None else json_text(rig_to_mapping(truth.rig))


def read_truth(cursor: duckdb.DuckDBPyConnection, survey_id: str) -> Truth | None:
    """Read the truth of a survey."""
    worlds = cursor.execute(_TRUE_WORLD, {"id": survey_id}).fetchall()
    if not worlds:
        return None
    rig, about = worlds[0]
    marks = fetch(cursor, _TRUE_MARKS, {"id": survey_id}).to_pylist()
    stops = fetch(cursor, _TRUE_STOPS, {"id": survey_id}).to_pylist()
    return Truth(
        marks=_marks_of(marks, np.zeros((len(marks), 3, 3))),
        stops=tuple(StopTruth(name=row["stop"], T_site_base=_pose(row)) for row in stops),
        rig=None if rig is None else rig_from_mapping(json.loads(rig)),
        about=json.loads(about),
    )


def _pose(row: Mapping[str, Any]) -> Array:
    """Return the pose of a row of ``true_stops``."""
    yaw, pitch, roll = (np.radians(row[f"{name}_deg"]) for name in ("yaw", "pitch", "roll"))
    return rigid(rot_z(yaw) @ rot_y(pitch) @ rot_x(roll), [row["x_m"], row["y_m"], row["z_m"]])


def _marks_of(rows: list[dict[str, Any]], cov_p_site: Array) -> ControlMarks:
    """Return the marks of rows with their covariances."""
    return ControlMarks(
        names=tuple(row["mark"] for row in rows),
        p_site=places(rows),
        cov_p_site=cov_p_site,
    )
