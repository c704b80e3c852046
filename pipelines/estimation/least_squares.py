"""Weighted least squares of dense problems, one or many at once.

Observations come in groups of equal blocks; blocks do not correlate with each other, the
coordinates within a block do. Residual = observed - computed. Unknowns may live on a manifold:
the caller says how a small change moves the state. Letters: ``J`` derivative of the residuals by
the unknowns, ``Q`` cofactor (covariance), ``P`` its inverse, ``N`` normal matrix.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from spheremark.pipelines.errors import (
    DegenerateGeometryError,
    NotConvergedError,
    TooFewObservationsError,
)
from spheremark.pipelines.estimation.linear_algebra import SINGULAR, invert_each
from spheremark.pipelines.estimation.statistical_tests import (
    BlockStatistics,
    block_statistics,
    critical_w,
    noncentrality,
    passes_global_test,
)
from spheremark.pipelines.model import Array, Index, Mask

_STEPS = 50  # three to six suffice; more mean that the start was useless
_SETTLED = 1e-12  # square of the last step in standard deviations


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Observations:
    """A group of k blocks of m observations each, at some state of the p unknowns.

    Leading dimensions, where there are any, are independent problems of the same shape.
    """

    residuals: Array  # (..., k, m) observed minus computed
    J: Array  # (..., k, m, p) derivative of the residuals by a small change of the unknowns
    cov: Array  # (..., k, m, m) covariance of each block


Groups = tuple[Observations, ...]
Move = Callable[[Array, Array], Array]
"""Gives states after small changes, (..., p), of the unknowns."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Solution:
    """Where the weighted sum of squares is least."""

    estimate: Array  # the unknowns
    cov: Array  # (p, p) covariance of a small change of the estimate
    groups: Groups  # the observations at the estimate

    @property
    def vtpv(self) -> float:
        """Weighted sum of squares of the residuals."""
        return sum(
            float(np.einsum("km,kmn,kn->", g.residuals, invert_each(g.cov)[0], g.residuals))
            for g in self.groups
        )


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Solutions:
    """Solutions of independent problems."""

    estimates: Array  # (s, ...) the unknowns of each problem
    covs: Array  # (s, p, p) covariances of small changes; NaN where the unknowns are undetermined
    is_settled: Mask  # (s,) whether the steps became small


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Adjustment:
    """An estimate with the statistics of its blocks, in the order of the groups."""

    estimate: Array  # the unknowns
    cov: Array  # (p, p) covariance of a small change of the estimate, by the a-priori sigmas
    groups: Groups  # the observations at the estimate
    statistics: tuple[BlockStatistics, ...]  # tests of the blocks of each group
    dof: int  # degrees of freedom: observations minus unknowns
    vtpv: float  # weighted sum of squares of the residuals
    sigma0: float  # square root of the a-posteriori variance factor; NaN without redundancy
    # whether ``vtpv`` is no larger than the sigmas promise, at the level of the test
    passes_global_test: bool
    redundancies: Array  # (b,) redundancy of each block's observations together
    # (b,) largest absolute w-statistic among each block's observations; NaN where not testable
    w_statistics: Array
    # (b,) minimal detectable bias along each block's weakest axis; infinite if none is
    detectable_biases: Array
    # square root of Baarda's lambda0: how many sigmas a bias must move w to be found
    noncentrality: float
    critical_w: float  # largest w that good data have, at the level of the test

    def external_reliabilities(self, J_of_interest: Array) -> Array:
        """Return how far a bias that stays unseen can move something of interest.

        Parameters
        ----------
        J_of_interest : (q, p)
            Derivative of what is of interest by a small change of the unknowns.

        Returns
        -------
        (b,)
            Length of the largest shift by a bias of just detectable size in each block; infinite
            where a bias in some direction cannot be detected.

        Notes
        -----
        A bias ``b`` moves the unknowns by ``Q_x J' P b`` (Baarda 1968).
        """
        gain, shifts = J_of_interest @ self.cov, []
        for group, statistics in zip(self.groups, self.statistics, strict=True):
            effects = gain @ np.swapaxes(group.J, -1, -2) @ invert_each(group.cov)[0]
            shifts.append(statistics.external_reliabilities(effects, self.noncentrality))
        return np.concatenate(shifts)


def normal_equations(groups: Groups) -> tuple[Array, Array]:
    """Sum the normal equations of groups of observations.

    Parameters
    ----------
    groups : tuple of Observations
        Groups of the same problem, or of the same problems.

    Returns
    -------
    tuple
        Normal matrices, (..., p, p), and right-hand sides, (..., p), of the step that makes the
        weighted sum of squares least.
    """
    summed: Array = np.zeros(())
    for group in groups:
        *problems, k, m, p = group.J.shape
        columns = np.concatenate([group.J, group.residuals[..., None]], axis=-1)
        weighted = (invert_each(group.cov)[0] @ columns).reshape(*problems, k * m, p + 1)
        J = group.J.reshape(*problems, k * m, p)
        summed = summed + np.swapaxes(J, -1, -2) @ weighted
    return summed[..., :-1], -summed[..., -1]


def solve_each(linearise: Callable[[Array, Index], Groups], move: Move, start: Array) -> Solutions:
    """Solve independent problems of the same shape.

    Parameters
    ----------
    linearise : callable
        Gives the observations of some of the problems: at their states, and with their places.
    move : callable
        Gives states after small changes.
    start : (s, ...)
        Approximate unknowns of each problem.

    Returns
    -------
    Solutions
        What each problem gives; one that is singular or does not settle spoils no other.

    Notes
    -----
    Gauss-Newton; covariances may depend on the state and are taken anew at each step. A problem
    that has settled is not touched any more. Cost per step grows linearly with the blocks and with
    the third power of the unknowns.
    """
    states, rows = np.array(start), np.arange(len(start))
    covs, is_settled = np.zeros((0, 0, 0)), np.zeros(len(start), dtype=np.bool_)
    for step in range(_STEPS):
        N, rhs = normal_equations(linearise(states[rows], rows))
        cov, is_regular = invert_each(N)
        steps = np.where(is_regular[:, None], np.einsum("spq,sq->sp", cov, rhs), 0.0)
        states[rows] = move(states[rows], steps)
        if step == 0:
            covs = cov
        else:
            covs[rows] = cov
        squares = np.einsum("sp,sp->s", steps, rhs)
        is_settled[rows] = is_regular & (squares < _SETTLED)
        rows = rows[is_regular & (squares >= _SETTLED)]  # NaN is neither
        if not len(rows):
            break
    return Solutions(estimates=states, covs=covs, is_settled=is_settled)


def solve_by_chords(
    covs: Array, rhs: Callable[[Array], Array], move: Move, start: Array
) -> tuple[Array, Mask]:
    """Solve independent problems whose normal matrices hardly change on the way.

    Parameters
    ----------
    covs : (s, p, p)
        Inverses of the normal matrices at the start.
    rhs : callable
        Gives the right-hand sides, (s, p), at states.
    move : callable
        Gives states after small changes.
    start : (s, ...)
        Approximate unknowns of each problem.

    Returns
    -------
    tuple
        The unknowns of each problem, and whether its steps became small.
    """
    states, is_settled = start, np.zeros(len(start), dtype=np.bool_)
    for _ in range(_STEPS):
        right = rhs(states)
        steps = (covs @ right[..., None])[..., 0]
        states, is_settled = move(states, steps), np.einsum("sp,sp->s", steps, right) < _SETTLED
        if is_settled.all():
            break
    return states, is_settled


def solve(linearise: Callable[[Array], Groups], move: Move, start: Array) -> Solution:
    """Find the unknowns for which the weighted sum of squares is least.

    Parameters
    ----------
    linearise : callable
        Gives the observations at a state.
    move : callable
        Gives the state after a small change, (p,), of the unknowns.
    start : array
        Approximate unknowns.

    Returns
    -------
    Solution
        Estimate and covariance.

    Raises
    ------
    DegenerateGeometryError
        If the observations leave an unknown undetermined.
    NotConvergedError
        If the steps do not become small against the standard deviations.

    Notes
    -----
    As ``solve_each``.
    """

    def alone(states: Array, _rows: Index) -> Groups:
        return tuple(
            Observations(residuals=g.residuals[None], J=g.J[None], cov=g.cov[None])
            for g in linearise(states[0])
        )

    found = solve_each(alone, lambda states, steps: move(states[0], steps[0])[None], start[None])
    groups = linearise(found.estimates[0])
    N, _ = normal_equations(groups)
    cov, is_regular = invert_each(N)
    if not (found.is_settled[0] and is_regular):
        raise _why_unsettled(N, is_regular=bool(is_regular))
    return Solution(estimate=found.estimates[0], cov=cov, groups=groups)


def _why_unsettled(N: Array, *, is_regular: bool) -> DegenerateGeometryError | NotConvergedError:
    """Return why there is no solution, from the last normal matrix."""
    if is_regular:
        return NotConvergedError(
            f"The adjustment did not settle within {_STEPS} steps; the approximate values are too "
            "far off or the observations contradict each other."
        )
    scale = np.sqrt(np.diag(N))
    if not np.all(scale > 0.0):
        return DegenerateGeometryError("The observations do not touch every unknown.")
    smallest = float(np.linalg.eigvalsh(N / np.outer(scale, scale))[0])
    return DegenerateGeometryError(
        "The observations leave an unknown undetermined (smallest eigenvalue of the scaled normal "
        f"matrix {smallest:.1e}, at least {SINGULAR:.0e} is needed)."
    )


def adjust(
    linearise: Callable[[Array], Groups],
    move: Move,
    start: Array,
    *,
    test_level: float,
    test_power: float,
) -> Adjustment:
    """Solve one problem and test it.

    Parameters
    ----------
    linearise : callable
        Gives the observations at a state.
    move : callable
        Gives the state after a small change, (p,), of the unknowns.
    start : array
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
    """
    dof = _degrees_of_freedom(linearise(start))
    solution = solve(linearise, move, start)
    vtpv, shift = solution.vtpv, noncentrality(test_level, test_power)
    statistics = tuple(
        block_statistics(
            g.residuals,
            invert_each(g.cov)[0],
            g.J @ solution.cov @ np.swapaxes(g.J, -1, -2),
        )
        for g in solution.groups
    )
    return Adjustment(
        estimate=solution.estimate,
        cov=solution.cov,
        groups=solution.groups,
        statistics=statistics,
        dof=dof,
        vtpv=vtpv,
        sigma0=float(np.sqrt(vtpv / dof)) if dof else np.nan,
        passes_global_test=passes_global_test(vtpv, dof, test_level),
        redundancies=np.concatenate([s.redundancies for s in statistics]),
        w_statistics=np.concatenate([s.w for s in statistics]),
        detectable_biases=np.concatenate([s.detectable_biases(shift) for s in statistics]),
        noncentrality=shift,
        critical_w=critical_w(test_level),
    )


def _degrees_of_freedom(groups: Groups) -> int:
    """Return the number of observations minus that of the unknowns, if it is not negative."""
    n, p = sum(group.residuals.size for group in groups), int(groups[0].J.shape[-1])
    if n < p:
        raise TooFewObservationsError(f"{n} observations cannot determine {p} unknowns.")
    return n - p
