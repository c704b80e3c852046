"""Greatest distance and smallest count that keep the tolerance, with their confidence."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.accuracy.error_model import (
    Bound,
    Demand,
    ErrorModel,
    ErrorSample,
    Limits,
    Statistic,
    fit_error_model,
    limits_of_each,
)
from spheremark.pipelines.errors import TooFewObservationsError
from spheremark.web.columns import Columns, by_method, floats, has_errors, texts
from spheremark.web.templating import signed

_SEED = 20  # of the resamples: the same rows give the same page
_N_RESAMPLES = 200
_STATISTICS: tuple[Statistic, ...] = ("p95", "mean")


@dataclass(frozen=True, slots=True, kw_only=True)
class Statement:
    """The limits of one method with their error model, or the reason for their absence."""

    method: str
    place: str
    model: ErrorModel | None
    p95: Limits | None
    mean: Limits | None
    reason: str = ""

    @property
    def distance(self) -> str:
        """Greatest distance at which 95 % of the errors are within the tolerance."""
        return distance_words(self.p95.greatest_distance) if self.p95 else self.reason

    @property
    def count(self) -> str:
        """Smallest count at which they are."""
        return count_words(self.p95.smallest_count) if self.p95 else ""

    @property
    def mean_distance(self) -> str:
        """Greatest distance at which the mean error, the measure of the study, is within it."""
        return distance_words(self.mean.greatest_distance) if self.mean else ""

    @property
    def mean_count(self) -> str:
        """Smallest count at which it is."""
        return count_words(self.mean.smallest_count) if self.mean else ""

    def power(self, term: str) -> str:
        """Return the power of one of the model's terms with its standard deviation."""
        if self.model is None or term not in self.model.terms:
            return "\N{EN DASH}"
        power, sigma = self.model.exponent(term), self.model.sigma(term)
        if sigma > abs(power):
            return f"not determined (± {sigma:.2f})"
        return f"{signed(power)} ± {sigma:.2f}"


def exponents(one: Statement) -> str:
    """Return the powers of a model that its errors determine, as a sentence; the rest by name."""
    if one.model is None:
        return one.reason
    known = [
        f"{term} to the power {one.power(term)}"
        for term in one.model.terms
        if one.model.sigma(term) <= abs(one.model.exponent(term))
    ]
    rest = [term for term in one.model.terms if not any(text.startswith(term) for text in known)]
    unknown = f"{' and '.join(rest)} not determined" if rest else ""
    return "; ".join(part for part in (", ".join(known), unknown) if part)


def statements(fits: Columns, tolerance_m: float, *, place: str = "") -> tuple[Statement, ...]:
    """Return the limits of each method of a table of fits; none without truth."""
    if not has_errors(fits):
        return ()
    return tuple(_statement(method, rows, tolerance_m, place) for method, rows in by_method(fits))


def _statement(method: str, rows: Columns, tolerance_m: float, place: str) -> Statement:
    """Return the limits of one method."""
    _, scans = np.unique(np.array(texts(rows, "stop"), dtype=str), return_inverse=True)
    sample = ErrorSample(
        ranges=floats(rows, "range_m").copy(),
        n_points=floats(rows, "n_points").copy(),
        incidences=_incidences(rows),
        errors_3d=floats(rows, "error_3d_m").copy(),
        scans=scans.astype(np.intp),
    )
    demands = [Demand(tolerance=tolerance_m, statistic=one) for one in _STATISTICS]
    rng = np.random.default_rng(_SEED)
    try:
        model = fit_error_model(sample)
        p95, mean = limits_of_each(sample, demands, rng, n_resamples=_N_RESAMPLES)
    except TooFewObservationsError as error:
        return Statement(
            method=method, place=place, model=None, p95=None, mean=None, reason=str(error)
        )
    return Statement(method=method, place=place, model=model, p95=p95, mean=mean)


def _incidences(rows: Columns) -> NDArray[np.float64]:
    """Return the incidences of rows [rad]; NaN where the table has none."""
    if "incidence_deg" not in rows:
        return np.full(len(rows["stop"]), np.nan)
    return np.radians(floats(rows, "incidence_deg"))


def distance_words(bound: Bound) -> str:
    """Format a greatest distance with its interval, within the observed range."""
    return _with_interval(bound, _distance)


def count_words(bound: Bound) -> str:
    """Format a smallest count with its interval, within the observed range."""
    return _with_interval(bound, _count)


def _with_interval(bound: Bound, write: Callable[[float, tuple[float, float]], str]) -> str:
    """Format a bound and, where its ends differ, its interval."""
    value, low, high = (write(one, bound.seen) for one in (bound.value, bound.low, bound.high))
    return value if low == high == value else f"{value} ({low} to {high})"


def _distance(value: float, seen: tuple[float, float]) -> str:
    """Format one distance."""
    if value == 0:
        return "nowhere"
    return f"≥ {seen[1]:.1f} m" if math.isinf(value) else f"{value:.1f} m"


def _count(value: float, seen: tuple[float, float]) -> str:
    """Format one count."""
    if math.isinf(value):
        return f"> {seen[1]:.0f}"
    return f"≤ {seen[0]:.0f}" if value == 0 else f"{math.ceil(value)}"
