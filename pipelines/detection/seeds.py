"""Seeds: places at which a surface ends upward and to a side.

Hides how a few hundred places are picked from millions of returns.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.detection.target import Target
from spheremark.pipelines.model import Array, Column

_Vector = tuple[float, float, float]


class _Voxels(NamedTuple):
    """Occupied voxels, as an open hash table.

    Attributes
    ----------
    keys : (size,)
        Key of the voxel in each slot; -1 in a free one.
    numbers : (size,) int32
        Its number; anything in a free slot.
    sums : (k, 4) float32
        Sums of x, y, z of the returns in each voxel, and their count.
    edge : float
        Edge of a voxel [m].
    """

    keys: NDArray[np.int64]
    numbers: NDArray[np.int32]
    sums: Column
    edge: float


def find_seeds(points: Column, target: Target, n_points_min: int) -> Array:
    """Return rough centres at which a sphere may stand."""
    voxels = _voxels(points, target.radius)
    ends = _free_ends(voxels, target.up, target.radius, n_points_min)
    ends = ends[np.lexsort((ends[:, 2], ends[:, 1], ends[:, 0], -ends[:, 3]))]
    return np.ascontiguousarray(thinned(ends, 0.5 * target.radius)[:, :3])


@compiled
def _slot(keys: NDArray[np.int64], key: int) -> int:
    """Return the place of a key in an open hash table, or the free place where it belongs."""
    mask = len(keys) - 1
    place = ((key * 0x9E3779B97F4A7C1) >> 17) & mask
    while keys[place] != -1 and keys[place] != key:
        place = (place + 1) & mask
    return place


@compiled
def _voxel(x: float, y: float, z: float, edge: float) -> int:
    """Return the key of the voxel that holds a point within some kilometres."""
    i, j, k = np.floor(x / edge), np.floor(y / edge), np.floor(z / edge)
    return ((int(i) + 500_000) * 1_000_000 + int(j) + 500_000) * 1_000_000 + int(k) + 500_000


@compiled
def _voxels(points: Column, edge: float) -> _Voxels:
    """Return the voxels that some returns occupy."""
    size = 64
    while size < 2 * len(points):
        size *= 2
    keys, numbers = np.full(size, -1, np.int64), np.empty(size, np.int32)
    sums = np.empty((len(points), 4), np.float32)
    n = 0
    for point in points:
        key = _voxel(point[0], point[1], point[2], edge)
        slot = _slot(keys, key)
        if keys[slot] == -1:
            keys[slot], numbers[slot] = key, n
            sums[n] = 0.0
            n += 1
        own = sums[numbers[slot]]
        own[0] += point[0]
        own[1] += point[1]
        own[2] += point[2]
        own[3] += 1.0
    return _Voxels(keys, numbers, sums[:n], edge)


@compiled
def _is_free(voxels: _Voxels, p: _Vector, step: _Vector, beam: _Vector) -> bool:
    """Return whether the voxels one step away, at the same depth or next to it, are empty."""
    edge = voxels.edge
    for depth in (-edge, 0.0, edge):
        x, y = p[0] + step[0] + depth * beam[0], p[1] + step[1] + depth * beam[1]
        key = _voxel(x, y, p[2] + step[2] + depth * beam[2], edge)
        if voxels.keys[_slot(voxels.keys, key)] != -1:
            return False
    return True


@compiled
def _around(voxels: _Voxels, p: _Vector) -> tuple[float, float, float, float]:
    """Return sums of x, y, z and count over the 27 voxels about a point."""
    x, y, z, n, edge = 0.0, 0.0, 0.0, 0.0, voxels.edge
    for i in range(-1, 2):
        for j in range(-1, 2):
            for k in range(-1, 2):
                key = _voxel(p[0] + i * edge, p[1] + j * edge, p[2] + k * edge, edge)
                slot = _slot(voxels.keys, key)
                if voxels.keys[slot] != -1:
                    own = voxels.sums[voxels.numbers[slot]]
                    x, y, z, n = x + own[0], y + own[1], z + own[2], n + own[3]
    return x, y, z, n


@compiled
def _axes(p: _Vector, up: Array) -> tuple[_Vector, _Vector]:
    """Return the direction of a place, and the unit vector across it, to the left."""
    distance = np.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
    x, y, z = p[0] / distance, p[1] / distance, p[2] / distance
    a, b, c = up[1] * z - up[2] * y, up[2] * x - up[0] * z, up[0] * y - up[1] * x
    length = np.sqrt(a * a + b * b + c * c) + 1e-12
    return (x, y, z), (a / length, b / length, c / length)


@compiled
def _free_ends(voxels: _Voxels, up: Array, radius: float, n_points_min: int) -> Array:
    """Return centres and counts, (k, 4), of surfaces that end upward and to one side at least."""
    out = np.empty((len(voxels.sums), 4))
    n_out, step = 0, 3.0 * radius
    upward = (step * up[0], step * up[1], step * up[2])
    for own in voxels.sums:
        n = np.float64(own[3])
        p = (own[0] / n, own[1] / n, own[2] / n)
        beam, side = _axes(p, up)
        if not _is_free(voxels, p, upward, beam):
            continue
        left = (step * side[0], step * side[1], step * side[2])
        right = (-left[0], -left[1], -left[2])
        if not (_is_free(voxels, p, left, beam) or _is_free(voxels, p, right, beam)):
            continue
        x, y, z, n = _around(voxels, p)
        if n >= n_points_min:
            # the points of a cap lie 2/3 R before the centre on average
            before = 2.0 / 3.0 * radius
            out[n_out, 0], out[n_out, 1] = x / n + before * beam[0], y / n + before * beam[1]
            out[n_out, 2], out[n_out, 3] = z / n + before * beam[2], n
            n_out += 1
    return out[:n_out]


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
