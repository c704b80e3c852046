"""Two results beside each other: differences of points, parameters and pairs, with tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spheremark.pipelines.errors import TooFewObservationsError
from spheremark.pipelines.geometry import rot_z
from spheremark.pipelines.model import Array, Mask, seal

LEVEL = 0.05  # probability that any difference of a table is called significant by chance
_PAIRS_MIN = 6  # fewer pairs cannot reach the level in a signed-rank test


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PointDifferences:
    """Differences of points that two results share, second minus first.

    Attributes
    ----------
    differences : (n, 3)
        Along the axes of the first result [m].
    sigmas : (n,)
        Square root of the trace of the covariance of each [m].
    statistics : (n,)
        Squared length by that covariance: chi-squared of three degrees of freedom by chance.
    p_values : (n,)
        Probability of a larger one by chance.
    significant : (n,)
        Whether it is larger than chance gives in a table of so many, at the level of 5 %.
    """

    differences: Array
    sigmas: Array
    statistics: Array
    p_values: Array
    significant: Mask

    def __post_init__(self) -> None:
        seal(self, differences=(None, 3), sigmas=(None,), statistics=(None,), p_values=(None,))


@dataclass(frozen=True, slots=True, kw_only=True)
class PairedDifference:
    """The typical difference of paired values, second minus first.

    Attributes
    ----------
    median, low, high : float
        Median of the differences and its 95 % interval, by order statistics.
    p_value : float
        Of the signed-rank test that the differences are symmetric about zero.
    n : int
        Pairs.
    """

    median: float
    low: float
    high: float
    p_value: float
    n: int


def compare_points(
    first: Array, cov_first: Array, second: Array, cov_second: Array
) -> PointDifferences:
    """Return the differences of points, tested against their covariances.

    Parameters
    ----------
    first, second : (n, 3)
        The same points in two results [m].
    cov_first, cov_second : (n, 3, 3)
        Their covariances [m^2].

    Returns
    -------
    PointDifferences
        In the order of the points.

    Notes
    -----
    The results are taken as independent. Two results of one log share its noise: their differences
    vary less than that, so that a significant one is significant all the more. Holm's procedure
    over all points.
    """
    from scipy.stats import chi2  # slow to import

    differences = np.asarray(second - first, dtype=np.float64).reshape(-1, 3)
    cov = np.asarray(cov_first + cov_second).reshape(-1, 3, 3)
    solved = np.linalg.solve(cov, differences[..., None])[..., 0]
    statistics = np.sum(differences * solved, axis=1)
    p_values = np.asarray(chi2.sf(statistics, 3))
    return PointDifferences(
        differences=differences,
        sigmas=np.sqrt(np.trace(cov, axis1=1, axis2=2)),
        statistics=statistics,
        p_values=p_values,
        significant=holm(p_values),
    )


def aligned(first: Array, second: Array) -> Array:
    """Return the second points moved onto the first by heading and place.

    Parameters
    ----------
    first, second : (n, 3)
        The same points in two levelled frames, at least two apart horizontally [m].

    Returns
    -------
    (n, 3)
        The second points [m].

    Raises
    ------
    TooFewObservationsError
        If there are fewer than two points.

    Notes
    -----
    Least squares with equal weights; for networks whose frame is that of their first station.
    """
    if len(first) < 2:
        raise TooFewObservationsError(f"{len(first)} common points; two or more define a frame.")
    a, b = first - first.mean(axis=0), second - second.mean(axis=0)
    heading = np.arctan2(np.sum(b[:, 0] * a[:, 1] - b[:, 1] * a[:, 0]), np.sum(b[:, :2] * a[:, :2]))
    return np.asarray(b @ rot_z(float(heading)).T + first.mean(axis=0))


def compare_numbers(
    first: Array, sigma_first: Array, second: Array, sigma_second: Array
) -> tuple[Array, Array, Mask]:
    """Return differences of numbers, their standard deviations, and which are significant.

    Parameters
    ----------
    first, sigma_first, second, sigma_second : (n,)
        The same quantities in two results, each row in a unit of its own.

    Returns
    -------
    tuple of array
        Second minus first, its standard deviation, and Holm's decision at the level of 5 %.
    """
    from scipy.stats import norm  # slow to import

    differences, sigmas = second - first, np.hypot(sigma_first, sigma_second)
    known = sigmas > 0
    ratios = np.where(known, np.abs(differences) / np.where(known, sigmas, 1.0), 0.0)
    return differences, sigmas, holm(np.where(known, 2.0 * norm.sf(ratios), 1.0))


def compare_pairs(first: Array, second: Array) -> PairedDifference:
    """Return the typical difference of paired values, for instance of two methods at each stop.

    Parameters
    ----------
    first, second : (n,)
        Values of independent units, at least six.

    Returns
    -------
    PairedDifference
        Median with its interval, and the test.

    Raises
    ------
    TooFewObservationsError
        If there are fewer pairs.

    Notes
    -----
    Wilcoxon's signed-rank test; the interval of the median is that of the sign test.
    """
    from scipy.stats import binom, wilcoxon  # slow to import

    differences = np.sort(second - first)
    n = len(differences)
    if n < _PAIRS_MIN:
        raise TooFewObservationsError(f"{n} common stops; {_PAIRS_MIN} or more are compared.")
    k = max(int(binom.ppf(LEVEL / 2.0, n, 0.5)) - 1, 0)
    is_same = not np.any(differences)
    return PairedDifference(
        median=float(np.median(differences)),
        low=float(differences[k]),
        high=float(differences[n - 1 - k]),
        p_value=1.0 if is_same else float(wilcoxon(differences).pvalue),
        n=n,
    )


def holm(p_values: Array) -> Mask:
    """Return which of several tests reject, at 5 % for all together (Holm 1979).

    Parameters
    ----------
    p_values : (n,)
        Of each test.

    Returns
    -------
    (n,)
        Whether it rejects.
    """
    n = len(p_values)
    order = np.argsort(p_values)
    passes = p_values[order] * (n - np.arange(n)) <= LEVEL
    n_first = int(np.argmin(np.append(passes, False)))
    rejected = np.zeros(n, dtype=np.bool_)
    rejected[order[:n_first]] = True
    return rejected
