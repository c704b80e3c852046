"""Where to look: places at which something ends upward and to a side.

Hides how a few hundred places are picked from millions of returns.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from pipelines.extraction.ball import Ball
from pipelines.values import Array, Column


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
def _is_free(keys: NDArray[np.int64], p: Array, v_step: Array, v_beam: Array, edge: float) -> bool:
    """Tell whether nothing lies one step away, at the same depth give or take a voxel."""
    for depth in (-edge, 0.0, edge):
        q = p + v_step + depth * v_beam
        if keys[_slot(keys, _voxel(q[0], q[1], q[2], edge))] != -1:
            return False
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _around(keys: NDArray[np.int64], sums: Column, p: Array, edge: float) -> Array:
    """Return sums of x, y, z and count over the 27 voxels about a point."""
    total = np.zeros(4)
    for i in range(-1, 2):
        for j in range(-1, 2):
            for k in range(-1, 2):
                key = _voxel(p[0] + i * edge, p[1] + j * edge, p[2] + k * edge, edge)
                place = _slot(keys, key)
                if keys[place] != -1:
                    for axis in range(4):
                        total[axis] += sums[place, axis]
    return total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _free_ends(
    keys: NDArray[np.int64], sums: Column, up: Array, radius: float, n_points_min: int
) -> Array:
    """Return centres and counts, (k, 4), of what ends upward and to at least one side."""
    out = np.empty((len(keys), 4))
    n_out = 0
    for place in range(len(keys)):
        if keys[place] == -1:
            continue
        p = sums[place, :3].astype(np.float64) / sums[place, 3]
        v_beam = p / np.linalg.norm(p)
        v_side = np.cross(up, v_beam)
        v_side /= np.linalg.norm(v_side) + 1e-12
        if not _is_free(keys, p, 3.0 * radius * up, v_beam, radius):
            continue
        if not (
            _is_free(keys, p, 3.0 * radius * v_side, v_beam, radius)
            or _is_free(keys, p, -3.0 * radius * v_side, v_beam, radius)
        ):
            continue
        total = _around(keys, sums, p, radius)
        if total[3] >= n_points_min:
            # the points of a cap lie 2/3 R before the centre on average
            out[n_out, :3] = total[:3] / total[3] + (2.0 / 3.0) * radius * v_beam
            out[n_out, 3] = total[3]
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
