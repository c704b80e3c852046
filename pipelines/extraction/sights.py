"""What the beams towards and about a group show, at whatever depth they end.

Hides how the beams of a direction are found. A ball on a pole stops the beams that are aimed at it
and lets pass those beside it: a rock, a head or a crown of leaves does not.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from pipelines.extraction.ball import Ball, blur_at, seen_from, view_of
from pipelines.extraction.cells import (
    N_DIRECTIONS,
    N_DIRECTIONS_SIDE,
    by_cell,
    direction_cells,
    rows_in,
)
from pipelines.values import Array, Column, Mask, StitchedCloud

_STEP = 0.05  # [m] at most between the directions about a centre that are looked up
_REACH = 4.0  # radii about a centre: shoulders lie within three radii below a head
_POLE = 0.5  # radii: half the width of what a ball may stand on
_ASIDE = 1.9  # radii: what is farther to a side may stand there on its own
_HELD = (-4.0, 1.5)  # radii of depth within which something belongs to what is looked at
_ON = (-1.3, 0.3)  # radii of depth within which a return may lie on the ball
_PLACE = 0.1  # radii: what passes nearer to another beam than this passes at the same place
_MEAN_WIDTH = 0.75  # of the greater half width of a beam: in any direction
_TINY = 1e-6
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
        Reflectivity of what the first ones lie on, 0-255: theirs by the shares of their beams that
        are inside the outline, by least squares.
    n_distinct : int
        Places, a tenth of the radius wide, where the first ones pass the centre: beams that are
        repeated tell little that is new.
    rows : (m,) int32
        Returns of the cloud whose beams pass within four radii, ascending.
    seen : (3, m)
        How these beams pass the centre, as ``passing`` says, in any order [m].
    """

    n_on: int
    n_through: int
    n_before: int
    spread: float
    n_held: int
    n_past: int
    n_short: int
    brightness: float
    n_distinct: int
    rows: NDArray[np.int32]
    seen: Array

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
    def shows_below(self) -> bool:
        """Tell whether most beams below it, beside a pole's place, are seen to go on past it.

        Returns
        -------
        bool
            False also where no beam returns from there: against the sky, or before a shadow.
        """
        return self.n_past > 2 and self.n_past > self.n_held + self.n_short

    @property
    def n_aimed(self) -> int:
        """Count the beams that would have met the ball if nothing were nearer.

        Returns
        -------
        int
            Those that end on it or before it.
        """
        return self.n_on + self.n_before


def sights(
    cloud: StitchedCloud, directions: NDArray[np.uint16], centres: Array, ball: Ball
) -> list[Sight]:
    """Count the beams towards and about some centres by where they end.

    Parameters
    ----------
    cloud : StitchedCloud
        One stop.
    directions : (n,) uint16
        Cells of its returns' directions.
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
    reach = (_REACH + 0.5) * ball.radius + 0.05
    is_wanted = np.array([_directions_about(centre, ball.up, reach) for centre in centres])
    rows = rows_in(directions, np.logical_or.reduce(is_wanted))
    starts, places = by_cell(directions, rows, N_DIRECTIONS)
    rows[places] = rows.copy()
    points, intensities = cloud.p_base.take(rows, axis=0), cloud.intensities.take(rows)
    near = [_runs(starts, np.flatnonzero(mine)) for mine in is_wanted]
    seen = [
        Sight(*_counted(points, intensities, mine, centre, ball))
        for mine, centre in zip(near, centres, strict=True)
    ]
    return [sight._replace(rows=np.sort(rows[sight.rows])) for sight in seen]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _counted(
    points: Column, intensities: Column, near: NDArray[np.int32], c: Array, ball: Ball
) -> tuple[int, int, int, float, int, int, int, float, int, NDArray[np.int32], Array]:
    """Return the fields of a sight, from the returns near its direction."""
    radius, distance = ball.radius, np.sqrt(np.sum(c**2))
    blur = blur_at(c, ball) / radius
    rows = _towards(points, near, c, (_REACH + blur) * radius / distance)
    seen = seen_from(points[rows].T.astype(np.float64), view_of(c, ball.up))
    n_on, n_through, n_before, n_held, n_past, n_short = 0, 0, 0, 0, 0, 0
    gaps2, light, lit = 0.0, 0.0, 0.0
    half = int((1.0 + blur) / _PLACE) + 1
    is_met = np.zeros((2 * half, 2 * half), np.bool_)
    for i in range(len(rows)):
        across, along, depth = np.abs(seen[0, i]) / radius, seen[1, i] / radius, seen[2, i] / radius
        gap = np.hypot(across, along)
        is_aimed = gap < 1.0 + blur and along > -0.9
        if is_aimed and _ON[0] < depth < _ON[1]:
            n_on += 1
            gaps2 += gap * gap
            column = half + int(np.floor(seen[0, i] / radius / _PLACE))
            is_met[column, half + int(np.floor(along / _PLACE))] = True
            share = _lit_share((1.0 - gap) / (_MEAN_WIDTH * blur))
            light += share * intensities[rows[i]]
            lit += share * share
        n_before += is_aimed and depth <= _ON[0]
        n_through += gap < 0.8 and depth > 1.0
        is_below = along < -0.3 and gap > 1.2 + blur and _POLE + blur < across < _ASIDE + blur
        if is_below:
            n_past += depth > _HELD[1]
            n_short += depth < _HELD[0]
            n_held += _HELD[0] <= depth <= _HELD[1]
    spread, brightness = gaps2 / max(n_on, 1), light / max(lit, _TINY)
    counts = (n_on, n_through, n_before, spread, n_held, n_past, n_short)
    return (*counts, brightness, int(np.sum(is_met)), rows, seen)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _lit_share(inside: float) -> float:
    """Return what share of a beam is inside an outline that it enters by so many half widths."""
    inside = min(max(inside, -1.0), 1.0)
    return float((np.arccos(-inside) + inside * np.sqrt(1.0 - inside * inside)) / np.pi)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _towards(
    points: Column, near: NDArray[np.int32], c: Array, tangent: float
) -> NDArray[np.int32]:
    """Return which of some rows are within an angle, given by its tangent, of a centre."""
    x, y, z = c
    least = (x * x + y * y + z * z) / (1.0 + tangent * tangent)
    rows = np.empty(len(near) + 1, np.int32)
    n_rows = 0
    for i in near:
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        along = x * px + y * py + z * pz
        rows[n_rows] = i  # kept only if the next one does not take its place
        n_rows += along > 0.0 and along * along > least * (px * px + py * py + pz * pz)
    return rows[:n_rows]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _runs(starts: NDArray[np.int64], cells: NDArray[np.int64]) -> NDArray[np.int32]:
    """Return the places of all that lies in some cells."""
    n = 0
    for cell in cells:
        n += starts[cell + 1] - starts[cell]
    places = np.empty(n, np.int32)
    n = 0
    for cell in cells:
        for i in range(starts[cell], starts[cell + 1]):
            places[n] = i
            n += 1
    return places


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _directions_about(c: Array, up: Array, reach: float) -> Mask:
    """Tell the cells of directions in which beams may pass a centre within a reach."""
    is_wanted = np.zeros(N_DIRECTIONS, np.bool_)
    v_across = np.cross(up, c)
    v_across *= reach / (np.sqrt(np.sum(v_across**2)) + 1e-12)
    n_fine = 1.5 * reach * N_DIRECTIONS_SIDE / np.sqrt(np.sum(c**2))
    n_steps = 2 + int(max(n_fine, reach / _STEP))
    n = 2 * n_steps + 1
    xyz, cells = np.empty((3, n), np.float32), np.empty(n, np.uint16)
    for i in range(n):
        for j in range(n):
            for axis in range(3):
                aside = (i - n_steps) * v_across[axis] + (j - n_steps) * reach * up[axis]
                xyz[axis, j] = c[axis] + aside / n_steps
        direction_cells(xyz[0], xyz[1], xyz[2], cells)
        for cell in cells:
            is_wanted[cell] = True
    return is_wanted
