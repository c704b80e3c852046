"""The dashboards of accuracy: of one survey, and over all."""

from __future__ import annotations

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse

from spheremark.service.http import figures
from spheremark.service.http.pages.frame import frame_of
from spheremark.service.http.state import Current, Service
from spheremark.storage.catalogue.accuracy import Selection
from spheremark.web.pages.accuracy import accuracy_page

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

_METHODS = """
SELECT DISTINCT fit_method FROM latest_marker_fits WHERE $survey = '' OR survey = $survey
ORDER BY fit_method != 'along_beam', fit_method
"""


@router.get("/accuracy")
def accuracy(request: Request, service: Current) -> str:
    """Show the accuracy over all surveys."""
    return _page(request, service, "")


@router.get("/surveys/{name:path}/accuracy")
def survey_accuracy(name: str, request: Request, service: Current) -> str:
    """Show the accuracy of a survey."""
    return _page(request, service, service.catalogue.get_survey(name).name)


def _page(request: Request, service: Service, survey: str) -> str:
    """Return the dashboard of a survey, or of all."""
    query = {name: request.query_params.getlist(name) for name in request.query_params}
    selection = Selection(surveys=(survey,) if survey else ())
    return accuracy_page(
        frame_of(service, survey, "accuracy" if survey else ""),
        query,
        survey=survey,
        methods=[row["fit_method"] for row in service.catalogue.rows(_METHODS, {"survey": survey})],
        has_truth=figures.choose(service, selection).values["is_error"],
    )
