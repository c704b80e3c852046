"""Routes of SQL for people: a question, its answer, what can be asked, and a copy of it all."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import pyarrow as pa
from fastapi import APIRouter, Request, Response
from fastapi import Query as QueryParameter
from fastapi.responses import FileResponse, PlainTextResponse
from pyarrow import csv

from spheremark.service.http.api.models import Answer, Column, Listing, Query, Table
from spheremark.service.http.state import Current, Service
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.catalogue.records import unit_of
from spheremark.storage.catalogue.sandbox import QueryLimits, QueryResult, run_query, to_csv

router = APIRouter(tags=["sql"])

_COORDINATES = """
SELECT survey, 'mark' AS kind, mark AS name, NULL AS fit_method, NULL AS resection_method,
    'control' AS status, x_m, y_m, z_m, sqrt(sigma_x_m ^ 2 + sigma_y_m ^ 2 + sigma_z_m ^ 2)
    AS sigma_3d_m, NULL::DOUBLE AS error_3d_m
FROM control_marks JOIN (SELECT survey_id, name AS survey FROM surveys) USING (survey_id)
WHERE $survey::VARCHAR IS NULL OR survey_id = $survey OR survey = $survey
UNION ALL BY NAME
SELECT survey, 'station' AS kind, stop AS name, fit_method, resection_method, status, x_m, y_m, z_m,
    sigma_3d_m, error_3d_m
FROM latest_station_fixes
WHERE $survey::VARCHAR IS NULL OR survey_id = $survey OR survey = $survey
ORDER BY ALL
"""


@router.post(
    "/sql", name="query", response_model=Answer, responses={200: {"content": {"text/csv": {}}}}
)
def query(asked: Query, request: Request, service: Current) -> Any:
    """Answer one SELECT on a snapshot of the database, as JSON or CSV, within announced limits."""
    return _answer(service, asked, request)


@router.get(
    "/sql",
    name="query_by_link",
    response_model=Answer,
    responses={200: {"content": {"text/csv": {}}}},
)
def query_by_link(
    q: Annotated[str, QueryParameter(min_length=1, max_length=8000, description="One SELECT.")],
    request: Request,
    service: Current,
) -> Any:
    """Answer one SELECT that is part of the address: every question is a link."""
    return _answer(service, Query(sql=q), request)


@router.get("/sql/schema", name="get_schema")
def get_schema(service: Current) -> Listing[Table]:
    """Describe every table and view with its columns, types, units and what they mean."""
    return Listing(items=[Table.model_validate(table) for table in service.catalogue.schema()])


@router.get("/export/results.duckdb", name="export_database", response_class=FileResponse)
def export_database(service: Current) -> FileResponse:
    """Return a consistent copy of the database, for one's own DuckDB."""
    return FileResponse(
        service.catalogue.snapshot(),
        media_type="application/vnd.duckdb",
        filename="results.duckdb",
    )


@router.get("/export/coordinates.csv", name="export_coordinates")
def export_coordinates(
    service: Current,
    survey: Annotated[str | None, QueryParameter(description="Id or name of a survey.")] = None,
) -> Response:
    """Return the newest stations and the control marks as CSV, in the site frame."""
    return Response(coordinates(service.catalogue, survey), media_type="text/csv")


def coordinates(catalogue: Catalogue, survey: str | None) -> bytes:
    """Return the newest stations and the control marks of one survey or all, as CSV."""
    sink = pa.BufferOutputStream()
    csv.write_csv(catalogue.table(_COORDINATES, {"survey": survey}), sink)
    return bytes(sink.getvalue().to_pybytes())


def ask(catalogue: Catalogue, limits: QueryLimits, sql: str) -> Answer:
    """Answer one SELECT on a snapshot of the database."""
    snapshot = catalogue.snapshot()
    return _to_answer(run_query(snapshot, sql, limits), limits, snapshot)


def _answer(service: Service, asked: Query, request: Request) -> Answer | Response:
    """Run a question on a snapshot and answer in the shape that was asked for."""
    if asked.format == "csv" or request.headers.get("accept", "").startswith("text/csv"):
        result = run_query(service.catalogue.snapshot(), asked.sql, service.limits)
        return _csv(result, service.limits.rows)
    return ask(service.catalogue, service.limits, asked.sql)


def _to_answer(result: QueryResult, limits: QueryLimits, snapshot: Path) -> Answer:
    """Return what a query gave in the wire format."""
    return Answer(
        columns=[Column(name=c.name, type=c.type, unit=unit_of(c.name)) for c in result.columns],
        rows=[list(row) for row in result.rows],
        truncated=result.truncated,
        row_limit=limits.rows,
        elapsed_ms=round(result.elapsed_ms, 3),
        snapshot_at=datetime.fromtimestamp(snapshot.stat().st_mtime, UTC),
    )


def _csv(result: QueryResult, row_limit: int) -> Response:
    """Return an answer as CSV; what JSON says beside the rows is in the headers."""
    headers = {
        "X-Truncated": str(result.truncated).lower(),
        "X-Row-Limit": str(row_limit),
        "X-Elapsed-Ms": f"{result.elapsed_ms:.3f}",
    }
    return PlainTextResponse(to_csv(result), media_type="text/csv", headers=headers)
