"""Route of the page of a survey's report."""

from __future__ import annotations

from typing import Annotated
from urllib.parse import quote, urlencode

from fastapi import APIRouter, Query
from fastapi.responses import HTMLResponse

from spheremark.service.http.pages.frame import frame_of
from spheremark.service.http.state import Current
from spheremark.service.serialise.survey_report import survey_report
from spheremark.web.pages.report import report_page

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)


@router.get("/surveys/{name:path}/report")
def report(name: str, service: Current, adjustment: Annotated[str, Query()] = "") -> str:
    """Show the report of a survey."""
    found = service.catalogue.get_survey(name)
    address = f"/api/v1/surveys/{quote(found.survey_id)}/report"
    query = f"?{urlencode({'adjustment': adjustment})}" if adjustment else ""
    made = survey_report(service.catalogue, found.survey_id, adjustment or None)
    return report_page(frame_of(service, found.name, "report"), made, address, query)
