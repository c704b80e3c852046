"""From errors to the study's Tables 2 and 4, its Figure 3, and what keeps its tolerance."""

from __future__ import annotations

from dataclasses import dataclass

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
from spheremark.pipelines.model import Array, Index, seal
from spheremark.pipelines.published import GREATEST_DISTANCE, TABLE_2

FIELD, LANE, REAL = "field", "to 30 m", "to 30 m, noise of a real VLP-16"
"""Places of findings: the study's field, and spheres to 30 m, both with the noise of the study's
simulator; and the same spheres with the noise of a real sensor."""

_STATISTICS: tuple[Statistic, ...] = ("p95", "mean")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Table2Row:
    """Accuracy of centres at one of the study's distances.

    Attributes
    ----------
    distance : float
        Distance of the marker in the study [m].
    published_n_points : int
        Its number of returns there.
    published_error : float
        Its error there, 3-D [m].
    n_points : mapping of str to float
        Mean number of returns by method; NaN where the marker was never found.
    errors : mapping of str to ErrorSummary
        Errors over the worlds by method.
    """

    distance: float
    published_n_points: int
    published_error: float
    n_points: dict[str, float]
    errors: dict[str, ErrorSummary]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Table4Row:
    """Mean error of the centres at one stop of the lane.

    Attributes
    ----------
    stop : str
        Its name.
    n_marks : int
        Marks that might have been found, over all worlds.
    errors : mapping of str to ErrorSummary
        Errors over markers and worlds by method.
    mean_range : float
        Mean distance of the markers found by our method [m].
    """

    stop: str
    n_marks: int
    errors: dict[str, ErrorSummary]
    mean_range: float


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Finding:
    """What one method keeps in one place.

    Attributes
    ----------
    place : str
        ``FIELD``, ``LANE`` or ``REAL``.
    method : str
        Fitting method.
    model : ErrorModel
        How its errors depend on distance, count and incidence.
    limits : mapping of str to Limits
        What keeps the tolerance, by statistic: ``p95`` and the study's ``mean``.
    errors : ErrorSummary
        The errors themselves.
    """

    place: str
    method: str
    model: ErrorModel
    limits: dict[Statistic, Limits]
    errors: ErrorSummary


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Reading:
    """What the study's method gives at the centre stop under one reading of how it was done.

    Attributes
    ----------
    series : str
        ``CENTRE`` or ``CENTRE_REAL``: whose noise.
    method : str
        ``PAPER`` (half of each sphere is cut away) or ``GROUND`` (all below the highest ground).
    errors : ErrorSummary
        Errors over spheres and worlds.
    least : float
        Smallest error [m].
    bias_station : (3,)
        Mean error beyond the centre, to its left and upward [m].
    n_points : float
        Mean number of returns that the cut leaves.
    """

    series: str
    method: str
    errors: ErrorSummary
    least: float
    bias_station: Array
    n_points: float

    def __post_init__(self) -> None:
        seal(self, bias_station=(3,))


def table_2(made: Reproduction) -> tuple[Table2Row, ...]:
    """Return the study's Table 2 again: errors by distance at the centre stop.

    Parameters
    ----------
    made : Reproduction
        The scans.

    Returns
    -------
    tuple of Table2Row
        In the order of the distances.
    """
    centres, scans = made.centres, made.series(CENTRE)
    nearest = np.argmin(np.abs(centres.ranges[:, None] - TABLE_2.ranges), axis=1)
    rows = []
    for i, distance in enumerate(TABLE_2.ranges):
        keep = {m: centres.of(m, scans) & (nearest == i) for m in (OURS, PAPER)}
        rows.append(
            Table2Row(
                distance=float(distance),
                published_n_points=int(TABLE_2.n_points[i]),
                published_error=float(TABLE_2.errors_3d[i]),
                n_points={
                    m: float(centres.n_points[k].mean()) if k.any() else np.nan
                    for m, k in keep.items()
                },
                errors={
                    m: summarise(centres.error_3d[k], made.config.tolerance)
                    for m, k in keep.items()
                },
            )
        )
    return tuple(rows)


def table_4(made: Reproduction) -> tuple[Table4Row, ...]:
    """Return the study's Table 4 again: mean error per stop of lane 2.

    Parameters
    ----------
    made : Reproduction
        The scans.

    Returns
    -------
    tuple of Table4Row
        In the order of the stops, those that were scanned.
    """
    centres, rows = made.centres, []
    for stop in STOPS_OF_LANE_2:
        scans = np.array([i for i in made.series(LANE_2) if made.scans[i].stop == stop], np.intp)
        if not len(scans):
            continue
        keep = {method: centres.of(method, scans) for method in (OURS, PAPER)}
        rows.append(
            Table4Row(
                stop=stop,
                n_marks=int(made.n_marks[scans].sum()),
                errors={
                    m: summarise(centres.error_3d[k], made.config.tolerance)
                    for m, k in keep.items()
                },
                mean_range=float(centres.ranges[keep[OURS]].mean()) if keep[OURS].any() else np.nan,
            )
        )
    return tuple(rows)


def findings(made: Reproduction, rng: np.random.Generator) -> tuple[Finding, ...]:
    """Say what each method keeps, in the study's field and to 30 m.

    Parameters
    ----------
    made : Reproduction
        The scans.
    rng : numpy.random.Generator
        Draws the resamples of the confidence intervals.

    Returns
    -------
    tuple of Finding
        Field first, ours first.

    Notes
    -----
    Greatest distances are for the default time of a turn, smallest counts for 7.5 m, the distance
    of the study's own claim.
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


def readings(made: Reproduction) -> tuple[Reading, ...]:
    """Say how the study's errors depend on what it leaves open: its noise and its cut.

    Parameters
    ----------
    made : Reproduction
        The scans.

    Returns
    -------
    tuple of Reading
        Its simulator's noise first, the cut at the equator first.
    """
    return tuple(
        _reading(made, series, method)
        for series in (CENTRE, CENTRE_REAL)
        for method in (PAPER, GROUND)
    )


def _reading(made: Reproduction, series: str, method: str) -> Reading:
    """Summarise one method in one series."""
    centres = made.centres
    keep = centres.of(method, made.series(series))
    return Reading(
        series=series,
        method=method,
        errors=summarise(centres.error_3d[keep], made.config.tolerance),
        least=float(centres.error_3d[keep].min(initial=np.inf)),
        bias_station=centres.error_station[keep].mean(axis=0),
        n_points=float(centres.n_points[keep].mean()),
    )


def models_of_icp(made: Reproduction) -> dict[str, ErrorSummary]:
    """Compare the hemisphere and the full sphere as models of the study's ICP (Figure 3).

    Parameters
    ----------
    made : Reproduction
        The scans.

    Returns
    -------
    dict
        Errors at the centre stop by method: ``paper`` (hemisphere) and ``paper_sphere``.
    """
    scans = made.series(CENTRE)
    return {
        method: summarise(
            made.centres.error_3d[made.centres.of(method, scans)], made.config.tolerance
        )
        for method in (PAPER, FULL_SPHERE)
    }


def _finding(
    made: Reproduction, place: str, method: str, scans: Index, rng: np.random.Generator
) -> Finding:
    """Say what one method keeps in one place."""
    centres, tolerance = made.centres, made.config.tolerance
    keep = centres.of(method, scans)
    usual = [i for i in scans if made.scans[i].turn == TURN]
    default = centres.of(method, usual)
    density = float(np.median(centres.n_points[default] * centres.ranges[default] ** 2))
    sample = centres.sample(keep)
    asked = {
        statistic: Demand(
            tolerance=tolerance, statistic=statistic, at_range=GREATEST_DISTANCE, density=density
        )
        for statistic in _STATISTICS
    }
    return Finding(
        place=place,
        method=method,
        model=fit_error_model(sample),
        limits={statistic: limits(sample, demand, rng) for statistic, demand in asked.items()},
        errors=summarise(centres.error_3d[default], tolerance),
    )
