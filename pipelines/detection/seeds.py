"""Seeds: places at which a surface ends upward and to a side.

Hides how a few hundred places are picked from millions of returns.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.detection.target import Target
from spheremark.pipelines.model import Array, Column, Mask

_STEP = 3.0  # radii beside a surface that must be free for it to end there
_CAP = 2.0 / 3.0  # radii that the returns of a sphere lie before its centre on average


class _Voxels(NamedTuple):
    """Occupied voxels.

    Attributes
    ----------
    keys : (k,)
        Of each, ascending.
    sums : (k, 4)
        Sums of x, y, z of the returns in each, and their count.
    edge : float
        Edge of a voxel [m].
    """

    keys: NDArray[np.int64]
    sums: Array
    edge: float


def find_seeds(points: Column, target: Target, n_points_min: int) -> Array:
    """Return rough centres at which a sphere may stand."""
    voxels, step = _voxels(points.astype(np.float64), target.radius), _STEP * target.radius
    p = voxels.sums[:, :3] / voxels.sums[:, 3:]
    p = p[_is_free(voxels, p, step * target.up)]
    across = np.cross(target.up, p)
    across *= step / (np.linalg.norm(across, axis=1, keepdims=True) + 1e-12)
    p = p[_is_free(voxels, p, across) | _is_free(voxels, p, -across)]
    sums = _sums_around(voxels, p)
    is_many = sums[:, 3] >= n_points_min
    p, sums = p[is_many], sums[is_many]
    before = _CAP * target.radius / np.linalg.norm(p, axis=1, keepdims=True)
    centres = sums[:, :3] / sums[:, 3:] + before * p
    order = np.lexsort((*centres.T[::-1], -sums[:, 3]))
    found: Array = thinned(centres[order], 0.5 * target.radius)
    return found


def _keys(points: Array, edge: float) -> NDArray[np.int64]:
    """Return the keys of the voxels that hold some points within some kilometres."""
    i, j, k = np.floor(points.T / edge).astype(np.int64) + 500_000
    return np.asarray((i * 1_000_000 + j) * 1_000_000 + k)


def _voxels(points: Array, edge: float) -> _Voxels:
    """Return the voxels that some returns occupy."""
    keys, own = np.unique(_keys(points, edge), return_inverse=True)
    columns = (*points.T, np.ones(len(points)))
    sums = [np.bincount(own, weights=column, minlength=len(keys)) for column in columns]
    return _Voxels(keys, np.column_stack(sums), edge)


def _places(voxels: _Voxels, points: Array) -> tuple[NDArray[np.intp], Mask]:
    """Return the rows of the voxels that hold some points, and whether there is one."""
    keys = _keys(points, voxels.edge)
    rows = np.minimum(np.searchsorted(voxels.keys, keys), len(voxels.keys) - 1)
    return rows, np.asarray(voxels.keys[rows] == keys)


def _is_free(voxels: _Voxels, p: Array, steps: Array) -> Mask:
    """Return whether the voxels one step away, at the same depth or next to it, are empty."""
    beams = voxels.edge * p / np.linalg.norm(p, axis=1, keepdims=True)
    is_free = np.ones(len(p), np.bool_)
    for depth in (-1.0, 0.0, 1.0):
        is_free &= ~_places(voxels, p + steps + depth * beams)[1]
    return is_free


def _sums_around(voxels: _Voxels, p: Array) -> Array:
    """Return sums of x, y, z and count over the 27 voxels about each point."""
    sums = np.zeros((len(p), 4))
    for offset in np.ndindex(3, 3, 3):
        rows, is_held = _places(voxels, p + voxels.edge * (np.array(offset) - 1.0))
        sums += np.where(is_held[:, None], voxels.sums[rows], 0.0)
    return sums


@compiled
def thinned(seeds: Array, gap: float) -> Array:
    """Return the places that have no earlier one within a gap."""
    kept, places = np.empty_like(seeds), np.empty((3, len(seeds)))
    n_kept = 0
    for i in range(len(seeds)):
        n_near = 0
        for j in range(n_kept):
            dx, dy = seeds[i, 0] - places[0, j], seeds[i, 1] - places[1, j]
            dz = seeds[i, 2] - places[2, j]
            n_near += dx * dx + dy * dy + dz * dz < gap * gap
        if not n_near:
            for k in range(seeds.shape[1]):
                kept[n_kept, k] = seeds[i, k]
            for k in range(3):
                places[k, n_kept] = seeds[i, k]
            n_kept += 1
    return kept[:n_kept]
