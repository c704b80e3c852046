"""Routes of two pages: a site with its clouds and its ground, and whether error bars hold."""

from __future__ import annotations

from fastapi import APIRouter
from fastapi.responses import HTMLResponse, RedirectResponse

from spheremark.pipelines.errors import InputError, NotFoundError
from spheremark.pipelines.ground_model import ElevationModel
from spheremark.service.http.api.jobs import start
from spheremark.service.http.api.models import NewJob
from spheremark.service.http.api.sites import Product, products_of
from spheremark.service.http.pages.frame import frame_of
from spheremark.service.http.pages.networks import Fields
from spheremark.service.http.state import Current, Service
from spheremark.service.jobs.handlers import JobKind
from spheremark.storage.catalogue.solutions import chosen_solution
from spheremark.storage.exports.reports import kept_coverage, kept_worlds
from spheremark.web.pages.ellipse_coverage import coverage_page
from spheremark.web.pages.site import site_page
from spheremark.web.pages.worlds import worlds_page

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

_MARKS = """
SELECT mark, x_m, y_m FROM control_marks JOIN surveys AS s USING (survey_id)
WHERE s.survey_id = $id ORDER BY mark
"""
_STATIONS = """
SELECT station AS name, x_m, y_m FROM adjusted_stations WHERE adjustment_id = $adjustment
UNION ALL
SELECT station AS name, x_m, y_m FROM chosen_stations
WHERE $adjustment IS NULL AND survey_id = $id
ORDER BY name
"""
_JOBS = """
SELECT job_id FROM jobs
WHERE survey_id = $id AND kind = 'site' AND status IN ('accepted', 'running') ORDER BY created_at
"""


@router.get("/coverage")
def coverage(service: Current) -> str:
    """Show the coverage of error ellipses."""
    return coverage_page(frame_of(service), kept_coverage(service.settings.data))


@router.get("/worlds")
def worlds(service: Current) -> str:
    """Show detection and errors in random worlds."""
    return worlds_page(frame_of(service), kept_worlds(service.settings.data))


@router.get("/surveys/{name:path}/site")
def site(name: str, service: Current) -> str:
    """Show what was made of all stops of a survey."""
    survey = service.catalogue.get_survey(name)
    products = products_of(service, name)
    newest = next((one for one in products if one.kind == "geotiff"), None)
    key, rows = {"id": survey.survey_id}, service.catalogue.rows
    adjustment = {"adjustment": newest.adjustment_id if newest else None}
    columns = service.catalogue.columns
    return site_page(
        frame_of(service, survey.name, "site"),
        _model(service, newest),
        columns(_MARKS, key),
        columns(_STATIONS, key | adjustment),
        products=[one.model_dump() for one in products],
        jobs=[row["job_id"] for row in rows(_JOBS, key)],
        solution=chosen_solution(service.catalogue, survey.survey_id),
    )


@router.post("/surveys/{name:path}/site")
def start_job(name: str, fields: Fields, service: Current) -> RedirectResponse:
    """Start a job that makes cloud and ground, and show it."""
    try:
        options = {key: float(value) for key, value in fields.items()}
    except ValueError as error:
        raise InputError(f"The form has a value that is no number: {error}.") from error
    job = start(service, NewJob(kind=JobKind.SITE, survey=name, options=options))
    return RedirectResponse(f"/jobs/{job.job_id}", status_code=303)


def _model(service: Service, newest: Product | None) -> ElevationModel | None:
    """Read the newest model of the ground, if it is there."""
    from spheremark.storage.exports.ground_model import read_geotiff

    if newest is None:
        return None
    rows = service.catalogue.rows(
        "SELECT url FROM site_products WHERE product_id = $id AND kind = 'geotiff'",
        {"id": newest.product_id},
    )
    try:
        return read_geotiff(rows[0]["url"])
    except NotFoundError:
        return None
