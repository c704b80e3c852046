"""Pages of jobs and recordings."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from fastapi import APIRouter
from fastapi.responses import HTMLResponse

from spheremark.pipelines.errors import NotFoundError
from spheremark.service.http.pages.frame import frame_of
from spheremark.service.http.state import Current, Service
from spheremark.web.templating import render

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
    return render("jobs.html", frame=frame_of(service), jobs=newest_jobs(service))


@router.get("/jobs/{job_id}")
def job(job_id: str, service: Current) -> str:
    """Show one job with its stops, and its results on the whole survey."""
    found = newest_jobs(service, job=job_id)
    if not found:
        raise NotFoundError(f"There is no job {job_id!r}.")
    rows, key = service.catalogue.rows, {"id": job_id}
    return render(
        "job.html",
        frame=frame_of(service, found[0]["survey"]),
        job=found[0],
        stops=rows(_JOB_STOPS, key),
        made=rows(_JOB_MADE, key),
        config=json.dumps(json.loads(found[0]["config"]), indent=2),
        options=json.loads(found[0]["options"] or "{}"),
    )


@router.get("/recordings/{recording_id}")
def recording(recording_id: str, service: Current) -> str:
    """Show one recording: its preflight report and its jobs."""
    found = service.row(_RECORDING, recording_id, "recording")
    preflight, own = json.loads(found["preflight"]), newest_jobs(service, recording=recording_id)
    shown = {"recording": found, "preflight": preflight, "jobs": own}
    return render("recording.html", frame=frame_of(service), **shown)


def newest_jobs(
    service: Service, *, is_active: bool = False, **of: str
) -> Sequence[Mapping[str, Any]]:
    """Return the newest jobs; of one ``job``, ``recording`` or ``survey`` if named by its id."""
    named = {"job": None, "recording": None, "survey": None} | of
    return service.catalogue.rows(_JOBS, named | {"is_active": is_active, "n": _N_JOBS})
