"""Routes of SQL for people: queries, the schema, and copies of the database."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any

from fastapi import APIRouter, Path, Request, Response
from fastapi import Query as QueryParameter
from fastapi.responses import FileResponse, PlainTextResponse

from spheremark.service.http.api.models import Listing, Query, QueryResponse, Table
from spheremark.service.http.state import Current, Service
from spheremark.service.serialise.queries import serialise_query
from spheremark.storage.catalogue.coordinates import coordinates_csv, named_points
from spheremark.storage.catalogue.sandbox import QueryResult, run_query, to_csv
from spheremark.storage.exports.points import GeographicOrigin, format_points

router = APIRouter(tags=["sql"])

ORIGIN = "Where the site is: LON,LAT[,BEARING of the y axis] in degrees (WGS 84); for GeoJSON."
POINT_MEDIA = {
    "dxf": "image/vnd.dxf",
    "xml": "application/xml",
    "geojson": "application/geo+json",
}


class PointFile(StrEnum):
    """Files of named points."""

    DXF = "dxf"
    XML = "xml"
    GEOJSON = "geojson"


@router.post(
    "/sql",
    name="query",
    response_model=QueryResponse,
    responses={200: {"content": {"text/csv": {}}}},
)
async def query(body: Query, request: Request, service: Current) -> Any:
    """Run one SELECT on a snapshot of the database, as JSON or CSV, within announced limits."""
    return await service.queries.run(request, _run, service, body, _accepted(request))


@router.get(
    "/sql",
    name="query_by_link",
    response_model=QueryResponse,
    responses={200: {"content": {"text/csv": {}}}},
)
async def query_by_link(
    q: Annotated[str, QueryParameter(min_length=1, max_length=8000, description="One SELECT.")],
    request: Request,
    service: Current,
) -> Any:
    """Run one SELECT that is part of the address: every query is a link."""
    return await service.queries.run(request, _run, service, Query(sql=q), _accepted(request))


@router.get("/sql/schema", name="get_schema")
def get_schema(service: Current) -> Listing[Table]:
    """Describe every table and view: columns, types, units and their meaning."""
    return Listing(items=[Table.model_validate(table) for table in service.catalogue.schema()])


@router.get(
    "/export/results.duckdb",
    name="export_database",
    response_class=FileResponse,
    responses={200: {"content": {"application/vnd.duckdb": {}}}},
)
def export_database(service: Current) -> FileResponse:
    """Return a consistent copy of the database, for one's own DuckDB (1.0 and later)."""
    return FileResponse(
        service.catalogue.export(),
        media_type="application/vnd.duckdb",
        filename="results.duckdb",
    )


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
    return Response(coordinates_csv(service.catalogue, survey), media_type="text/csv")


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
    return Response(text, media_type=POINT_MEDIA[kind])


def _accepted(request: Request) -> str:
    """Return what the client accepts."""
    return request.headers.get("accept", "")


def _run(service: Service, request: Query, accept: str) -> QueryResponse | Response:
    """Run a query on a snapshot; return CSV where the body or the Accept header requests it."""
    limits, snapshot = service.settings.query_limits, service.catalogue.snapshot()
    result = run_query(snapshot, request.sql, limits)
    if request.format == "csv" or accept.startswith("text/csv"):
        return _csv(result, limits.rows)
    return QueryResponse.model_validate(serialise_query(result, limits, snapshot))


def _csv(result: QueryResult, row_limit: int) -> Response:
    """Return a result as CSV; truncation, limit and time are in the headers."""
    headers = {
        "X-Truncated": str(result.truncated).lower(),
        "X-Row-Limit": str(row_limit),
        "X-Elapsed-Ms": f"{result.elapsed_ms:.3f}",
    }
    return PlainTextResponse(to_csv(result), media_type="text/csv", headers=headers)
