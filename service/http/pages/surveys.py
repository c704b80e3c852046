"""Pages of results: the overview, the dashboard of a survey, and its stops."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse

from spheremark.pipelines.errors import NotFoundError
from spheremark.service.http.pages.frame import address_of, frame_of
from spheremark.service.http.pages.jobs import newest_jobs
from spheremark.service.http.state import Current, Service
from spheremark.storage.clouds import stop as clouds
from spheremark.web.columns import Columns, texts
from spheremark.web.figures import scene
from spheremark.web.pages.filters import Filters
from spheremark.web.pages.stop import stop_page
from spheremark.web.pages.survey import SurveyData, overview_page, survey_page

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

_N_RECORDINGS = 50
_N_POINTS = 250_000  # of a cloud; the page thins them further
_NEWEST_SURVEY = """
SELECT s.name FROM runs AS r JOIN surveys AS s USING (survey_id)
ORDER BY r.finished_at DESC LIMIT 1
"""
_SURVEYS = """
SELECT s.name, s.tolerance_m, s.created_at,
    (SELECT count(*) FROM control_marks AS c WHERE c.survey_id = s.survey_id) AS n_control_marks,
    (SELECT count(*) FROM true_stops AS t WHERE t.survey_id = s.survey_id) AS n_true_stops,
    (SELECT count(DISTINCT x.stop) FROM stops AS x JOIN latest_runs AS r USING (run_id)
        WHERE r.survey_id = s.survey_id) AS n_stops,
    (SELECT sqrt(avg(f.sigma_3d_m ^ 2)) FROM latest_station_fixes AS f
        WHERE f.survey_id = s.survey_id AND f.fit_method = 'along_beam') AS station_sigma_rms_m,
    (SELECT sqrt(avg(f.error_3d_m ^ 2)) FROM latest_station_fixes AS f
        WHERE f.survey_id = s.survey_id AND f.fit_method = 'along_beam') AS station_error_rms_m
FROM surveys AS s ORDER BY s.created_at DESC, s.name
"""
_RECORDINGS = """
SELECT recording_id, name, size_bytes, uploaded_at, verdict
FROM recordings ORDER BY uploaded_at DESC, recording_id LIMIT $n
"""
_N_ACTIVE = "SELECT count(*) AS n FROM jobs WHERE status IN ('accepted', 'running')"
_SURVEY = """
SELECT survey_id, name, tolerance_m, rig_digest FROM surveys WHERE name = $id OR survey_id = $id
"""
_MARKS = "SELECT mark, x_m, y_m, z_m FROM control_marks WHERE survey_id = $id ORDER BY mark"
_TRUE_STOPS = "SELECT stop, x_m, y_m, z_m FROM true_stops WHERE survey_id = $id ORDER BY stop"
_FITS = """
SELECT m.stop, m.fit_method, m.marker, m.mark, m.status, m.reason, m.range_m, m.n_points,
    m.sigma_3d_m, m.error_3d_m,
    sqrt(greatest(0, m.sigma_3d_m ^ 2
        - (radians(x.sigma_heading_deg) * m.range_m * cos(radians(m.elevation_deg))) ^ 2) / 3)
        AS sigma_axis_m
FROM latest_marker_fits AS m JOIN stops AS x USING (run_id, stop)
WHERE survey_id = $id ORDER BY m.stop, m.fit_method, m.marker
"""
_FIXES = """
SELECT stop, fit_method, resection_method, status, reason, x_m, y_m, z_m, sigma_3d_m,
    sqrt(cov_xx_m2 + cov_yy_m2) AS sigma_horizontal_m,
    ellipse_major_95_m, ellipse_minor_95_m, ellipse_bearing_deg, n_markers,
    included_angle_min_deg, included_angle_max_deg, error_horizontal_m, error_3d_m
FROM latest_station_fixes WHERE survey_id = $id ORDER BY stop, fit_method
"""
_SUBSETS = """
SELECT x.stop, x.fit_method, x.marks, x.included_angle_deg, x.included_angle_max_deg,
    x.sigma_horizontal_m, x.error_horizontal_m
FROM resections AS x JOIN latest_runs AS r USING (run_id)
WHERE r.survey_id = $id AND x.n_marks = $n_marks AND x.resection_method = $resection
ORDER BY x.stop, x.fit_method, x.marks
"""
_SUBSET_METHODS = """
SELECT DISTINCT x.resection_method FROM resections AS x JOIN latest_runs AS r USING (run_id)
WHERE r.survey_id = $id ORDER BY x.resection_method
"""
_STOP_NAMES = """
SELECT DISTINCT x.stop FROM stops AS x JOIN latest_runs AS r USING (run_id)
WHERE r.survey_id = $id ORDER BY x.stop
"""
_STOP = """
SELECT x.*, r.job_id, r.recording_id, c.name AS recording, r.finished_at, r.code_version,
    r.config_digest, r.rig_digest
FROM stops AS x JOIN latest_runs AS r USING (run_id) JOIN recordings AS c USING (recording_id)
WHERE r.survey_id = $id AND x.stop = $stop ORDER BY r.finished_at DESC
"""
_STOP_METHODS = """
SELECT DISTINCT fit_method FROM (
    SELECT fit_method, run_id, stop FROM marker_fits UNION ALL
    SELECT fit_method, run_id, stop FROM station_fixes UNION ALL
    SELECT fit_method, run_id, stop FROM rejections
) WHERE run_id = $run AND stop = $stop ORDER BY fit_method
"""
_STOP_FITS = """
SELECT * FROM marker_fits
WHERE run_id = $run AND stop = $stop AND fit_method = $method ORDER BY marker
"""
_STOP_REJECTIONS = """
SELECT * FROM rejections
WHERE run_id = $run AND stop = $stop AND fit_method = $method ORDER BY n_points DESC
"""
_STOP_FIXES = "SELECT * FROM station_fixes WHERE run_id = $run AND stop = $stop ORDER BY fit_method"
_STOP_OBSERVATIONS = """
SELECT o.*,
    sqrt(m.cov_xx_m2 * cos(radians(f.yaw_deg)) ^ 2 + m.cov_yy_m2 * sin(radians(f.yaw_deg)) ^ 2
        - 2 * m.cov_xy_m2 * sin(radians(f.yaw_deg)) * cos(radians(f.yaw_deg))) AS sigma_x_m,
    sqrt(m.cov_xx_m2 * sin(radians(f.yaw_deg)) ^ 2 + m.cov_yy_m2 * cos(radians(f.yaw_deg)) ^ 2
        + 2 * m.cov_xy_m2 * sin(radians(f.yaw_deg)) * cos(radians(f.yaw_deg))) AS sigma_y_m,
    sqrt(m.cov_zz_m2) AS sigma_z_m
FROM observations AS o
JOIN marker_fits AS m USING (run_id, stop, fit_method, marker)
JOIN station_fixes AS f USING (run_id, stop, fit_method, resection_method)
WHERE o.run_id = $run AND o.stop = $stop AND o.fit_method = $method ORDER BY o.marker
"""
_ADJUSTMENTS = """
SELECT a.adjustment_id, a.datum, a.status, a.n_stations, a.n_marks, a.passes_global_test, a.sigma0,
    a.finished_at,
    (SELECT sqrt(avg(x.sigma_3d_m ^ 2)) FROM adjusted_stations AS x
        WHERE x.adjustment_id = a.adjustment_id) AS station_sigma_rms_m,
    (SELECT sqrt(avg(x.difference_3d_m ^ 2)) FROM control_checks AS x
        WHERE x.adjustment_id = a.adjustment_id) AS control_rms_m
FROM adjustments AS a WHERE a.survey_id = $id ORDER BY a.finished_at DESC LIMIT $n
"""
_CALIBRATIONS = """
SELECT calibration_id, rig_digest, len(stops) AS n_stops, gap_rms_before_m, gap_rms_after_m,
    finished_at
FROM calibrations WHERE survey_id = $id ORDER BY finished_at DESC LIMIT $n
"""
_STOP_TABLES = {
    "fits": _STOP_FITS,
    "rejections": _STOP_REJECTIONS,
    "observations": _STOP_OBSERVATIONS,
}
_N_RESULTS = 20  # networks and calibrations in the page of their survey


@router.get("/")
def overview(request: Request, service: Current) -> str:
    """Show what there is and how to bring more."""
    rows = service.catalogue.rows
    newest = rows(_NEWEST_SURVEY)
    return overview_page(
        frame_of(service),
        _survey_data(service, _survey(service, newest[0]["name"]), Filters()) if newest else None,
        address=address_of(request),
        surveys=rows(_SURVEYS),
        recordings=rows(_RECORDINGS, {"n": _N_RECORDINGS}),
        n_active_jobs=rows(_N_ACTIVE)[0]["n"],
    )


@router.get("/surveys/{name:path}/stops/{stop:path}")
def stop(
    name: str,
    stop: str,
    service: Current,
    method: Annotated[str, Query()] = "",
    marker: Annotated[str, Query()] = "",
    recording: Annotated[str, Query()] = "",
) -> str:
    """Show one stop; where several logs have one of this name, that of the newest results."""
    survey, rows = _survey(service, name), service.catalogue.rows
    found = rows(_STOP, {"id": survey["survey_id"], "stop": stop})
    if not found:
        raise NotFoundError(f"The survey {survey['name']} has no results of a stop {stop!r}.")
    shown = next((row for row in found if row["recording_id"] == recording), found[0])
    key = {"run": shown["run_id"], "stop": shown["stop"]}
    methods = [one["fit_method"] for one in rows(_STOP_METHODS, key)]
    chosen = method if method in methods else next(iter(methods), "")
    columns, by_method = service.catalogue.columns, key | {"method": chosen}
    return stop_page(
        frame_of(service, survey["name"]),
        shown,
        {name: columns(sql, by_method) for name, sql in _STOP_TABLES.items()},
        _scan(shown["cloud_url"]),
        tolerance_m=survey["tolerance_m"],
        stops=[one["stop"] for one in rows(_STOP_NAMES, {"id": survey["survey_id"]})],
        method=chosen,
        methods=methods,
        marker=marker,
        fixes=rows(_STOP_FIXES, key),
        namesakes=found if len(found) > 1 else (),
    )


@router.get("/surveys/{name:path}")
def survey(name: str, request: Request, service: Current) -> str:
    """Show the dashboard of a survey."""
    found, rows = _survey(service, name), service.catalogue.rows
    query = {key: request.query_params.getlist(key) for key in request.query_params}
    filters = Filters.from_query(query)
    key = {"id": found["survey_id"], "n": _N_RESULTS}
    return survey_page(
        frame_of(service, found["name"]),
        _survey_data(service, found, filters),
        filters,
        adjustments=rows(_ADJUSTMENTS, key),
        calibrations=rows(_CALIBRATIONS, key),
        rig_digest=found["rig_digest"],
        jobs=newest_jobs(service, survey=found["survey_id"], is_active=True),
        address=address_of(request),
        n_logs=len(service.catalogue.recordings_of_survey(found["survey_id"])),
    )


def _survey(service: Service, key: str) -> Mapping[str, Any]:
    """Return the survey of that name or id."""
    return service.row(_SURVEY, key, "survey")


def _survey_data(service: Service, survey: Mapping[str, Any], filters: Filters) -> SurveyData:
    """Return the newest results of a survey, with stations from the chosen number of marks."""
    few = {"n_marks": filters.n_marks, "resection": filters.resection}

    def columns(sql: str, **more: object) -> Columns:
        return service.catalogue.columns(sql, {"id": survey["survey_id"], **more})

    return SurveyData(
        name=survey["name"],
        tolerance_m=survey["tolerance_m"],
        marks=columns(_MARKS),
        true_stops=columns(_TRUE_STOPS),
        fits=columns(_FITS),
        fixes=columns(_FIXES),
        subsets=columns(_SUBSETS, **few),
        subset_methods=tuple(texts(columns(_SUBSET_METHODS), "resection_method")),
    )


def _scan(url: str | None) -> scene.Scan | None:
    """Read the cloud of a stop, if it was kept and is still there."""
    if url is None:
        return None
    try:
        cloud = clouds.read_cloud(url, n_max=_N_POINTS)
    except NotFoundError:
        return None
    return scene.Scan(
        p_station=cloud.p_station,
        markers=cloud.markers,
        residuals=cloud.residuals,
        names=cloud.names,
        fit_method=cloud.fit_method,
    )
