"""Weighted least squares with the statistics of geodesy: the one place where they are solved.

Observations come in groups of equal blocks; blocks do not correlate with each other, the
coordinates within a block do. Residual = observed - computed. Unknowns may live on a manifold:
the caller says how a small change moves the state. Letters: ``J`` derivative of the residuals by
the unknowns, ``Q`` cofactor (covariance), ``P`` its inverse, ``N`` normal matrix, after Teunissen,
Testing Theory (2006).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from scipy.special import chdtrc, ndtri

from spheremark.pipelines.errors import (
    DegenerateGeometryError,
    NotConvergedError,
    TooFewObservationsError,
)
from spheremark.pipelines.model import Array, Index, Mask

State = TypeVar("State")

_STEPS = 50  # three to six suffice; more mean that the start was useless
_SETTLED = 1e-12  # square of the last step in standard deviations
_SINGULAR = 1e-11  # eigenvalue of the normal matrix with unit diagonal
_UNTESTABLE = 1e-7  # redundancy below which a bias cannot show


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Observations:
    """A group of k blocks of m observations each, at some state of the p unknowns.

    Leading dimensions, where there are any, are independent problems of the same shape.

    Attributes
    ----------
    residuals : (..., k, m)
        Observed minus computed.
    J : (..., k, m, p)
        Derivative of the residuals by a small change of the unknowns.
    cov : (..., k, m, m)
        Covariance of each block.
    """

    residuals: Array
    J: Array
    cov: Array


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Solution(Generic[State]):
    """Where the weighted sum of squares is least.

    Attributes
    ----------
    estimate : State
        The unknowns.
    cov : (..., p, p)
        Covariance of a small change of the estimate.
    groups : tuple of Observations
        The observations at the estimate.
    """

    estimate: State
    cov: Array
    groups: tuple[Observations, ...]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Adjustment(Generic[State]):
    """An estimate with the statistics of its blocks, in the order of the groups.

    Attributes
    ----------
    estimate : State
        The unknowns.
    cov : (p, p)
        Covariance of a small change of the estimate, by the a-priori sigmas.
    groups : tuple of Observations
        The observations at the estimate.
    dof : int
        Degrees of freedom: observations minus unknowns.
    vtpv : float
        Weighted sum of squares of the residuals.
    sigma0 : float
        Square root of the a-posteriori variance factor; NaN without redundancy.
    passes_global_test : bool
        Whether ``vtpv`` is no larger than the sigmas promise, at the level of the test; true
        without redundancy.
    redundancies : (b,)
        Redundancy of each block's observations together.
    w_statistics : (b,)
        Largest absolute w-statistic among each block's observations; NaN where not testable.
    detectable_biases : (b,)
        Minimal detectable bias along each block's weakest axis; infinite if none is.
    noncentrality : float
        Square root of Baarda's lambda0: how many sigmas a bias must move w to be found.
    critical_w : float
        Largest w that good data have, at the level of the test.
    """

    estimate: State
    cov: Array
    groups: tuple[Observations, ...]
    dof: int
    vtpv: float
    sigma0: float
    passes_global_test: bool
    redundancies: Array
    w_statistics: Array
    detectable_biases: Array
    noncentrality: float
    critical_w: float


def solve(
    linearise: Callable[[State], tuple[Observations, ...]],
    move: Callable[[State, Array], State],
    start: State,
) -> Solution[State]:
    """Find the unknowns for which the weighted sum of squares is least.

    Parameters
    ----------
    linearise : callable
        Gives the observations at a state.
    move : callable
        Gives the state after a small change, (..., p), of the unknowns.
    start : State
        Approximate unknowns.

    Returns
    -------
    Solution
        Estimate and covariance; of every problem, when there are leading dimensions.

    Raises
    ------
    DegenerateGeometryError
        If the observations leave an unknown undetermined.
    NotConvergedError
        If the steps do not become small against the standard deviations.

    Notes
    -----
    Gauss-Newton; covariances may depend on the state and are taken anew at each step. Cost per
    step grows linearly with the blocks and with the third power of the unknowns.
    """
    return _solve(linearise, move, start, linearise(start))


def _solve(
    linearise: Callable[[State], tuple[Observations, ...]],
    move: Callable[[State, Array], State],
    state: State,
    groups: tuple[Observations, ...],
) -> Solution[State]:
    """Return the solution from a state and the observations at it."""
    for _ in range(_STEPS):
        N, gradient = _normal_equations(groups)
        step = -(_inverse(_regular(N)) @ gradient[..., None])[..., 0]
        state = move(state, step)
        groups = linearise(state)
        if np.all(np.einsum("...p,...pq,...q->...", step, N, step) < _SETTLED):
            return Solution(
                estimate=state, cov=_inverse(_normal_equations(groups)[0]), groups=groups
            )
    raise NotConvergedError(
        f"The adjustment did not settle within {_STEPS} steps; the approximate values are too far "
        "off or the observations contradict each other."
    )


def _normal_equations(groups: tuple[Observations, ...]) -> tuple[Array, Array]:
    """Return the normal matrix and the gradient of half the weighted sum of squares."""
    summed: Array = np.zeros(())
    for group in groups:
        *problems, k, m, p = group.J.shape
        columns = np.concatenate([group.J, group.residuals[..., None]], axis=-1)
        weighted = np.linalg.solve(group.cov, columns).reshape(*problems, k * m, p + 1)
        J = group.J.reshape(*problems, k * m, p)
        summed = summed + np.swapaxes(J, -1, -2) @ weighted
    return summed[..., :-1], summed[..., -1]


def _inverse(matrix: Array) -> Array:
    """Return the inverse of the last two dimensions."""
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def _regular(N: Array) -> Array:
    """Return the normal matrix if it has an inverse."""
    scale = np.sqrt(np.einsum("...pp->...p", N))
    with np.errstate(divide="ignore", invalid="ignore"):
        scaled = N / (scale[..., None] * scale[..., None, :])
    if not np.all(np.isfinite(scaled)):
        raise DegenerateGeometryError("The observations do not touch every unknown.")
    smallest = float(np.linalg.eigvalsh(scaled).min())
    if smallest < _SINGULAR:
        raise DegenerateGeometryError(
            "The observations leave an unknown undetermined (smallest eigenvalue of the scaled "
            f"normal matrix {smallest:.1e}, at least {_SINGULAR:.0e} is needed)."
        )
    return N


def adjust(
    linearise: Callable[[State], tuple[Observations, ...]],
    move: Callable[[State, Array], State],
    start: State,
    *,
    test_level: float,
    test_power: float,
) -> Adjustment[State]:
    """Solve one problem and test it.

    Parameters
    ----------
    linearise : callable
        Gives the observations at a state.
    move : callable
        Gives the state after a small change, (p,), of the unknowns.
    start : State
        Approximate unknowns.
    test_level : float
        Probability with which the global test and each w-test reject good data.
    test_power : float
        Probability with which a bias of the minimal detectable size is found.

    Returns
    -------
    Adjustment
        Estimate, covariance and statistics.

    Raises
    ------
    TooFewObservationsError
        If there are fewer observations than unknowns.
    DegenerateGeometryError
        If the observations leave an unknown undetermined.
    NotConvergedError
        If the steps do not become small.

    Notes
    -----
    The global test is one-sided: residuals that are too small do no harm. With
    ``Q_v = Q - J Q_x J'``, a block has redundancy ``trace(Q_v P)`` and a coordinate
    ``w = (P v) / sqrt((P Q_v P))``, elementwise on vector and diagonal (Teunissen 2006, section
    4.3); the minimal detectable bias along the weakest axis is ``sqrt(lambda0 / e)``, ``e`` the
    smallest eigenvalue of the block of ``P Q_v P`` (Baarda 1968).
    """
    first = linearise(start)
    dof = _degrees_of_freedom(first)
    solution = _solve(linearise, move, start, first)
    vtpv = sum(_vtpv(group) for group in solution.groups)
    noncentrality = float(ndtri(1.0 - test_level / 2.0) + ndtri(test_power))
    statistics = [_block_statistics(group, solution.cov) for group in solution.groups]
    redundancies, w_statistics, weakest = (np.concatenate(c) for c in zip(*statistics, strict=True))
    with np.errstate(divide="ignore"):
        detectable = noncentrality / np.sqrt(weakest)
    return Adjustment(
        estimate=solution.estimate,
        cov=solution.cov,
        groups=solution.groups,
        dof=dof,
        vtpv=vtpv,
        sigma0=float(np.sqrt(vtpv / dof)) if dof else np.nan,
        passes_global_test=dof == 0 or bool(chdtrc(dof, vtpv) >= test_level),
        redundancies=redundancies,
        w_statistics=w_statistics,
        detectable_biases=detectable,
        noncentrality=noncentrality,
        critical_w=float(ndtri(1.0 - test_level / 2.0)),
    )


def _degrees_of_freedom(groups: tuple[Observations, ...]) -> int:
    """Return the number of observations minus that of the unknowns, if it is not negative."""
    n, p = sum(group.residuals.size for group in groups), int(groups[0].J.shape[-1])
    if n < p:
        raise TooFewObservationsError(f"{n} observations cannot determine {p} unknowns.")
    return n - p


def _vtpv(group: Observations) -> float:
    """Return the weighted sum of squares of a group."""
    v = group.residuals
    return float(np.einsum("km,kmn,kn->", v, _inverse(group.cov), v))


def _testability(group: Observations, cov: Array) -> tuple[Array, Array]:
    """Return each block's ``P`` and ``P Q_v P``."""
    weights = _inverse(group.cov)
    weighted = weights @ group.J
    return weights, weights - weighted @ cov @ np.swapaxes(weighted, -1, -2)


def _block_statistics(group: Observations, cov: Array) -> tuple[Array, Array, Array]:
    """Return redundancy, largest w and weakest testability (0 if untestable) of each block."""
    weights, tested = _testability(group, cov)
    redundancies = np.einsum("kmn,knm->k", tested, group.cov)
    squares = np.einsum("kmm->km", tested)
    testable = squares > _UNTESTABLE * np.einsum("kmm->km", weights)
    weighted = np.abs(np.einsum("kmn,kn->km", weights, group.residuals))
    w = np.where(testable, weighted / np.sqrt(np.where(testable, squares, 1.0)), -1.0).max(axis=1)
    weakest = np.asarray(np.linalg.eigvalsh(tested)[:, 0], dtype=np.float64)
    weakest[weakest < _UNTESTABLE * np.linalg.eigvalsh(weights)[:, 0]] = 0.0
    return redundancies, np.where(w < 0, np.nan, w), weakest


def external_reliabilities(adjustment: Adjustment[State], J_of_interest: Array) -> Array:
    """Return how far a bias that stays unseen can move something of interest.

    Parameters
    ----------
    adjustment : Adjustment
        What the observations gave.
    J_of_interest : (q, p)
        Derivative of what is of interest by a small change of the unknowns.

    Returns
    -------
    (b,)
        Length of the largest shift, over all directions of a bias of just detectable size in each
        block; infinite where a bias in some direction cannot be detected.

    Notes
    -----
    A bias ``b`` moves the unknowns by ``Q_x J' P b`` and is just detectable when
    ``b' P Q_v P b = lambda0`` (Baarda 1968).
    """
    shifts, first = [], 0
    for group in adjustment.groups:
        weights, tested = _testability(group, adjustment.cov)
        biases = adjustment.detectable_biases[first : first + len(tested)]
        first, is_open = first + len(tested), np.isinf(biases)
        effects = J_of_interest @ adjustment.cov @ np.swapaxes(group.J, -1, -2) @ weights
        tested[is_open] = np.eye(tested.shape[-1])
        moved = effects @ np.linalg.solve(tested, np.swapaxes(effects, -1, -2))
        worst = np.where(is_open, np.inf, np.linalg.eigvalsh(moved)[:, -1])
        shifts.append(adjustment.noncentrality * np.sqrt(worst))
    return np.concatenate(shifts)


def snoop(
    adjust_kept: Callable[[Mask], Adjustment[State]],
    n_blocks: int,
    may_drop: Callable[[Mask, int], bool],
    *,
    is_studentised: bool = False,
) -> tuple[Adjustment[State], Mask, tuple[tuple[int, float], ...]]:
    """Leave out the worst block, one at a time, while its w-test fails.

    Parameters
    ----------
    adjust_kept : callable
        Adjusts with the blocks of a mask, (n_blocks,), only.
    n_blocks : int
        Number of all blocks.
    may_drop : callable
        Whether, of the blocks of a mask, the given one can be spared.
    is_studentised : bool
        Whether w is divided by ``sigma0`` where that is above 1: for sigmas that are too small
        throughout, which would otherwise cost good blocks.

    Returns
    -------
    tuple
        The last adjustment, the mask of the blocks in it, and the dropped blocks with their w.

    Notes
    -----
    Baarda's data snooping, iterated: after each removal all others are tested anew, since one bad
    block makes its neighbours look bad. For the same reason each that was left out before the last
    is tried again at the end, and kept if no test fails with it. Studentised after Pope (1976).
    """
    keep = np.ones(n_blocks, dtype=np.bool_)
    dropped: list[tuple[int, float]] = []
    while True:
        adjustment = adjust_kept(keep)
        places: Index = np.flatnonzero(keep)
        w = _w_of(adjustment, is_studentised=is_studentised)
        for worst in np.argsort(-w):
            if w[worst] <= adjustment.critical_w:
                return _readmitted(
                    adjust_kept, adjustment, keep, dropped, is_studentised=is_studentised
                )
            if may_drop(keep, int(places[worst])):
                break
        else:
            return _readmitted(
                adjust_kept, adjustment, keep, dropped, is_studentised=is_studentised
            )
        dropped.append((int(places[worst]), float(w[worst])))
        keep = keep.copy()
        keep[places[worst]] = False


def _w_of(adjustment: Adjustment[State], *, is_studentised: bool) -> Array:
    """Return the w-statistics of the blocks, 0 where there is none."""
    w = np.nan_to_num(adjustment.w_statistics, nan=0.0)
    return w / max(1.0, adjustment.sigma0) if is_studentised else w


def _readmitted(
    adjust_kept: Callable[[Mask], Adjustment[State]],
    adjustment: Adjustment[State],
    keep: Mask,
    dropped: list[tuple[int, float]],
    *,
    is_studentised: bool,
) -> tuple[Adjustment[State], Mask, tuple[tuple[int, float], ...]]:
    """Take back the blocks that only bad ones dropped after them had made look bad."""
    left = list(dropped)
    for one in dropped[:-1]:  # the last was judged with all the others out
        again = keep.copy()
        again[one[0]] = True
        tried = adjust_kept(again)
        worst = float(_w_of(tried, is_studentised=is_studentised).max())
        if worst <= tried.critical_w:
            adjustment, keep = tried, again
            left.remove(one)
    return adjustment, keep, tuple(left)
