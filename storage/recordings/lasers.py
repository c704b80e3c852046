"""The lasers of a LiDAR, as far as its returns show them: is it the one that the rig describes."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.model import RING_UNKNOWN, Array, Rig, Rings
from spheremark.pipelines.scan.rigs import VLP16_ELEVATIONS
from spheremark.storage.recordings.families import Returns

_SAMPLE = 5_000  # returns that are looked at
_FAR = 2.0  # [m]; nearer, the heights of a VLP-16's lasers change elevations by 0.3 deg or more
_N_MIN = 20  # returns that show the elevation of a laser
_SAME = np.radians(0.5)  # a quarter of the spacing of a VLP-16's lasers
_MODEL = np.radians(0.15)  # half of the smallest spacing of lasers in the table
_VELODYNE = (3.0e-3, 1.5e-3)  # [rad] VLP-16 manual; VLS-128 manual, table F-1: one family
_FOCAL_OFFSET = 0.04191  # [m] of a VLP-16, from the spin axis to where beams cross
_RESOLUTION = 1e-4  # [m] of coordinates; drivers round to float32 or to millimetres
_SIGMA_SHARE = 0.1  # of the share of vertical offsets: the middle of 0 and 1 is 5 sigma away
_STEADY = np.radians(0.3)  # scatter of the elevation of a laser that only spins


class Model(NamedTuple):
    """A LiDAR as its maker describes it."""

    name: str
    elevations: Array  # of its lasers, the lowest first [rad]
    focal_offset: float  # [m] from the spin axis to where beams cross; 0 where clouds omit it
    divergence: tuple[float, float]  # [rad] full widths across and along the spin axis


MODELS = (
    Model(
        "Velodyne Puck Hi-Res",
        np.radians(np.linspace(-10.0, 10.0, 16)),
        _FOCAL_OFFSET,
        _VELODYNE,
    ),
    Model(
        "Velodyne VLP-32C",
        np.radians([
            -25.0, -15.639, -11.31, -8.843, -7.254, -6.148, -5.333, -4.667, -4.0, -3.667, -3.333,
            -3.0, -2.667, -2.333, -2.0, -1.667, -1.333, -1.0, -0.667, -0.333, 0.0, 0.333, 0.667,
            1.0, 1.333, 1.667, 2.333, 3.333, 4.667, 7.0, 10.333, 15.0,
        ]),
        0.0,
        _VELODYNE,
    ),
)  # fmt: skip
"""LiDARs other than the VLP-16 that are known by their elevations."""


class Lasers(NamedTuple):
    """Rig and rings that fit each other; which LiDAR it is, and what is not known of it."""

    rig: Rig | None
    rings: Rings
    notes: tuple[str, ...] = ()
    weaknesses: tuple[str, ...] = ()


def with_lasers(rig: Rig | None, returns: Returns) -> Lasers:
    """Return rig and rings that fit each other, and sentences where the LiDAR is no VLP-16.

    Rings that count from the top are turned over, also with a rig of the user. A known model has
    the optics of its maker; the elevations of any other LiDAR are those of its returns; its beams
    are taken to leave its origin. Where rings keep no elevation, both are as they were.
    """
    rings = returns.rings
    as_they_were = Lasers(rig, rings)
    if not len(rings) or rings[0] == RING_UNKNOWN:
        return as_they_were
    samples, lasers = _sample(returns)
    elevations = _elevations(samples, lasers, int(rings.max()) + 1)
    seen = np.flatnonzero(np.isfinite(elevations))
    if not len(seen):
        return as_they_were
    known = VLP16_ELEVATIONS if rig is None else rig.laser_elevations
    if _agrees(elevations, known, _SAME):
        return as_they_were
    if _agrees(elevations, known[::-1], _SAME):
        return Lasers(rig, np.asarray(len(known) - 1 - rings, np.uint8))
    if 1.4826 * np.nanmedian(np.abs(samples - elevations[lasers])) > _STEADY:
        return as_they_were
    order = np.argsort(elevations)  # rings without returns come last
    rank = np.zeros(len(elevations), np.uint8)
    rank[order] = np.arange(len(order))
    found = np.sort(elevations[seen])
    model = next((one for one in MODELS if _agrees(found, one.elevations, _MODEL)), None)
    if model is not None:
        note = (
            f"The LiDAR of {returns.topic} is a {model.name} by its elevations; these and the "
            "divergence of its beams are those of its maker."
        )
        return Lasers(_of_model(rig, model), rank[rings], (note,))
    if rig is not None:
        zeros = np.zeros(len(seen))
        rig = replace(
            rig, laser_elevations=found, laser_heights=zeros, laser_range_biases=zeros.copy()
        )
    low, high = np.degrees(found[[0, -1]])
    note = (
        f"The LiDAR of {returns.topic} is no VLP-16: it has {len(seen)} lasers from {low:.1f} to "
        f"{high:.1f} deg. Elevations are taken from the returns, the divergence of beams from "
        "the VLP-16; give the rig of this LiDAR with its divergence_rad (--rig)."
    )
    return Lasers(rig, rank[rings], (note,), (note,))


def carries_heights(rig: Rig | None, rings: Rings, returns: Returns) -> bool | None:
    """Return whether points include the vertical offsets of their beams; None if that is open.

    The points of a laser lie on a line over their horizontal distance; where that meets the spin
    axis is the offset. Its share of the offsets that the maker gives is 1 or 0.
    """
    given = rig.laser_heights if rig is not None else -_FOCAL_OFFSET * np.tan(VLP16_ELEVATIONS)
    if returns.has_heights is not None or not len(rings) or int(rings.max()) >= len(given):
        return returns.has_heights
    rows = slice(None, None, max(1, len(rings) // _SAMPLE))
    p = returns.p_lidar[rows].astype(np.float64)
    lasers, horizontal = rings[rows], np.hypot(p[:, 0], p[:, 1])
    share = weight = 0.0
    for ring in range(len(given)):
        mine = lasers == ring
        if not given[ring] or mine.sum() < _N_MIN:
            continue
        at, z = horizontal[mine], p[mine, 2]
        off = at - at.mean()
        spread = float(off @ off)
        if spread <= len(at) * _RESOLUTION**2:
            continue  # all at one distance: no line
        slope = float(off @ z) / spread
        squares = float(np.sum((z - z.mean() - slope * off) ** 2))
        variance = max(squares / (len(at) - 2), _RESOLUTION**2)
        own = given[ring] ** 2 / (variance * (1.0 / len(at) + at.mean() ** 2 / spread))
        share += own * (z.mean() - slope * at.mean()) / given[ring]
        weight += own
    if not weight or weight**-0.5 > _SIGMA_SHARE:
        return None
    return bool(share / weight > 0.5)


def _of_model(rig: Rig | None, model: Model) -> Rig | None:
    """Return a rig with the optics of a model."""
    if rig is None:
        return None
    return replace(
        rig,
        laser_elevations=model.elevations.copy(),
        laser_heights=-model.focal_offset * np.tan(model.elevations),
        laser_range_biases=np.zeros(len(model.elevations)),
        divergence=np.array(model.divergence),
    )


def _agrees(found: Array, known: Array, limit: float) -> bool:
    """Return whether all elevations that were found are those that are known."""
    if len(found) > len(known):
        return False
    return bool(np.nanmax(np.abs(known[: len(found)] - found)) < limit)


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
