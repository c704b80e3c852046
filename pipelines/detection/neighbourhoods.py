"""The returns about some places.

Hides how neighbours are found: the returns in the cells about the seeds, sorted by cell.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.detection.cells import Cells, Layout, rows_by_cell
from spheremark.pipelines.detection.ground import N_BLOCK, ground_by_block, skin_of
from spheremark.pipelines.detection.target import rays_of
from spheremark.pipelines.model import Array, Column, Mask

_REACH = 4.5  # radii about a seed whose returns decide whether a sphere stands free there

_ROUNDED = 1e-4  # [m]: more than a cell's edge may be off by rounding


class SortedReturns(NamedTuple):
    """Returns sorted by cell, for the cells about the seeds.

    Attributes
    ----------
    starts : (n_side ** 2 + 2,)
        The returns of a cell are ``points[starts[cell]:starts[cell + 1]]``.
    points : (m, 3) float32
        The returns themselves [m].
    n_side : int
        Cells along one side.
    edge : float
        Edge of a cell [m].
    R_station_base : (3, 3)
        Levelling.
    reach : float
        Radius about a seed within which returns are used [m].
    planes : (k, k, 4)
        Planes of the ground by block of cells, as from ``ground_by_block``.
    skin : float
        Height above these up to which a return is ground, and is left out [m].
    """

    starts: NDArray[np.int64]
    points: Column
    n_side: int
    edge: float
    R_station_base: Array
    reach: float
    planes: Array
    skin: float


def returns_about(p_base: Column, cells: Cells, seeds: Array, radius: float) -> SortedReturns:
    """Return the returns about some places, by cell."""
    reach, layout = _REACH * radius, cells.layout
    margin = int(np.ceil(reach / layout.edge)) + 1
    is_wanted = _cells_about(layout, cells.R_station_base, seeds, margin)
    rows, starts = rows_by_cell(cells.ground, is_wanted)
    planes = ground_by_block(cells, seeds)
    R, skin = cells.R_station_base, skin_of(radius)
    return SortedReturns(starts, p_base[rows], layout.n_side, layout.edge, R, reach, planes, skin)


@compiled
def rays_near(nearby: SortedReturns, c: Array) -> Array:
    """Return the rays to the returns within reach of a place, but to no ground."""
    points, x, y, z, reach2 = nearby.points, c[0], c[1], c[2], nearby.reach**2
    plane = _plane_at(nearby, c)
    level = plane[0] * x + plane[1] * y + plane[2] * z + plane[3] - nearby.skin
    bottom, top = _span(nearby, nearby.R_station_base[0], c)
    low, high = _span(nearby, nearby.R_station_base[1], c)
    most = 0
    for row in range(bottom * nearby.n_side, (top + 1) * nearby.n_side, nearby.n_side):
        most += nearby.starts[row + high + 1] - nearby.starts[row + low]
    rows, n = np.empty(most, np.uint32), 0
    for row in range(bottom * nearby.n_side, (top + 1) * nearby.n_side, nearby.n_side):
        for i in range(nearby.starts[row + low], nearby.starts[row + high + 1]):
            p, q, r = points[i, 0] - x, points[i, 1] - y, points[i, 2] - z
            rows[n] = i  # overwritten by the next one unless counted
            is_above = plane[0] * p + plane[1] * q + plane[2] * r + level >= 0.0
            n += (p * p + q * q + r * r < reach2) & is_above
    rays: Array = rays_of(points, rows[:n])
    return rays


@compiled
def _plane_at(nearby: SortedReturns, c: Array) -> Array:
    """Return the plane of the ground in the block of a place."""
    half, last = nearby.n_side // 2, nearby.n_side - 1
    row = int(np.floor(_along(nearby.R_station_base[0], c) / nearby.edge)) + half
    column = int(np.floor(_along(nearby.R_station_base[1], c) / nearby.edge)) + half
    plane: Array = nearby.planes[
        min(max(row, 0), last) // N_BLOCK, min(max(column, 0), last) // N_BLOCK
    ]
    return plane


@compiled
def _span(nearby: SortedReturns, v_axis: Array, c: Array) -> tuple[int, int]:
    """Return the first and the last cell along an axis that may hold returns within reach."""
    place = _along(v_axis, c)
    reach, half = nearby.reach + _ROUNDED, nearby.n_side // 2
    first = int(np.floor((place - reach) / nearby.edge)) + half
    last = int(np.floor((place + reach) / nearby.edge)) + half
    return max(first, 0), min(last, nearby.n_side - 1)


@compiled
def _along(v_axis: Array, c: Array) -> float:
    """Return how far along an axis a place lies."""
    return float(v_axis[0] * c[0] + v_axis[1] * c[1] + v_axis[2] * c[2])


@compiled
def _cells_about(layout: Layout, R_station_base: Array, places: Array, margin: int) -> Mask:
    """Return which cells hold some places or lie within a margin; the cell beyond the grid not."""
    n_side, last = layout.n_side, layout.n_side - 1
    is_wanted = np.zeros(n_side * n_side + 1, np.bool_)
    for i in range(len(places)):
        x, y = _along(R_station_base[0], places[i]), _along(R_station_base[1], places[i])
        row = min(max(int(np.floor(x / layout.edge)) + n_side // 2, 0), last)
        column = min(max(int(np.floor(y / layout.edge)) + n_side // 2, 0), last)
        for k in range(max(row - margin, 0), min(row + margin, last) + 1):
            for m in range(max(column - margin, 0), min(column + margin, last) + 1):
                is_wanted[k * n_side + m] = True
    return is_wanted
