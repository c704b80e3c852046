"""Where to put marks: exchanges between places of a grid, then steps off it, with a bound.

A set of marks is scored in some microseconds per stop; thousands of sets are scored in one call.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.errors import ConfigError, DegenerateGeometryError
from spheremark.pipelines.model import Array, Index
from spheremark.pipelines.placement.bounds import (
    gained,
    groups_of,
    information_of,
    least_sigmas,
    relax,
    start_information,
    widest_sigma,
)
from spheremark.pipelines.placement.candidates import (
    CANDIDATES_MAX,
    Candidates,
    find_candidates,
    places_near,
)
from spheremark.pipelines.placement.centre_model import CentreModel
from spheremark.pipelines.placement.evaluation import check_sizes, evaluate, predict_observables
from spheremark.pipelines.placement.plan import Arrangement, Evaluation, Requirement, Site, Stops
from spheremark.pipelines.placement.station_covariance import (
    Observables,
    Pairs,
    add_mark,
    best_circles,
    pairs_of,
    shared_sigmas,
    sigma_3d,
    start_of,
)
from spheremark.pipelines.placement.visibility import find_visibility
from spheremark.pipelines.progress import checkpoint
from spheremark.pipelines.threads import side_by_side

MARKS_MOST = 40
"""Marks that are placed at most."""

_LOST = 1e3  # [m] counts for a stop without a position: worse than any that has one
_Z_95 = 1.96  # sigmas within which an error of any shape lies with 95 %: 3-D sigma on one axis
_ROUNDS_MAX = 30  # of exchanges; four to eight settle
_DRAWN_EVENLY, _DRAWN_BY_SHARES = 1600, 400  # random arrangements, of which starts are chosen
_MARKS_STARTED, _STARTS_MIN, _STARTS_MAX = 48, 3, 12  # in all descents on the grid; descents
_POLISHED = 3  # of these that are carried off the grid
_FINEST = 0.01  # [m] last step off the grid: finer than a mark can be staked out
_POWER = 12.0  # of the mean over stops that is as good as their largest, and smoother
_WORTH = 0.9998  # of the objective that is reached: a smaller gain ends a search
_WORSE_MOST = 1.3  # than now, at most, while the loss of a mark would break the tolerance
_TRIED = 32  # places for a mark of which losses are evaluated, the most promising first
_BLOCK = 1000  # places that are predicted at a time
_SLACK = 1.15  # times the tolerance that a quick search keeps: more is hopeless
_FINER = (3, 2, 1)  # times that the grid of the bound is finer, as far as places suffice


@dataclass(frozen=True, slots=True, kw_only=True)
class Goal:
    """Number of marks, or the accuracy that decides it.

    Attributes
    ----------
    n_marks : int or None
        Number of marks; by default the least number that keeps the tolerance.
    probability : float
        Required probability that the tolerance is kept at every stop.
    is_robust : bool
        Whether this shall hold after the loss of any one mark too; only for three marks or more.
    most : int
        Largest number of marks when the least number is searched.
    loss_weight : float
        Exponent of the largest sigma after a loss in the objective, 0 to 1, beside that of the
        worst stop. 0.03: one percent at the worst stop is worth a third after a loss.
    """

    n_marks: int | None = None
    probability: float = 0.95
    is_robust: bool = True
    most: int = 20
    loss_weight: float = 0.03

    def __post_init__(self) -> None:
        if self.n_marks is not None and not 2 <= self.n_marks <= MARKS_MOST:
            raise ConfigError(
                f"{self.n_marks} marks are requested; from 2 to {MARKS_MOST} can be placed."
            )
        if not 2 <= self.most <= MARKS_MOST:
            raise ConfigError(f"At most {self.most} marks; it must be from 2 to {MARKS_MOST}.")
        if not 0.0 < self.probability < 1.0:
            raise ConfigError(f"probability is {self.probability!r}; it must lie between 0 and 1.")
        if not 0.0 <= self.loss_weight <= 1.0:
            raise ConfigError(f"loss_weight is {self.loss_weight!r}; it must be from 0 to 1.")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Optimum:
    """The best places that were found."""

    evaluation: Evaluation  # its marks are the best places
    ground: Array  # (k,) height of the ground under each mark [m]
    # largest 3-D sigma over all stops after the loss of any one mark; infinite where a stop would
    # have no position [m]
    worst_after_loss: float
    is_kept: bool  # whether the goal is reached
    # largest 3-D sigma over all stops that no arrangement of as many marks on the places of the
    # bound goes below; NaN for a method without one [m]
    bound: float
    bound_spacing: float  # of the grid of these places; 0 if they are those given [m]
    n_bounded: int  # how many these are
    # information gained, as the sum over stops of the logarithm of its determinant, and its upper
    # bound over all arrangements of as many marks; NaN for a method that has no such sum
    log_det: float
    log_det_bound: float
    n_candidates: int  # places that were compared
    n_exchanges: int  # exchanges and steps that improved on the starts


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Proposal:
    """One more mark."""

    p_site: Array  # (3,) centre of its sphere [m]
    ground: float  # height of the ground under it [m]
    before: Evaluation  # the arrangement without it
    after: Evaluation  # the arrangement with it; it is the last mark


class _Problem(NamedTuple):
    """All candidates as observed from all stops."""

    site: Site
    stops: Stops
    candidates: Candidates
    model: CentreModel
    requirement: Requirement
    pairs: Pairs
    power: float = np.inf  # of the mean over stops that stands for their largest sigma
    is_loss_first: bool = False  # whether the tolerance after a loss comes before all else


class _Found(NamedTuple):
    """An arrangement."""

    score: tuple[float, float, float]  # excess after a loss, objective, mean over stops [m]
    problem: _Problem  # whose candidates
    chosen: Index  # are its marks
    n_exchanges: int


def optimise(  # noqa: PLR0913  all that a plan is made of
    site: Site,
    stops: Stops,
    candidates: Candidates,
    model: CentreModel,
    requirement: Requirement,
    goal: Goal,
    rng: np.random.Generator,
) -> Optimum:
    """Find the best places for a number of marks, or the least number that keeps the tolerance.

    Parameters
    ----------
    site : Site
        Ground and what hides marks.
    stops : Stops
        Positions of the LiDAR; all of them count at once.
    candidates : Candidates
        Where a mark may stand; places between are tried too where these have rules.
    model : CentreModel
        Accuracy of centres.
    requirement : Requirement
        Tolerance and method.
    goal : Goal
        Number of marks, or the accuracy that decides it.
    rng : numpy.random.Generator
        Draws the starts.

    Returns
    -------
    Optimum
        Marks, their evaluation, and the bound of all arrangements.

    Raises
    ------
    DegenerateGeometryError
        If no number of marks keeps the tolerance, with the bound that shows it.

    Notes
    -----
    The best of many random arrangements, a fifth of them drawn by the shares of the convex
    relaxation (``bounds.relax``), are improved by exchanging one mark at a time, first on a high
    power mean over the stops, which has fewer local minima than their largest, then on that; the
    best leave the grid in steps that halve. The objective is the product of the largest 3-D sigma
    over all stops and that after the loss of any one mark, with the exponents of the goal: no plan
    that is better in both scores worse. Where the tolerance does not hold after a loss, that comes
    first, if it can be reached. Cost grows with marks times candidates times stops.
    """
    check_sizes(len(stops.names), goal.n_marks or goal.most)
    problem = _problem(site, stops, candidates, model, requirement)
    if goal.n_marks is not None:
        return _optimum(_search(problem, goal.n_marks, goal, rng), problem, goal)
    least = _least(problem, goal)
    most = _search(problem, goal.most, goal, rng, is_quick=True)
    if not _keeps(most, goal):
        if _keeps(most, goal, _SLACK):
            most = _search(problem, goal.most, goal, rng)
        if not (found := _optimum(most, problem, goal)).is_kept:
            raise DegenerateGeometryError(_impossible(problem, found, goal))
    for k in range(least, goal.most):
        quick = _search(problem, k, goal, rng, is_quick=True)
        if _keeps(quick, goal, _SLACK):
            found = _optimum(_search(problem, k, goal, rng), problem, goal)
            # a smaller sigma may come with an error ellipsoid of worse shape
            if not found.is_kept and _keeps(quick, goal):
                found = _optimum(quick, problem, goal)
            if found.is_kept:
                return found
    return _optimum(_search(problem, goal.most, goal, rng), problem, goal)


def propose_mark(
    site: Site,
    stops: Stops,
    present: Arrangement,
    candidates: Candidates,
    model: CentreModel,
    requirement: Requirement,
) -> Proposal:
    """Return the one more mark with the least power mean of 3-D sigmas over all stops.

    The worst stops count most, and where no place helps them, the next ones do.

    Parameters
    ----------
    present : Arrangement
        Marks that stand already.
    site, stops, candidates, model, requirement
        As of ``optimise``.

    Returns
    -------
    Proposal
        Its place, and the evaluations without and with it.

    Raises
    ------
    DegenerateGeometryError
        If no candidate is far enough from the marks that stand.
    """
    gaps = cdist(candidates.p_site, present.p_site)
    places = np.flatnonzero(gaps.min(axis=1, initial=np.inf) >= candidates.apart)
    n = len(places)
    if not n:
        raise DegenerateGeometryError(
            f"No place for one more mark is {candidates.apart:g} m from those that stand."
        )
    p_site = np.concatenate([candidates.p_site[places], present.p_site])
    ground = np.concatenate([candidates.ground[places], np.zeros(len(present.names))])
    joined = Candidates(p_site=p_site, ground=ground, apart=1e-6)
    problem = _problem(site, stops, joined, model, requirement)._replace(power=_POWER)
    fixed, each = np.arange(n, n + len(present.names)), np.arange(n)[:, None]
    best = int(np.lexsort(_scores(problem, fixed, each).T[::-1])[0])
    name = next(f"P{i:02d}" for i in range(1, 1000) if f"P{i:02d}" not in present.names)
    wider = Arrangement(
        names=(*present.names, name), p_site=np.vstack([present.p_site, p_site[best]])
    )
    return Proposal(
        p_site=p_site[best].copy(),
        ground=float(ground[best]),
        before=evaluate(site, stops, present, model, requirement),
        after=evaluate(site, stops, wider, model, requirement),
    )


def best_without_search(  # noqa: PLR0913  all that a plan is made of
    site: Site,
    stops: Stops,
    candidates: Candidates,
    model: CentreModel,
    requirement: Requirement,
    n_marks: int,
    drawn: tuple[int, np.random.Generator] | None,
) -> float:
    """Return the least 3-D sigma at the worst stop of random arrangements, or of all there are.

    Parameters
    ----------
    site, stops, candidates, model, requirement
        As of ``optimise``.
    n_marks : int
        Number of marks.
    drawn : tuple of int and numpy.random.Generator, optional
        How many arrangements are drawn; by default every arrangement is evaluated.

    Returns
    -------
    float
        Reference for optimised arrangements [m].
    """
    problem = _problem(site, stops, candidates, model, requirement)
    p_site, apart = candidates.p_site, candidates.apart
    if drawn is not None:
        some = [
            _draw(candidates, n_marks, drawn[1].permutation(len(p_site))) for _ in range(drawn[0])
        ]
    else:
        near = cdist(p_site, p_site) < apart
        every = map(np.array, combinations(range(len(near)), n_marks))
        some = [c for c in every if near[np.ix_(c, c)].sum() == n_marks]
    return float(_scores(problem, np.zeros(0, np.intp), np.array(some))[:, 0].min())


def _observed(
    site: Site, stops: Stops, candidates: Candidates, model: CentreModel, requirement: Requirement
) -> Iterator[Observables]:
    """Predict candidates from all stops, block by block."""
    for first in range(0, len(candidates.p_site), _BLOCK):
        marks = Arrangement.numbered(candidates.p_site[first : first + _BLOCK])
        visibility = find_visibility(site, stops.p_site, marks)
        yield predict_observables(stops.p_site, marks, model, requirement, visibility)[1]


def _problem(
    site: Site, stops: Stops, candidates: Candidates, model: CentreModel, requirement: Requirement
) -> _Problem:
    """Predict all candidates from all stops."""
    blocks = _observed(site, stops, candidates, model, requirement)
    parts = zip(*(pairs_of(some, requirement) for some in blocks), strict=True)
    pairs = Pairs(*(np.concatenate(part, axis=1) for part in parts))
    return _Problem(site, stops, candidates, model, requirement, pairs)


def _information(problem: _Problem, candidates: Candidates) -> Array:
    """Return the information of candidates, block by block."""
    site, stops, _, model, requirement, *_ = problem
    blocks = _observed(site, stops, candidates, model, requirement)
    return np.concatenate([information_of(some, requirement) for some in blocks])


def _start(problem: _Problem) -> Array:
    """Return the information of a station without marks."""
    return start_information(problem.model.sensor.sigma_range_bias, problem.requirement)


def _search(
    problem: _Problem, k: int, goal: Goal, rng: np.random.Generator, *, is_quick: bool = False
) -> _Found:
    """Return the best k places of several starts, on the grid and, unless quick, off it."""
    n_starts = 1 if is_quick else min(max(_MARKS_STARTED // k, _STARTS_MIN), _STARTS_MAX)
    starts = _starts(problem, k, n_starts, rng)
    found = [_descended(problem, start, goal, rng) for start in starts]
    best = _best_off_grid(found, goal, rng, is_quick=is_quick)
    limit = problem.requirement.tolerance / _Z_95
    if not goal.is_robust or k < 3 or _after_loss(best) <= limit:
        return best
    first = problem._replace(is_loss_first=True)
    found = [_descended(first, start, goal, rng) for start in starts]
    kept = _best_off_grid(found, goal, rng, is_quick=is_quick)
    return kept if _evaluated(kept, goal)[0] == 0.0 else best


def _starts(problem: _Problem, k: int, n: int, rng: np.random.Generator) -> list[Index]:
    """Return the best of each of some lots of random arrangements.

    Most are drawn evenly, the last by the shares of the relaxation.
    """
    candidates = problem.candidates
    is_seen = np.asarray(problem.pairs.is_seen.any(axis=0))
    groups = groups_of(candidates.p_site, candidates.apart)
    shares = relax(_information(problem, candidates), _start(problem), groups, k, 0.0).shares
    odds = np.log(np.maximum(shares, 1e-12))
    n_drawn = _DRAWN_EVENLY + _DRAWN_BY_SHARES
    luck = (rng.gumbel(size=len(odds)) for _ in range(n_drawn))
    orders = (np.argsort(-(one + odds * (i >= _DRAWN_EVENLY))) for i, one in enumerate(luck))
    drawn = [_draw(candidates, k, order[is_seen[order]]) for order in orders]
    most = max(map(len, drawn))
    if most < k:
        raise DegenerateGeometryError(
            f"There is room for {most} of {k} marks that a stop can see; allow more places, or "
            "marks nearer to each other."
        )
    every = np.array([one for one in drawn if len(one) == k])
    scores = _scores(problem._replace(power=_POWER), np.zeros(0, np.intp), every)[:, 0]
    parts = np.array_split(np.arange(len(every)), n)
    return [every[part[np.argmin(scores[part])]] for part in parts if len(part)]


def _draw(candidates: Candidates, k: int, order: Index) -> Index:
    """Return the first k candidates of an order that are not too near to each other, or fewer."""
    chosen: list[int] = []
    places = candidates.p_site
    for c in order:
        if len(chosen) == k:
            break
        off = places[chosen] - places[c]
        if not (np.einsum("ij,ij->i", off, off) < candidates.apart**2).any():
            chosen.append(int(c))
    return np.array(chosen, dtype=np.intp)


def _descended(problem: _Problem, start: Index, goal: Goal, rng: np.random.Generator) -> _Found:
    """Exchange marks on a smooth objective, then on the objective itself."""
    smooth = _exchanged(problem._replace(power=_POWER), start, goal, rng)
    exact = _exchanged(problem, smooth.chosen, goal, rng)
    return exact._replace(n_exchanges=exact.n_exchanges + smooth.n_exchanges)


def _best_off_grid(
    found: list[_Found], goal: Goal, rng: np.random.Generator, *, is_quick: bool
) -> _Found:
    """Return the best of arrangements after the best few have left the grid, if they may."""
    found = sorted(found, key=lambda one: one.score)
    several = list({tuple(sorted(one.chosen)): one for one in found}.values())
    if not is_quick and found[0].problem.candidates.rules is not None:
        several += [_off_grid(one, goal, rng) for one in several[:_POLISHED]]
    return min(several, key=lambda one: _evaluated(one, goal))


def _off_grid(found: _Found, goal: Goal, rng: np.random.Generator) -> _Found:
    """Move marks by steps that halve, while that improves the objective."""
    candidates = found.problem.candidates
    site, stops, _, model, requirement, *_ = found.problem
    assert candidates.rules is not None
    step = candidates.spacing / 2.0
    while step > _FINEST:
        p_site = found.problem.candidates.p_site[found.chosen]
        local = places_near(site, stops, candidates.rules, p_site, step)
        problem = _problem(site, stops, local, model, requirement)
        problem = problem._replace(is_loss_first=found.problem.is_loss_first)
        moved = _descended(problem, np.arange(len(p_site)), goal, rng)
        if _is_worth(moved.score, found.score):
            found = moved._replace(n_exchanges=found.n_exchanges + moved.n_exchanges)
        else:
            step /= 2.0
    return found


def _exchanged(problem: _Problem, start: Index, goal: Goal, rng: np.random.Generator) -> _Found:
    """Exchange marks one at a time while that improves the objective."""
    chosen, n_exchanges = start.copy(), 0
    (score,) = _objectives(problem, chosen[1:], chosen[:1], goal)
    for _ in range(_ROUNDS_MAX):
        before = score
        for i in rng.permutation(len(chosen)):
            others = np.delete(chosen, i)
            tried = _promising(problem, others, score)
            found = _objectives(problem, others, tried, goal)
            best = min(range(len(tried)), key=found.__getitem__, default=-1)
            if best >= 0 and found[best] < score:
                chosen[i], score, n_exchanges = tried[best], found[best], n_exchanges + 1
        if not _is_worth(score, before):
            break
    return _Found(score, problem, chosen, n_exchanges)


def _is_worth(score: tuple[float, float, float], before: tuple[float, float, float]) -> bool:
    """Return whether an objective is so much better that a search should go on."""
    return score[0] < before[0] or (score[0] == before[0] and score[1] < _WORTH * before[1])


def _promising(problem: _Problem, others: Index, score: tuple[float, float, float]) -> Index:
    """Return the candidates beside others that leave the worst stop best, the best first."""
    p_site = problem.candidates.p_site
    near = cdist(p_site, p_site[others]) < problem.candidates.apart
    places = np.flatnonzero(~near.any(axis=1) & problem.pairs.is_seen.any(axis=0))
    limit = score[1] if score[0] == 0.0 else _WORSE_MOST * score[1]
    scores = _scores(problem, others, places[:, None], limit)
    order = np.lexsort((scores[:, 1], scores[:, 0]))
    order = order[scores[order, 0] < limit]  # a loss only adds to the objective
    return np.asarray(places[order[:_TRIED]])


def _objectives(
    problem: _Problem, others: Index, tried: Index, goal: Goal
) -> list[tuple[float, float, float]]:
    """Return the objective with each of some candidates beside others, the less the better.

    The excess over the tolerance after the loss of a mark if that comes first, the largest sigma
    over all stops, weighed with that after a loss, and the mean over stops [m].
    """
    worst, mean = _scores(problem, others, tried[:, None]).T
    excess = np.zeros(len(tried))
    if goal.is_robust and len(others) > 1:
        none = np.zeros((1, 0), dtype=np.intp)
        after = np.full(len(tried), _scores(problem, others, none)[0, 0])
        for j in range(len(others)):
            rest = np.delete(others, j)
            after = np.maximum(after, _scores(problem, rest, tried[:, None])[:, 0])
        if problem.is_loss_first:
            excess = np.maximum(after - problem.requirement.tolerance / _Z_95, 0.0)
        worst = worst ** (1.0 - goal.loss_weight) * after**goal.loss_weight
    return list(zip(excess.tolist(), worst.tolist(), mean.tolist(), strict=True))


def _evaluations(found: _Found, slack: float = 1.0) -> list[Evaluation]:
    """Return the evaluations of marks that hide each other too: all, then without each of them."""
    site, stops, candidates, model, requirement, *_ = found.problem
    wider = replace(requirement, tolerance=slack * requirement.tolerance)
    marks, n = Arrangement.numbered(candidates.p_site[found.chosen]), len(found.chosen)
    visibility = find_visibility(site, stops.p_site, marks)
    remaining = [np.arange(n), *(np.delete(np.arange(n), i) for i in range(n) if n > 2)]
    return [
        evaluate(site, stops, marks.rows(keep), model, wider, visibility=visibility.rows(keep))
        for keep in remaining
    ]


def _after_loss(found: _Found) -> float:
    """Return the largest sigma over all stops after the loss of any one mark [m]."""
    return max((one.worst_sigma_3d for one in _evaluations(found)[1:]), default=np.inf)


def _evaluated(found: _Found, goal: Goal) -> tuple[float, float]:
    """Return the objective of an arrangement whose marks hide each other too."""
    whole, *rest = (min(one.worst_sigma_3d, _LOST) for one in _evaluations(found))
    if not goal.is_robust or not rest:
        return 0.0, whole
    excess = max(max(rest) - found.problem.requirement.tolerance / _Z_95, 0.0)
    weighed = whole ** (1.0 - goal.loss_weight) * max(rest) ** goal.loss_weight
    return excess * found.problem.is_loss_first, weighed


def _scores(
    problem: _Problem,
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
    sigmas = shared_sigmas(problem.model.sensor.sigma_range_bias, requirement)
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


def _optimum(found: _Found, problem: _Problem, goal: Goal) -> Optimum:
    """Assemble the result; marks are named by azimuth about the middle of the stops."""
    site, stops, candidates, model, requirement, *_ = problem
    own, chosen = found.problem.candidates, found.chosen
    off = own.p_site[chosen, :2] - stops.p_site[:, :2].mean(axis=0)
    chosen = chosen[np.argsort(np.arctan2(off[:, 1], off[:, 0]))]
    marks, k = Arrangement.numbered(own.p_site[chosen]), len(chosen)
    after = _after_loss(found)
    bound, gain, n_bounded, spacing = np.nan, (np.nan, np.nan), 0, 0.0
    if requirement.method != "paper":
        finer = _finer(problem)
        information, start = _information(problem, finer), _start(problem)
        groups = groups_of(finer.p_site, finer.apart)
        bound = relax(information, start, groups, k, requirement.resection.sigma_height).bound
        plan = replace(finer, p_site=marks.p_site.copy(), ground=np.zeros(k))
        gain = gained(information, start, _information(problem, plan), k)
        n_bounded, spacing = len(finer.p_site), finer.spacing
    return Optimum(
        evaluation=evaluate(site, stops, marks, model, requirement),
        ground=own.ground[chosen].copy(),
        worst_after_loss=after if after < _LOST else np.inf,
        is_kept=_keeps(found, goal),
        bound=bound,
        bound_spacing=spacing,
        n_bounded=n_bounded,
        log_det=gain[0],
        log_det_bound=gain[1],
        n_candidates=len(candidates.p_site),
        n_exchanges=found.n_exchanges,
    )


def _finer(problem: _Problem) -> Candidates:
    """Return the places of the bound: a finer grid where the candidates allow others."""
    given, site, stops = problem.candidates, problem.site, problem.stops
    if given.rules is None:
        return given
    for times in _FINER:
        if times**2 * len(given.p_site) <= CANDIDATES_MAX // 2:
            return find_candidates(site, stops, replace(given.rules, spacing=given.spacing / times))
    return given


def _keeps(found: _Found, goal: Goal, slack: float = 1.0) -> bool:
    """Return whether marks reach the goal for a multiple of the tolerance."""
    whole, *rest = _evaluations(found, slack)
    every = [whole, *rest] if goal.is_robust else [whole]
    return all(one.worst_probability >= goal.probability for one in every)


def _least(problem: _Problem, goal: Goal) -> int:
    """Return a lower bound of the number of marks; raise if no number keeps the tolerance."""
    requirement = problem.requirement
    least = 3 if requirement.method == "paper" or goal.is_robust else 2
    if goal.most < least:
        raise ConfigError(f"At most {goal.most} marks; {least} are needed for this goal.")
    _refuse_impossible(problem)
    information = _information(problem, problem.candidates)
    sigmas = least_sigmas(information, requirement)[:, : goal.most]
    widest = widest_sigma(requirement.tolerance, goal.probability)
    enough = np.flatnonzero(sigmas.max(axis=0) <= widest) + 1 + goal.is_robust
    if len(enough) and enough[0] <= goal.most:
        return max(least, int(enough[0]))
    place = sigmas.shape[1] - 1 - (goal.is_robust and sigmas.shape[1] > 1)
    worst = int(np.argmax(sigmas[:, place]))
    raise DegenerateGeometryError(
        f"No arrangement of {goal.most} marks keeps {_goal_text(problem, goal)}: wherever they "
        f"stood, the 3-D sigma at {problem.stops.names[worst]} would be "
        f"{1e3 * sigmas[worst, place]:.2g} mm or more; the tolerance allows at most "
        f"{1e3 * widest:.2g} mm. Ask for a larger tolerance, or allow more places."
    )


def _goal_text(problem: _Problem, goal: Goal) -> str:
    """Return the goal as a part of a sentence."""
    after = " after the loss of any one" if goal.is_robust else ""
    return (
        f"{1e3 * problem.requirement.tolerance:g} mm with {100 * goal.probability:g} % at every "
        f"stop{after}"
    )


def _sigmas_of_all(problem: _Problem) -> Array:
    """Return the 3-D sigma at each stop with a mark at every candidate [m]."""
    every, none = np.arange(len(problem.candidates.p_site)), np.zeros((1, 0), dtype=np.intp)
    each = range(len(problem.stops.names))
    return np.array([_scores(problem, every, none, stops=[e])[0, 0] for e in each])


def _refuse_impossible(problem: _Problem) -> None:
    """Raise if not even all marks at once would bring the 3-D sigma below the tolerance."""
    if problem.requirement.method == "paper":
        return
    sigmas, tolerance = _sigmas_of_all(problem), problem.requirement.tolerance
    worst = int(np.argmax(sigmas))
    if sigmas[worst] > tolerance:
        best = f"{1e3 * sigmas[worst]:.2g} mm (3-D sigma)" if sigmas[worst] < _LOST else "nothing"
        raise DegenerateGeometryError(
            f"No arrangement keeps {1e3 * tolerance:g} mm: even a mark at each of "
            f"{len(problem.candidates.p_site)} places at once would leave {best} at "
            f"{problem.stops.names[worst]}. Ask for a larger tolerance, or allow more places."
        )


def _impossible(problem: _Problem, best: Optimum, goal: Goal) -> str:
    """Return the message that no number of marks keeps the tolerance, with the bound."""
    worst = int(np.argmax(best.evaluation.sigma_3d))
    text = (
        f"{goal.most} marks do not keep {_goal_text(problem, goal)}: the best that was found "
        f"leaves {1e3 * best.evaluation.sigma_3d[worst]:.3g} mm (3-D sigma) at "
        f"{problem.stops.names[worst]}."
    )
    if problem.requirement.method != "paper":
        text += (
            f" Even a mark at each of {best.n_candidates} places at once would leave "
            f"{1e3 * float(_sigmas_of_all(problem).max()):.2g} mm: ask for a larger tolerance."
        )
    return text


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
            sigma = _LOST
            if is_fixed:
                _add_seen(pairs, e, used, work)
                sigma = min(sigma_3d(*work, shared, sigma_height), _LOST)
            out[m, 0] = out[m, 0] + sigma**power if is_smooth else max(out[m, 0], sigma)
            out[m, 1] += sigma


@compiled
def _add_seen(pairs: Pairs, e: int, marks: Index, work: tuple[Array, Array, Array]) -> None:
    """Add those of some marks that are found to the equations of a station."""
    for c in marks:
        if pairs.is_seen[e, c]:
            add_mark(pairs, e, c, work[0], work[1], work[2])
