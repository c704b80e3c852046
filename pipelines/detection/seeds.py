"""Seeds: places at which a surface ends upward and to a side.

Hides how a few hundred places are picked from millions of returns.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from spheremark.pipelines.detection.target import Target
from spheremark.pipelines.model import Array, Column, Index, Mask

_STEP = 3.0  # radii beside a surface that must be free for it to end there
_DUST = 0.05  # of the returns in its voxel: fewer in another one are no surface
_CAP = 2.0 / 3.0  # radii that the returns of a sphere lie before its centre on average


def find_seeds(points: Column, target: Target, n_points_min: int) -> Array:
    """Return rough centres at which a sphere may stand."""
    edge, step = target.radius, _STEP * target.radius
    p = points.astype(np.float64)
    occupied, own = np.unique(_voxels(p, edge), return_inverse=True)
    columns = (*p.T, np.ones(len(p)))
    sums = np.array([np.bincount(own, one, len(occupied)) for one in columns], np.float64).T
    p, n = sums[:, :3] / sums[:, 3:], sums[:, 3]
    voxels = (occupied, n, edge)
    is_top = _is_free(voxels, p, n, step * target.up)
    p, n = p[is_top], n[is_top]
    across = np.cross(target.up, p)
    across *= step / (np.linalg.norm(across, axis=1, keepdims=True) + 1e-12)
    p = p[_is_free(voxels, p, n, across) | _is_free(voxels, p, n, -across)]
    around = np.zeros((len(p), 4))
    for offset in np.ndindex(3, 3, 3):
        rows, is_held = _find(occupied, _voxels(p + edge * (np.array(offset) - 1.0), edge))
        around[is_held] += sums[rows[is_held]]
    around, p = (one[around[:, 3] >= n_points_min] for one in (around, p))
    before = _CAP * target.radius / np.linalg.norm(p, axis=1, keepdims=True)
    centres = around[:, :3] / around[:, 3:] + before * p
    centres = centres[np.lexsort((*centres.T[::-1], -around[:, 3]))]
    return np.asarray(centres[thinned(centres, 0.5 * target.radius)])


def thinned(places: Array, gap: float) -> Index:
    """Return the rows of the places that have no earlier one within a gap."""
    is_kept = np.zeros(len(places), np.bool_)
    if len(places):
        for row, near in enumerate(KDTree(places).query_ball_point(places, gap)):
            is_kept[row] = not is_kept[near].any()
    return np.flatnonzero(is_kept)


def _voxels(points: Array, edge: float) -> NDArray[np.int64]:
    """Return the numbers of the voxels that hold some points within some kilometres."""
    i, j, k = np.floor(points.T / edge).astype(np.int64) + 500_000
    return np.asarray((i * 1_000_000 + j) * 1_000_000 + k)


def _find(occupied: NDArray[np.int64], voxels: NDArray[np.int64]) -> tuple[Index, Mask]:
    """Return the rows of some voxels among the occupied ones, and whether they are there."""
    rows = np.minimum(np.searchsorted(occupied, voxels), len(occupied) - 1)
    return rows, np.asarray(occupied[rows] == voxels)


def _is_free(
    voxels: tuple[NDArray[np.int64], Array, float], p: Array, n: Array, step: Array
) -> Mask:
    """Return whether the voxels one step away, at the same depth or next to it, hold no surface.

    ``voxels`` are their numbers, what they hold and their edge; ``n`` is how many returns show each
    place.
    """
    occupied, held, edge = voxels
    beams = edge * p / np.linalg.norm(p, axis=1, keepdims=True)
    away = np.stack([p + step + depth * beams for depth in (-1.0, 0.0, 1.0)])
    rows, is_held = _find(occupied, _voxels(away.reshape(-1, 3), edge))
    shown = np.where(is_held, held[rows], 0.0).reshape(3, -1)
    return np.asarray((shown <= _DUST * n).all(axis=0))
