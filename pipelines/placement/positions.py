"""Covariances of positions from those of centres, without any observation.

Hides the normal equations of the resection methods at places where nobody has stood yet. Rotations
are about the station itself, so that the translation block is the covariance of the position.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from scipy.special import ndtri

from pipelines.placement.values import Requirement
from pipelines.values import Array, Index, Mask

_SINGULAR = 1e-11  # pivot over diagonal below which an unknown is undetermined
_LOOSE2 = 1.0  # [m^2] a position that is worse than this is none
_UNTESTABLE = 1e-7  # redundancy below which a bias cannot show


class Positions(NamedTuple):
    """What centres make of positions.

    Attributes
    ----------
    cov_motion : (e, 6, 6)
        Of a small motion about the station, rotation [rad] and translation [m]; infinite on the
        diagonal where there is no position.
    used : (e, n)
        Marks that carry each position.
    """

    cov_motion: Array
    used: Mask


def predict_positions(
    eyes_site: Array, marks_site: Array, cov_centres: Array, is_seen: Mask, wish: Requirement
) -> Positions:
    """Predict the covariances of positions.

    Parameters
    ----------
    eyes_site : (e, 3)
        Places of the LiDAR [m].
    marks_site : (n, 3)
        Marks [m].
    cov_centres : (e, n, 3, 3)
        Covariances of their centres in the axes of the site [m^2].
    is_seen : (e, n)
        Which are found.
    wish : Requirement
        Method, and what is known of levelling and marks.

    Returns
    -------
    Positions
        Covariances, and what carries them.

    Notes
    -----
    ``free_station``: ``(sum J' P J + G)^-1`` with ``J = [-[v]x, 1]`` of each mark and the AHRS's
    information ``G`` on roll and pitch, as ``resection`` adjusts them. ``paper``: horizontal
    distances and heights of the three marks whose circles cut best, and the lean carried through
    them as ``ranging`` does; its heading is that of the three directions.
    """
    eyes, marks = np.ascontiguousarray(eyes_site), np.ascontiguousarray(marks_site)
    covs = cov_centres + (wish.sigma_marks**2 + wish.resection.sigma_common**2) * np.eye(3)
    out = np.zeros((len(eyes), 6, 6))
    if wish.method == "paper":
        used = np.zeros(is_seen.shape, dtype=np.bool_)
        _by_circles(eyes, marks, covs, is_seen, wish.sigma_levelling**2, used, out)
        return Positions(out, used)
    _by_motion(eyes, marks, covs, is_seen, wish.sigma_levelling**-2, out)
    return Positions(out, np.array(is_seen))


@numba.njit(cache=True, nogil=True)
def _inverted(N: Array, out: Array) -> bool:
    """Invert a symmetric positive matrix into another; false if it is singular."""
    n = len(N)
    L = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            s = N[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                if not s > _SINGULAR * N[i, i]:
                    return False
                L[i, i] = np.sqrt(s)
            else:
                L[i, j] = s / L[j, j]
    for i in range(n):  # L becomes its own inverse
        L[i, i] = 1.0 / L[i, i]
        for j in range(i):
            s = 0.0
            for k in range(j, i):
                s -= L[i, k] * L[k, j]
            L[i, j] = s * L[i, i]
    for i in range(n):
        for j in range(i + 1):
            s = 0.0
            for k in range(i, n):
                s += L[k, i] * L[k, j]
            out[i, j] = s
            out[j, i] = s
    return True


@numba.njit(cache=True, nogil=True)
def _by_motion(
    eyes: Array, marks: Array, covs: Array, is_seen: Mask, gravity: float, out: Array
) -> None:
    """Fill in the covariances of free stations."""
    P, J, PJ = np.empty((3, 3)), np.zeros((3, 6)), np.empty((3, 6))
    N = np.empty((6, 6))
    for e in range(len(eyes)):
        N[:] = 0.0
        N[0, 0] = N[1, 1] = gravity
        for m in range(len(marks)):
            if not is_seen[e, m] or not _inverted(covs[e, m], P):
                continue
            x, y, z = marks[m, 0] - eyes[e, 0], marks[m, 1] - eyes[e, 1], marks[m, 2] - eyes[e, 2]
            J[0, 1], J[0, 2], J[1, 0], J[1, 2], J[2, 0], J[2, 1] = z, -y, -z, x, y, -x
            J[0, 3] = J[1, 4] = J[2, 5] = 1.0
            for i in range(3):
                for j in range(6):
                    PJ[i, j] = P[i, 0] * J[0, j] + P[i, 1] * J[1, j] + P[i, 2] * J[2, j]
            for i in range(6):
                for j in range(6):
                    N[i, j] += J[0, i] * PJ[0, j] + J[1, i] * PJ[1, j] + J[2, i] * PJ[2, j]
        ok = _inverted(N, out[e])
        if not ok or out[e, 3, 3] + out[e, 4, 4] + out[e, 5, 5] > _LOOSE2:
            out[e] = np.diag(np.full(6, np.inf))


@numba.njit(cache=True, nogil=True)
def _best_three(eye: Array, marks: Array, is_seen: Mask, units: Array, three: Index) -> bool:
    """Find the three seen marks whose circles cut best; false if there are none."""
    least = np.inf
    n = len(marks)
    for m in range(n):
        x, y = marks[m, 0] - eye[0], marks[m, 1] - eye[1]
        flat = max(np.hypot(x, y), 1e-9)
        units[m, 0], units[m, 1] = x / flat, y / flat
    for i in range(n):
        if not is_seen[i]:
            continue
        for j in range(i + 1, n):
            if not is_seen[j]:
                continue
            xx = units[i, 0] ** 2 + units[j, 0] ** 2
            xy = units[i, 0] * units[i, 1] + units[j, 0] * units[j, 1]
            for k in range(j + 1, n):
                if not is_seen[k]:
                    continue
                a = xx + units[k, 0] ** 2
                b = xy + units[k, 0] * units[k, 1]
                spread = 3.0 / max(a * (3.0 - a) - b * b, 1e-12)
                if spread < least:
                    least = spread
                    three[0], three[1], three[2] = i, j, k
    return least < 1e6


@numba.njit(cache=True, nogil=True)
def _by_circles(
    eyes: Array, marks: Array, covs: Array, is_seen: Mask, level2: float, used: Mask, out: Array
) -> None:
    """Fill in the covariances of positions by three circles."""
    units, three = np.empty((len(marks), 2)), np.empty(3, np.intp)
    A, C, W, gain = np.zeros((6, 3)), np.zeros((6, 6)), np.empty((6, 6)), np.zeros((3, 6))
    lean, Q, N = np.zeros((6, 2)), np.empty((3, 3)), np.zeros((3, 3))
    B = np.zeros((2, 3))
    for e in range(len(eyes)):
        out[e] = np.diag(np.full(6, np.inf))
        if not _best_three(eyes[e], marks, is_seen[e], units, three):
            continue
        C[:] = 0.0
        yaw2 = 0.0
        for r in range(3):
            m = three[r]
            x, y, z = marks[m, 0] - eyes[e, 0], marks[m, 1] - eyes[e, 1], marks[m, 2] - eyes[e, 2]
            u, v = units[m]
            B[0, 0], B[0, 1], B[1, 2] = u, v, 1.0
            for q in range(2):  # -skew(v), its first two columns, seen through B
                lean[2 * r, 0], lean[2 * r, 1] = -z * v, z * u
                lean[2 * r + 1, 0], lean[2 * r + 1, 1] = y, -x
                A[2 * r + q] = B[q]
            C[2 * r : 2 * r + 2, 2 * r : 2 * r + 2] = B @ covs[e, m] @ B.T
            flat2 = x * x + y * y
            side2 = v * v * covs[e, m, 0, 0] - 2.0 * u * v * covs[e, m, 0, 1]
            yaw2 += (side2 + u * u * covs[e, m, 1, 1]) / flat2 / 9.0
        W[:] = 0.0
        for r in range(3):
            s = slice(2 * r, 2 * r + 2)
            W[s, s] = np.linalg.inv(C[s, s] + level2 * lean[s] @ lean[s].T)
        N[:] = A.T @ W @ A
        if not _inverted(N, Q):
            continue
        gain[:] = Q @ A.T @ W
        tilt = gain @ lean
        position = gain @ C @ gain.T + level2 * tilt @ tilt.T
        if np.trace(position) > _LOOSE2:
            continue
        for r in range(3):
            used[e, three[r]] = True
        out[e] = 0.0
        out[e, 3:, 3:] = position
        out[e, 0, 0] = out[e, 1, 1] = level2
        out[e, 2, 2] = yaw2
        out[e, 3:, :2] = -level2 * tilt
        out[e, :2, 3:] = -level2 * tilt.T


class Reliability(NamedTuple):
    """What would show of an error in one mark, and what would not.

    Attributes
    ----------
    redundancies : (e, n)
        Redundancy of each mark's observations together; 0 where it is not used.
    detectable_biases : (e, n)
        Minimal detectable bias along the weakest axis [m].
    external : (e, n)
        Largest shift of the position by a bias of that size [m].
    """

    redundancies: Array
    detectable_biases: Array
    external: Array


def reliability(
    eyes_site: Array, marks_site: Array, cov_centres: Array, found: Positions, wish: Requirement
) -> Reliability:
    """Say how large an error in one mark must be to be found, and what a smaller one does.

    Parameters
    ----------
    eyes_site : (e, 3)
        Places of the LiDAR [m].
    marks_site : (n, 3)
        Marks [m].
    cov_centres : (e, n, 3, 3)
        Covariances of their centres in the axes of the site [m^2].
    found : Positions
        What ``predict_positions`` made of them.
    wish : Requirement
        Method and levels of the tests.

    Returns
    -------
    Reliability
        Baarda's measures, as ``adjustment`` gives them after a survey.
    """
    v = marks_site[None] - eyes_site[:, None]
    extra = (wish.sigma_marks**2 + wish.resection.sigma_common**2) * np.eye(3)
    covs = np.where(found.used[..., None, None], cov_centres + extra, np.eye(3))
    is_fixed = np.isfinite(found.cov_motion).all(axis=(1, 2))
    used = found.used & is_fixed[:, None]
    Q = np.where(is_fixed[:, None, None], found.cov_motion, 0.0)
    if wish.method == "paper":
        J, covs = _circle_equations(v, covs, wish)
        Q = _by_weights(J, covs, used)
        to_position = np.eye(3)
    else:
        J = _motion_equations(v)
        to_position = np.eye(6)[3:]
    P = np.linalg.inv(covs)
    PJ = P @ J
    tested = P - PJ @ Q[:, None] @ np.swapaxes(PJ, -1, -2)
    redundancies = np.einsum("enij,enji->en", tested, covs)
    weakest = np.linalg.eigvalsh(tested)[..., 0]
    is_open = weakest < _UNTESTABLE * np.linalg.eigvalsh(P)[..., 0]
    power = wish.resection.test_power
    noncentrality = float(ndtri(1.0 - wish.resection.test_level / 2.0) + ndtri(power))
    biases = noncentrality / np.sqrt(np.where(is_open, 1.0, weakest))
    effects = to_position @ Q[:, None] @ np.swapaxes(PJ, -1, -2)
    safe = np.where(is_open[..., None, None], np.eye(covs.shape[-1]), tested)
    shifts = effects @ np.linalg.solve(safe, np.swapaxes(effects, -1, -2))
    external = noncentrality * np.sqrt(np.maximum(np.linalg.eigvalsh(shifts)[..., -1], 0.0))
    none = ~used | is_open
    return Reliability(
        redundancies=np.where(used, redundancies, 0.0),
        detectable_biases=np.where(none, np.inf, biases),
        external=np.where(none, np.inf, external),
    )


def _motion_equations(v: Array) -> Array:
    """Return ``[-[v]x, 1]`` of vectors from stations to marks, (e, n, 3, 6)."""
    J = np.zeros((*v.shape[:-1], 3, 6))
    x, y, z = np.moveaxis(v, -1, 0)
    J[..., 0, 1], J[..., 0, 2], J[..., 1, 0] = z, -y, -z
    J[..., 1, 2], J[..., 2, 0], J[..., 2, 1] = x, y, -x
    J[..., :, 3:] = np.eye(3)
    return J


def _circle_equations(v: Array, covs: Array, wish: Requirement) -> tuple[Array, Array]:
    """Return derivatives, (e, n, 2, 3), and covariances of horizontal distances and heights."""
    flat = np.maximum(np.hypot(v[..., 0], v[..., 1]), 1e-9)
    B = np.zeros((*v.shape[:-1], 2, 3))
    B[..., 0, 0], B[..., 0, 1], B[..., 1, 2] = v[..., 0] / flat, v[..., 1] / flat, 1.0
    lean = B @ _motion_equations(v)[..., :2]
    cov = B @ covs @ np.swapaxes(B, -1, -2)
    return B, cov + wish.sigma_levelling**2 * lean @ np.swapaxes(lean, -1, -2)


def _by_weights(J: Array, covs: Array, used: Mask) -> Array:
    """Return the inverse normal matrices of the used blocks; zero where singular."""
    weighted = np.linalg.solve(covs, J) * used[..., None, None]
    N = np.einsum("enmp,enmq->epq", J, weighted)
    is_fixed = used.sum(axis=1) >= 3
    return np.where(
        is_fixed[:, None, None], np.linalg.inv(np.where(is_fixed[:, None, None], N, np.eye(3))), 0.0
    )
