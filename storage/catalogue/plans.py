"""Plans and the terrains that they are made on, as rows of the database.

A plan is what was asked and what was promised at each of its stops. What came of it is not stored:
the view ``placements`` reads it from the newest results of the plan's survey.
"""

from __future__ import annotations

import json
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Any

import pyarrow as pa

from spheremark.pipelines.errors import NotFoundError
from spheremark.storage.catalogue.database import Database, execute_on
from spheremark.storage.catalogue.records import json_text

_PLANS = """
SELECT p.*, s.name AS survey,
    (SELECT count(*) FROM planned_stops AS x WHERE x.placement_id = p.placement_id) AS n_stops,
    (SELECT count(*) FROM placements AS y WHERE y.placement_id = p.placement_id
        AND y.run_id IS NOT NULL) AS n_surveyed,
    (SELECT max(coalesce(x.sigma_3d_m, 'inf'::DOUBLE)) FROM planned_stops AS x
        WHERE x.placement_id = p.placement_id) AS worst_sigma_3d_m
FROM plans AS p LEFT JOIN surveys AS s USING (survey_id)
WHERE ($id::VARCHAR IS NULL OR p.placement_id = $id)
    AND ($survey::VARCHAR IS NULL OR p.survey_id = $survey OR s.name = $survey)
ORDER BY p.created_at DESC, p.placement_id LIMIT $n
"""
_STOPS = "SELECT * FROM placements WHERE placement_id = $id"
_TERRAINS = "SELECT * FROM terrains ORDER BY uploaded_at DESC, terrain_id LIMIT $n"
_TERRAIN = "SELECT * FROM terrains WHERE terrain_id = $id"
_ENTER_TERRAIN = """
INSERT INTO terrains VALUES (?, ?, ?, ?, ?) ON CONFLICT DO UPDATE SET url = excluded.url
"""
_MOST = 1000  # of one list


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedStop:
    """What a plan promises at one stop.

    Attributes
    ----------
    stop : str
        Its name.
    place : int
        Its place in the plan, from 0.
    x_m, y_m, z_m : float
        Place of the LiDAR in the site frame [m].
    n_seen, n_used : int
        Marks that will be found, and those that carry the position.
    sigma_3d_m : float or None
        Predicted 3-D sigma; none where there is no position [m].
    probability_within_tolerance : float
        Predicted probability that the 3-D error is within the tolerance, 0 to 1.
    included_angle_min_deg, included_angle_max_deg : float or None
        Least and greatest angle between two used marks [deg].
    dop : float or None
        Dilution of precision.
    reason : str
        Why there is no position, or a weak one; empty when all is well.
    """

    stop: str
    place: int
    x_m: float
    y_m: float
    z_m: float
    n_seen: int
    n_used: int
    sigma_3d_m: float | None
    probability_within_tolerance: float
    included_angle_min_deg: float | None
    included_angle_max_deg: float | None
    dop: float | None
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class NewPlan:
    """A plan to keep.

    Attributes
    ----------
    name : str
        Given by people.
    survey_id : str or None
        Survey that it is for.
    site_name, resection_method : str
        Terrain, and how positions will be found.
    tolerance_m : float
        3-D error that is accepted [m].
    marks : sequence of mapping
        The arrangement, as JSON has it.
    model_version, model_source : str
        Which model of centres predicted.
    request : mapping
        All that was asked.
    stops : sequence of PlannedStop
        What it promises.
    """

    name: str
    survey_id: str | None
    site_name: str
    resection_method: str
    tolerance_m: float
    marks: Sequence[Mapping[str, Any]]
    model_version: str
    model_source: str
    request: Mapping[str, Any]
    stops: Sequence[PlannedStop]


def keep_plan(database: Database, plan: NewPlan) -> str:
    """Keep a plan with its promises.

    Parameters
    ----------
    database : Database
        Where.
    plan : NewPlan
        The plan.

    Returns
    -------
    str
        Its ``placement_id``.
    """
    placement_id = secrets.token_hex(8)
    row = [
        placement_id,
        plan.name,
        plan.survey_id,
        plan.site_name,
        plan.resection_method,
        plan.tolerance_m,
        json.dumps(list(plan.marks)),
        len(plan.marks),
        plan.model_version,
        plan.model_source,
        json_text(plan.request),
        datetime.now(UTC),
    ]
    stops = pa.Table.from_pylist(
        [{"placement_id": placement_id, **asdict(stop)} for stop in plan.stops]
    )
    with database.writing() as cursor:
        cursor.execute("INSERT INTO plans VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", row)
        execute_on(cursor, "INSERT INTO planned_stops BY NAME SELECT * FROM incoming", stops)
    return placement_id


def list_plans(database: Database, survey: str | None = None) -> list[dict[str, Any]]:
    """Return kept plans, newest first, without their stops.

    Parameters
    ----------
    database : Database
        Where they are.
    survey : str, optional
        Id or name of a survey: only its plans.

    Returns
    -------
    list of dict
        Rows of ``plans`` with ``survey``, ``n_stops``, ``n_surveyed`` and ``worst_sigma_3d_m``.
    """
    rows = database.rows(_PLANS, {"id": None, "survey": survey, "n": _MOST})
    return [_plain(row) for row in rows]


def get_plan(database: Database, placement_id: str) -> dict[str, Any]:
    """Return one plan with its stops, promised and achieved; NotFoundError if there is none.

    Parameters
    ----------
    database : Database
        Where it is.
    placement_id : str
        Which.

    Returns
    -------
    dict
        As ``list_plans``, with ``stops``: rows of ``placements``.
    """
    rows = database.rows(_PLANS, {"id": placement_id, "survey": None, "n": 1})
    if not rows:
        raise NotFoundError(f"There is no plan {placement_id!r}; GET /api/v1/plans lists them.")
    repeated = {*rows[0], "survey"}
    stops = database.rows(_STOPS, {"id": placement_id})
    kept = ("sigma_3d_m", "run_id")
    return _plain(rows[0]) | {
        "stops": [
            {key: value for key, value in row.items() if key not in repeated or key in kept}
            for row in stops
        ]
    }


def keep_terrain(
    database: Database, digest: str, *, name: str, size_bytes: int, url: str
) -> dict[str, Any]:
    """Enter a terrain that was uploaded; the same bytes twice are one terrain, with its first name.

    Parameters
    ----------
    database : Database
        Where.
    digest : str
        SHA-256 of the bytes, in hexadecimal.
    name : str
        Name of the file.
    size_bytes : int
        Length of the file.
    url : str
        Where its grid is.

    Returns
    -------
    dict
        The row of ``terrains``.
    """
    row = [digest, name, size_bytes, url, datetime.now(UTC)]
    with database.writing() as cursor:
        cursor.execute(_ENTER_TERRAIN, row)
    return get_terrain(database, digest)


def list_terrains(database: Database) -> list[dict[str, Any]]:
    """Return the terrains that were uploaded, newest first.

    Parameters
    ----------
    database : Database
        Where they are.

    Returns
    -------
    list of dict
        Rows of ``terrains``.
    """
    return database.rows(_TERRAINS, {"n": _MOST})


def get_terrain(database: Database, terrain_id: str) -> dict[str, Any]:
    """Return one terrain; NotFoundError if there is none.

    Parameters
    ----------
    database : Database
        Where it is.
    terrain_id : str
        SHA-256 of its bytes.

    Returns
    -------
    dict
        A row of ``terrains``.
    """
    rows = database.rows(_TERRAIN, {"id": terrain_id})
    if not rows:
        raise NotFoundError(f"There is no terrain {terrain_id!r}; upload one to /api/v1/terrains.")
    return rows[0]


def _plain(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row with its JSON read."""
    return dict(row) | {key: json.loads(row[key]) for key in ("marks", "request")}
