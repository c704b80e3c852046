"""What is looked for, and how beams pass it."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from pipelines.values import Array


class Ball(NamedTuple):
    """What is looked for: radius [m], upward unit vector, full width of the beams [rad]."""

    radius: float
    up: Array
    divergence: float


@numba.njit(cache=True, nogil=True, error_model="numpy")
def blur_at(c: Array, ball: Ball) -> float:
    """Return half the width of a beam at a place.

    Parameters
    ----------
    c : (3,)
        The place [m].
    ball : Ball
        What is looked for.

    Returns
    -------
    float
        By so much a beam that passes the ball may still touch it [m].
    """
    return float(0.5 * ball.divergence * np.sqrt(c[0] ** 2 + c[1] ** 2 + c[2] ** 2))


class View(NamedTuple):
    """A centre [m], and unit vectors across and up the view of it."""

    x: float
    y: float
    z: float
    across: tuple[float, float, float]
    up: tuple[float, float, float]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def view_of(c: Array, up: Array) -> View:
    """Return how a centre is looked at.

    Parameters
    ----------
    c : (3,)
        The centre [m].
    up : (3,)
        Upward unit vector.

    Returns
    -------
    View
        Axes of the view.
    """
    distance = np.sqrt(c[0] ** 2 + c[1] ** 2 + c[2] ** 2)
    x, y, z = c[0] / distance, c[1] / distance, c[2] / distance
    along = up[0] * x + up[1] * y + up[2] * z
    p, q, r = up[0] - along * x, up[1] - along * y, up[2] - along * z
    length = np.sqrt(p * p + q * q + r * r) + 1e-12
    p, q, r = p / length, q / length, r / length
    across = (q * z - r * y, r * x - p * z, p * y - q * x)
    return View(c[0], c[1], c[2], across, (p, q, r))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def passing(view: View, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return how the beam of a return passes a centre.

    Parameters
    ----------
    view : View
        How the centre is looked at.
    x, y, z : float
        The return [m].

    Returns
    -------
    across, along, depth : float
        Where the beam passes, across and up, and how much farther than that the return lies [m].
    """
    observed2 = x * x + y * y + z * z
    share = (view.x * x + view.y * y + view.z * z) / observed2
    dx, dy, dz = share * x - view.x, share * y - view.y, share * z - view.z
    across = dx * view.across[0] + dy * view.across[1] + dz * view.across[2]
    along = dx * view.up[0] + dy * view.up[1] + dz * view.up[2]
    return across, along, np.sqrt(observed2) * (1.0 - share)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def seen_from(points: Array, view: View) -> Array:
    """Return how the beams of some returns pass a centre.

    Parameters
    ----------
    points : (3, n)
        Returns in the base frame [m].
    view : View
        How the centre is looked at.

    Returns
    -------
    (3, n)
        As ``passing`` says.
    """
    seen = np.empty(points.shape)
    for i in range(points.shape[1]):
        seen[0, i], seen[1, i], seen[2, i] = passing(view, points[0, i], points[1, i], points[2, i])
    return seen
