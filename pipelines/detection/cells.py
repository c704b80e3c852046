"""Cells of the level ground and sectors about the gimbal's axis: where each return of a stop lies.

Hides the one pass over all returns. Later steps select returns by these, which takes a small part
of the time that computing with coordinates takes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.config import ExtractionConfig
from spheremark.pipelines.geometry import levelling_rotation
from spheremark.pipelines.model import Array, Column, Mask, StitchedCloud
from spheremark.pipelines.threads import side_by_side

N_SECTORS = 512
"""Sectors of azimuth: 0.6 to 0.9 deg."""


class Layout(NamedTuple):
    """The grid: cells along one side, edge of a cell [m], how far it reaches [m]."""

    n_side: int
    edge: float
    reach: float


class Cells(NamedTuple):
    """Each return's cell and sector, and how low returns lie in the cells.

    Attributes
    ----------
    layout : Layout
        The grid of the ground.
    R_station_base : (3, 3)
        Levelling.
    ground : (n,) int32
        Cell of each return on the level ground; ``n_side ** 2`` beyond the grid.
    sectors : (n,) uint16
        Sector of each return; any one for a return that is not finite.
    lowest : (n_side, n_side) float32
        Levelled height of the lowest return per cell; infinite without any [m].
    """

    layout: Layout
    R_station_base: Array
    ground: NDArray[np.int32]
    sectors: NDArray[np.uint16]
    lowest: Column


def cells_of(cloud: StitchedCloud, config: ExtractionConfig) -> Cells:
    """Sort returns into cells."""
    n = len(cloud.p_base)
    n_side = 2 * int(np.ceil(config.range_max / config.ground_cell))
    layout = Layout(n_side, config.ground_cell, config.range_max)
    R = levelling_rotation(cloud.levelling)
    ground, sectors = np.empty(n, np.int32), np.empty(n, np.uint16)
    parts = side_by_side(
        lambda first, end: _sort(
            cloud.p_base[first:end],
            R.astype(np.float32),
            layout,
            ground[first:end],
            sectors[first:end],
        ),
        n,
    )
    lowest = np.minimum.reduce(parts)[:-1].reshape(n_side, n_side)
    return Cells(layout, R, ground, sectors, lowest)


def rows_by_cell(
    cells: NDArray[np.integer], is_wanted: Mask
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the returns in the wanted cells by cell, and the start of those of every cell."""
    rows = np.flatnonzero(is_wanted[cells])
    own = cells[rows]
    starts = np.append(0, np.cumsum(np.bincount(own, minlength=len(is_wanted))))
    return rows[np.argsort(own, kind="stable")], starts


@compiled
def sector_of(x: float, y: float) -> int:
    """Return the sector of a direction: by its place on a square about the axis."""
    total = abs(x) + abs(y)
    if not 0.0 < total < np.inf:
        return 0
    turned = 1.0 + y / total if x > 0.0 else 3.0 - y / total
    return int(turned * (0.25 * N_SECTORS)) % N_SECTORS


@compiled
def _sort(
    p_base: Column,
    R: Column,
    layout: Layout,
    ground: NDArray[np.int32],
    sectors: NDArray[np.uint16],
) -> Column:
    """Write each return's cell and sector; return the levelled height of the lowest per cell."""
    n_side = layout.n_side
    beyond, per_edge = n_side * n_side, np.float32(1.0 / layout.edge)
    half, reach = np.float32(0.5 * n_side), np.float32(layout.reach)
    lowest = np.full(beyond + 1, np.inf, np.float32)
    for i in range(len(p_base)):
        p, q, r = p_base[i, 0], p_base[i, 1], p_base[i, 2]
        x = R[0, 0] * p + R[0, 1] * q + R[0, 2] * r
        y = R[1, 0] * p + R[1, 1] * q + R[1, 2] * r
        z = R[2, 0] * p + R[2, 1] * q + R[2, 2] * r
        cell = beyond
        if x * x + y * y < reach * reach and abs(z) < reach:
            row, column = int(x * per_edge + half), int(y * per_edge + half)
            cell = min(row, n_side - 1) * n_side + min(column, n_side - 1)
        ground[i], sectors[i] = cell, sector_of(p, q)
        lowest[cell] = min(lowest[cell], z)
    return lowest
