"""Network -> Tested: hides the solution, its tests, and which observations they leave out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from spheremark.pipelines.errors import TooFewObservationsError
from spheremark.pipelines.model import Array, Mask
from spheremark.pipelines.model.network import Network
from spheremark.pipelines.network.normal_equations import (
    N_DEFECT,
    Cofactors,
    Linearised,
    State,
    linearise,
    solve_network,
    start,
)

UNTESTABLE = 1e-7
"""Redundancy below which a bias cannot show."""

_UPRIGHT = 0.05  # spread across over spread along of marks on a plumb line: no heading

Dropped = list[tuple[int, float]]
"""Blocks that were left out, with the w that each had then."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Tested:
    """A solution with the statistics of all its blocks; columns run over centres, gravity, control.

    Attributes
    ----------
    network : Network
        What was observed.
    state : State
        The solution.
    lin : Linearised
        Residuals, weights and derivatives there.
    cofactors : Cofactors
        Covariances of the unknowns.
    used : (b,)
        Which blocks count.
    tested : tuple of (b, i, i)
        ``P Q_v P`` of centres, gravity and control.
    redundancies : (b,)
        NaN where a block is not used.
    w : (b,)
        Largest of each block; NaN where none can be had.
    weakest : (b,)
        Smallest eigenvalue of ``tested``; 0 where a bias cannot show.
    """

    network: Network
    state: State
    lin: Linearised
    cofactors: Cofactors
    used: Mask
    tested: tuple[Array, Array, Array]
    redundancies: Array
    w: Array
    weakest: Array

    @property
    def dof(self) -> int:
        """Degrees of freedom."""
        return _degrees_of_freedom(self.network, self.used)

    @property
    def squares(self) -> tuple[float, float, float]:
        """The weighted sums of squares of centres, gravity and control."""
        pairs = (
            (self.lin.v_centres, self.lin.P_centres),
            (self.lin.v_gravity, self.lin.P_gravity),
            (self.lin.v_control, self.lin.P_control),
        )
        first, second, third = (float(np.einsum("ni,nij,nj->", v, P, v)) for v, P in pairs)
        return first, second, third

    @property
    def vtpv(self) -> float:
        """The weighted sum of squares, with what all share against what was known of it."""
        shared = self.state.shared
        return sum(self.squares) + float(shared @ self.network.shared.weights @ shared)

    @property
    def sigma0(self) -> float:
        """The square root of the variance factor; NaN without redundancy."""
        return float(np.sqrt(self.vtpv / self.dof)) if self.dof else np.nan

    @property
    def own_marks(self) -> Array:
        """The covariance of each mark, (m, 3, 3)."""
        return _own_marks(self.cofactors)

    @property
    def common(self) -> tuple[Array, Array]:
        """Per centre, the covariance of its mark and what all share, and to its station.

        Shapes are (n, 3 + k, 3 + k) and (n, 6, 3 + k).
        """
        return _common(self.cofactors, self.network)

    def passes(self, level: float) -> bool:
        """Return whether the residuals are no larger than their sigmas promise."""
        return self.dof == 0 or bool(chdtrc(self.dof, self.vtpv) >= level)


def snoop(network: Network, critical: float, *, is_studentised: bool) -> tuple[Tested, Dropped]:
    """Leave out the worst block, one at a time, while its w-test fails.

    Notes
    -----
    A block that was left out before the last is tried again at the end, and kept if no test fails
    with it: gross errors make good neighbours look bad.
    """
    used = np.ones(network.n_blocks, dtype=np.bool_)
    state = start(network)
    dropped: Dropped = []
    while True:
        tested = _test(network, state, used)
        w = _w_of(tested, is_studentised=is_studentised)
        worst = _worst(network, w, used, critical)
        if worst is None:
            return _readmitted(tested, dropped, critical, is_studentised=is_studentised)
        dropped.append((worst, float(w[worst])))
        state, used = tested.state, used.copy()
        used[worst] = False


def _w_of(tested: Tested, *, is_studentised: bool) -> Array:
    """Return the w-statistics of the blocks, 0 where there is none."""
    w = np.nan_to_num(tested.w, nan=0.0)
    return w / max(1.0, tested.sigma0) if is_studentised else w


def _readmitted(
    tested: Tested, dropped: Dropped, critical: float, *, is_studentised: bool
) -> tuple[Tested, Dropped]:
    """Take back the blocks that only bad ones dropped after them had made look bad."""
    left = list(dropped)
    for one in dropped[:-1]:  # the last was judged with all the others out
        used = tested.used.copy()
        used[one[0]] = True
        tried = _test(tested.network, tested.state, used)
        if _w_of(tried, is_studentised=is_studentised).max() <= critical:
            tested = tried
            left.remove(one)
    return tested, left


def _worst(network: Network, w: Array, used: Mask, critical: float) -> int | None:
    """Return the block with the largest w above the limit that can be spared."""
    for block in np.argsort(-w):
        if w[block] <= critical:
            return None
        if _may_drop(network, used, int(block)):
            return int(block)
    return None


def _may_drop(network: Network, used: Mask, block: int) -> bool:
    """Return whether a block can be spared without leaving an unknown open."""
    n, s = len(network.sightings), len(network.stations)
    if block >= n + s:
        return int(used[n + s :].sum()) > 2
    rest = used[:n].copy()
    station = block - n
    if block < n:
        rest[block] = False
        station, mark = network.sightings[block]
        if not np.any(network.sightings[rest, 1] == mark):
            return False
    own = network.p_base[rest & (network.sightings[:, 0] == station)]
    own = own @ network.R_station_base[station].T
    if block < n:
        return bool(len(own) >= 2 and _has_heading(own))
    return bool(len(own) >= 3 and used[n : n + s].sum() > 1)


def _has_heading(p: Array) -> bool:
    """Return whether points are far enough from one plumb line to tell a heading."""
    off = p - p.mean(axis=0)
    return bool(np.linalg.norm(off[:, :2]) > _UPRIGHT * np.linalg.norm(off))


def _degrees_of_freedom(network: Network, used: Mask) -> int:
    """Return observations minus unknowns plus the defect of the datum."""
    n, s = len(network.sightings), len(network.stations)
    observed = (
        3 * int(used[:n].sum()) + 2 * int(used[n : n + s].sum()) + 3 * int(used[n + s :].sum())
    )
    unknown = 6 * s + 3 * len(network.marks) - (N_DEFECT if network.is_free else 0)
    if observed < unknown:
        raise TooFewObservationsError(
            f"{observed} observations cannot determine the {unknown} unknowns of {s} stations and "
            f"{len(network.marks)} marks."
        )
    return observed - unknown


def _test(network: Network, approximate: State, used: Mask) -> Tested:
    """Solve with some blocks and test all of them."""
    _degrees_of_freedom(network, used)
    state, cofactors = solve_network(network, approximate, used)
    lin = linearise(network, state, used)
    station = network.sightings[:, 0]
    own = _own_marks(cofactors)
    own_common, between = _common(cofactors, network)
    J_turned = np.swapaxes(lin.J_common, 1, 2)
    cross = lin.J_centres @ between @ J_turned
    turned = lin.J_centres @ cofactors.stations[station] @ np.swapaxes(lin.J_centres, 1, 2)
    q_centres = turned + cross + np.swapaxes(cross, 1, 2) + lin.J_common @ own_common @ J_turned
    q_gravity = lin.J_gravity @ cofactors.stations @ np.swapaxes(lin.J_gravity, 1, 2)
    blocks = (
        (lin.v_centres, lin.P_centres, q_centres),
        (lin.v_gravity, lin.P_gravity, q_gravity),
        (lin.v_control, lin.P_control, own[network.controls]),
    )
    tested = tuple(P - P @ Q @ P for _, P, Q in blocks)
    columns = [_statistics(*block, kept) for block, kept in zip(blocks, tested, strict=True)]
    redundancies, w, weakest = (np.concatenate(c) for c in zip(*columns, strict=True))
    return Tested(
        network=network,
        state=state,
        lin=lin,
        cofactors=cofactors,
        used=used,
        tested=(tested[0], tested[1], tested[2]),
        redundancies=np.where(used, redundancies, np.nan),
        w=w,
        weakest=weakest,
    )


def _own_marks(cofactors: Cofactors) -> Array:
    """Return the covariance of each mark, (m, 3, 3)."""
    m = len(cofactors.marks) // 3
    return np.asarray(np.einsum("iaib->iab", cofactors.marks.reshape(m, 3, m, 3)))


def _common(cofactors: Cofactors, network: Network) -> tuple[Array, Array]:
    """Return, per centre, the covariance of its mark and what all share, and to its station.

    Shapes are (n, 3 + k, 3 + k) and (n, 6, 3 + k).
    """
    station, mark = network.sightings.T
    mixed = cofactors.shared_and_marks[mark]
    shared = np.broadcast_to(cofactors.shared, (len(mark), *cofactors.shared.shape))
    upper = np.concatenate([_own_marks(cofactors)[mark], mixed], axis=2)
    lower = np.concatenate([np.swapaxes(mixed, 1, 2), shared], axis=2)
    between = [cofactors.between[station, :, mark], cofactors.with_shared[station]]
    return np.concatenate([upper, lower], axis=1), np.concatenate(between, axis=2)


def _statistics(
    residuals: Array, weights: Array, cofactors: Array, tested: Array
) -> tuple[Array, Array, Array]:
    """Return redundancy, largest w (NaN) and weakest testability (0 if untestable) of blocks."""
    if not len(residuals):
        return np.zeros(0), np.zeros(0), np.zeros(0)
    redundancies = residuals.shape[1] - np.einsum("bij,bji->b", weights, cofactors)
    squares = np.einsum("bii->bi", tested)
    testable = squares > UNTESTABLE * np.einsum("bii->bi", weights)
    pressed = np.abs(np.einsum("bij,bj->bi", weights, residuals))
    w = np.where(testable, pressed / np.sqrt(np.where(testable, squares, 1.0)), -1.0).max(axis=1)
    weakest = np.asarray(np.linalg.eigvalsh(tested)[:, 0], dtype=np.float64)
    is_open = weakest <= UNTESTABLE * np.linalg.eigvalsh(weights)[:, 0]
    return (
        np.asarray(redundancies),
        np.where(w < 0, np.nan, w),
        np.where(is_open, 0.0, weakest),
    )
