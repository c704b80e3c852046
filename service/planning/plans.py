"""Plans from the command line: fields, marks and models put together, and what is found."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from spheremark.pipelines import placement
from spheremark.pipelines.errors import InputError
from spheremark.pipelines.placement import (
    Arrangement,
    Goal,
    Optimum,
    PlaceRules,
    Requirement,
    Sensor,
    Stops,
)
from spheremark.service.planning.centre_models import Ask, model_of_surveys
from spheremark.service.planning.requests import (
    Asked,
    Ground,
    Place,
    marks_at,
    simulated_ground,
    stops_at,
    terrain_ground,
)
from spheremark.service.serialise.plans import Plain, evaluation_json, marks_json
from spheremark.storage.imports.plan_files import read_keep_out, read_stops

_SEED = 0  # of the optimiser's later starts


@dataclass(frozen=True, slots=True, kw_only=True)
class Wanted:
    """What is asked of positions, and how the scans will be driven."""

    tolerance: float
    method: str
    sigma_marks: float
    turn: float
    rpm: float
    step: float = 0.0
    rest_revolutions: int = 3


def ground_of(
    scenario: str,
    seed: int,
    terrain: Path | None,
    stops: Path | None,
    *,
    keep_out: Path | None = None,
    poles: tuple[float, float] | None = None,
) -> Ground:
    """Return the field that was named, with the stops and rules that were given."""
    if terrain is None:
        ground = simulated_ground(f"{scenario}@{seed}")
    else:
        ground = terrain_ground(str(terrain), terrain.name, terrain)
    site = ground.site
    if keep_out is not None:
        site = replace(site, keep_out=(*site.keep_out, *read_keep_out(keep_out)))
    if poles is not None:
        site = replace(site, pole_heights=poles)
    ground = replace(ground, site=site)
    return ground if stops is None else replace(ground, stops=_stops(ground, stops))


def _stops(ground: Ground, path: Path) -> Stops:
    """Return stops of a file; where no height is given, the LiDAR stands on its mast."""
    names, p_site = read_stops(path)
    found = stops_at(ground.site, [(n, x, y) for n, (x, y, _) in zip(names, p_site, strict=True)])
    given = np.isfinite(p_site[:, 2])
    heights = np.where(given, p_site[:, 2], found.p_site[:, 2])
    low = heights < found.p_site[:, 2] - ground.site.mast
    if low.any():
        name = names[int(np.flatnonzero(low)[0])]
        raise InputError(f"Stop {name} is under the ground; leave its z out or mend it.")
    return Stops(names=names, p_site=np.column_stack([p_site[:, :2], heights]))


def put_together(
    ground: Ground, marks: Arrangement | None, wanted: Wanted, ask: Ask | None, survey: str
) -> Asked:
    """Return a plan that can be judged."""
    sensor = Sensor(
        turn=wanted.turn,
        spin_rpm=wanted.rpm,
        step=wanted.step,
        rest_revolutions=wanted.rest_revolutions,
    )
    radius = ground.site.marker_radius
    model = (
        placement.sensor_model(sensor, radius)
        if ask is None
        else model_of_surveys(ask, sensor, radius, survey=survey)
    )
    if marks is not None:
        places = [
            Place(name, p[0], p[1], z=p[2])
            for name, p in zip(marks.names, marks.p_site.tolist(), strict=True)
        ]
        placement.check_sizes(len(ground.stops.names), len(places))
        marks = marks_at(ground.site, places)
    return Asked(
        ground=ground,
        stops=ground.stops,
        marks=Arrangement.numbered(np.zeros((0, 3))) if marks is None else marks,
        model=model,
        requirement=Requirement(
            tolerance=wanted.tolerance, method=wanted.method, sigma_marks=wanted.sigma_marks
        ),
    )


def rules_of(
    reach: float, slope_deg: float, spacing: float, *, is_inside_allowed: bool
) -> PlaceRules:
    """Return where marks may stand."""
    return PlaceRules(
        reach=reach,
        slope_max=float(np.radians(slope_deg)),
        spacing=spacing,
        is_inside_allowed=is_inside_allowed,
    )


def goal_of(n_marks: int | None, probability: float, *, is_robust: bool) -> Goal:
    """Return what is to be found."""
    return Goal(n_marks=n_marks, probability=probability, is_robust=is_robust)


def evaluate(asked: Asked) -> Plain:
    """Return what an arrangement promises."""
    site = asked.ground.site
    found = placement.evaluate(site, asked.stops, asked.marks, asked.model, asked.requirement)
    return evaluation_json(site, asked.model, found)


def optimise(asked: Asked, rules: PlaceRules, goal: Goal) -> Plain:
    """Return the best places, and how good they are known to be."""
    site, stops = asked.ground.site, asked.stops
    placement.check_sizes(len(stops.names), goal.n_marks or 0)
    candidates = placement.find_candidates(site, stops, rules)
    rng = np.random.default_rng(_SEED)
    found = placement.optimise(site, stops, candidates, asked.model, asked.requirement, goal, rng)
    answer = evaluation_json(site, asked.model, found.evaluation)
    return answer | {"optimum": optimum_answer(found, goal), "notes": _notes(found, goal)}


def optimum_answer(found: Optimum, goal: Goal) -> Plain:
    """Return what is known of an optimum beside what it promises."""
    return {
        "keeps_tolerance": found.is_kept,
        "probability": goal.probability,
        "is_robust": goal.is_robust,
        "worst_sigma_3d_after_loss_m": _number(found.worst_after_loss),
        "information_gain": _number(found.log_det),
        "information_gain_bound": _number(found.log_det_bound),
        "share_of_bound": _number(found.log_det / found.log_det_bound),
        "n_candidates": found.n_candidates,
        "n_exchanges": found.n_exchanges,
    }


def _notes(found: Optimum, goal: Goal) -> list[str]:
    """Say how good an optimum is, for people."""
    text = f"The tolerance {_kept(found, goal)}."
    if np.isfinite(found.worst_after_loss):
        text += f" Without its worst mark: {1e3 * found.worst_after_loss:.2f} mm (3-D sigma)."
    notes = [text]
    if np.isfinite(found.log_det):
        share = 100 * found.log_det / found.log_det_bound
        notes.append(
            f"{found.n_candidates:,} places compared; {share:.1f} % of the information that no "
            f"arrangement of as many marks can exceed."
        )
    return notes


def _kept(found: Optimum, goal: Goal) -> str:
    """Say whether the tolerance is kept, and whether a loss would break it."""
    with_all = f"with {100 * goal.probability:g} % at every stop"
    if found.is_kept:
        return f"is kept {with_all}" + (", after the loss of any one mark too" * goal.is_robust)
    if found.evaluation.worst_probability >= goal.probability:
        return f"is kept {with_all}, but NOT after the loss of any one mark"
    return f"is NOT kept {with_all}"


def one_more(asked: Asked, rules: PlaceRules | None = None) -> Plain:
    """Return the one more mark that would help most."""
    site = asked.ground.site
    placement.check_sizes(len(asked.stops.names), len(asked.marks.names) + 1)
    candidates = placement.find_candidates(site, asked.stops, rules or PlaceRules())
    found = placement.propose_mark(
        site, asked.stops, asked.marks, candidates, asked.model, asked.requirement
    )
    mark = marks_json(site, found.after.marks)[-1]
    return mark | {
        "worst_sigma_3d_before_m": _number(found.before.worst_sigma_3d),
        "worst_sigma_3d_m": _number(found.after.worst_sigma_3d),
        "mean_sigma_3d_before_m": _number(found.before.sigma_3d.mean()),
        "mean_sigma_3d_m": _number(found.after.sigma_3d.mean()),
        "worst_probability_within_tolerance": found.after.worst_probability,
        "stops": [
            {"name": name, "sigma_3d_before_m": _number(a), "sigma_3d_m": _number(b)}
            for name, a, b in zip(
                asked.stops.names, found.before.sigma_3d, found.after.sigma_3d, strict=True
            )
        ],
    }


def _number(value: Any) -> float | None:
    """Return a number, or null where JSON has none for it."""
    return float(value) if np.isfinite(value) else None
