"""The last test: beams that pass below a ball on a pole go on past it.

Hides how the beams of a direction are found at whatever depth they end.
"""

from __future__ import annotations

import numba
import numpy as np

from pipelines.extraction.ball import Ball, view
from pipelines.extraction.looks import Look
from pipelines.threads import side_by_side
from pipelines.values import Array, Column, Mask

_N_FACE = 256  # cells along a face of the cube of directions: 0.45 deg
_N_SURE = 20  # returns that show a shape well enough to judge by it alone
_SHAPE_SURE = 0.05  # of the radius: a radius known that well tells a ball from a stone by itself


def grounded(p_base: Column, looks: list[Look], verdicts: list[str], ball: Ball) -> list[str]:
    """Refuse what rests on the ground: beams below a ball on a pole go on past it.

    A group that shows its shape well may have its lower half hidden by something nearer.

    Parameters
    ----------
    p_base : (n, 3) float32
        All returns of the stop [m].
    looks : list of Look
        What was seen.
    verdicts : list of str
        Why each is no marker; empty where it may be one.
    ball : Ball
        What is looked for.

    Returns
    -------
    list of str
        The same with more reasons.
    """
    open_cases = [look for look, reason in zip(looks, verdicts, strict=True) if not reason]
    if not open_cases:
        return verdicts
    centres = np.array([look.p_base for look in open_cases])
    is_wanted = _directions_about(centres, ball.up, 3.0 * ball.radius + 0.1)

    parts = side_by_side(
        lambda first, end: _in_directions(p_base[first:end], is_wanted), len(p_base)
    )
    points = np.concatenate(parts)
    return [
        reason or _resting(points, look, ball) for look, reason in zip(looks, verdicts, strict=True)
    ]


def _resting(points: Column, look: Look, ball: Ball) -> str:
    """Return why a group seems to rest on the ground; empty if it does not."""
    n_past, n_short = _beneath(points, look, ball)
    is_sure = look.n_points >= _N_SURE and look.sigma_radius < _SHAPE_SURE * ball.radius
    if is_sure or n_short <= 1 + n_past:
        return ""
    return (
        f"It rests on the ground: of {n_past + n_short} beams that pass below it beside a pole's "
        f"place, {n_short} end at its distance or nearer."
    )


def _beneath(points: Column, look: Look, ball: Ball) -> tuple[int, int]:
    """Count the returns below a group beside a pole's place: those past it, and the others."""
    c, radius = look.p_base, ball.radius
    distance = float(np.linalg.norm(c))
    blur = 0.5 * ball.divergence * distance
    reach = 2.8 * radius + blur
    seen, _, _ = view(_towards(points, c, reach / distance), c, ball.up)
    across, along, depth = np.abs(seen[:, 0]), seen[:, 1], seen[:, 2]
    is_below = (along < -0.3 * radius) & (across > 0.6 * radius + blur)
    is_below &= np.hypot(across, along) > 1.2 * radius + blur
    n_past = int(np.sum(is_below & (depth > 1.5 * radius)))
    return n_past, int(is_below.sum()) - n_past


@numba.njit(cache=True, nogil=True)
def _towards(points: Column, c: Array, tangent: float) -> Array:
    """Return the points that are seen within an angle, given by its tangent, of a centre."""
    x, y, z = c
    least = (x * x + y * y + z * z) / (1.0 + tangent * tangent)
    rows = np.empty(len(points), np.int32)
    n_rows = 0
    for i in range(len(points)):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        along = x * px + y * py + z * pz
        rows[n_rows] = i  # kept only if the next one does not take its place
        n_rows += along > 0.0 and along * along > least * (px * px + py * py + pz * pz)
    return points[rows[:n_rows]].astype(np.float64)


@numba.njit(cache=True, nogil=True)
def _directions_about(centres: Array, up: Array, reach: float) -> Mask:
    """Tell the cells of directions in which beams may pass some centres within a reach."""
    is_wanted = np.zeros(6 * _N_FACE * _N_FACE, np.bool_)
    n_steps = 2 + int(1.5 * reach * _N_FACE / np.sqrt(np.min(np.sum(centres**2, axis=1)) + 1e-9))
    for k in range(len(centres)):
        c = centres[k]
        v_across = np.cross(up, c)
        v_across *= reach / (np.sqrt(np.sum(v_across**2)) + 1e-12)
        for i in range(-n_steps, n_steps + 1):
            for j in range(-n_steps, n_steps + 1):
                q = c + (i / n_steps) * v_across + (j / n_steps) * reach * up
                is_wanted[_direction_cell(q[0], q[1], q[2])] = True
    return is_wanted


@numba.njit(cache=True, nogil=True)
def _in_directions(p_base: Column, is_wanted: Mask) -> Column:
    """Return the points, at whatever depth, in the cells that are wanted."""
    rows = np.empty(len(p_base), np.int32)
    n_rows = 0
    for i in range(len(p_base)):
        rows[n_rows] = i  # kept only if the next one does not take its place
        n_rows += is_wanted[_direction_cell(p_base[i, 0], p_base[i, 1], p_base[i, 2])]
    return p_base[rows[:n_rows]]


@numba.njit(cache=True, nogil=True)
def _direction_cell(x: float, y: float, z: float) -> int:
    """Return the cell of a direction on a cube of ``_N_FACE`` squared cells a face."""
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        face, first, second, largest = int(x > 0.0), y, z, ax
    elif ay >= az:
        face, first, second, largest = 2 + int(y > 0.0), x, z, ay
    else:
        face, first, second, largest = 4 + int(z > 0.0), x, y, az
    scale = 0.4999 * _N_FACE / max(largest, 1e-9)
    row, column = int(first * scale + 0.5 * _N_FACE), int(second * scale + 0.5 * _N_FACE)
    return (face * _N_FACE + row) * _N_FACE + column
