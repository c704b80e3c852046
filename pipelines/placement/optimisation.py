"""Where to put marks: greedy on information, then exchanges on the accuracy of positions.

The normal equations of a free station are a sum over its marks, so that a mark can be added,
removed or exchanged in some hundred operations per stop. The study's method has no such sum; its
arrangements are evaluated whole.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.errors import ConfigError, DegenerateGeometryError
from spheremark.pipelines.estimation.linear_algebra import invert
from spheremark.pipelines.model import Array, Index, Mask
from spheremark.pipelines.placement.bounds import least_sigmas, widest_sigma
from spheremark.pipelines.placement.candidates import Candidates
from spheremark.pipelines.placement.centre_model import CentreModel
from spheremark.pipelines.placement.evaluation import check_sizes, evaluate, predict_observables
from spheremark.pipelines.placement.plan import Arrangement, Evaluation, Requirement, Site, Stops
from spheremark.pipelines.placement.station_covariance import (
    LOOSE2,
    Information,
    Observables,
    information,
    predict_positions,
    shared_variance,
)
from spheremark.pipelines.placement.visibility import find_visibility
from spheremark.pipelines.progress import checkpoint

MARKS_MOST = 40
"""Marks that are placed at most."""

_LOST = 1e3  # [m] counts for a stop without a position: worse than any that has one
_LOOSE_PRIOR = np.array([3.0, 3.0, 3.0, 10.0, 10.0, 10.0])  # [rad, m] before any mark is seen
_Z_95 = 1.96  # sigmas within which an error of any shape lies with 95 %: 3-D sigma on one axis
_ROUNDS_MAX = 30  # of exchanges; four to eight settle
_STARTS_MAX, _STARTS_MIN = 16, 2
_MARKS_STARTED = 96  # in all starts together: many marks leave little to chance
_STARTS_PAPER = 4  # where arrangements are evaluated whole
_DRAWN, _DRAWN_KEPT = 1500, 40  # random arrangements that these begin with, and evaluate in full
_POWER = 12.0  # of the mean over stops that is as good as their largest, and smoother
_SHARE_MOVED = 0.4  # share of marks that a later start has elsewhere
_FEW = 10  # marks that are always searched in full
_SLACK, _SLACK_PAPER = 1.15, 2.0  # times the tolerance that a quick search keeps: more is hopeless
_WORSE_MOST = 1.3  # than now, at most, while the loss of a mark would break the tolerance
_TRIED_MAX = 12  # candidates that are evaluated in full for each mark, the most promising first
_SCREENED = 800  # candidates of a round by whole evaluation, for all marks together


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
    """

    n_marks: int | None = None
    probability: float = 0.95
    is_robust: bool = True
    most: int = 20

    def __post_init__(self) -> None:
        if self.n_marks is not None and not 2 <= self.n_marks <= MARKS_MOST:
            raise ConfigError(
                f"{self.n_marks} marks are requested; from 2 to {MARKS_MOST} can be placed."
            )
        if not 2 <= self.most <= MARKS_MOST:
            raise ConfigError(f"At most {self.most} marks; it must be from 2 to {MARKS_MOST}.")
        if not 0.0 < self.probability < 1.0:
            raise ConfigError(f"probability is {self.probability!r}; it must lie between 0 and 1.")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Optimum:
    """The best places that were found.

    Attributes
    ----------
    evaluation : Evaluation
        Its marks are the best places.
    ground : (k,)
        Height of the ground under each mark [m].
    worst_after_loss : float
        Largest 3-D sigma over all stops after the loss of any one mark; infinite where a stop
        would have no position [m].
    is_kept : bool
        Whether the goal is reached.
    log_det, log_det_bound : float
        Information gained, as the sum over stops of the logarithm of its determinant, and its upper
        bound over all arrangements of as many marks; NaN for a method that has no such sum.
    n_candidates : int
        Places that were compared.
    n_exchanges : int
        Exchanges that improved on the greedy start.
    """

    evaluation: Evaluation
    ground: Array
    worst_after_loss: float
    is_kept: bool
    log_det: float
    log_det_bound: float
    n_candidates: int
    n_exchanges: int


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Proposal:
    """One more mark.

    Attributes
    ----------
    p_site : (3,)
        Centre of its sphere [m].
    ground : float
        Height of the ground under it [m].
    before, after : Evaluation
        The arrangement without and with it; it is the last mark.
    """

    p_site: Array
    ground: float
    before: Evaluation
    after: Evaluation


class _Problem(NamedTuple):
    """All candidates as observed from all stops.

    Attributes
    ----------
    site, stops, candidates, model, requirement
        As given to ``optimise``.
    observables : Observables
        All candidates, marks that stand already after them.
    added : Information
        Contribution of each to the normal equations.
    prior : (6, 6)
        Information of the AHRS.
    shared2 : tuple of float
        Variances of the common errors of all ranges and of all heights of centres [m^2].
    near : (c, c)
        Which candidates are too near to each other.
    power : float
        Of the mean over stops that stands for their largest sigma.
    """

    site: Site
    stops: Stops
    candidates: Candidates
    model: CentreModel
    requirement: Requirement
    observables: Observables
    added: Information
    prior: Array
    shared2: tuple[float, float]
    near: Mask
    power: float = np.inf

    @property
    def is_paper(self) -> bool:
        """Whether arrangements have to be evaluated whole."""
        return self.requirement.method == "paper"


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
        Where a mark may stand.
    model : CentreModel
        Accuracy of centres.
    requirement : Requirement
        Tolerance and method.
    goal : Goal
        Number of marks, or the accuracy that decides it.
    rng : numpy.random.Generator
        Perturbs the later starts.

    Returns
    -------
    Optimum
        Marks and their evaluation.

    Raises
    ------
    DegenerateGeometryError
        If no number of marks keeps the tolerance, with the bound that shows it.

    Notes
    -----
    Greedy on the regularised logarithm of the determinant of the information, summed over stops,
    which is monotone and submodular: at least 63 % of the greatest gain (Nemhauser, Wolsey, Fisher,
    1978); the bound adds the largest remaining gains. Then marks are exchanged one at a time while
    that lowers, in this order, the excess over the tolerance after a loss, the largest 3-D sigma
    over all stops, and their mean. Cost of a round grows with marks times candidates times stops.
    """
    check_sizes(len(stops.names), goal.n_marks or goal.most)
    problem = _problem(site, stops, candidates, model, requirement)
    if goal.n_marks is not None:
        return _optimum(problem, _search(problem, goal.n_marks, goal, rng), goal)
    least = _least(problem, goal)
    slack = _SLACK_PAPER if problem.is_paper else _SLACK
    most = _quick_search(problem, goal.most, goal, rng)
    if most is not None and not _keeps(problem, most, goal):
        is_near = _keeps(problem, most, goal, slack)
        best = _search(problem, goal.most, goal, rng) if is_near else (most, 0)
        found = _optimum(problem, best, goal)
        if not found.is_kept:
            raise DegenerateGeometryError(_impossible(problem, found, goal))
    for k in range(least, goal.most):
        some = _quick_search(problem, k, goal, rng)
        if some is not None and _keeps(problem, some, goal):
            found = _optimum(problem, _search(problem, k, goal, rng), goal)
            # a smaller sigma may come with an error ellipsoid of worse shape
            return found if found.is_kept else _optimum(problem, (some, 0), goal)
        if some is None or _keeps(problem, some, goal, slack):
            found = _optimum(problem, _search(problem, k, goal, rng), goal)
            if found.is_kept:
                return found
    found = _optimum(problem, _search(problem, goal.most, goal, rng), goal)
    if found.is_kept:
        return found
    raise DegenerateGeometryError(_impossible(problem, found, goal))


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
    gaps = np.linalg.norm(candidates.p_site[:, None] - present.p_site[None], axis=2)
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
    fixed = np.arange(n, n + len(present.names))
    scores = [_score(problem, np.append(fixed, c)) for c in range(n)]
    best = min(range(n), key=scores.__getitem__)
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
    near = problem.near
    some: Iterable[Index]
    if drawn is not None:
        some = (_draw(near, n_marks, drawn[1]) for _ in range(drawn[0]))
    else:
        every = map(np.array, combinations(range(len(near)), n_marks))
        some = (c for c in every if near[np.ix_(c, c)].sum() == n_marks)
    return min(_score(problem, chosen)[0] for chosen in some)


def _problem(
    site: Site, stops: Stops, candidates: Candidates, model: CentreModel, requirement: Requirement
) -> _Problem:
    """Predict all candidates from all stops."""
    marks = candidates.arrangement
    visibility = find_visibility(site, stops.p_site, marks)
    _, observables = predict_observables(stops.p_site, marks, model, requirement, visibility)
    return _Problem(
        site=site,
        stops=stops,
        candidates=candidates,
        model=model,
        requirement=requirement,
        observables=observables,
        added=information(observables, requirement),
        prior=np.diag([requirement.sigma_levelling**-2.0] * 2 + [0.0] * 4),
        shared2=(
            shared_variance(model.sensor.sigma_range_bias),
            requirement.resection.sigma_height**2,
        ),
        near=_near(candidates),
    )


def _near(candidates: Candidates) -> Mask:
    """Return which candidates are too near to each other, (c, c)."""
    return np.asarray(cdist(candidates.p_site, candidates.p_site) < candidates.apart)


def _sums(problem: _Problem, chosen: Index) -> tuple[Array, Array, Array]:
    """Return the normal equations of all stops with some candidates."""
    normal, cov_rhs, bias_rhs = (part[:, chosen].sum(axis=1) for part in problem.added)
    return normal + problem.prior, cov_rhs + problem.prior, bias_rhs


def _search(problem: _Problem, k: int, goal: Goal, rng: np.random.Generator) -> tuple[Index, int]:
    """Return the best k places of several starts, and the number of exchanges.

    The first start is greedy, or the best of many random ones where information is no sum; the
    second is random, the others perturb the best so far (iterated local search: Lourenco, Martin,
    Stuetzle, 2003). Each descends on a high power mean over the stops, which has fewer local
    minima than their largest, then on that.
    """
    smooth = problem._replace(power=_POWER)
    best, score, n_exchanges = _greedy(problem, k), (np.inf, np.inf, np.inf), 0
    n_starts = max(_STARTS_MIN, min(_STARTS_MAX, _MARKS_STARTED // k))
    if problem.is_paper:
        best, n_starts = _best_drawn(problem, best, goal, rng), _STARTS_PAPER
    for i in range(n_starts):
        start = best if i == 0 else _perturbed(problem, best, 1.0 if i == 1 else _SHARE_MOVED, rng)
        found, n = _exchanged(smooth, start, goal, rng)
        found, m = _exchanged(problem, found, goal, rng)
        n_exchanges += n + m
        if (other := _objective(problem, found, goal)) < score:
            best, score = found, other
    return best, n_exchanges


def _quick_search(problem: _Problem, k: int, goal: Goal, rng: np.random.Generator) -> Index | None:
    """Return k places of a short search; none without room, and for few marks of a free station."""
    if k <= _FEW and not problem.is_paper:
        return None
    try:
        chosen = _greedy(problem, k)
    except DegenerateGeometryError:
        return None
    if problem.is_paper:
        return _best_drawn(problem, chosen, goal, rng)
    quick = replace(goal, is_robust=False)  # evaluating losses takes ten times as long
    return _exchanged(problem._replace(power=_POWER), chosen, quick, rng)[0]


def _best_drawn(problem: _Problem, other: Index, goal: Goal, rng: np.random.Generator) -> Index:
    """Return the best of many random arrangements and of another with as many marks."""
    drawn = [other, *(_draw(problem.near, len(other), rng) for _ in range(_DRAWN))]
    drawn = [chosen for chosen in drawn if len(chosen) == len(other)]
    drawn.sort(key=lambda chosen: _score(problem, chosen))
    return min(drawn[:_DRAWN_KEPT], key=lambda chosen: _objective(problem, chosen, goal))


def _draw(near: Mask, k: int, rng: np.random.Generator) -> Index:
    """Return k random candidates that are not too near to each other; fewer without room."""
    chosen: list[int] = []
    for c in rng.permutation(len(near)):
        if len(chosen) == k:
            break
        if not near[c, chosen].any():
            chosen.append(int(c))
    return np.array(chosen, dtype=np.intp)


def _greedy(problem: _Problem, k: int) -> Index:
    """Return k candidates, each the one that adds most information to those before it."""
    chosen: list[int] = []
    allowed = problem.observables.is_seen.any(axis=0)
    added = problem.added.normal
    normal = np.tile(problem.prior + np.diag(_LOOSE_PRIOR**-2.0), (len(added), 1, 1))
    for _ in range(k):
        if not allowed.any():
            raise DegenerateGeometryError(
                f"There is room for {len(chosen)} of {k} marks that a stop can see; allow more "
                "places, or marks nearer to each other."
            )
        best = int(np.argmax(np.where(allowed, _gains(normal, added), -np.inf)))
        chosen.append(best)
        normal += added[:, best]
        allowed &= ~problem.near[best]
    return np.array(chosen, dtype=np.intp)


def _bound(problem: _Problem, chosen: Index) -> tuple[float, float]:
    """Return the information gained, and its upper bound over arrangements of as many marks."""
    start, added = problem.prior + np.diag(_LOOSE_PRIOR**-2.0), problem.added.normal
    normal = start + added[:, chosen].sum(axis=1)
    gained = float((np.linalg.slogdet(normal)[1] - np.linalg.slogdet(start)[1]).sum())
    further, singles = (
        float(np.sort(_gains(before, added))[::-1][: len(chosen)].sum())
        for before in (normal, np.tile(start, (len(normal), 1, 1)))
    )
    return gained, min(gained + further, singles)


def _perturbed(problem: _Problem, chosen: Index, share: float, rng: np.random.Generator) -> Index:
    """Return an arrangement of which a share of the marks stands elsewhere."""
    out = chosen.copy()
    for i in rng.choice(len(out), max(1, round(share * len(out))), replace=False):
        free = np.flatnonzero(~problem.near[np.delete(out, i)].any(axis=0))
        out[i] = rng.choice(free) if len(free) else out[i]
    return out


def _exchanged(
    problem: _Problem, start: Index, goal: Goal, rng: np.random.Generator
) -> tuple[Index, int]:
    """Exchange marks one at a time while that improves the objective."""
    chosen, n_exchanges = start.copy(), 0
    score = _objective(problem, chosen, goal)
    for _ in range(_ROUNDS_MAX):
        is_better = False
        for i in rng.permutation(len(chosen)):
            for c in _promising(problem, chosen, int(i), score, rng):
                changed = chosen.copy()
                changed[i] = c
                found = _objective(problem, changed, goal, score[0])
                if found < score:
                    chosen, score, is_better = changed, found, True
                    n_exchanges += 1
                    break
        if not is_better:
            break
    return chosen, n_exchanges


def _promising(
    problem: _Problem,
    chosen: Index,
    i: int,
    score: tuple[float, float, float],
    rng: np.random.Generator,
) -> Index:
    """Return the candidates that would be better as mark i than the present one, best first."""
    others = np.delete(chosen, i)
    free = np.array(~problem.near[others].any(axis=0))
    free[chosen] = False
    places = np.flatnonzero(free)
    if problem.is_paper:
        places = rng.permutation(places)[: max(_SCREENED // len(chosen), 30)]
        scores = np.array([_score(problem, np.append(others, c)) for c in places]).reshape(-1, 2)
    else:
        scores = np.empty((len(places), 2))
        limit = score[1] if score[0] == 0.0 else _WORSE_MOST * score[1]
        stops = np.argsort(-_sigmas(problem, chosen))
        sums, rule = _sums(problem, others), (limit, problem.power)
        _score_each(sums, tuple(problem.added), problem.shared2, places, stops, rule, scores)
    order = np.lexsort((scores[:, 1], scores[:, 0]))
    if score[0] == 0.0:
        order = order[[tuple(scores[o]) < score[1:] for o in order]]
    return places[order[:_TRIED_MAX]]


def _objective(
    problem: _Problem, chosen: Index, goal: Goal, most: float = np.inf
) -> tuple[float, float, float]:
    """Return the objective, the less the better.

    The excess over the tolerance after the loss of a mark, evaluated up to some length, the largest
    sigma over all stops, and their mean [m].
    """
    if not goal.is_robust or len(chosen) < 3:
        return 0.0, *_score(problem, chosen)
    sigma = problem.requirement.tolerance / _Z_95
    excess = max(_after_loss(problem, chosen, most + sigma) - sigma, 0.0)
    return (excess, np.inf, np.inf) if excess > most else (excess, *_score(problem, chosen))


def _sigmas(problem: _Problem, chosen: Index) -> Array:
    """Return the 3-D sigma at each stop; large where there is no position [m]."""
    if not problem.is_paper:
        return np.asarray(_sigma_each(_sums(problem, chosen), problem.shared2), dtype=np.float64)
    every = problem.observables
    some = every._replace(
        marks_site=every.marks_site[chosen],
        cov_centres=every.cov_centres[:, chosen],
        is_seen=every.is_seen[:, chosen],
    )
    cov = predict_positions(some, problem.requirement).cov_motion[:, 3:, 3:]
    return np.asarray(np.minimum(np.sqrt(np.trace(cov, axis1=1, axis2=2)), _LOST))


def _score(problem: _Problem, chosen: Index) -> tuple[float, float]:
    """Return the largest sigma over all stops, or their power mean, and their mean [m]."""
    checkpoint()
    sigmas = _sigmas(problem, chosen)
    worst = float(sigmas.max())
    if np.isfinite(problem.power):
        worst *= float(np.mean((sigmas / worst) ** problem.power)) ** (1.0 / problem.power)
    return worst, float(sigmas.mean())


def _after_loss(problem: _Problem, chosen: Index, most: float = np.inf) -> float:
    """Return the largest sigma over all stops after the loss of any one mark, or one above most."""
    worst = 0.0
    for i in range(len(chosen)):
        worst = max(worst, float(_sigmas(problem, np.delete(chosen, i)).max()))
        if worst > most:
            break
    return worst


def _optimum(problem: _Problem, found: tuple[Index, int], goal: Goal) -> Optimum:
    """Assemble the result; marks are named by azimuth about the middle of the stops."""
    site, stops, candidates, model, requirement, *_ = problem
    chosen, n_exchanges = found
    off = candidates.p_site[chosen, :2] - stops.p_site[:, :2].mean(axis=0)
    chosen = chosen[np.argsort(np.arctan2(off[:, 1], off[:, 0]))]
    marks = Arrangement.numbered(candidates.p_site[chosen])
    after = _after_loss(problem, chosen) if len(chosen) > 2 else np.inf
    gained, bound = (np.nan, np.nan) if problem.is_paper else _bound(problem, chosen)
    return Optimum(
        evaluation=evaluate(site, stops, marks, model, requirement),
        ground=candidates.ground[chosen].copy(),
        worst_after_loss=after if after < _LOST else np.inf,
        is_kept=_keeps(problem, chosen, goal),
        log_det=gained,
        log_det_bound=bound,
        n_candidates=len(candidates.p_site),
        n_exchanges=n_exchanges,
    )


def _keeps(problem: _Problem, chosen: Index, goal: Goal, slack: float = 1.0) -> bool:
    """Return whether marks reach the goal for a multiple of the tolerance."""
    site, stops, candidates, model, requirement, *_ = problem
    wider = replace(requirement, tolerance=slack * requirement.tolerance)
    marks, n = Arrangement.numbered(candidates.p_site[chosen]), len(chosen)
    remaining = [np.arange(n)]
    if goal.is_robust and n >= 3:
        remaining += [np.delete(np.arange(n), i) for i in range(n)]
    visibility = find_visibility(site, stops.p_site, marks)
    return all(
        evaluate(
            site, stops, marks.rows(keep), model, wider, visibility=visibility.rows(keep)
        ).worst_probability
        >= goal.probability
        for keep in remaining
    )


def _least(problem: _Problem, goal: Goal) -> int:
    """Return a lower bound of the number of marks; raise if no number keeps the tolerance."""
    least = 3 if problem.is_paper or goal.is_robust else 2
    if goal.most < least:
        raise ConfigError(f"At most {goal.most} marks; {least} are needed for this goal.")
    _refuse_impossible(problem)
    requirement = problem.requirement
    sigmas = least_sigmas(problem.observables, requirement)[:, : goal.most]
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
    return _sigmas(problem, np.flatnonzero(problem.observables.is_seen.any(axis=0)))


def _refuse_impossible(problem: _Problem) -> None:
    """Raise if not even all marks at once would bring the 3-D sigma below the tolerance."""
    if problem.is_paper:
        return
    sigmas, tolerance = _sigmas_of_all(problem), problem.requirement.tolerance
    worst = int(np.argmax(sigmas))
    if sigmas[worst] > tolerance:
        best = f"{1e3 * sigmas[worst]:.2g} mm (3-D sigma)" if sigmas[worst] < _LOST else "nothing"
        raise DegenerateGeometryError(
            f"No arrangement keeps {1e3 * tolerance:g} mm: even a mark at each of "
            f"{len(problem.near)} places at once would leave {best} at "
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
    if not problem.is_paper:
        text += (
            f" Even a mark at each of {best.n_candidates} places at once would leave "
            f"{1e3 * float(_sigmas_of_all(problem).max()):.2g} mm: ask for a larger tolerance."
        )
    return text


@compiled
def _add(a: Array, b: Array, out: Array) -> None:
    """Write the sum of two (6, 6) matrices."""
    for i in range(6):
        for j in range(6):
            out[i, j] = a[i, j] + b[i, j]


@compiled
def _log_det(N: Array) -> float:
    """Return the logarithm of the determinant of a positive (6, 6) matrix; overwrites the matrix.

    Without the limit of ``factorise``: a loose prior beside precise marks is no singularity.
    """
    total = 0.0
    for i in range(6):
        for k in range(i):
            N[i, i] -= N[i, k] * N[i, k]
        if N[i, i] <= 0.0:
            return -np.inf
        N[i, i] = np.sqrt(N[i, i])
        total += 2.0 * np.log(N[i, i])
        for j in range(i + 1, 6):
            for k in range(i):
                N[j, i] -= N[j, k] * N[i, k]
            N[j, i] /= N[i, i]
    return total


@compiled
def _gains(normal: Array, added: Array) -> Array:
    """Return what each candidate adds to the log-determinants of all stops together."""
    gains, work, nothing = np.zeros(added.shape[1]), np.empty((6, 6)), np.zeros((6, 6))
    for e in range(len(normal)):
        _add(normal[e], nothing, work)
        before = _log_det(work)
        for c in range(added.shape[1]):
            if added[e, c, 3, 3] + added[e, c, 4, 4] + added[e, c, 5, 5] > 0.0:
                _add(normal[e], added[e, c], work)
                gains[c] += _log_det(work) - before
    return gains


@compiled
def _sigma(
    N: Array, cov_rhs: Array, bias_rhs: Array, shared2: tuple[float, float], inverse: Array
) -> float:
    """Return the 3-D sigma of one stop; large without a position."""
    if not invert(N, inverse) or inverse[3, 3] + inverse[4, 4] + inverse[5, 5] > LOOSE2:
        return _LOST
    total = shared2[1]
    for i in range(3, 6):
        moved = 0.0
        for j in range(6):
            moved += inverse[i, j] * bias_rhs[j]
            for k in range(6):
                total += inverse[i, j] * cov_rhs[j, k] * inverse[k, i]
        total += shared2[0] * moved * moved
    return float(np.sqrt(total))


@compiled
def _sigma_each(sums: tuple[Array, Array, Array], shared2: tuple[float, float]) -> Array:
    """Return the 3-D sigma of each stop; large without a position."""
    normal, cov_rhs, bias_rhs = sums
    inverse, out = np.empty((6, 6)), np.empty(len(normal))
    for e in range(len(normal)):
        out[e] = _sigma(normal[e], cov_rhs[e], bias_rhs[e], shared2, inverse)
    return out


@compiled
def _score_each(  # noqa: PLR0913  a kernel takes what it needs
    sums: tuple[Array, Array, Array],
    added: tuple[Array, Array, Array],
    shared2: tuple[float, float],
    places: Index,
    stops: Index,
    rule: tuple[float, float],
    out: Array,
) -> None:
    """Write the largest sigma, or power mean, and the mean with each candidate added.

    Stops are left out once a candidate exceeds the limit of the rule.
    """
    limit, power = rule
    is_smooth = np.isfinite(power)
    beyond = len(stops) * limit**power if is_smooth and np.isfinite(limit) else np.inf
    N, cov_rhs, bias_rhs = np.empty((6, 6)), np.empty((6, 6)), np.empty(6)
    inverse = np.empty((6, 6))
    for i in range(len(places)):
        c = places[i]
        worst, total, powers = 0.0, 0.0, 0.0
        for s in range(len(stops)):
            e = stops[s]
            _add(sums[0][e], added[0][e, c], N)
            _add(sums[1][e], added[1][e, c], cov_rhs)
            for k in range(6):
                bias_rhs[k] = sums[2][e, k] + added[2][e, c, k]
            sigma = _sigma(N, cov_rhs, bias_rhs, shared2, inverse)
            total += sigma
            if is_smooth:
                powers += sigma**power
            else:
                worst = max(worst, sigma)
            if worst > limit or powers > beyond:
                worst, powers, total = max(worst, 2.0 * limit), 2.0 * beyond, np.inf
                break
        out[i, 0] = (powers / len(stops)) ** (1.0 / power) if is_smooth else worst
        out[i, 1] = total / len(stops)
