"""Plans and their terrains as rows of the database.

A plan is a request with the predictions at each of its stops. The achieved accuracy is not stored:
the view ``placements`` reads it from the newest results of the plan's survey.
"""

from __future__ import annotations

import json
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
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
ORDER BY p.created_at DESC, p.placement_id LIMIT 1000
"""
_STOPS = "SELECT * FROM placements WHERE placement_id = $id"
_TERRAINS = "SELECT * FROM terrains ORDER BY uploaded_at DESC, terrain_id LIMIT 1000"
_TERRAIN = "SELECT * FROM terrains WHERE terrain_id = $id"
_KEEP_PLAN = "INSERT INTO plans BY NAME SELECT * FROM incoming"
_KEEP_STOPS = "INSERT INTO planned_stops BY NAME SELECT * FROM incoming"
_KEEP_TERRAIN = """
INSERT INTO terrains VALUES (?, ?, ?, ?, ?) ON CONFLICT DO UPDATE SET url = excluded.url
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedStop:
    """The prediction at one stop: a row of ``planned_stops``, whose comments define the columns."""

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
    """A plan to store: a row of ``plans``, whose comments define the columns, with its stops."""

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
    """Store a plan with its predictions and return its ``placement_id``."""
    placement_id = secrets.token_hex(8)
    row = {field.name: getattr(plan, field.name) for field in fields(plan)}
    row |= {
        "placement_id": placement_id,
        "marks": json.dumps(list(plan.marks)),
        "n_marks": len(plan.marks),
        "request": json_text(plan.request),
        "created_at": datetime.now(UTC),
    }
    del row["stops"]
    stops = [{"placement_id": placement_id, **asdict(stop)} for stop in plan.stops]
    with database.writing() as cursor:
        execute_on(cursor, _KEEP_PLAN, pa.Table.from_pylist([row]))
        execute_on(cursor, _KEEP_STOPS, pa.Table.from_pylist(stops))
    return placement_id


def list_plans(database: Database, survey: str | None = None) -> list[dict[str, Any]]:
    """Return plans, newest first, without their stops; of one survey (id or name) if given.

    Rows of ``plans`` with ``survey``, ``n_stops``, ``n_surveyed`` and ``worst_sigma_3d_m``.
    """
    return [_parsed(row) for row in database.rows(_PLANS, {"id": None, "survey": survey})]


def get_plan(database: Database, placement_id: str) -> dict[str, Any]:
    """Return a plan as ``list_plans`` does, with its rows of ``placements`` as ``stops``."""
    rows = database.rows(_PLANS, {"id": placement_id, "survey": None})
    if not rows:
        raise NotFoundError(f"There is no plan {placement_id!r}; GET /api/v1/plans lists them.")
    repeated = {*rows[0], "survey"} - {"sigma_3d_m", "run_id"}
    stops = [
        {key: value for key, value in row.items() if key not in repeated}
        for row in database.rows(_STOPS, {"id": placement_id})
    ]
    return _parsed(rows[0]) | {"stops": stops}


def keep_terrain(
    database: Database, digest: str, *, name: str, size_bytes: int, url: str
) -> dict[str, Any]:
    """Add an uploaded terrain and return its row; the same bytes twice keep their first name."""
    with database.writing() as cursor:
        cursor.execute(_KEEP_TERRAIN, [digest, name, size_bytes, url, datetime.now(UTC)])
    return get_terrain(database, digest)


def list_terrains(database: Database) -> list[dict[str, Any]]:
    """Return the uploaded terrains, newest first, as rows of ``terrains``."""
    return database.rows(_TERRAINS)


def get_terrain(database: Database, terrain_id: str) -> dict[str, Any]:
    """Return a terrain by the SHA-256 of its bytes, as a row of ``terrains``."""
    rows = database.rows(_TERRAIN, {"id": terrain_id})
    if not rows:
        raise NotFoundError(f"There is no terrain {terrain_id!r}; upload one to /api/v1/terrains.")
    return rows[0]


def _parsed(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row with its JSON parsed."""
    return dict(row) | {key: json.loads(row[key]) for key in ("marks", "request")}
