"""The lasers of a LiDAR, as far as its returns show them: is it the one that the rig describes.

Elevations of Velodyne's models are those of the files of calibration of VeloView, which the ROS
driver (velodyne_pointcloud/params: VLP16_hires_db, 32db, VeloView-VLP-32C, VLS128) and
velodyne-decoder carry; distances of the focus those of the maker's envelope drawings (86-0129,
86-0106, 86-0130), as in velodyne-decoder. Divergence: VLS-128 manual, table F-1, and HDL-32E data
sheet; that of the other Pucks is taken to be that of the VLP-16. Clouds of the ROS driver omit the
vertical offsets of these models. An Ouster or a Hesai has elevations of its own unit.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.model import RING_UNKNOWN, Array, Index, Rig, Rings
from spheremark.pipelines.scan.rigs import VLP16_ELEVATIONS
from spheremark.storage.recordings.families import Returns

_SAMPLE = 5_000  # returns that are looked at
_SAMPLE_RING = 100  # of each ring, of LiDARs with many
_FAR = 2.0  # [m]; nearer, the heights of a VLP-16's lasers change elevations by 0.3 deg or more
_N_MIN = 20  # returns that show the elevation of a laser
_SAME = np.radians(0.5)  # a quarter of the spacing of a VLP-16's lasers
_MODEL = np.radians(0.15)  # models with equally many lasers differ by whole degrees somewhere
_RESOLUTION = 1e-4  # [m] of coordinates; drivers round to float32 or to millimetres
_SIGMA_SHARE = 0.1  # of the share of vertical offsets: the middle of 0 and 1 is 5 sigma away
_STEADY = np.radians(0.3)  # scatter of the elevation of a laser that only spins
_GOLDEN = (5.0**0.5 - 1.0) / 2.0  # its multiples spread evenly, whatever their number
_PUCK = 0.04191  # [m] from the spin axis to where the beams of a VLP-16 or Hi-Res cross
_VLP16_HEIGHTS = -_PUCK * np.tan(VLP16_ELEVATIONS)


class Model(NamedTuple):
    """A LiDAR as its maker describes it."""

    name: str
    elevations: Array  # of its lasers, the lowest first [rad]
    focal_offset: float  # from the spin axis to where beams cross [m]
    divergence: tuple[float, float]  # full widths across and along the spin axis [rad]

    @property
    def heights(self) -> Array:
        """Vertical offsets of the beams on the spin axis [m]."""
        return np.asarray(-self.focal_offset * np.tan(self.elevations))


MODELS = (
    Model("Velodyne Puck Hi-Res", np.radians(np.arange(-7.5, 8.0) * 4 / 3), _PUCK, (3e-3, 1.5e-3)),
    Model(
        "Velodyne HDL-32E", np.radians(np.arange(-23.0, 9.0) * 4 / 3), 0.02883, (2.79e-3, 2.79e-3)
    ),
    Model(
        "Velodyne VLP-32C",
        np.radians([
            -25.0, -15.639, -11.31, -8.843, -7.254, -6.148, -5.333, -4.667, -4.0, -3.667, -3.333,
            -3.0, -2.667, -2.333, -2.0, -1.667, -1.333, -1.0, -0.667, -0.333, 0.0, 0.333, 0.667,
            1.0, 1.333, 1.667, 2.333, 3.333, 4.667, 7.0, 10.333, 15.0,
        ]),
        0.0424,
        (3e-3, 1.5e-3),
    ),
    Model(
        "Velodyne Alpha Prime (VLS-128)",
        np.radians([
            -25.0, -19.582, -16.042, -13.565, -11.742, -10.346, -9.244, -8.352, -7.65, -7.15, -6.85,
            -6.65, *np.linspace(-6.5, 4.83, 104), 4.98, 5.18, 5.43, 5.73, 6.08, 6.48, 6.98, 7.58,
            8.43, 9.7, 11.75, 15.0,
        ]),
        0.05863,
        (3e-3, 1.5e-3),
    ),
)  # fmt: skip
"""LiDARs other than the VLP-16 that are known by their elevations."""


class Lasers(NamedTuple):
    """Rig and rings that fit each other; which LiDAR it is, and what is not known of it."""

    rig: Rig | None
    rings: Rings
    heights: Array  # of the beams on the spin axis, by the maker [m]
    notes: tuple[str, ...] = ()
    weaknesses: tuple[str, ...] = ()


class _Sample(NamedTuple):
    """Some returns that are far enough."""

    z: Array
    horizontal: Array
    lasers: Rings

    def elevations(self, heights: Array) -> Array:
        """Return elevations of beams that leave the spin axis at given heights [rad]."""
        return np.asarray(np.arctan2(self.z - heights[self.lasers], self.horizontal))

    def medians(self, heights: Array) -> Array:
        """Return the median elevation of each ring, NaN where it is not seen [rad]."""
        elevations, medians = self.elevations(heights), np.full(len(heights), np.nan)
        for ring in range(len(heights)):
            mine = elevations[self.lasers == ring]
            if len(mine) >= _N_MIN:
                medians[ring] = np.median(mine)
        return medians


def with_lasers(rig: Rig | None, returns: Returns) -> Lasers:
    """Return rig and rings that fit each other, and sentences where the LiDAR is no VLP-16.

    Rings that count from the top are turned over, also with a rig of the user. A known model has
    the optics of its maker; the elevations of any other LiDAR are those of its returns; its beams
    are taken to leave its origin. Where rings keep no elevation, both are as they were.
    """
    rings, known, heights = returns.rings, VLP16_ELEVATIONS, _VLP16_HEIGHTS
    if rig is not None:
        known, heights = rig.laser_elevations, rig.laser_heights
    as_they_were = Lasers(rig, rings, heights)
    if not len(rings) or rings[0] == RING_UNKNOWN:
        return as_they_were
    sample, level = _sample(returns), np.zeros(int(rings.max()) + 1)
    elevations = sample.medians(level)
    seen = np.flatnonzero(np.isfinite(elevations))
    if not len(seen) or _agrees(elevations, known, _SAME):
        return as_they_were
    if _agrees(elevations, known[::-1], _SAME):
        return Lasers(rig, np.asarray(len(known) - 1 - rings, np.uint8), heights)
    scatter = np.abs(sample.elevations(level) - elevations[sample.lasers])
    if 1.4826 * np.nanmedian(scatter) > _STEADY:
        return as_they_were
    order = np.argsort(elevations)  # rings without returns come last
    rank = np.zeros(len(elevations), np.uint8)
    rank[order] = np.arange(len(order))
    sample = sample._replace(lasers=rank[sample.lasers])
    model = next((one for one in MODELS if _is_model(sample, one, len(seen))), None)
    if model is not None:
        note = (
            f"The LiDAR of {returns.topic} is a {model.name} by its elevations; these and the "
            "divergence of its beams are those of its maker."
        )
        return Lasers(_of_model(rig, model), rank[rings], model.heights, (note,))
    found, heights = elevations[order[: len(seen)]], np.zeros(len(seen))
    if rig is not None:
        zeros = (heights.copy(), heights.copy())
        rig = replace(
            rig, laser_elevations=found, laser_heights=zeros[0], laser_range_biases=zeros[1]
        )
    low, high = np.degrees(found[[0, -1]])
    note = (
        f"The LiDAR of {returns.topic} is no VLP-16: it has {len(seen)} lasers from {low:.1f} to "
        f"{high:.1f} deg. Elevations are taken from the returns, the divergence of beams from "
        "the VLP-16; give the rig of this LiDAR with its divergence_rad (--rig)."
    )
    return Lasers(rig, rank[rings], heights, (note,), (note,))


def carries_heights(lasers: Lasers, returns: Returns) -> bool | None:
    """Return whether points include the vertical offsets of their beams; None if that is open.

    The points of a laser lie on a line over their horizontal distance; where that meets the spin
    axis is the offset. Its share of the offsets that the maker gives is 1 or 0.
    """
    given, rings = lasers.heights, lasers.rings
    if returns.has_heights is not None or not len(rings) or int(rings.max()) >= len(given):
        return returns.has_heights
    rows = _spread(rings)
    p = returns.p_lidar[rows].astype(np.float64)
    rings, horizontal = rings[rows], np.hypot(p[:, 0], p[:, 1])
    share = weight = 0.0
    for ring in range(len(given)):
        mine = rings == ring
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
        laser_heights=model.heights,
        laser_range_biases=np.zeros(len(model.elevations)),
        cloud_carries_heights=False,
        divergence=np.array(model.divergence),
    )


def _is_model(sample: _Sample, model: Model, n_seen: int) -> bool:
    """Return whether elevations are those of a model, with or without its vertical offsets."""
    if n_seen > len(model.elevations):
        return False
    for heights in (np.zeros_like(model.heights), model.heights):
        heights = np.pad(heights, (0, max(0, int(sample.lasers.max()) + 1 - len(heights))))
        if _agrees(sample.medians(heights)[:n_seen], model.elevations, _MODEL):
            return True
    return False


def _agrees(found: Array, known: Array, limit: float) -> bool:
    """Return whether all elevations that were found are those that are known."""
    if len(found) > len(known):
        return False
    return bool(np.nanmax(np.abs(known[: len(found)] - found)) < limit)


def _sample(returns: Returns) -> _Sample:
    """Return some returns that are far enough."""
    rows = _spread(returns.rings)
    p = returns.p_lidar[rows].astype(np.float64)
    horizontal = np.hypot(p[:, 0], p[:, 1])
    is_far = horizontal > _FAR
    return _Sample(p[is_far, 2], horizontal[is_far], returns.rings[rows][is_far])


def _spread(rings: Rings) -> Index:
    """Return places of some returns, spread evenly, but not at the pace of any pattern of rings."""
    n, most = len(rings), max(_SAMPLE, _SAMPLE_RING * (int(rings.max()) + 1))
    if n <= most:
        return np.arange(n)
    return np.asarray(np.arange(most) * _GOLDEN % 1.0 * n, np.intp)
