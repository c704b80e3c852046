"""What the beams towards and about a group show, at whatever depth they end.

Hides how the beams of a direction are found. A ball on a pole stops the beams that are aimed at it
and lets pass those beside it: a rock, a head or a crown of leaves does not.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from pipelines.extraction.ball import Ball, seen_from, view_of
from pipelines.threads import side_by_side
from pipelines.values import Array, Column, Mask, StitchedCloud

_N_SIDE = 128  # cells along a side of the octahedron of directions: 0.5 to 1 deg
_STEP = 0.05  # [m] at most between the directions about a centre that are looked up
_BLOCK = 2048  # returns whose directions are found at once
_REACH = 4.0  # radii about a centre: shoulders lie within three radii below a head
_POLE = 0.5  # radii: half the width of what a ball may stand on
_ASIDE = 1.9  # radii: what is farther to a side may stand there on its own
_HELD = (-4.0, 1.5)  # radii of depth within which something belongs to what is looked at
_ON = (-1.3, 0.3)  # radii of depth within which a return may lie on the ball
_UNSEEN = 3.0  # as many beams below it that end nearer as that go past: no more is known


class Sight(NamedTuple):
    """Beams towards and about a group, counted by where they end.

    Attributes
    ----------
    n_on : int
        Returns inside the outline at the depth of the ball.
    n_through : int
        Returns well inside the outline that lie behind the ball.
    n_before : int
        Returns inside the outline that lie before the ball: beams that would have met it.
    spread : float
        Mean square of the distances from the centre at which the first ones pass it, in units of
        the radius squared: about a half for a ball of the known radius.
    n_held : int
        Returns below it, beside a pole's place, that lie about as far away.
    n_past : int
        Returns there that lie behind it.
    n_short : int
        Returns there that end long before it.
    brightness : float
        Mean reflectivity of the first ones, 0-255.
    rows : (m,) int32
        Returns of the cloud whose beams pass within four radii, ascending.
    """

    n_on: int
    n_through: int
    n_before: int
    spread: float
    n_held: int
    n_past: int
    n_short: int
    brightness: float
    rows: NDArray[np.int32]

    @property
    def is_open_below(self) -> bool:
        """Tell whether most beams below it, beside a pole's place, go on past it.

        Beams that something nearer stops show neither. If they are three in four, nothing is known:
        what lies behind a crest at its own foot shows no more.

        Returns
        -------
        bool
            False if they are stopped by what it rests on, or too many by something nearer.
        """
        n_nearer_max = _UNSEEN * (1 + self.n_past)
        return self.n_held <= 1 + self.n_past and self.n_short <= n_nearer_max

    @property
    def n_aimed(self) -> int:
        """Count the beams that would have met the ball if nothing were nearer.

        Returns
        -------
        int
            Those that end on it or before it.
        """
        return self.n_on + self.n_before


def sights(cloud: StitchedCloud, centres: Array, ball: Ball) -> list[Sight]:
    """Count the beams towards and about some centres by where they end.

    Parameters
    ----------
    cloud : StitchedCloud
        One stop.
    centres : (k, 3)
        Centres of groups that may be balls [m].
    ball : Ball
        What is looked for.

    Returns
    -------
    list of Sight
        What is seen of each.
    """
    if not len(centres):
        return []
    is_wanted = _directions_about(centres, ball.up, (_REACH + 0.5) * ball.radius + 0.05)
    parts = side_by_side(
        lambda first, end: _in_directions(cloud.p_base[first:end], is_wanted) + first,
        len(cloud.p_base),
    )
    rows = np.concatenate(parts)
    points, intensities = cloud.p_base[rows], cloud.intensities[rows]
    seen = [Sight(*_counted(points, intensities, centre, ball)) for centre in centres]
    return [sight._replace(rows=rows[sight.rows]) for sight in seen]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _counted(
    points: Column, intensities: Column, c: Array, ball: Ball
) -> tuple[int, int, int, float, int, int, int, float, NDArray[np.int32]]:
    """Return the fields of a sight."""
    radius, distance = ball.radius, np.sqrt(np.sum(c**2))
    blur = 0.5 * ball.divergence * distance / radius
    rows = _towards(points, c, (_REACH + blur) * radius / distance)
    seen = seen_from(points[rows].astype(np.float64), view_of(c, ball.up))
    n_on, n_through, n_before, n_held, n_past, n_short = 0, 0, 0, 0, 0, 0
    gaps2, light = 0.0, 0.0
    for i in range(len(seen)):
        across, along, depth = np.abs(seen[i, 0]) / radius, seen[i, 1] / radius, seen[i, 2] / radius
        gap = np.hypot(across, along)
        is_aimed = gap < 1.0 + blur and along > -0.9
        if is_aimed and _ON[0] < depth < _ON[1]:
            n_on += 1
            gaps2 += gap * gap
            light += intensities[rows[i]]
        n_before += is_aimed and depth <= _ON[0]
        n_through += gap < 0.8 and depth > 1.0
        is_below = along < -0.3 and gap > 1.2 + blur and _POLE + blur < across < _ASIDE + blur
        if is_below:
            n_past += depth > _HELD[1]
            n_short += depth < _HELD[0]
            n_held += _HELD[0] <= depth <= _HELD[1]
    n = max(n_on, 1)
    return n_on, n_through, n_before, gaps2 / n, n_held, n_past, n_short, light / n, rows


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _towards(points: Column, c: Array, tangent: float) -> NDArray[np.int32]:
    """Return the rows of the points within an angle, given by its tangent, of a centre."""
    x, y, z = c
    least = (x * x + y * y + z * z) / (1.0 + tangent * tangent)
    rows = np.empty(len(points), np.int32)
    n_rows = 0
    for i in range(len(points)):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        along = x * px + y * py + z * pz
        rows[n_rows] = i  # kept only if the next one does not take its place
        n_rows += along > 0.0 and along * along > least * (px * px + py * py + pz * pz)
    return rows[:n_rows]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _directions_about(centres: Array, up: Array, reach: float) -> Mask:
    """Tell the cells of directions in which beams may pass some centres within a reach."""
    is_wanted = np.zeros(2 * _N_SIDE * _N_SIDE, np.bool_)
    xyz, cell = np.empty((3, 1), np.float32), np.empty(1, np.int32)
    for k in range(len(centres)):
        c = centres[k]
        v_across = np.cross(up, c)
        v_across *= reach / (np.sqrt(np.sum(v_across**2)) + 1e-12)
        n_steps = 2 + int(max(1.5 * reach * _N_SIDE / np.sqrt(np.sum(c**2)), reach / _STEP))
        for i in range(-n_steps, n_steps + 1):
            for j in range(-n_steps, n_steps + 1):
                for axis in range(3):
                    aside = i * v_across[axis] + j * reach * up[axis]
                    xyz[axis, 0] = c[axis] + aside / n_steps
                _direction_cells(xyz[0], xyz[1], xyz[2], cell)
                is_wanted[cell[0]] = True
    return is_wanted


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _in_directions(p_base: Column, is_wanted: Mask) -> NDArray[np.int32]:
    """Return the rows of the points, at whatever depth, in the cells that are wanted."""
    rows = np.empty(len(p_base), np.int32)
    cells = np.empty(_BLOCK, np.int32)
    xyz = np.empty((3, _BLOCK), np.float32)
    n_rows = 0
    for low in range(0, len(p_base), _BLOCK):
        points = p_base[low : low + _BLOCK]
        n = len(points)
        for i in range(n):
            xyz[0, i], xyz[1, i], xyz[2, i] = points[i, 0], points[i, 1], points[i, 2]
        _direction_cells(xyz[0, :n], xyz[1, :n], xyz[2, :n], cells)
        for i in range(n):
            rows[n_rows] = low + i  # kept only if the next one does not take its place
            n_rows += is_wanted[cells[i]]
    return rows[:n_rows]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _direction_cells(x: Column, y: Column, z: Column, cells: NDArray[np.int32]) -> None:
    """Write the cells of some directions: the octahedron seen from above and from below.

    A return that is none gets any cell: the angle refuses it later.
    """
    half, side = np.float32(0.4999 * _N_SIDE), np.int32(_N_SIDE)
    for i in range(len(x)):
        total = abs(x[i]) + abs(y[i]) + abs(z[i])
        scale = half / total if (total > 0.0) & (total < np.inf) else np.float32(0.0)
        row, column = np.int32(x[i] * scale + half), np.int32(y[i] * scale + half)
        cell = (row + (side if z[i] > 0.0 else np.int32(0))) * side + column
        cells[i] = cell if scale > 0.0 else np.int32(0)
