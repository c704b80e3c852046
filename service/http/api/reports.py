"""Routes of reports: a survey's results to be printed and signed."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response

from spheremark.service.http.api.surveys import Key
from spheremark.service.http.state import Current, Service
from spheremark.service.serialise.survey_report import survey_report
from spheremark.web.pages.report import report_html, report_pdf

router = APIRouter(prefix="/surveys", tags=["results"])

Chosen = Annotated[
    str | None, Query(description="Id of an adjustment of the survey; the newest by default.")
]


@router.get(
    "/{survey}/report.pdf",
    name="get_report_pdf",
    response_class=Response,
    responses={200: {"content": {"application/pdf": {}}}},
)
async def get_report_pdf(
    survey: Key, request: Request, service: Current, adjustment: Chosen = None
) -> Response:
    """Return the report of a survey as PDF: adjustment or stations, tests, map, digests."""
    return await service.plans.run(request, _pdf, service, survey, adjustment)


def _pdf(service: Service, survey: str, adjustment: str | None) -> Response:
    """Return the report as PDF."""
    report = survey_report(service.catalogue, survey, adjustment)
    return _file(report_pdf(report), "application/pdf", service, survey, "pdf")


@router.get(
    "/{survey}/report.html",
    name="get_report_html",
    response_class=Response,
    responses={200: {"content": {"text/html": {}}}},
)
def get_report_html(survey: Key, service: Current, adjustment: Chosen = None) -> Response:
    """Return the report of a survey as HTML in one file."""
    report = survey_report(service.catalogue, survey, adjustment)
    return _file(report_html(report), "text/html", service, survey, "html")


def _file(body: Any, media_type: str, service: Service, survey: str, ending: str) -> Response:
    """Return a file, to be shown or saved under the name of its survey."""
    name = service.catalogue.get_survey(survey).name
    safe = "".join(c if c.isascii() and (c.isalnum() or c in "-_.") else "-" for c in name)
    headers = {"Content-Disposition": f'inline; filename="{safe}-report.{ending}"'}
    return Response(body, media_type=media_type, headers=headers)
