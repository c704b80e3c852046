"""The study's Tables 2 and 4 and Figure 3 from errors, and the limits that keep its tolerance."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.accuracy import ErrorSummary, summarise
from spheremark.pipelines.error_model import (
    Demand,
    ErrorModel,
    Limits,
    Statistic,
    fit_error_model,
    limits,
)
from spheremark.pipelines.evaluation.experiment import Plain
from spheremark.pipelines.evaluation.reproduction.plan import (
    CENTRE,
    CENTRE_REAL,
    DISTANCES,
    DISTANCES_REAL,
    FULL_SPHERE,
    GROUND,
    LANE_2,
    OURS,
    PAPER,
    STOPS_OF_LANE_2,
    TURN,
    TURNS,
)
from spheremark.pipelines.evaluation.reproduction.scans import Reproduction
from spheremark.pipelines.model import Index, Mask
from spheremark.pipelines.published import GREATEST_DISTANCE, TABLE_2

FIELD, LANE, REAL = "field", "to 30 m", "to 30 m, noise of a real VLP-16"
"""Places of findings: the study's field, and spheres to 30 m, both with the noise of the study's
simulator; and the same spheres with the noise of a real sensor."""

_STATISTICS: tuple[Statistic, ...] = ("p95", "mean")


class Finding(NamedTuple):
    """The error model of one method in one place, and the limits that keep the tolerance.

    The limits are by statistic: ``p95``, and ``mean``, the study's.
    """

    place: str
    method: str
    model: ErrorModel
    limits: Mapping[Statistic, Limits]
    errors: ErrorSummary


def table_2(made: Reproduction) -> list[Plain]:
    """Return the study's Table 2 again: errors by distance; NaN where a marker was never found."""
    centres, scans = made.centres, made.series(CENTRE)
    nearest = np.argmin(np.abs(centres.ranges[:, None] - TABLE_2.ranges), axis=1)
    rows = []
    for i, distance in enumerate(TABLE_2.ranges):
        published = float(TABLE_2.errors_3d[i])
        row: Plain = {
            "distance_m": float(distance),
            "study_n_points": int(TABLE_2.n_points[i]),
            "study_error_3d_m": published,
        }
        for method in (OURS, PAPER):
            keep = centres.of(method, scans) & (nearest == i)
            errors = _summary(made, keep)
            counts = centres.n_points[keep]
            row[f"{method}_n_points_mean"] = float(counts.mean()) if keep.any() else np.nan
            row[f"{method}_error_3d_mean_m"] = errors.mean
            row[f"{method}_error_3d_max_m"] = errors.largest
            row[f"{method}_n"] = errors.n
        rows.append(row | {"paper_minus_study_m": row["paper_error_3d_mean_m"] - published})
    return rows


def table_4(made: Reproduction) -> list[Plain]:
    """Return the study's Table 4 again: mean error per stop of lane 2."""
    centres, rows = made.centres, []
    for stop in STOPS_OF_LANE_2:
        scans = np.array([i for i in made.series(LANE_2) if made.scans[i].stop == stop], np.intp)
        if not len(scans):
            continue
        ours = centres.ranges[centres.of(OURS, scans)]
        row: Plain = {
            "stop": stop,
            "n_marks": int(made.n_marks[scans].sum()),
            "range_mean_m": float(ours.mean()) if len(ours) else np.nan,
        }
        for method in (OURS, PAPER):
            errors = _summary(made, centres.of(method, scans))
            row[f"{method}_n"] = errors.n
            row[f"{method}_error_3d_mean_m"] = errors.mean
            row[f"{method}_error_3d_p95_m"] = errors.p95
        rows.append(row)
    return rows


def readings(made: Reproduction) -> list[Plain]:
    """Return the errors of the study's method by the noise and the cut, which it leaves open."""
    centres, rows = made.centres, []
    for series in (CENTRE, CENTRE_REAL):
        for method in (PAPER, GROUND):
            keep = centres.of(method, made.series(series))
            errors, bias = _summary(made, keep), centres.error_station[keep].mean(axis=0)
            rows.append(
                {
                    "series": series,
                    "fit_method": method,
                    "n": errors.n,
                    "n_points_mean": float(centres.n_points[keep].mean()),
                    "error_3d_mean_m": errors.mean,
                    "error_3d_min_m": float(centres.error_3d[keep].min(initial=np.inf)),
                    "error_3d_max_m": errors.largest,
                    "bias_beyond_m": float(bias[0]),
                    "bias_up_m": float(bias[2]),
                }
            )
    return rows


def models_of_icp(made: Reproduction) -> dict[str, ErrorSummary]:
    """Compare the hemisphere and the full sphere as models of the study's ICP (Figure 3)."""
    scans = made.series(CENTRE)
    return {m: _summary(made, made.centres.of(m, scans)) for m in (PAPER, FULL_SPHERE)}


def findings(made: Reproduction, rng: np.random.Generator) -> tuple[Finding, ...]:
    """Return the limits of each method in each place: field first, ours first.

    Greatest distances are for the default time of a turn, smallest counts for 7.5 m, the distance
    of the study's own limit. ``rng`` draws the resamples of the confidence intervals.
    """
    places = {
        FIELD: made.series(CENTRE, LANE_2, TURNS),
        LANE: made.series(DISTANCES),
        REAL: made.series(DISTANCES_REAL),
    }
    return tuple(
        _finding(made, place, method, scans, rng)
        for place, scans in places.items()
        for method in (OURS, PAPER)
    )


def _finding(
    made: Reproduction, place: str, method: str, scans: Index, rng: np.random.Generator
) -> Finding:
    """Return the limits of one method in one place."""
    centres, tolerance = made.centres, made.config.tolerance
    usual = centres.of(method, [i for i in scans if made.scans[i].turn == TURN])
    density = float(np.median(centres.n_points[usual] * centres.ranges[usual] ** 2))
    sample = centres.sample(centres.of(method, scans))
    demands = {
        statistic: Demand(
            tolerance=tolerance, statistic=statistic, at_range=GREATEST_DISTANCE, density=density
        )
        for statistic in _STATISTICS
    }
    return Finding(
        place=place,
        method=method,
        model=fit_error_model(sample),
        limits={statistic: limits(sample, demand, rng) for statistic, demand in demands.items()},
        errors=_summary(made, usual),
    )


def _summary(made: Reproduction, keep: Mask) -> ErrorSummary:
    """Summarise the errors of some rows."""
    return summarise(made.centres.error_3d[keep], made.config.tolerance)
