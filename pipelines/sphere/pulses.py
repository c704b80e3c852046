"""All pulses that pass a sphere, including those without a recorded return.

A driver drops pulses that did not return, but lasers fire by the clock: ring, time and azimuth of
the returns about a marker determine every pulse between them.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.geometry import levelling_rotation
from spheremark.pipelines.model import RING_UNKNOWN, Array, Index, Mask, StitchedCloud
from spheremark.pipelines.scan.rigs import FIRING_CYCLE, FIRING_ORDER, LASER_CYCLE, N_LASERS
from spheremark.pipelines.scan.stitching import beams

_DELAYS = np.argsort(FIRING_ORDER) * LASER_CYCLE  # [s] of each laser within its firing
_PHASE_MAX = 3e-6  # [s] scatter of the firing clock: one laser's share of a firing
_N_TIMED = 20_000  # returns from which the clock and the spin are estimated
_THINNED = 8  # of these one in so many for the mean rate of the spin
_SPIN_MAX = np.radians(0.2)  # scatter of azimuths about a steady spin
_REACH = 1.5  # radii: pulses that pass a centre closer are taken
_DEPTH = 2.0  # radii before and behind the centre within which a return is the sphere's own
_POLE_FROM, _POLE = 0.6, 0.35  # radii below the centre, and from the vertical: may be the pole
_DRIFT = 0.05  # [s] over which the spin is steady
_CLOSE = 0.02  # [s] between returns of the same part of a revolution
_N_RATES = 10
_SEARCHES = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)  # half widths of the search for the rate, relative
_MARGIN = np.radians(1.0)  # effect of the LiDAR's offset from the axis on directions


class Firings(NamedTuple):
    """All firings of a stop, and which of their pulses returned.

    Attributes
    ----------
    azimuths, angles : (m,)
        Azimuth of the first laser and gimbal angle at its instant [rad].
    spin, turn : float
        Rates of the two [rad/s].
    row_of : (m, 16)
        Row of the cloud of each pulse's return; -1 without one.
    """

    azimuths: Array
    angles: Array
    spin: float
    turn: float
    row_of: NDArray[np.int32]


class Passing(NamedTuple):
    """Pulses that pass one sphere closely, in the plane across the line of sight.

    Attributes
    ----------
    places : (n, 2)
        Intersections with the plane [m].
    half_widths : (n, 2, 2)
        Their footprints there: half widths times axes [m].
    has_hit : (n,)
        Whether they returned from the sphere.
    axes : (2, 3)
        Unit vectors of the plane.
    centre : (3,)
        Origin of the plane [m].
    distance : float
        From the base to the centre [m].
    """

    places: Array
    half_widths: Array
    has_hit: Mask
    axes: Array
    centre: Array
    distance: float


def firings_of(cloud: StitchedCloud) -> tuple[Firings | None, str]:
    """Return every firing between the first return and the last, or why they are not known."""
    if len(cloud.rig.laser_elevations) != N_LASERS:
        return None, f"the rig has {len(cloud.rig.laser_elevations)} lasers, not a VLP-16's 16"
    if not len(cloud.rings) or np.any(cloud.rings == RING_UNKNOWN):
        return None, "the rings of the returns are not known"
    rows = np.unique(np.linspace(0, len(cloud.times) - 1, _N_TIMED).astype(np.intp))
    rows = rows[np.isfinite(cloud.p_base[rows]).all(axis=1)]
    times = cloud.seconds(rows)
    firings = times - _DELAYS[cloud.rings[rows]]
    turn = np.exp(2j * np.pi * firings / FIRING_CYCLE)
    phase = float(np.angle(turn.mean())) / (2 * np.pi) * FIRING_CYCLE
    off = np.angle(turn * np.exp(-2j * np.pi * phase / FIRING_CYCLE)) / (2 * np.pi) * FIRING_CYCLE
    if not np.sqrt(np.mean(off**2)) < _PHASE_MAX:
        return None, "the times of the returns do not follow the VLP-16's firing cycle"
    order = np.argsort(times)
    azimuths = _azimuths(cloud, rows)[order]
    spin, off = _steady(times[order], azimuths)
    bins = np.round((times[order] - times.min()) / _DRIFT).astype(np.intp)
    counts = np.bincount(bins)
    seen = np.flatnonzero(counts)
    drift = np.bincount(bins, off)[seen] / counts[seen]
    scatter = np.sqrt(np.mean((off - np.bincount(bins, off)[bins] / counts[bins]) ** 2))
    if not scatter < _SPIN_MAX:
        return None, "the azimuths of the returns do not follow a steady spin"
    drifts = (times.min() + seen * _DRIFT, drift)
    return _all_firings(cloud, phase, spin, drifts), ""


def _azimuths(cloud: StitchedCloud, rows: Index) -> Array:
    """Return the azimuths of returns in the frame of the LiDAR [rad]."""
    table = beams(cloud, rows)
    angles = cloud.gimbal_angles[rows].astype(np.float64)
    c, s, d = np.cos(angles), np.sin(angles), table.directions_base
    v_head = np.column_stack([c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0], d[:, 2]])
    v = v_head @ cloud.rig.T_head_lidar[:3, :3]
    return np.asarray(np.arctan2(-v[:, 1], v[:, 0]))


def _steady(times: Array, azimuths: Array) -> tuple[float, Array]:
    """Return the rate of the steadiest spin [rad/s], and each azimuth less its rate times time."""
    gaps, steps = np.diff(times), np.diff(azimuths)
    is_close = (gaps > 0.0) & (gaps < _CLOSE)
    rates = (steps[is_close] % (2 * np.pi)) / gaps[is_close]
    if len(rates) < _N_RATES:
        return 0.0, np.where(np.arange(len(times)) % 2, np.pi, -np.pi)
    spin = float(np.median(rates))
    turns = np.exp(1j * azimuths)
    for width in _SEARCHES:
        trial = spin * (1.0 + width * np.linspace(-2.0, 2.0, 81))
        phases = azimuths[::_THINNED] - trial[:, None] * times[::_THINNED]
        spin = float(trial[np.argmax(np.abs(np.exp(1j * phases).sum(axis=1)))])
    mean = float(np.angle(np.mean(turns * np.exp(-1j * spin * times))))
    return spin, mean + np.angle(turns * np.exp(-1j * (spin * times + mean)))


def _all_firings(
    cloud: StitchedCloud, phase: float, spin: float, drifts: tuple[Array, Array]
) -> Firings:
    """Return the firings for the instant of firing 0, and a spin with deviations at some times."""
    seconds = cloud.seconds(slice(None)) - _DELAYS[cloud.rings] - phase
    numbers = np.rint(seconds / FIRING_CYCLE).astype(np.intp)
    numbered = _recorded(numbers, 2.0 * np.pi / (abs(spin) * FIRING_CYCLE))
    row_of = np.full((len(numbered), N_LASERS), -1, np.int32)
    row_of[np.searchsorted(numbered, numbers), cloud.rings] = np.arange(len(numbers))
    times = np.asarray(phase + FIRING_CYCLE * numbered, np.float64)
    thin = slice(None, None, max(len(cloud.times) // _N_TIMED, 1))
    stamps, places = np.unique(cloud.seconds(thin), return_index=True)
    angles = np.unwrap(cloud.gimbal_angles[thin][places])
    gimbal = np.interp(times, stamps, angles.astype(np.float64))
    azimuths = spin * times + np.interp(times, *drifts)
    return Firings(
        azimuths=azimuths,
        angles=gimbal,
        spin=spin,
        turn=float(np.median(np.diff(gimbal))) / FIRING_CYCLE,
        row_of=row_of,
    )


def _recorded(numbers: Index, revolution: float) -> Index:
    """Return the numbers of all firings but those in pauses: a revolution without a return."""
    heard = np.unique(numbers)
    lengths = np.diff(heard, append=heard[-1] + 1)
    lengths[lengths > revolution] = 1
    within = np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    return np.asarray(np.repeat(heard, lengths) + within)


def passing_of(
    cloud: StitchedCloud, firings: Firings, centres: Array, radius: float
) -> list[Passing]:
    """Return the pulses that pass each sphere closely, except those that may have met its pole."""
    rig, distances = cloud.rig, np.linalg.norm(centres, axis=1)
    sights = centres / distances[:, None]
    reaches = _REACH * radius / distances + _MARGIN
    which, m, ring = _aimed(
        np.column_stack([sights, np.sin(reaches), np.cos(reaches)]),
        (firings.azimuths, firings.angles),
        rig.T_head_lidar[:3, :3].copy(),
        rig.laser_elevations,
    )
    angles = firings.angles[m] + firings.turn * _DELAYS[ring]
    azimuths = firings.azimuths[m] + firings.spin * _DELAYS[ring]
    u = _directions(cloud, azimuths, angles, rig.laser_elevations[ring])
    spin_axis = rig.T_head_lidar[:3, 2]
    origins = _turned(rig.T_head_lidar[:3, 3] + rig.laser_heights[ring, None] * spin_axis, angles)
    across = np.cross(_turned(np.tile(spin_axis, (len(m), 1)), angles), u)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    rows = firings.row_of[m, ring]
    seen = np.where(rows < 0, np.inf, np.linalg.norm(cloud.p_base[rows] - origins, axis=1))
    up = levelling_rotation(cloud.levelling)[2]
    edges = np.searchsorted(which, range(len(centres) + 1))
    return [
        _past((p, radius), (origins[a:b], u[a:b], across[a:b], seen[a:b]), rig.divergence, up)
        for p, (a, b) in zip(centres, pairwise(edges), strict=True)
    ]


@compiled
def _aimed(
    sights: Array,
    turns: tuple[Array, Array],
    R: Array,
    elevations: Array,
) -> tuple[Index, Index, Index]:
    """Return marker, firing and laser of the pulses that aim near a sphere, marker by marker.

    ``sights`` are directions with the sine and cosine of their reach, ``turns`` azimuths and gimbal
    angles, ``R`` the rotation of the LiDAR in the head, ``elevations`` those of the lasers.
    """
    n = len(turns[0])
    sines, cosines = np.sin(elevations), np.cos(elevations)
    found = [(0, 0, 0) for _ in range(0)]
    for m in range(n):
        c, s = np.cos(turns[1][m]), np.sin(turns[1][m])
        # within one firing the head and the spin move by less than the margin of the reach
        x, y = np.cos(turns[0][m]), -np.sin(turns[0][m])
        for k in range(len(sights)):
            hx, hy = c * sights[k, 0] + s * sights[k, 1], c * sights[k, 1] - s * sights[k, 0]
            hz = sights[k, 2]
            height = hx * R[0, 2] + hy * R[1, 2] + hz * R[2, 2]
            ahead = x * (hx * R[0, 0] + hy * R[1, 0] + hz * R[2, 0])
            ahead += y * (hx * R[0, 1] + hy * R[1, 1] + hz * R[2, 1])
            if ahead < 0.5:
                continue
            for ring in range(len(sines)):
                if (
                    abs(height - sines[ring]) < sights[k, 3]
                    and ahead * cosines[ring] + height * sines[ring] > sights[k, 4]
                ):
                    found.append((k, m, ring))
    table = np.empty((3, len(found)), np.intp)
    for i in range(len(found)):
        table[0, i], table[1, i], table[2, i] = found[i]
    order = np.argsort(table[0], kind="mergesort")
    return table[0][order], table[1][order], table[2][order]


def _directions(cloud: StitchedCloud, azimuths: Array, angles: Array, elevations: Array) -> Array:
    """Return the directions of pulses in the base frame, (n, 3)."""
    v_lidar = np.column_stack(
        [
            np.cos(elevations) * np.cos(azimuths),
            -np.cos(elevations) * np.sin(azimuths),
            np.sin(elevations),
        ]
    )
    return _turned(v_lidar @ cloud.rig.T_head_lidar[:3, :3].T, angles)


def _turned(v_head: Array, angles: Array) -> Array:
    """Return vectors of the turning head, (n, 3), in the base frame."""
    c, s = np.cos(angles), np.sin(angles)
    x, y, z = v_head.T
    return np.column_stack([c * x - s * y, s * x + c * y, z])


def _past(
    sphere: tuple[Array, float],
    pulses: tuple[Array, Array, Array, Array],
    divergence: Array,
    up: Array,
) -> Passing:
    """Return of the pulses aimed near one sphere those that may meet its limb."""
    (p, radius), (origins, u, across, seen) = sphere, pulses
    distance = float(np.linalg.norm(p))
    along = np.einsum("ij,ij->i", p - origins, u)
    passed = origins + along[:, None] * u - p
    axes = _plane(p / distance, up)
    places, depth = passed @ axes.T, (seen - along) / radius
    both = np.stack([across, np.cross(u, across)], axis=1) @ axes.T
    half_widths = 0.5 * along[:, None, None] * divergence[:, None] * both
    is_pole = (places[:, 1] < -_POLE_FROM * radius) & (np.abs(places[:, 0]) < _POLE * radius)
    is_near = (along > 0.0) & (np.einsum("ij,ij->i", passed, passed) < (_REACH * radius) ** 2)
    is_taken = is_near & (depth > -_DEPTH) & ~is_pole
    has_hit = (depth < _DEPTH)[is_taken]
    return Passing(places[is_taken], half_widths[is_taken], has_hit, axes, p, distance)


def _plane(sight: Array, up: Array) -> Array:
    """Return two unit vectors across a line of sight, the second one upward, (2, 3)."""
    side = np.cross(sight, up)
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(side, sight)])
