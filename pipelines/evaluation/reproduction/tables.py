"""The study's Tables 2 and 4 and Figure 3 from errors, and the limits that keep its tolerance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.accuracy.error_model import (
    Demand,
    ErrorModel,
    ErrorSample,
    Limits,
    Statistic,
    fit_error_model,
    limits,
)
from spheremark.pipelines.accuracy.truth import ErrorSummary, summarise
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
from spheremark.pipelines.model import Mask
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


class StudyTables(NamedTuple):
    """The study's tables from simulation; rows of plain values."""

    table_2: list[Plain]
    table_4: list[Plain]
    readings: list[Plain]
    icp: dict[str, ErrorSummary]
    findings: tuple[Finding, ...]


def study_tables(made: Reproduction, rng: np.random.Generator) -> StudyTables:
    """Return the study's tables again, and the limits that keep its tolerance.

    Parameters
    ----------
    made : Reproduction
        The scans.
    rng : numpy.random.Generator
        Draws the resamples of the confidence intervals.

    Returns
    -------
    StudyTables
        Errors by distance, by stop, by what the study leaves open, and by model of its ICP; limits
        by place and method.
    """
    return StudyTables(
        table_2=table_2(made),
        table_4=table_4(made),
        readings=readings(made),
        icp=models_of_icp(made),
        findings=findings(made, rng),
    )


def table_2(made: Reproduction) -> list[Plain]:
    """Return the study's Table 2 again: errors by distance; NaN where a marker was never found."""
    nearest = np.argmin(np.abs(made.centres["range_m"][:, None] - TABLE_2.ranges), axis=1)
    rows = []
    for i, distance in enumerate(TABLE_2.ranges):
        published = float(TABLE_2.errors_3d[i])
        row: Plain = {
            "distance_m": float(distance),
            "study_n_points": int(TABLE_2.n_points[i]),
            "study_error_3d_m": published,
        }
        for method in (OURS, PAPER):
            keep = made.of(method, CENTRE) & (nearest == i)
            errors = _summary(made, keep)
            counts = made.centres["n_points"][keep]
            row[f"{method}_n_points_mean"] = float(counts.mean()) if keep.any() else np.nan
            row[f"{method}_error_3d_mean_m"] = errors.mean
            row[f"{method}_error_3d_max_m"] = errors.largest
            row[f"{method}_n"] = errors.n
        rows.append(row | {"paper_minus_study_m": row["paper_error_3d_mean_m"] - published})
    return rows


def table_4(made: Reproduction) -> list[Plain]:
    """Return the study's Table 4 again: mean error per stop of lane 2."""
    rows = []
    for stop in STOPS_OF_LANE_2:
        scans = [i for i, one in enumerate(made.scans) if (one.series, one.stop) == (LANE_2, stop)]
        if not scans:
            continue
        at_stop = made.centres["stop"] == stop
        ours = made.centres["range_m"][made.of(OURS, LANE_2) & at_stop]
        row: Plain = {
            "stop": stop,
            "n_marks": int(made.n_marks[scans].sum()),
            "range_mean_m": float(ours.mean()) if len(ours) else np.nan,
        }
        for method in (OURS, PAPER):
            errors = _summary(made, made.of(method, LANE_2) & at_stop)
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
            keep = made.of(method, series)
            errors = _summary(made, keep)
            rows.append(
                {
                    "series": series,
                    "fit_method": method,
                    "n": errors.n,
                    "n_points_mean": float(centres["n_points"][keep].mean()),
                    "error_3d_mean_m": errors.mean,
                    "error_3d_min_m": float(centres["error_3d_m"][keep].min(initial=np.inf)),
                    "error_3d_max_m": errors.largest,
                    "bias_beyond_m": float(centres["error_towards_m"][keep].mean()),
                    "bias_up_m": float(centres["error_up_m"][keep].mean()),
                }
            )
    return rows


def models_of_icp(made: Reproduction) -> dict[str, ErrorSummary]:
    """Compare the hemisphere and the full sphere as models of the study's ICP (Figure 3)."""
    return {method: _summary(made, made.of(method, CENTRE)) for method in (PAPER, FULL_SPHERE)}


def findings(made: Reproduction, rng: np.random.Generator) -> tuple[Finding, ...]:
    """Return the limits of each method in each place: field first, ours first.

    Greatest distances are for the default time of a turn, smallest counts for 7.5 m, the distance
    of the study's own limit. ``rng`` draws the resamples of the confidence intervals.
    """
    places = {FIELD: (CENTRE, LANE_2, TURNS), LANE: (DISTANCES,), REAL: (DISTANCES_REAL,)}
    return tuple(
        _finding(made, place, method, series, rng)
        for place, series in places.items()
        for method in (OURS, PAPER)
    )


def _finding(
    made: Reproduction, place: str, method: str, series: Sequence[str], rng: np.random.Generator
) -> Finding:
    """Return the limits of one method in one place."""
    keep = made.of(method, *series)
    usual = keep & (made.centres["turn_s"] == TURN)
    own = {key: column[keep] for key, column in made.centres.items()}
    sample = ErrorSample(
        ranges=own["range_m"],
        n_points=own["n_points"].astype(np.float64),
        incidences=np.radians(own["incidence_deg"]),
        errors_3d=own["error_3d_m"],
        scans=own["scan"].astype(np.intp),
    )
    density = float(np.median((made.centres["n_points"] * made.centres["range_m"] ** 2)[usual]))
    demands = {
        statistic: Demand(
            tolerance=made.config.tolerance,
            statistic=statistic,
            at_range=GREATEST_DISTANCE,
            density=density,
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
    return summarise(made.centres["error_3d_m"][keep], made.config.tolerance)
