"""The pulses about a place that no return shows: where the sky is behind, or echoes are lost.

A driver drops pulses that did not return, but lasers fire by the clock: the azimuths and gimbal
angles of some returns determine every pulse between them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.detection.target import Target, view_of
from spheremark.pipelines.model import RING_UNKNOWN, Array, Index, StitchedCloud
from spheremark.pipelines.scan.rigs import FIRING_CYCLE, FIRING_ORDER, LASER_CYCLE, N_LASERS
from spheremark.pipelines.scan.stitching import beams

_REACH = 3.0  # radii: the returns of beams that pass nearer are all known
_DELAYS = np.argsort(FIRING_ORDER) * LASER_CYCLE  # [s] of each laser within its firing
_PHASE_MAX = 3e-6  # [s] scatter of the firing clock: about one laser's share of a firing
_KNOT = 0.002  # [s] between the returns that show spin and gimbal: far less than a revolution
_N_KNOTS = (500, 50_000)
_OFF_MAX = 1e-3  # [rad] a third of a beam: median by which a pulse may be misplaced
_SLOWEST, _FASTEST = 2.0, 200.0  # [rad/s] of a spin
_MARGIN = 0.02  # [rad] beside a place where pulses are searched: what the gimbal turns meanwhile

_N_SAMPLES, _N_SAMPLE = 300, 100  # samples of so many returns that follow each other
_GROUND = (0.25, 0.55)  # sines of the angles below the horizon where the ground is near
_N_SECTORS, _N_IN_SECTOR = 24, 20  # of azimuth, and pulses that show one
_WEAKEST = 0.01  # share of the returns that are taken for the weakest


class Clock(NamedTuple):
    """When the lasers fire, and where they point then.

    Attributes
    ----------
    phase : float
        Instant of firing 0 [s].
    times, azimuths, angles : (k,)
        Instants, increasing [s], azimuths of the spin and angles of the gimbal, unwrapped [rad].
    spin : float
        Rate of the azimuths [rad/s].
    R, origin : (3, 3), (3,)
        Mounting of the LiDAR in the head.
    elevations, heights : (16,)
        Of the lasers [rad], [m].
    """

    phase: float
    times: Array
    azimuths: Array
    angles: Array
    spin: float
    R: Array
    origin: Array
    elevations: Array
    heights: Array


def clock_of(cloud: StitchedCloud) -> Clock | None:
    """Return the clock of a scan; None where rings or times are unknown or follow no such clock."""
    rig, n = cloud.rig, len(cloud.p_base)
    if len(rig.laser_elevations) != N_LASERS or n < _N_KNOTS[0]:
        return None
    n_knots = int(np.clip(cloud.duration / _KNOT, *_N_KNOTS))
    rows = np.unique(np.linspace(0, n - 1, n_knots).astype(np.intp))
    rings = cloud.rings[rows]
    rows = rows[(rings != RING_UNKNOWN) & np.isfinite(cloud.p_base[rows]).all(axis=1)]
    if len(rows) < _N_KNOTS[0] // 2:
        return None
    times = cloud.times[rows].astype(np.float64)
    rows = rows[np.argsort(times, kind="stable")]
    times = cloud.times[rows].astype(np.float64)
    firings = times - _DELAYS[cloud.rings[rows]]
    turns = np.exp(2j * np.pi * firings / FIRING_CYCLE)
    phase = float(np.angle(turns.mean())) / (2 * np.pi) * FIRING_CYCLE
    off = np.angle(turns * np.exp(-2j * np.pi * phase / FIRING_CYCLE)) / (2 * np.pi) * FIRING_CYCLE
    if not np.sqrt(np.mean(off**2)) < _PHASE_MAX:
        return None
    azimuths = _azimuths(cloud, rows)
    gaps, steps = np.diff(times), np.diff(azimuths) % (2 * np.pi)
    is_close = (gaps > 0.0) & (gaps < 4.0 * _KNOT)
    spin = float(np.median(steps[is_close] / gaps[is_close])) if is_close.any() else 0.0
    if not _SLOWEST < spin < _FASTEST:
        return None
    knots = np.append(True, gaps > 0.0)
    times, azimuths, rows = times[knots], azimuths[knots], rows[knots]
    azimuths = _unwrapped(times, azimuths, spin)
    angles = np.unwrap(cloud.gimbal_angles[rows].astype(np.float64))
    # every second one against its neighbours
    off = azimuths[1:-1:2] - np.interp(times[1:-1:2], times[::2], azimuths[::2])
    if not np.median(np.abs(off)) < _OFF_MAX:
        return None
    return Clock(
        phase,
        times,
        azimuths,
        angles,
        spin,
        rig.T_head_lidar[:3, :3].copy(),
        rig.T_head_lidar[:3, 3].copy(),
        rig.laser_elevations.copy(),
        rig.laser_heights.copy(),
    )


def unheard_about(
    cloud: StitchedCloud, clock: Clock, rows: NDArray[np.int32], c: Array, target: Target
) -> Array:
    """Return where pulses without a return pass a centre, across and up [m], and faces, (3, k).

    ``rows`` are the returns about it.
    """
    rows = rows[cloud.rings[rows] < N_LASERS]
    rings = cloud.rings[rows].astype(np.int64)
    seconds = cloud.times[rows.astype(np.intp)] - _DELAYS[rings] - clock.phase
    heard = np.sort(np.rint(seconds / FIRING_CYCLE).astype(np.int64) * N_LASERS + rings)
    found: Array = _unheard(clock, _DELAYS, heard, c, target)
    return found


class Hearing(NamedTuple):
    """How well a scan hears its echoes.

    Attributes
    ----------
    lost : float
        Share of the pulses towards the ground nearby that have no return: the scan loses them
        anyway. 1 where that is not known.
    weakest : float
        Reflectivity over squared range of the weakest returns [1/m^2].
    """

    lost: float
    weakest: float


def hearing_of(cloud: StitchedCloud, clock: Clock, up: Array) -> Hearing:
    """Return how well a scan hears its echoes, by some of its firings."""
    starts = np.linspace(0, max(len(cloud.p_base) - _N_SAMPLE, 0), _N_SAMPLES).astype(np.intp)
    rows = np.minimum((starts[:, None] + np.arange(_N_SAMPLE)).ravel(), len(cloud.p_base) - 1)
    rings = np.minimum(cloud.rings[rows], N_LASERS - 1).astype(np.int64)
    seconds = cloud.times[rows] - _DELAYS[rings] - clock.phase
    numbers = np.rint(seconds / FIRING_CYCLE).astype(np.int64)
    strengths = cloud.intensities[rows] / np.sum(cloud.p_base[rows] ** 2, axis=1)
    firings = _firings_within(numbers.reshape(_N_SAMPLES, -1))
    is_heard = np.zeros((len(firings), N_LASERS), np.bool_)
    places = np.minimum(np.searchsorted(firings, numbers), max(len(firings) - 1, 0))
    is_known = firings[places] == numbers if len(firings) else np.zeros(len(numbers), np.bool_)
    is_heard[places[is_known], rings[is_known]] = True
    directions = _directions(clock, clock.phase + firings.astype(np.float64) * FIRING_CYCLE)
    steep = directions @ up
    is_ground = (steep > -_GROUND[1]) & (steep < -_GROUND[0])
    azimuths = np.arctan2(directions[is_ground, 1], directions[is_ground, 0])
    sectors = (azimuths * _N_SECTORS / 6.2832).astype(int) + _N_SECTORS
    n, n_heard = np.bincount(sectors), np.bincount(sectors, weights=is_heard[is_ground])
    is_shown = n >= _N_IN_SECTOR
    shares = 1.0 - n_heard[is_shown] / n[is_shown]  # by sectors: the rover hides some of the ground
    lost = float(np.median(shares)) if len(shares) > _N_SECTORS // 2 else 1.0
    strengths = strengths[np.isfinite(strengths)]
    return Hearing(lost, float(np.quantile(strengths, _WEAKEST)) if len(strengths) else 0.0)


def _firings_within(numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the firings between the first and the last of each sample, (k, n), each once."""
    begins = numbers.min(axis=1) + 1
    order = np.argsort(begins, kind="stable")
    begins, ends = begins[order], np.minimum(numbers.max(axis=1), begins + _N_SAMPLE)[order]
    begins[1:] = np.maximum(begins[1:], np.maximum.accumulate(ends)[:-1])
    return np.concatenate([np.arange(i, j) for i, j in zip(begins, ends, strict=True)])


def _directions(clock: Clock, instants: Array) -> Array:
    """Return the directions of all lasers at some instants in the base frame, (n, 16, 3)."""
    azimuths = np.interp(instants, clock.times, clock.azimuths)[:, None]
    angles = np.interp(instants, clock.times, clock.angles)[:, None]
    c = np.cos(clock.elevations)
    z = np.broadcast_to(np.sin(clock.elevations), (len(instants), N_LASERS))
    v = np.stack([c * np.cos(azimuths), -c * np.sin(azimuths), z], axis=-1) @ clock.R.T
    x = np.cos(angles) * v[..., 0] - np.sin(angles) * v[..., 1]
    y = np.sin(angles) * v[..., 0] + np.cos(angles) * v[..., 1]
    return np.stack([x, y, v[..., 2]], axis=-1)


def _azimuths(cloud: StitchedCloud, rows: Index) -> Array:
    """Return the azimuths of returns in the frame of the LiDAR, clockwise [rad]."""
    d = beams(cloud, rows).directions_base
    angles = cloud.gimbal_angles[rows].astype(np.float64)
    c, s = np.cos(angles), np.sin(angles)
    v_head = np.column_stack([c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0], d[:, 2]])
    v = v_head @ cloud.rig.T_head_lidar[:3, :3]
    return np.asarray(np.arctan2(-v[:, 1], v[:, 0]))


@compiled
def _unwrapped(times: Array, azimuths: Array, spin: float) -> Array:
    """Return azimuths that grow with the spin, which is followed as it drifts."""
    out = azimuths.copy()
    for i in range(1, len(out)):
        expected = out[i - 1] + spin * (times[i] - times[i - 1])
        out[i] = azimuths[i] + 2 * np.pi * np.round((expected - azimuths[i]) / (2 * np.pi))
    return out


@compiled
def _at(times: Array, values: Array, t: float) -> float:
    """Return a value between knots; beyond them it goes on."""
    i = min(max(int(np.searchsorted(times, t)) - 1, 0), len(times) - 2)
    share = (t - times[i]) / (times[i + 1] - times[i])
    return float(values[i] + share * (values[i + 1] - values[i]))


@compiled
def _unheard(  # noqa: C901, PLR0915  one compiled loop
    clock: Clock, delays: Array, heard: NDArray[np.int64], c: Array, target: Target
) -> Array:
    """Return where pulses that were not heard pass a centre, and on which face, (3, k).

    Once a revolution the plane of the lasers passes the place; about that instant each pulse is
    tried.
    """
    found, n, R = np.empty((3, 256)), 0, clock.R
    view, reach = view_of(c, target.up), _REACH * target.radius
    distance = np.sqrt(c[0] ** 2 + c[1] ** 2 + c[2] ** 2)
    aside = np.sqrt(clock.origin[0] ** 2 + clock.origin[1] ** 2) + np.max(np.abs(clock.heights))
    wide = (reach + aside) / distance + _MARGIN
    low, high = clock.elevations[0] - wide, clock.elevations[-1] + wide
    period, sines, cosines = (
        2 * np.pi / clock.spin,
        np.sin(clock.elevations),
        np.cos(clock.elevations),
    )
    for turn in range(int((clock.times[-1] - clock.times[0]) / period) + 1):
        t = clock.times[0] + turn * period
        elevation = 0.0
        for _ in range(2):
            angle = _at(clock.times, clock.angles, t)
            cs, sn = np.cos(angle), np.sin(angle)
            hx, hy = cs * c[0] + sn * c[1], cs * c[1] - sn * c[0]
            x = R[0, 0] * hx + R[1, 0] * hy + R[2, 0] * c[2]
            y = R[0, 1] * hx + R[1, 1] * hy + R[2, 1] * c[2]
            z = R[0, 2] * hx + R[1, 2] * hy + R[2, 2] * c[2]
            elevation = np.arctan2(z, np.sqrt(x * x + y * y))
            gap = np.arctan2(-y, x) - _at(clock.times, clock.azimuths, t)
            gap -= 2 * np.pi * np.round(gap / (2 * np.pi))
            t += gap / clock.spin
        if elevation < low or elevation > high:
            continue
        half = wide / max(np.cos(elevation), 0.1) / clock.spin
        if t - half < clock.times[0] or t + half > clock.times[-1]:
            continue
        # within the passage spin and gimbal turn evenly
        azimuth_then = _at(clock.times, clock.azimuths, t)
        angle_then = _at(clock.times, clock.angles, t)
        turned = _at(clock.times, clock.angles, t + half) - angle_then
        first = int(np.floor((t - half - clock.phase) / FIRING_CYCLE))
        last = int(np.ceil((t + half - clock.phase) / FIRING_CYCLE))
        for number in range(first, last + 1):
            instant = clock.phase + number * FIRING_CYCLE
            azimuth = azimuth_then + clock.spin * (instant - t)
            angle = angle_then + turned * (instant - t) / half
            cs, sn = np.cos(angle), np.sin(angle)
            ca, sa = np.cos(azimuth), np.sin(azimuth)
            for ring in range(len(delays)):
                if abs(clock.elevations[ring] - elevation) > wide:
                    continue
                key = number * len(delays) + ring
                at = np.searchsorted(heard, key)
                if at < len(heard) and heard[at] == key:
                    continue
                a = clock.spin * delays[ring]  # small: to the first order
                x = cosines[ring] * (ca - a * sa)
                y, z = -cosines[ring] * (sa + a * ca), sines[ring]
                u = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z
                v = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z
                w = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z
                height = clock.heights[ring]
                p = clock.origin[0] + height * R[0, 2]
                q = clock.origin[1] + height * R[1, 2]
                r = clock.origin[2] + height * R[2, 2]
                p, q, u, v = cs * p - sn * q, sn * p + cs * q, cs * u - sn * v, sn * u + cs * v
                along = (c[0] - p) * u + (c[1] - q) * v + (c[2] - r) * w
                dx, dy, dz = p + along * u - c[0], q + along * v - c[1], r + along * w - c[2]
                if along < 0.0 or dx * dx + dy * dy + dz * dz > reach * reach:
                    continue
                if n == found.shape[1]:
                    found = np.concatenate((found, np.empty_like(found)), axis=1)
                found[0, n] = dx * view.across[0] + dy * view.across[1] + dz * view.across[2]
                found[1, n] = dx * view.up[0] + dy * view.up[1] + dz * view.up[2]
                found[2, n] = 0.5 if sn * c[0] < cs * c[1] else -0.5
                n += 1
    return found[:, :n].copy()
