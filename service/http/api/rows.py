"""Rows of the database in the wire format: a model for each table, made from its columns."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from datetime import datetime
from typing import Annotated, Any

import pyarrow as pa
from fastapi import Path, Response
from pydantic import BaseModel, ConfigDict, Field, create_model

from spheremark.pipelines.errors import NotFoundError
from spheremark.service.http.api.models import Listing, Strict
from spheremark.service.http.state import Service
from spheremark.storage.catalogue.records import unit_of
from spheremark.storage.catalogue.schema import SCHEMAS

Plain = dict[str, Any]
Columns = Iterable[tuple[str, pa.DataType]]

_DOCUMENT = "SELECT media_type, text FROM documents WHERE result_id = $id AND name = $name"
_NAMES = "SELECT name FROM documents WHERE result_id = $id ORDER BY name"
_JSON: Mapping[str, Any] = {"config": dict[str, Any], "covariance": list[list[float]]}
"""Columns that hold JSON, with the type of their values."""

FileName = Annotated[str, Path(description="Name of a file, as the result lists it.")]


class Row(BaseModel):
    """A row; a column that is not declared is an error of the service."""

    model_config = ConfigDict(extra="forbid")


class ResultFilter(Strict):
    """Which results are requested."""

    survey: str | None = Field(default=None, description="Id or name of a survey.")
    after: int = Field(default=0, ge=0, le=10**15, description="The 'next' of the part before.")
    limit: int = Field(default=100, ge=1, le=1000, description="Items in one part.")


def row_model(name: str, about: str, columns: Columns, **more: Any) -> type[Row]:
    """Return the model of a row with these columns, and with fields beside them."""
    fields: Plain = {
        column: (_JSON.get(column, _type_of(kind)) | None, Field(description=_unit(column)))
        for column, kind in columns
    }
    fields |= {field: (kind, ...) for field, kind in more.items()}
    return create_model(name, __base__=Row, __doc__=about, **fields)


def listing_of(model: type[BaseModel]) -> type[BaseModel]:
    """Return the model of a list of such items."""
    return Listing[model]  # type: ignore[valid-type]  # known at run time only


def _type_of(kind: pa.DataType) -> Any:
    """Return the type of the values of a column."""
    if pa.types.is_list(kind):
        return list[_type_of(kind.value_type)]  # type: ignore[misc]  # known at run time only
    tests = (
        (pa.types.is_string, str),
        (pa.types.is_boolean, bool),
        (pa.types.is_integer, int),
        (pa.types.is_floating, float),
        (pa.types.is_timestamp, datetime),
    )
    return next(python for is_kind, python in tests if is_kind(kind))


def _unit(column: str) -> str | None:
    """Return the unit of a column in brackets, if it has one."""
    unit = unit_of(column)
    return f"[{unit}]" if unit else None


def _columns_of(table: str) -> Columns:
    """Return the columns of a table that a job writes."""
    return [(field.name, field.type) for field in SCHEMAS[table]]


def _table(name: str, about: str, table: str, **more: Any) -> type[Row]:
    """Return the model of a row of a table."""
    return row_model(name, about, _columns_of(table), **more)


def _many(name: str, about: str, table: str) -> Any:
    """Return the type of a list of rows of a table."""
    return list[_table(name, about, table)]  # type: ignore[misc]  # known at run time only


_LABELS = {"id": str, "survey": str, "recording_id": str}
MarkerFit = _table("MarkerFit", "A sphere centre in the station frame.", "marker_fits", **_LABELS)
StationFix = _table("StationFix", "A station in the site frame.", "station_fixes", **_LABELS)
StationFixDetail = _table(
    "StationFixDetail",
    "A station with its observations.",
    "station_fixes",
    **_LABELS,
    observations=_many("Observation", "A marker of a stop, used for a fix or not.", "observations"),
)
Adjustment = _table("Adjustment", "An adjusted network.", "adjustments", survey=str)
AdjustmentDetail = _table(
    "AdjustmentDetail",
    "An adjusted network with its stations and marks.",
    "adjustments",
    survey=str,
    stations=_many("AdjustedStation", "A station of a network.", "adjusted_stations"),
    marks=_many("AdjustedMark", "A mark of a network.", "adjusted_marks"),
    control_checks=_many(
        "ControlCheck", "A control mark as all else predicts it.", "control_checks"
    ),
    repeated_stops=_many("RepeatedStop", "Two stations at one place.", "repeated_stops"),
    mark_decisions=_many(
        "MarkDecision", "What all stations together make of a mark.", "mark_decisions"
    ),
    mark_evidence=_many("MarkEvidence", "What one station shows of a mark.", "mark_evidence"),
    refused=_many("RefusedStation", "A station that is not in the network.", "refused_stations"),
    files=list[str],
)
Calibration = _table("Calibration", "A calibrated rig.", "calibrations", survey=str)
CalibrationDetail = _table(
    "CalibrationDetail",
    "A calibrated rig with its parameters.",
    "calibrations",
    survey=str,
    values=_many("CalibratedParameter", "A parameter before and after.", "calibrated_parameters"),
    gaps=_many("FaceGap", "The two faces of a sphere against each other.", "calibration_gaps"),
    files=list[str],
)


def listed(service: Service, sql: str, parameters: Mapping[str, Any]) -> Plain:
    """Return a part of the rows of a query that takes ``$after`` and ``$n``."""
    after, limit = parameters["after"], parameters["limit"]
    rest = {name: value for name, value in parameters.items() if name != "limit"}
    rows = service.catalogue.rows(sql, rest | {"n": limit + 1})
    return {
        "items": [_readable(row) for row in rows[:limit]],
        "next": str(after + limit) if len(rows) > limit else None,
    }


def one_of(service: Service, sql: str, key: str, what: str) -> Plain:
    """Return the row with an id."""
    return _readable(service.row(sql, key, what))


def detailed(service: Service, row: Plain, parts: Mapping[str, str], key: str) -> Plain:
    """Return a result with the rows that belong to it, and the names of its files."""
    found = {name: service.catalogue.rows(sql, {"id": key}) for name, sql in parts.items()}
    names = [one["name"] for one in service.catalogue.rows(_NAMES, {"id": key})]
    return row | found | {"files": names}


def document(service: Service, key: str, name: str) -> Response:
    """Return a file of a result, to be saved under its name."""
    found = service.catalogue.rows(_DOCUMENT, {"id": key, "name": name})
    if not found:
        raise NotFoundError(f"There is no file {name!r} of a result {key!r}.")
    headers = {"Content-Disposition": f'attachment; filename="{name}"'}
    return Response(found[0]["text"], media_type=found[0]["media_type"], headers=headers)


def _readable(row: Plain) -> Plain:
    """Return a row with its JSON as values."""
    return {key: json.loads(value) if key in _JSON else value for key, value in row.items()}
