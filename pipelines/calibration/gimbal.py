"""How pulses depend on the rig: its parameters, their order and their derivatives.

A parameter moves a beam as a rigid body: it turns it about its origin and shifts the origin. The
range to a sphere changes by what the same motion of the sphere the other way would change it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from spheremark.pipelines.model import (
    Array,
    Beams,
    Index,
    Rig,
    Rings,
    ScanLog,
    StitchedCloud,
    Timed,
)
from spheremark.pipelines.scan.interpolation import scatter_of_angles
from spheremark.pipelines.scan.stitching import beams
from spheremark.pipelines.sphere.linearisation import linearise as linearise_ranges
from spheremark.pipelines.sphere.noise import classes_of
from spheremark.pipelines.sphere.optics import N_ESTIMATED, derivatives, echo_shifts, with_widths
from spheremark.pipelines.sphere.returns import returns_of, scan_lines

_RATE_WINDOW = 0.05  # [s] over which the speed of the gimbal is taken: encoders jitter
_NS = 1e-9  # [s] in a nanosecond
_UP = np.array([0.0, 0.0, 1.0])


class Parameter(NamedTuple):
    """One number of a rig, with the reasons for holding it.

    Attributes
    ----------
    name, unit : str
        Its name and SI unit.
    unknown : float
        A sigma of it that is as good as not knowing it.
    twin : str
        What else does the same to the observations.
    caution : str
        Why it is held even where observations determine it; empty if it is not.
    """

    name: str
    unit: str
    unknown: float
    twin: str
    caution: str = ""


_LENGTH, _ANGLE, _TIME = 0.02, np.radians(1.0), 0.005

MOUNTING = (
    Parameter("axis_offset_x", "m", _LENGTH, "too few spheres are seen on both faces"),
    Parameter("axis_offset_y", "m", _LENGTH, "too few spheres are seen on both faces"),
    Parameter("spin_axis_tilt", "rad", _ANGLE, "too few lasers see the spheres"),
    Parameter("spin_zero", "rad", _ANGLE, "too few spheres are seen on both faces"),
    Parameter("encoder_cosine", "rad", _ANGLE, "the spheres stand in too few directions"),
    Parameter("encoder_sine", "rad", _ANGLE, "the spheres stand in too few directions"),
)
"""Determined by the differences between the two faces."""

OTHERS = (
    Parameter(
        "gimbal_clock_offset",
        "s",
        _TIME,
        "at constant speed of the gimbal it turns all centres together, as a heading does; only a "
        "gimbal that changes its speed while the LiDAR measures can determine it",
    ),
    Parameter(
        "spin_axis_heading", "rad", _ANGLE, "it turns all centres of a stop about the gimbal axis"
    ),
    Parameter("height_offset", "m", _LENGTH, "it shifts all centres of a stop along the axis"),
    Parameter("gimbal_axis_roll", "rad", _ANGLE, "it turns all centres of a stop about x of base"),
    Parameter("gimbal_axis_pitch", "rad", _ANGLE, "it turns all centres of a stop about y of base"),
    Parameter(
        "common_range_bias",
        "m",
        _LENGTH,
        "it puts every centre nearer or farther by the same on both faces",
        "only the size that near spheres seem to have speaks of it, which rests on the width of "
        "the beams that is assumed; compare distances between marks with known ones",
    ),
)
"""Determined only by coordinates of the spheres, or by a varying speed of the gimbal."""

GIMBAL = MOUNTING + OTHERS


class Pulses(NamedTuple):
    """Pulses at spheres as recorded, before anything of the rig was applied.

    Attributes
    ----------
    v_lidar : (n, 3)
        Directions of the beams in the LiDAR's frame.
    heights : (n,)
        Where they leave the spin axis [m].
    ranges : (n,)
        Ranges, bias included [m].
    angles : (n,)
        Recorded gimbal angle at the instant of the pulse on the gimbal's own clock [rad].
    rates : (n,)
        Speed of the gimbal [rad/s].
    rings : (n,) uint8
        Lasers.
    shades : (n,)
        Class of reflectivity, from dark to bright: the noise depends on it.
    which : (n,)
        The sphere that each one met.
    lines : (n,)
        Scan line of each at its sphere, numbered from sphere to sphere.
    sigmas_angle : (n,)
        Standard deviation of the gimbal's angle, an error that the pulses of a line share [rad].
    divergence : (2,)
        Full width of the footprint across and along the spin axis [rad].
    """

    v_lidar: Array
    heights: Array
    ranges: Array
    angles: Array
    rates: Array
    rings: Rings
    shades: Index
    which: Index
    lines: Index
    sigmas_angle: Array
    divergence: Array

    @classmethod
    def joined(cls, parts: list[Pulses]) -> Pulses:
        """Return the pulses of several stops as one table; spheres and lines are numbered on."""
        ends = [(part.which.max(initial=-1) + 1, part.lines.max(initial=-1) + 1) for part in parts]
        firsts = np.cumsum([(0, 0), *ends[:-1]], axis=0)
        numbered = [
            part._replace(which=part.which + sphere, lines=part.lines + line)
            for part, (sphere, line) in zip(parts, firsts, strict=True)
        ]
        columns = [name for name in cls._fields if name != "divergence"]
        return numbered[0]._replace(
            **{name: np.concatenate([getattr(part, name) for part in numbered]) for name in columns}
        )


def recorded_pulses(
    log: ScanLog, cloud: StitchedCloud, rows: Index, which: Index, unknown: float = 0.0
) -> Pulses:
    """Undo the stitching of some returns.

    Parameters
    ----------
    log : ScanLog
        Recording of the stop.
    cloud : StitchedCloud
        The same, stitched.
    rows : (n,)
        Returns, sphere by sphere.
    which : (n,)
        The sphere of each, numbered from 0 on.
    unknown : float
        Standard deviation of the gimbal's angle where its samples do not tell it [rad].

    Returns
    -------
    Pulses
        The returns as recorded.
    """
    rig, table = cloud.rig, beams(cloud, rows)
    turned = cloud.gimbal_angles[rows].astype(np.float64)
    rates = _rates(log, rig, _instants(cloud, rows))
    v_head = _turn(table.directions_base, -turned)
    biases = np.zeros(256)
    biases[: len(rig.laser_range_biases)] = rig.laser_range_biases
    heights = np.zeros(256)
    heights[: len(rig.laser_heights)] = rig.laser_heights
    return Pulses(
        v_lidar=v_head @ rig.T_head_lidar[:3, :3],
        heights=heights[table.rings],
        ranges=table.ranges + biases[table.rings],
        angles=_recorded(turned, rig) + rates * rig.gimbal_clock_offset,
        rates=rates,
        rings=table.rings,
        shades=classes_of(table.intensities)[0],
        which=which,
        lines=_lines(table.times, which),
        sigmas_angle=np.full(len(rows), scatter_of_angles(cloud.gimbal_angles, unknown)),
        divergence=rig.divergence,
    )


def _lines(times: Array, which: Index) -> Index:
    """Return the scan line of each pulse, numbered from sphere to sphere."""
    lines = np.empty(len(times), dtype=np.intp)
    first = 0
    for sphere in range(which.max(initial=-1) + 1):
        own = np.flatnonzero(which == sphere)
        lines[own] = first + scan_lines(times[own])
        first = lines[own].max(initial=first - 1) + 1
    return lines


def _instants(cloud: StitchedCloud, rows: Index) -> Array:
    """Return the instants of the gimbal angles of some returns since the first pulse [s]."""
    if not isinstance(cloud.gimbal_angles, Timed):
        return cloud.seconds(rows)
    return np.asarray((cloud.gimbal_angles.stamps_ns[rows] - cloud.start_ns) * _NS, np.float64)


def _rates(log: ScanLog, rig: Rig, times: Array) -> Array:
    """Return the speed of the gimbal [rad/s] at times since the stop's first pulse."""
    first = int(log.stamps_lidar_ns.min())
    joints = (log.stamps_gimbal_ns - first) * _NS + rig.gimbal_clock_offset
    later, earlier = times + 0.5 * _RATE_WINDOW, times - 0.5 * _RATE_WINDOW
    turned = np.interp(later, joints, log.gimbal_angles)
    turned -= np.interp(earlier, joints, log.gimbal_angles)
    passed = np.minimum(later, joints[-1]) - np.maximum(earlier, joints[0])
    return np.asarray(turned / np.maximum(passed, 0.1 * _RATE_WINDOW))


def _recorded(turned: Array, rig: Rig) -> Array:
    """Return recorded angles from those with the eccentricity applied."""
    cosine, sine = rig.encoder_eccentricity
    angles = turned.copy()
    for _ in range(4):  # converges by the size of the amplitudes each time
        angles = turned - cosine * np.cos(angles) - sine * np.sin(angles)
    return angles


def _turn(v: Array, angles: Array) -> Array:
    """Return ``Rz(angle) v`` for rows of vectors, (n, 3) or one, and as many angles."""
    c, s = np.cos(angles), np.sin(angles)
    x, y, z = np.broadcast_to(v, (len(angles), 3)).T
    return np.stack([c * x - s * y, s * x + c * y, z], axis=1)


def angles_of(seen: Pulses, rig: Rig) -> Array:
    """Return the true gimbal angles of pulses, if the rig is right."""
    cosine, sine = rig.encoder_eccentricity
    at_pulse = seen.angles - seen.rates * rig.gimbal_clock_offset
    return np.asarray(at_pulse + cosine * np.cos(at_pulse) + sine * np.sin(at_pulse))


def aimed(seen: Pulses, rig: Rig) -> Beams:
    """Return pulses as lines in the base frame."""
    angles, R = angles_of(seen, rig), rig.T_head_lidar[:3, :3]
    directions = _turn(seen.v_lidar @ R.T, angles)
    spin = _turn(R[:, 2], angles)
    across = np.cross(spin, directions)
    known = np.zeros(256)
    known[: len(rig.laser_range_biases)] = rig.laser_range_biases
    n = len(angles)
    return Beams(
        origins_base=_turn(rig.T_head_lidar[:3, 3], angles) + seen.heights[:, None] * spin,
        directions_base=directions,
        ranges=seen.ranges - known[seen.rings],
        across_base=across / np.linalg.norm(across, axis=1, keepdims=True),
        rings=seen.rings,
        intensities=np.zeros(n),
        times=np.zeros(n),
        divergence=rig.divergence,
    )


def motions(seen: Pulses, rig: Rig) -> tuple[Array, Array]:
    """Return how each parameter moves each beam."""
    angles = angles_of(seen, rig)
    table = aimed(seen, rig)
    R, z = rig.T_head_lidar[:3, :3], np.array([0.0, 0.0, 1.0])
    heading, _, _ = _euler(rig)
    axis_tilt = np.array([-np.sin(heading), np.cos(heading), 0.0])
    n, origins = len(angles), table.origins_base
    turns = {name: np.zeros((n, 3)) for name, *_ in GIMBAL}
    shifts = {name: np.zeros((n, 3)) for name, *_ in GIMBAL}
    shifts["axis_offset_x"] = _turn(np.array([1.0, 0.0, 0.0]), angles)
    shifts["axis_offset_y"] = _turn(np.array([0.0, 1.0, 0.0]), angles)
    shifts["height_offset"] = np.tile(z, (n, 1))
    turns["spin_zero"] = _turn(R[:, 2], angles)
    turns["spin_axis_tilt"] = _turn(axis_tilt, angles)
    turns["spin_axis_heading"] = np.tile(z, (n, 1))
    for name in ("spin_axis_tilt", "spin_axis_heading"):
        shifts[name] = seen.heights[:, None] * np.cross(turns[name], turns["spin_zero"])
    at_pulse = seen.angles - seen.rates * rig.gimbal_clock_offset
    by_angle = {
        "encoder_cosine": np.cos(at_pulse),
        "encoder_sine": np.sin(at_pulse),
        "gimbal_clock_offset": -seen.rates,
    }
    for name, factors in by_angle.items():
        turns[name] = factors[:, None] * z
        shifts[name] = factors[:, None] * np.cross(z, origins)
    for name, axis in (("gimbal_axis_roll", 0), ("gimbal_axis_pitch", 1)):
        turns[name] = np.tile(np.eye(3)[axis], (n, 1))
        shifts[name] = np.cross(np.eye(3)[axis], origins)
    names = [parameter.name for parameter in GIMBAL]
    return (
        np.stack([turns[name] for name in names], axis=1),
        np.stack([shifts[name] for name in names], axis=1),
    )


class Linearised(NamedTuple):
    """Residuals of pulses with their derivatives.

    Attributes
    ----------
    residuals : (n,)
        Observed minus computed ranges [m].
    J_centres : (n, 3)
        Derivatives of the computed ranges by the centre of the sphere that was met.
    J_rig : (n, q)
        The same by the parameters of ``GIMBAL``.
    J_optics : (n, 3)
        The same by the optics of ``sphere.optics`` that scans determine.
    J_angle : (n,)
        The same by the angle of the gimbal [m/rad].
    slopes : (n,)
        How much the range changes with the direction of the beam [m/rad].
    sigmas_nonlinear : (n,)
        Standard deviation of the part of the range that is not linear [m].
    """

    residuals: Array
    J_centres: Array
    J_rig: Array
    J_optics: Array
    J_angle: Array
    slopes: Array
    sigmas_nonlinear: Array


def linearise(
    seen: Pulses, rig: Rig, optics: Array, spheres: tuple[Array, Array], radius: float
) -> Linearised:
    """Compare pulses with spheres, whose centres and their covariances are known.

    Notes
    -----
    With ``v`` from a beam's origin to the centre and ``J`` the derivative of its range by the
    centre, a turn ``w`` of the beam changes the range by ``(J x v) w`` and a shift of its origin
    by ``-J``: what counts is where the sphere is as seen from the beam.
    """
    table, (centres, covs) = aimed(seen, rig), spheres
    starts = np.searchsorted(seen.which, np.arange(len(centres) + 1))
    noise = (seen.shades, np.zeros(len(seen.which)), 0.0)
    specified = returns_of(table, starts, _UP, seen.shades, noise)
    widened = with_widths(specified, optics)
    states, known = np.full((len(centres), 4), radius), np.zeros((len(centres), 4, 4))
    states[:, :3], known[:, :3, :3] = centres, covs
    linear = linearise_ranges(widened, states, known)
    J = linear.J[:3].T
    turns, shifts = motions(seen, rig)
    met = centres[seen.which]
    v = met - table.origins_base
    J_rig = np.einsum("nqi,ni->nq", turns, np.cross(J, v)) - np.einsum("nqi,ni->nq", shifts, J)
    J_rig[:, -1] = 1.0  # a range that is measured too long
    along = np.einsum("ni,ni->n", J, table.directions_base)
    slopes2 = np.maximum(np.einsum("ni,ni->n", J, J) - along**2, 0.0)
    return Linearised(
        residuals=table.ranges - linear.ranges - echo_shifts(linear, optics),
        J_centres=J,
        J_rig=J_rig,
        J_optics=derivatives(specified, widened, linear)[:N_ESTIMATED].T,
        J_angle=J[:, 0] * met[:, 1] - J[:, 1] * met[:, 0],
        slopes=table.ranges * np.sqrt(slopes2),
        sigmas_nonlinear=linear.sigmas_nonlinear,
    )


def _euler(rig: Rig) -> Array:
    """Return heading, tilt and spin zero of ``R_head_lidar = Rz(heading) Ry(tilt) Rz(zero)``."""
    return Rotation.from_matrix(rig.T_head_lidar[:3, :3]).as_euler("ZYZ")


def values(rig: Rig) -> Array:
    """Return the parameters of a rig."""
    heading, tilt, zero = _euler(rig)
    x, y = rig.T_head_lidar[:2, 3]
    known = {
        "axis_offset_x": x,
        "axis_offset_y": y,
        "spin_axis_tilt": tilt,
        "spin_zero": zero,
        "encoder_cosine": rig.encoder_eccentricity[0],
        "encoder_sine": rig.encoder_eccentricity[1],
        "gimbal_clock_offset": rig.gimbal_clock_offset,
        "spin_axis_heading": heading,
    }
    return np.array([known.get(name, 0.0) for name, *_ in GIMBAL])


def moved(rig: Rig, changes: Array, bias_changes: Array) -> Rig:
    """Return a rig with some of its numbers changed.

    Parameters
    ----------
    rig : Rig
        The rig.
    changes : (q,)
        Changes of the parameters of ``GIMBAL``; those that a rig does not hold must be zero.
    bias_changes : (k,)
        Changes of the laser range biases [m].

    Returns
    -------
    Rig
        The changed rig, under the same name.
    """
    by_name = dict(zip((name for name, *_ in GIMBAL), values(rig) + changes, strict=True))
    T_head_lidar = rig.T_head_lidar.copy()
    euler = [by_name[name] for name in ("spin_axis_heading", "spin_axis_tilt", "spin_zero")]
    T_head_lidar[:3, :3] = Rotation.from_euler("ZYZ", euler).as_matrix()
    T_head_lidar[:2, 3] = by_name["axis_offset_x"], by_name["axis_offset_y"]
    return replace(
        rig,
        T_head_lidar=T_head_lidar,
        encoder_eccentricity=np.array([by_name["encoder_cosine"], by_name["encoder_sine"]]),
        gimbal_clock_offset=float(by_name["gimbal_clock_offset"]),
        laser_range_biases=rig.laser_range_biases + bias_changes,
    )
