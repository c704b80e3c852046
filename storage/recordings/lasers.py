"""The lasers of a LiDAR, as far as its returns show them: is it the one that the rig describes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from spheremark.pipelines.model import RING_UNKNOWN, Array, Rig, Rings
from spheremark.storage.recordings.families import Returns

_SAMPLE = 5_000  # returns that are looked at
_FAR = 2.0  # [m]; nearer, the heights of a VLP-16's lasers change elevations by 0.3 deg or more
_N_MIN = 20  # returns that show the elevation of a laser
_SAME = np.radians(0.5)  # a quarter of the spacing of a VLP-16's lasers
_STEADY = np.radians(0.3)  # scatter of the elevation of a laser that only spins


def with_lasers(rig: Rig | None, returns: Returns) -> tuple[Rig | None, Rings, tuple[str, ...]]:
    """Return rig and rings that fit each other, and a sentence where the LiDAR is no VLP-16.

    Rings from the top down are turned over. The elevations of another LiDAR are those of its
    returns; its beams are taken to leave its origin. Where rings keep no elevation, both are as
    they were.
    """
    rings = returns.rings
    if rig is None or not len(rings) or rings[0] == RING_UNKNOWN:
        return rig, rings, ()
    elevations, scatter = _elevations(returns)
    seen = np.flatnonzero(np.isfinite(elevations))
    if not len(seen):
        return rig, rings, ()
    known = rig.laser_elevations
    if len(elevations) <= len(known):
        if np.abs(known[: len(elevations)] - elevations)[seen].max() < _SAME:
            return rig, rings, ()
        if np.abs(known[::-1][: len(elevations)] - elevations)[seen].max() < _SAME:
            return rig, np.asarray(len(known) - 1 - rings, np.uint8), ()
    if np.median(scatter[seen]) > _STEADY:
        return rig, rings, ()
    order = np.argsort(elevations)  # rings without returns come last
    rank = np.zeros(len(elevations), np.uint8)
    rank[order] = np.arange(len(order))
    sorted_elevations = np.sort(elevations[seen])
    n = len(seen)
    rig = replace(
        rig,
        laser_elevations=sorted_elevations,
        laser_heights=np.zeros(n),
        laser_range_biases=np.zeros(n),
    )
    low, high = np.degrees(sorted_elevations[[0, -1]])
    return (
        rig,
        rank[rings],
        (
            f"The LiDAR of {returns.topic} is no VLP-16: it has {n} lasers from {low:.1f} to "
            f"{high:.1f} deg. Elevations are taken from the returns, the divergence of beams from "
            "the VLP-16; give the rig of this LiDAR (--rig).",
        ),
    )


def _elevations(returns: Returns) -> tuple[Array, Array]:
    """Return the median elevation of each ring, NaN where it is not seen, and its scatter [rad]."""
    rows = slice(None, None, max(1, len(returns.rings) // _SAMPLE))
    p, rings = returns.p_lidar[rows].astype(np.float64), returns.rings[rows]
    horizontal = np.hypot(p[:, 0], p[:, 1])
    elevations = np.arctan2(p[:, 2], horizontal)
    elevations, rings = elevations[horizontal > _FAR], rings[horizontal > _FAR]
    n = int(returns.rings.max()) + 1
    medians, scatters = np.full(n, np.nan), np.full(n, np.nan)
    for ring in range(n):
        mine = elevations[rings == ring]
        if len(mine) >= _N_MIN:
            medians[ring] = np.median(mine)
            scatters[ring] = 1.4826 * np.median(np.abs(mine - medians[ring]))
    return medians, scatters
