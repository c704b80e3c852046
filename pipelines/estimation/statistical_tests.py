"""Tests of adjusted observations: data snooping, reliability, global test.

Observations come in blocks whose coordinates correlate. Letters after Teunissen, Testing Theory
(2006): ``P`` weight, ``Q_v`` covariance of the residuals, ``w`` test statistic; ``P Q_v P`` is the
testability of a block.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
from scipy.special import chdtrc, ndtri

from spheremark.pipelines.model import Array, Mask

UNTESTABLE = 1e-7
"""Redundancy below which a bias cannot show."""


class BlockStatistics(NamedTuple):
    """Statistics of blocks of m observations each."""

    redundancies: Array  # (...) redundancy of each block's observations together
    # (...) largest absolute w-statistic among each block's observations; NaN where not testable
    w: Array
    testability: Array  # (..., m, m) ``P Q_v P``
    weakest: Array  # (...) its smallest eigenvalue; 0 where a bias in some direction cannot show

    def detectable_biases(self, noncentrality: float) -> Array:
        """Return the minimal detectable bias along each block's weakest axis, or infinity."""
        with np.errstate(divide="ignore"):
            return np.asarray(noncentrality / np.sqrt(self.weakest))

    def external_reliabilities(self, effects: Array, noncentrality: float) -> Array:
        """Return how far a bias of just detectable size can move something of interest.

        Parameters
        ----------
        effects : (..., q, m)
            Derivative of what is of interest by a bias of each observation.
        noncentrality : float
            Square root of Baarda's lambda0.

        Returns
        -------
        (...)
            Length of the largest shift over all directions of the bias; infinite where a bias in
            some direction cannot be detected.

        Notes
        -----
        A bias ``b`` is just detectable when ``b' P Q_v P b = lambda0`` (Baarda 1968).
        """
        is_open = self.weakest == 0.0
        solid = np.where(is_open[..., None, None], np.eye(effects.shape[-1]), self.testability)
        moved = effects @ np.linalg.solve(solid, np.swapaxes(effects, -1, -2))
        worst = np.maximum(np.linalg.eigvalsh(moved)[..., -1], 0.0)
        return np.where(is_open, np.inf, noncentrality * np.sqrt(worst))


def block_statistics(residuals: Array, weights: Array, cov_adjusted: Array) -> BlockStatistics:
    """Test blocks of observations.

    Parameters
    ----------
    residuals : (..., m)
        Observed minus computed.
    weights : (..., m, m)
        Inverse covariance of each block; zero where a block is not used.
    cov_adjusted : (..., m, m)
        Covariance of the adjusted observations, ``J Q_x J'``.

    Returns
    -------
    BlockStatistics
        Redundancy, w-statistic and testability.

    Notes
    -----
    With ``Q_v = Q - J Q_x J'`` a block has redundancy ``trace(Q_v P)`` and a coordinate
    ``w = (P v) / sqrt((P Q_v P))``, elementwise on vector and diagonal (Teunissen 2006, section
    4.3); a bias along the weakest axis is detectable from ``sqrt(lambda0 / e)`` on, ``e`` the
    smallest eigenvalue of ``P Q_v P`` (Baarda 1968).
    """
    tested = weights - weights @ cov_adjusted @ weights
    redundancies = residuals.shape[-1] - np.einsum("...ij,...ji->...", weights, cov_adjusted)
    squares = np.einsum("...ii->...i", tested)
    testable = squares > UNTESTABLE * np.einsum("...ii->...i", weights)
    weighted = np.abs(np.einsum("...ij,...j->...i", weights, residuals))
    w = np.where(testable, weighted / np.sqrt(np.where(testable, squares, 1.0)), -1.0)
    largest = w.max(axis=-1, initial=-1.0)
    weakest = np.linalg.eigvalsh(tested)[..., 0]
    is_open = weakest <= UNTESTABLE * np.linalg.eigvalsh(weights)[..., 0]
    return BlockStatistics(
        redundancies=np.asarray(redundancies),
        w=np.where(largest < 0.0, np.nan, largest),
        testability=tested,
        weakest=np.where(is_open, 0.0, weakest),
    )


def critical_w(level: float) -> float:
    """Return the w-statistic that good data exceed with a probability.

    Parameters
    ----------
    level : float
        Probability that a good observation is rejected.

    Returns
    -------
    float
        Two-sided quantile of the normal distribution.
    """
    return float(ndtri(1.0 - level / 2.0))


def noncentrality(level: float, power: float) -> float:
    """Return how many sigmas a bias must move w to be found (square root of Baarda's lambda0).

    Parameters
    ----------
    level : float
        Probability that a good observation is rejected.
    power : float
        Probability that the bias is found.

    Returns
    -------
    float
        The shift of w.
    """
    return critical_w(level) + float(ndtri(power))


def passes_global_test(vtpv: float, dof: int, level: float) -> bool:
    """Return whether a weighted sum of squares is no larger than the sigmas promise.

    Parameters
    ----------
    vtpv : float
        Weighted sum of squares of the residuals.
    dof : int
        Degrees of freedom.
    level : float
        Probability that good data are rejected.

    Returns
    -------
    bool
        True without redundancy too. One-sided: residuals that are too small do no harm.
    """
    return dof == 0 or bool(chdtrc(dof, vtpv) >= level)


class Tested(Protocol):
    """What data snooping must know of an adjustment."""

    @property
    def w_statistics(self) -> Array:
        """Largest w of each block that was used; NaN where not testable."""

    @property
    def sigma0(self) -> float:
        """Square root of the variance factor; NaN without redundancy."""

    @property
    def critical_w(self) -> float:
        """Largest w that good data have."""


_Adjusted = TypeVar("_Adjusted", bound=Tested)

Dropped = tuple[tuple[int, float], ...]
"""Blocks that were left out, with the w that each had then."""


def snoop(
    adjust_used: Callable[[Mask], _Adjusted],
    n_blocks: int,
    may_drop: Callable[[Mask, int], bool],
    *,
    is_studentised: bool = False,
) -> tuple[_Adjusted, Mask, Dropped]:
    """Leave out the worst block, one at a time, while its w-test fails.

    Parameters
    ----------
    adjust_used : callable
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

    def w_of(adjusted: _Adjusted) -> Array:
        w = np.nan_to_num(adjusted.w_statistics, nan=0.0)
        return w / max(1.0, adjusted.sigma0) if is_studentised else w

    used = np.ones(n_blocks, dtype=np.bool_)
    adjusted, dropped = adjust_used(used), list[tuple[int, float]]()
    while (worst := _worst(w_of(adjusted), used, adjusted.critical_w, may_drop)) is not None:
        dropped.append(worst)
        used = used.copy()
        used[worst[0]] = False
        adjusted = adjust_used(used)
    for one in dropped[:-1]:  # the last was judged with all the others out
        again = used.copy()
        again[one[0]] = True
        tried = adjust_used(again)
        if w_of(tried).max() <= tried.critical_w:
            adjusted, used = tried, again
            dropped.remove(one)
    return adjusted, used, tuple(dropped)


def _worst(
    w: Array, used: Mask, critical: float, may_drop: Callable[[Mask, int], bool]
) -> tuple[int, float] | None:
    """Return the block with the largest w above the limit that can be spared, and that w."""
    blocks = np.flatnonzero(used)
    for k in np.argsort(-w):
        if w[k] <= critical:
            return None
        if may_drop(used, int(blocks[k])):
            return int(blocks[k]), float(w[k])
    return None
