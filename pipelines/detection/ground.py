"""The ground of a stop: an opened grid of lowest points, unknown where none was seen."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.config import ExtractionConfig
from spheremark.pipelines.detection.cells import Cells
from spheremark.pipelines.estimation.linear_algebra import invert
from spheremark.pipelines.model import Array, Column, Mask, StitchedCloud
from spheremark.pipelines.threads import side_by_side

N_BLOCK = 4
"""Cells along a side of the blocks that have one plane of the ground each."""

_FIELD = 10.0  # [m] from the station: where the published method takes the highest ground point
_WINDOW = 9  # cells along a side of the opening: smaller rocks are not ground
_STEP = 0.10  # [m] that a cell's lowest point may lie above the opened surface
_CELLS_MIN = 9  # a marker seen alone covers at most 6 cells: that is not yet ground
_RISE = 0.15  # [m] that ground may rise above its cell of the opened grid: tops of mounds
_AROUND = 24  # cells each way about a place whose ground may show its height
_ROUGH, _SLOPE, _TILT = 0.05, 0.05, 0.2  # [m] of the ground, how it bends away, tangent of tilts
_SMOOTH = 0.01  # [m] least roughness: lowest points of cells scatter so on a plane floor
_SKIN, _SKIN_MAX = 0.3, 0.03  # radii, and [m]: ground is that rough, spheres begin higher
_LOW, _REACHES = 0.2, (0.8, 0.4, 0.2, 0.2)  # share of cells, and heights [m], that may be ground


def skin_of(radius: float) -> float:
    """Return how far above the plane of the ground a return counts as ground [m]."""
    return min(_SKIN * radius, _SKIN_MAX)


class Ground(NamedTuple):
    """Which returns rise above the ground.

    Attributes
    ----------
    points_above : (m, 3) float32
        Returns that are not known to be ground [m].
    height_max : float
        Highest ground return within 10 m, levelled [m].
    """

    points_above: Column
    height_max: float


def ground_of(cloud: StitchedCloud, cells: Cells, config: ExtractionConfig) -> Ground:
    """Return which returns rise above the ground, and how high the ground is."""
    heights = np.append(_ground(cells.lowest), np.float32(np.nan))  # nothing is known beyond
    parts = side_by_side(
        lambda first, end: _above(
            cloud.p_base[first:end],
            cells.R_station_base[2],
            heights[cells.ground[first:end]],
            config.ground_clearance,
        ),
        len(cloud.p_base),
    )
    is_above = np.concatenate([mask for mask, _ in parts])
    return Ground(cloud.p_base[is_above], max(highest for _, highest in parts))


def planes_below(cells: Cells, places: Array) -> Array:
    """Return the planes of the ground about some places, (n, 5).

    The height of a point p of the base frame above one is ``plane[:3] @ p + plane[3]`` [m], its
    standard deviation at the place ``plane[4]``; both are infinite where too little ground is seen.
    """
    n_side, edge, _ = cells.layout
    R, levelled = cells.R_station_base, places @ cells.R_station_base.T
    heights, slopes, sigmas = np.split(
        _planes_below(cells.lowest, n_side, edge, levelled), [1, 3], 1
    )
    planes = np.empty((len(places), 5))
    planes[:, :3] = R[2] - slopes @ R[:2]
    planes[:, 3] = np.sum(slopes * levelled[:, :2], axis=1) - heights[:, 0]
    planes[:, 4] = sigmas[:, 0]
    planes[np.isinf(sigmas[:, 0]), 3] = np.inf
    return planes


def ground_by_block(cells: Cells, places: Array) -> Array:
    """Return the planes of the ground about some places by block of cells, (k, k, 4).

    As those of ``planes_below``; offsets are infinite in all other blocks.
    """
    n_side, edge, _ = cells.layout
    planes = np.zeros((n_side // N_BLOCK + 1, n_side // N_BLOCK + 1, 4))
    planes[:, :, 3] = np.inf
    levelled = places @ cells.R_station_base.T
    aside = 0.5 * N_BLOCK * edge * np.array([[i, j, 0] for i in (-1, 0, 1) for j in (-1, 0, 1)])
    blocks = _blocks(levelled[:, None] + aside, n_side, edge).reshape(-1, 2)
    blocks = np.unique(blocks, axis=0)
    middles = np.zeros((len(blocks), 3))
    middles[:, :2] = ((blocks + 0.5) * N_BLOCK - n_side // 2) * edge
    planes[tuple(blocks.T)] = planes_below(cells, middles @ cells.R_station_base)[:, :4]
    return planes


def _blocks(levelled: Array, n_side: int, edge: float) -> NDArray[np.intp]:
    """Return the blocks of cells that hold some places."""
    cells = np.floor(levelled[..., :2] / edge).astype(np.intp) + n_side // 2
    return np.clip(cells, 0, n_side - 1) // N_BLOCK


@compiled
def _planes_below(lowest: Column, n_side: int, edge: float, places: Array) -> Array:
    """Return heights of the ground below some levelled places, slopes, and sigmas, (n, 4)."""
    found, most = np.zeros((len(places), 4)), (2 * _AROUND + 1) ** 2
    x, y, z = np.empty(most), np.empty(most), np.empty(most)
    found[:, 3] = np.inf
    for i in range(len(places)):
        row = int(np.floor(places[i, 0] / edge)) + n_side // 2
        column = int(np.floor(places[i, 1] / edge)) + n_side // 2
        n = 0
        for j in range(max(row - _AROUND, 0), min(row + _AROUND + 1, n_side)):
            for k in range(max(column - _AROUND, 0), min(column + _AROUND + 1, n_side)):
                if lowest[j, k] < np.inf:
                    x[n] = (j + 0.5 - n_side // 2) * edge - places[i, 0]
                    y[n] = (k + 0.5 - n_side // 2) * edge - places[i, 1]
                    z[n] = lowest[j, k]
                    n += 1
        if n >= _CELLS_MIN:
            _plane_below(x[:n], y[:n], z[:n], found[i])
    return found


@compiled
def _plane_below(x: Array, y: Array, z: Array, plane: Array) -> None:
    """Write the height of the ground at the origin by a plane through lowest points, and sigma.

    What stands on the ground is left out step by step, from a low level plane on.
    """
    N, rhs, rough = np.zeros((3, 3)), np.zeros(3), _ROUGH
    plane[0] = np.quantile(z, _LOW)
    for reach in _REACHES:
        N[:], rhs[:] = 0.0, 0.0
        N[0, 0], N[1, 1], N[2, 2] = 1e-6, _TILT**-2.0, _TILT**-2.0
        total, squares = 1e-6, 0.0
        for i in range(len(x)):
            off = z[i] - plane[0] - plane[1] * x[i] - plane[2] * y[i]
            if abs(off) < reach:
                weight = (_ROUGH + _SLOPE * np.sqrt(x[i] * x[i] + y[i] * y[i])) ** -2.0
                row = (1.0, x[i], y[i])
                total, squares = total + weight, squares + weight * off * off
                for j in range(3):
                    rhs[j] += weight * row[j] * z[i]
                    for k in range(3):
                        N[j, k] += weight * row[j] * row[k]
        invert(N, N)
        for j in range(3):
            plane[j] = N[j, 0] * rhs[0] + N[j, 1] * rhs[1] + N[j, 2] * rhs[2]
        rough = max(np.sqrt(squares / total), _SMOOTH)
    plane[3] = np.sqrt(rough * rough + _CELLS_MIN * N[0, 0])


def _n_about(mask: Mask) -> Array:
    """Return how many cells of a mask are set in the window about each cell."""
    from scipy import ndimage  # slow to import

    counts: Array = ndimage.uniform_filter(mask.astype(np.float64), _WINDOW, mode="constant")
    return np.round(counts * _WINDOW**2)


def _ground(lowest: Column) -> Column:
    """Return the ground's height per cell; infinite where no ground was seen in or beside it.

    By the morphological opening of the lowest points. A cell has ground where its lowest point lies
    near the opened surface and enough others around do too: a marker behind a rock has no ground
    around it, and must not become ground itself, nor must a window that sees nothing else.
    """
    from scipy import ndimage  # slow to import

    eroded = ndimage.minimum_filter(lowest, _WINDOW, mode="constant", cval=np.inf)
    eroded[_n_about(lowest < np.inf) < _CELLS_MIN] = -np.inf
    opened = ndimage.maximum_filter(eroded, _WINDOW, mode="constant", cval=-np.inf)
    is_low = lowest < opened + np.float32(_STEP)
    low = np.where(is_low, lowest, np.float32(-np.inf))
    highest = ndimage.maximum_filter(low, 3, mode="constant", cval=-np.inf)
    is_ground = (highest > -np.inf) & (_n_about(is_low) >= _CELLS_MIN)
    return np.where(is_ground, highest, np.float32(np.inf))


@compiled
def _above(p_base: Column, v_up: Array, ground: Column, clearance: float) -> tuple[Mask, float]:
    """Return which returns are not known to be ground, and the highest ground in the field.

    ``ground`` holds the height of the ground below each: infinite where none was seen.
    """
    is_above, highest = np.zeros(len(p_base), np.bool_), -np.inf
    for i in range(len(p_base)):
        x, y, z = p_base[i, 0], p_base[i, 1], p_base[i, 2]
        height = np.float32(v_up[0] * x + v_up[1] * y + v_up[2] * z)
        over = height - ground[i]
        is_above[i] = (over > clearance) | (ground[i] == np.inf)
        is_field = x * x + y * y < _FIELD**2
        if is_field and -np.inf < over < _RISE and height > highest:
            highest = float(height)
    return is_above, highest
