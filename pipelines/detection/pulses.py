"""The pulses about a place that no return shows: where the sky is behind, or echoes are lost.

A driver drops pulses that did not return, but lasers fire by the clock: the azimuths and gimbal
angles of some returns determine every pulse between them. A pulse is known by the number of its
firing times 16 plus its laser.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.detection.target import Target, view_of
from spheremark.pipelines.model import RING_UNKNOWN, Array, Index, Mask, Rig, StitchedCloud
from spheremark.pipelines.scan.interpolation import errors_of_interpolation
from spheremark.pipelines.scan.rigs import FIRING_CYCLE, FIRING_ORDER, LASER_CYCLE, N_LASERS

_REACH = 3.0  # radii: the returns of beams that pass nearer are all known
_DELAYS = np.argsort(FIRING_ORDER) * LASER_CYCLE  # [s] of each laser within its firing
_PHASE_MAX = 3e-6  # [s] scatter of the firing clock: about one laser's share of a firing
_KNOT = 0.002  # [s] between the returns that show spin and gimbal: far less than a revolution
_N_KNOTS = (500, 50_000)
_OFF_MAX = 1e-3  # [rad] a third of a beam: median by which a pulse may be misplaced
_SLOWEST, _FASTEST = 2.0, 200.0  # [rad/s] of a spin
_MARGIN = 0.006  # [rad] beside a place where pulses are tried: what turns within a firing
_LEVEL = 0.9  # least cosine of the elevation of a laser

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
        Instants, azimuths of the spin, both increasing, and angles of the gimbal [s], [rad].
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


def clock_of(cloud: StitchedCloud) -> Clock | None:
    """Return the clock of a scan; None where rings or times are unknown or follow no such clock."""
    n = len(cloud.p_base)
    if len(cloud.rig.laser_elevations) != N_LASERS or n < _N_KNOTS[0]:
        return None
    n_knots = int(np.clip(cloud.duration / _KNOT, *_N_KNOTS))
    rows = np.unique(np.linspace(0, n - 1, n_knots).astype(np.intp))
    is_known = (cloud.rings[rows] != RING_UNKNOWN) & np.isfinite(cloud.p_base[rows]).all(axis=1)
    times, first = np.unique(cloud.seconds(rows[is_known]), return_index=True)
    rows = rows[is_known][first]
    if len(rows) < _N_KNOTS[0] // 2:
        return None
    turns = np.exp(2j * np.pi * (times - _DELAYS[cloud.rings[rows]]) / FIRING_CYCLE)
    per_radian = FIRING_CYCLE / (2 * np.pi)
    off = per_radian * np.angle(turns / turns.mean())
    angles = np.unwrap(cloud.gimbal_angles[rows].astype(np.float64))
    azimuths, _ = _seen_from_lidar(cloud.rig, cloud.p_base[rows].T, angles)
    gaps = np.diff(times)
    rates = (np.diff(azimuths) % (2 * np.pi) / gaps)[gaps < 4.0 * _KNOT]
    spin = float(np.median(rates)) if len(rates) else 0.0
    azimuths = spin * times + np.unwrap(azimuths - spin * times)
    # every second one against its neighbours
    misplaced = azimuths[1:-1:2] - np.interp(times[1:-1:2], times[::2], azimuths[::2])
    is_steady = np.sqrt(np.mean(off**2)) < _PHASE_MAX and _SLOWEST < spin < _FASTEST
    if not (is_steady and np.median(np.abs(misplaced)) < _OFF_MAX):
        return None
    phase = per_radian * float(np.angle(turns.mean()))
    bends = errors_of_interpolation(cloud.gimbal_angles, rows)
    return Clock(phase, times, azimuths, angles, bends, cloud.rig)


def unheard_about(
    cloud: StitchedCloud, clock: Clock, rows: NDArray[np.int32], c: Array, target: Target
) -> Array:
    """Return where pulses without a return pass a centre, across and up [m], and faces, (3, k).

    ``rows`` are the returns about it. Once a revolution the plane of the lasers passes the centre:
    about that instant the pulses of the lasers that point there are tried.
    """
    reach = _REACH * target.radius
    wide = np.arcsin(min(reach / float(np.linalg.norm(c)), 1.0))
    spin = (clock.azimuths[-1] - clock.azimuths[0]) / (clock.times[-1] - clock.times[0])
    turn = 2 * np.pi  # and before and after the scan: the place goes about the spin axis too
    revolutions = np.arange(clock.azimuths[0] - 2 * turn, clock.azimuths[-1] + 2 * turn, turn)
    instants = np.interp(revolutions, clock.azimuths, clock.times)
    elevations = np.zeros(len(instants))
    for _ in range(2):
        angles = np.interp(instants, clock.times, clock.angles)
        azimuths, elevations = _seen_from_lidar(clock.rig, c, angles)
        ahead = np.unwrap(azimuths - clock.azimuths[0])
        instants = np.interp(revolutions + ahead, clock.azimuths, clock.times)
    wide += _MARGIN
    aims = np.abs(elevations[:, None] - clock.rig.laser_elevations)
    passages, rings = np.nonzero(aims < wide)
    across = np.sqrt(wide**2 - aims[passages, rings] ** 2) / (_LEVEL * spin * FIRING_CYCLE)
    most = int(across.max(initial=0.0))
    shifts = np.arange(-most, most + 1)
    tried, later = np.nonzero(np.abs(shifts) <= across[:, None])
    firings = np.rint((instants[passages] - clock.phase) / FIRING_CYCLE).astype(np.int64)
    firings, rings = firings[tried] + shifts[later], rings[tried]
    v_lidar, angles, is_known = _beams(clock, firings, rings)
    gaps = _to_lidar(clock.rig, c, angles)
    gaps[2] -= clock.rig.laser_heights[rings]
    along = np.sum(gaps * v_lidar, axis=0)
    passing = along * v_lidar - gaps
    near = np.flatnonzero(is_known & (along > 0.0) & (np.sum(passing**2, axis=0) < reach**2))
    pulses, first = np.unique(firings[near] * N_LASERS + rings[near], return_index=True)
    heard = _pulses(cloud, clock, rows[cloud.rings[rows] < N_LASERS].astype(np.intp))
    found = near[first[~np.isin(pulses, heard, assume_unique=True)]]
    view, angles = view_of(c, target.up), angles[found]
    is_left = np.sin(angles) * c[0] < np.cos(angles) * c[1]
    p_base = _turned(clock.rig.T_head_lidar[:3, :3] @ passing[:, found], angles)
    return np.array([view.across @ p_base, view.up @ p_base, np.where(is_left, 0.5, -0.5)])


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
    """Return how well a scan hears its echoes, by the firings after some that it heard."""
    starts = np.linspace(0, len(cloud.p_base) - _N_SAMPLE, _N_SAMPLES).astype(np.intp)
    in_time = np.argsort(np.asarray(cloud.times), kind="stable")  # whatever the order of returns
    rows = in_time[starts[:, None] + np.arange(_N_SAMPLE)]
    strengths = cloud.intensities[rows] / np.sum(cloud.p_base[rows] ** 2, axis=-1)
    heard = _pulses(cloud, clock, rows.ravel()).reshape(rows.shape)
    following = heard // N_LASERS + 1
    tried = np.unique(following[following < following.max(axis=1, keepdims=True) - 1])
    firings, rings = np.repeat(tried, N_LASERS), np.tile(np.arange(N_LASERS), len(tried))
    v_lidar, angles, _ = _beams(clock, firings, rings)
    x, y, z = _turned(clock.rig.T_head_lidar[:3, :3] @ v_lidar, angles)
    steep = up @ (x, y, z)
    is_ground = (steep > -_GROUND[1]) & (steep < -_GROUND[0])
    sectors = (np.arctan2(y, x)[is_ground] * _N_SECTORS / 6.2832).astype(int) + _N_SECTORS
    is_heard = np.isin((firings * N_LASERS + rings)[is_ground], heard)
    n, n_heard = np.bincount(sectors), np.bincount(sectors, weights=is_heard)
    is_shown = n >= _N_IN_SECTOR
    shares = 1.0 - n_heard[is_shown] / n[is_shown]  # by sectors: the rover hides some of the ground
    lost = float(np.median(shares)) if len(shares) > _N_SECTORS // 2 else 1.0
    return Hearing(lost, float(np.nanquantile(strengths, _WEAKEST)))


def _beams(
    clock: Clock, firings: NDArray[np.int64], rings: NDArray[np.int64]
) -> tuple[Array, Array, Mask]:
    """Return directions of pulses in the frame of the LiDAR, gimbal angles, and whether known."""
    instants = clock.phase + firings * FIRING_CYCLE + _DELAYS[rings]
    azimuths = np.interp(instants, clock.times, clock.azimuths)
    level, z = (f(clock.rig.laser_elevations)[rings] for f in (np.cos, np.sin))
    return (
        np.array([level * np.cos(azimuths), -level * np.sin(azimuths), z]),
        np.interp(instants, clock.times, clock.angles),
        _is_recorded(clock, instants)
        & (np.interp(instants, clock.times, clock.bends) <= clock.bend_max),
    )


def _is_recorded(clock: Clock, instants: Array) -> Mask:
    """Return which instants lie in no pause: a revolution or more without a return is one."""
    n_turns = (clock.azimuths[-1] - clock.azimuths[0]) / (2.0 * np.pi)
    revolution = (clock.times[-1] - clock.times[0]) / n_turns
    later = np.searchsorted(clock.times, instants).clip(1, len(clock.times) - 1)
    is_inside = (instants > clock.times[0]) & (instants < clock.times[-1])
    is_inside &= clock.times[later] - clock.times[later - 1] < revolution
    return np.asarray(is_inside)


def _pulses(cloud: StitchedCloud, clock: Clock, rows: Index) -> NDArray[np.int64]:
    """Return the pulses of some returns."""
    rings = np.minimum(cloud.rings[rows], N_LASERS - 1).astype(np.int64)
    seconds = cloud.seconds(rows) - _DELAYS[rings] - clock.phase
    return np.rint(seconds / FIRING_CYCLE).astype(np.int64) * N_LASERS + rings


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
