"""The ground of a stop: an opened grid of lowest points, unknown where none was seen."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spheremark.pipelines.config import ExtractionConfig
from spheremark.pipelines.detection.cells import Cells
from spheremark.pipelines.model import Array, Column, Mask, StitchedCloud

_FIELD = 10.0  # [m] from the station: where the published method takes the highest ground point
_WINDOW = 9  # cells along a side of the opening: smaller rocks are not ground
_STEP = 0.10  # [m] that a cell's lowest point may lie above the opened surface
_CELLS_MIN = 9  # a marker seen alone covers at most 6 cells: that is not yet ground
_RISE = 0.15  # [m] that ground may rise above its cell of the opened grid: tops of mounds
_AROUND = 24  # cells each way about a place whose ground may show its height
_N_NEAREST = 40  # of these that do: ground a metre about it, where all cells are seen
_ROUGH, _SLOPE, _TILT = 0.05, 0.05, 0.2  # [m] of the ground, how it bends away, tangent of tilts
_SMOOTH = 0.01  # [m] least roughness: lowest points of cells scatter so on a plane floor


class Ground(NamedTuple):
    """Which returns rise above the ground.

    Attributes
    ----------
    points_above : (m, 3) float32
        Returns that are not known to be ground [m].
    height_max : float
        Highest ground return within 10 m, levelled [m].
    lowest : (n_side, n_side) float32
        Levelled height of the lowest return of each cell of ground; infinite in others [m].
    """

    points_above: Column
    height_max: float
    lowest: Column


def ground_of(
    cloud: StitchedCloud, cells: Cells, config: ExtractionConfig, radius: float
) -> Ground:
    """Return which returns rise above the ground, and how high the ground is."""
    from scipy import ndimage  # slow to import

    lowest = _opened(cells.lowest)
    known = np.where(lowest < np.inf, lowest, -np.inf)  # what is above nothing known is kept
    known = ndimage.maximum_filter(known, 3, mode="constant", cval=-np.inf)
    over = cells.heights - np.append(known, np.float32(np.nan))[cells.ground]
    is_field = cloud.p_base[:, 0] ** 2 + cloud.p_base[:, 1] ** 2 < _FIELD**2
    highest = cells.heights[is_field & (over < _RISE)].max(initial=-np.inf)
    clearance = np.clip(radius, 0.5 * config.ground_clearance, config.ground_clearance)
    return Ground(cloud.p_base[over > clearance], float(highest), lowest)


def planes_below(ground: Ground, cells: Cells, places: Array) -> Array:
    """Return the planes of the ground about some places, (n, 5), each by the cells nearest to it.

    The height of a point p of the base frame above one is ``plane[:3] @ p + plane[3]`` [m], its
    standard deviation at the place ``plane[4]``; both are infinite where too little ground is seen.
    """
    R, edge, n_side = cells.R_station_base, cells.edge, len(ground.lowest)
    planes = np.tile((*R[2], np.inf, np.inf), (len(places), 1))
    for plane, (x, y, _) in zip(planes, places @ R.T, strict=True):
        corner = np.clip(np.array([x, y]) // edge + n_side // 2 - _AROUND, 0, n_side).astype(int)
        window = ground.lowest[tuple(slice(k, k + 2 * _AROUND + 1) for k in corner)]
        seen = np.argwhere(window < np.inf)
        if len(seen) >= _CELLS_MIN:
            offsets = (seen + corner + 0.5 - n_side // 2) * edge - (x, y)
            near = np.argsort(np.linalg.norm(offsets, axis=1), kind="stable")[:_N_NEAREST]
            heights = window[tuple(seen[near].T)].astype(np.float64)
            height, *slopes, sigma = _plane_below(offsets[near], heights)
            plane[:3] -= np.array(slopes) @ R[:2]
            plane[3:] = slopes[0] * x + slopes[1] * y - height, sigma
    return planes


def _plane_below(offsets: Array, z: Array) -> tuple[float, ...]:
    """Return the height of the ground at the origin by a plane, its two slopes, and a sigma."""
    J = np.column_stack([np.ones(len(z)), offsets])
    weights = (_ROUGH + _SLOPE * np.linalg.norm(offsets, axis=1)) ** -2.0
    N = (J.T * weights) @ J + np.diag([0.0, _TILT**-2.0, _TILT**-2.0])
    plane = np.linalg.solve(N, (J.T * weights) @ z)
    variance = weights @ (z - J @ plane) ** 2 / weights.sum() + _SMOOTH**2
    return (*plane, np.sqrt(variance + _CELLS_MIN * np.linalg.inv(N)[0, 0]))


def _opened(lowest: Column) -> Column:
    """Return the lowest heights of cells of ground; infinite in all others.

    By the morphological opening of the lowest points. A cell has ground where its lowest point lies
    near the opened surface and enough others around do too: a marker behind a rock has no ground
    around it, and must not become ground itself, nor must a window that sees nothing else.
    """
    from scipy import ndimage  # slow to import

    eroded = ndimage.minimum_filter(lowest, _WINDOW, mode="constant", cval=np.inf)
    eroded[_n_about(lowest < np.inf) < _CELLS_MIN] = -np.inf
    opened = ndimage.maximum_filter(eroded, _WINDOW, mode="constant", cval=-np.inf)
    is_low = lowest < opened + np.float32(_STEP)
    is_low &= _n_about(is_low) >= _CELLS_MIN
    return np.where(is_low, lowest, np.float32(np.inf))


def _n_about(mask: Mask) -> Array:
    """Return how many cells of a mask are set in the window about each cell."""
    from scipy import ndimage  # slow to import

    counts: Array = ndimage.uniform_filter(mask.astype(np.float64), _WINDOW, mode="constant")
    return np.round(counts * _WINDOW**2)
