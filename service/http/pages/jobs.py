"""Pages of jobs and recordings."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse

from spheremark.pipelines.errors import NotFoundError
from spheremark.service.http.pages.frame import address_of, frame_of
from spheremark.service.http.state import Current, Service
from spheremark.web import pages

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

_N_JOBS = 100  # in one page; the API lists all
_JOBS = """
SELECT j.*, s.name AS survey, r.name AS recording
FROM jobs AS j JOIN surveys AS s USING (survey_id) LEFT JOIN recordings AS r USING (recording_id)
WHERE ($job IS NULL OR j.job_id = $job)
    AND ($recording IS NULL OR j.recording_id = $recording)
    AND ($survey IS NULL OR j.survey_id = $survey)
    AND (NOT $is_active OR j.status IN ('accepted', 'running'))
ORDER BY j.created_at DESC, j.job_id LIMIT $n
"""
_JOB_STOPS = """
SELECT x.stop, x.n_returns,
    (SELECT count(DISTINCT m.marker) FROM marker_fits AS m
        WHERE m.run_id = x.run_id AND m.stop = x.stop AND m.fit_method = 'along_beam') AS n_markers
FROM stops AS x JOIN runs AS r USING (run_id) WHERE r.job_id = $id ORDER BY x.stop
"""
_JOB_MADE = """
SELECT '/adjustments/' || adjustment_id AS address,
    'Network of ' || n_stations || ' stations and ' || n_marks || ' marks' AS what
FROM adjustments WHERE job_id = $id
UNION ALL
SELECT '/calibrations/' || calibration_id, 'Calibration of the gimbal'
FROM calibrations WHERE job_id = $id
"""
_RECORDING = """
SELECT recording_id, name, size_bytes, uploaded_at, verdict, preflight
FROM recordings WHERE recording_id = $id
"""


@router.get("/jobs")
def jobs(service: Current) -> str:
    """Show the newest jobs."""
    return pages.jobs_page(pages.JobsPage(frame=frame_of(service), jobs=newest_jobs(service)))


@router.get("/jobs/{job_id}")
def job(job_id: str, service: Current) -> str:
    """Show one job."""
    found = newest_jobs(service, job=job_id)
    if not found:
        raise NotFoundError(f"There is no job {job_id!r}.")
    stops = service.catalogue.rows(_JOB_STOPS, {"id": job_id})
    frame = frame_of(service, found[0]["survey"])
    made = service.catalogue.rows(_JOB_MADE, {"id": job_id})
    return pages.job_page(
        pages.JobPage(frame=frame, job=found[0], stops=tuple(stops), made=tuple(made))
    )


@router.get("/recordings/{recording_id}")
def recording(recording_id: str, request: Request, service: Current) -> str:
    """Show one recording."""
    found = service.catalogue.rows(_RECORDING, {"id": recording_id})
    if not found:
        raise NotFoundError(f"There is no recording {recording_id!r}.")
    return pages.recording_page(
        pages.RecordingPage(
            frame=frame_of(service),
            recording=found[0],
            preflight=json.loads(found[0]["preflight"]),
            jobs=newest_jobs(service, recording=recording_id),
            address=address_of(request),
        )
    )


def newest_jobs(
    service: Service,
    *,
    job: str | None = None,
    recording: str | None = None,
    survey: str | None = None,
    is_active: bool = False,
) -> tuple[Mapping[str, Any], ...]:
    """Return the newest jobs, of one recording or survey if named."""
    parameters = {"job": job, "recording": recording, "survey": survey, "is_active": is_active}
    return tuple(service.catalogue.rows(_JOBS, {**parameters, "n": _N_JOBS}))
