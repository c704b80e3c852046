"""The tab that a survey opens with: its decision, its coordinates, its map."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query
from fastapi.responses import HTMLResponse

from spheremark.service.http.pages.frame import frame_of, survey_row
from spheremark.service.http.pages.jobs import newest_jobs
from spheremark.service.http.state import Current
from spheremark.service.serialise.solution import survey_result
from spheremark.web.pages.result import result_page

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

_COUNTS = """
SELECT (SELECT count(*) FROM stops JOIN latest_runs USING (run_id) WHERE survey_id = $id)
        AS n_stops,
    (SELECT count(*) FROM control_marks WHERE survey_id = $id) AS n_control,
    (SELECT count(*) FROM adjustments WHERE survey_id = $id) AS n_networks,
    (SELECT count(*) FROM site_products WHERE survey_id = $id) AS n_products,
    (SELECT changed_at FROM control_changes WHERE survey_id = $id) AS control_changed_at
"""


@router.get("/surveys/{name:path}")
def result(name: str, service: Current, after: Annotated[int, Query(ge=0, le=10**9)] = 0) -> str:
    """Show the result of a survey."""
    found = survey_row(service, name)
    key, catalogue = {"id": found["survey_id"]}, service.catalogue
    return result_page(
        frame_of(service, found["name"], "result"),
        survey_result(catalogue, found["survey_id"]),
        after=after,
        tolerance_m=found["tolerance_m"],
        counts=catalogue.computed(
            ("counts", found["survey_id"]), lambda: catalogue.rows(_COUNTS, key)[0]
        ),
        n_logs=len(catalogue.recordings_of_survey(found["survey_id"])),
        sample=service.samples.message(found["survey_id"]),
        jobs=newest_jobs(service, survey=found["survey_id"], is_active=True),
    )
