"""Plans: a field, stops, marks and a model are assembled, evaluated and optimised."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from spheremark.pipelines import placement
from spheremark.pipelines.errors import InputError
from spheremark.pipelines.model import Array
from spheremark.pipelines.placement import (
    Arrangement,
    Candidates,
    CentreModel,
    Costs,
    FieldMap,
    Goal,
    PlaceRules,
    Report,
    Requirement,
    Sensor,
    Site,
    Stops,
)
from spheremark.pipelines.progress import checkpoint
from spheremark.service.planning.centre_models import Query, model_of
from spheremark.service.planning.requests import (
    Ground,
    Place,
    Plan,
    VisibilityCache,
    ground_on,
    marks_at,
    simulated_ground,
    stops_at,
)
from spheremark.service.serialise.plans import (
    Plain,
    evaluation_json,
    map_json,
    optimum_json,
    proposal_json,
    trade_off_json,
)
from spheremark.storage.imports.plan_files import read_keep_out, read_stops
from spheremark.storage.imports.terrain import read_terrain

_PAIRS_MAX = 250_000  # of places and marks at once; 100 MB or so
_SEED = 0  # of the optimiser's later starts


def read_ground(
    scenario: str,
    terrain: Path | None,
    stops: Path | None,
    *,
    keep_out: Path | None = None,
    poles: tuple[float, float] | None = None,
) -> Ground:
    """Return a simulated field or a terrain, with the stops, polygons and poles given."""
    if terrain is None:
        ground = simulated_ground(scenario)
    else:
        ground = ground_on(str(terrain), read_terrain(terrain))
    site = ground.site
    if keep_out is not None:
        site = replace(site, keep_out=(*site.keep_out, *read_keep_out(keep_out)))
    if poles is not None:
        site = replace(site, pole_heights=poles)
    ground = replace(ground, site=site)
    return ground if stops is None else replace(ground, stops=_stops(ground, stops))


def _stops(ground: Ground, path: Path) -> Stops:
    """Return the stops of a file; without a height the LiDAR stands on its mast."""
    names, p_site = read_stops(path)
    found = stops_at(ground.site, [(n, x, y) for n, (x, y, _) in zip(names, p_site, strict=True)])
    heights = np.where(np.isfinite(p_site[:, 2]), p_site[:, 2], found.p_site[:, 2])
    low = heights < found.p_site[:, 2] - ground.site.mast
    if low.any():
        name = names[int(np.flatnonzero(low)[0])]
        raise InputError(f"Stop {name} is under the ground; leave out its z or correct it.")
    return Stops(names=names, p_site=np.column_stack([p_site[:, :2], heights]))


def assemble(
    ground: Ground,
    marks: Arrangement | None,
    sensor: Sensor,
    requirement: Requirement,
    query: Query | None,
    survey: str,
) -> Plan:
    """Return a plan on its ground, with the model of the results that can be queried."""
    radius = ground.site.marker_radius
    places = () if marks is None else zip(marks.names, marks.p_site.tolist(), strict=True)
    standing = [Place(name, p[0], p[1], z=p[2]) for name, p in places]
    placement.check_sizes(len(ground.stops.names), len(standing))
    return Plan(
        ground=ground,
        stops=ground.stops,
        marks=marks_at(ground.site, standing),
        model=model_of(query, sensor, radius, survey),
        requirement=requirement,
    )


def evaluate(plan: Plan, cache: VisibilityCache | None = None) -> Plain:
    """Return the predicted accuracy of an arrangement at its stops."""
    site, stops, marks = plan.ground.site, plan.stops, plan.marks
    visibility = None if cache is None else cache.find(plan.ground, stops.p_site, marks)
    checkpoint()
    found = placement.evaluate(
        site, stops, marks, plan.model, plan.requirement, visibility=visibility
    )
    after = placement.worst_after_loss(site, found, plan.model, visibility=visibility)
    return evaluation_json(site, plan.model, found, after)


def require_small(plan: Plan) -> None:
    """Refuse a plan whose evaluation takes more memory than a request may."""
    n_stops, n_marks = len(plan.stops.names), len(plan.marks.names)
    placement.check_sizes(n_stops, n_marks)
    if n_stops * n_marks > _PAIRS_MAX:
        raise InputError(
            f"{n_stops:,} stops and {n_marks:,} marks are {n_stops * n_marks:,} pairs; a request "
            f"takes {_PAIRS_MAX:,}. Evaluate parts of the field, or use `spheremark plan evaluate`."
        )


def evaluate_field(
    plan: Plan, n_across: int, cache: VisibilityCache, viewshed_of: str | None = None
) -> Plain:
    """Return the predicted accuracy on a grid over the part of the field that a map shows.

    With it, where the mark of a name is found from.
    """
    x0, y0, x1, y1 = plan.ground.view
    step = max(x1 - x0, y1 - y0) / n_across
    xs, ys = (np.arange(a + step / 2, b, step) for a, b in ((x0, x1), (y0, y1)))
    n_lines = max(1, _PAIRS_MAX // (max(1, len(plan.marks.names)) * len(xs)))
    parts = [
        _part_of_map(plan, xs, ys[first : first + n_lines], cache)
        for first in range(0, len(ys), n_lines)
    ]
    layers = ("ys", "sigma_3d", "probability", "n_seen", "is_seen")
    joined = {name: np.concatenate([getattr(one, name) for one in parts]) for name in layers}
    names = plan.marks.names
    mark = names.index(viewshed_of) if viewshed_of in names else None
    return map_json(replace(parts[0], **joined), mark)


def _part_of_map(plan: Plan, xs: Array, ys: Array, cache: VisibilityCache) -> FieldMap:
    """Return some lines of a map."""
    site = plan.ground.site
    stations, _ = placement.map_stations(site, xs, ys)
    visibility = cache.find(plan.ground, stations, plan.marks)
    checkpoint()
    return placement.field_map(
        site, xs, ys, plan.marks, plan.model, plan.requirement, visibility=visibility
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Aim:
    """What a search is for: rules of places, goal, costs, and whether the plan's marks stay."""

    rules: PlaceRules = field(default_factory=PlaceRules)
    goal: Goal = field(default_factory=Goal)
    costs: Costs = field(default_factory=Costs)
    keeps_marks: bool = False


def optimise(plan: Plan, aim: Aim, report: Report | None = None) -> Plain:
    """Return the best places, and how near they are to the bound."""
    site, given = plan.ground.site, _given(plan, aim)
    rng, standing = np.random.default_rng(_SEED), plan.marks if aim.keeps_marks else None
    found = placement.optimise(*given, aim.goal, rng, standing=standing, report=report)
    evaluation = evaluation_json(site, plan.model, found.evaluation, found.worst_after_loss)
    return evaluation | optimum_json(found, aim.goal, aim.costs)


def trade_off(
    plan: Plan,
    aim: Aim,
    numbers: Sequence[int],
    weights: Sequence[float],
    report: Report | None = None,
) -> Plain:
    """Return the best plans of several numbers of marks, and of several weights of a loss."""
    found = placement.trade_off(
        *_given(plan, aim),
        aim.goal,
        np.random.default_rng(_SEED),
        numbers=numbers,
        weights=weights,
        standing=plan.marks if aim.keeps_marks else None,
        report=report,
    )
    return trade_off_json(plan.ground.site, plan.model, found, aim.goal, aim.costs)


def _given(plan: Plan, aim: Aim) -> tuple[Site, Stops, Candidates, CentreModel, Requirement]:
    """Return what a search takes, checked."""
    site, stops = plan.ground.site, plan.stops
    placement.check_sizes(len(stops.names), aim.goal.n_marks or 0)
    candidates = placement.find_candidates(site, stops, aim.rules)
    return site, stops, candidates, plan.model, plan.requirement


def suggest(plan: Plan, rules: PlaceRules | None = None) -> Plain:
    """Return the one more mark that would help most."""
    site, stops = plan.ground.site, plan.stops
    placement.check_sizes(len(stops.names), len(plan.marks.names) + 1)
    candidates = placement.find_candidates(site, stops, rules or PlaceRules())
    found = placement.propose_mark(
        site, stops, plan.marks, candidates, plan.model, plan.requirement
    )
    return proposal_json(site, found)
