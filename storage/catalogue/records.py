"""Rows of the catalogue as values, and values as rows."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from datetime import datetime
from enum import StrEnum
from typing import Any, Generic, TypeVar

from spheremark.pipelines.errors import InputError

_Record = TypeVar("_Record")
_SI_COLUMNS = {"tolerance": "tolerance_m", "duration": "duration_s"}  # field to column
_JSON = ("config", "options", "preflight")

_UNITS = {
    "m2": "m²",
    "m": "m",
    "deg": "°",
    "s": "s",
    "bytes": "bytes",
    "percent": "%",
    "at": "UTC",
}
"""Printed unit by the ending of a column's name."""


class JobStatus(StrEnum):
    """Status of a job, in the words of OGC API - Processes."""

    ACCEPTED = "accepted"
    RUNNING = "running"
    SUCCESSFUL = "successful"
    FAILED = "failed"
    DISMISSED = "dismissed"

    @property
    def is_final(self) -> bool:
        """Whether a job with this status never changes again."""
        return self not in (JobStatus.ACCEPTED, JobStatus.RUNNING)


@dataclass(frozen=True, slots=True, kw_only=True)
class Page(Generic[_Record]):
    """One page of a list, newest first; ``next`` is the ``after`` of the page that follows."""

    items: tuple[_Record, ...]
    next: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyRecord:
    """A survey: a row of ``surveys``, whose comments define the columns, with counts.

    ``tolerance`` is in metres; ``n_true_stops`` counts stops with a known truth.
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
    """An uploaded log: a row of ``recordings``, whose comments define the columns."""

    recording_id: str
    name: str
    size_bytes: int
    uploaded_at: datetime
    url: str
    verdict: str
    preflight: Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class JobRecord:
    """A job: a row of ``jobs``, whose comments define the columns, with the names of its inputs.

    ``recording_id`` and ``recording`` are None for a job on the survey as a whole. ``waits_for``
    are the open jobs of the survey whose results this job reads.
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
    waits_for: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class RunRecord:
    """A run: a row of ``runs``, whose comments define the columns; ``duration`` is in seconds."""

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


_Kind = TypeVar("_Kind", SurveyRecord, RecordingRecord, JobRecord, RunRecord)


@dataclass(frozen=True, slots=True, kw_only=True)
class ColumnInfo:
    """A column of a table or view, with its unit from the name and its comment."""

    name: str
    type: str
    unit: str
    comment: str


@dataclass(frozen=True, slots=True, kw_only=True)
class TableInfo:
    """A ``table`` or ``view`` that may be queried, with its columns in order."""

    name: str
    kind: str
    comment: str
    columns: tuple[ColumnInfo, ...]


def unit_of(column: str) -> str:
    """Return the printed unit of a column.

    Parameters
    ----------
    column : str
        Name of a column.

    Returns
    -------
    str
        The unit that the name carries; empty when it carries none.
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


def record_of(kind: type[_Kind], row: Mapping[str, Any]) -> _Kind:
    """Build a record from a row; JSON becomes a mapping, and SI fields have no unit in the name."""
    values = {f.name: row[_SI_COLUMNS.get(f.name, f.name)] for f in fields(kind)}
    values |= {name: json.loads(values[name] or "{}") for name in _JSON if name in values}
    if "status" in values:
        values["status"] = JobStatus(values["status"])
    return kind(**values)


def json_text(values: Mapping[str, Any]) -> str:
    """Return values as JSON; InputError if they are not plain or not finite."""
    try:
        return json.dumps(values, sort_keys=True, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise InputError(f"Values for the catalogue must be plain and finite: {error}.") from error
