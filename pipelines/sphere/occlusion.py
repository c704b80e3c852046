"""Which returns of a sphere have a limb opposite them that is seen.

Each return at the limb pulls the centre towards itself. However many there are, the pulls of
opposite sides cancel on average, because beams pass both alike. Where something nearer hides one
side, returns end although the sphere goes on: those of the other side would pull the centre away
from what hides it, by more than its sigma.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.model import (
    Array,
    Beams,
    Column,
    Index,
    MarkerCandidate,
    Mask,
    StitchedCloud,
)
from spheremark.pipelines.scan.stitching import beams
from spheremark.pipelines.sphere.linearisation import Linear
from spheremark.pipelines.sphere.returns import Returns
from spheremark.pipelines.threads import side_by_side

_REACH = 3.0  # radii: what passes farther is farther from a place at the limb than its opposite is
_ROUGH = 0.5  # radii by which a rough centre may be off
_BLOCK = 4096  # returns that are compared with all places at a time


class Others(NamedTuple):
    """The returns towards each candidate that are not its members.

    Attributes
    ----------
    starts : (m + 1,)
        First one of each candidate, and the end of the last.
    beams : Beams
        Their beams.
    """

    starts: Index
    beams: Beams


def others_towards(
    cloud: StitchedCloud, candidates: Sequence[MarkerCandidate], radius: float
) -> Others:
    """Return the returns of a stop whose beams pass its candidates, beside their members.

    Parameters
    ----------
    cloud : StitchedCloud
        The stop.
    candidates : sequence of MarkerCandidate
        What may be markers.
    radius : float
        Radius of the spheres [m].

    Returns
    -------
    Others
        Those that may be the nearest to a place at the limb.
    """
    rough, rig = np.array([c.p_base_rough for c in candidates]), cloud.rig
    distances = np.linalg.norm(rough, axis=1)
    reaches = (_REACH + _ROUGH) * radius / distances
    axes = np.column_stack([rough / distances[:, None], 1.0 / distances, reaches])
    off = float(np.linalg.norm(rig.T_head_lidar[:3, 3]) + np.max(np.abs(rig.laser_heights)))
    parts = side_by_side(
        lambda first, end: _rows_about(cloud.p_base, first, end, axes, off), len(cloud.p_base)
    )
    owners, rows = np.concatenate(parts, axis=1)
    groups = [
        np.setdiff1d(rows[owners == k], c.members, assume_unique=True)
        for k, c in enumerate(candidates)
    ]
    starts = np.cumsum([0, *(len(group) for group in groups)])
    return Others(starts, beams(cloud, np.concatenate(groups)))


@compiled
def _rows_about(p_base: Column, first: int, end: int, axes: Array, off: float) -> Index:
    """Return the returns whose beams may pass some places closely, (2, n): place and row.

    ``axes``, (m, 5), are directions to the places, inverse distances, and angles that are close.
    """
    found = [(0, 0) for _ in range(0)]
    seen, is_close = np.empty((4, _BLOCK), np.float32), np.empty(_BLOCK, np.bool_)
    for begin in range(first, end, _BLOCK):
        n = min(_BLOCK, end - begin)
        for i in range(n):
            x, y, z = p_base[begin + i, 0], p_base[begin + i, 1], p_base[begin + i, 2]
            inverse = np.float32(1.0) / np.sqrt(x * x + y * y + z * z)
            seen[0, i], seen[1, i], seen[2, i] = inverse * x, inverse * y, inverse * z
            seen[3, i] = inverse
        for k in range(len(axes)):
            n_close = _mark_close(seen, n, axes[k], off, is_close)
            for i in range(n if n_close else 0):
                if is_close[i]:
                    found.append((k, begin + i))
    table = np.empty((2, len(found)), np.intp)
    for j in range(len(found)):
        table[0, j], table[1, j] = found[j]
    return table


@compiled
def _mark_close(seen: Array, n: int, axis: Array, off: float, is_close: Mask) -> int:
    """Mark which returns, by direction and inverse distance, may pass a place; return how many.

    Beams begin up to ``off`` from the origin, which turns them the more the nearer they end.
    """
    x, y, z, nearness, close = axis
    n_close = 0
    for i in range(n):
        cosine = seen[0, i] * x + seen[1, i] * y + seen[2, i] * z
        angle = close + off * abs(seen[3, i] - nearness)
        is_close[i] = (cosine > 0.0) & (1.0 - cosine * cosine < angle * angle)
        n_close += is_close[i]
    return n_close


def faces_seen(
    returns: Returns, linear: Linear, centres: Array, others: Others, radius: float
) -> Mask:
    """Tell which returns have places opposite them that nothing nearer than the sphere hides.

    Notes
    -----
    A place is hidden if the return that passes nearest to it ends before the sphere. What remains
    of the outline is symmetric about the centre, so that its pulls cancel on average.
    """
    passed = returns.first_axes * linear.offsets[0] + returns.second_axes * linear.offsets[1]
    is_seen = np.ones(len(returns.ranges), dtype=bool)
    for k, centre in enumerate(centres):
        own, beside = slice(*returns.starts[k : k + 2]), slice(*others.starts[k : k + 2])
        directions = others.beams.directions_base[beside]
        v = centre - others.beams.origins_base[beside]
        along = np.einsum("ij,ij->i", v, directions)
        is_before = others.beams.ranges[beside] < along - radius
        if not is_before.any():
            continue
        passed_by, opposite = along[:, None] * directions - v, -passed[:, own].T
        hiding, showing = passed_by[is_before], np.vstack([passed[:, own].T, passed_by[~is_before]])
        is_seen[own] = cKDTree(showing).query(opposite)[0] < cKDTree(hiding).query(opposite)[0]
    return is_seen
