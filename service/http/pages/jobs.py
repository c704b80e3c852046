"""Pages of jobs and recordings."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse

from spheremark.pipelines.errors import NotFoundError
from spheremark.pipelines.stop_decisions import is_good_enough
from spheremark.service.http.pages.frame import address_of, frame_of
from spheremark.service.http.state import Current, Service
from spheremark.web.pages.recording import recording_page
from spheremark.web.templating import render

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

_N_JOBS = 100  # in one page; the API lists all
_JOBS = """
SELECT j.*, s.name AS survey, r.name AS recording, d.survey_id IS NOT NULL AS is_of_deleted
FROM jobs AS j JOIN surveys AS s USING (survey_id) LEFT JOIN recordings AS r USING (recording_id)
LEFT JOIN deleted_surveys AS d ON d.survey_id = j.survey_id
WHERE ($job IS NULL AND d.survey_id IS NULL OR j.job_id = $job)
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
_N_LIVE, _N_LIVE_STOPS = 30, 12  # jobs, and stops of each, on the page of live stops
_LIVE = """
SELECT j.job_id, j.status, j.progress_percent, j.message, j.error_reason, j.created_at,
    j.recording_id, c.name AS recording, s.name AS survey, s.tolerance_m
FROM jobs AS j JOIN surveys AS s USING (survey_id) JOIN recordings AS c USING (recording_id)
WHERE j.kind = 'process' AND survey_id NOT IN (SELECT survey_id FROM deleted_surveys)
ORDER BY j.created_at DESC, j.job_id LIMIT $n
"""
_LIVE_STOPS = """
SELECT r.job_id, x.stop, count(*) OVER (PARTITION BY r.job_id) AS n_stops, f.status,
    f.sigma_3d_m, f.cov_xx_m2, f.cov_xy_m2, f.cov_xz_m2, f.cov_yy_m2, f.cov_yz_m2, f.cov_zz_m2
FROM stops AS x JOIN runs AS r USING (run_id)
LEFT JOIN station_fixes AS f ON f.run_id = x.run_id AND f.stop = x.stop
    AND f.fit_method = 'along_beam' AND f.resection_method = 'free_station'
WHERE list_contains($jobs, r.job_id)
QUALIFY row_number() OVER (PARTITION BY r.job_id ORDER BY x.stop) <= $n_stops ORDER BY x.stop
"""
_RECORDING = """
SELECT recording_id, name, size_bytes, uploaded_at, verdict, preflight
FROM recordings WHERE recording_id = $id
"""


@router.get("/jobs")
def jobs(service: Current) -> str:
    """Show the newest jobs."""
    return render("jobs.html", frame=frame_of(service), jobs=newest_jobs(service))


@router.get("/live")
def live(request: Request, service: Current) -> str:
    """Show the stops as they come, newest first, each with its decision."""
    rows = service.catalogue.rows
    found = [dict(row) for row in rows(_LIVE, {"n": _N_LIVE})]
    by_job = {one["job_id"]: one | {"stops": []} for one in found}
    for stop in rows(_LIVE_STOPS, {"jobs": list(by_job), "n_stops": _N_LIVE_STOPS}):
        job = by_job[stop["job_id"]]
        job["stops"].append({**stop, "grade": _grade(stop, job["tolerance_m"])})
    shown = {"jobs": list(by_job.values()), "address": address_of(request)}
    return render("live.html", frame=frame_of(service), **shown)


def _grade(stop: Mapping[str, Any], tolerance: float) -> str:
    """Return the decision on a stop: good enough, not good enough, or without a position."""
    if stop["sigma_3d_m"] is None:
        return "no position"
    xx, xy, xz, yy, yz, zz = (stop[f"cov_{ij}_m2"] for ij in ("xx", "xy", "xz", "yy", "yz", "zz"))
    cov = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    is_good = is_good_enough(stop["status"], cov, tolerance)
    return "good enough" if is_good else "not good enough"


@router.get("/jobs/{job_id}")
def job(job_id: str, service: Current) -> str:
    """Show one job with its stops, and its results on the whole survey."""
    found = newest_jobs(service, job=job_id)
    if not found:
        raise NotFoundError(f"There is no job {job_id!r}.")
    rows, key = service.catalogue.rows, {"id": job_id}
    is_of_deleted = found[0]["is_of_deleted"]
    return render(
        "job.html",
        frame=frame_of(service, "" if is_of_deleted else found[0]["survey"]),
        job=found[0],
        stops=[] if is_of_deleted else rows(_JOB_STOPS, key),
        made=[] if is_of_deleted else rows(_JOB_MADE, key),
        config=json.dumps(json.loads(found[0]["config"]), indent=2),
        options=json.loads(found[0]["options"] or "{}"),
    )


@router.get("/recordings/{recording_id}")
def recording(recording_id: str, service: Current) -> str:
    """Show one recording: its preflight report and its jobs."""
    found = service.row(_RECORDING, recording_id, "recording")
    frame = frame_of(service)
    jobs = newest_jobs(service, recording=recording_id)
    return recording_page(frame, found, json.loads(found["preflight"]), jobs, frame.surveys)


def newest_jobs(
    service: Service, *, is_active: bool = False, **of: str
) -> Sequence[Mapping[str, Any]]:
    """Return the newest jobs; of one ``job``, ``recording`` or ``survey`` if named by its id."""
    named = {"job": None, "recording": None, "survey": None} | of
    return service.catalogue.rows(_JOBS, named | {"is_active": is_active, "n": _N_JOBS})
