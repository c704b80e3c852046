"""Stops in one frame for the 3-D view: poses, spheres, refused groups, and clouds."""

from __future__ import annotations

from typing import Any

from spheremark.pipelines.errors import NotFoundError
from spheremark.service.http.state import Service
from spheremark.storage.catalogue.rows import natural
from spheremark.storage.clouds.octree import Octree, octree_of
from spheremark.web.links import stop_url

STOPS_MAX = 60  # in one scene
_REFUSED_MAX = 400
_STOPS = """
SELECT x.run_id, x.stop, x.cloud_url IS NOT NULL AS has_cloud, x.n_returns, r.recording_id
FROM stops AS x JOIN latest_runs AS r USING (run_id) JOIN surveys AS s USING (survey_id)
WHERE s.name = $survey AND (len($stops::VARCHAR[]) = 0 OR list_contains($stops::VARCHAR[], x.stop))
ORDER BY {natural}, r.finished_at DESC LIMIT $n
""".replace("{natural}", natural("x.stop"))
_COUNT = """
SELECT count(*) AS n FROM stops AS x JOIN latest_runs AS r USING (run_id)
    JOIN surveys AS s USING (survey_id) WHERE s.name = $survey
"""
_POSES = """
SELECT run_id, stop, x_m, y_m, z_m, rotation, solution FROM chosen_stations WHERE survey = $survey
"""
_SPHERES = """
SELECT m.run_id, m.stop, m.marker, m.mark, m.status, m.reason, m.x_m, m.y_m, m.z_m, m.radius_m,
    m.range_m, m.n_points, m.rms_m, m.sigma_3d_m, m.error_3d_m, m.probability, m.hypothesis
FROM latest_marker_fits AS m
WHERE m.survey = $survey AND m.fit_method = $method AND list_contains($runs::VARCHAR[], m.run_id)
ORDER BY m.stop, m.marker
"""
_REFUSED = """
SELECT x.run_id, x.stop, x.x_m, x.y_m, x.z_m, x.n_points, x.reason, x.probability, x.is_possible
FROM rejections AS x WHERE x.fit_method = $method AND list_contains($runs::VARCHAR[], x.run_id)
ORDER BY x.is_possible DESC, x.n_points DESC LIMIT $n
"""
_CLOUD = "SELECT cloud_url FROM stops WHERE run_id = $run AND stop = $stop"
_IDENTITY = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]


def scene_of(service: Service, survey: str, stops: list[str], method: str) -> dict[str, Any]:
    """Return the stops of a survey with their poses in one frame, by one fitting method.

    Poses are those of the chosen solution; a stop without one is shown in its own frame.
    """
    record = service.catalogue.get_survey(survey)
    rows = service.catalogue.rows
    found = rows(_STOPS, {"survey": record.name, "stops": stops, "n": STOPS_MAX})
    if not found:
        missing = f"results of a stop {stops[0]!r}" if stops else "results of stops"
        raise NotFoundError(f"The survey {record.name} has no {missing}.")
    known = rows(_POSES, {"survey": record.name})
    poses = {(one["run_id"], one["stop"]): one for one in known}
    key = {"runs": [one["run_id"] for one in found], "method": method}
    shown = {(one["run_id"], one["stop"]): i for i, one in enumerate(found)}
    spheres = rows(_SPHERES, {"survey": record.name, **key})
    refused = rows(_REFUSED, {**key, "n": _REFUSED_MAX})
    return {
        "survey": record.name,
        "method": method,
        "poses": known[0]["solution"] if known else "none: each stop is in its own frame",
        "n_stops": rows(_COUNT, {"survey": record.name})[0]["n"],
        "stops": [
            one
            | _pose(poses.get((one["run_id"], one["stop"])))
            | {"href": stop_url(record.name, one["stop"], method)}
            for one in found
        ],
        "spheres": [
            one
            | {"place": shown[one["run_id"], one["stop"]]}
            | {"href": stop_url(record.name, one["stop"], method, one["marker"])}
            for one in spheres
            if (one["run_id"], one["stop"]) in shown
        ],
        "refused": [
            one | {"place": shown[one["run_id"], one["stop"]]}
            for one in refused
            if (one["run_id"], one["stop"]) in shown
        ],
    }


def cloud_of(service: Service, run: str, stop: str) -> Octree:
    """Return the octree of a stop's cloud."""
    found = service.catalogue.rows(_CLOUD, {"run": run, "stop": stop})
    if not found or found[0]["cloud_url"] is None:
        raise NotFoundError(f"There is no cloud of a stop {stop!r} of a run {run!r}.")
    settings = service.settings
    return octree_of(found[0]["cloud_url"], settings.data / "octrees", settings.min_free_bytes)


def _pose(row: dict[str, Any] | None) -> dict[str, Any]:
    """Return the rotation, rows first, and the place of a station; its own frame without a pose."""
    if row is None:
        return {"has_pose": False, "rotation": _IDENTITY, "position_m": [0.0, 0.0, 0.0]}
    place = [row[f"{axis}_m"] for axis in "xyz"]
    return {"has_pose": True, "rotation": list(row["rotation"]), "position_m": place}
