"""The study's procedure: limits from results, random plans, and their tables and figures."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from spheremark.pipelines import published as study
from spheremark.pipelines.errors import InputError
from spheremark.pipelines.placement import (
    CentreModel,
    RandomPlanSpec,
    Report,
    SearchState,
    errors_by_angle,
    simulate_random_plans,
)
from spheremark.pipelines.sphere import METHODS
from spheremark.service.planning.centre_models import Query, quoted
from spheremark.service.serialise.plans import Plain, random_plans_json

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


def within_limits(
    spec: RandomPlanSpec,
    limits: Plain,
    distance: float | None,
    angles: tuple[float | None, float | None],
) -> RandomPlanSpec:
    """Return a specification with its distances and angles, or those of results [m, rad]."""
    farthest = limits["greatest_distance_m"] if distance is None else distance
    low, high = (
        float(np.radians(limits[key])) if angle is None else angle
        for angle, key in zip(angles, ("angle_min_deg", "angle_max_deg"), strict=True)
    )
    return replace(spec, distances=(min(2.0, farthest / 2), farthest), angles=(low, high))


def limits_of_results(
    query: Query | None, method: str, tolerance: float, survey: str = ""
) -> Plain:
    """Return the greatest distance and the window of angles in which results keep a tolerance.

    The medians of errors (of sigmas, where no truth is known) by distance and by included angle of
    pairs, by the newest run of each log, of one survey if it is named; without enough results the
    limits of the study.
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
    if query is None:
        return limits
    named = {"method": method, "survey": quoted(survey)}
    near = _rows(query(_DISTANCES.format(bin=_BIN_M, **named)))
    if sum(row["n"] for row in near) >= _FITS_LEAST:
        limits["distance_source"] = f"{sum(row['n'] for row in near):,} fits by {method}"
        limits["greatest_distance_m"] = _greatest(near, tolerance)
    pairs = _rows(query(_WINDOW.format(bin=_BIN_DEG, none=_NO_POSITION, **named)))
    window = _window([row for row in pairs if row["n"] >= _PAIRS_LEAST], tolerance)
    if window:
        limits["angle_min_deg"], limits["angle_max_deg"] = window
        limits["angle_source"] = f"{sum(row['n'] for row in pairs):,} pairs of marks by {method}"
    return limits


def _rows(found: Mapping[str, Any]) -> list[Plain]:
    """Return the rows of a query by name."""
    names = [column["name"] for column in found["columns"]]
    return [dict(zip(names, row, strict=True)) for row in found["rows"]]


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


def run(spec: RandomPlanSpec, model: CentreModel, limits: Plain) -> Plain:
    """Simulate random plans and return their pass rates, with the study's Table 3."""
    error, distance = spec.error or 0.017, study.GRANTED_DISTANCE
    angles = np.radians(_ANGLES_DEG)
    return random_plans_json(
        simulate_random_plans(spec, model),
        None if spec.error is not None else model,
        limits,
        (angles, errors_by_angle(angles, error, distance)),
        errors_by_angle(study.TABLE_3.included_angles, error, distance),
    )


def run_reported(spec: RandomPlanSpec, model: CentreModel, limits: Plain, report: Report) -> Plain:
    """Do as ``run``, and report the begin."""
    report(SearchState(0.05, f"Drawing {spec.n_arrangements:,} arrangements", 0, np.inf, 0.0))
    return run(spec, model, limits)


def write(folder: Path, results: Plain) -> None:
    """Write the tables (CSV) and the figures (Plotly's JSON and pages of their own)."""
    from plotly.io import to_html

    from spheremark.web import assets
    from spheremark.web.figures import random_plans as figures_of
    from spheremark.web.theme import coloured

    folder.mkdir(parents=True, exist_ok=True)
    for name in ("by_number_of_marks", "by_worst_angle", "by_included_angle", "table3"):
        with (folder / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(results[name][0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(results[name])
    figures = {
        "pass_rate_by_number": figures_of.pass_rate_by_number(results),
        "pass_rate_by_angle": figures_of.pass_rate_by_angle(results),
        "error_by_angle": figures_of.error_by_angle(results),
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
