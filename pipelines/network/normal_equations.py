"""Normal equations of a network.

A station meets others only through marks, so the stations are eliminated and what remains is a
dense system of the marks and of what all stations share. All coordinates are relative to the middle
of the approximate marks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spheremark.pipelines.errors import DegenerateGeometryError, NotConvergedError
from spheremark.pipelines.estimation.linear_algebra import Reduced, eliminate, invert_each
from spheremark.pipelines.geometry import by_motion, skew
from spheremark.pipelines.model import Array, Mask
from spheremark.pipelines.model.network import Network, Parts
from spheremark.pipelines.positioning.matching import moved

_MOTION = 6  # unknowns of a station's motion; one of its error of height follows
N_DEFECT = 4  # of a free network whose stations are levelled: place and heading

_STEPS = 50  # three to six suffice
_SETTLED = 1e-12  # square of the last step in standard deviations
_SINGULAR = 1e-11  # eigenvalue of the reduced normal matrix with unit diagonal


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class State:
    """Poses of the stations, (s, 4, 4), and marks, (m, 3), relative to the middle [m].

    ``heights``, (s,), are errors of height of the stations' centres in standard deviations;
    ``shared``, (k,), the unknowns that all stations have in common.
    """

    T_site_base: Array
    heights: Array
    p_site: Array
    shared: Array


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Linearised:
    """Residuals, weights and derivatives at a state.

    Attributes
    ----------
    v_centres : (n, 3)
        ``T p_base - p_site`` [m].
    P_centres : (n, 3, 3)
        Weights; zero where a block is not used.
    J_centres : (n, 3, 7)
        By the motion of the station and its error of height.
    J_common : (n, 3, 3 + k)
        By the mark, minus the identity, and by what all stations share.
    v_gravity : (s, 2)
        Horizontal part of the measured up direction [rad].
    P_gravity : (s, 2, 2)
        Weights.
    J_gravity : (s, 2, 7)
        By the same.
    v_control : (c, 3)
        Given minus adjusted coordinates [m]; by the mark minus the identity.
    P_control : (c, 3, 3)
        Weights.
    """

    v_centres: Array
    P_centres: Array
    J_centres: Array
    J_common: Array
    v_gravity: Array
    P_gravity: Array
    J_gravity: Array
    v_control: Array
    P_control: Array


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Cofactors:
    """Covariances of a solution; q common unknowns: 3 m of the marks, then what all share.

    Attributes
    ----------
    stations : (s, 7, 7)
        Of small motions of the stations, and of their errors of height.
    between : (s, 7, q)
        Between stations and common unknowns.
    common : (q, q)
        Of the common unknowns.
    parts : Parts
        What these were made of.
    """

    stations: Array
    between: Array
    common: Array
    parts: Parts

    def of_centres(self, network: Network) -> tuple[Array, Array]:
        """Return, per centre, the covariance of its mark and what all share, and to its station.

        Shapes are (n, 3 + k, 3 + k) and (n, 7, 3 + k).
        """
        station, mark = network.sightings.T
        m, q = len(network.marks), len(self.common)
        shared = np.broadcast_to(np.arange(3 * m, q), (len(mark), q - 3 * m))
        columns = np.concatenate([3 * mark[:, None] + np.arange(3), shared], axis=1)
        between = self.between[station[:, None], :, columns]
        own = self.common[columns[:, :, None], columns[:, None, :]]
        return own, np.swapaxes(between, 1, 2)


def middle_of(network: Network) -> Array:
    """Return the middle of the approximate marks."""
    return np.asarray(network.p_site.mean(axis=0))


def start(network: Network) -> State:
    """Return the approximate values."""
    middle = middle_of(network)
    T = np.array(network.T_site_base)
    T[:, :3, 3] -= middle
    nothing = np.zeros(len(network.shared.names))
    return State(
        T_site_base=T, heights=np.zeros(len(T)), p_site=network.p_site - middle, shared=nothing
    )


def step_to(state: State, xi: Array, dp: Array, d_shared: Array) -> State:
    """Move a state; ``xi``, (s, 7), are motions of the stations and steps of their heights."""
    return State(
        T_site_base=moved(state.T_site_base, xi[:, :_MOTION]),
        heights=state.heights + xi[:, _MOTION],
        p_site=state.p_site + dp,
        shared=state.shared + d_shared,
    )


def linearise(network: Network, state: State, used: Mask) -> Linearised:
    """Return residuals, weights and derivatives."""
    n, s = len(network.sightings), len(network.stations)
    station, mark = network.sightings.T
    R, t = state.T_site_base[:, :3, :3], state.T_site_base[:, :3, 3]
    R_each = R[station]
    derivatives = R_each @ network.shared.derivatives
    lifts = np.einsum("nij,nj->ni", R_each, network.heights_base)
    p = np.einsum("nij,nj->ni", R_each, network.p_base) + t[station] - derivatives @ state.shared
    p -= state.heights[station, None] * lifts
    J_mark = np.broadcast_to(-np.eye(3), (n, 3, 3))
    weights = R_each @ invert_each(network.cov_p_base)[0] @ np.swapaxes(R_each, 1, 2)
    up = np.einsum("sij,sj->si", R, network.R_station_base[:, 2])
    cov_up = (R @ network.cov_up_base @ np.swapaxes(R, 1, 2))[:, :2, :2]
    control = network.p_control_site - middle_of(network)
    return Linearised(
        v_centres=p - state.p_site[mark],
        P_centres=weights * used[:n, None, None],
        J_centres=np.concatenate([by_motion(p), -lifts[..., None]], axis=2),
        J_common=np.concatenate([J_mark, -derivatives], axis=2),
        v_gravity=up[:, :2],
        P_gravity=invert_each(cov_up)[0] * used[n : n + s, None, None],
        J_gravity=np.concatenate([-skew(up)[:, :2], np.zeros((s, 2, 4))], axis=2),
        v_control=control - state.p_site[network.controls],
        P_control=invert_each(network.cov_control_site)[0] * used[n + s :, None, None],
    )


def _reduce(network: Network, lin: Linearised, state: State) -> tuple[Reduced, Array]:
    """Return the normal equations without the stations, and the right-hand sides of these."""
    s, m, k = len(network.stations), len(network.marks), len(state.shared)
    station, mark = network.sightings.T
    weighted = np.swapaxes(lin.J_centres, 1, 2) @ lin.P_centres
    levelled = np.swapaxes(lin.J_gravity, 1, 2) @ lin.P_gravity
    local, rhs = levelled @ lin.J_gravity, -np.einsum("sij,sj->si", levelled, lin.v_gravity)
    local[:, _MOTION, _MOTION] += 1.0  # the prior of the heights
    rhs[:, _MOTION] -= state.heights
    np.add.at(local, station, weighted @ lin.J_centres)
    np.add.at(rhs, station, -np.einsum("nij,nj->ni", weighted, lin.v_centres))
    coupling = weighted @ lin.J_common
    n_own = _MOTION + 1
    to_marks, to_shared = np.zeros((s, m, n_own, 3)), np.zeros((s, n_own, k))
    np.add.at(to_marks, (station, mark), coupling[..., :3])
    np.add.at(to_shared, station, coupling[..., 3:])
    flat = np.swapaxes(to_marks, 1, 2).reshape(s, n_own, 3 * m)
    mixed = np.concatenate([flat, to_shared], axis=2)
    return eliminate(local, mixed, rhs, *_common_alone(network, lin, state.shared)), rhs


def _common_alone(network: Network, lin: Linearised, shared: Array) -> tuple[Array, Array]:
    """Return the normal equations of marks and shared unknowns where no station moves."""
    m, k = len(network.marks), len(shared)
    mark = network.sightings[:, 1]
    weighted = np.swapaxes(lin.J_common, 1, 2) @ lin.P_centres
    squares = weighted @ lin.J_common
    products = -np.einsum("nij,nj->ni", weighted, lin.v_centres)
    blocks, rhs = np.zeros((m, 3, 3 + k)), np.zeros((m, 3))
    np.add.at(blocks, mark, squares[:, :3])
    np.add.at(rhs, mark, products[:, :3])
    np.add.at(blocks[:, :, :3], network.controls, lin.P_control)
    np.add.at(rhs, network.controls, np.einsum("nij,nj->ni", lin.P_control, lin.v_control))
    N = np.zeros((3 * m + k, 3 * m + k))
    diagonal = np.zeros((m, 3, m, 3))
    diagonal[np.arange(m), :, np.arange(m), :] = blocks[:, :, :3]
    N[: 3 * m, : 3 * m] = diagonal.reshape(3 * m, 3 * m)
    N[: 3 * m, 3 * m :] = blocks[:, :, 3:].reshape(3 * m, k)
    N[3 * m :, : 3 * m] = N[: 3 * m, 3 * m :].T
    weights = network.shared.prior_weights
    N[3 * m :, 3 * m :] = squares[:, 3:, 3:].sum(axis=0) + weights
    tail = products[:, 3:].sum(axis=0) - weights @ shared
    return N, np.concatenate([rhs.ravel(), tail])


def _datum(network: Network, state: State) -> Array:
    """Return orthonormal columns of what a free network leaves open: (3m + k, 4), or none."""
    m, extra = len(network.marks), len(network.shared.names)
    if not network.is_free:
        return np.zeros((3 * m + extra, 0))
    motions = np.zeros((m, 3, N_DEFECT))
    motions[:, [0, 1, 2], [0, 1, 2]] = 1.0
    motions[:, 0, 3], motions[:, 1, 3] = -state.p_site[:, 1], state.p_site[:, 0]
    open_ = np.linalg.qr(motions.reshape(3 * m, N_DEFECT)).Q
    return np.concatenate([open_, np.zeros((extra, N_DEFECT))])


def _inverse(normal: Array, datum: Array) -> Array:
    """Return the inverse of the reduced normal matrix, of least trace in a free network.

    The inner constraints ``datum' dx = 0`` make it the pseudo-inverse (Meissl 1969).
    """
    held = np.abs(datum).max(axis=1, initial=0.0) > 0.0
    scale = np.sqrt(np.diag(normal))
    border = float(np.mean(scale[held] ** 2)) if held.any() else 0.0
    bordered = normal + border * datum @ datum.T
    values = np.linalg.eigvalsh(bordered / np.outer(scale, scale))
    if not values[0] > _SINGULAR:
        raise DegenerateGeometryError(
            "The observations do not hold the network together (smallest eigenvalue of the scaled "
            f"normal matrix {values[0]:.1e}, at least {_SINGULAR:.0e} is needed): a station or a "
            "group of marks can move on its own."
        )
    inverse = np.linalg.inv(bordered)
    inverse = inverse - datum @ (datum.T @ inverse)
    inverse = inverse - (inverse @ datum) @ datum.T
    return np.asarray((inverse + inverse.T) / 2.0)


def solve_network(network: Network, state: State, used: Mask) -> tuple[State, Cofactors]:
    """Find the state for which the weighted sum of squares is least.

    Notes
    -----
    Gauss-Newton. In a free network each step keeps the marks' centroid and mean heading where the
    approximate values have them.
    """
    m = len(network.marks)
    for _ in range(_STEPS):
        reduced, rhs = _reduce(network, linearise(network, state, used), state)
        cov = _inverse(reduced.N, _datum(network, state))
        common = cov @ reduced.rhs
        stations = reduced.local_steps(common)
        state = step_to(state, stations, common[: 3 * m].reshape(m, 3), common[3 * m :])
        if np.sum(reduced.steps * rhs) + reduced.rhs @ common < _SETTLED:
            return state, _cofactors(reduced, cov)
    raise NotConvergedError(
        f"The network did not settle within {_STEPS} steps; the approximate values are too far "
        "off or the observations contradict each other."
    )


def _cofactors(reduced: Reduced, cov_common: Array) -> Cofactors:
    """Return the covariances of stations and common unknowns."""
    between = -reduced.gains @ cov_common
    stations = reduced.own - between @ np.swapaxes(reduced.gains, 1, 2)
    return Cofactors(
        stations=(stations + np.swapaxes(stations, 1, 2)) / 2.0,
        between=between,
        common=cov_common,
        parts=Parts(
            own=reduced.own[:, :_MOTION, :_MOTION].copy(),
            coupling=reduced.gains[:, :_MOTION].copy(),
            cov_common=cov_common,
        ),
    )
