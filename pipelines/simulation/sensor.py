"""The VLP-16, pulse by pulse: when each laser fires, and the record of its echo."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.model import Array, Column, Firings, Index, Mask, Nanos, Rig, Rings, seal
from spheremark.pipelines.scan.rigs import (
    AZIMUTH_STEP,
    FIRING_CYCLE,
    FIRING_ORDER,
    FIRINGS_PER_BLOCK,
    LASER_CYCLE,
    N_BLOCKS,
    N_LASERS,
    RANGE_STEP,
)
from spheremark.pipelines.simulation.echo import Aims, Echoes
from spheremark.pipelines.simulation.options import Optics, SimulationConfig
from spheremark.pipelines.simulation.rig import Motion, quantised

FIRINGS_PER_PACKET = N_BLOCKS * FIRINGS_PER_BLOCK
"""Firings of all lasers that the sensor sends at once."""

_PULSES_PER_BLOCK = FIRINGS_PER_BLOCK * N_LASERS
_FULL_TURN = 36_000  # steps of an azimuth
_RANGE_LIMITS = (0.9, 100.0)  # [m] the VLP-16's own
_DUST_REACH, _DUST_SHADE = 15.0, 0.05  # [m] up to which dust is detected, and its reflectivity
_NOISE_LIMITS = (5.0, 15.0, 40.0, 100.0)  # calibrated reflectivity, 0-255
_NOISE = np.array(
    [0.0137, 0.0107, 0.0089, 0.0067, 0.0064]
)  # [m] seen in real packets, between them
_INTENSITY_NOISE = (1.0, 0.05)  # counts, and share of the value
_TURN_WITHIN = 0.01  # [rad] more than the head turns within a firing, at 20 revolutions a second
_NS_CYCLE, _NS_LASER = round(FIRING_CYCLE * 1e9), round(LASER_CYCLE * 1e9)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Pulses:
    """Some whole firings of all lasers, in the order of firing.

    Attributes
    ----------
    offsets_ns : (n,)
        Instant of each pulse since the first one of the stop.
    rings : (n,) uint8
        Laser of each pulse, 0 the lowest.
    azimuths : (n,)
        True azimuth of the spinning head, unwrapped, clockwise from x seen from +z [rad].
    gimbal_angles : (n,)
        True angle of the gimbal [rad].
    """

    offsets_ns: Nanos
    rings: Rings
    azimuths: Array
    gimbal_angles: Array

    def __post_init__(self) -> None:
        n = len(self.offsets_ns)
        seal(self, offsets_ns=(n,), rings=(n,), azimuths=(n,), gimbal_angles=(n,))

    def rows(self, chosen: Mask) -> Pulses:
        """Return some of the pulses."""
        return Pulses(
            offsets_ns=self.offsets_ns[chosen],
            rings=self.rings[chosen],
            azimuths=self.azimuths[chosen],
            gimbal_angles=self.gimbal_angles[chosen],
        )


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Recorded:
    """The packets of some pulses, and the points that a driver computes from them.

    Attributes
    ----------
    p_lidar : (n, 3) float32
        Points, heights of the lasers included [m].
    intensities : (n,) float32
        Calibrated reflectivity, 0-255.
    rings : (n,) uint8
        Laser of each return.
    offsets_ns : (n,)
        Instant of each return's pulse since the first one of the stop.
    firings : Firings
        All pulses, with and without a return; its start is that of the stop.
    spheres : (n,)
        Sphere of the scene that each return is from, -1 for none.
    sigmas : (n,)
        Standard deviation of each range [m].
    """

    p_lidar: Column
    intensities: Column
    rings: Rings
    offsets_ns: Nanos
    firings: Firings
    spheres: Index
    sigmas: Array

    def __post_init__(self) -> None:
        n = len(self.rings)
        columns = ("intensities", "rings", "offsets_ns", "spheres", "sigmas")
        seal(self, p_lidar=(n, 3), **dict.fromkeys(columns, (n,)))

    @classmethod
    def joined(cls, pieces: Sequence[Self], start_ns: int) -> Self:
        """Return several pieces of one recording as one."""

        def whole(parts: Iterable[NDArray[Any]]) -> NDArray[Any]:
            return np.concatenate(list(parts))

        columns = ("p_lidar", "intensities", "rings", "offsets_ns", "spheres", "sigmas")
        firings = {
            name: whole(getattr(piece.firings, name) for piece in pieces)
            for name in ("azimuths", "distances", "reflectivities")
        }
        return cls(
            **{name: whole(getattr(piece, name) for piece in pieces) for name in columns},
            firings=Firings(**firings, start_ns=start_ns),
        )


def fire(first: int, n: int, start_azimuth: float, motion: Motion, spin_rpm: float) -> Pulses:
    """Return some firings of all lasers."""
    firings = np.arange(first, first + n, dtype=np.int64)
    offsets_ns = (firings[:, None] * _NS_CYCLE + np.arange(N_LASERS) * _NS_LASER).ravel()
    times = np.asarray(offsets_ns * 1e-9, dtype=np.float64)
    return Pulses(
        offsets_ns=offsets_ns,
        rings=np.tile(FIRING_ORDER.astype(np.uint8), n),
        azimuths=start_azimuth + 2 * np.pi * spin_rpm / 60.0 * times,
        gimbal_angles=motion.angle_at(times),
    )


def aim(pulses: Pulses, rig: Rig, T_site_base: Array) -> Aims:
    """Return origins and directions of the beams of some pulses."""
    lasers = np.column_stack([rig.laser_elevations, rig.laser_heights])
    posed = _posed(rig.T_head_lidar, T_site_base)
    origins, directions, axes = _aim(
        pulses.azimuths, pulses.gimbal_angles, pulses.rings, lasers, posed
    )
    return Aims(origins_site=origins, directions_site=directions, spin_axes_site=axes)


def may_pass(pulses: Pulses, rig: Rig, T_site_base: Array, p_site: Array, near: float) -> Mask:
    """Return the pulses of all firings in which a beam may pass a point closely."""
    first = slice(None, None, N_LASERS)
    posed = _posed(rig.T_head_lidar, T_site_base)
    limits = (near, np.abs(rig.laser_elevations).max(), np.abs(rig.laser_heights).max())
    found = _may_pass(pulses.azimuths[first], pulses.gimbal_angles[first], posed, p_site, limits)
    return np.asarray(np.repeat(found, N_LASERS))


def record(
    pulses: Pulses, echoes: Echoes, rig: Rig, config: SimulationConfig, rng: np.random.Generator
) -> Recorded:
    """Return the record of some pulses."""
    optics = config.optics
    echoes = _disturbed(echoes, optics, rng)
    seen = np.flatnonzero(_is_seen(echoes, config, rng))
    rings, shades = pulses.rings[seen], 100.0 * echoes.reflectivities[seen]
    sigmas = np.broadcast_to(
        range_noise(shades) if config.sigma_range is None else config.sigma_range, len(seen)
    )
    if optics.sigma_weak:
        sigmas = np.hypot(sigmas, optics.sigma_weak / _strengths(echoes, optics, seen))
    ranges = (1.0 + optics.range_scale) * echoes.ranges[seen] + rig.laser_range_biases[rings]
    ranges = quantised(ranges + sigmas * rng.standard_normal(len(seen)), config.range_step)
    azimuths = recorded_azimuths(pulses.azimuths, config.azimuth_step, seen)
    floor, share = _INTENSITY_NOISE
    counts = shades + (floor + share * shades) * rng.standard_normal(len(seen))
    intensities = np.clip(np.round(counts), 0.0, 255.0).astype(np.float32)
    return Recorded(
        p_lidar=_points(ranges, azimuths, rig.laser_elevations[rings], rig.laser_heights[rings]),
        intensities=intensities,
        rings=rings,
        offsets_ns=pulses.offsets_ns[seen],
        firings=_firings(pulses.azimuths, seen, ranges, intensities),
        spheres=echoes.spheres[seen],
        sigmas=np.array(sigmas),
    )


def recorded_azimuths(azimuths: Array, step: float, chosen: Index) -> Array:
    """Return the azimuths that a driver computes for some pulses of whole packets.

    Notes
    -----
    A packet holds the azimuth of the first of 32 pulses, rounded to the step; that of the others
    follows from the mean speed within the packet and is rounded again, as drivers do.
    """
    blocks = quantised(azimuths.reshape(-1, N_BLOCKS, _PULSES_PER_BLOCK)[:, :, 0], step)
    block, k = np.divmod(chosen, _PULSES_PER_BLOCK)
    times = k // N_LASERS * FIRING_CYCLE + k % N_LASERS * LASER_CYCLE
    lasting = (N_BLOCKS - 1) * FIRINGS_PER_BLOCK * FIRING_CYCLE
    speeds = (blocks[:, -1] - blocks[:, 0]) / lasting
    found = blocks.ravel()[block] + speeds[block // N_BLOCKS] * times
    return quantised(found, step) % (2 * np.pi)


def _firings(azimuths: Array, seen: Index, ranges: Array, intensities: Column) -> Firings:
    """Return all pulses as packets hold them, given the returns of some."""
    distances, reflectivities = (
        np.zeros(len(azimuths), np.uint16),
        np.zeros(len(azimuths), np.uint8),
    )
    distances[seen] = np.round(np.maximum(ranges, RANGE_STEP) / RANGE_STEP)
    reflectivities[seen] = intensities
    hundredths = np.round(azimuths[::_PULSES_PER_BLOCK] / AZIMUTH_STEP) % _FULL_TURN
    return Firings(
        azimuths=hundredths.astype(np.uint16),
        distances=distances.reshape(-1, _PULSES_PER_BLOCK),
        reflectivities=reflectivities.reshape(-1, _PULSES_PER_BLOCK),
        start_ns=0,
    )


def range_noise(reflectivities: Array) -> Array:
    """Return the range noise of a VLP-16 as seen in real packets."""
    return np.asarray(_NOISE[np.digitize(reflectivities, _NOISE_LIMITS)])


def _disturbed(echoes: Echoes, optics: Optics, rng: np.random.Generator) -> Echoes:
    """Return the echoes with those of dust, which come first, and with ranges that mean nothing."""
    if not optics.dust and not optics.strays:
        return echoes
    ranges, shades = echoes.ranges.copy(), echoes.reflectivities.copy()
    spheres, n = np.array(echoes.spheres), len(echoes.ranges)
    dusty = rng.exponential(1.0 / optics.dust, n) if optics.dust else np.full(n, np.inf)
    is_dust = dusty < np.minimum(ranges, _DUST_REACH)
    is_stray = rng.random(n) < optics.strays
    ranges[is_dust], shades[is_dust] = dusty[is_dust], _DUST_SHADE
    ranges[is_stray] = rng.uniform(*_RANGE_LIMITS, is_stray.sum())
    shades[is_stray] = 1.0
    spheres[is_dust | is_stray] = -1
    return Echoes(ranges=ranges, reflectivities=shades, spheres=spheres)


def _strengths(echoes: Echoes, optics: Optics, chosen: Mask | Index) -> Array:
    """Return the energies of some echoes over that of an even chance of detection."""
    energies = echoes.reflectivities[chosen] / echoes.ranges[chosen] ** 2
    return np.asarray(energies / optics.energy_half)


def _is_seen(echoes: Echoes, config: SimulationConfig, rng: np.random.Generator) -> Mask:
    """Return which echoes are strong enough and near enough, and not lost by chance."""
    is_seen = (echoes.ranges >= _RANGE_LIMITS[0]) & (echoes.ranges <= _RANGE_LIMITS[1])
    strength = np.maximum(_strengths(echoes, config.optics, is_seen), 1e-12)
    chance = (1.0 - config.drop_out) / (1.0 + strength ** (-1.0 / config.optics.softness))
    is_seen[is_seen] = rng.random(len(chance)) < chance
    return is_seen


def _points(ranges: Array, azimuths: Array, elevations: Array, heights: Array) -> Column:
    """Return recorded polar measurements as points, (n, 3) (VLP-16 manual, section 9)."""
    reach = ranges * np.cos(elevations)
    x, y = reach * np.cos(azimuths), -reach * np.sin(azimuths)
    return np.column_stack([x, y, ranges * np.sin(elevations) + heights]).astype(np.float32)


def _posed(T_head_lidar: Array, T_site_base: Array) -> Array:
    """Return C, S and K, (3, 3, 4): T_site_base Rz(a) T_head_lidar is cos(a) C + sin(a) S + K."""
    turning = np.zeros((3, 4, 4))
    turning[0, :2, :2] = [[1.0, 0.0], [0.0, 1.0]]
    turning[1, :2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    turning[2, 2:, 2:] = [[1.0, 0.0], [0.0, 1.0]]
    return np.ascontiguousarray((T_site_base @ turning @ T_head_lidar)[:, :3])


@compiled
def _may_pass(
    azimuths: Array,
    gimbal_angles: Array,
    posed: Array,
    points: Array,
    limits: tuple[float, float, float],
) -> Mask:  # pragma: no cover
    """Return which firings, fans about the spin axis, may pass a point within the first limit.

    The others are the steepest elevation and the largest height of a laser.
    """
    near, steepest, highest = limits
    slope, reach = np.tan(steepest), near / np.cos(steepest) + highest
    found = np.zeros(len(azimuths), dtype=np.bool_)
    w, axis, ahead = np.empty(3), np.empty(3), np.empty(3)
    for i in range(len(azimuths)):
        c, s = np.cos(gimbal_angles[i]), np.sin(gimbal_angles[i])
        x, y = np.cos(azimuths[i]), -np.sin(azimuths[i])
        for k in range(3):
            column_x = c * posed[0, k, 0] + s * posed[1, k, 0] + posed[2, k, 0]
            column_y = c * posed[0, k, 1] + s * posed[1, k, 1] + posed[2, k, 1]
            ahead[k] = x * column_x + y * column_y
            axis[k] = c * posed[0, k, 2] + s * posed[1, k, 2] + posed[2, k, 2]
            w[k] = c * posed[0, k, 3] + s * posed[1, k, 3] + posed[2, k, 3]
        for j in range(len(points)):
            px, py, pz = points[j, 0] - w[0], points[j, 1] - w[1], points[j, 2] - w[2]
            forward = px * ahead[0] + py * ahead[1] + pz * ahead[2]
            along = px * axis[0] + py * axis[1] + pz * axis[2]
            from_axis2 = max(px * px + py * py + pz * pz - along * along, 0.0)
            from_axis = np.sqrt(from_axis2)
            if (
                forward > -reach
                and from_axis2 - forward * forward <= (near + _TURN_WITHIN * from_axis) ** 2
                and abs(along) <= reach + slope * from_axis
            ):
                found[i] = True
                break
    return found


@compiled
def _aim(
    azimuths: Array, gimbal_angles: Array, rings: Rings, lasers: Array, posed: Array
) -> tuple[Array, Array, Array]:  # pragma: no cover
    """Return origins, directions and spin axes of pulses in the site frame, (n, 3) each.

    ``lasers`` holds elevation and height of each laser, (k, 2); ``posed`` is that of ``_posed``.
    """
    n = len(azimuths)
    origins, directions, axes = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
    for i in range(n):
        elevation, height = lasers[rings[i], 0], lasers[rings[i], 1]
        c, s = np.cos(gimbal_angles[i]), np.sin(gimbal_angles[i])
        x = np.cos(elevation) * np.cos(azimuths[i])
        y = -np.cos(elevation) * np.sin(azimuths[i])
        z = np.sin(elevation)
        for k in range(3):
            column_x = c * posed[0, k, 0] + s * posed[1, k, 0] + posed[2, k, 0]
            column_y = c * posed[0, k, 1] + s * posed[1, k, 1] + posed[2, k, 1]
            column_z = c * posed[0, k, 2] + s * posed[1, k, 2] + posed[2, k, 2]
            shift = c * posed[0, k, 3] + s * posed[1, k, 3] + posed[2, k, 3]
            origins[i, k] = shift + height * column_z
            directions[i, k] = x * column_x + y * column_y + z * column_z
            axes[i, k] = column_z
    return origins, directions, axes
