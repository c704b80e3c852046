"""Where to put marks: the best places with a bound, one more mark, and what a mark is worth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist

from spheremark.pipelines.errors import ConfigError, DegenerateGeometryError
from spheremark.pipelines.model import Array, Column
from spheremark.pipelines.placement.bounds import (
    gained,
    groups_of,
    least_sigmas,
    widest_sigma,
)
from spheremark.pipelines.placement.branching import Places, branch, relax
from spheremark.pipelines.placement.candidates import CANDIDATES_MAX, Candidates, find_candidates
from spheremark.pipelines.placement.centre_model import CentreModel
from spheremark.pipelines.placement.evaluation import check_sizes, evaluate
from spheremark.pipelines.placement.plan import Arrangement, Evaluation, Requirement, Site, Stops
from spheremark.pipelines.placement.scoring import LOST, Problem, problem_of, scores_of
from spheremark.pipelines.placement.search import (
    POWER,
    Found,
    Goal,
    draw,
    evaluated,
    numbered_after,
    placed,
    polished,
    ranked,
    search,
)
from spheremark.pipelines.placement.stop_moves import moved_stops
from spheremark.pipelines.placement.walk import round_trip

_SLACK = 1.15  # times the tolerance that a quick search keeps: more is hopeless
_HOPELESS = 2.0  # the same where places between those of a grid, however wide, come after it
_FINER = 3  # times that the grid of the bound is finer, if places suffice ...
_FINE = 0.3  # [m] ... and its spacing
_SEARCH, _RELAXED, _BOUND = 0.4, 0.45, 0.95  # shares of the time after these steps
_PLACED = 40  # arrangements that are displaced by chance
_ROUNDS_OF_STOPS = 4  # in which stops and marks move in turn


class SearchState(NamedTuple):
    """How far a search has come."""

    share: float  # 0 to 1
    step: str  # what it does, for people
    n_marks: int
    worst: float  # 3-D sigma of the worst stop of the best arrangement; infinite before one [m]
    bound: float  # that no arrangement goes below; 0 before one [m]


Report = Callable[[SearchState], None]
"""Takes the state of a search."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Optimum:
    """The best places that were found."""

    evaluation: Evaluation  # its marks are the best places, those that stand first
    ground: Array  # (k,) height of the ground under each mark [m]
    # largest 3-D sigma over all stops after the loss of any one mark; infinite where a stop would
    # have no position [m]
    worst_after_loss: float
    is_kept: bool  # whether the goal is reached
    unreachable: str  # why the goal cannot be reached, where the rest of it was optimised
    # largest 3-D sigma over all stops, or their mean where that is the objective, that no
    # arrangement of as many marks on the places of the bound goes below; the same after a loss; NaN
    # for a method without one [m]
    bound: float
    bound_after_loss: float
    bound_spacing: float  # of the grid of these places; 0 if they are those given [m]
    n_bounded: int  # how many these are
    # information gained, as the sum over stops of the logarithm of its determinant, and its upper
    # bound over all arrangements of as many marks; NaN for a method that has no such sum
    log_det: float
    log_det_bound: float
    # largest 3-D sigma over all stops where marks end up beside their places, exceeded by 5 % of
    # such arrangements; NaN if all stand as planned [m]
    worst_as_placed: float
    walk: float  # round from the first stop past all marks [m]
    n_candidates: int  # places that were compared
    n_exchanges: int  # exchanges and steps that improved on the starts
    cost: float = 0.0  # of marks and of the way past them, in the unit of ``Costs``


@dataclass(frozen=True, slots=True, kw_only=True)
class Costs:
    """What a mark costs, and a metre of the way past all marks; in any unit."""

    per_mark: float = 0.0
    per_metre: float = 0.0

    def of(self, found: Optimum) -> float:
        """Return the costs of a plan."""
        return self.per_mark * len(found.ground) + self.per_metre * found.walk


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class TradeOff:
    """Optima that are each better in one respect: by number of marks, and by weight of a loss."""

    by_number: tuple[Optimum, ...]
    by_weight: tuple[Optimum, ...]  # of the number of marks of the goal
    numbers: tuple[int, ...]
    weights: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Proposal:
    """One more mark."""

    p_site: Array  # (3,) centre of its sphere [m]
    ground: float  # height of the ground under it [m]
    before: Evaluation  # the arrangement without it
    after: Evaluation  # the arrangement with it; it is the last mark


@dataclass(slots=True)
class _Course:
    """Progress of a search, reported with the best arrangement and the bound so far."""

    report: Report | None = None
    begin: float = 0.0
    end: float = 1.0
    n_marks: int = 0
    worst: float = np.inf
    bound: float = 0.0
    shown: SearchState = field(default=SearchState(0.0, "", 0, np.inf, 0.0))

    def part(self, begin: float, end: float) -> _Course:
        """Return the course of a part."""
        width = self.end - self.begin
        return _Course(self.report, self.begin + width * begin, self.begin + width * end)

    def at(self, share: float, step: str) -> None:
        """Report a step."""
        if self.report is not None:
            share = self.begin + share * (self.end - self.begin)
            self.report(SearchState(share, step, self.n_marks, self.worst, self.bound))

    def found(self, share: float, found: Found) -> None:
        """Report an arrangement."""
        worst = scores_of(found.problem, found.chosen, np.zeros((1, 0), np.intp))[0, 0]
        self.worst = min(self.worst, float(worst))
        self.at(_SEARCH * share, f"Placing {self.n_marks} marks")

    def relaxed(self, share: float, bound: float) -> None:
        """Report the bound of marks that could be divided."""
        self.bound = max(self.bound, bound)
        self.at(_SEARCH + (_RELAXED - _SEARCH) * share, f"Bounding {self.n_marks} marks")

    def bounded(self, share: float, bound: float) -> None:
        """Report the bound of branching."""
        self.bound = max(self.bound, bound)
        self.at(
            _RELAXED + (_BOUND - _RELAXED) * share, f"Raising the bound of {self.n_marks} marks"
        )


def optimise(  # noqa: PLR0913  all that a plan is made of
    site: Site,
    stops: Stops,
    candidates: Candidates,
    model: CentreModel,
    requirement: Requirement,
    goal: Goal,
    rng: np.random.Generator,
    *,
    standing: Arrangement | None = None,
    report: Report | None = None,
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
        Number of marks, or the accuracy that decides it, and what is least.
    rng : numpy.random.Generator
        Draws the starts.
    standing : Arrangement, optional
        Marks that stand already: they stay, and count among the number.
    report : callable, optional
        Takes the state of the search; may raise to end it.

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
    problem = problem_of(site, stops, candidates, model, requirement, standing)
    course = _Course(report)
    if goal.n_marks is not None:
        return _best(problem, goal.n_marks, goal, rng, course)
    try:
        return _fewest(problem, goal, rng, course)
    except DegenerateGeometryError as error:
        if not goal.is_robust:
            raise
        found = _fewest(problem, replace(goal, is_robust=False), rng, course)
        return replace(found, is_kept=False, unreachable=str(error))


def trade_off(  # noqa: PLR0913  all that a plan is made of
    site: Site,
    stops: Stops,
    candidates: Candidates,
    model: CentreModel,
    requirement: Requirement,
    goal: Goal,
    rng: np.random.Generator,
    *,
    numbers: Sequence[int],
    weights: Sequence[float] = (),
    standing: Arrangement | None = None,
    report: Report | None = None,
) -> TradeOff:
    """Return the best plans of several numbers of marks, and of several weights of a loss.

    Parameters
    ----------
    site, stops, candidates, model, requirement, goal, rng, standing, report
        See ``optimise``; the weights are tried with the goal's number of marks, or the largest of
        ``numbers`` if it has none.
    numbers : sequence of int
        Numbers of marks, 2 to ``MARKS_MOST``.
    weights : sequence of float
        Weights of a loss, 0 to 1.

    Returns
    -------
    TradeOff
        No plan of it is worse than another one in every respect, as far as the search found.

    Raises
    ------
    ConfigError
        If a number of marks or a weight is out of range.
    DegenerateGeometryError
        If so many marks do not fit where a stop sees them.
    """
    k = goal.n_marks or max(numbers, default=goal.most)
    goals = [(n, replace(goal, n_marks=n)) for n in numbers]
    goals += [(k, replace(goal, n_marks=k, objective="worst", loss_weight=w)) for w in weights]
    check_sizes(len(stops.names), max((n for n, _ in goals), default=0))
    problem = problem_of(site, stops, candidates, model, requirement, standing)
    course, cost = _Course(report), np.cumsum([0.0, *(n for n, _ in goals)])
    found = []
    for i, (n, one) in enumerate(goals):
        part = course.part(cost[i] / cost[-1], cost[i + 1] / cost[-1])
        found.append(_best(problem, n, one, rng, part))
    return TradeOff(
        by_number=tuple(found[: len(numbers)]),
        by_weight=tuple(found[len(numbers) :]),
        numbers=tuple(numbers),
        weights=tuple(weights),
    )


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
    gaps = cdist(candidates.p_site, present.p_site).min(axis=1, initial=np.inf)
    if not (gaps >= candidates.apart).any():
        raise DegenerateGeometryError(
            f"No place for one more mark is {candidates.apart:g} m from those that stand."
        )
    problem = problem_of(site, stops, candidates, model, requirement, present)
    problem, places = problem._replace(power=POWER), problem.candidates
    each = np.arange(len(places.p_site) - len(problem.fixed))[:, None]
    best = int(np.lexsort(scores_of(problem, problem.fixed, each).T[::-1])[0])
    wider = numbered_after(present, places.p_site[best][None])
    return Proposal(
        p_site=places.p_site[best].copy(),
        ground=float(places.ground[best]),
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
    objective: str = "worst",
) -> float:
    """Return the least objective of random arrangements, or of all there are.

    Parameters
    ----------
    site, stops, candidates, model, requirement
        As of ``optimise``.
    n_marks : int
        Number of marks.
    drawn : tuple of int and numpy.random.Generator, optional
        How many arrangements are drawn; by default every arrangement is evaluated.
    objective : str
        One of ``OBJECTIVES``.

    Returns
    -------
    float
        Reference for optimised arrangements, as if marks did not hide each other [m].
    """
    problem = problem_of(site, stops, candidates, model, requirement)
    p_site, apart = candidates.p_site, candidates.apart
    if drawn is not None:
        some = [
            draw(candidates, n_marks, drawn[1].permutation(len(p_site))) for _ in range(drawn[0])
        ]
    else:
        near = cdist(p_site, p_site) < apart
        every = map(np.array, combinations(range(len(near)), n_marks))
        some = [c for c in every if near[np.ix_(c, c)].sum() == n_marks]
    goal = Goal(objective=objective, is_robust=False, loss_weight=0.0)
    return float(ranked(problem, np.zeros(0, np.intp), np.array(some), goal).min())


def _best(
    problem: Problem, k: int, goal: Goal, rng: np.random.Generator, course: _Course
) -> Optimum:
    """Return the best places of a number of marks with their bound; stops move too if they may."""
    course.n_marks = k
    found = search(problem, k, goal, rng, course.found)
    if goal.stop_reach:
        found = _with_stops(found, goal, rng, course)
    return _optimum(found, problem, goal, rng, course)


def _with_stops(found: Found, goal: Goal, rng: np.random.Generator, course: _Course) -> Found:
    """Move stops and marks in turn, while that improves the objective."""
    given = found.problem.stops
    for i in range(_ROUNDS_OF_STOPS):
        course.at(_SEARCH, f"Moving the stops, round {i + 1}")
        stops = moved_stops(given, goal.stop_reach, found.problem, found.marks)
        n_fixed = len(found.problem.standing.names)
        own = found.problem.candidates.rows(found.chosen[n_fixed:])
        moved = placed(found.problem._replace(stops=stops), own, goal)
        if own.rules is not None and len(own.p_site):
            moved = polished(moved, goal, rng)
        none = np.zeros((1, 0), np.intp)
        before = scores_of(found.problem, found.chosen, none)[0, 0]
        after = scores_of(moved.problem, moved.chosen, none)[0, 0]
        if after >= before:
            break
        found = moved
        if after > 0.995 * before:
            break
    return found


def _fewest(problem: Problem, goal: Goal, rng: np.random.Generator, course: _Course) -> Optimum:
    """Return the best places of the least number of marks that keeps the tolerance."""
    least = _least(problem, goal)
    course.n_marks = goal.most
    most = search(problem, goal.most, goal, rng, is_quick=True)
    if not most.keeps(goal):
        if most.keeps(goal, _SLACK):
            most = search(problem, goal.most, goal, rng)
        if not most.keeps(goal):
            raise DegenerateGeometryError(_impossible(problem, most, goal))
    for k in range(least, goal.most):
        course.n_marks = k
        course.at(0.0, f"Trying {k} marks")
        quick = search(problem, k, goal, rng, is_quick=True)
        if quick.keeps(goal, _SLACK if problem.candidates.rules is None else _HOPELESS):
            found = _best(problem, k, goal, rng, course)
            # a smaller sigma may come with an error ellipsoid of worse shape
            if not found.is_kept and quick.keeps(goal):
                found = _optimum(quick, problem, goal, rng, course)
            if found.is_kept:
                return found
    return _best(problem, goal.most, goal, rng, course)


class _Bound(NamedTuple):
    """A bound over all arrangements, after a loss too, and the places that it holds for."""

    bound: float
    after_loss: float
    places: Candidates
    rows: Column  # information at these


def _bounded(
    found: Found, problem: Problem, goal: Goal, rng: np.random.Generator, course: _Course
) -> tuple[Found, _Bound | None]:
    """Return an arrangement, or a better one that its bound came across, and the bound, if any.

    Without any one mark, one less stands: no arrangement of these goes below their bound.
    """
    n = len(found.chosen) - len(problem.fixed)
    if problem.requirement.method == "paper" or n < 1:
        return found, None
    problem = problem._replace(stops=found.problem.stops)
    places = _finer(problem)
    rows = problem.information(places)
    given = Places(
        rows=rows.reshape(len(rows), -1),
        start=found.problem.start,
        groups=groups_of(places.p_site, places.apart),
        p_site=places.p_site,
        sigma_height=problem.requirement.resection.sigma_height,
        is_mean=goal.objective == "mean",
    )
    after = relax(given._replace(is_mean=False), n - 1).bound if n > 1 else np.nan
    around = relax(given, n, course.relaxed)
    alone = replace(goal, is_robust=False, loss_weight=0.0, walk_weight=0.0)
    alone = replace(alone, objective="mean" if given.is_mean else "worst")
    # a plan for the loss of a mark is no plan for the worst stop: its bound is that of divided ones
    reached = around.bound if goal.objective == "after_loss" else evaluated(found, alone)[1]
    branched = branch(given, n, around, reached, course.bounded)
    if len(branched.chosen):
        other = placed(found.problem, places.rows(branched.chosen), goal)
        other = polished(other, goal, rng) if places.rules is not None else other
        found = min(found, other, key=lambda one: evaluated(one, goal))
    return found, _Bound(branched.bound, after, places, rows)


def _optimum(
    found: Found, problem: Problem, goal: Goal, rng: np.random.Generator, course: _Course
) -> Optimum:
    """Assemble the result; new marks are named by azimuth about the middle of the stops."""
    found, bound = _bounded(found, problem, goal, rng, course)
    own, (site, stops, _, model, requirement, standing, *_) = (
        found.problem.candidates,
        found.problem,
    )
    fixed, free = np.split(found.chosen, [len(standing.names)])
    off = own.p_site[free, :2] - stops.p_site[:, :2].mean(axis=0)
    free = free[np.argsort(np.arctan2(off[:, 1], off[:, 0]))]
    found = found._replace(chosen=np.append(fixed, free))
    marks = found.marks
    gain = np.nan, np.nan
    if bound is not None:
        gain = gained(bound.rows, found.problem.start, found.problem.rows[free])
    after = found.after_loss()
    return Optimum(
        evaluation=evaluate(site, stops, marks, model, requirement),
        ground=own.ground[found.chosen].copy(),
        worst_after_loss=after if after < LOST else np.inf,
        is_kept=found.keeps(goal),
        unreachable="",
        bound=bound.bound if bound else np.nan,
        bound_after_loss=bound.after_loss if bound else np.nan,
        bound_spacing=bound.places.spacing if bound else 0.0,
        n_bounded=len(bound.places.p_site) if bound else 0,
        log_det=gain[0],
        log_det_bound=gain[1],
        worst_as_placed=_as_placed(found),
        walk=round_trip(stops.p_site[0], marks.p_site),
        n_candidates=len(problem.candidates.p_site) - len(standing.names),
        n_exchanges=found.n_exchanges,
    )


def _as_placed(found: Found) -> float:
    """Return the worst sigma that 5 % of arrangements that end up beside their places exceed."""
    rules = found.problem.candidates.rules
    if rules is None or not rules.placement:
        return np.nan
    site, stops, _, model, requirement, standing, *_ = found.problem
    rng, marks, worst = np.random.default_rng(0), found.marks, []
    is_free = np.arange(len(marks.names)) >= len(standing.names)
    for _ in range(_PLACED):
        turns = rng.uniform(0.0, 2.0 * np.pi, len(marks.names))
        off = rules.placement * np.sqrt(rng.random(len(turns))) * is_free
        moved = marks.p_site.copy()
        ground = site.ground_at(moved)
        moved[:, :2] += off[:, None] * np.column_stack([np.cos(turns), np.sin(turns)])
        moved[:, 2] += np.nan_to_num(site.ground_at(moved) - ground)
        beside = replace(marks, p_site=moved)
        worst.append(evaluate(site, stops, beside, model, requirement).worst_sigma_3d)
    return float(np.quantile(worst, 0.95, method="higher"))


def _finer(problem: Problem) -> Candidates:
    """Return the places of the bound: a finer grid where the candidates allow others."""
    given, site, stops = problem.candidates, problem.site, problem.stops
    free = given.rows(np.arange(len(given.p_site) - len(problem.fixed)))
    if given.rules is None:
        return free
    for times in range(max(_FINER, int(np.ceil(given.spacing / _FINE))), 0, -1):
        if times**2 * len(free.p_site) <= CANDIDATES_MAX // 2:
            finer = find_candidates(
                site, stops, replace(given.rules, spacing=given.spacing / times)
            )
            gaps = cdist(finer.p_site, problem.standing.p_site).min(axis=1, initial=np.inf)
            return finer.rows(np.flatnonzero(gaps >= finer.apart))
    return free


def _least(problem: Problem, goal: Goal) -> int:
    """Return a lower bound of the number of marks; raise if no number keeps the tolerance."""
    requirement = problem.requirement
    least = 3 if requirement.method == "paper" or goal.is_robust else 2
    least = max(least, len(problem.fixed))
    if goal.most < least:
        raise ConfigError(f"At most {goal.most} marks; {least} are needed for this goal.")
    _refuse_impossible(problem)
    sigmas = least_sigmas(problem.rows, requirement)[:, : goal.most]
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


def _goal_text(problem: Problem, goal: Goal) -> str:
    """Return the goal as a part of a sentence."""
    after = " after the loss of any one" if goal.is_robust else ""
    return (
        f"{1e3 * problem.requirement.tolerance:g} mm with {100 * goal.probability:g} % at every "
        f"stop{after}"
    )


def _sigmas_of_all(problem: Problem) -> Array:
    """Return the 3-D sigma at each stop with a mark at every candidate [m]."""
    every, none = np.arange(len(problem.candidates.p_site)), np.zeros((1, 0), dtype=np.intp)
    each = range(len(problem.stops.names))
    return np.array([scores_of(problem, every, none, stops=[e])[0, 0] for e in each])


def _refuse_impossible(problem: Problem) -> None:
    """Raise if not even all marks at once would bring the 3-D sigma below the tolerance."""
    if problem.requirement.method == "paper":
        return
    sigmas, tolerance = _sigmas_of_all(problem), problem.requirement.tolerance
    worst = int(np.argmax(sigmas))
    if sigmas[worst] > tolerance:
        best = f"{1e3 * sigmas[worst]:.2g} mm (3-D sigma)" if sigmas[worst] < LOST else "nothing"
        raise DegenerateGeometryError(
            f"No arrangement keeps {1e3 * tolerance:g} mm: even a mark at each of "
            f"{len(problem.candidates.p_site)} places at once would leave {best} at "
            f"{problem.stops.names[worst]}. Ask for a larger tolerance, or allow more places."
        )


def _impossible(problem: Problem, best: Found, goal: Goal) -> str:
    """Return the message that no number of marks keeps the tolerance, with the bound."""
    sigmas = best.evaluations()[0].sigma_3d
    worst = int(np.argmax(sigmas))
    text = (
        f"{goal.most} marks do not keep {_goal_text(problem, goal)}: the best that was found "
        f"leaves {1e3 * sigmas[worst]:.3g} mm (3-D sigma) at {problem.stops.names[worst]}."
    )
    if problem.requirement.method != "paper":
        text += (
            f" Even a mark at each of {len(problem.candidates.p_site)} places at once would leave "
            f"{1e3 * float(_sigmas_of_all(problem).max()):.2g} mm: ask for a larger tolerance."
        )
    return text
