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
def view(points: Array, c: Array, up: Array) -> tuple[Array, Array, Array]:
    """Return points as seen toward a centre.

    Parameters
    ----------
    points : (n, 3)
        Returns in the base frame [m].
    c : (3,)
        The centre [m].
    up : (3,)
        Upward unit vector.

    Returns
    -------
    seen : (n, 3)
        Where each beam passes the centre, across and up, and how much farther than that its return
        lies [m].
    v_across, v_up : (3,)
        Unit vectors across the view.
    """
    v_beam = c / np.linalg.norm(c)
    v_up = up - np.dot(up, v_beam) * v_beam
    v_up /= np.linalg.norm(v_up) + 1e-12
    v_across = np.cross(v_up, v_beam)
    seen = np.empty((len(points), 3))
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        observed2 = x * x + y * y + z * z
        share = (c[0] * x + c[1] * y + c[2] * z) / observed2
        dx, dy, dz = share * x - c[0], share * y - c[1], share * z - c[2]
        seen[i, 0] = dx * v_across[0] + dy * v_across[1] + dz * v_across[2]
        seen[i, 1] = dx * v_up[0] + dy * v_up[1] + dz * v_up[2]
        seen[i, 2] = np.sqrt(observed2) * (1.0 - share)
    return seen, v_across, v_up
