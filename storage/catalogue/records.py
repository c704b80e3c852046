"""Rows of the catalogue as values: what the typed verbs of ``catalogue`` take and give."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from typing import Any, Generic, TypeVar

import numpy as np
import pyarrow as pa

from spheremark.pipelines.errors import ControlError, InputError
from spheremark.pipelines.geometry import rigid, rot_x, rot_y, rot_z, yaw_pitch_roll
from spheremark.pipelines.model import Array, ControlMarks, StopTruth, Truth
from spheremark.pipelines.scan.rigs import rig_to_mapping

_Record = TypeVar("_Record")

_UNITS = {
    "m2": "m²",
    "m": "m",
    "deg": "°",
    "s": "s",
    "bytes": "bytes",
    "percent": "%",
    "at": "UTC",
}
"""What people read for the ending of a column's name."""


class JobStatus(StrEnum):
    """Where a job stands; the words are those of OGC API - Processes."""

    ACCEPTED = "accepted"
    RUNNING = "running"
    SUCCESSFUL = "successful"
    FAILED = "failed"
    DISMISSED = "dismissed"

    @property
    def is_final(self) -> bool:
        """Whether a job that stands here never changes again."""
        return self not in (JobStatus.ACCEPTED, JobStatus.RUNNING)


@dataclass(frozen=True, slots=True, kw_only=True)
class Page(Generic[_Record]):
    """A part of a list.

    Attributes
    ----------
    items : tuple
        The records, newest first.
    next : str or None
        What to pass as ``after`` to get the part that follows; none at the end.
    """

    items: tuple[_Record, ...]
    next: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyRecord:
    """A field with its marks and logs.

    Attributes
    ----------
    survey_id : str
        Given by the catalogue, never reused.
    name : str
        Given by people, unique.
    tolerance : float
        Error that the survey accepts [m].
    created_at : datetime
        When it was made, in UTC.
    rig_digest : str or None
        Rig that its jobs use where they name none; none: the one that each log describes.
    n_control_marks : int
        Number of its control marks.
    n_true_stops : int
        Number of its stops whose truth is known.
    n_recordings : int
        Number of different logs that jobs of this survey have asked for.
    """

    survey_id: str
    name: str
    tolerance: float
    created_at: datetime
    rig_digest: str | None
    n_control_marks: int
    n_true_stops: int
    n_recordings: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingRecord:
    """An uploaded log.

    Attributes
    ----------
    recording_id : str
        SHA-256 of its bytes, in hexadecimal.
    name : str
        Stem of the name that it was uploaded under.
    size_bytes : int
        Length of the file.
    uploaded_at : datetime
        When it came, in UTC.
    url : str
        Where its bytes are.
    verdict : str
        Outcome of the preflight: ``ok``, ``weak`` or ``refused``.
    preflight : mapping
        The whole report.
    """

    recording_id: str
    name: str
    size_bytes: int
    uploaded_at: datetime
    url: str
    verdict: str
    preflight: Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class JobRecord:
    """Work that was asked for.

    Attributes
    ----------
    job_id : str
        Given by the catalogue.
    kind : str
        What is done, for instance ``process``.
    survey_id, survey : str
        The survey that it belongs to: id and name.
    recording_id, recording : str or None
        The log that it reads: digest and name; none for work on the survey as a whole.
    config : mapping
        The effective configuration.
    options : mapping
        What was chosen beside it: ``rig`` (a digest), ``recordings``, and what its kind knows.
    status : JobStatus
        Where it stands.
    progress_percent : float
        0 to 100.
    message : str
        What is being done, as a sentence for people.
    attempts : int
        How often it was started.
    created_at : datetime
        When it was asked for, in UTC.
    started_at, finished_at : datetime or None
        When its last attempt began, and when it came to its end.
    error_code, error_reason, error_traceback : str or None
        Why it failed: stable code, sentence, and where in the code.
    """

    job_id: str
    kind: str
    survey_id: str
    survey: str
    recording_id: str | None
    recording: str | None
    config: Mapping[str, Any]
    options: Mapping[str, Any]
    status: JobStatus
    progress_percent: float
    message: str
    attempts: int
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    error_code: str | None
    error_reason: str | None
    error_traceback: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class RunRecord:
    """A recording processed with one configuration by one version of the code.

    Attributes
    ----------
    run_id : str
        Names the rows of this run in every table.
    job_id, survey_id, recording_id : str
        Where it belongs.
    config : mapping
        The effective configuration.
    config_digest, code_version, rig_digest : str
        What the numbers depend on.
    finished_at : datetime
        When, in UTC.
    duration : float
        Time that the run took [s].
    peak_memory_bytes : int or None
        Largest resident size of the worker's process.
    """

    run_id: str
    job_id: str
    survey_id: str
    recording_id: str
    config: Mapping[str, Any]
    config_digest: str
    code_version: str
    rig_digest: str
    finished_at: datetime
    duration: float
    peak_memory_bytes: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class ColumnInfo:
    """A column of a table or view.

    Attributes
    ----------
    name : str
        Its name, which carries the unit.
    type : str
        DuckDB's name of its type.
    unit : str
        Unit for people, from the name; empty for numbers without one and for text.
    comment : str
        What it is; empty where the name says it.
    """

    name: str
    type: str
    unit: str
    comment: str


@dataclass(frozen=True, slots=True, kw_only=True)
class TableInfo:
    """A table or view that people may query.

    Attributes
    ----------
    name : str
        Its name.
    kind : str
        ``table`` or ``view``.
    comment : str
        What its rows are.
    columns : tuple of ColumnInfo
        Its columns, in their order.
    """

    name: str
    kind: str
    comment: str
    columns: tuple[ColumnInfo, ...]


def unit_of(column: str) -> str:
    """Return the unit that the name of a column carries, for people; empty when it carries none.

    Parameters
    ----------
    column : str
        Name of a column.

    Returns
    -------
    str
        The unit as it is printed.
    """
    ending = next((end for end in _UNITS if column.endswith(f"_{end}")), None)
    return "" if ending is None else _UNITS[ending]


def tables_of(rows: list[dict[str, Any]]) -> tuple[TableInfo, ...]:
    """Build the description of tables and views from the rows of their columns."""
    columns: dict[str, list[ColumnInfo]] = {}
    about = {row["table_name"]: row for row in rows}
    comments = {(row["table_name"], row["column_name"]): row["comment"] for row in rows}
    for row in rows:
        name, column = row["table_name"], row["column_name"]
        inherited = comments.get((name.removeprefix("latest_"), column))
        info = ColumnInfo(
            name=column,
            type=row["data_type"],
            unit=unit_of(column),
            comment=row["comment"] or inherited or "",
        )
        columns.setdefault(name, []).append(info)
    return tuple(
        TableInfo(
            name=name,
            kind=about[name]["kind"],
            comment=about[name]["table_comment"] or "",
            columns=tuple(found),
        )
        for name, found in columns.items()
    )


def survey_of(row: dict[str, Any]) -> SurveyRecord:
    """Build a record from a row."""
    return SurveyRecord(tolerance=row.pop("tolerance_m"), **row)


def recording_of(row: dict[str, Any]) -> RecordingRecord:
    """Build a record from a row."""
    return RecordingRecord(**{**row, "preflight": json.loads(row["preflight"])})


def job_of(row: dict[str, Any]) -> JobRecord:
    """Build a record from a row."""
    texts = {name: json.loads(row[name] or "{}") for name in ("config", "options")}
    return JobRecord(**{**row, **texts, "status": JobStatus(row["status"])})


def run_of(row: dict[str, Any]) -> RunRecord:
    """Build a record from a row."""
    return RunRecord(duration=row.pop("duration_s"), **{**row, "config": json.loads(row["config"])})


def pose_of(row: Mapping[str, Any]) -> Array:
    """Return the pose that a row of ``true_stops`` tells."""
    yaw, pitch, roll = (np.radians(row[f"{name}_deg"]) for name in ("yaw", "pitch", "roll"))
    return rigid(rot_z(yaw) @ rot_y(pitch) @ rot_x(roll), [row["x_m"], row["y_m"], row["z_m"]])


def coordinates_of(rows: list[dict[str, Any]]) -> Array:
    """Return the coordinates of rows, (n, 3) [m]."""
    return np.array([[row["x_m"], row["y_m"], row["z_m"]] for row in rows]).reshape(-1, 3)


def marks_table(survey_id: str, marks: ControlMarks) -> pa.Table:
    """Return marks as rows, in their order."""
    x, y, z = marks.p_site.T
    n = len(marks.names)
    columns = {"survey_id": [survey_id] * n, "mark": list(marks.names), "place": range(n)}
    return pa.table(columns | {"x_m": x, "y_m": y, "z_m": z})


def true_stops_table(survey_id: str, stops: tuple[StopTruth, ...]) -> pa.Table:
    """Return true poses as rows."""
    rows = []
    for stop in stops:
        yaw, pitch, roll = np.degrees(yaw_pitch_roll(stop.T_site_base[:3, :3]))
        x, y, z = stop.T_site_base[:3, 3]
        rows.append((survey_id, stop.name, x, y, z, yaw, pitch, roll))
    names = ("survey_id", "stop", "x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg")
    types = [pa.string(), pa.string(), *[pa.float64()] * 6]
    return pa.table(
        [pa.array([row[i] for row in rows], kind) for i, kind in enumerate(types)], names=names
    )


def json_text(values: Mapping[str, Any]) -> str:
    """Return values as JSON; InputError if they are not plain or not finite."""
    try:
        return json.dumps(values, sort_keys=True, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise InputError(f"Values for the catalogue must be plain and finite: {error}.") from error


def rig_text(truth: Truth) -> str | None:
    """Return the true rig as JSON, when known."""
    return None if truth.rig is None else json_text(rig_to_mapping(truth.rig))


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
