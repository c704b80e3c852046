"""Solution of a network with its tests and data snooping."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from spheremark.pipelines.errors import TooFewObservationsError
from spheremark.pipelines.estimation.statistical_tests import (
    BlockStatistics,
    Dropped,
    block_statistics,
    passes_global_test,
    snoop,
)
from spheremark.pipelines.geometry import has_heading
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
    blocks : tuple of BlockStatistics
        Tests of centres, gravity and control.
    critical_w : float
        Largest w that good data have.
    """

    network: Network
    state: State
    lin: Linearised
    cofactors: Cofactors
    used: Mask
    blocks: tuple[BlockStatistics, BlockStatistics, BlockStatistics]
    critical_w: float

    @property
    def redundancies(self) -> Array:
        """Redundancy of each block; NaN where it is not used."""
        return np.where(self.used, np.concatenate([b.redundancies for b in self.blocks]), np.nan)

    @property
    def w(self) -> Array:
        """Largest w of each block; NaN where it is not used or not testable."""
        return np.concatenate([block.w for block in self.blocks])

    @property
    def w_statistics(self) -> Array:
        """Largest w of each block that is used."""
        return self.w[self.used]

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
        """The weighted sum of squares, with shared unknowns and heights against their prior."""
        shared, heights = self.state.shared, self.state.heights
        priors = shared @ self.network.shared.prior_weights @ shared + heights @ heights
        return sum(self.squares) + float(priors)

    @property
    def sigma0(self) -> float:
        """The square root of the variance factor; NaN without redundancy."""
        return float(np.sqrt(self.vtpv / self.dof)) if self.dof else np.nan

    def passes(self, level: float) -> bool:
        """Return whether the residuals are no larger than their sigmas promise."""
        return passes_global_test(self.vtpv, self.dof, level)


def snoop_network(
    network: Network, critical: float, *, is_studentised: bool
) -> tuple[Tested, Dropped]:
    """Adjust a network and leave out the worst block, one at a time, while its w-test fails."""
    state = start(network)

    def adjusted(used: Mask) -> Tested:
        nonlocal state
        tested = _test(network, state, used, critical)
        state = tested.state  # the next solution is near
        return tested

    tested, _, dropped = snoop(
        adjusted, network.n_blocks, partial(_may_drop, network), is_studentised=is_studentised
    )
    return tested, dropped


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
        return bool(len(own) >= 2 and has_heading(own))
    return bool(len(own) >= 3 and used[n : n + s].sum() > 1)


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


def _test(network: Network, approximate: State, used: Mask, critical: float) -> Tested:
    """Solve with some blocks and test all of them."""
    _degrees_of_freedom(network, used)
    state, cofactors = solve_network(network, approximate, used)
    lin = linearise(network, state, used)
    own, between = cofactors.of_centres(network)
    J_turned = np.swapaxes(lin.J_common, 1, 2)
    cross = lin.J_centres @ between @ J_turned
    stations = cofactors.stations[network.sightings[:, 0]]
    cov_centres = lin.J_centres @ stations @ np.swapaxes(lin.J_centres, 1, 2)
    cov_centres += cross + np.swapaxes(cross, 1, 2) + lin.J_common @ own @ J_turned
    cov_gravity = lin.J_gravity @ cofactors.stations @ np.swapaxes(lin.J_gravity, 1, 2)
    cov_control = own_marks(network, cofactors)[network.controls]
    return Tested(
        network=network,
        state=state,
        lin=lin,
        cofactors=cofactors,
        used=used,
        blocks=(
            block_statistics(lin.v_centres, lin.P_centres, cov_centres),
            block_statistics(lin.v_gravity, lin.P_gravity, cov_gravity),
            block_statistics(lin.v_control, lin.P_control, cov_control),
        ),
        critical_w=critical,
    )


def own_marks(network: Network, cofactors: Cofactors) -> Array:
    """Return the covariance of each mark, (m, 3, 3)."""
    m = len(network.marks)
    marks = cofactors.common[: 3 * m, : 3 * m].reshape(m, 3, m, 3)
    return np.asarray(np.einsum("iaib->iab", marks))
