"""Where to put marks: greedy on information, then exchange on what is really wanted.

What a free station knows is a sum over its marks, so that a mark can be added, taken away or
exchanged in some hundred operations per stop. The study's method has no such sum; its arrangements
are judged whole.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.errors import ConfigError, DegenerateGeometryError
from spheremark.pipelines.estimation.linear_algebra import invert
from spheremark.pipelines.model import Array, Index
from spheremark.pipelines.placement.bounds import least_sigmas, widest_sigma
from spheremark.pipelines.placement.candidates import Candidates
from spheremark.pipelines.placement.centre_model import CentreModel
from spheremark.pipelines.placement.evaluation import check_sizes, evaluate, sighting_of
from spheremark.pipelines.placement.plan import Arrangement, Evaluation, Requirement, Site, Stops
from spheremark.pipelines.placement.station_covariance import (
    LOOSE2,
    Information,
    Sighting,
    information,
    predict_positions,
    shared_variance,
)
from spheremark.pipelines.placement.visibility import look

MARKS_MOST = 40
"""Marks that are placed at most."""

_LOST = 1e3  # [m] counts for a stop without a position: worse than any that has one
_LOOSE_PRIOR = np.array([3.0, 3.0, 3.0, 10.0, 10.0, 10.0])  # [rad, m] before any mark is seen
_SURE = 1.96  # sigmas within which an error of any shape lies with 95 %: 3-D sigma on one axis
_ROUNDS = 30  # of exchanges; four to eight settle
_STARTS, _STARTS_LEAST = 16, 2
_MARKS_STARTED = 96  # in all starts together: many marks leave little to chance
_STARTS_WHOLE = 4  # of whole judgements
_DRAWN, _DRAWN_KEPT = 1500, 40  # arrangements at random that these begin with, and judge in full
_POWER = 12.0  # of the mean over stops that is as good as their largest, and smoother
_SHAKEN = 0.4  # share of marks that such a start has elsewhere
_FEW = 10  # marks that are always searched in full
_SLACK, _SLACK_WHOLE = 1.15, 2.0  # times the tolerance that a short search keeps: more helps none
_WORSE = 1.3  # than now, at most, while a loss would break what is wanted
_TRIED = 12  # candidates that are judged in full for each mark, the most promising first
_SCREENED = 800  # places that whole judgements try in a round, for all marks together


@dataclass(frozen=True, slots=True, kw_only=True)
class Goal:
    """What is to be found.

    Attributes
    ----------
    n_marks : int or None
        Number of marks; none asks for the least number that keeps the tolerance.
    probability : float
        With which the tolerance shall be kept at every stop.
    is_robust : bool
        Whether it shall be kept after the loss of any one mark too; only for three marks or more.
    most : int
        Marks that there are at most when the least number is asked for.
    """

    n_marks: int | None = None
    probability: float = 0.95
    is_robust: bool = True
    most: int = 20

    def __post_init__(self) -> None:
        if self.n_marks is not None and not 2 <= self.n_marks <= MARKS_MOST:
            raise ConfigError(
                f"{self.n_marks} marks were asked for; from 2 to {MARKS_MOST} can be placed."
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
        What they promise; its marks are the answer.
    ground : (k,)
        Height of the ground under each mark [m].
    worst_after_loss : float
        Largest 3-D sigma over all stops after the loss of any one mark; infinite where a stop
        would have no position [m].
    is_kept : bool
        Whether the tolerance is kept at every stop with the probability that was asked for, after
        a loss too if that was asked for.
    log_det, log_det_bound : float
        Information gained, as the sum over stops of the logarithm of its determinant, and what no
        arrangement of as many marks can exceed; NaN for a method that has no such sum.
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
        What the arrangement promises without and with it; its name is the last.
    """

    p_site: Array
    ground: float
    before: Evaluation
    after: Evaluation


class _Task(NamedTuple):
    """Candidates as the stops see them.

    Attributes
    ----------
    sighting : Sighting
        All candidates, marks that stand already behind them.
    added : Information
        What each adds.
    prior : (6, 6)
        What gravity tells.
    shared2 : tuple of float
        Variances of what all ranges are too long, and of what all centres are too high [m^2].
    near : (c, c)
        Which candidates are too near to each other.
    wish : Requirement
        Tolerance and method.
    """

    sighting: Sighting
    added: Information
    prior: Array
    shared2: tuple[float, float]
    near: np.ndarray
    wish: Requirement
    power: float = np.inf


def optimise(  # noqa: PLR0913  all that a plan is made of
    site: Site,
    stops: Stops,
    candidates: Candidates,
    model: CentreModel,
    wish: Requirement,
    goal: Goal,
    rng: np.random.Generator,
) -> Optimum:
    """Find the best places for a number of marks, or the least number that keeps the tolerance.

    Parameters
    ----------
    site : Site
        Ground and what hides marks.
    stops : Stops
        Places of the LiDAR; all of them count at once.
    candidates : Candidates
        Where a mark may stand.
    model : CentreModel
        How well centres will be known.
    wish : Requirement
        Tolerance and method.
    goal : Goal
        Number of marks, or what shall be kept.
    rng : numpy.random.Generator
        Shakes the later starts.

    Returns
    -------
    Optimum
        Marks and what they promise.

    Raises
    ------
    DegenerateGeometryError
        If no number of marks keeps the tolerance, with the bound that nothing exceeds.

    Notes
    -----
    Greedy on the regularised logarithm of the determinant of the information, summed over stops,
    which is monotone and submodular: at least 63 % of the greatest gain (Nemhauser, Wolsey, Fisher,
    1978), and the bound is their sum of the largest gains that are left. Then marks are exchanged
    one at a time while that lowers, in this order, what a loss would break, the largest 3-D sigma
    over all stops, and their mean. Cost of a round grows with marks times candidates times stops.
    """
    check_sizes(len(stops.names), goal.n_marks or goal.most)
    task = _task(site, stops, candidates, model, wish)
    given = site, stops, candidates, model, task

    def tried(k: int) -> Optimum:
        return _optimum(*given, _best(task, k, goal, rng), goal)

    if goal.n_marks is not None:
        return tried(goal.n_marks)
    least = _least(task, stops, goal)

    def is_kept(chosen: Index, slack: float) -> bool:
        wider = replace(wish, tolerance=slack * wish.tolerance)
        marks = Arrangement.numbered(candidates.p_site[chosen])
        return _keeps(site, stops, marks, model, wider, goal)

    slack = _SLACK_WHOLE if wish.method == "paper" else _SLACK
    most = _glance(task, goal.most, goal, rng)
    if most is not None and not is_kept(most, 1.0):
        is_near = is_kept(most, slack)
        found = tried(goal.most) if is_near else _optimum(*given, (most, 0), goal)
        if not found.is_kept:
            raise DegenerateGeometryError(_impossible(task, stops, found, goal))
    for k in range(least, goal.most):
        some = _glance(task, k, goal, rng)
        if some is not None and is_kept(some, 1.0):  # a better sigma may have a worse shape
            found = tried(k)
            return found if found.is_kept else _optimum(*given, (some, 0), goal)
        if (some is None or is_kept(some, slack)) and (found := tried(k)).is_kept:
            return found
    if (found := tried(goal.most)).is_kept:
        return found
    raise DegenerateGeometryError(_impossible(task, stops, found, goal))


def propose_mark(
    site: Site,
    stops: Stops,
    present: Arrangement,
    candidates: Candidates,
    model: CentreModel,
    wish: Requirement,
) -> Proposal:
    """Name the one more mark that would help most.

    It has the least power mean of 3-D sigmas over all stops: the worst count most, and where no
    place helps them, the next ones do.

    Parameters
    ----------
    site : Site
        Ground and what hides marks.
    stops : Stops
        Places of the LiDAR.
    present : Arrangement
        Marks that stand already.
    candidates : Candidates
        Where one more may stand.
    model : CentreModel
        How well centres will be known.
    wish : Requirement
        Tolerance and method.

    Returns
    -------
    Proposal
        Its place, and what it changes.

    Raises
    ------
    DegenerateGeometryError
        If no candidate is far enough from the marks that stand.
    """
    gaps = np.linalg.norm(candidates.p_site[:, None] - present.p_site[None], axis=2)
    free = gaps.min(axis=1, initial=np.inf) >= candidates.apart
    if not free.any():
        raise DegenerateGeometryError(
            f"No place for one more mark is {candidates.apart:g} m from those that stand."
        )
    places = np.flatnonzero(free)
    n = len(places)
    p_site = np.concatenate([candidates.p_site[places], present.p_site])
    ground = np.concatenate([candidates.ground[places], np.zeros(len(present.names))])
    all_of_them = Candidates(p_site=p_site, ground=ground, apart=1e-6)
    task = _task(site, stops, all_of_them, model, wish)._replace(power=_POWER)
    fixed = np.arange(n, n + len(present.names))
    scores = [_score(task, np.append(fixed, c)) for c in range(n)]
    best = min(range(n), key=scores.__getitem__)
    name = next(f"P{i:02d}" for i in range(1, 1000) if f"P{i:02d}" not in present.names)
    wider = Arrangement(
        names=(*present.names, name), p_site=np.vstack([present.p_site, p_site[best]])
    )
    return Proposal(
        p_site=p_site[best].copy(),
        ground=float(ground[best]),
        before=evaluate(site, stops, present, model, wish),
        after=evaluate(site, stops, wider, model, wish),
    )


def draw_arrangement(candidates: Candidates, n_marks: int, rng: np.random.Generator) -> Arrangement:
    """Return marks at random among the places where they may stand."""
    chosen: list[int] = []
    for c in rng.permutation(len(candidates.p_site)):
        gaps = np.linalg.norm(candidates.p_site[chosen] - candidates.p_site[c], axis=1)
        if not chosen or gaps.min() >= candidates.apart:
            chosen.append(int(c))
        if len(chosen) == n_marks:
            return Arrangement.numbered(candidates.p_site[chosen])
    raise DegenerateGeometryError(_no_room(candidates, n_marks, len(chosen)))


def best_without_search(  # noqa: PLR0913  all that a plan is made of
    site: Site,
    stops: Stops,
    candidates: Candidates,
    model: CentreModel,
    wish: Requirement,
    n_marks: int,
    drawn: tuple[int, np.random.Generator] | None,
) -> float:
    """Return the least 3-D sigma at the worst stop that chance finds, or of all arrangements.

    Parameters
    ----------
    site : Site
        Ground and what hides marks.
    stops : Stops
        Places of the LiDAR.
    candidates : Candidates
        Where a mark may stand.
    model : CentreModel
        How well centres will be known.
    wish : Requirement
        Tolerance and method.
    n_marks : int
        Number of marks.
    drawn : tuple of int and numpy.random.Generator, optional
        How many arrangements are drawn; without it all that there are are judged.

    Returns
    -------
    float
        What an optimised arrangement is measured by [m].
    """
    task = _task(site, stops, candidates, model, wish)
    some: Iterable[Index]
    if drawn is not None:
        some = (_drawn(task, n_marks, drawn[1]) for _ in range(drawn[0]))
    else:
        every = combinations(range(len(task.near)), n_marks)
        some = (c for c in map(np.array, every) if task.near[np.ix_(c, c)].sum() == n_marks)
    return min(_score(task, chosen)[0] for chosen in some)


def _no_room(candidates: Candidates, wanted: int, found: int) -> str:
    """Say that there are too few places."""
    return (
        f"There is room for {found} of {wanted} marks {candidates.apart:g} m apart on "
        f"{len(candidates.p_site)} places; allow more places or marks nearer to each other."
    )


def _task(
    site: Site, stops: Stops, candidates: Candidates, model: CentreModel, wish: Requirement
) -> _Task:
    """Look at every candidate from every stop."""
    marks = candidates.arrangement
    alone = look(site, stops.p_site, marks)
    _, sighting = sighting_of(stops.p_site, marks, model, wish, alone)
    gaps = np.linalg.norm(candidates.p_site[:, None] - candidates.p_site[None], axis=2)
    prior = np.zeros((6, 6))
    prior[0, 0] = prior[1, 1] = wish.sigma_levelling**-2
    return _Task(
        sighting=sighting,
        added=information(sighting, wish),
        prior=prior,
        shared2=(
            shared_variance(model.sensor.sigma_range_bias),
            wish.resection.sigma_height**2,
        ),
        near=gaps < candidates.apart,
        wish=wish,
    )


def _sums(task: _Task, chosen: Index) -> tuple[Array, Array, Array]:
    """Return what stops know with some candidates: normal matrix, spread and pull."""
    normal, spread, pull = (part[:, chosen].sum(axis=1) for part in task.added)
    return normal + task.prior, spread + task.prior, pull


def _best(task: _Task, k: int, goal: Goal, rng: np.random.Generator) -> tuple[Index, int]:
    """Return the best places of k marks that several starts led to, and exchanges made.

    The first start is greedy, or the best of many at random where information says little; the
    second goes on from it with places at random, the others shake what is best so far (iterated
    local search: Lourenco, Martin, Stuetzle, 2003). Each goes down on a high power mean over the
    stops, which has fewer dead ends than their largest, then on that.
    """
    smooth = task._replace(power=_POWER)
    best, score, n_exchanges = _greedy(task, k), (np.inf, np.inf, np.inf), 0
    is_whole = task.wish.method == "paper"
    if is_whole:
        best = _best_drawn(task, best, goal, rng)
    n_starts = max(_STARTS_LEAST, min(_STARTS, _MARKS_STARTED // k))
    for i in range(_STARTS_WHOLE if is_whole else n_starts):
        start = best if i == 0 else _shaken(task, best, 1.0 if i == 1 else _SHAKEN, rng)
        found, n = _exchanged(smooth, start, goal, rng)
        found, m = _exchanged(task, found, goal, rng)
        n_exchanges += n + m
        if (other := _wanted(task, found, goal)) < score:
            best, score = found, other
    return best, n_exchanges


def _best_drawn(task: _Task, other: Index, goal: Goal, rng: np.random.Generator) -> Index:
    """Return the best of many arrangements at random, and of another with as many marks."""
    drawn = [other, *(_drawn(task, len(other), rng) for _ in range(_DRAWN))]
    drawn = [chosen for chosen in drawn if len(chosen) == len(other)]
    drawn.sort(key=lambda chosen: _score(task, chosen))
    return min(drawn[:_DRAWN_KEPT], key=lambda chosen: _wanted(task, chosen, goal))


def _drawn(task: _Task, k: int, rng: np.random.Generator) -> Index:
    """Return k candidates at random that are not too near to each other; fewer without room."""
    chosen: list[int] = []
    for c in rng.permutation(len(task.near)):
        if len(chosen) == k:
            break
        if not task.near[c, chosen].any():
            chosen.append(int(c))
    return np.array(chosen, dtype=np.intp)


def _greedy(task: _Task, k: int) -> Index:
    """Return k candidates, each the one that adds most information to those before it."""
    chosen: list[int] = []
    allowed = task.sighting.is_seen.any(axis=0)
    normal = np.tile(task.prior + np.diag(_LOOSE_PRIOR**-2.0), (len(task.sighting.eyes_site), 1, 1))
    for _ in range(k):
        if not allowed.any():
            raise DegenerateGeometryError(
                f"There is room for {len(chosen)} of {k} marks that a stop can see; allow more "
                "places, or marks nearer to each other."
            )
        gains = np.where(allowed, _gains(normal, task.added.normal), -np.inf)
        best = int(np.argmax(gains))
        chosen.append(best)
        normal += task.added.normal[:, best]
        allowed &= ~task.near[best]
    return np.array(chosen, dtype=np.intp)


def _bound(task: _Task, chosen: Index) -> tuple[float, float]:
    """Return the information gained, and what no arrangement of as many marks can exceed."""
    start = task.prior + np.diag(_LOOSE_PRIOR**-2.0)
    normal = start + task.added.normal[:, chosen].sum(axis=1)
    gained = float((np.linalg.slogdet(normal)[1] - np.linalg.slogdet(start)[1]).sum())
    gains = np.sort(_gains(normal, task.added.normal))[::-1]
    nothing = np.tile(start, (len(normal), 1, 1))
    singles = np.sort(_gains(nothing, task.added.normal))[::-1]
    return gained, min(
        gained + float(gains[: len(chosen)].sum()), float(singles[: len(chosen)].sum())
    )


def _shaken(task: _Task, chosen: Index, share: float, rng: np.random.Generator) -> Index:
    """Return an arrangement of which a share of the marks stands elsewhere."""
    out = chosen.copy()
    for i in rng.choice(len(out), max(1, round(share * len(out))), replace=False):
        others = np.delete(out, i)
        free = np.flatnonzero(~task.near[others].any(axis=0))
        out[i] = rng.choice(free) if len(free) else out[i]
    return out


def _exchanged(
    task: _Task, start: Index, goal: Goal, rng: np.random.Generator
) -> tuple[Index, int]:
    """Exchange marks one at a time while that improves what is wanted."""
    chosen, n_exchanges = start.copy(), 0
    score = _wanted(task, chosen, goal)
    for _ in range(_ROUNDS):
        is_better = False
        for i in rng.permutation(len(chosen)):
            for c in _promising(task, chosen, int(i), score, rng):
                trial = chosen.copy()
                trial[i] = c
                found = _wanted(task, trial, goal, score[0])
                if found < score:
                    chosen, score, is_better = trial, found, True
                    n_exchanges += 1
                    break
        if not is_better:
            break
    return chosen, n_exchanges


def _promising(
    task: _Task,
    chosen: Index,
    i: int,
    score: tuple[float, float, float],
    rng: np.random.Generator,
) -> Index:
    """Return the candidates that would be better in place i than what stands there, best first."""
    others = np.delete(chosen, i)
    free = np.array(~task.near[others].any(axis=0))
    free[chosen] = False
    if task.wish.method == "paper":
        places = np.flatnonzero(free)
        places = rng.permutation(places)[: max(_SCREENED // len(chosen), 30)]
        worsts = np.array([_score(task, np.append(others, c)) for c in places]).reshape(-1, 2)
    else:
        places = np.flatnonzero(free)
        worsts = np.empty((len(places), 2))
        limit = score[1] if score[0] == 0.0 else _WORSE * score[1]
        stops = np.argsort(-_sigmas(task, chosen))
        _judge(
            _sums(task, others),
            tuple(task.added),
            task.shared2,
            places,
            stops,
            (limit, task.power),
            worsts,
        )
    order = np.lexsort((worsts[:, 1], worsts[:, 0]))
    if score[0] == 0.0:
        order = order[[tuple(worsts[o]) < score[1:] for o in order]]
    return places[order[:_TRIED]]


def _wanted(
    task: _Task, chosen: Index, goal: Goal, most: float = np.inf
) -> tuple[float, float, float]:
    """Return what an arrangement is judged by, the less the better.

    By how much the loss of a mark would break the tolerance, looked at until that is more than some
    length, the largest sigma over all stops, and their mean [m].
    """
    if not goal.is_robust or len(chosen) < 3:
        return 0.0, *_score(task, chosen)
    sure = task.wish.tolerance / _SURE
    broken = max(_after_loss(task, chosen, most + sure) - sure, 0.0)
    return (broken, np.inf, np.inf) if broken > most else (broken, *_score(task, chosen))


def _sigmas(task: _Task, chosen: Index) -> Array:
    """Return the 3-D sigma at each stop; large where there is no position [m]."""
    if task.wish.method == "paper":
        some = task.sighting._replace(
            marks_site=task.sighting.marks_site[chosen],
            cov_centres=task.sighting.cov_centres[:, chosen],
            is_seen=task.sighting.is_seen[:, chosen],
        )
        variances = np.trace(
            predict_positions(some, task.wish).cov_motion[:, 3:, 3:], axis1=1, axis2=2
        )
        return np.asarray(np.minimum(np.sqrt(variances), _LOST), dtype=np.float64)
    return np.asarray(_sigmas_of(_sums(task, chosen), task.shared2), dtype=np.float64)


def _score(task: _Task, chosen: Index) -> tuple[float, float]:
    """Return the largest sigma over all stops, or their power mean, and their mean [m]."""
    sigmas = _sigmas(task, chosen)
    worst = float(sigmas.max())
    if np.isfinite(task.power):
        worst *= float(np.mean((sigmas / worst) ** task.power)) ** (1.0 / task.power)
    return worst, float(sigmas.mean())


def _after_loss(task: _Task, chosen: Index, most: float = np.inf) -> float:
    """Return the largest sigma over all stops after the loss of any one mark, or one above most."""
    worst = 0.0
    for i in range(len(chosen)):
        worst = max(worst, float(_sigmas(task, np.delete(chosen, i)).max()))
        if worst > most:
            break
    return worst


def _optimum(  # noqa: PLR0913  all that an answer is made of
    site: Site,
    stops: Stops,
    candidates: Candidates,
    model: CentreModel,
    task: _Task,
    found: tuple[Index, int],
    goal: Goal,
) -> Optimum:
    """Assemble the answer; marks are named by azimuth about the middle of the stops."""
    chosen, n_exchanges = found
    off = candidates.p_site[chosen, :2] - stops.p_site[:, :2].mean(axis=0)
    chosen = chosen[np.argsort(np.arctan2(off[:, 1], off[:, 0]))]
    marks = Arrangement.numbered(candidates.p_site[chosen])
    promised = evaluate(site, stops, marks, model, task.wish)
    after = _after_loss(task, chosen) if len(chosen) > 2 else np.inf
    gained, bound = (np.nan, np.nan) if task.wish.method == "paper" else _bound(task, chosen)
    return Optimum(
        evaluation=promised,
        ground=candidates.ground[chosen].copy(),
        worst_after_loss=after if after < _LOST else np.inf,
        is_kept=_keeps(site, stops, marks, model, task.wish, goal),
        log_det=gained,
        log_det_bound=bound,
        n_candidates=len(candidates.p_site),
        n_exchanges=n_exchanges,
    )


def _keeps(
    site: Site,
    stops: Stops,
    marks: Arrangement,
    model: CentreModel,
    wish: Requirement,
    goal: Goal,
) -> bool:
    """Return whether marks keep the tolerance at every stop, after a loss too if that counts."""
    n = len(marks.names)
    keeps = [np.arange(n)]
    if goal.is_robust and n >= 3:
        keeps += [np.delete(np.arange(n), i) for i in range(n)]
    sights = look(site, stops.p_site, marks)
    return all(
        evaluate(
            site, stops, marks.rows(keep), model, wish, sights=sights.rows(keep)
        ).worst_probability
        >= goal.probability
        for keep in keeps
    )


def _least(task: _Task, stops: Stops, goal: Goal) -> int:
    """Return a number of marks that fewer cannot keep the tolerance with; raise if none can."""
    least = 3 if task.wish.method == "paper" or goal.is_robust else 2
    if goal.most < least:
        raise ConfigError(f"At most {goal.most} marks; {least} are needed for what is asked.")
    _refuse_impossible(task, stops)
    sigmas = least_sigmas(task.sighting, task.wish)[:, : goal.most]
    wanted = widest_sigma(task.wish.tolerance, goal.probability)
    enough = np.flatnonzero(sigmas.max(axis=0) <= wanted) + 1 + goal.is_robust
    if len(enough) and enough[0] <= goal.most:
        return max(least, int(enough[0]))
    place = sigmas.shape[1] - 1 - (goal.is_robust and sigmas.shape[1] > 1)
    worst = int(np.argmax(sigmas[:, place]))
    raise DegenerateGeometryError(
        f"No arrangement of {goal.most} marks keeps {_asked(task, goal)}: wherever they stood, the "
        f"3-D sigma at {stops.names[worst]} would be {1e3 * sigmas[worst, place]:.2g} mm or more, "
        f"and {1e3 * wanted:.2g} mm is the most with which that can be. Ask for a larger "
        "tolerance, or allow more places."
    )


def _asked(task: _Task, goal: Goal) -> str:
    """Say what shall be kept."""
    after = " after the loss of any one" if goal.is_robust else ""
    return (
        f"{1e3 * task.wish.tolerance:g} mm with {100 * goal.probability:g} % at every stop{after}"
    )


def _refuse_impossible(task: _Task, stops: Stops) -> None:
    """Raise if not even all marks at once would bring the 3-D sigma below the tolerance."""
    if task.wish.method == "paper":
        return
    sigmas = _sigmas(task, np.flatnonzero(task.sighting.is_seen.any(axis=0)))
    worst = int(np.argmax(sigmas))
    if sigmas[worst] > task.wish.tolerance:
        best = f"{1e3 * sigmas[worst]:.2g} mm (3-D sigma)" if sigmas[worst] < _LOST else "nothing"
        raise DegenerateGeometryError(
            f"No arrangement keeps {1e3 * task.wish.tolerance:g} mm: even a mark at each of "
            f"{task.near.shape[0]} places at once would leave {best} at {stops.names[worst]}. Ask "
            "for a larger tolerance, or allow more places."
        )


def _glance(task: _Task, k: int, goal: Goal, rng: np.random.Generator) -> Index | None:
    """Return the best places of k marks that a short search finds.

    None where there is no room, and for few marks, of which a short search tells too little.
    """
    if k <= _FEW and task.wish.method != "paper":
        return None
    try:
        chosen = _greedy(task, k)
    except DegenerateGeometryError:
        return None
    if task.wish.method == "paper":
        return _best_drawn(task, chosen, goal, rng)
    quick = replace(goal, is_robust=False)  # judging losses takes ten times as long
    return _exchanged(task._replace(power=_POWER), chosen, quick, rng)[0]


def _impossible(task: _Task, stops: Stops, best: Optimum, goal: Goal) -> str:
    """Say that no number of marks keeps the tolerance, and what nothing can exceed."""
    text = f"{goal.most} marks do not keep {_asked(task, goal)}"
    worst = int(np.argmax(best.evaluation.sigma_3d))
    text += (
        f": the best that was found leaves {1e3 * best.evaluation.sigma_3d[worst]:.3g} mm (3-D "
        f"sigma) at {stops.names[worst]}."
    )
    if task.wish.method != "paper":
        sigmas = _sigmas(task, np.flatnonzero(task.sighting.is_seen.any(axis=0)))
        text += (
            f" Even a mark at each of {best.n_candidates} places at once would leave "
            f"{1e3 * float(sigmas.max()):.2g} mm: ask for a larger tolerance."
        )
    return text


@compiled
def _log_det(N: Array) -> float:
    """Return the logarithm of the determinant of a positive (6, 6) matrix, which is spoilt."""
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
    gains = np.zeros(added.shape[1])
    work = np.empty((6, 6))
    for e in range(len(normal)):
        work[:] = normal[e]
        before = _log_det(work)
        for c in range(added.shape[1]):
            if added[e, c, 3, 3] + added[e, c, 4, 4] + added[e, c, 5, 5] > 0.0:
                work[:] = normal[e] + added[e, c]
                gains[c] += _log_det(work) - before
    return gains


@compiled
def _sigma_of(
    N: Array, spread: Array, pull: Array, shared2: tuple[float, float], inverse: Array
) -> float:
    """Return the 3-D sigma of one stop; large without a position."""
    if not invert(N, inverse) or inverse[3, 3] + inverse[4, 4] + inverse[5, 5] > LOOSE2:
        return _LOST
    total = shared2[1]
    for i in range(3, 6):
        moved = 0.0
        for j in range(6):
            moved += inverse[i, j] * pull[j]
            for k in range(6):
                total += inverse[i, j] * spread[j, k] * inverse[k, i]
        total += shared2[0] * moved * moved
    return float(np.sqrt(total))


@compiled
def _sigmas_of(sums: tuple[Array, Array, Array], shared2: tuple[float, float]) -> Array:
    """Return the 3-D sigma of each stop; large without a position."""
    normal, spread, pull = sums
    inverse = np.empty((6, 6))
    out = np.empty(len(normal))
    for e in range(len(normal)):
        out[e] = _sigma_of(normal[e], spread[e], pull[e], shared2, inverse)
    return out


@compiled
def _judge(  # noqa: PLR0913  a kernel takes what it needs
    sums: tuple[Array, Array, Array],
    added: tuple[Array, Array, Array],
    shared2: tuple[float, float],
    places: Index,
    stops: Index,
    rule: tuple[float, float],
    out: Array,
) -> None:
    """Fill in the largest sigma, or power mean, and the mean with each candidate added.

    Beyond a limit it is not looked any further.
    """
    limit, power = rule
    is_smooth = np.isfinite(power)
    beyond = len(stops) * limit**power if is_smooth and np.isfinite(limit) else np.inf
    N, spread, pull, inverse = np.empty((6, 6)), np.empty((6, 6)), np.empty(6), np.empty((6, 6))
    for i in range(len(places)):
        c = places[i]
        worst, total, powers = 0.0, 0.0, 0.0
        for e in stops:
            N[:] = sums[0][e] + added[0][e, c]
            spread[:] = sums[1][e] + added[1][e, c]
            pull[:] = sums[2][e] + added[2][e, c]
            sigma = _sigma_of(N, spread, pull, shared2, inverse)
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
