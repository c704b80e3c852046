"""Scores of sets of marks: thousands of sets in one call, some microseconds for each stop."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.errors import ConfigError
from spheremark.pipelines.estimation.linear_algebra import invert
from spheremark.pipelines.model import Array, Column, Index, Mask
from spheremark.pipelines.placement.candidates import Candidates
from spheremark.pipelines.placement.centre_model import CentreModel
from spheremark.pipelines.placement.evaluation import predict_observables
from spheremark.pipelines.placement.packing import N_PACKED, packed, variance_of
from spheremark.pipelines.placement.plan import Arrangement, Requirement, Site, Stops
from spheremark.pipelines.placement.station_covariance import (
    LOOSE2,
    Circles,
    Observables,
    best_circles,
    circles_of,
    information_of,
    shared_sigmas,
    shared_variance,
    start_information,
)
from spheremark.pipelines.placement.visibility import find_visibility
from spheremark.pipelines.progress import checkpoint
from spheremark.pipelines.threads import side_by_side

LOST = 1e3
"""What counts for a stop without a position: worse than any that has one [m]."""

_BLOCK = 1000  # places that are predicted at a time


class Problem(NamedTuple):
    """All candidates as observed from all stops; the last are marks that stand already."""

    site: Site
    stops: Stops
    candidates: Candidates
    model: CentreModel
    requirement: Requirement
    standing: Arrangement
    rows: Array  # (c, s, 28) information about free stations, packed
    given: Circles | None  # of the method of three circles
    power: float = np.inf  # of the mean over stops that stands for their largest sigma
    is_loss_first: bool = False  # whether the tolerance after a loss comes before all else

    @property
    def fixed(self) -> Index:
        """Candidates that are the marks that stand."""
        n = len(self.candidates.p_site)
        return np.arange(n - len(self.standing.names), n)

    @property
    def is_seen(self) -> Mask:
        """Which candidates any stop sees, (c,)."""
        if self.given is not None:
            return np.asarray(self.given.is_seen.any(axis=0))
        return np.asarray(self.rows.any(axis=(1, 2)))

    @property
    def gravity(self) -> Array:
        """Information of a free station without marks, packed, (28,)."""
        return packed(start_information(self.shared_variance, self.requirement))

    @property
    def start(self) -> Array:
        """Information of each free station by gravity and marks that stand, packed, (s, 28)."""
        return np.asarray(self.gravity + self.rows[self.fixed].sum(axis=0))

    @property
    def shared_variance(self) -> float:
        """Variance of the common error of all ranges [m^2]."""
        sensor = self.model.sensor
        return shared_variance(sensor.sigma_range_bias, sensor.sigma_range_common)

    def information(self, candidates: Candidates) -> Column:
        """Return the information of candidates, (c, s, 28), in single precision."""
        out = np.empty((len(candidates.p_site), len(self.stops.names), N_PACKED), np.float32)
        _fill(self._replace(candidates=candidates), out)
        return out


def _fill(problem: Problem, out: Array | Column) -> None:
    """Write the information of all candidates about free stations, packed."""
    site, stops, candidates, model, requirement, *_ = problem
    first = 0
    for some in _observed(site, stops, candidates, model, requirement):
        rows = np.swapaxes(packed(information_of(some, requirement)), 0, 1)
        out[first : first + len(rows)] = rows
        first += len(rows)


def problem_of(
    site: Site,
    stops: Stops,
    candidates: Candidates,
    model: CentreModel,
    requirement: Requirement,
    standing: Arrangement | None = None,
) -> Problem:
    """Predict all candidates from all stops; none is nearer to a mark that stands than allowed."""
    if not model.sensor.is_full_turn:
        raise ConfigError(
            f"The gimbal turns through {np.degrees(model.sensor.sweep):.0f} degrees; marks are "
            "placed for a full turn of 360 only. Plans of part of a turn can be evaluated."
        )
    standing = Arrangement.numbered(np.empty((0, 3))) if standing is None else standing
    candidates = with_standing(candidates, standing)
    rows = np.empty((len(candidates.p_site), len(stops.names), N_PACKED))
    problem = Problem(site, stops, candidates, model, requirement, standing, rows, None)
    _fill(problem, rows)
    if requirement.method != "paper":
        return problem
    blocks = _observed(site, stops, candidates, model, requirement)
    every = zip(*(circles_of(some, requirement) for some in blocks), strict=True)
    return problem._replace(given=Circles(*(np.concatenate(part, axis=1) for part in every)))


def with_standing(candidates: Candidates, standing: Arrangement) -> Candidates:
    """Return candidates that keep away from the marks that stand, and these behind them."""
    gaps = cdist(candidates.p_site, standing.p_site).min(axis=1, initial=np.inf)
    keep = gaps >= candidates.apart
    if not len(standing.names):
        return candidates
    return replace(
        candidates,
        p_site=np.concatenate([candidates.p_site[keep], standing.p_site]),
        ground=np.concatenate([candidates.ground[keep], np.zeros(len(standing.names))]),
    )


def _observed(
    site: Site, stops: Stops, candidates: Candidates, model: CentreModel, requirement: Requirement
) -> Iterator[Observables]:
    """Predict candidates from all stops, block by block."""
    for first in range(0, len(candidates.p_site), _BLOCK):
        marks = Arrangement.numbered(candidates.p_site[first : first + _BLOCK])
        visibility = find_visibility(site, stops.p_site, marks)
        yield predict_observables(stops.p_site, marks, model, requirement, visibility)[1]


def scores_of(
    problem: Problem,
    common: Index,
    varied: Index,
    limit: float = np.inf,
    *,
    stops: list[int] | None = None,
) -> Array:
    """Return the largest sigma over all stops, or their power mean, and the mean of sets of marks.

    Each row of ``varied`` joins the common marks. Above the limit numbers are only lower bounds.
    """
    checkpoint()
    requirement, p_stops = problem.requirement, problem.stops.p_site
    rule = limit, problem.power, requirement.resection.sigma_height
    # stops at the edge are mostly the worst, and show first that a set is beyond the limit
    outwards = np.argsort(-np.linalg.norm(p_stops - p_stops.mean(axis=0), axis=1))
    order = outwards if stops is None else np.array(stops)
    out, varied = np.zeros((len(varied), 2)), np.ascontiguousarray(varied)
    given, rows = problem.given, problem.rows

    def part(first: int, last: int) -> None:
        some, found = varied[first:last], out[first:last]
        if given is None:
            base = problem.gravity + rows[common].sum(axis=0)
            _score_each(rows, base, some, order, rule, found)
        else:
            shared = shared_sigmas(problem.shared_variance, requirement)
            _score_circles(given, shared, common, some, order, rule, found)

    side_by_side(part, len(varied), threaded_from=64)
    out /= len(order)
    if np.isfinite(problem.power):
        out[:, 0] **= 1.0 / problem.power
    else:
        out[:, 0] *= len(order)
    return out


@compiled
def _score_each(
    rows: Array,
    base: Array,
    varied: Index,
    order: Index,
    rule: tuple[float, float, float],
    out: Array,
) -> None:
    """Add up the largest sigma, or powers of sigmas, and sigmas of sets of marks over all stops.

    A set is left out once it exceeds the limit of the rule.
    """
    work = np.empty(N_PACKED)
    for m in range(len(varied)):
        for e in order:
            if not _goes_on(out[m, 0], len(order), rule):
                break
            for i in range(N_PACKED):
                work[i] = base[e, i]
            for c in varied[m]:
                for i in range(N_PACKED):
                    work[i] += rows[c, e, i]
            _enter(variance_of(work), rule, out[m])


@compiled
def _score_circles(  # noqa: PLR0913  a kernel takes what it needs
    given: Circles,
    shared: Array,
    common: Index,
    varied: Index,
    order: Index,
    rule: tuple[float, float, float],
    out: Array,
) -> None:
    """Like ``_score_each``, by the three marks at each stop whose circles cut best."""
    n, three = len(common), np.empty(3, np.intp)
    marks = np.empty(n + varied.shape[1], np.intp)
    marks[:n] = common
    for m in range(len(varied)):
        marks[n:] = varied[m]
        for e in order:
            if not _goes_on(out[m, 0], len(order), rule):
                break
            variance = np.inf
            if best_circles(given, e, marks, three):
                parts = given.parts[e, three[0]] + given.parts[e, three[1]]
                parts += given.parts[e, three[2]]
                cofactor = np.empty((3, 3))
                if invert(parts[:, :3].copy(), cofactor):
                    moved = cofactor @ (parts[:, 6:] * shared)
                    cov = cofactor @ parts[:, 3:6].copy() @ cofactor
                    if np.trace(cofactor) <= LOOSE2:
                        variance = np.trace(cov) + (moved * moved).sum()
            _enter(variance, rule, out[m])


@compiled
def _goes_on(sum_or_largest: float, n_stops: int, rule: tuple[float, float, float]) -> bool:
    """Return whether a set of marks may yet stay within the limit."""
    limit, power, _ = rule
    if np.isfinite(power) and np.isfinite(limit):
        return bool(sum_or_largest <= n_stops * limit**power)
    return bool(sum_or_largest <= limit)


@compiled
def _enter(variance: float, rule: tuple[float, float, float], out: Array) -> None:
    """Enter the sigma of a stop into the sums of a set."""
    _, power, sigma_height = rule
    sigma = LOST
    if variance <= LOOSE2:
        sigma = min(np.sqrt(variance + sigma_height**2), LOST)
    out[0] = out[0] + sigma**power if np.isfinite(power) else max(out[0], sigma)
    out[1] += sigma
