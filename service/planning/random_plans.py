"""The study's procedure as one answer: tables and figures of marks at random."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spheremark.pipelines import published as study
from spheremark.pipelines.errors import InputError
from spheremark.pipelines.placement import (
    CentreModel,
    PassRate,
    RandomPlanSpec,
    by_number,
    by_worst_angle,
    errors_by_angle,
    simulate_random_plans,
)
from spheremark.pipelines.sphere import METHODS
from spheremark.service.planning.centre_models import Ask, quoted
from spheremark.service.serialise.plans import Plain, model_json

_ANGLES_DEG = np.arange(10.0, 171.0, 2.5)
_BIN_DEG = 10  # of included angles of results
_PAIRS_LEAST = 8  # in a class of included angles
_FITS_LEAST = 30
_BIN_M = 0.5  # of distances of results
_NO_POSITION = 1e9  # [m] error of pairs that gave none

_DISTANCES = """
SELECT floor(range_m / {bin}) * {bin} AS range_m, count(*) AS n,
    quantile_cont(coalesce(error_3d_m, sigma_3d_m), 0.5) AS error_3d_m
FROM latest_marker_fits WHERE fit_method = '{method}' AND mark IS NOT NULL
    AND ('{survey}' IN ('', survey, survey_id))
GROUP BY 1 ORDER BY 1
"""
_WINDOW = """
SELECT floor(x.included_angle_deg / {bin}) * {bin} AS angle_deg, count(*) AS n,
    quantile_cont(coalesce(x.error_3d_m, x.sigma_3d_m, {none}), 0.5) AS error_3d_m
FROM resections AS x JOIN latest_runs AS r USING (run_id) JOIN surveys AS s USING (survey_id)
WHERE x.fit_method = '{method}' AND x.n_marks = 2 AND ('{survey}' IN ('', s.name, s.survey_id))
    AND x.resection_method = if(
        EXISTS (FROM resections WHERE fit_method = '{method}' AND resection_method = '{method}'),
        '{method}', 'free_station')
GROUP BY 1 ORDER BY 1
"""  # the study's fits by its own resection, where there are such; each pair counts once


@dataclass(frozen=True, slots=True, kw_only=True)
class Wanted:
    """What is to be tried; a distance or window of None is taken from results [m, rad]."""

    n_arrangements: int = 100_000
    n_marks: tuple[int, int] = (3, 14)
    distance: float | None = None
    angle_min: float | None = None
    angle_max: float | None = None
    error: float | None = 0.017
    tolerance: float = 0.03
    seed: int = 0

    def trial(self, limits: Plain) -> RandomPlanSpec:
        """Return the trial within the limits of results."""
        farthest = limits["greatest_distance_m"] if self.distance is None else self.distance
        low, high = (
            float(np.radians(limits[key])) if given is None else given
            for given, key in ((self.angle_min, "angle_min_deg"), (self.angle_max, "angle_max_deg"))
        )
        return RandomPlanSpec(
            n_arrangements=self.n_arrangements,
            n_marks=self.n_marks,
            distances=(min(2.0, farthest / 2), farthest),
            angles=(low, high),
            error=self.error,
            tolerance=self.tolerance,
            seed=self.seed,
        )


def limits_of_results(ask: Ask | None, method: str, tolerance: float, survey: str = "") -> Plain:
    """Return the greatest distance and the window of angles that results keep a tolerance in.

    The medians of errors (of sigmas, where no truth is known) by distance and by included angle of
    pairs, by the newest run of each log, of one survey if it is named; without results, or too few
    of them, the study's own limits.
    """
    if method not in METHODS:
        raise InputError(f"{method!r} is no fitting method; there are {', '.join(METHODS)}.")
    limits: Plain = {
        "greatest_distance_m": study.GREATEST_DISTANCE,
        "angle_min_deg": float(np.degrees(study.LEAST_ANGLE)),
        "angle_max_deg": float(np.degrees(study.WIDEST_ANGLE)),
        "distance_source": "study",
        "angle_source": "study",
    }
    if ask is None:
        return limits
    named = {"method": method, "survey": quoted(survey)}
    near = _rows(ask(_DISTANCES.format(bin=_BIN_M, **named)))
    if sum(row["n"] for row in near) >= _FITS_LEAST:
        limits["distance_source"] = f"{sum(row['n'] for row in near):,} fits by {method}"
        limits["greatest_distance_m"] = _greatest(near, tolerance)
    pairs = _rows(ask(_WINDOW.format(bin=_BIN_DEG, none=_NO_POSITION, **named)))
    window = _window([row for row in pairs if row["n"] >= _PAIRS_LEAST], tolerance)
    if window:
        limits["angle_min_deg"], limits["angle_max_deg"] = window
        limits["angle_source"] = f"{sum(row['n'] for row in pairs):,} pairs of marks by {method}"
    return limits


def _rows(answer: Mapping[str, Any]) -> list[Plain]:
    """Return the rows of an answer by name."""
    names = [column["name"] for column in answer["columns"]]
    return [dict(zip(names, row, strict=True)) for row in answer["rows"]]


def _greatest(rows: list[Plain], tolerance: float) -> float:
    """Return the distance up to which the tolerance is kept; the first class at the least [m]."""
    greatest = rows[0]["range_m"] + _BIN_M
    for row in rows:
        if row["n"] >= _PAIRS_LEAST and row["error_3d_m"] > tolerance:
            break
        greatest = row["range_m"] + _BIN_M
    return float(greatest)


def _window(rows: list[Plain], tolerance: float) -> tuple[float, float] | None:
    """Return the run of classes about a right angle that keeps the tolerance [deg]."""
    kept = {row["angle_deg"] for row in rows if row["error_3d_m"] <= tolerance}
    start = min(kept, key=lambda angle: abs(angle + _BIN_DEG / 2 - 90.0), default=None)
    if start is None:
        return None
    low = high = start
    while low - _BIN_DEG in kept:
        low -= _BIN_DEG
    while high + _BIN_DEG in kept:
        high += _BIN_DEG
    return float(low), float(high + _BIN_DEG)


def run(trial: RandomPlanSpec, model: CentreModel, limits: Plain) -> Plain:
    """Try arrangements at random and say what came of them."""
    result = simulate_random_plans(trial, model)
    error = trial.error or 0.017
    angles = np.radians(_ANGLES_DEG)
    curve = errors_by_angle(angles, error, study.GRANTED_DISTANCE)
    table_3 = errors_by_angle(study.TABLE_3.included_angles, error, study.GRANTED_DISTANCE)
    inside = result.is_in_window
    return {
        "n_arrangements": trial.n_arrangements,
        "seed": trial.seed,
        "tolerance_m": trial.tolerance,
        "error_per_axis_m": trial.error,
        "model": model_json(model) if trial.error is None else None,
        "distance_min_m": trial.distances[0],
        "distance_max_m": trial.distances[1],
        "angle_min_deg": float(np.degrees(trial.angles[0])),
        "angle_max_deg": float(np.degrees(trial.angles[1])),
        "limits": limits,
        "n_in_window": int(inside.sum()),
        "pass_rate": float(result.passes.mean()),
        "pass_rate_in_window": float(result.passes[inside].mean()) if inside.any() else None,
        "pass_rate_outside": float(result.passes[~inside].mean()) if not inside.all() else None,
        "by_number_of_marks": [
            {"n_marks": int(row.low), **_share(row)} for row in by_number(result)
        ],
        "by_worst_angle": [
            {"angle_from_deg": row.low, "angle_to_deg": row.high, **_share(row)}
            for row in by_worst_angle(result)
        ],
        "by_included_angle": [
            {"included_angle_deg": float(a), "median_error_3d_m": float(e)}
            for a, e in zip(_ANGLES_DEG, curve, strict=True)
        ],
        "table3": [
            {
                "included_angle_deg": float(np.degrees(a)),
                "study_error_3d_m": float(published),
                "median_error_3d_m": float(e),
            }
            for a, published, e in zip(
                study.TABLE_3.included_angles, study.TABLE_3.errors, table_3, strict=True
            )
        ],
        "window_that_keeps_tolerance_deg": _kept_window(curve, trial.tolerance),
    }


def _kept_window(curve: np.ndarray, tolerance: float) -> list[float] | None:
    """Return between which included angles the median error keeps the tolerance [deg]."""
    kept = _ANGLES_DEG[curve <= tolerance]
    return [float(kept.min()), float(kept.max())] if len(kept) else None


def _share(row: PassRate) -> Plain:
    """Return how many of a class pass."""
    found = {
        "pass_rate": row.share,
        "median_error_3d_m": row.median,
        "p95_error_3d_m": row.p95,
    }
    return {"n": row.n} | {k: float(v) if np.isfinite(v) else None for k, v in found.items()}


def write(folder: Path, answer: Plain) -> None:
    """Write the tables (CSV) and the figures (Plotly's JSON and pages of their own)."""
    from plotly.io import to_html

    from spheremark.web import assets
    from spheremark.web.figures import random_plans as trials
    from spheremark.web.theme import coloured

    folder.mkdir(parents=True, exist_ok=True)
    for name in ("by_number_of_marks", "by_worst_angle", "by_included_angle", "table3"):
        with (folder / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(answer[name][0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(answer[name])
    figures = {
        "pass_rate_by_number": trials.pass_rate_by_number(answer),
        "pass_rate_by_angle": trials.pass_rate_by_angle(answer),
        "error_by_angle": trials.error_by_angle(answer),
    }
    parts = [
        to_html(
            coloured(figure.to_plotly_json(), assets.tokens("light")),
            full_html=False,
            include_plotlyjs="inline" if i == 0 else False,
            validate=False,
        )
        for i, figure in enumerate(figures.values())
    ]
    head = "<!doctype html><meta charset='utf-8'><title>Marks at random</title>"
    (folder / "index.html").write_text(head + "".join(parts), encoding="utf-8")
