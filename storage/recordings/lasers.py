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
    samples, lasers = _sample(returns)
    elevations = _elevations(samples, lasers, int(rings.max()) + 1)
    seen = np.flatnonzero(np.isfinite(elevations))
    if not len(seen):
        return rig, rings, ()
    known = rig.laser_elevations
    if len(elevations) <= len(known):
        if np.abs(known[: len(elevations)] - elevations)[seen].max() < _SAME:
            return rig, rings, ()
        if np.abs(known[::-1][: len(elevations)] - elevations)[seen].max() < _SAME:
            return rig, np.asarray(len(known) - 1 - rings, np.uint8), ()
    if 1.4826 * np.nanmedian(np.abs(samples - elevations[lasers])) > _STEADY:
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


def _sample(returns: Returns) -> tuple[Array, Rings]:
    """Return elevations [rad] and rings of some returns that are far enough."""
    rows = slice(None, None, max(1, len(returns.rings) // _SAMPLE))
    p = returns.p_lidar[rows].astype(np.float64)
    horizontal = np.hypot(p[:, 0], p[:, 1])
    is_far = horizontal > _FAR
    return np.arctan2(p[is_far, 2], horizontal[is_far]), returns.rings[rows][is_far]


def _elevations(samples: Array, lasers: Rings, n: int) -> Array:
    """Return the median elevation of each ring, NaN where it is not seen [rad]."""
    medians = np.full(n, np.nan)
    for ring in range(n):
        mine = samples[lasers == ring]
        if len(mine) >= _N_MIN:
            medians[ring] = np.median(mine)
    return medians
