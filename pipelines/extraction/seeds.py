"""Where to look: places at which something ends upward and to a side.

Hides how a few hundred places are picked from millions of returns.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from pipelines.extraction.ball import Ball
from pipelines.values import Array, Column

_Vector = tuple[float, float, float]


def find_seeds(
    p_base: Column, rows_above: NDArray[np.int32], ball: Ball, n_points_min: int
) -> Array:
    """Return rough centres at which a ball may be looked for.

    Parameters
    ----------
    p_base : (n, 3) float32
        Returns [m].
    rows_above : (m,) int32
        Those that are not known to be ground.
    ball : Ball
        What is looked for.
    n_points_min : int
        Places with fewer returns about them are left out.

    Returns
    -------
    (k, 3)
        Places, those with most returns first [m].
    """
    keys, sums = _voxels(p_base, rows_above, ball.radius)
    ends = _free_ends(keys, sums, ball.up, ball.radius, n_points_min)
    ends = ends[np.lexsort((ends[:, 2], ends[:, 1], ends[:, 0], -ends[:, 3]))]
    return np.ascontiguousarray(thinned(ends, 0.5 * ball.radius)[:, :3])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _slot(keys: NDArray[np.int64], key: int) -> int:
    """Return the place of a key in an open hash table, or the free place where it belongs."""
    mask = len(keys) - 1
    place = ((key * 0x9E3779B97F4A7C1) >> 17) & mask
    while keys[place] != -1 and keys[place] != key:
        place = (place + 1) & mask
    return place


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _voxel(x: float, y: float, z: float, edge: float) -> int:
    """Return the key of the voxel that holds a point within some kilometres."""
    i, j, k = np.floor(x / edge), np.floor(y / edge), np.floor(z / edge)
    return ((int(i) + 500_000) * 1_000_000 + int(j) + 500_000) * 1_000_000 + int(k) + 500_000


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _voxels(
    p_base: Column, rows: NDArray[np.int32], edge: float
) -> tuple[NDArray[np.int64], Column]:
    """Return the occupied voxels as an open hash table: keys, and sums of x, y, z with count."""
    size = 64
    while size < 2 * len(rows):
        size *= 2
    keys = np.full(size, -1, np.int64)
    sums = np.zeros((size, 4), np.float32)
    for i in rows:
        key = _voxel(p_base[i, 0], p_base[i, 1], p_base[i, 2], edge)
        place = _slot(keys, key)
        keys[place] = key
        sums[place, 0] += p_base[i, 0]
        sums[place, 1] += p_base[i, 1]
        sums[place, 2] += p_base[i, 2]
        sums[place, 3] += 1.0
    return keys, sums


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _is_free(
    keys: NDArray[np.int64], p: _Vector, step: _Vector, beam: _Vector, edge: float
) -> bool:
    """Tell whether nothing lies one step away, at the same depth give or take a voxel."""
    for depth in (-edge, 0.0, edge):
        x, y = p[0] + step[0] + depth * beam[0], p[1] + step[1] + depth * beam[1]
        if keys[_slot(keys, _voxel(x, y, p[2] + step[2] + depth * beam[2], edge))] != -1:
            return False
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _around(
    keys: NDArray[np.int64], sums: Column, p: _Vector, edge: float
) -> tuple[float, float, float, float]:
    """Return sums of x, y, z and count over the 27 voxels about a point."""
    x, y, z, n = 0.0, 0.0, 0.0, 0.0
    for i in range(-1, 2):
        for j in range(-1, 2):
            for k in range(-1, 2):
                key = _voxel(p[0] + i * edge, p[1] + j * edge, p[2] + k * edge, edge)
                place = _slot(keys, key)
                if keys[place] != -1:
                    x, y, z = x + sums[place, 0], y + sums[place, 1], z + sums[place, 2]
                    n += sums[place, 3]
    return x, y, z, n


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _axes(p: _Vector, up: Array) -> tuple[_Vector, _Vector]:
    """Return the direction of a place, and the unit vector across it, to the left."""
    distance = np.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
    x, y, z = p[0] / distance, p[1] / distance, p[2] / distance
    a, b, c = up[1] * z - up[2] * y, up[2] * x - up[0] * z, up[0] * y - up[1] * x
    length = np.sqrt(a * a + b * b + c * c) + 1e-12
    return (x, y, z), (a / length, b / length, c / length)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _free_ends(
    keys: NDArray[np.int64], sums: Column, up: Array, radius: float, n_points_min: int
) -> Array:
    """Return centres and counts, (k, 4), of what ends upward and to at least one side."""
    out = np.empty((len(keys), 4))
    n_out, step = 0, 3.0 * radius
    upward = (step * up[0], step * up[1], step * up[2])
    for place in range(len(keys)):
        if keys[place] == -1:
            continue
        n = np.float64(sums[place, 3])
        p = (sums[place, 0] / n, sums[place, 1] / n, sums[place, 2] / n)
        beam, side = _axes(p, up)
        if not _is_free(keys, p, upward, beam, radius):
            continue
        left = (step * side[0], step * side[1], step * side[2])
        right = (-left[0], -left[1], -left[2])
        if not (_is_free(keys, p, left, beam, radius) or _is_free(keys, p, right, beam, radius)):
            continue
        x, y, z, n = _around(keys, sums, p, radius)
        if n >= n_points_min:
            # the points of a cap lie 2/3 R before the centre on average
            before = 2.0 / 3.0 * radius
            out[n_out, 0], out[n_out, 1] = x / n + before * beam[0], y / n + before * beam[1]
            out[n_out, 2], out[n_out, 3] = z / n + before * beam[2], n
            n_out += 1
    return out[:n_out]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def thinned(seeds: Array, gap: float) -> Array:
    """Return the places that have no earlier one within a gap.

    Parameters
    ----------
    seeds : (n, m)
        Places and whatever belongs to them, strongest first [m].
    gap : float
        How near is too near [m].

    Returns
    -------
    (k, m)
        The places that stay, in the same order.
    """
    kept = np.empty_like(seeds)
    n_kept = 0
    for i in range(len(seeds)):
        is_new = True
        for j in range(n_kept):
            dx, dy = seeds[i, 0] - kept[j, 0], seeds[i, 1] - kept[j, 1]
            dz = seeds[i, 2] - kept[j, 2]
            if dx * dx + dy * dy + dz * dz < gap * gap:
                is_new = False
                break
        if is_new:
            kept[n_kept] = seeds[i]
            n_kept += 1
    return kept[:n_kept]
