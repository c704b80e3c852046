"""The frame of all pages, the page of errors, and pages about the service itself."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

from fastapi import APIRouter, Query, Request
from fastapi.responses import FileResponse, HTMLResponse

from spheremark.service.errors import Problem
from spheremark.service.http.state import Current, Service
from spheremark.web import assets, pages

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

_A_YEAR = "public, max-age=31536000, immutable"
_SURVEY_NAMES = "SELECT name FROM surveys ORDER BY created_at DESC, name"


@router.get(assets.plotly_url())
def plotly_script() -> FileResponse:
    """Return Plotly's script from the installed package."""
    return FileResponse(
        assets.plotly_script(), media_type="text/javascript", headers={"Cache-Control": _A_YEAR}
    )


@router.get("/sql")
def sql(service: Current, q: Annotated[str, Query(max_length=100_000)] = "") -> str:
    """Show the workbench for queries."""
    limits = service.settings.query_limits
    return pages.sql_page(
        pages.SqlPage(
            frame=frame_of(service),
            query=q or pages.EXAMPLES[0][1],
            tables=tuple(asdict(table) for table in service.catalogue.schema()),
            seconds=limits.seconds,
            rows=limits.rows,
            memory_bytes=limits.memory_bytes,
        )
    )


def error_page(_: Request, problem: Problem) -> HTMLResponse:
    """Return a problem as a page, for browsers."""
    text = pages.error_page(
        pages.ErrorPage(
            frame=pages.Frame(),
            status=problem.status,
            title=problem.title,
            detail=problem.detail,
            code=problem.code,
        )
    )
    return HTMLResponse(text, status_code=problem.status)


def frame_of(service: Service, survey: str = "") -> pages.Frame:
    """Return what every page shows around itself."""
    names = tuple(row["name"] for row in service.catalogue.rows(_SURVEY_NAMES))
    return pages.Frame(surveys=names, survey=survey)


def address_of(request: Request) -> str:
    """Return the address that the reader uses for this service."""
    return str(request.base_url).rstrip("/")
