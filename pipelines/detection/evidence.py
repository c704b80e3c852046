"""What the beams towards and about a group show, at whatever depth they end.

Hides how the beams of a direction are found. A ball on a pole stops the beams that are aimed at it
and lets pass those beside it: a rock, a head or a crown of leaves does not.
"""

from __future__ import annotations

from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.detection.cells import (
    N_DIRECTIONS,
    N_DIRECTIONS_SIDE,
    direction_cells,
    rows_in,
)
from spheremark.pipelines.detection.target import Ball, blur_at, rays_of, seen_from, view_of
from spheremark.pipelines.model import Array, Column, StitchedCloud
from spheremark.pipelines.threads import side_by_side

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

_Groups = tuple[NDArray[np.int64], NDArray[np.int32]]  # where each one's begin, and what they hold


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
        How these beams pass the centre, as ``passing`` says [m].
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
        """
        n_nearer_max = _UNSEEN * (1 + self.n_past)
        return self.n_held <= 1 + self.n_past and self.n_short <= n_nearer_max

    @property
    def shows_below(self) -> bool:
        """Tell whether most beams below it, beside a pole's place, are seen to go on past it."""
        return self.n_past > 2 and self.n_past > self.n_held + self.n_short

    @property
    def n_aimed(self) -> int:
        """Count the beams that would have met the ball if nothing were nearer."""
        return self.n_on + self.n_before


def sights(
    cloud: StitchedCloud, directions: NDArray[np.uint16], centres: Array, ball: Ball
) -> list[Sight]:
    """Count the beams towards and about some centres by where they end."""
    if not len(centres):
        return []
    starts, owners = _centres_by_direction(centres, ball.up, (_REACH + 0.5) * ball.radius + 0.05)
    is_wanted, cones = starts[1:] > starts[:-1], _cones(centres, ball)

    def towards(first: int, end: int) -> _Groups:
        rows, own = rows_in(directions, is_wanted, first, end)
        groups: _Groups = _towards(cloud.p_base, rows, own, starts, owners, cones)
        return groups

    parts = side_by_side(towards, len(directions))

    def counted(first: int, end: int) -> list[Sight]:
        found = []
        for i in range(first, end):
            rows = np.concatenate([rows[begin[i] : begin[i + 1]] for begin, rows in parts])
            fields = _counted(cloud.p_base, cloud.intensities, rows, centres[i], ball)
            found.append(Sight(*fields))
        return found

    return list(chain(*side_by_side(counted, len(centres), worth=4)))


def _cones(centres: Array, ball: Ball) -> Array:
    """Return the cones that are looked at, (k, 4).

    Their axes, not of unit length; and the square of how far a unit vector at the edge of one goes
    along its axis, in the axis's own length.
    """
    distances2 = np.sum(centres**2, axis=1)
    tangents = _REACH * ball.radius / np.sqrt(distances2) + 0.5 * ball.divergence
    return np.column_stack([centres, distances2 / (1.0 + tangents**2)])


@compiled
def _counted(
    p_base: Column, intensities: Column, rows: NDArray[np.int32], c: Array, ball: Ball
) -> tuple[int, int, int, float, int, int, int, float, int, NDArray[np.int32], Array]:
    """Return the fields of a sight, from its returns."""
    radius = ball.radius
    blur = blur_at(c, ball) / radius
    seen = seen_from(rays_of(p_base, rows), view_of(c, ball.up))
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


@compiled
def _lit_share(inside: float) -> float:
    """Return what share of a beam is inside an outline that it enters by so many half widths."""
    inside = min(max(inside, -1.0), 1.0)
    return float((np.arccos(-inside) + inside * np.sqrt(1.0 - inside * inside)) / np.pi)


@compiled
def _towards(
    p_base: Column,
    rows: NDArray[np.int32],
    directions: NDArray[np.int32],
    starts: NDArray[np.int64],
    owners: NDArray[np.int32],
    cones: Array,
) -> _Groups:
    """Return which of some rows lie in each cone: where those of each begin, and the rows."""
    n = 0
    for cell in directions:
        n += starts[cell + 1] - starts[cell]
    near, whose = np.empty(n + 1, np.int32), np.empty(n + 1, np.int32)
    n = 0
    for j in range(len(rows)):
        row, cell = rows[j], directions[j]
        x, y, z = p_base[row, 0], p_base[row, 1], p_base[row, 2]
        for i in range(starts[cell], starts[cell + 1]):
            owner = owners[i]
            along = cones[owner, 0] * x + cones[owner, 1] * y + cones[owner, 2] * z
            near[n], whose[n] = row, owner  # kept only if the next one does not take its place
            n += along > 0.0 and along * along > cones[owner, 3] * (x * x + y * y + z * z)
    groups: _Groups = _grouped(near[:n], whose[:n], len(cones))
    return groups


@compiled
def _centres_by_direction(centres: Array, up: Array, reach: float) -> _Groups:
    """Return the centres that beams in each cell of directions may pass within a reach.

    Where those of each cell begin, and the centres.
    """
    sides = np.empty(len(centres), np.int64)
    for k in range(len(centres)):
        n_fine = 1.5 * reach * N_DIRECTIONS_SIDE / np.sqrt(np.sum(centres[k] ** 2))
        sides[k] = 2 * (2 + int(max(n_fine, reach / _STEP))) + 1
    owners = np.empty(np.sum(np.minimum(sides**2, N_DIRECTIONS)), np.int32)
    cells = np.empty(len(owners), np.uint16)
    latest = np.full(N_DIRECTIONS, -1, np.int64)
    n = 0
    for k in range(len(centres)):
        for cell in _directions_about(centres[k], up, reach, sides[k]):
            if latest[cell] != k:
                latest[cell], cells[n], owners[n] = k, cell, k
                n += 1
    groups: _Groups = _grouped(owners[:n], cells[:n], N_DIRECTIONS)
    return groups


@compiled
def _directions_about(c: Array, up: Array, reach: float, n: int) -> NDArray[np.uint16]:
    """Return the cells of directions about a centre on a lattice, so many each way."""
    v_across = np.cross(up, c)
    v_across *= reach / (np.sqrt(np.sum(v_across**2)) + 1e-12)
    xyz, cells, half = np.empty((3, n), np.float32), np.empty((n, n), np.uint16), n // 2
    for i in range(n):
        for j in range(n):
            for axis in range(3):
                aside = (i - half) * v_across[axis] + (j - half) * reach * up[axis]
                xyz[axis, j] = c[axis] + aside / half
        direction_cells(xyz[0], xyz[1], xyz[2], cells[i])
    return cells.reshape(-1)


@compiled
def _grouped(items: NDArray[np.int32], groups: NDArray[np.integer], n_groups: int) -> _Groups:
    """Sort items by group, by counting: where those of each group begin, and the items."""
    starts = np.zeros(n_groups + 2, np.int64)  # of the group before, until they have moved on
    for group in groups:
        starts[group + 2] += 1
    for i in range(n_groups):
        starts[i + 2] += starts[i + 1]
    grouped = np.empty_like(items)
    for i in range(len(items)):
        group_before = groups[i] + 1
        grouped[starts[group_before]] = items[i]
        starts[group_before] += 1
    return starts[:-1], grouped
