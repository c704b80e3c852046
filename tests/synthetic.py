"""A small world whose truth is known, by formulas that share nothing with the pipeline.

Recordings here are made shot by shot from points in base: undo the gimbal, undo the mounting, put
the bias on along the beam.
"""

from dataclasses import replace

import numpy as np

from spheremark.pipelines.model import (
    ControlMarks,
    Levelling,
    MarkerFit,
    MarkerFits,
    Origin,
    ScanLog,
    Status,
)
from spheremark.pipelines.scan.rigs import vlp16

NS = 1_000_000_000


def turn_z(angle):
    """Rotation matrices about z, (..., 3, 3)."""
    c, s, o = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    return np.stack([c, -s, o, s, c, o, o, o, o + 1], axis=-1).reshape(*np.shape(angle), 3, 3)


def rotation(rng, largest=np.pi):
    """A random rotation by at most an angle, by the formula of Rodrigues."""
    axis = rng.normal(size=3)
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = rng.uniform(0, largest)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def crooked_rig(rng, **changes):
    """A rig on which nothing is straight; ``changes`` replace its fields."""
    T = np.eye(4)
    T[:3, :3] = rotation(rng, 0.02) @ np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    T[:3, 3] = [0.06, -0.03, 0.0]
    return replace(vlp16("crooked", T, R_mount_imu=rotation(rng)), **changes)


def fired(rng, n, rig):
    """Ranges, rings and points of n beams in the LiDAR frame, origin heights included."""
    rings = rng.integers(0, len(rig.laser_elevations), n).astype(np.uint8)
    ranges = rng.uniform(2.0, 20.0, n)
    azimuth, elevation = rng.uniform(-np.pi, np.pi, n), rig.laser_elevations[rings]
    v = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            -np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        axis=1,
    )
    return ranges, rings, v


def scan_log(rng, rig, *, n=3000, turn=2 * np.pi, duration=13.2, joint_rate=100.0, lean=(0.0, 0.0)):
    """One stop of a gimbal that turns evenly, and its true returns in base, (n, 3)."""
    begin = 1_700_000_000 * NS + 123_456_789
    stamps = begin + np.sort(rng.integers(0, int(duration * NS), n))
    joint_times = np.arange(-0.1, duration + 0.1 + 1 / joint_rate, 1 / joint_rate)
    stamps_joint = begin + np.round(joint_times * NS).astype(np.int64)

    def joint(stamps_ns):
        return 0.7 + turn * ((stamps_ns - begin) / NS) / duration

    ranges, rings, v = fired(rng, n, rig)
    heights, biases = rig.laser_heights[rings], rig.laser_range_biases[rings]
    up = np.array([0.0, 0.0, 1.0])
    p_true = ranges[:, None] * v + heights[:, None] * up
    recorded = (ranges + biases)[:, None] * v
    if rig.cloud_carries_heights:
        recorded = recorded + heights[:, None] * up
    phi = joint(stamps)
    angle = phi + rig.encoder_eccentricity @ [np.cos(phi), np.sin(phi)]
    p_head = p_true @ rig.T_head_lidar[:3, :3].T + rig.T_head_lidar[:3, 3]
    p_base = np.einsum("nij,nj->ni", turn_z(angle), p_head)
    offset = round(rig.gimbal_clock_offset * NS)
    log = ScanLog(
        p_lidar=recorded.astype(np.float32),
        intensities=rng.uniform(1, 100, n).astype(np.float32),
        rings=rings,
        stamps_lidar_ns=stamps,
        has_pulse_times=True,
        gimbal_angles=joint(stamps_joint),
        stamps_gimbal_ns=stamps_joint - offset,
        quaternions_imu=leaning(rng, rig, lean, joint(stamps_joint)),
        stamps_imu_ns=stamps_joint.copy(),
        rig=None,
        origin=Origin(name="walk", digest=""),
    )
    return log, p_base


def leaning(rng, rig, lean, angles):
    """Quaternions (x y z w) of an AHRS on a base that leans, with any heading."""
    mount = turn_z(angles) if rig.imu_mount == "head" else np.eye(3)
    R = turn_z(np.array(rng.uniform(-3, 3))) @ lean_matrix(*lean) @ mount @ rig.R_mount_imu
    return quaternions(np.broadcast_to(R, (len(angles), 3, 3)))


def quaternions(R):
    """Quaternions (x y z w) of rotation matrices, (n, 3, 3), for rotations that are not near pi."""
    odd = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]])
    length = np.linalg.norm(odd, axis=0)
    half = np.arctan2(length / 2, (np.trace(R, axis1=1, axis2=2) - 1) / 2) / 2
    return np.concatenate([np.sin(half) * odd / length, [np.cos(half)]]).T


def field(rng, n=14, *, radius=8.0, middle=(0.0, 0.0, 0.0)):
    """Control marks in an uneven ring, 0.6 to 1.5 m above the middle."""
    angle = np.sort((np.arange(n) + rng.uniform(-0.3, 0.3, n)) * 2 * np.pi / n)
    ring = radius * rng.uniform(0.8, 1.2, n)
    p_site = np.stack([ring * np.cos(angle), ring * np.sin(angle), rng.uniform(0.6, 1.5, n)], 1)
    return control(p_site + np.asarray(middle))


def control(p_site):
    """Exact control marks called A, B, C ..."""
    names = tuple(chr(65 + k) if k < 26 else f"M{k}" for k in range(len(p_site)))
    return ControlMarks(
        names=names, p_site=np.array(p_site, float), cov_p_site=np.zeros((len(p_site), 3, 3))
    )


def pose(p_site, yaw, lean=(0.0, 0.0)):
    """The pose of a base that stands somewhere, (4, 4)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn_z(np.array(float(yaw))) @ lean_matrix(*lean), p_site
    return T


def lean_matrix(roll, pitch):
    """``Ry(pitch) Rx(roll)``, written out."""
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    return np.array([[cp, sp * sr, sp * cr], [0, cr, -sr], [-sp, cp * sr, cp * cr]])


def sightings(marks, T_site_base, *, lean=(0.0, 0.0), sigma_level=3e-3, cov=None, noise=None):
    """The fits that marks would give at a pose; ``cov`` is what they claim, ``noise`` what is."""
    p_base = (marks.p_site - T_site_base[:3, 3]) @ T_site_base[:3, :3]
    p_base = p_base if noise is None else p_base + noise
    cov = np.broadcast_to(np.eye(3) * 4e-3**2 if cov is None else cov, (len(p_base), 3, 3))
    levelling = Levelling(roll=lean[0], pitch=lean[1], sigma=sigma_level, is_measured=True)
    names = [f"M{i:02d}" for i in range(1, len(p_base) + 1)]
    fits = tuple(marker_fit(*one) for one in zip(p_base, cov, names, strict=True))
    return MarkerFits(method="along_beam", fits=fits, rejected=(), levelling=levelling)


def marker_fit(p_base, cov, name=""):
    """A fit with a centre and a covariance; the rest is plausible."""
    return MarkerFit(
        name=name,
        p_base=np.array(p_base),
        cov_p_base=np.array(cov),
        method="along_beam",
        status=Status.OK,
        reason="",
        radius=0.1,
        radius_free=0.1,
        sigma_radius_free=0.002,
        mean_range=float(np.linalg.norm(p_base)),
        mean_intensity=60.0,
        used=np.arange(100),
        rejected=np.zeros(0, np.intp),
        residuals=np.zeros(100),
        sigma0=1.0,
        n_rings=8,
        coverage=0.9,
    )
