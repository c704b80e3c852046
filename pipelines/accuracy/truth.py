"""Errors of centres and stations against truth, and their statistics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from spheremark.pipelines.geometry import inverse, transform, wrap
from spheremark.pipelines.model import (
    Array,
    Beams,
    ControlMarks,
    Index,
    MarkerFits,
    StopTruth,
)

UNMATCHED = -1  # the true mark of a fit that is near none

_NEAR = 0.5  # [m]; a fit farther than this from every true mark is a false marker


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MarkerErrors:
    """Errors of sphere centres against truth.

    Attributes
    ----------
    marks : (n,)
        True mark of each fit; ``UNMATCHED`` for a fit near none: a false marker.
    error_base : (n, 3)
        Estimate minus truth in the base frame; NaN for a false marker [m].
    error_radial : (n,)
        Component along the line from the base to the true centre; NaN likewise [m].
    """

    marks: Index
    error_base: Array
    error_radial: Array

    @property
    def error_3d(self) -> Array:
        """Length of each error; NaN for a false marker, (n,) [m]."""
        return np.asarray(np.linalg.norm(self.error_base, axis=1))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class StationError:
    """Error of a station against truth.

    Attributes
    ----------
    error_site : (3,)
        Estimate minus truth of the position in the site frame [m].
    error_yaw : float
        Estimate minus truth of the heading [rad].
    """

    error_site: Array
    error_yaw: float

    @property
    def error_3d(self) -> float:
        """Length of the error of the position [m]."""
        return float(np.linalg.norm(self.error_site))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ErrorSummary:
    """Statistics of a sample of error lengths.

    Attributes
    ----------
    n : int
        Size of the sample.
    mean, rms, p95, largest : float
        Mean, root mean square, 95th percentile and maximum; NaN for an empty sample [m].
    share_within : float
        Share of the sample within the tolerance, 0 to 1; NaN likewise.
    """

    n: int
    mean: float
    rms: float
    p95: float
    largest: float
    share_within: float


def marker_errors(fits: MarkerFits, stop: StopTruth, marks: ControlMarks) -> MarkerErrors:
    """Compare the centres of one stop with the truth.

    Parameters
    ----------
    fits : MarkerFits
        Centres in the base frame.
    stop : StopTruth
        True pose of the base frame.
    marks : ControlMarks
        True centres.

    Returns
    -------
    MarkerErrors
        In the order of the fits.

    Notes
    -----
    Each fit is paired with the true mark that makes the sum of distances least (Kuhn-Munkres), and
    stays unmatched beyond half a metre. Base frame: errors of the levelling are not included.
    """
    return centre_errors(np.array([f.p_base for f in fits.fits]), stop, marks)


def centre_errors(p_base: ArrayLike, stop: StopTruth, marks: ControlMarks) -> MarkerErrors:
    """Compare centres with the truth, as ``marker_errors`` does.

    Parameters
    ----------
    p_base : (n, 3)
        Centres [m].
    stop : StopTruth
        True pose of the base frame.
    marks : ControlMarks
        True centres.

    Returns
    -------
    MarkerErrors
        In the order of the centres.
    """
    from scipy.optimize import linear_sum_assignment  # slow to import

    found = np.asarray(p_base, dtype=np.float64).reshape(-1, 3)
    true = transform(inverse(stop.T_site_base), marks.p_site)
    distances = np.linalg.norm(found[:, None] - true[None], axis=2)
    rows, columns = linear_sum_assignment(np.minimum(distances, _NEAR))
    near = distances[rows, columns] < _NEAR
    rows, columns = rows[near], columns[near]
    matched = np.full(len(found), UNMATCHED, dtype=np.intp)
    matched[rows] = columns
    errors = np.full((len(found), 3), np.nan)
    errors[rows] = found[rows] - true[columns]
    radial = np.full(len(found), np.nan)
    lines = true[columns] / np.linalg.norm(true[columns], axis=1, keepdims=True)
    radial[rows] = np.sum(errors[rows] * lines, axis=1)
    return MarkerErrors(marks=matched, error_base=errors, error_radial=radial)


def station_error(T_site_station: Array, stop: StopTruth) -> StationError:
    """Compare a station with the truth.

    Parameters
    ----------
    T_site_station : (4, 4)
        The estimate.
    stop : StopTruth
        True pose of the base frame, whose origin and heading are those of the station frame.

    Returns
    -------
    StationError
        In the site frame.

    Notes
    -----
    The heading of the base is the yaw of ``R_site_base = Rz(yaw) Ry(pitch) Rx(roll)``.
    """
    yaw, true = (np.arctan2(T[1, 0], T[0, 0]) for T in (T_site_station, stop.T_site_base))
    return StationError(
        error_site=T_site_station[:3, 3] - stop.T_site_base[:3, 3],
        error_yaw=float(wrap(yaw - true)),
    )


def summarise(errors_3d: ArrayLike, tolerance: float) -> ErrorSummary:
    """Summarise a sample of error lengths.

    Parameters
    ----------
    errors_3d : (n,)
        Lengths of errors; NaN are left out [m].
    tolerance : float
        Error that is accepted [m].

    Returns
    -------
    ErrorSummary
        With the size of the sample that was used.
    """
    sample = np.asarray(errors_3d, dtype=np.float64)
    sample = sample[np.isfinite(sample)]
    if not len(sample):
        return ErrorSummary(
            n=0, mean=np.nan, rms=np.nan, p95=np.nan, largest=np.nan, share_within=np.nan
        )
    return ErrorSummary(
        n=len(sample),
        mean=float(sample.mean()),
        rms=float(np.sqrt(np.mean(sample**2))),
        p95=float(np.quantile(sample, 0.95)),
        largest=float(sample.max()),
        share_within=float(np.mean(sample <= tolerance)),
    )


def mean_incidence(returns: Beams, p_base: Array, radius: float) -> float:
    """Return the mean angle between beams and the normals of a sphere where they meet it.

    Parameters
    ----------
    returns : Beams
        Beams that met the sphere.
    p_base : (3,)
        Its centre [m].
    radius : float
        Its radius [m].

    Returns
    -------
    float
        The angle; a beam whose axis misses the sphere counts as grazing [rad].
    """
    to_centre = p_base - returns.origins_base
    along = np.sum(to_centre * returns.directions_base, axis=1)
    beside = np.sqrt(np.maximum(np.sum(to_centre**2, axis=1) - along**2, 0.0))
    return float(np.mean(np.arcsin(np.minimum(beside / radius, 1.0))))
