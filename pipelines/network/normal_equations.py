"""Normal equations of a network: hides their structure.

A station meets others only through marks, so the stations are eliminated one by one and what
remains is a dense system of the marks alone (Schur complement; Triggs et al., Bundle Adjustment,
2000, section 6). Cost and memory grow linearly with the stations.

All coordinates are relative to the middle of the approximate marks. Letters as in ``adjustment``:
``J`` derivative of the residuals, ``P`` weight, ``N`` normal matrix, ``Q`` cofactor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spheremark.pipelines.errors import DegenerateGeometryError, NotConvergedError
from spheremark.pipelines.geometry import skew
from spheremark.pipelines.model import Array, Index, Mask
from spheremark.pipelines.model.network import Network, Parts
from spheremark.pipelines.positioning.matching import moved

N_DEFECT = 4  # of a free network whose stations are levelled: place and heading

_STEPS = 50  # three to six suffice
_SETTLED = 1e-12  # square of the last step in standard deviations
_SINGULAR = 1e-11  # eigenvalue of the reduced normal matrix with unit diagonal


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class State:
    """Poses of the stations, (s, 4, 4), and marks, (m, 3), relative to the middle [m].

    ``shared``, (k,), are the unknowns that all stations have in common.
    """

    T_site_base: Array
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
    J_centres : (n, 3, 6)
        By the motion of the station.
    J_common : (n, 3, 3 + k)
        By the mark, minus the identity, and by what all stations share.
    v_gravity : (s, 2)
        Horizontal part of the measured up direction [rad].
    P_gravity : (s, 2, 2)
        Weights.
    J_gravity : (s, 2, 6)
        By the motion of the station.
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
    """Covariances of a solution.

    Attributes
    ----------
    stations : (s, 6, 6)
        Of small motions of the stations.
    between : (s, 6, m, 3)
        Between stations and marks.
    marks : (3m, 3m)
        Of the marks.
    with_shared : (s, 6, k)
        Between stations and what all share.
    shared_and_marks : (m, 3, k)
        Between marks and what all share.
    shared : (k, k)
        Of what all share.
    parts : Parts
        What these were made of.
    """

    stations: Array
    between: Array
    marks: Array
    with_shared: Array
    shared_and_marks: Array
    shared: Array
    parts: Parts


def middle_of(network: Network) -> Array:
    """Return the middle of the approximate marks."""
    return np.asarray(network.p_site.mean(axis=0))


def start(network: Network) -> State:
    """Return the approximate values."""
    middle = middle_of(network)
    T = np.array(network.T_site_base)
    T[:, :3, 3] -= middle
    nothing = np.zeros(len(network.shared.names))
    return State(T_site_base=T, p_site=network.p_site - middle, shared=nothing)


def step_to(state: State, xi: Array, dp: Array, d_shared: Array) -> State:
    """Move a state."""
    return State(
        T_site_base=moved(state.T_site_base, xi),
        p_site=state.p_site + dp,
        shared=state.shared + d_shared,
    )


def linearise(network: Network, state: State, used: Mask) -> Linearised:
    """Return residuals, weights and derivatives."""
    n, s = len(network.sightings), len(network.stations)
    station, mark = network.sightings.T
    R, t = state.T_site_base[:, :3, :3], state.T_site_base[:, :3, 3]
    R_each = R[station]
    effects = R_each @ network.shared.effects
    p = np.einsum("nij,nj->ni", R_each, network.p_base) + t[station] - effects @ state.shared
    J_mark = np.broadcast_to(-np.eye(3), (n, 3, 3))
    weights = R_each @ np.linalg.inv(network.cov_p_base) @ np.swapaxes(R_each, 1, 2)
    up = np.einsum("sij,sj->si", R, network.R_station_base[:, 2])
    cov_up = (R @ network.cov_up_base @ np.swapaxes(R, 1, 2))[:, :2, :2]
    control = network.p_control_site - middle_of(network)
    return Linearised(
        v_centres=p - state.p_site[mark],
        P_centres=weights * used[:n, None, None],
        J_centres=np.concatenate([-skew(p), np.broadcast_to(np.eye(3), (n, 3, 3))], axis=2),
        J_common=np.concatenate([J_mark, -effects], axis=2),
        v_gravity=up[:, :2],
        P_gravity=np.asarray(np.linalg.inv(cov_up)) * used[n : n + s, None, None],
        J_gravity=np.concatenate([-skew(up)[:, :2], np.zeros((s, 2, 3))], axis=2),
        v_control=control - state.p_site[network.controls],
        P_control=np.asarray(np.linalg.inv(network.cov_control_site)) * used[n + s :, None, None],
    )


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class _Reduced:
    """Normal equations after the stations are eliminated.

    ``A`` (s, 6, 6) are the stations' own blocks, ``K`` (s, 6, 3m + k) is ``A^-1`` times their
    coupling to marks and shared unknowns, zero but in the ``columns`` of each station; ``S``
    (3m + k, 3m + k) is the Schur complement; ``g`` and ``r`` are the right sides.
    """

    A: Array
    K: Array
    S: Array
    g: Array
    r: Array
    columns: tuple[Index, ...]


def _reduce(network: Network, lin: Linearised, shared: Array) -> _Reduced:
    """Set up the normal equations and eliminate the stations."""
    s, m = len(network.stations), len(network.marks)
    station = network.sightings[:, 0]
    pressed = np.swapaxes(lin.J_centres, 1, 2) @ lin.P_centres
    levelled = np.swapaxes(lin.J_gravity, 1, 2) @ lin.P_gravity
    stations, g = levelled @ lin.J_gravity, np.einsum("sij,sj->si", levelled, lin.v_gravity)
    np.add.at(stations, station, pressed @ lin.J_centres)
    np.add.at(g, station, np.einsum("nij,nj->ni", pressed, lin.v_centres))
    to_marks = pressed @ lin.J_common[..., :3]
    to_shared = np.zeros((s, 6, len(shared)))
    np.add.at(to_shared, station, pressed @ lin.J_common[..., 3:])
    reduced, h = _marks_alone(network, lin, shared)
    solved, r, columns = np.zeros((s, 6, 3 * m + len(shared))), -h, []
    for each, rows in enumerate(_rows_of_stations(network)):
        own = np.swapaxes(to_marks[rows], 0, 1).reshape(6, -1)
        coupling = np.concatenate([own, to_shared[each]], axis=1)
        there = _columns(network.sightings[rows, 1], m, len(shared))
        part = np.linalg.solve(stations[each], coupling)
        reduced[there[:, None], there] -= coupling.T @ part
        r[there] += part.T @ g[each]
        solved[each][:, there] = part
        columns.append(there)
    reduced = (reduced + reduced.T) / 2.0
    return _Reduced(A=stations, K=solved, S=reduced, g=g, r=r, columns=tuple(columns))


def _rows_of_stations(network: Network) -> list[Index]:
    """Return the sightings of each station."""
    station = network.sightings[:, 0]
    ends = np.cumsum(np.bincount(station, minlength=len(network.stations)))
    return np.split(np.argsort(station, kind="stable"), ends[:-1])


def _columns(marks: Index, n_marks: int, n_shared: int) -> Index:
    """Return where the unknowns of some marks, and all that are shared, stand."""
    own = 3 * marks[:, None] + np.arange(3)
    return np.concatenate([own.ravel(), 3 * n_marks + np.arange(n_shared)])


def _marks_alone(network: Network, lin: Linearised, shared: Array) -> tuple[Array, Array]:
    """Return normal matrix and gradient of marks and shared unknowns where no station moves."""
    m, k = len(network.marks), len(shared)
    mark = network.sightings[:, 1]
    pressed = np.swapaxes(lin.J_common, 1, 2) @ lin.P_centres
    squares = pressed @ lin.J_common
    gradient = np.einsum("nij,nj->ni", pressed, lin.v_centres)
    blocks, h = np.zeros((m, 3, 3 + k)), np.zeros((m, 3))
    np.add.at(blocks, mark, squares[:, :3])
    np.add.at(h, mark, gradient[:, :3])
    np.add.at(blocks[:, :, :3], network.controls, lin.P_control)
    np.add.at(h, network.controls, -np.einsum("nij,nj->ni", lin.P_control, lin.v_control))
    N = np.zeros((3 * m + k, 3 * m + k))
    diagonal = np.zeros((m, 3, m, 3))
    diagonal[np.arange(m), :, np.arange(m), :] = blocks[:, :, :3]
    N[: 3 * m, : 3 * m] = diagonal.reshape(3 * m, 3 * m)
    N[: 3 * m, 3 * m :] = blocks[:, :, 3:].reshape(3 * m, k)
    N[3 * m :, : 3 * m] = N[: 3 * m, 3 * m :].T
    weights = network.shared.weights
    N[3 * m :, 3 * m :] = squares[:, 3:, 3:].sum(axis=0) + weights
    tail = gradient[:, 3:].sum(axis=0) + weights @ shared
    return N, np.concatenate([h.ravel(), tail])


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
        reduced = _reduce(network, linearise(network, state, used), state.shared)
        cov_marks = _inverse(reduced.S, _datum(network, state))
        dp = cov_marks @ reduced.r
        own = np.linalg.solve(reduced.A, reduced.g[..., None])[..., 0]
        xi = -own - reduced.K @ dp
        state = step_to(state, xi, dp[: 3 * m].reshape(m, 3), dp[3 * m :])
        size = np.einsum("si,si->", own, reduced.g) + reduced.r @ dp
        if size < _SETTLED:
            return state, _cofactors(reduced, cov_marks, m)
    raise NotConvergedError(
        f"The network did not settle within {_STEPS} steps; the approximate values are too far "
        "off or the observations contradict each other."
    )


def _cofactors(reduced: _Reduced, cov_marks: Array, m: int) -> Cofactors:
    """Return the covariances of stations, marks and what all share."""
    between = np.empty_like(reduced.K)
    for each, there in enumerate(reduced.columns):
        between[each] = -reduced.K[each][:, there] @ cov_marks[there]
    own = np.asarray(np.linalg.inv(reduced.A), dtype=np.float64)
    stations = own - between @ np.swapaxes(reduced.K, 1, 2)
    return Cofactors(
        stations=(stations + np.swapaxes(stations, 1, 2)) / 2.0,
        between=between[:, :, : 3 * m].reshape(len(between), 6, m, 3),
        marks=cov_marks[: 3 * m, : 3 * m].copy(),
        with_shared=between[:, :, 3 * m :],
        shared_and_marks=cov_marks[: 3 * m, 3 * m :].reshape(m, 3, -1),
        shared=cov_marks[3 * m :, 3 * m :].copy(),
        parts=Parts(own=own, coupling=reduced.K, cov_common=cov_marks),
    )
