"""ScanLog -> StitchedCloud: hides clocks, the turning gimbal, the laser table and levelling.

A return becomes ``p_base = Rz(angle) T_head_lidar p_lidar`` with the gimbal angle interpolated to
the instant of its pulse, after the laser's bias has been subtracted along the beam.
Inside, ``stops`` cuts a log into stops, ``spin`` finds the times that clouds lack, ``turning``
has the loops; ``firings`` are all pulses of a scan, with and without a return.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from spheremark.pipelines.config import StitchingConfig
from spheremark.pipelines.errors import (
    MissingGimbalAngleError,
    MissingPulseTimesError,
    MissingRigError,
    RecordingError,
    RigError,
)
from spheremark.pipelines.model import (
    RING_UNKNOWN,
    Array,
    Beams,
    Column,
    ImuMount,
    Index,
    Levelling,
    Mask,
    Nanos,
    Rig,
    Rings,
    ScanLog,
    StitchedCloud,
    Timed,
)
from spheremark.pipelines.scan.spin import stamps_by_spin
from spheremark.pipelines.scan.stops import pause_notes, split_stops
from spheremark.pipelines.scan.turning import Joints, Lidar, Pulses, Tally, turn_returns

__all__ = ["beams", "choose_rig", "level", "pause_notes", "split_stops", "stitch"]

_NS = 1e-9  # [s] in a nanosecond
_FULL_TURN = 2.0 * np.pi
_NEARLY_FULL = np.radians(359.0)  # a joint sample may be missing at either end
_SMEAR = np.radians(0.05)  # 7 mm at 7.5 m: largest turn during a message without pulse times
_RESTS_MIN = 4  # fewer rests than this are those before and after an even turn
_SPEED_MAX = 5.0 * np.pi  # per second: revolutions of 10 Hz would be a quarter of a turn apart
_TURNS = np.radians(0.1)  # per second; a gimbal at rest turns less
_OVERRUN = 3.0  # joint samples after whose last one returns may go on
_JOINT_GAP = 0.5  # [s]; over a longer gap of a moving gimbal the angle is a guess
_JOINT_GAP_MOTION = np.radians(0.5)
_HALF_TURN = np.pi + 1e-6  # between two samples: which way the gimbal turned is open
_SIGMA_UNLEVELLED = np.radians(3.0)  # how a rover may lean on ground it can drive on
_LEAN_STRANGE = np.radians(45.0)  # more is a wrong mounting, not a slope
_ELEVATION_CLEAN = 0.1  # of the lasers' spacing: rings are inferred only from such elevations


def choose_rig(log: ScanLog, rig: Rig | None) -> Rig:
    """Choose the rig: the given one, else the one that the recording describes.

    Parameters
    ----------
    log : ScanLog
        The recording.
    rig : Rig or None
        A rig that the user gave.

    Returns
    -------
    Rig
        The rig to use. Raw packets decide whether coordinates include the heights of the lasers.

    Raises
    ------
    MissingRigError
        If there is neither.
    """
    chosen = rig or log.rig
    if chosen is None:
        raise MissingRigError(
            f"{log.origin.name} does not describe how the LiDAR sits on the gimbal: it has no "
            "/tf_static from the LiDAR's frame to the gimbal's head. Give a rig (--rig rig.json) "
            "or record /tf_static."
        )
    if log.has_heights is None or log.has_heights == chosen.cloud_carries_heights:
        return chosen
    return replace(chosen, cloud_carries_heights=log.has_heights)


def level(log: ScanLog, rig: Rig, config: StitchingConfig) -> Levelling:
    """Read from the AHRS how the base leans.

    Notes
    -----
    The up direction in base is the third row of ``R_world_base``, so the heading of the AHRS and
    its magnetic disturbances do not matter. The mean is that of the samples within three scaled
    median deviations of the median. Errors of an AHRS are correlated in time: the scatter of one
    sample, not of the mean, is added to the sigma of the configuration.
    """
    norms = np.linalg.norm(log.quaternions_imu, axis=1)
    usable = np.isfinite(norms) & (norms > 0.5)
    if not np.any(usable):
        return Levelling(
            roll=0.0,
            pitch=0.0,
            sigma=_SIGMA_UNLEVELLED,
            is_measured=False,
            sigma_heading=rig.sigma_heading,
        )
    x, y, z, w = (log.quaternions_imu[usable] / norms[usable, None]).T
    up_imu = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
    ups = up_imu @ rig.R_mount_imu.T
    if rig.imu_mount is ImuMount.HEAD:
        ups = _turn(ups, _angles_at(_joints(log, rig), log.stamps_imu_ns[usable]))
    up, scatter = _robust_direction(ups)
    return Levelling(
        roll=float(np.arctan2(up[1], up[2])),
        pitch=float(np.arctan2(-up[0], np.hypot(up[1], up[2]))),
        sigma=float(np.hypot(np.hypot(config.sigma_levelling, scatter), log.sigma_levelling)),
        is_measured=True,
        sigma_heading=rig.sigma_heading,
    )


def _angles_at(joints: Joints, stamps_ns: Nanos) -> Array:
    """Return the gimbal angle [rad] at some instants of the LiDAR's clock."""
    start = joints.stamps_ns[0]
    return np.asarray(np.interp(stamps_ns - start, joints.stamps_ns - start, joints.angles))


def _turn(v_head: Array, angles: Array) -> Array:
    """Return ``Rz(angle) v_head`` for rows of vectors and as many angles."""
    c, s = np.cos(angles), np.sin(angles)
    x, y, z = v_head.T
    return np.stack([c * x - s * y, s * x + c * y, z], axis=1)


def _robust_direction(ups: Array) -> tuple[Array, float]:
    """Return the mean unit vector without outliers, and the scatter of one per axis [rad]."""
    distances = np.linalg.norm(ups - np.median(ups, axis=0), axis=1)
    inliers = ups[distances <= 3.0 * 1.4826 * np.median(distances) + 1e-12]
    up = inliers.mean(axis=0)
    scatter = float(np.sqrt(np.sum((inliers - up) ** 2) / len(inliers) / 2.0))
    return up / np.linalg.norm(up), scatter


def stitch(log: ScanLog, rig: Rig, config: StitchingConfig) -> StitchedCloud:
    """Turn one stop's returns into points in the base frame.

    Parameters
    ----------
    log : ScanLog
        One stop, as from ``split_stops``.
    rig : Rig
        How the LiDAR sits on the gimbal.
    config : StitchingConfig
        Limits of range, sigma of the AHRS.

    Returns
    -------
    StitchedCloud
        Returns with their gimbal angles; its notes count the returns left out and list weaknesses.

    Raises
    ------
    MissingGimbalAngleError
        If the log has no joint sample.
    MissingPulseTimesError
        If the points carry no time of their own and the gimbal does not rest during a message.
    RecordingError
        If no return has a gimbal angle and a range within the limits, or the gimbal turns faster
        than a gimbal can.

    Notes
    -----
    The angle is interpolated linearly between joint samples, the eccentricity applied at the
    samples. Sine and cosine are evaluated once per joint sample and continued to the pulse by
    their series, which is good to 0.1 micrometres at 60 m. One pass, linear in the number of
    returns. Where no return is left out, intensities and rings are those of the log; gimbal angles
    and times are computed on access.
    """
    rings, notes = _lasers_of(log, rig)
    joints = _joints(log, rig)
    joints, by_spin_ns, smear_note = _without_smear(log, rings, joints, rig)
    pulses = Pulses(log.p_lidar, log.intensities, rings, log.stamps_lidar_ns)
    kept, tally, rows = turn_returns(pulses, joints, _lidar(rig, config))
    stamps_ns = kept.stamps_ns if by_spin_ns is None else by_spin_ns[rows]
    _refuse_empty(log, joints, tally, config)
    near = _near(log.p_lidar, rows, config.range_min)
    near_ns = (log.stamps_lidar_ns if by_spin_ns is None else by_spin_ns)[near]
    levelling = level(log, rig, config)
    rate = float(np.nan_to_num(np.nanmedian(np.abs(joints.rates)))) / _NS
    levelling = replace(levelling, sigma_clock=rate * config.sigma_clock)
    levelling, weaknesses = _clocked(levelling, rate, tally, joints)
    coverage, duration = _extent(tally, joints)
    notes += smear_note + pause_notes(log) + _count_notes(tally, by_message=bool(smear_note))
    notes += _level_notes(levelling) + _turn_notes(coverage)
    return StitchedCloud(
        p_base=kept.p,
        gimbal_angles=Timed(kept.stamps_ns, *joints, is_angle=True),
        intensities=kept.intensities,
        rings=kept.rings,
        times=Timed(stamps_ns, np.array([tally.first_ns]), np.zeros(1), np.array([_NS])),
        levelling=levelling,
        rig=rig,
        coverage=coverage,
        duration=duration,
        name=log.origin.name,
        notes=log.notes + notes + weaknesses,
        weaknesses=weaknesses,
        near_times=(near_ns - tally.first_ns).astype(np.float64) * _NS,
        near_rings=rings[near],
    )


def _near(p_lidar: Column, kept: Index | slice, range_min: float) -> Index:
    """Return the rows that are left out because they are nearer than the least range."""
    is_left = np.ones(len(p_lidar), np.bool_)
    is_left[kept] = False
    left = np.flatnonzero(is_left)
    ranges = np.linalg.norm(p_lidar[left].astype(np.float64), axis=1)
    return np.asarray(left[ranges < range_min])


def _clocked(
    levelling: Levelling, rate: float, tally: Tally, joints: Joints
) -> tuple[Levelling, tuple[str, ...]]:
    """Return the levelling with a heading as uncertain as the clocks, and why it is.

    Both sensors are recorded for the same time: returns that go on after the last joint sample, and
    begin by more after the first, carry stamps that are too late, as messages stamped at the end of
    a revolution whose times count from its first point. At an even speed of the gimbal that is a
    turn of everything, which nothing in the scan shows.
    """
    lead = (tally.first_ns - int(joints.stamps_ns[0])) * _NS
    overrun = (tally.last_ns - int(joints.stamps_ns[-1])) * _NS
    gaps = np.diff(joints.stamps_ns) * _NS
    if not len(gaps) or overrun < _OVERRUN * np.median(gaps) or lead < overrun:
        return levelling, ()
    late = 0.5 * (lead + overrun)
    turned = rate * late
    sigma = float(np.hypot(levelling.sigma_heading, turned))
    return replace(levelling, sigma_heading=sigma), (
        f"Returns go on for {overrun:.2f} s after the last joint sample and begin {lead:.2f} s "
        f"after the first: their stamps seem {late:.2f} s too late (the end of a revolution, not "
        f"its start?), and the heading is uncertain by {np.degrees(turned):.1f} deg. If so, give "
        f"gimbal_clock_offset_s {late:+.3f} in the rig.",
    )


def _lasers_of(log: ScanLog, rig: Rig) -> tuple[Rings, tuple[str, ...]]:
    """Return the laser of each return, inferred from its elevation when it is not recorded."""
    n_lasers = len(rig.laser_elevations)
    if not len(log.rings) or log.rings[0] != RING_UNKNOWN:
        highest = int(log.rings.max(initial=0))
        if highest >= n_lasers:
            raise RigError(
                f"{log.origin.name} has returns of laser {highest}, but rig {rig.name!r} describes "
                f"{n_lasers} lasers (0 to {n_lasers - 1}). Give the rig of this LiDAR (--rig)."
            )
        return log.rings, ()
    rings, off = _nearest_lasers(log.p_lidar, rig)
    spacing = float(np.min(np.diff(rig.laser_elevations))) if n_lasers > 1 else np.pi
    if not np.nanquantile(off, 0.95) < _ELEVATION_CLEAN * spacing:
        return log.rings, (
            "Rings are not recorded and cannot be inferred from the elevations: laser heights and "
            "biases are not applied.",
        )
    return rings, ("Rings are not recorded; they were inferred from the elevations.",)


def _nearest_lasers(p_lidar: Column, rig: Rig) -> tuple[Rings, Column]:
    """Return for each point the laser of nearest elevation, and the difference [rad]."""
    horizontal = np.hypot(p_lidar[:, 0], p_lidar[:, 1])
    rings = np.full(len(p_lidar), RING_UNKNOWN, np.uint8)
    best = np.full(len(p_lidar), np.inf, np.float32)
    for k, elevation in enumerate(rig.laser_elevations):
        height = rig.laser_heights[k] if rig.cloud_carries_heights else 0.0
        off = np.abs(np.arctan2(p_lidar[:, 2] - np.float32(height), horizontal) - elevation)
        closer = off < best
        rings[closer], best[closer] = k, off[closer]
    return rings, best


def _joints(log: ScanLog, rig: Rig) -> Joints:
    """Return the gimbal on the LiDAR's clock, eccentricity applied."""
    if not len(log.gimbal_angles):
        raise MissingGimbalAngleError(
            f"{log.origin.name} has no joint sample; a JointState, a transform or an orientation "
            "of the gimbal's head is needed at 10 Hz or more."
        )
    stamps_ns = log.stamps_gimbal_ns + np.int64(round(rig.gimbal_clock_offset / _NS))
    cosine, sine = rig.encoder_eccentricity
    angles = log.gimbal_angles
    angles = angles + cosine * np.cos(angles) + sine * np.sin(angles)
    gaps, steps = np.diff(stamps_ns), np.diff(angles)
    _refuse_speed(log, np.abs(steps) / (gaps * _NS))
    rates = np.append(steps / gaps, 0.0)
    is_guess = (gaps > _JOINT_GAP / _NS) & (np.abs(steps) > _JOINT_GAP_MOTION)
    rates[:-1][is_guess | (np.abs(steps) > _HALF_TURN)] = np.nan
    return Joints(stamps_ns, angles, rates)


def _refuse_speed(log: ScanLog, speeds: Array) -> None:
    """Raise RecordingError if the gimbal turns faster than a gimbal can [rad/s]."""
    turning = speeds[speeds > _TURNS]
    speed = float(np.median(turning)) if len(turning) else 0.0
    if speed > _SPEED_MAX:
        raise RecordingError(
            f"The gimbal of {log.origin.name} would turn at {np.degrees(speed):,.0f} deg/s; at "
            f"most {np.degrees(_SPEED_MAX):.0f} are plausible. Give the unit of its angle, as "
            "--joint-unit deg or the number of steps of a full turn (joint_unit=... in a request), "
            "or name another joint with --joint."
        )


def _without_smear(
    log: ScanLog, rings: Rings, joints: Joints, rig: Rig
) -> tuple[Joints, Nanos | None, tuple[str, ...]]:
    """Void the angle during messages without pulse times in which the gimbal moved.

    Return the instants of the other pulses too, where the spin shows them.
    """
    if log.has_pulse_times or not len(log.stamps_lidar_ns):
        return joints, None, ()
    messages = np.unique(log.stamps_lidar_ns)
    if len(messages) > 1:
        # A message lasts no longer than usual, however long the next one is in coming.
        lasting = np.minimum(np.diff(messages, append=messages[-1]), np.median(np.diff(messages)))
        lasting[-1] = lasting[:-1].max()
        ends = messages + lasting.astype(np.int64)
        moved = np.abs(_angles_at(joints, ends) - _angles_at(joints, messages))
    else:  # the duration of the only message is unknown
        moved = np.ptp(joints.angles, keepdims=True)
    smeared, n_rests = _smeared(moved)
    if np.mean(smeared) > 0.5 and n_rests < _RESTS_MIN:
        raise MissingPulseTimesError(
            f"The points of {log.origin.name} carry no time of their own, and the gimbal turns by "
            f"{np.degrees(np.median(moved)):.2f} deg during a message (at most "
            f"{np.degrees(_SMEAR):.2f} can be tolerated). Record a point cloud with the field "
            "time, or raw packets, or let the gimbal rest while the LiDAR scans."
        )
    is_good = ~smeared[np.searchsorted(messages, log.stamps_lidar_ns)]
    by_spin_ns = stamps_by_spin(log.p_lidar, rings, log.stamps_lidar_ns, is_good, rig)
    notes: tuple[str, ...] = ()
    if np.any(smeared):
        joints = _voided(joints, messages[smeared])
        notes = (
            f"The points carry no time of their own: {int(np.sum(smeared))} of {len(messages)} "
            "messages were made while the gimbal moved and are left out.",
        )
    return joints, by_spin_ns, notes


def _smeared(moved: Array) -> tuple[Mask, int]:
    """Return the messages in which the gimbal moved, and the number of rests, from its motion.

    A message is stamped with its start; some drivers stamp the end. The first message of a rest is
    therefore left out too, unless it is the only one.
    """
    smeared = moved > _SMEAR
    is_first = ~smeared & np.append(True, smeared[:-1])
    is_last = ~smeared & np.append(smeared[1:], True)
    return smeared | (is_first & ~is_last & (np.arange(len(moved)) > 0)), int(is_first.sum())


def _voided(joints: Joints, stamps_ns: Nanos) -> Joints:
    """Return the gimbal with the angle unknown in the sample intervals of the given instants."""
    rates = joints.rates.copy()
    hit = np.searchsorted(joints.stamps_ns, stamps_ns, side="right") - 1
    rates[np.clip(hit, 0, len(rates) - 1)] = np.nan
    return joints._replace(rates=rates)


def _lidar(rig: Rig, config: StitchingConfig) -> Lidar:
    """Return the rig and the limits of range in the form of the kernels."""
    return Lidar(
        tuple(rig.T_head_lidar[:3].ravel().tolist()),
        _by_ring(rig.laser_range_biases),
        _by_ring(rig.laser_heights),
        bool(rig.laser_range_biases.any()),
        float(rig.cloud_carries_heights),
        (config.range_min, config.range_max),
    )


def _by_ring(values: Array) -> Array:
    """Return values of lasers as a table over all rings; zero for unknown ones."""
    table = np.zeros(RING_UNKNOWN + 1)
    table[: len(values)] = values
    return table


def _refuse_empty(log: ScanLog, joints: Joints, tally: Tally, config: StitchingConfig) -> None:
    """Raise RecordingError with the reason if no return was kept."""
    if tally.n_kept:
        return
    if not len(log.stamps_lidar_ns):
        raise RecordingError(f"{log.origin.name} holds no LiDAR return.")
    if tally.n_without_angle:
        away = (int(joints.stamps_ns[0]) - int(log.stamps_lidar_ns[0])) * _NS
        raise RecordingError(
            f"No return of {log.origin.name} has a gimbal angle: the joint samples begin "
            f"{away:+.3f} s after the first return and last "
            f"{(joints.stamps_ns[-1] - joints.stamps_ns[0]) * _NS:.3f} s. Check the clocks "
            "(gimbal_clock_offset_s in the rig) and record both topics together."
        )
    raise RecordingError(
        f"No return of {log.origin.name} is from {config.range_min} to {config.range_max} m away "
        f"({tally.n_not_finite} are not finite, {tally.n_out_of_range} are nearer or farther)."
    )


def _extent(tally: Tally, joints: Joints) -> tuple[float, float]:
    """Return the angle [rad] and the time [s] from the first pulse with an angle to the last."""
    first = max(tally.first_ns, int(joints.stamps_ns[0]))
    final = min(tally.last_ns, int(joints.stamps_ns[-1]))
    inside = joints.angles[(joints.stamps_ns >= first) & (joints.stamps_ns <= final)]
    times = joints.stamps_ns - first
    edges = np.interp([0, final - first], times, joints.angles)
    turned = float(np.ptp(np.concatenate([edges, inside])))
    return min(turned, _FULL_TURN), float((final - first) * _NS)


def _count_notes(tally: Tally, *, by_message: bool) -> tuple[str, ...]:
    """Return notes on the returns left out; those beyond the range limits need none."""
    notes = []
    if tally.n_without_angle:
        moved = "in a message during which the gimbal moved, or " if by_message else ""
        notes.append(
            f"{tally.n_without_angle:,} returns have no gimbal angle ({moved}before, after or in a "
            "gap of the joint samples) and are left out."
        )
    if tally.n_not_finite:
        notes.append(f"{tally.n_not_finite} returns are not finite and are left out.")
    return tuple(notes)


def _level_notes(levelling: Levelling) -> tuple[str, ...]:
    """Return notes on an implausible or missing levelling."""
    if not levelling.is_measured:
        return (
            "No AHRS: the base is assumed level to "
            f"{np.degrees(levelling.sigma):.0f} deg (1 sigma).",
        )
    lean = np.arccos(np.cos(levelling.roll) * np.cos(levelling.pitch))
    if lean > _LEAN_STRANGE:
        return (
            f"By the AHRS the base leans by {np.degrees(lean):.0f} deg: check R_mount_imu of the "
            "rig.",
        )
    return ()


def _turn_notes(coverage: float) -> tuple[str, ...]:
    """Return notes on a turn that is not full."""
    degrees = np.degrees(coverage)
    if coverage < np.pi:
        return (f"turn under 180 deg ({degrees:.0f} deg): parts of the scene are not seen: weak.",)
    if coverage < _NEARLY_FULL:
        return (
            f"The gimbal turned {degrees:.0f} deg: under 360 deg some markers are seen on one face "
            "only, and gimbal errors do not cancel.",
        )
    return ()


def beams(cloud: StitchedCloud, members: Index) -> Beams:
    """Rebuild the beams of some returns in the base frame.

    Parameters
    ----------
    cloud : StitchedCloud
        A stitched stop.
    members : (n,)
        Rows of the cloud.

    Returns
    -------
    Beams
        Origins, directions and ranges in float64; ``origin + range * direction`` is the return.

    Notes
    -----
    A beam begins on the spin axis at its laser's height; of an unknown laser, at the LiDAR's
    origin. Across is the spin axis times the direction: the tangent of the sweep.
    """
    rig = cloud.rig
    heights = _by_ring(rig.laser_heights)[cloud.rings[members], None]
    angles = cloud.gimbal_angles[members].astype(np.float64)
    spin, centre = rig.T_head_lidar[:3, 2], rig.T_head_lidar[:3, 3]
    origins = _turn(centre + heights * spin, angles)
    along = cloud.p_base[members] - origins
    ranges = np.linalg.norm(along, axis=1)
    directions = along / ranges[:, None]
    across = np.cross(_turn(np.broadcast_to(spin, origins.shape), angles), directions)
    return Beams(
        origins_base=origins,
        directions_base=directions,
        ranges=ranges,
        across_base=across / np.linalg.norm(across, axis=1, keepdims=True),
        rings=cloud.rings[members],
        intensities=cloud.intensities[members].astype(np.float64),
        times=cloud.seconds(members),
        divergence=rig.divergence,
    )
