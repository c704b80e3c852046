"""The rig that turns the LiDAR: nominal and true geometry, motion, encoder and AHRS.

Times are seconds since the first pulse, on the LiDAR's clock.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from spheremark.pipelines.geometry import exp_motion, rot_z
from spheremark.pipelines.model import Array, ImuMount, Nanos, Rig, seal
from spheremark.pipelines.scan.rigs import N_LASERS, tilted_vlp16
from spheremark.pipelines.simulation.options import SimulationConfig

_KNOT = 0.002  # [s] between the knots of a turn that ripples
_LEAD = 0.05  # [s] that encoder and AHRS record before the first and after the last pulse
_MARKER_RADIUS = 0.100  # [m] of the sphere that scan lines must not miss ...
_MARKER_RANGE = 15.0  # [m] ... at this distance
_LINES_WANTED = 2  # scan lines over its diameter at the least


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Motion:
    """The true angle of the gimbal, linear between knots.

    Attributes
    ----------
    times : (n,)
        Instants of the knots, ascending [s].
    angles : (n,)
        True angle of the head at each knot, unwrapped [rad].
    """

    times: Array
    angles: Array

    def __post_init__(self) -> None:
        seal(self, times=(None,), angles=(len(self.times),))

    def angle_at(self, times: Array) -> Array:
        """Return the true angle at some instants."""
        return np.interp(times, self.times, self.angles)


def recorded_time(config: SimulationConfig) -> float:
    """Return the duration of the recording [s].

    Parameters
    ----------
    config : SimulationConfig
        The speeds of gimbal and LiDAR.

    Returns
    -------
    float
        From the first pulse to the last [s].
    """
    if config.step:
        rest = config.rest_revolutions * 60.0 / config.spin_rpm
        return _n_steps(config) * (rest + config.move) + rest
    return _turning_time(config) + 60.0 / config.spin_rpm


def _turning_time(config: SimulationConfig) -> float:
    """Return the time of an even turn through its sweep [s]."""
    return float(config.turn * (config.sweep / (2 * np.pi)))


def turning(config: SimulationConfig, start: float) -> Motion:
    """Return the motion of the gimbal: even, or from rest to rest."""
    return stepped_turn(config, start) if config.step else even_turn(config, start)


def stepped_turn(config: SimulationConfig, start: float) -> Motion:
    """Return a movement that rests at every step, at the first and last angle too."""
    rest = config.rest_revolutions * 60.0 / config.spin_rpm
    begins = np.arange(_n_steps(config) + 1) * (rest + config.move)
    angles = np.minimum(np.arange(len(begins)) * config.step, config.sweep)
    return Motion(
        times=np.column_stack([begins, begins + rest]).ravel(), angles=start + np.repeat(angles, 2)
    )


def _n_steps(config: SimulationConfig) -> int:
    """Return the number of steps of a turn."""
    return int(np.ceil(config.sweep / config.step - 1e-9))


def even_turn(config: SimulationConfig, start: float) -> Motion:
    """Return a movement at constant speed, but for its ripples."""
    end = recorded_time(config) + 1.0
    n = int((end + 1.0) / _KNOT) if config.ripples else 1
    times = np.linspace(-1.0, end, n + 1)
    turned = 2 * np.pi / config.turn * times
    sines = [amplitude * np.sin(periods * turned) for amplitude, periods in config.ripples]
    return Motion(times=times, angles=start + turned + sum(sines))


def nominal_rig(config: SimulationConfig) -> Rig:
    """Return the rig as its maker and a recording describe it.

    Parameters
    ----------
    config : SimulationConfig
        Nominal axis offset, divergence and place of the AHRS.

    Returns
    -------
    Rig
        Spin axis tilted by 90 degrees, without any error.
    """
    rig = tilted_vlp16("tilted-vlp16", config.axis_offset)
    return replace(rig, divergence=np.array(config.divergence), imu_mount=config.imu_mount)


def true_rig(config: SimulationConfig, rng: np.random.Generator) -> Rig:
    """Return the true rig, which no log contains."""
    rig = nominal_rig(config)
    T_head_lidar = rig.T_head_lidar.copy()
    twist = np.concatenate([rng.normal(0.0, config.sigma_misalignment, 3), np.zeros(3)])
    T_head_lidar[:3, :3] = exp_motion(twist)[:3, :3] @ T_head_lidar[:3, :3]
    T_head_lidar[:2, 3] += rng.normal(0.0, config.sigma_axis_offset, 2)
    optics, of_lasers = config.optics, rng.normal(0.0, config.sigma_laser_bias, N_LASERS)
    return replace(
        rig,
        name="true",
        T_head_lidar=T_head_lidar,
        laser_range_biases=optics.range_bias + of_lasers,
        divergence=optics.divergence_scale * np.array([1.0, optics.roundness]) * rig.divergence,
        encoder_eccentricity=rng.normal(0.0, config.sigma_eccentricity, 2),
        gimbal_clock_offset=config.gimbal_clock_offset,
    )


def joint_samples(
    motion: Motion, rig: Rig, config: SimulationConfig, rng: np.random.Generator
) -> tuple[Array, Nanos]:
    """Return the samples of the gimbal's encoder: angles [rad] and instants [ns]."""
    times = _sample_times(config, rng)
    truth = motion.angle_at(times)
    stamps = times - rig.gimbal_clock_offset
    if config.sigma_joint_stamp:
        late = np.abs(rng.normal(0.0, config.sigma_joint_stamp, len(times)))
        stamps += np.minimum(late, 0.9 / config.joint_rate)
    c, s = rig.encoder_eccentricity
    angles = truth.copy()
    for _ in range(3):  # the amplitudes belong to the recorded angle; they are small
        angles = truth - c * np.cos(angles) - s * np.sin(angles)
    angles = quantised(
        angles + rng.normal(0.0, config.sigma_encoder, len(times)), config.encoder_step
    )
    return angles, _nanoseconds(stamps)


def ahrs_samples(
    motion: Motion,
    R_station_base: Array,
    rig: Rig,
    config: SimulationConfig,
    rng: np.random.Generator,
) -> tuple[Array, Nanos]:
    """Return the samples of the AHRS: quaternions and instants [ns]."""
    times = _sample_times(config, rng)
    lean = rng.normal(0.0, config.sigma_ahrs_bias, 3) * (1.0, 1.0, 0.0)
    shake = Rotation.from_rotvec(rng.normal(0.0, config.sigma_ahrs, (len(times), 3)))
    mount = Rotation.from_matrix(rig.R_mount_imu)
    if rig.imu_mount is ImuMount.HEAD:
        mount = Rotation.from_euler("z", motion.angle_at(times)[:, None]) * mount
    base = Rotation.from_matrix(rot_z(rng.uniform(-np.pi, np.pi))) * Rotation.from_rotvec(lean)
    if config.sigma_ahrs_drift:
        rates = rng.normal(0.0, config.sigma_ahrs_drift, 3)
        base = base * Rotation.from_rotvec(times[:, None] * rates)
    orientations = base * shake * Rotation.from_matrix(R_station_base) * mount
    return orientations.as_quat(), _nanoseconds(times)


def commensurability(config: SimulationConfig) -> str:
    """Return a warning when the speeds of gimbal and LiDAR make scan lines coincide.

    Parameters
    ----------
    config : SimulationConfig
        The two speeds.

    Returns
    -------
    str
        A sentence; empty when the lines spread well.

    Notes
    -----
    With the spin axis horizontal each laser crosses the horizon twice a revolution, at its
    elevation off the sweep's plane to either side. The largest gap between all these directions of
    one turn must not exceed half the width of a sphere of radius 0.1 m at 15 m.
    """
    gaps = _horizon_gaps(config)
    worst, wanted = float(gaps.max()), 2 * _MARKER_RADIUS / _MARKER_RANGE / _LINES_WANTED
    if worst <= wanted:
        return ""
    if config.step:
        return (
            f"Rests every {np.degrees(config.step):.3g} deg put scan lines of the 2 deg pitch of "
            f"the channels on scan lines and leave gaps of {np.degrees(worst):.2f} deg (mean "
            f"{np.degrees(gaps.mean()):.2f}); choose a finer step that is no multiple of a degree."
        )
    advance = np.degrees(2 * np.pi / config.turn * 60.0 / config.spin_rpm)
    return (
        f"A turn of {config.turn:g} s at {config.spin_rpm:g} rpm moves the gimbal {advance:.3f} "
        f"deg per revolution, which is commensurate with the 2 deg pitch of the channels: scan "
        f"lines fall on scan lines and leave gaps of {np.degrees(worst):.2f} deg "
        f"(mean {np.degrees(gaps.mean()):.2f}); change the time of the turn by some percent."
    )


def quantised(values: Array, step: float) -> Array:
    """Return values rounded to multiples of a step."""
    return np.asarray(np.round(values / step) * step) if step else values


def horizon_lines(config: SimulationConfig) -> Array:
    """Return the directions in which the scan lines of one turn cross the horizon, ascending."""
    return np.sort(np.concatenate(face_lines(config)))


def face_lines(config: SimulationConfig) -> tuple[Array, Array]:
    """Return the directions in which the scan lines of one turn cross the horizon.

    Parameters
    ----------
    config : SimulationConfig
        The speeds of gimbal and LiDAR.

    Returns
    -------
    front, back : (n,), (m,)
        Azimuths in the base frame, of each face ascending from 0 to 2 pi [rad].
    """
    period = 60.0 / config.spin_rpm
    elevations = nominal_rig(config).laser_elevations
    motion = turning(config, 0.0)
    end = recorded_time(config) if config.step else _turning_time(config)
    up, down = np.arange(0.0, end, period), np.arange(period / 2, end, period)
    front = motion.angle_at(up)[:, None] + np.pi / 2 - elevations
    back = motion.angle_at(down)[:, None] - np.pi / 2 + elevations
    return np.sort(front.ravel() % (2 * np.pi)), np.sort(back.ravel() % (2 * np.pi))


def _horizon_gaps(config: SimulationConfig) -> Array:
    """Return the gaps between the directions in which one turn crosses the horizon [rad]."""
    directions = horizon_lines(config)
    return np.diff(directions, append=directions[0] + 2 * np.pi)


def _sample_times(config: SimulationConfig, rng: np.random.Generator) -> Array:
    """Return the instants of samples that bracket all pulses, on either clock [s]."""
    period = 1.0 / config.joint_rate
    lead = max(_LEAD, 2 * period) + abs(config.gimbal_clock_offset)
    first = -lead - rng.uniform(0.0, period)
    return np.arange(first, recorded_time(config) + lead, period)


def _nanoseconds(times: Array) -> Nanos:
    """Return times since the first pulse as whole nanoseconds."""
    return np.round(times * 1e9).astype(np.int64)
