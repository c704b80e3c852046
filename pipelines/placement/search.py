"""The search for places: exchanges between places of a grid, then steps off it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist

from spheremark.pipelines.accuracy.probability import WIDEST_95
from spheremark.pipelines.errors import ConfigError, DegenerateGeometryError
from spheremark.pipelines.model import Array, Index
from spheremark.pipelines.placement.bounds import groups_of
from spheremark.pipelines.placement.branching import Places, relax
from spheremark.pipelines.placement.candidates import Candidates, places_near
from spheremark.pipelines.placement.evaluation import evaluate, worst_after_loss
from spheremark.pipelines.placement.plan import Arrangement, Evaluation
from spheremark.pipelines.placement.scoring import LOST, Problem, problem_of, scores_of
from spheremark.pipelines.placement.visibility import find_visibility
from spheremark.pipelines.placement.walk import perimeters

OBJECTIVES = ("worst", "after_loss", "mean")
"""What is least: the largest 3-D sigma over all stops, that after a loss, or their mean."""

MARKS_MOST = 40
"""Marks that are placed at most."""

POWER = 12.0
"""Exponent of the mean over stops that is as good as their largest, and smoother."""

_ROUNDS_MAX = 30  # of exchanges; four to eight settle
_DRAWN_EVENLY, _DRAWN_BY_SHARES = 1600, 400  # random arrangements, of which starts are chosen
_MARKS_STARTED, _STARTS_MIN, _STARTS_MAX = 48, 3, 12  # in all descents on the grid; descents
_POLISHED = 3  # of these that are carried off the grid
_FINEST = 0.01  # [m] last step off the grid: finer than a mark can be staked out
_WORTH = 0.9998  # of the objective that is reached: a smaller gain ends a search
_WORSE_MOST = 1.3  # than now, at most, while the loss of a mark would break the tolerance
_TRIED = 32  # places for a mark of which losses are evaluated, the most promising first
_LOSSES = 2  # the worst without it, by which these are chosen where a loss weighs ...
_HEAVY = 0.2  # ... so much
_FAINT = 1e-12  # share of a place by which none is drawn

Score = tuple[float, float, float]
"""Excess after a loss, objective, mean over stops [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Goal:
    """Number of marks, or the accuracy that decides it, and what is least.

    Attributes
    ----------
    n_marks : int or None
        Number of marks, those that stand included; by default the least that keeps the tolerance.
    probability : float
        Required probability that the tolerance is kept at every stop.
    is_robust : bool
        Whether this shall hold after the loss of any one mark too; only for three marks or more.
    most : int
        Largest number of marks when the least number is searched.
    objective : str
        One of ``OBJECTIVES``.
    loss_weight : float
        Exponent of the largest sigma after a loss beside that of the worst stop, 0 to 1, where that
        is the objective. 0.03: one percent at the worst stop is worth a third after a loss.
    walk_weight : float
        Exponent of the way past all marks in the objective, 0 to 1. 0.1: a way shorter by a tenth
        is worth one percent at the worst stop.
    stop_reach : float
        How far stops may be moved from where they are given [m].
    """

    n_marks: int | None = None
    probability: float = 0.95
    is_robust: bool = True
    most: int = 20
    objective: str = "worst"
    loss_weight: float = 0.03
    walk_weight: float = 0.0
    stop_reach: float = 0.0

    def __post_init__(self) -> None:
        if self.n_marks is not None and not 2 <= self.n_marks <= MARKS_MOST:
            raise ConfigError(
                f"{self.n_marks} marks are requested; from 2 to {MARKS_MOST} can be placed."
            )
        if not 2 <= self.most <= MARKS_MOST:
            raise ConfigError(f"At most {self.most} marks; it must be from 2 to {MARKS_MOST}.")
        if not 0.0 < self.probability < 1.0:
            raise ConfigError(f"probability is {self.probability!r}; it must lie between 0 and 1.")
        if self.objective not in OBJECTIVES:
            raise ConfigError(
                f"There is no objective {self.objective!r}; there are {', '.join(OBJECTIVES)}."
            )
        for name, most in (("loss_weight", 1.0), ("walk_weight", 1.0), ("stop_reach", 20.0)):
            if not 0.0 <= getattr(self, name) <= most:
                raise ConfigError(
                    f"{name} is {getattr(self, name)!r}; it must be from 0 to {most:g}."
                )

    @property
    def counts_loss(self) -> bool:
        """Whether the accuracy after a loss counts."""
        return self.is_robust or self.objective == "after_loss"

    @property
    def weight(self) -> float:
        """Exponent of the largest sigma after a loss."""
        return {"worst": self.loss_weight, "after_loss": 1.0, "mean": 0.0}[self.objective]


class Found(NamedTuple):
    """An arrangement."""

    score: Score
    problem: Problem  # whose candidates
    chosen: Index  # are its marks: first those that stand
    n_exchanges: int

    @property
    def marks(self) -> Arrangement:
        """Its marks: those that stand with their names, others numbered."""
        own, standing = self.problem.candidates.p_site[self.chosen], self.problem.standing
        return numbered_after(standing, own[len(standing.names) :])

    def evaluations(self, slack: float = 1.0) -> list[Evaluation]:
        """Return the evaluations of marks that hide each other too: all, then without each."""
        site, stops, _, model, requirement, *_ = self.problem
        wider = replace(requirement, tolerance=slack * requirement.tolerance)
        marks, n = self.marks, len(self.chosen)
        visibility = find_visibility(site, stops.p_site, marks)
        remaining = [np.arange(n), *(np.delete(np.arange(n), i) for i in range(n) if n > 2)]
        return [
            evaluate(site, stops, marks.rows(keep), model, wider, visibility=visibility.rows(keep))
            for keep in remaining
        ]

    def after_loss(self) -> float:
        """Return the largest sigma over all stops after the loss of any one mark [m]."""
        site, stops, _, model, requirement, *_ = self.problem
        whole = evaluate(site, stops, self.marks, model, requirement)
        return worst_after_loss(site, whole, model)

    def keeps(self, goal: Goal, slack: float = 1.0) -> bool:
        """Return whether marks reach the goal for a multiple of the tolerance."""
        every = self.evaluations(slack)[: None if goal.is_robust else 1]
        return all(one.worst_probability >= goal.probability for one in every)


def numbered_after(standing: Arrangement, p_site: Array) -> Arrangement:
    """Return marks that stand and others beside them, by azimuth, with the next free numbers."""
    names = list(standing.names)
    for _ in p_site:
        names.append(next(f"P{i:02d}" for i in range(1, 1000) if f"P{i:02d}" not in names))
    return Arrangement(names=tuple(names), p_site=np.concatenate([standing.p_site, p_site]))


def search(
    problem: Problem,
    k: int,
    goal: Goal,
    rng: np.random.Generator,
    found: Callable[[float, Found], None] = lambda _share, _found: None,
    *,
    is_quick: bool = False,
) -> Found:
    """Return the best k places of several starts, on the grid and, unless quick, off it."""
    n_starts = _STARTS_MIN if is_quick else min(max(_MARKS_STARTED // k, _STARTS_MIN), _STARTS_MAX)

    def searched(problem: Problem, begin: float) -> Found:
        starts, some = _starts(problem, k, n_starts, goal, rng), []
        for i, start in enumerate(starts):
            some.append(_descended(problem, start, goal, rng))
            found(begin + 0.3 * (i + 1) / len(starts), min(some, key=lambda one: one.score))
        return _best_off_grid(some, goal, rng, is_quick=is_quick)

    best = searched(problem, 0.0)
    found(0.5, best)
    limit = problem.requirement.tolerance / WIDEST_95
    if not goal.is_robust or k < 3 or best.after_loss() <= limit:
        return best
    kept = searched(problem._replace(is_loss_first=True), 0.5)
    return kept if evaluated(kept, goal)[0] == 0.0 else best


def _starts(problem: Problem, k: int, n: int, goal: Goal, rng: np.random.Generator) -> list[Index]:
    """Return the best of each of some lots of random arrangements.

    Most are drawn evenly, the last by the shares of the relaxation.
    """
    candidates, fixed = problem.candidates, problem.fixed
    free = candidates.rows(np.arange(len(candidates.p_site) - len(fixed)))
    k_free = k - len(fixed)
    if k_free <= 0:
        if k_free:
            raise ConfigError(f"{len(fixed)} marks stand already; {k} are requested in all.")
        return [fixed]
    is_seen, n = problem.is_seen[: len(free.p_site)], min(n, _DRAWN_BY_SHARES)
    rows = problem.rows[: len(free.p_site)].reshape(len(free.p_site), -1).astype(np.float32)
    groups = groups_of(free.p_site, free.apart)
    shares = relax(Places(rows, problem.start, groups, free.p_site, 0.0), k_free).shares
    odds = np.log(np.maximum(shares, _FAINT))
    n_drawn = _DRAWN_EVENLY + _DRAWN_BY_SHARES
    noise = (rng.gumbel(size=len(odds)) for _ in range(n_drawn))
    orders = (np.argsort(-(one + odds * (i >= _DRAWN_EVENLY))) for i, one in enumerate(noise))
    drawn = [draw(free, k_free, order[is_seen[order]]) for order in orders]
    most = max(map(len, drawn))
    if most < k_free:
        raise DegenerateGeometryError(
            f"Only {most} of {k_free} marks fit where a stop can see them; allow more places, "
            "or marks nearer to each other."
        )
    every = np.array([one for one in drawn if len(one) == k_free])
    scores = ranked(problem._replace(power=POWER), fixed, every, goal)
    parts = np.array_split(np.arange(len(every)), n)
    return [np.append(fixed, every[part[np.argmin(scores[part])]]) for part in parts if len(part)]


def ranked(problem: Problem, fixed: Index, every: Index, goal: Goal) -> Array:
    """Return the objective of sets of marks, (m, k), beside those that stand, (m,)."""
    if goal.objective == "mean" and not problem.is_loss_first:
        return scores_of(problem, fixed, every)[:, 1]
    worst, weight = scores_of(problem, fixed, every)[:, 0], _weight(problem, goal)
    if not (goal.counts_loss and weight and len(fixed) + every.shape[1] > 2):
        return worst
    rest = [(fixed, np.delete(every, j, axis=1)) for j in range(every.shape[1])]
    rest += [(np.delete(fixed, j), every) for j in range(len(fixed))]
    after = np.max([scores_of(problem, *one)[:, 0] for one in rest], axis=0)
    return np.asarray(worst ** (1.0 - weight) * after**weight)


def _weight(problem: Problem, goal: Goal) -> float:
    """Return how much a loss counts for starts and for the choice of places."""
    return 1.0 if problem.is_loss_first else goal.weight


def draw(candidates: Candidates, k: int, order: Index) -> Index:
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


def _descended(problem: Problem, start: Index, goal: Goal, rng: np.random.Generator) -> Found:
    """Exchange marks on a smooth objective, then on the objective itself."""
    if goal.objective == "mean":
        return _exchanged(problem._replace(power=1.0), start, goal, rng)
    smooth = _exchanged(problem._replace(power=POWER), start, goal, rng)
    exact = _exchanged(problem, smooth.chosen, goal, rng)
    return exact._replace(n_exchanges=exact.n_exchanges + smooth.n_exchanges)


def _best_off_grid(
    found: list[Found], goal: Goal, rng: np.random.Generator, *, is_quick: bool
) -> Found:
    """Return the best of arrangements after the best few have left the grid, if they may."""
    found = sorted(found, key=lambda one: one.score)
    several = list({tuple(sorted(one.chosen)): one for one in found}.values())
    if not is_quick and found[0].problem.candidates.rules is not None:
        several += [polished(one, goal, rng) for one in several[:_POLISHED]]
    return min(several, key=lambda one: evaluated(one, goal))


def placed(problem: Problem, places: Candidates, goal: Goal) -> Found:
    """Return the arrangement of a mark at each place beside those that stand."""
    site, stops, _, model, requirement, standing, *_ = problem
    own = problem_of(site, stops, places, model, requirement, standing)
    own = own._replace(is_loss_first=problem.is_loss_first)
    chosen = np.append(own.fixed, np.arange(len(places.p_site)))
    (score,) = _objectives(own, chosen[:-1], chosen[-1:], goal)
    return Found(score, own, chosen, 0)


def polished(found: Found, goal: Goal, rng: np.random.Generator) -> Found:
    """Move marks by steps that halve, while that improves the objective."""
    problem, candidates = found.problem, found.problem.candidates
    site, stops, _, model, requirement, standing, *_ = problem
    assert candidates.rules is not None
    step, n_fixed = candidates.spacing / 2.0, len(standing.names)
    while step > _FINEST:
        p_site = found.problem.candidates.p_site[found.chosen[n_fixed:]]
        local = places_near(site, stops, candidates.rules, p_site, step)
        near = problem_of(site, stops, local, model, requirement, standing)
        near = near._replace(is_loss_first=problem.is_loss_first)
        start = np.append(near.fixed, np.arange(len(p_site)))
        moved = _descended(near, start, goal, rng)
        if _is_worth(moved.score, found.score):
            found = moved._replace(n_exchanges=found.n_exchanges + moved.n_exchanges)
        else:
            step /= 2.0
    return found


def _exchanged(problem: Problem, start: Index, goal: Goal, rng: np.random.Generator) -> Found:
    """Exchange marks one at a time while that improves the objective; those that stand stay."""
    chosen, n_exchanges, n_fixed = start.copy(), 0, len(problem.fixed)
    (score,) = _objectives(problem, chosen[:-1], chosen[-1:], goal)
    for _ in range(_ROUNDS_MAX):
        before = score
        # a loss only adds to the objective
        limit = np.inf if goal.walk_weight else score[1] * (_WORSE_MOST if score[0] else 1.0)
        for i in rng.permutation(np.arange(n_fixed, len(chosen))):
            others = np.delete(chosen, i)
            tried = _promising(problem, others, goal, limit)
            found = _objectives(problem, others, tried, goal)
            best = min(range(len(tried)), key=found.__getitem__, default=-1)
            if best >= 0 and found[best] < score:
                chosen[i], score, n_exchanges = tried[best], found[best], n_exchanges + 1
        if not _is_worth(score, before):
            break
    return Found(score, problem, chosen, n_exchanges)


def _is_worth(score: Score, before: Score) -> bool:
    """Return whether an objective is so much better that a search should go on."""
    return score[0] < before[0] or (score[0] == before[0] and score[1] < _WORTH * before[1])


def _promising(problem: Problem, others: Index, goal: Goal, limit: float) -> Index:
    """Return the candidates beside others that leave the worst stop best, the best first.

    Where a loss weighs much, the worst stop after the loss of one of the others.
    """
    p_site = problem.candidates.p_site
    near = cdist(p_site, p_site[others]) < problem.candidates.apart
    places = np.flatnonzero(~near.any(axis=1) & problem.is_seen)
    if _weight(problem, goal) < _HEAVY or len(others) < 2:
        scores = scores_of(problem, others, places[:, None], limit)
    else:
        rest, limit = [np.delete(others, j) for j in range(len(others))], np.inf
        alone = [scores_of(problem, one, np.zeros((1, 0), np.intp))[0, 0] for one in rest]
        worst = [rest[j] for j in np.argsort(alone)[::-1][:_LOSSES]]
        scores = np.max([scores_of(problem, one, places[:, None]) for one in worst], axis=0)
    order = np.lexsort((scores[:, 1], scores[:, 0]))
    order = order[scores[order, 0] < limit]
    return np.asarray(places[order[:_TRIED]])


def _objectives(problem: Problem, others: Index, tried: Index, goal: Goal) -> list[Score]:
    """Return the objective with each of some candidates beside others, the less the better.

    The excess over the tolerance after the loss of a mark if that comes first, the largest sigma
    over all stops, weighed with that after a loss, and the mean over stops [m].
    """
    worst, mean = scores_of(problem, others, tried[:, None]).T
    excess = np.zeros(len(tried))
    if goal.counts_loss and len(others) > 1 and (goal.weight or problem.is_loss_first):
        none = np.zeros((1, 0), dtype=np.intp)
        after = np.full(len(tried), scores_of(problem, others, none)[0, 0])
        for j in range(len(others)):
            rest = np.delete(others, j)
            after = np.maximum(after, scores_of(problem, rest, tried[:, None])[:, 0])
        if problem.is_loss_first:
            excess = np.maximum(after - problem.requirement.tolerance / WIDEST_95, 0.0)
        worst = worst ** (1.0 - goal.weight) * after**goal.weight
    if goal.walk_weight:
        p_site = problem.candidates.p_site
        sets = np.concatenate(
            [np.tile(p_site[others], (len(tried), 1, 1)), p_site[tried][:, None]], axis=1
        )
        worst = worst * perimeters(sets) ** goal.walk_weight
    return list(zip(excess.tolist(), worst.tolist(), mean.tolist(), strict=True))


def evaluated(found: Found, goal: Goal) -> tuple[float, float]:
    """Return the objective of an arrangement whose marks hide each other too."""
    whole, *rest = found.evaluations()
    worst = min(whole.worst_sigma_3d, LOST)
    if goal.objective == "mean":
        worst = float(np.minimum(whole.sigma_3d, LOST).mean())
    walk = float(perimeters(whole.marks.p_site[None])[0]) ** goal.walk_weight
    if not goal.counts_loss or not rest:
        return 0.0, walk * worst
    after = min(max(one.worst_sigma_3d for one in rest), LOST)
    excess = max(after - found.problem.requirement.tolerance / WIDEST_95, 0.0)
    weighed = worst ** (1.0 - goal.weight) * after**goal.weight
    return excess * found.problem.is_loss_first, walk * weighed
