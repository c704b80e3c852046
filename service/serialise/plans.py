"""The JSON of plans: a public interface of ``spheremark plan`` and of ``/api/v1/plans``."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from spheremark.pipelines.placement import (
    Arrangement,
    CentreModel,
    Costs,
    Evaluation,
    FieldMap,
    Goal,
    Optimum,
    PassRate,
    Proposal,
    RandomPlanResults,
    Site,
    Stops,
    TradeOff,
    by_number,
    by_worst_angle,
)
from spheremark.pipelines.published import TABLE_3
from spheremark.storage.exports.points import NamedPoint

Plain = dict[str, Any]


def evaluation_json(
    site: Site, model: CentreModel, found: Evaluation, after_loss: float = math.nan
) -> Plain:
    """Return the evaluation of an arrangement, with the worst sigma after a loss if known."""
    worst = int(np.argmax(np.where(np.isfinite(found.sigma_3d), found.sigma_3d, np.inf)))
    return {
        "site": {"name": site.name},
        "method": found.requirement.method,
        "tolerance_m": found.requirement.tolerance,
        "model": model_json(model),
        "marks": marks_json(site, found.marks),
        "stops": [stop_json(found, i) for i in range(len(found.stops.names))],
        "worst_stop": found.stops.names[worst],
        "worst_sigma_3d_m": number_or_null(found.worst_sigma_3d),
        "mean_sigma_3d_m": number_or_null(found.sigma_3d.mean()),
        "worst_sigma_3d_after_loss_m": number_or_null(after_loss),
        "worst_probability_within_tolerance": found.worst_probability,
        "keeps_tolerance_95": bool(found.worst_probability >= 0.95),
    }


def marks_json(site: Site, marks: Arrangement) -> list[Plain]:
    """Return marks with the ground under them and the heights of their poles."""
    ground = site.ground_at(marks.p_site)
    return [
        {
            "name": name,
            "position_m": _numbers(p),
            "ground_m": number_or_null(z),
            "pole_height_m": number_or_null(p[2] - z),
        }
        for name, p, z in zip(marks.names, marks.p_site, ground, strict=True)
    ]


def stop_json(found: Evaluation, i: int) -> Plain:
    """Return the evaluation of one stop."""
    marks = found.marks.names
    low, high = np.degrees(found.angles[i])
    has_angle = found.n_used[i] >= 2
    return {
        "name": found.stops.names[i],
        "position_m": _numbers(found.stops.p_site[i]),
        "sigma_3d_m": number_or_null(found.sigma_3d[i]),
        "rms_error_3d_m": number_or_null(found.rms_3d[i]),
        "probability_within_tolerance": float(found.probability[i]),
        "covariance_m2": _numbers(found.cov_p_site[i]),
        "visible_marks": [marks[k] for k in np.flatnonzero(found.is_seen[i])],
        "n_used": int(found.n_used[i]),
        "included_angle_min_deg": number_or_null(low) if has_angle else None,
        "included_angle_max_deg": number_or_null(high) if has_angle else None,
        "dop": number_or_null(found.dop[i]),
        "dof": int(found.dof[i]),
        "reason": found.reasons[i],
        "marks": [_mark_at_stop(found, i, k) for k in range(len(marks))],
    }


def _mark_at_stop(found: Evaluation, i: int, k: int) -> Plain:
    """Return the evaluation of one mark from one stop."""
    return {
        "name": found.marks.names[k],
        "is_seen": bool(found.is_seen[i, k]),
        "probability_found": float(found.found[i, k]),
        "visible_share": float(found.shares[i, k]),
        "surface_behind_m": number_or_null(found.gaps[i, k]),
        "range_m": float(found.ranges[i, k]),
        "n_points": float(found.n_points[i, k]),
        "redundancy": float(found.redundancies[i, k]),
        "minimal_detectable_bias_m": number_or_null(found.detectable_biases[i, k]),
        "external_reliability_m": number_or_null(found.external_reliabilities[i, k]),
    }


def optimum_json(found: Optimum, goal: Goal, costs: Costs) -> Plain:
    """Return the quality of an optimum, beside its evaluation."""
    share = found.log_det / found.log_det_bound
    reached = found.evaluation.sigma_3d
    reached = reached.mean() if goal.objective == "mean" else reached.max()
    excess = reached / found.bound - 1.0
    return {
        "optimum": {
            "keeps_tolerance": found.is_kept,
            "probability": goal.probability,
            "is_robust": goal.is_robust,
            "objective": goal.objective,
            "unreachable": found.unreachable,
            "worst_sigma_3d_after_loss_m": number_or_null(found.worst_after_loss),
            "worst_sigma_3d_after_loss_bound_m": number_or_null(found.bound_after_loss),
            "worst_sigma_3d_as_placed_m": number_or_null(found.worst_as_placed),
            "walk_m": found.walk,
            "cost": costs.of(found),
            "information_gain": number_or_null(found.log_det),
            "information_gain_bound": number_or_null(found.log_det_bound),
            "share_of_bound": number_or_null(share),
            "worst_sigma_3d_bound_m": number_or_null(found.bound),
            "excess_over_bound": number_or_null(excess),
            "bound_spacing_m": found.bound_spacing or None,
            "n_bounded": found.n_bounded,
            "n_candidates": found.n_candidates,
            "n_exchanges": found.n_exchanges,
        },
        "notes": _notes(found, goal, float(excess), costs),
    }


def _notes(found: Optimum, goal: Goal, excess: float, costs: Costs) -> list[str]:
    """Return what a plan reaches, for people."""
    kept = f"with {100 * goal.probability:g} % at every stop"
    if found.is_kept:
        text = f"is kept {kept}" + ", after the loss of any one mark too" * goal.is_robust
    elif found.evaluation.worst_probability >= goal.probability:
        text = f"is kept {kept}, but NOT after the loss of any one mark"
    else:
        text = f"is NOT kept {kept}"
    notes = [f"The tolerance {text}."]
    if found.unreachable:
        notes.append(f"{found.unreachable} The rest of the goal was optimised.")
    if math.isfinite(found.worst_after_loss):
        worst = 1e3 * found.worst_after_loss
        notes[0] += f" Without its worst mark: {worst:.3f} mm (3-D sigma)."
    if math.isfinite(excess):
        where = f"every {found.bound_spacing:.2f} m" if found.bound_spacing else "that were given"
        what = "mean of all stops" if goal.objective == "mean" else "worst stop"
        notes.append(
            f"{found.n_candidates:,} places compared. The {what} is within "
            f"{max(100 * excess, 0.0):.1f} % of any arrangement of as many marks on "
            f"{found.n_bounded:,} places {where}: none has less than {1e3 * found.bound:.3f} mm."
        )
    if math.isfinite(found.worst_as_placed):
        notes.append(
            f"Where marks end up beside their places, 95 % of such arrangements have "
            f"{1e3 * found.worst_as_placed:.3f} mm or less at the worst stop."
        )
    if goal.stop_reach:
        notes.append("Stops were moved; the bound holds for where they are now.")
    walk = f"The round from the first stop past all marks is {found.walk:.0f} m"
    return [*notes, f"{walk}; costs {costs.of(found):g}." if costs != Costs() else f"{walk}."]


def trade_off_json(
    site: Site, model: CentreModel, found: TradeOff, goal: Goal, costs: Costs
) -> Plain:
    """Return the best plans of several numbers of marks and of several weights of a loss."""

    def plain(one: Optimum) -> Plain:
        evaluation = evaluation_json(site, model, one.evaluation, one.worst_after_loss)
        return evaluation | optimum_json(one, goal, costs)

    reached = [one for one in found.by_number if one.is_kept]
    cheapest = min(reached, key=lambda one: (costs.of(one), len(one.ground)), default=None)
    return {
        "by_number": [plain(one) for one in found.by_number],
        "by_loss_weight": [plain(one) for one in found.by_weight],
        "numbers": list(found.numbers),
        "loss_weights": list(found.weights),
        "cheapest": None if cheapest is None else len(cheapest.ground),
    }


def proposal_json(site: Site, found: Proposal) -> Plain:
    """Return one more mark, with the accuracy without and with it."""
    before, after = found.before.sigma_3d, found.after.sigma_3d
    return marks_json(site, found.after.marks)[-1] | {
        "worst_sigma_3d_before_m": number_or_null(before.max()),
        "worst_sigma_3d_m": number_or_null(after.max()),
        "mean_sigma_3d_before_m": number_or_null(before.mean()),
        "mean_sigma_3d_m": number_or_null(after.mean()),
        "worst_probability_within_tolerance": found.after.worst_probability,
        "stops": [
            {"name": name, "sigma_3d_before_m": number_or_null(a), "sigma_3d_m": number_or_null(b)}
            for name, a, b in zip(found.after.stops.names, before, after, strict=True)
        ],
    }


def random_plans_json(
    results: RandomPlanResults,
    model: CentreModel | None,
    limits: Plain,
    by_angle: tuple[np.ndarray, np.ndarray],
    table_3: np.ndarray,
) -> Plain:
    """Return pass rates of random plans, and the errors by included angle and of Table 3."""
    spec, inside, passes = results.spec, results.is_in_window, results.passes
    angles, curve = np.degrees(by_angle[0]), by_angle[1]
    kept = angles[curve <= spec.tolerance]
    return {
        "n_arrangements": spec.n_arrangements,
        "seed": spec.seed,
        "tolerance_m": spec.tolerance,
        "error_per_axis_m": spec.error,
        "model": None if model is None else model_json(model),
        "distance_min_m": spec.distances[0],
        "distance_max_m": spec.distances[1],
        "angle_min_deg": float(np.degrees(spec.angles[0])),
        "angle_max_deg": float(np.degrees(spec.angles[1])),
        "limits": limits,
        "n_in_window": int(inside.sum()),
        "pass_rate": float(passes.mean()),
        "pass_rate_in_window": float(passes[inside].mean()) if inside.any() else None,
        "pass_rate_outside": float(passes[~inside].mean()) if not inside.all() else None,
        "by_number_of_marks": [
            {"n_marks": int(row.low), **_pass_rate(row)} for row in by_number(results)
        ],
        "by_worst_angle": [
            {"angle_from_deg": row.low, "angle_to_deg": row.high, **_pass_rate(row)}
            for row in by_worst_angle(results)
        ],
        "by_included_angle": [
            {"included_angle_deg": float(a), "median_error_3d_m": float(e)}
            for a, e in zip(angles, curve, strict=True)
        ],
        "table3": [
            {
                "included_angle_deg": float(np.degrees(a)),
                "study_error_3d_m": float(published),
                "median_error_3d_m": float(e),
            }
            for a, published, e in zip(
                TABLE_3.included_angles, TABLE_3.errors, table_3, strict=True
            )
        ],
        "window_that_keeps_tolerance_deg": (
            [float(kept.min()), float(kept.max())] if len(kept) else None
        ),
    }


def _pass_rate(row: PassRate) -> Plain:
    """Return the pass rate of a class."""
    return {
        "n": row.n,
        "pass_rate": number_or_null(row.share),
        "median_error_3d_m": number_or_null(row.median),
        "p95_error_3d_m": number_or_null(row.p95),
    }


def map_json(field: FieldMap, mark: int | None = None) -> Plain:
    """Return an evaluation on a grid of places, rows along y, and where a mark is found from."""
    return {
        "viewshed": None if mark is None else field.is_seen[..., mark].astype(int).tolist(),
        "x_m": _numbers(field.xs),
        "y_m": _numbers(field.ys),
        "sigma_3d_m": _rounded(field.sigma_3d, 6),
        "probability_within_tolerance": _rounded(field.probability, 5),
        "n_seen": field.n_seen.tolist(),
    }


def site_json(site: Site, stops: Stops, marks: Arrangement, *, n_across: int) -> Plain:
    """Return a field to plan on: its ground, thinned, its stops and its marks."""
    step = max(1, math.ceil(max(site.ground.shape) / n_across))
    return {
        "name": site.name,
        "extent_m": [float(v) for v in (site.xs[0], site.ys[0], site.xs[-1], site.ys[-1])],
        "pole_heights_m": list(site.pole_heights),
        "marker_radius_m": site.marker_radius,
        "mast_m": site.mast,
        "keep_out_m": [_numbers(polygon) for polygon in site.keep_out],
        "ground": {
            "x_m": _numbers(site.xs[::step]),
            "y_m": _numbers(site.ys[::step]),
            "ground_m": _rounded(site.ground[::step, ::step], 3),
        },
        "stops": [
            {"name": name, "position_m": _numbers(p)}
            for name, p in zip(stops.names, stops.p_site, strict=True)
        ],
        "marks": marks_json(site, marks),
    }


def model_json(model: CentreModel) -> Plain:
    """Return a model of centres and its origin."""
    origin = model.provenance
    return {
        "version": model.version,
        "source": origin.source,
        "n_rows": origin.n_rows,
        "n_stops": origin.n_stops,
        "surveys": list(origin.surveys),
        "fit_method": origin.fit_method or None,
        "newest": origin.newest or None,
        "text": model_text(model),
        "warning": model.sensor.warning or None,
    }


def model_text(model: CentreModel) -> str:
    """Return the origin of the accuracy of centres, for people."""
    origin = model.provenance
    if origin.source == "sensor":
        text = "Accuracy of centres from the sensor."
    else:
        text = (
            f"Accuracy of centres from {origin.n_rows:,} fits at {origin.n_stops} stops of "
            f"{', '.join(origin.surveys)}."
        )
    return " ".join(part for part in (text, origin.note, model.sensor.warning) if part)


_COLUMNS = (
    "kind",
    "name",
    "x_m",
    "y_m",
    "z_m",
    "ground_m",
    "pole_height_m",
    "sigma_3d_m",
    "probability_within_tolerance",
    "n_used",
)


def to_csv(evaluation: Mapping[str, Any]) -> str:
    """Return marks to stake out and the accuracy of each stop as one table."""
    text = io.StringIO()
    writer = csv.DictWriter(text, _COLUMNS, restval="", lineterminator="\n", extrasaction="ignore")
    writer.writeheader()
    for kind, rows in (("mark", evaluation["marks"]), ("stop", evaluation["stops"])):
        for row in rows:
            place = dict(zip(("x_m", "y_m", "z_m"), row["position_m"], strict=True))
            writer.writerow({"kind": kind, **_short({**row, **place})})
    return text.getvalue()


def _short(row: Plain) -> Plain:
    """Return a row with lengths to the micrometre."""
    return {
        key: round(value, 6) if key.endswith("_m") and isinstance(value, float) else value
        for key, value in row.items()
    }


def plan_points(evaluation: Mapping[str, Any]) -> list[NamedPoint]:
    """Return marks and stops as named points, with what maps show of them."""
    kinds = (
        ("mark", evaluation["marks"], ("ground_m", "pole_height_m")),
        ("stop", evaluation["stops"], ("sigma_3d_m", "probability_within_tolerance", "n_used")),
    )
    return [
        NamedPoint(
            kind=kind,
            name=one["name"],
            p_site=one["position_m"],
            properties={name: one[name] for name in names},
        )
        for kind, rows, names in kinds
        for one in rows
    ]


def number_or_null(value: float) -> float | None:
    """Return a number, or null where JSON has none for it."""
    return float(value) if math.isfinite(value) else None


def _numbers(values: ArrayLike) -> Any:
    """Return an array as nested lists; unknown is null."""
    array = np.asarray(values, dtype=np.float64)
    return array.tolist() if np.isfinite(array).all() else _with_nulls(array)


def _rounded(grid: np.ndarray, digits: int) -> Any:
    """Return a rounded grid."""
    return _with_nulls(np.round(grid, digits))


def _with_nulls(array: np.ndarray) -> Any:
    """Return an array as nested lists, with null where JSON has no number."""
    values = array.astype(object)
    values[~np.isfinite(array)] = None
    return values.tolist()
