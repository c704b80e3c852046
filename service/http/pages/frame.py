"""The frame of all pages, the page of errors, and pages about the service itself."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import FileResponse, HTMLResponse, RedirectResponse

from spheremark.pipelines.errors import NotFoundError
from spheremark.service.errors import Problem
from spheremark.service.http.api.models import PARAMETERS_MAX
from spheremark.service.http.api.sql import query_of
from spheremark.service.http.state import Current, Service
from spheremark.storage.catalogue import saved_queries
from spheremark.storage.catalogue.records import TableInfo
from spheremark.web import assets, glossary
from spheremark.web.pages.base import Frame
from spheremark.web.pages.guide import guide_page
from spheremark.web.pages.sql import Schema, SqlQuery, schema_of, sql_page
from spheremark.web.templating import render

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

_A_YEAR = "public, max-age=31536000, immutable"
_SURVEY_NAMES = """
SELECT name FROM surveys WHERE survey_id NOT IN (SELECT survey_id FROM deleted_surveys)
ORDER BY created_at DESC, name
"""
_SURVEY = """
SELECT survey_id, name, tolerance_m, rig_digest FROM surveys
WHERE (name = $id OR survey_id = $id) AND survey_id NOT IN (SELECT survey_id FROM deleted_surveys)
"""


@router.get(assets.plotly_url())
def plotly_script() -> FileResponse:
    """Return Plotly's script from the installed package."""
    return FileResponse(
        assets.plotly_script(), media_type="text/javascript", headers={"Cache-Control": _A_YEAR}
    )


@router.get(assets.reference_urls()["script"], response_class=FileResponse)
@router.get(assets.reference_urls()["style"], response_class=FileResponse)
def reference_file(request: Request) -> FileResponse:
    """Return a file of Swagger UI from the installed package."""
    path = assets.reference_folder() / request.url.path.rpartition("/")[2]
    return FileResponse(path, headers={"Cache-Control": _A_YEAR})


@router.get("/guide")
@router.get("/guide/{page:path}")
def guide(request: Request, service: Current, page: str = "") -> Response:
    """Return a file of the guide; where it is not built, a page of its Markdown."""
    if request.url.path == "/guide":
        return RedirectResponse("/guide/")
    folder = assets.guide_folder()
    if not folder.is_dir():
        name = page.removesuffix(".html").removeprefix("made/")
        return HTMLResponse(guide_page(frame_of(service), name or "index"))
    return FileResponse(_page_of_guide(folder.resolve(), page or "index.html"))


def _page_of_guide(folder: Path, page: str) -> Path:
    """Return a file below the folder of the guide; NotFoundError for any other path."""
    with suppress(OSError, ValueError):  # names that no file can have: too long, or with a NUL
        found = (folder / page).resolve()
        if found.is_relative_to(folder) and found.is_file():
            return found
    raise NotFoundError(f"The guide has no page {page[:200]!r}; /guide/ lists its pages.")


@router.get("/glossary")
def show_glossary(service: Current) -> str:
    """Show the words of the product and their meaning."""
    words = glossary.glossary()
    return render("glossary.html", frame=frame_of(service), words=words, anchor=glossary.anchor)


@router.get("/docs")
def docs(service: Current) -> str:
    """Show the interface for programs."""
    return render("docs.html", frame=frame_of(service), reference=assets.reference_urls())


@router.get("/sql")
def sql(
    service: Current,
    q: Annotated[str, Query(max_length=100_000)] = "",
    name: Annotated[str, Query(max_length=200)] = "",
    p: Annotated[list[str] | None, Query(max_length=PARAMETERS_MAX)] = None,
) -> str:
    """Show the workbench for queries."""
    chosen = query_of(service, None if name else q, name or None, p or [])
    return sql_page(
        frame_of(service),
        SqlQuery(text=chosen["sql"], parameters=chosen["parameters"], name=name),
        _schema(service.catalogue.schema()),
        asdict(service.settings.query_limits),
        saved_queries.list_queries(service.catalogue),
    )


@lru_cache(maxsize=4)
def _schema(tables: tuple[TableInfo, ...]) -> Schema:
    """Return tables and views as the page for queries shows them."""
    return schema_of([asdict(table) for table in tables])


def error_page(_: Request, problem: Problem) -> HTMLResponse:
    """Return a problem as a page, for browsers."""
    text = render("error.html", frame=Frame(), problem=problem)
    return HTMLResponse(text, status_code=problem.status)


def frame_of(service: Service, survey: str = "", tab: str = "") -> Frame:
    """Return what every page shows around itself; a page of a survey names the tab it is in."""
    rows = service.catalogue.computed("names", lambda: service.catalogue.rows(_SURVEY_NAMES))
    names = tuple(row["name"] for row in rows)
    return Frame(surveys=names, survey=survey, tab=tab)


def survey_row(service: Service, key: str) -> Mapping[str, Any]:
    """Return the survey of that name or id."""
    return service.catalogue.computed(
        ("survey_row", key), lambda: service.row(_SURVEY, key, "survey")
    )


def address_of(request: Request) -> str:
    """Return the address that the reader uses for this service."""
    return str(request.base_url).rstrip("/")
