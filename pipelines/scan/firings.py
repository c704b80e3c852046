"""All pulses of a scan, with and without a return: a driver drops those that have none.

Lasers fire by the clock: times, azimuths and gimbal angles of some returns determine every pulse
between them. A pulse is known by the number of its firing times 16 plus its laser.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spheremark.pipelines.model import RING_UNKNOWN, Array, Index, Mask, Rig, Rings, StitchedCloud
from spheremark.pipelines.scan.interpolation import errors_of_interpolation
from spheremark.pipelines.scan.rigs import FIRING_CYCLE, LASER_DELAYS, N_LASERS

_PHASE_MAX = 3e-6  # [s] scatter of the firing clock: about one laser's share of a firing
_KNOT = 0.0005  # [s] between the returns that show spin and gimbal: far less than a revolution
_N_KNOTS = (500, 200_000)
_STEADY = (0.01, 0.05)  # [s] before and after a return that show azimuth and speed of the spin
_PAUSE = 0.9  # of a revolution without a return: the scan was not recorded
_OFF_MAX = 1e-3  # [rad] a third of a beam: median by which a pulse may be misplaced
_SLOWEST, _FASTEST = 2.0, 200.0  # [rad/s] of a spin
_MARGIN = 0.006  # [rad] beside a place where pulses are tried: what turns within a firing
_BLOCK = 500_000  # returns whose pulses are numbered at once
_LEVEL = 0.9  # least cosine of the elevation of a laser


class Clock(NamedTuple):
    """When the lasers fire, and where they point then.

    Attributes
    ----------
    phase : float
        Instant of firing 0 [s].
    times, azimuths, angles : (k,)
        Instants, increasing, azimuths of the spin, unwrapped, and angles of the gimbal [s], [rad].
    bends : (k,)
        By how much these angles may be off where the gimbal starts or stops [rad].
    rig : Rig
        The rig, with its 16 lasers.
    bend_max : float
        Pulses whose angle may be off by more are not known [rad].
    """

    phase: float
    times: Array
    azimuths: Array
    angles: Array
    bends: Array
    rig: Rig
    bend_max: float = np.inf

    @property
    def spin(self) -> float:
        """Mean speed of the spin [rad/s]."""
        return float((self.azimuths[-1] - self.azimuths[0]) / (self.times[-1] - self.times[0]))


class Pulses(NamedTuple):
    """Some pulses, whether they had a return or not.

    Attributes
    ----------
    numbers : (k,)
        Their numbers.
    directions : (3, k)
        Unit vectors along the beams, in the frame of the LiDAR.
    angles : (k,)
        Angles of the gimbal [rad].
    is_known : (k,)
        Whether the scan was recorded then, and the angles are good.
    """

    numbers: Index
    directions: Array
    angles: Array
    is_known: Mask

    @property
    def rings(self) -> Index:
        """Lasers of the pulses."""
        return self.numbers % N_LASERS


def clock_of(cloud: StitchedCloud) -> tuple[Clock | None, str]:
    """Return the clock of a scan.

    Parameters
    ----------
    cloud : StitchedCloud
        The scan.

    Returns
    -------
    Clock or None, str
        None where rings and times do not tell; and why, as the end of a sentence.
    """
    n, n_lasers = len(cloud.p_base), len(cloud.rig.laser_elevations)
    if n_lasers != N_LASERS:
        return None, f"the rig has {n_lasers} lasers, not a VLP-16's 16"
    n_knots = int(np.clip(cloud.duration / _KNOT, *_N_KNOTS))
    rows = np.unique(np.linspace(0, n - 1, n_knots).astype(np.intp)) if n else np.zeros(0, np.intp)
    is_known = (cloud.rings[rows] != RING_UNKNOWN) & np.isfinite(cloud.p_base[rows]).all(axis=1)
    times, first = np.unique(cloud.seconds(rows[is_known]), return_index=True)
    rows = rows[is_known][first]
    if not len(rows) and n:
        return None, "the rings of the returns are not known"
    if len(rows) < _N_KNOTS[0] // 2:
        return None, "too few returns have times that show when the lasers fire"
    turns = np.exp(2j * np.pi * (times - LASER_DELAYS[cloud.rings[rows]]) / FIRING_CYCLE)
    per_radian = FIRING_CYCLE / (2 * np.pi)
    off = per_radian * np.angle(turns / turns.mean())
    if not np.sqrt(np.mean(off**2)) < _PHASE_MAX:
        return None, "the times of the returns do not follow the VLP-16's firing cycle"
    angles = np.unwrap(cloud.gimbal_angles[rows].astype(np.float64))
    azimuths, _ = _seen_from_lidar(cloud.rig, cloud.p_base[rows].T, angles)
    gaps = np.diff(times)
    rates = (np.diff(azimuths) % (2 * np.pi) / gaps)[gaps < _STEADY[0]]
    spin = float(np.median(rates)) if len(rates) else 0.0
    azimuths = spin * times + np.unwrap(azimuths - spin * times)
    # every second one against its neighbours
    misplaced = azimuths[1:-1:2] - np.interp(times[1:-1:2], times[::2], azimuths[::2])
    if not (np.median(np.abs(misplaced)) < _OFF_MAX and _SLOWEST < spin < _FASTEST):
        return None, "the azimuths of the returns do not follow a steady spin"
    phase = per_radian * float(np.angle(turns.mean()))
    azimuths = _smooth(times, azimuths)
    bends = errors_of_interpolation(cloud.gimbal_angles, rows)
    return Clock(phase, times, azimuths, angles, bends, cloud.rig), ""


def _smooth(times: Array, azimuths: Array) -> Array:
    """Return means of azimuths, which are rounded, moved along by the speed of the spin there."""
    sums = np.cumsum(np.insert(np.stack([times, azimuths]), 0, 0.0, axis=1), axis=1)

    def means(before: float, after: float) -> Array:
        first = np.searchsorted(times, times - before)
        end = np.searchsorted(times, times + after, side="right")
        return np.asarray((sums[:, end] - sums[:, first]) / (end - first))

    mean_times, found = means(_STEADY[0], _STEADY[0])
    lasting, turned = means(0.0, _STEADY[1]) - means(_STEADY[1], 0.0)
    spins = np.divide(turned, lasting, out=np.zeros_like(times), where=lasting > 0.0)
    return np.asarray(found + spins * (times - mean_times))


def pulses_about(clock: Clock, c: Array, reach: float) -> tuple[Pulses, Array, Array]:
    """Return the known pulses that pass a place, how, and how far along the beams it is.

    Parameters
    ----------
    clock : Clock
        The clock of a scan.
    c : (3,)
        The place, in base [m].
    reach : float
        How near they pass it [m].

    Returns
    -------
    Pulses, (3, k), (k,)
        In the order of their numbers; from the place to the nearest point of each beam, in the
        frame of the LiDAR [m]; from where the beam leaves the LiDAR to that point [m].

    Notes
    -----
    Once a revolution the plane of the lasers passes the place: about that instant the pulses of the
    lasers that point there are tried.
    """
    wide = np.arcsin(min(reach / float(np.linalg.norm(c)), 1.0))
    turn = 2 * np.pi  # and before and after the scan: the place goes about the spin axis too
    revolutions = np.arange(clock.azimuths[0] - 2 * turn, clock.azimuths[-1] + 2 * turn, turn)
    instants = np.interp(revolutions, clock.azimuths, clock.times)
    elevations = np.zeros(len(instants))
    for _ in range(2):
        angles = np.interp(instants, clock.times, clock.angles)
        azimuths, elevations = _seen_from_lidar(clock.rig, c, angles)
        ahead = np.unwrap(azimuths - clock.azimuths[0])
        instants = np.interp(revolutions + ahead, clock.azimuths, clock.times)
    wide += _MARGIN + np.abs(clock.rig.laser_heights).max() / np.linalg.norm(c)
    aims = np.abs(elevations[:, None] - clock.rig.laser_elevations)
    passages, rings = np.nonzero(aims < wide)
    across = np.sqrt(wide**2 - aims[passages, rings] ** 2) / (_LEVEL * clock.spin * FIRING_CYCLE)
    most = int(across.max(initial=0.0))
    shifts = np.arange(-most, most + 1)
    tried, later = np.nonzero(np.abs(shifts) <= across[:, None])
    firings = np.rint((instants[passages] - clock.phase) / FIRING_CYCLE).astype(np.int64)
    tried_ones = (firings[tried] + shifts[later]) * N_LASERS + rings[tried]
    pulses = pulses_of(clock, np.unique(tried_ones))
    gaps = _to_lidar(clock.rig, c, pulses.angles)
    gaps[2] -= clock.rig.laser_heights[pulses.rings]
    along = np.sum(gaps * pulses.directions, axis=0)
    passing = along * pulses.directions - gaps
    near = pulses.is_known & (along > 0.0) & (np.sum(passing**2, axis=0) < reach**2)
    return Pulses._make(column[..., near] for column in pulses), passing[:, near], along[near]


def pulses_of(clock: Clock, numbers: Index) -> Pulses:
    """Return some pulses.

    Parameters
    ----------
    clock : Clock
        The clock of a scan.
    numbers : (k,)
        Their numbers.

    Returns
    -------
    Pulses
        In that order.
    """
    rings = numbers % N_LASERS
    instants = clock.phase + numbers // N_LASERS * FIRING_CYCLE + LASER_DELAYS[rings]
    azimuths = np.interp(instants, clock.times, clock.azimuths)
    level, z = (f(clock.rig.laser_elevations)[rings] for f in (np.cos, np.sin))
    return Pulses(
        numbers,
        np.array([level * np.cos(azimuths), -level * np.sin(azimuths), z]),
        np.interp(instants, clock.times, clock.angles),
        _is_recorded(clock, instants)
        & (np.interp(instants, clock.times, clock.bends) <= clock.bend_max),
    )


def numbers_of(cloud: StitchedCloud, clock: Clock, rows: Index | slice) -> Index:
    """Return the numbers of the pulses of some returns.

    Parameters
    ----------
    cloud : StitchedCloud
        The scan.
    clock : Clock
        Its clock.
    rows : (k,) or slice
        Rows of the cloud; those whose rings are not known count as of the last laser.

    Returns
    -------
    (k,)
        Numbers.
    """
    return _numbers(clock, cloud.rings[rows], cloud.seconds(rows))


def heard_of(cloud: StitchedCloud, clock: Clock) -> Index:
    """Return the numbers of all pulses that have a return, however near it is.

    Parameters
    ----------
    cloud : StitchedCloud
        The scan.
    clock : Clock
        Its clock.

    Returns
    -------
    (k,)
        Numbers, ascending.
    """
    begins = range(0, len(cloud.p_base), _BLOCK)
    parts = [numbers_of(cloud, clock, slice(begin, begin + _BLOCK)) for begin in begins]
    return np.sort(np.concatenate([*parts, near_of(cloud, clock)]), kind="stable")


def near_of(cloud: StitchedCloud, clock: Clock) -> Index:
    """Return the numbers of the pulses whose return is nearer than the least range.

    Parameters
    ----------
    cloud : StitchedCloud
        The scan.
    clock : Clock
        Its clock.

    Returns
    -------
    (k,)
        Numbers.
    """
    return _numbers(clock, cloud.near_rings, cloud.near_times)


def _numbers(clock: Clock, rings: Rings, seconds: Array) -> Index:
    """Return the numbers of the pulses of some lasers at some instants."""
    lasers = np.minimum(rings, N_LASERS - 1).astype(np.int64)
    firings = np.rint((seconds - LASER_DELAYS[lasers] - clock.phase) / FIRING_CYCLE)
    return np.asarray(firings.astype(np.int64) * N_LASERS + lasers)


def in_base(rig: Rig, v_lidar: Array, angles: Array) -> Array:
    """Return vectors in the base frame.

    Parameters
    ----------
    rig : Rig
        How the LiDAR sits on the gimbal.
    v_lidar : (3, k) or (3, 1)
        Vectors in the frame of the LiDAR.
    angles : (k,)
        Angles of the gimbal [rad].

    Returns
    -------
    (3, k)
        The vectors in base.
    """
    return _turned(rig.T_head_lidar[:3, :3] @ v_lidar, angles)


def _is_recorded(clock: Clock, instants: Array) -> Mask:
    """Return which instants lie in no pause."""
    later = np.searchsorted(clock.times, instants).clip(1, len(clock.times) - 1)
    is_inside = (instants > clock.times[0]) & (instants < clock.times[-1])
    longest = _PAUSE * 2.0 * np.pi / clock.spin
    is_inside &= clock.times[later] - clock.times[later - 1] < longest
    return np.asarray(is_inside)


def _seen_from_lidar(rig: Rig, p_base: Array, angles: Array) -> tuple[Array, Array]:
    """Return azimuths, clockwise, and elevations of places as the LiDAR sees them [rad]."""
    x, y, z = _to_lidar(rig, p_base, angles)
    return np.arctan2(-y, x), np.arctan2(z, np.hypot(x, y))


def _to_lidar(rig: Rig, p_base: Array, angles: Array) -> Array:
    """Return places, (3, ...), in the frame of the LiDAR under some gimbal angles, (3, n)."""
    T = rig.T_head_lidar
    return np.asarray(T[:3, :3].T @ (_turned(p_base, -angles) - T[:3, 3:]))


def _turned(v: Array, angles: Array) -> Array:
    """Return some vectors, (3, ...), turned about the axis of the gimbal, (3, n)."""
    c, s = np.cos(angles), np.sin(angles)
    return np.array([c * v[0] - s * v[1], s * v[0] + c * v[1], np.broadcast_to(v[2], c.shape)])
