"""Routes of SQL for people: queries, the schema, and copies of the database."""

from __future__ import annotations

import json
import pathlib
from collections.abc import Callable, Iterator, Mapping
from enum import StrEnum
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Path, Request, Response
from fastapi import Query as QueryParameter
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse
from pydantic import ValidationError

from spheremark.pipelines.errors import InputError
from spheremark.service.http.api.models import (
    PARAMETERS_MAX,
    Listing,
    NewQuery,
    Query,
    QueryFormat,
    QueryResponse,
    SavedQuery,
    Table,
)
from spheremark.service.http.state import Current, Service
from spheremark.service.serialise.queries import serialise_query
from spheremark.storage.catalogue import saved_queries
from spheremark.storage.catalogue.coordinates import coordinates_csv, named_points
from spheremark.storage.catalogue.query_files import to_arrow, to_parquet
from spheremark.storage.catalogue.sandbox import QueryResult, run_query, to_csv
from spheremark.storage.exports.points import GeographicOrigin, format_points

router = APIRouter(tags=["sql"])

ORIGIN = "Where the site is: LON,LAT[,BEARING of the y axis] in degrees (WGS 84); for GeoJSON."
POINT_MEDIA = {
    "dxf": "image/vnd.dxf",
    "xml": "application/xml",
    "geojson": "application/geo+json",
}
_WRITERS: Mapping[str, Callable[[QueryResult], str | bytes]] = {
    "csv": to_csv,
    "parquet": to_parquet,
    "arrow": to_arrow,
}
_MEDIA = {
    "csv": "text/csv",
    "parquet": "application/vnd.apache.parquet",
    "arrow": "application/vnd.apache.arrow.stream",
}
_FORMATS: dict[int | str, dict[str, Any]] = {
    200: {"content": {media: {} for media in _MEDIA.values()}}
}
QueryName = Annotated[str, Path(description="Name of the query.", max_length=200)]


class PointFile(StrEnum):
    """Files of named points."""

    DXF = "dxf"
    XML = "xml"
    GEOJSON = "geojson"


@router.post("/sql", name="query", response_model=QueryResponse, responses=_FORMATS)
async def query(body: Query, request: Request, service: Current) -> Any:
    """Run one SELECT on a snapshot of the database, within announced limits."""
    return await service.queries.run(request, _run, service, body, _accepted(request))


@router.get("/sql", name="query_by_link", response_model=QueryResponse, responses=_FORMATS)
async def query_by_link(
    request: Request,
    service: Current,
    q: Annotated[
        str | None, QueryParameter(min_length=1, max_length=8000, description="One SELECT.")
    ] = None,
    name: Annotated[
        str | None, QueryParameter(description="Name of a query that is kept, in place of q.")
    ] = None,
    p: Annotated[
        list[str] | None,
        QueryParameter(
            max_length=PARAMETERS_MAX,
            description="Value of a parameter, as name=value; again for more.",
        ),
    ] = None,
    format: Annotated[  # the word of the interface
        QueryFormat | None, QueryParameter(description="Format of the response.")
    ] = None,
) -> Any:
    """Run one SELECT that is part of the address, or kept under a name: every query is a link."""
    chosen = query_of(service, q, name, p or [])
    try:
        given = Query(format=format or "json", **chosen)
    except ValidationError as error:  # with those of a kept query, more than may be
        found = [{**one, "loc": ("query", *one["loc"])} for one in error.errors()]
        raise RequestValidationError(found) from error
    accept = "" if format else _accepted(request)
    return await service.queries.run(request, _run, service, given, accept)


def query_of(service: Service, q: str | None, name: str | None, given: list[str]) -> dict[str, Any]:
    """Return the text of a query and the values of its parameters, from those of an address."""
    if (q is None) == (name is None):
        text = "give either q, one SELECT, or name, that of a query that is kept"
        raise RequestValidationError([{"type": "missing", "loc": ("query", "q"), "msg": text}])
    found: dict[str, Any] = {"sql": q, "parameters": {}}
    if name is not None:
        found = saved_queries.get_query(service.catalogue, name)
    values = dict(_value_of(one) for one in given)
    return {"sql": found["sql"], "parameters": found["parameters"] | values}


def _value_of(text: str) -> tuple[str, Any]:
    """Return a parameter of an address: numbers, true, false and null as such, else text."""
    name, mark, value = text.partition("=")
    if not mark or not name:
        raise InputError(f"The parameter {text!r} must have the form name=value.")
    try:
        found = json.loads(value)
    except (ValueError, RecursionError):
        return name, value
    return name, value if isinstance(found, str | list | dict) else found


@router.get("/queries", name="list_queries")
def list_queries(service: Current) -> Listing[SavedQuery]:
    """List the queries that are kept under a name."""
    rows = saved_queries.list_queries(service.catalogue)
    return Listing(items=[SavedQuery.model_validate(row) for row in rows])


@router.put("/queries/{name}", name="put_query")
def put_query(name: QueryName, new: NewQuery, service: Current) -> SavedQuery:
    """Keep a query under a name, in place of the one that has it."""
    row = saved_queries.put_query(service.catalogue, name, new.sql, new.parameters)
    return SavedQuery.model_validate(row)


@router.get("/queries/{name}", name="get_query")
def get_query(name: QueryName, service: Current) -> SavedQuery:
    """Return a query that is kept."""
    return SavedQuery.model_validate(saved_queries.get_query(service.catalogue, name))


@router.delete("/queries/{name}", name="delete_query", status_code=204, response_class=Response)
def delete_query(name: QueryName, service: Current) -> Response:
    """Forget a query that is kept."""
    saved_queries.delete_query(service.catalogue, name)
    return Response(status_code=204)


@router.get("/sql/schema", name="get_schema")
def get_schema(service: Current) -> Listing[Table]:
    """Describe every table and view: columns, types, units and their meaning."""
    return Listing(items=[Table.model_validate(table) for table in service.catalogue.schema()])


def _lent_export(service: Current) -> Iterator[pathlib.Path]:
    """Lend a copy of the database until the response is sent."""
    with service.catalogue.lent_export() as copy:
        yield copy


@router.get(
    "/export/results.duckdb",
    name="export_database",
    response_class=FileResponse,
    responses={200: {"content": {"application/vnd.duckdb": {}}}},
)
def export_database(copy: Annotated[pathlib.Path, Depends(_lent_export)]) -> FileResponse:
    """Return a consistent copy of the database, for one's own DuckDB (1.0 and later)."""
    return FileResponse(copy, media_type="application/vnd.duckdb", filename="results.duckdb")


@router.get(
    "/export/coordinates.csv",
    name="export_coordinates",
    response_class=Response,
    responses={200: {"content": {"text/csv": {}}}},
)
def export_coordinates(
    service: Current,
    survey: Annotated[str | None, QueryParameter(description="Id or name of a survey.")] = None,
) -> Response:
    """Return the newest stations and the control marks as CSV, in the site frame."""
    if survey is not None:
        service.catalogue.get_survey(survey)
    return _coordinates(coordinates_csv(service.catalogue, survey), "text/csv", "csv")


@router.get(
    "/export/coordinates.{kind}",
    name="export_points",
    response_class=Response,
    responses={200: {"content": {media: {} for media in POINT_MEDIA.values()}}},
)
def export_points(
    service: Current,
    kind: Annotated[PointFile, Path(description="DXF or LandXML to stake out, or GeoJSON.")],
    survey: Annotated[str | None, QueryParameter(description="Id or name of a survey.")] = None,
    origin: Annotated[str | None, QueryParameter(description=ORIGIN)] = None,
) -> Response:
    """Return the newest stations and the control marks for other programs."""
    if survey is not None:
        service.catalogue.get_survey(survey)
    place = GeographicOrigin.parse(origin) if origin else None
    text = format_points(named_points(service.catalogue, survey), f".{kind}", place)
    return _coordinates(text, POINT_MEDIA[kind], kind)


def _coordinates(content: str | bytes, media_type: str, ending: str) -> Response:
    """Return coordinates as a file, to be saved."""
    headers = {"Content-Disposition": f'attachment; filename="coordinates.{ending}"'}
    return Response(content, media_type=media_type, headers=headers)


def _accepted(request: Request) -> str:
    """Return what the client accepts."""
    return request.headers.get("accept", "")


def _run(service: Service, request: Query, accept: str) -> QueryResponse | Response:
    """Run a query on a snapshot; return the format that the body or the Accept header requests."""
    limits = service.settings.query_limits
    accepted = (one for one, media in _MEDIA.items() if accept.startswith(media))
    form = request.format if request.format != "json" else next(accepted, "json")
    with service.catalogue.lent_snapshot() as snapshot:
        result = run_query(snapshot, request.sql, limits, request.parameters)
        if form == "json":
            return QueryResponse.model_validate(serialise_query(result, limits, snapshot))
    headers = {
        "X-Truncated": str(result.truncated).lower(),
        "X-Row-Limit": str(limits.rows),
        "X-Elapsed-Ms": f"{result.elapsed_ms:.3f}",
        "Content-Disposition": f'inline; filename="spheremark.{form}"',
    }
    return Response(_WRITERS[form](result), media_type=_MEDIA[form], headers=headers)
