"""Scores of sets of marks: thousands of sets in one call, some microseconds for each stop."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.model import Array, Index
from spheremark.pipelines.placement.bounds import (
    information_of,
    start_information,
    unpacked,
)
from spheremark.pipelines.placement.candidates import Candidates
from spheremark.pipelines.placement.centre_model import CentreModel
from spheremark.pipelines.placement.evaluation import predict_observables
from spheremark.pipelines.placement.plan import Arrangement, Requirement, Site, Stops
from spheremark.pipelines.placement.station_covariance import (
    Observables,
    Pairs,
    add_mark,
    best_circles,
    pairs_of,
    shared_sigmas,
    shared_variance,
    sigma_3d,
    start_of,
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
    pairs: Pairs
    power: float = np.inf  # of the mean over stops that stands for their largest sigma
    is_loss_first: bool = False  # whether the tolerance after a loss comes before all else

    @property
    def fixed(self) -> Index:
        """Candidates that are the marks that stand."""
        n = len(self.candidates.p_site)
        return np.arange(n - len(self.standing.names), n)

    @property
    def start(self) -> Array:
        """Information of each station by gravity and by the marks that stand, (s, 7, 7)."""
        standing = self.candidates.rows(self.fixed)
        gravity = start_information(self.shared_variance, self.requirement)
        if not len(standing.p_site):
            return np.tile(gravity, (len(self.stops.names), 1, 1))
        return gravity + unpacked(self.information(standing).sum(axis=0))

    @property
    def shared_variance(self) -> float:
        """Variance of the common error of all ranges [m^2]."""
        sensor = self.model.sensor
        return shared_variance(sensor.sigma_range_bias, sensor.sigma_range_common)

    def information(self, candidates: Candidates) -> Array:
        """Return the information of candidates, block by block."""
        blocks = _observed(self.site, self.stops, candidates, self.model, self.requirement)
        return np.concatenate([information_of(some, self.requirement) for some in blocks])


def problem_of(
    site: Site,
    stops: Stops,
    candidates: Candidates,
    model: CentreModel,
    requirement: Requirement,
    standing: Arrangement | None = None,
) -> Problem:
    """Predict all candidates from all stops; none is nearer to a mark that stands than allowed."""
    standing = Arrangement.numbered(np.empty((0, 3))) if standing is None else standing
    candidates = with_standing(candidates, standing)
    blocks = _observed(site, stops, candidates, model, requirement)
    parts = zip(*(pairs_of(some, requirement) for some in blocks), strict=True)
    pairs = Pairs(*(np.concatenate(part, axis=1) for part in parts))
    return Problem(site, stops, candidates, model, requirement, standing, pairs)


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
    sigmas = shared_sigmas(problem.shared_variance, requirement)
    rule = limit, problem.power, requirement.resection.sigma_height
    # stops at the edge are mostly the worst, and show first that a set is beyond the limit
    outwards = np.argsort(-np.linalg.norm(p_stops - p_stops.mean(axis=0), axis=1))
    order = outwards if stops is None else np.array(stops)
    out = np.zeros((len(varied), 2))
    start, varied = start_of(requirement), np.ascontiguousarray(varied)

    def part(first: int, last: int) -> None:
        rows = varied[first:last]
        _score_each(problem.pairs, start, sigmas, common, rows, order, rule, out[first:last])

    side_by_side(part, len(varied), threaded_from=64)
    out /= len(order)
    if np.isfinite(problem.power):
        out[:, 0] **= 1.0 / problem.power
    else:
        out[:, 0] *= len(order)
    return out


@compiled
def _score_each(  # noqa: PLR0913  a kernel takes what it needs
    pairs: Pairs,
    start: Array,
    shared: Array,
    common: Index,
    varied: Index,
    order: Index,
    rule: tuple[float, float, float],
    out: Array,
) -> None:
    """Add up the largest sigma, or powers of sigmas, and sigmas of sets of marks over all stops.

    A set is left out once it exceeds the limit of the rule.
    """
    limit, power, sigma_height = rule
    p, n, is_smooth = len(start), len(common), np.isfinite(power)
    beyond = len(order) * limit**power if is_smooth and np.isfinite(limit) else limit
    base = start.copy(), start.copy(), np.zeros((p, len(shared)))
    work = start.copy(), start.copy(), np.zeros((p, len(shared)))
    marks, three = np.empty(n + varied.shape[1], np.intp), np.empty(3, np.intp)
    marks[:n] = common
    for e in order:
        base[0][:], base[1][:], base[2][:] = start, start, 0.0
        if p > 3:
            _add_seen(pairs, e, common, base)
        for m in range(len(varied)):
            if out[m, 0] > beyond:
                continue
            work[0][:], work[1][:], work[2][:] = base[0], base[1], base[2]
            used, is_fixed = varied[m], True
            if p == 3:
                marks[n:] = varied[m]
                is_fixed = best_circles(pairs, e, marks, three)
                used = three
            sigma = LOST
            if is_fixed:
                _add_seen(pairs, e, used, work)
                sigma = min(sigma_3d(*work, shared, sigma_height), LOST)
            out[m, 0] = out[m, 0] + sigma**power if is_smooth else max(out[m, 0], sigma)
            out[m, 1] += sigma


@compiled
def _add_seen(pairs: Pairs, e: int, marks: Index, work: tuple[Array, Array, Array]) -> None:
    """Add those of some marks that are found to the equations of a station."""
    for c in marks:
        if pairs.is_seen[e, c]:
            add_mark(pairs, e, c, work[0], work[1], work[2])
