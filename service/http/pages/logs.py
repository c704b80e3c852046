"""The tab of a survey with its logs, its control and its settings."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse

from spheremark.service.http.pages.frame import address_of, frame_of, survey_row
from spheremark.service.http.state import Current
from spheremark.web.pages.base import Part
from spheremark.web.templating import render

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

_LOGS = """
SELECT r.recording_id, r.name, r.size_bytes, r.uploaded_at, r.verdict,
    j.job_id, j.status AS job_status, coalesce(j.error_reason, j.message) AS job_message,
    j.progress_percent, n.finished_at AS processed_at,
    (SELECT count(*) FROM stops AS x WHERE x.run_id = n.run_id) AS n_stops
FROM recordings AS r
LEFT JOIN (
    SELECT * FROM jobs WHERE survey_id = $id AND kind = 'process'
    QUALIFY row_number() OVER (PARTITION BY recording_id ORDER BY created_at DESC) = 1
) AS j USING (recording_id)
LEFT JOIN (SELECT * FROM latest_runs WHERE survey_id = $id) AS n USING (recording_id)
WHERE list_contains($recordings::VARCHAR[], r.recording_id)
ORDER BY r.uploaded_at, r.name LIMIT $n OFFSET $after
"""
_ROWS = 60  # logs in one part of the table
_REMOVED = """
SELECT r.recording_id, r.name, x.removed_at
FROM removed_recordings AS x JOIN recordings AS r USING (recording_id)
WHERE x.survey_id = $id ORDER BY x.removed_at DESC LIMIT $n
"""


@router.get("/surveys/{name:path}/logs")
def logs(
    name: str,
    request: Request,
    service: Current,
    after: Annotated[int, Query(ge=0, le=10**9)] = 0,
) -> str:
    """Show the logs of a survey, with what to do with them, its control and its name."""
    found, catalogue = survey_row(service, name), service.catalogue
    key = {"id": found["survey_id"]}
    recordings = list(catalogue.recordings_of_survey(found["survey_id"]))
    return render(
        "logs.html",
        frame=frame_of(service, found["name"], "logs"),
        survey=found,
        control=catalogue.control_marks(found["survey_id"]),
        logs=catalogue.rows(_LOGS, key | {"recordings": recordings, "n": _ROWS, "after": after}),
        part=Part(after, _ROWS, len(recordings)),
        removed=catalogue.rows(_REMOVED, key | {"n": _ROWS}),
        address=address_of(request),
    )
