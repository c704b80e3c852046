"""The tab of a survey with its stops, and the page of one stop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from fastapi import APIRouter, Query
from fastapi.responses import HTMLResponse

from spheremark.pipelines.errors import NotFoundError
from spheremark.service.http.pages.frame import frame_of, survey_row
from spheremark.service.http.state import Current, Service
from spheremark.storage.catalogue.rows import natural
from spheremark.storage.clouds import stop as clouds
from spheremark.web.figures import scene
from spheremark.web.pages.base import Part
from spheremark.web.pages.stop import stop_page, stops_page

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

_N_POINTS = 250_000  # of a cloud; the page thins them further
_STOPS = """
SELECT f.*, c.solution, c.x_m, c.y_m, c.z_m, c.sigma_3d_m AS station_sigma_3d_m,
    c.status AS station_status, c.reason AS station_reason,
    c.passes_global_test, c.error_3d_m AS station_error_3d_m
FROM (
    SELECT r.survey_id, r.recording_id, x.stop, x.run_id, x.notes,
        count(m.marker) AS n_markers, count(m.mark) AS n_on_marks,
        count(m.marker) FILTER (m.status <> 'ok') AS n_weak, avg(m.range_m) AS range_mean_m,
        sqrt(avg(m.sigma_3d_m ^ 2)) AS sigma_rms_m, sqrt(avg(m.error_3d_m ^ 2)) AS error_rms_m,
        max(m.error_3d_m) AS error_max_m
    FROM stops AS x JOIN latest_runs AS r USING (run_id)
    LEFT JOIN marker_fits AS m
        ON m.run_id = x.run_id AND m.stop = x.stop AND m.fit_method = coalesce(
            (SELECT fit_method FROM chosen_solutions WHERE survey_id = $id), 'along_beam')
    WHERE r.survey_id = $id GROUP BY ALL
) AS f
LEFT JOIN chosen_stations AS c
    ON c.survey_id = f.survey_id AND c.recording_id = f.recording_id AND c.stop = f.stop
ORDER BY {natural}, f.recording_id LIMIT $n OFFSET $after
""".replace("{natural}", natural("f.stop"))
_N_STOPS = "SELECT count(*) AS n FROM stops JOIN latest_runs USING (run_id) WHERE survey_id = $id"
_ROWS = 100  # stops in one part of the table
_STOP_NAMES = """
SELECT x.stop FROM stops AS x JOIN latest_runs AS r USING (run_id)
WHERE r.survey_id = $id GROUP BY x.stop ORDER BY {natural}
""".replace("{natural}", natural("x.stop"))
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
_CHOSEN = """
SELECT solution, adjustment_id, fit_method, station, x_m, y_m, z_m, sigma_3d_m, passes_global_test
FROM chosen_stations WHERE recording_id = $recording AND stop = $stop AND survey_id = $id
"""
_IN_NETWORK = """
SELECT x.marker, x.used, x.w, a.w_limit
FROM adjusted_observations AS x JOIN adjustments AS a USING (adjustment_id)
WHERE x.adjustment_id = $id AND x.station = $station AND x.kind = 'centre'
"""
_EVIDENCE = """
SELECT e.mark, e.marker, e.finding, e.range_m, e.log_odds, e.reason, d.decision, d.is_used,
    d.probability, d.hypothesis
FROM mark_evidence AS e JOIN mark_decisions AS d USING (adjustment_id, mark)
WHERE e.adjustment_id = $id AND e.station = $station ORDER BY e.mark
"""
_STOP_TABLES = {
    "fits": _STOP_FITS,
    "rejections": _STOP_REJECTIONS,
    "observations": _STOP_OBSERVATIONS,
}


@router.get("/surveys/{name:path}/stops")
def stops(name: str, service: Current, after: Annotated[int, Query(ge=0, le=10**9)] = 0) -> str:
    """Show the stops of a survey by its chosen solution."""
    found, rows = survey_row(service, name), service.catalogue.rows
    key = {"id": found["survey_id"]}
    return stops_page(
        frame_of(service, found["name"], "stops"),
        rows(_STOPS, key | {"n": _ROWS, "after": after}),
        part=Part(after, _ROWS, rows(_N_STOPS, key)[0]["n"]),
        tolerance_m=found["tolerance_m"],
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
    survey, rows = survey_row(service, name), service.catalogue.rows
    found = rows(_STOP, {"id": survey["survey_id"], "stop": stop})
    if not found:
        raise NotFoundError(f"The survey {survey['name']} has no results of a stop {stop!r}.")
    shown = next((row for row in found if row["recording_id"] == recording), found[0])
    key = {"run": shown["run_id"], "stop": shown["stop"]}
    methods = [one["fit_method"] for one in rows(_STOP_METHODS, key)]
    chosen = method if method in methods else next(iter(methods), "")
    solution, network, evidence = _solution_of(service, survey["survey_id"], shown, chosen)
    columns, by_method = service.catalogue.columns, key | {"method": chosen}
    return stop_page(
        frame_of(service, survey["name"], "stops"),
        shown,
        {name: columns(sql, by_method) for name, sql in _STOP_TABLES.items()},
        _scan(shown["cloud_url"]),
        tolerance_m=survey["tolerance_m"],
        stops=[one["stop"] for one in rows(_STOP_NAMES, {"id": survey["survey_id"]})],
        method=chosen,
        methods=methods,
        marker=marker,
        fixes=rows(_STOP_FIXES, key),
        chosen=solution,
        network=network,
        evidence=evidence,
        namesakes=found if len(found) > 1 else (),
    )


def _solution_of(
    service: Service, survey_id: str, stop: Mapping[str, Any], method: str
) -> tuple[Mapping[str, Any] | None, Mapping[str, Mapping[str, Any]], Sequence[Mapping[str, Any]]]:
    """Return the station of a stop in the chosen solution, its markers and evidence in a network.

    There are none of a method whose centres the network does not use.
    """
    rows = service.catalogue.rows
    place = {"recording": stop["recording_id"], "stop": stop["stop"], "id": survey_id}
    found = rows(_CHOSEN, place)
    if not found or found[0]["adjustment_id"] is None or found[0]["fit_method"] != method:
        return next(iter(found), None), {}, ()
    names = {"id": found[0]["adjustment_id"], "station": found[0]["station"]}
    in_network = {row["marker"]: row for row in rows(_IN_NETWORK, names)}
    return found[0], in_network, rows(_EVIDENCE, names)


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
