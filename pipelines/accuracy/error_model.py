"""Dependence of errors on distance, point count and incidence, and limits that keep a tolerance.

``fit_error_model`` fits a power law to errors; ``limits`` gives the greatest distance and smallest
point count that keep a tolerance, with confidence intervals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from spheremark.pipelines.errors import TooFewObservationsError
from spheremark.pipelines.estimation.linear_algebra import inverse
from spheremark.pipelines.estimation.robust import (
    HUBER,
    huber_weights,
    robust_sigma,
    sandwich_covariance,
)
from spheremark.pipelines.model import Array, Index, same_length, seal

Statistic = Literal["p95", "mean"]
"""What must be within a tolerance: the 95th percentile of the error, or, as in the study, its mean.
"""

TERMS = ("distance", "count", "incidence")
"""Explanatory variables of an error, in the order of a model's exponents."""

_LEAST_ERROR = (
    1e-5  # [m]; smaller errors are raised to this: their logarithms would dominate the fit
)
_PER_TERM = 4  # errors required for each unknown of a model
_SIGMA_EXPONENT = 3.0  # prior of every exponent about 0: physics gives -1/2 to 2
_N_STEPS = 12  # of reweighting; three or four change the fourth digit
_GROUPS_MIN = 5  # scans for a resampling by scans; with fewer, single errors are resampled
_P95 = 0.95
_CONFIDENCE = (0.025, 0.975)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ErrorSample:
    """Errors of sphere centres with explanatory variables, one row per centre.

    Attributes
    ----------
    ranges : (n,)
        Distances from the LiDAR to the centres [m].
    n_points : (n,)
        Numbers of returns that are used.
    incidences : (n,)
        Mean angles between beam and normal of the sphere; NaN where they are not known [rad].
    errors_3d : (n,)
        Lengths of the errors; NaN where they are not known [m].
    scans : (n,)
        Number of the scan of each: errors of one scan share those of the rig.
    """

    ranges: Array
    n_points: Array
    incidences: Array
    errors_3d: Array
    scans: Index

    def __post_init__(self) -> None:
        names = ("ranges", "n_points", "incidences", "errors_3d", "scans")
        seal(self, **dict.fromkeys(names, (None,)))
        same_length(self, *names)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ErrorModel:
    """Power law of errors in distance, point count and sine of incidence.

    Attributes
    ----------
    terms : tuple of str
        Those of ``TERMS`` that vary in the sample.
    exponents : (k,)
        Their powers.
    sigma_exponents : (k,)
        Standard deviations of the powers, robust, with the errors of one scan taken as dependent.
    correlation : float
        Correlation of the powers of distance and count; near -1 or 1 they are not separable,
        as when all scans took the same time. NaN without both terms.
    typical : float
        Error at the reference [m].
    reference : (3,)
        Distance [m], count and sine of incidence in the middle of the sample.
    density : float
        Median of count times squared distance: returns of one turn on a sphere at 1 m [m^2].
    factor_p95, factor_mean : float
        95th percentile and mean of error over typical error.
    range_span, count_span : tuple of float
        Least and greatest distance [m] and count of the sample: the range of validity.
    n, n_scans : int
        Numbers of errors and scans in the sample.
    """

    terms: tuple[str, ...]
    exponents: Array
    sigma_exponents: Array
    correlation: float
    typical: float
    reference: Array
    density: float
    factor_p95: float
    factor_mean: float
    range_span: tuple[float, float]
    count_span: tuple[float, float]
    n: int
    n_scans: int

    def __post_init__(self) -> None:
        k = len(self.terms)
        seal(self, exponents=(k,), sigma_exponents=(k,), reference=(3,))

    def exponent(self, term: str) -> float:
        """Return the power of one of ``TERMS``; 0 for a term that is not in the model."""
        return float(self.exponents[self.terms.index(term)]) if term in self.terms else 0.0

    def sigma(self, term: str) -> float:
        """Return the standard deviation of that power; NaN for a term that is not in the model."""
        return float(self.sigma_exponents[self.terms.index(term)]) if term in self.terms else np.nan

    def predict(
        self, ranges: ArrayLike, n_points: ArrayLike, statistic: Statistic = "p95"
    ) -> Array:
        """Return the error to expect at distances with numbers of returns.

        Parameters
        ----------
        ranges : (n,) or float
            Distances [m].
        n_points : (n,) or float
            Numbers of returns.
        statistic : {"p95", "mean"}
            What of the error.

        Returns
        -------
        (n,)
            Errors, 3-D, at the incidence of the reference [m].
        """
        factor = self.factor_p95 if statistic == "p95" else self.factor_mean
        d = np.asarray(ranges, dtype=np.float64) / self.reference[0]
        count = np.asarray(n_points, dtype=np.float64) / self.reference[1]
        powers = d ** self.exponent("distance") * count ** self.exponent("count")
        return np.asarray(self.typical * factor * powers)


@dataclass(frozen=True, slots=True, kw_only=True)
class Bound:
    """Limit of a variable up to which the tolerance is kept, with its confidence interval.

    Attributes
    ----------
    value, low, high : float
        The limit and its 95 % confidence interval, in the unit of the variable. Distances: the
        tolerance is kept from the nearest up to here; 0 means that not even the nearest keeps it,
        infinity that all do. Counts: it is kept from here up to the most returns; 0 means that all
        keep it, infinity that not even the most do.
    seen : tuple of float
        Least and greatest value in the sample.
    """

    value: float
    low: float
    high: float
    seen: tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Demand:
    """Tolerance of errors, and the conditions for which limits are computed.

    Attributes
    ----------
    tolerance : float
        Error that is accepted [m].
    statistic : {"p95", "mean"}
        What of the error must be within it; the study's is the mean.
    at_range : float or None
        Distance of the smallest count; the middle of the sample by default [m].
    density : float or None
        Count times squared distance of the turn, for the greatest distance; that of the middle of
        the sample by default [m^2].
    """

    tolerance: float
    statistic: Statistic = "p95"
    at_range: float | None = None
    density: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """Limits that keep a tolerance.

    Attributes
    ----------
    greatest_distance : Bound
        Distance up to which it is kept, with as many returns as the turn gives there [m].
    smallest_count : Bound
        Number of returns from which it is kept at ``at_range``.
    at_range : float
        Distance of the smallest count [m].
    """

    greatest_distance: Bound
    smallest_count: Bound
    at_range: float


def fit_error_model(sample: ErrorSample) -> ErrorModel:
    """Fit how errors depend on distance, point count and incidence.

    Parameters
    ----------
    sample : ErrorSample
        Errors of one method.

    Returns
    -------
    ErrorModel
        Powers with standard deviations.

    Raises
    ------
    TooFewObservationsError
        If there are fewer than 16 errors.

    Notes
    -----
    Robust regression of the logarithm of the 3-D error (Huber's psi, k = 1.345, scale from the
    median absolute deviation) with a weak prior of 0 +- 3 on each power, so that a sample in which
    nothing varies has an answer too, and a large sigma. The quantiles come from the residuals
    themselves, because the errors of a biased method are not chi-distributed. Standard deviations
    are of the sandwich form, clustered by scan. Distance and count are separable only where the
    count was varied at fixed distance, by the time of a turn.
    """
    return _solved(_regression(sample))


def limits(
    sample: ErrorSample, demand: Demand, rng: np.random.Generator, *, n_resamples: int = 400
) -> Limits:
    """Return the greatest distance and the smallest count of returns that keep a tolerance.

    Parameters
    ----------
    sample : ErrorSample
        Errors of one method.
    demand : Demand
        Tolerance and conditions.
    rng : numpy.random.Generator
        Draws the resamples.
    n_resamples : int
        Number of resamples.

    Returns
    -------
    Limits
        Limits with 95 % confidence intervals, within the range of the sample.

    Raises
    ------
    TooFewObservationsError
        If there are fewer than 16 errors.

    Notes
    -----
    The model of ``fit_error_model`` without incidence, which cannot be chosen and whose variation
    therefore counts among the errors, is fitted to the sample and again to resamples of whole scans
    (of single errors, where there are fewer than five scans); the interval is that of their bounds
    (percentile bootstrap). Cost grows linearly with errors times resamples.
    """
    (found,) = limits_of_each(sample, (demand,), rng, n_resamples=n_resamples)
    return found


def limits_of_each(
    sample: ErrorSample,
    demands: Sequence[Demand],
    rng: np.random.Generator,
    *,
    n_resamples: int = 400,
) -> tuple[Limits, ...]:
    """Return the limits of several tolerances or statistics from the same resamples.

    Parameters
    ----------
    sample, rng, n_resamples
        See ``limits``.
    demands : sequence of Demand
        Tolerances and conditions.

    Returns
    -------
    tuple of Limits
        Of each demand.
    """
    data = _regression(sample, TERMS[:2])
    drawn = _resampled(data.scans, n_resamples, rng)
    weights = np.vstack([np.ones(len(data.y)), drawn])
    coefficients = _coefficients(data, weights)
    return tuple(_limits(data, one, coefficients, weights) for one in demands)


def _limits(data: _Regression, demand: Demand, coefficients: Array, weights: Array) -> Limits:
    """Return the limits of a demand from the fits to all resamples."""
    if demand.density is not None:
        data = data._replace(density=demand.density)
    factors = np.log(_factors(data, coefficients, weights, demand.statistic))
    excess = np.log(demand.tolerance) - coefficients[:, 0] - factors  # what powers may add
    at = float(data.reference[0]) if demand.at_range is None else demand.at_range
    return Limits(
        greatest_distance=_bound(_distances(data, coefficients, excess), data.range_span),
        smallest_count=_bound(_counts(data, coefficients, excess, at), data.count_span),
        at_range=at,
    )


class _Regression(NamedTuple):
    """A sample as a linear problem: logarithms, centred so that the reference is zero."""

    X: Array
    y: Array
    scans: Index
    terms: tuple[str, ...]
    reference: Array
    density: float
    range_span: tuple[float, float]
    count_span: tuple[float, float]
    scale: float


def _regression(sample: ErrorSample, wanted: tuple[str, ...] = TERMS) -> _Regression:
    """Choose the rows that are known and, of the wanted terms, those that vary."""
    is_known = np.isfinite(sample.errors_3d) & (sample.n_points > 0) & (sample.ranges > 0)
    has_incidence = bool(np.isfinite(sample.incidences[is_known]).all())
    least = _PER_TERM * (1 + len(TERMS))
    if is_known.sum() < least:
        raise TooFewObservationsError(
            f"{int(is_known.sum())} known errors are too few for a model of distance and count; "
            f"{least} are needed."
        )
    ranges, counts = sample.ranges[is_known], sample.n_points[is_known].astype(np.float64)
    sines = np.sin(sample.incidences[is_known]) if has_incidence else np.ones(len(ranges))
    causes = np.column_stack([ranges, counts, np.maximum(sines, 1e-3)])
    reference = np.median(causes, axis=0)
    logs = np.log(causes / reference)
    varies = (np.ptp(logs, axis=0) > 1e-6) & np.isin(TERMS, wanted)
    y = np.log(np.maximum(sample.errors_3d[is_known], _LEAST_ERROR))
    data = _Regression(
        X=np.column_stack([np.ones(len(y)), logs[:, varies]]),
        y=y,
        scans=sample.scans[is_known],
        terms=tuple(term for term, use in zip(TERMS, varies, strict=True) if use),
        reference=reference,
        density=float(np.median(counts * ranges**2)),
        range_span=(float(ranges.min()), float(ranges.max())),
        count_span=(float(counts.min()), float(counts.max())),
        scale=1.0,
    )
    return data._replace(scale=_scale(data))


def _scale(data: _Regression) -> float:
    """Return the spread of the residuals about a first, plain fit."""
    beta = np.linalg.lstsq(data.X, data.y, rcond=None)[0]
    residuals = data.y - data.X @ beta
    return max(robust_sigma(residuals - np.median(residuals)), 1e-6)


def _coefficients(data: _Regression, weights: Array) -> Array:
    """Return the robust coefficients for each row of weights, (b, k)."""
    products = (data.X[:, :, None] * data.X[:, None, :]).reshape(len(data.y), -1)
    k = data.X.shape[1]
    prior = np.diag([0.0] + [(data.scale / _SIGMA_EXPONENT) ** 2] * (k - 1))
    robust = weights
    beta: Array = np.zeros((len(weights), k))
    for _ in range(_N_STEPS):
        normal = (robust @ products).reshape(-1, k, k) + prior
        right = robust @ (data.X * data.y[:, None])
        beta = np.asarray(np.linalg.solve(normal, right[..., None])[..., 0], dtype=np.float64)
        robust = weights * huber_weights((data.y - beta @ data.X.T) / data.scale)
    return beta


def _factors(data: _Regression, coefficients: Array, weights: Array, statistic: Statistic) -> Array:
    """Return the statistic of error over typical error for each row of weights, (b,)."""
    ratios = np.exp(data.y - coefficients @ data.X.T)
    if statistic == "mean":
        return np.asarray(np.sum(weights * ratios, axis=1) / weights.sum(axis=1))
    order = np.argsort(ratios, axis=1)
    shares = np.cumsum(np.take_along_axis(weights, order, axis=1), axis=1)
    place = np.argmax(shares >= _P95 * shares[:, -1:], axis=1)
    return np.asarray(ratios[np.arange(len(ratios)), order[np.arange(len(ratios)), place]])


def _solved(data: _Regression) -> ErrorModel:
    """Return the model of a sample with the covariance of its powers."""
    ones = np.ones((1, len(data.y)))
    beta = _coefficients(data, ones)
    cov = _covariance(data, beta[0])
    sigmas = np.sqrt(np.diag(cov))
    has_both = {"distance", "count"} <= set(data.terms)
    return ErrorModel(
        terms=data.terms,
        exponents=beta[0, 1:].copy(),
        sigma_exponents=sigmas[1:].copy(),
        correlation=float(cov[1, 2] / (sigmas[1] * sigmas[2])) if has_both else np.nan,
        typical=float(np.exp(beta[0, 0])),
        reference=data.reference,
        density=data.density,
        factor_p95=float(_factors(data, beta, ones, "p95")[0]),
        factor_mean=float(_factors(data, beta, ones, "mean")[0]),
        range_span=data.range_span,
        count_span=data.count_span,
        n=len(data.y),
        n_scans=len(np.unique(data.scans)),
    )


def _covariance(data: _Regression, beta: Array) -> Array:
    """Return the covariance of the coefficients, clustered by scan where there are some."""
    residuals = data.y - data.X @ beta
    psi = residuals * huber_weights(residuals / data.scale)
    is_inside = (np.abs(residuals) < HUBER * data.scale).astype(np.float64)
    k = data.X.shape[1]
    prior = np.diag([0.0] + [(data.scale / _SIGMA_EXPONENT) ** 2] * (k - 1))
    bread = inverse((data.X * is_inside[:, None]).T @ data.X + prior)
    return sandwich_covariance(bread, data.X * psi[:, None], _clusters(data.scans), prior)


def _clusters(scans: Index) -> Index:
    """Return which rows are drawn together: those of a scan, or each alone where scans are few."""
    _, clusters = np.unique(scans, return_inverse=True)
    is_few = int(clusters.max()) + 1 < _GROUPS_MIN
    return np.asarray(np.arange(len(scans)) if is_few else clusters, dtype=np.intp)


def _resampled(scans: Index, n: int, rng: np.random.Generator) -> Array:
    """Return how often each row is in each resample, (n, rows)."""
    clusters = _clusters(scans)
    n_clusters = int(clusters.max()) + 1
    counts = rng.multinomial(n_clusters, np.full(n_clusters, 1.0 / n_clusters), n)
    return np.asarray(counts[:, clusters], dtype=np.float64)


def _power(data: _Regression, coefficients: Array, term: str) -> Array:
    """Return the power of a term in each fit; 0 for one that is not in the model."""
    if term not in data.terms:
        return np.zeros(len(coefficients))
    return np.asarray(coefficients[:, 1 + data.terms.index(term)])


def _crossing(
    slope: Array, room: Array, span: tuple[float, float], reference: float
) -> tuple[Array, Array, Array]:
    """Return where errors cross the tolerance within the span, and whether its ends keep it."""
    low, high = np.log(np.array(span) / reference)
    crossing = np.clip(room / np.where(slope == 0, 1.0, slope), low, high)
    return reference * np.exp(crossing), slope * low <= room, slope * high <= room


def _distances(data: _Regression, coefficients: Array, excess: Array) -> Array:
    """Return up to which distance each fit keeps the tolerance, with ``density`` returns at 1 m."""
    of_range, of_count = (_power(data, coefficients, term) for term in TERMS[:2])
    turn = np.log(data.density / (data.reference[0] ** 2 * data.reference[1]))
    slope, room = of_range - 2.0 * of_count, excess - of_count * turn
    found, near, far = _crossing(slope, room, data.range_span, float(data.reference[0]))
    return np.where(near, np.where(far, np.inf, found), 0.0)


def _counts(data: _Regression, coefficients: Array, excess: Array, at_range: float) -> Array:
    """Return from which count on each fit keeps the tolerance at a distance."""
    of_range, of_count = (_power(data, coefficients, term) for term in TERMS[:2])
    room = excess - of_range * np.log(at_range / data.reference[0])
    found, few, many = _crossing(of_count, room, data.count_span, float(data.reference[1]))
    return np.where(many, np.where(few, 0.0, found), np.inf)


def _bound(values: Array, seen: tuple[float, float]) -> Bound:
    """Return the first value with the interval that the others span."""
    low, high = np.quantile(values[1:], _CONFIDENCE, method="inverted_cdf")
    return Bound(value=float(values[0]), low=float(low), high=float(high), seen=seen)
