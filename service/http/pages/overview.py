"""The overview, and the forms that create, rename, delete and restore surveys."""

from __future__ import annotations

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, RedirectResponse

from spheremark.service.http.pages.frame import address_of, frame_of
from spheremark.service.http.pages.networks import Fields
from spheremark.service.http.state import Current
from spheremark.service.serialise.solution import survey_decisions
from spheremark.web.links import survey_url
from spheremark.web.templating import render

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

_N_SURVEYS, _N_RECORDINGS = 30, 20  # on the overview
_SURVEYS = """
SELECT s.survey_id, s.name, s.tolerance_m, s.created_at,
    (SELECT count(*) FROM control_marks AS c WHERE c.survey_id = s.survey_id) AS n_control_marks
FROM surveys AS s WHERE s.survey_id NOT IN (SELECT survey_id FROM deleted_surveys)
ORDER BY s.created_at DESC, s.name LIMIT $n
"""
_RECORDINGS = """
SELECT r.recording_id, r.name, r.size_bytes, r.uploaded_at, r.verdict
FROM recordings AS r ORDER BY r.uploaded_at DESC, r.recording_id LIMIT $n
"""


@router.get("/")
def overview(request: Request, service: Current) -> str:
    """Show each survey with its decision, and how to bring more."""
    rows = service.catalogue.rows
    surveys = rows(_SURVEYS, {"n": _N_SURVEYS})
    tolerances = {survey["survey_id"]: survey["tolerance_m"] for survey in surveys}
    decisions = survey_decisions(service.catalogue, tolerances)
    for survey in surveys:
        survey["solution"], survey["decision"] = decisions[survey["survey_id"]]
    return render(
        "overview.html",
        frame=frame_of(service),
        address=address_of(request),
        surveys=surveys,
        deleted=service.catalogue.deleted_surveys(),
        recordings=rows(_RECORDINGS, {"n": _N_RECORDINGS}),
    )


@router.get("/new")
def new_survey(request: Request, service: Current) -> str:
    """Show the steps from nothing to a result."""
    return render("wizard.html", frame=frame_of(service), address=address_of(request))


@router.post("/restore")
def restore(fields: Fields, service: Current) -> RedirectResponse:
    """Restore a deleted survey, and show it."""
    survey = service.catalogue.restore_survey(fields.get("survey", ""))
    return RedirectResponse(survey_url(survey.name), status_code=303)


@router.post("/sample")
def sample(service: Current) -> RedirectResponse:
    """Begin a sample survey, and show it."""
    return RedirectResponse(survey_url(service.samples.begin(service)), status_code=303)
