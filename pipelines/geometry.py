"""Rigid motions, levelling and polar coordinates: the only changer of frames.

Conventions are those of CONVENTIONS.md: ``T_a_b`` maps from ``b`` to ``a``; small motions are
(rotation, translation) and act on the left.
"""

import numpy as np
from numpy.typing import ArrayLike

from spheremark.pipelines.model import Array, Levelling, Mask

_SMALL = 1e-9  # [rad]; below it the series of the exponential is exact in float64
_LINE = 0.05  # spread across over spread along of points on a line; 3 deg seen from the end
_PLUMB = 0.05  # the same of points on a plumb line, which give no heading


def skew(v: ArrayLike) -> Array:
    """Return the matrix ``[v]x`` with ``[v]x w = v x w``.

    Parameters
    ----------
    v : (..., 3)
        Vectors.

    Returns
    -------
    (..., 3, 3)
        One matrix per vector.
    """
    v = np.asarray(v, dtype=np.float64)
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def cross(v: Array, w: Array) -> Array:
    """Return ``v x w``.

    Parameters
    ----------
    v, w : (..., 3)
        Vectors.

    Returns
    -------
    (..., 3)
        Their cross products: those of ``numpy.cross``, of few vectors in a quarter of its time.
    """
    (x, y, z), (a, b, c) = np.moveaxis(v, -1, 0), np.moveaxis(w, -1, 0)
    return np.stack([y * c - z * b, z * a - x * c, x * b - y * a], axis=-1)


def unit(v: Array) -> Array:
    """Return vectors of length one.

    Parameters
    ----------
    v : (..., n)
        Vectors.

    Returns
    -------
    (..., n)
        Their directions.
    """
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


def rot_x(angle: float) -> Array:
    """Return the rotation about x by an angle.

    Parameters
    ----------
    angle : float
        Right-handed [rad].

    Returns
    -------
    (3, 3)
        Rotation.
    """
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def rot_y(angle: float) -> Array:
    """Return the rotation about y by an angle.

    Parameters
    ----------
    angle : float
        Right-handed [rad].

    Returns
    -------
    (3, 3)
        Rotation.
    """
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def rot_z(angle: float) -> Array:
    """Return the rotation about z by an angle.

    Parameters
    ----------
    angle : float
        Right-handed [rad].

    Returns
    -------
    (3, 3)
        Rotation.
    """
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rigid(R: ArrayLike, t: ArrayLike) -> Array:
    """Return the motion with a rotation and a translation.

    Parameters
    ----------
    R : (3, 3)
        Rotation.
    t : (3,)
        Translation [m].

    Returns
    -------
    (4, 4)
        Rigid motion.
    """
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def inverse(T: Array) -> Array:
    """Return the inverse of a rigid motion.

    Parameters
    ----------
    T : (4, 4)
        Rigid motion ``T_a_b``.

    Returns
    -------
    (4, 4)
        ``T_b_a``.
    """
    R = T[:3, :3]
    return rigid(R.T, -R.T @ T[:3, 3])


def transform(T: Array, p: ArrayLike) -> Array:
    """Move points by a rigid motion.

    Parameters
    ----------
    T : (4, 4)
        Rigid motion ``T_a_b``.
    p : (..., 3)
        Points in frame b [m].

    Returns
    -------
    (..., 3)
        Points in frame a [m].
    """
    return np.asarray(p, dtype=np.float64) @ T[:3, :3].T + T[:3, 3]


def exp_motion(xi: ArrayLike) -> Array:
    """Return the rigid motion of a small-motion vector.

    Parameters
    ----------
    xi : (6,)
        Rotation [rad] and translation [m] of the twist.

    Returns
    -------
    (4, 4)
        ``Exp(xi)``.

    Notes
    -----
    Barfoot, State Estimation for Robotics, eq. 7.34 and 7.37, with rotation first.
    """
    from scipy.spatial.transform import Rotation  # slow to import

    xi = np.asarray(xi, dtype=np.float64)
    return rigid(Rotation.from_rotvec(xi[:3]).as_matrix(), left_jacobian(xi[:3]) @ xi[3:])


def log_motion(T: Array) -> Array:
    """Return the small-motion vector whose ``exp_motion`` is ``T``.

    Parameters
    ----------
    T : (4, 4)
        Rigid motion that turns by less than pi.

    Returns
    -------
    (6,)
        Rotation [rad] and translation [m] of the twist.
    """
    from scipy.spatial.transform import Rotation  # slow to import

    phi = Rotation.from_matrix(T[:3, :3]).as_rotvec()
    return np.concatenate([phi, np.linalg.solve(left_jacobian(phi), T[:3, 3])])


def left_jacobian(phi: Array) -> Array:
    """Return the left Jacobian of a rotation vector.

    Notes
    -----
    Barfoot, State Estimation for Robotics, eq. 7.37.
    """
    cross = skew(phi)
    angle = float(np.linalg.norm(phi))
    if angle < _SMALL:
        return np.eye(3) + 0.5 * cross
    first, second = (1.0 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    return np.asarray(np.eye(3) + first * cross + second * cross @ cross)


def levelling_rotation(levelling: Levelling) -> Array:
    """Return the rotation that levels the base.

    Parameters
    ----------
    levelling : Levelling
        How the base leans.

    Returns
    -------
    (3, 3)
        ``R_station_base = Ry(pitch) Rx(roll)``.
    """
    return np.asarray(rot_y(levelling.pitch) @ rot_x(levelling.roll))


def up_by_lean(levelling: Levelling) -> Array:
    """Return the derivative of the up direction in base by roll and pitch.

    Parameters
    ----------
    levelling : Levelling
        How the base leans.

    Returns
    -------
    (3, 2)
        Derivative of the last row of ``R_station_base``.
    """
    cr, sr = np.cos(levelling.roll), np.sin(levelling.roll)
    cp, sp = np.cos(levelling.pitch), np.sin(levelling.pitch)
    return np.array([[0.0, -cp], [cp * cr, -sp * sr], [-cp * sr, -sp * cr]])


def yaw_pitch_roll(R: Array) -> tuple[float, float, float]:
    """Return yaw, pitch and roll of ``R = Rz(yaw) Ry(pitch) Rx(roll)``.

    Parameters
    ----------
    R : (3, 3)
        Rotation.

    Returns
    -------
    tuple of float
        Yaw, pitch and roll [rad].
    """
    from scipy.spatial.transform import Rotation  # slow to import

    yaw, pitch, roll = Rotation.from_matrix(R).as_euler("ZYX")
    return float(yaw), float(pitch), float(roll)


def included_angle(v: ArrayLike, w: ArrayLike) -> Array:
    """Return the angle between directions.

    Parameters
    ----------
    v, w : (..., 3)
        Directions of any length.

    Returns
    -------
    (...)
        Angles, 0 to pi [rad].

    Notes
    -----
    By the arc tangent of cross and dot product, which is exact for small and for flat angles
    (Kahan, 2006, section 13).
    """
    v, w = np.asarray(v, dtype=np.float64), np.asarray(w, dtype=np.float64)
    across = np.linalg.norm(cross(v, w), axis=-1)
    return np.asarray(np.arctan2(across, np.sum(v * w, axis=-1)))


def is_on_a_line(p: ArrayLike) -> bool:
    """Return whether points lie about on one line, or are fewer than three.

    Parameters
    ----------
    p : (n, 3)
        Points [m].

    Returns
    -------
    bool
        True where they spread across their line by less than a twentieth of their spread along it,
        which is 3 degrees seen from the end.
    """
    points = np.asarray(p, dtype=np.float64)
    if len(points) < 3:
        return True
    spreads = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spreads[1] < _LINE * spreads[0])


def has_heading(p: Array) -> Mask:
    """Return whether points are far enough from one plumb line to give a heading.

    Parameters
    ----------
    p : (..., n, 3)
        Groups of points in a levelled frame [m].

    Returns
    -------
    (...) bool
        True where they spread across the plumb line by more than a twentieth of their spread.
    """
    off = p - p.mean(axis=-2, keepdims=True)
    across = np.linalg.norm(off[..., :2], axis=(-2, -1))
    return np.asarray(across > _PLUMB * np.linalg.norm(off, axis=(-2, -1)))


def turn_in_place(T: Array, axis: ArrayLike = (0.0, 0.0, 1.0)) -> Array:
    """Return the small motion on the left that turns a frame by 1 rad about an axis of its own.

    Parameters
    ----------
    T : (..., 4, 4)
        Poses of frames.
    axis : (..., 3)
        Unit vectors in these frames; z by default.

    Returns
    -------
    (..., 6)
        Rotation [rad] and translation [m]; the origin of the frame stays.
    """
    turned = (T[..., :3, :3] @ np.asarray(axis)[..., None])[..., 0]
    return np.concatenate([turned, cross(T[..., :3, 3], turned)], axis=-1)


def by_motion(p: Array) -> Array:
    """Return the derivative of points by a small motion on the left.

    Parameters
    ----------
    p : (..., 3)
        Points [m].

    Returns
    -------
    (..., 3, 6)
        ``[-[p]x, 1]``.
    """
    J = np.zeros((*p.shape, 6))
    J[..., :3] = -skew(p)
    J[..., 0, 3] = J[..., 1, 4] = J[..., 2, 5] = 1.0
    return J


def wrap(angle: ArrayLike) -> Array:
    """Reduce angles to [-pi, pi).

    Parameters
    ----------
    angle : (...)
        Angles [rad].

    Returns
    -------
    (...)
        The same directions [rad].
    """
    return np.asarray((np.asarray(angle, dtype=np.float64) + np.pi) % (2.0 * np.pi) - np.pi)
