"""The angle of the gimbal: chosen among joints, transforms, orientations and plain numbers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime

import numpy as np

from spheremark.pipelines.errors import MissingGimbalAngleError, RecordingError
from spheremark.pipelines.model import Array, ImuMount, Nanos, Rig
from spheremark.storage.recordings.families import Returns, Series
from spheremark.storage.recordings.frames import FrameTree, recorded_rig
from spheremark.storage.recordings.options import LogOptions, listed
from spheremark.storage.recordings.orientations import Orientations

_MOVES = np.radians(1.0)  # a joint that turns less is not the gimbal of a scan
_UPRIGHT = 0.1  # sine of half the tilt that a gimbal's transform may have off its own z axis
_HALF_TURN = np.pi / 2.0  # an AHRS on the base turns less while the rover stands
_CENTRAL = (1.0, 99.0)  # [%] of samples: a few may be spikes
_WRAPPED = 4.0 * np.pi + 1e-3  # [rad] quaternions show angles within two turns, encoders within one
_COUNT_MAX = 1e9  # of steps: thousands of turns of the finest encoders
_WRAPS_MAX = 0.01  # of the samples: a turn takes seconds, at 10 Hz or more
_NAMING = "--joint (joint=... in a request)"
_AVERAGED = 1_000_000_000  # [ns] of accelerations, against vibration
_SIGMA_GRAVITY = 5e-3  # [rad]: a bias of 0.05 m/s^2, as industrial accelerometers have
_GRAVITY, _GRAVITY_OFF = 9.81, 0.5  # [m/s^2]; farther off it is another unit or no gravity


@dataclass(frozen=True, slots=True, kw_only=True)
class Signals:
    """What could hold the angle: joints, plain numbers, frames that turn, and the AHRS."""

    joints: Sequence[Series]
    numbers: Sequence[Series]
    tree: FrameTree
    imu: Series | None
    found: Mapping[str, str]


def choose_gimbal(
    signals: Signals, options: LogOptions, frame: str, rig: Rig | None
) -> tuple[Series, Rig | None]:
    """Return the gimbal's angle in radians, and the rig, with the AHRS on the head if it is there.

    The order is: what the options name, joints, transforms that turn, an AHRS that turns with the
    head, a plain number that changes.
    """
    series = _named(signals, options.joint) if options.joint else None
    series = series or _of_joints(signals.joints, signals.tree, frame)
    if series is None:
        imu = signals.imu
        if imu is not None and (rig is None or rig.imu_mount is not ImuMount.HEAD):
            rig = _on_head(imu, rig)
        series = _of_ahrs(imu, rig) or _of_numbers(signals)
    angles = _unwrapped(series.values[:, 0] * options.joint_scale) + options.joint_offset
    return replace(series, values=angles[:, None]), rig


def _unwrapped(angles: Array) -> Array:
    """Return angles without jumps by full turns.

    Jumps that are frequent beyond two full turns are no wraps but another unit, such as steps.
    """
    low, high = np.percentile(angles, _CENTRAL)
    is_jump = np.abs(np.diff(angles)) > np.pi
    is_rare = is_jump.sum() <= _WRAPS_MAX * len(angles)
    is_count = np.abs(angles).max() < _COUNT_MAX
    is_other = high - low > _WRAPPED and is_count and not is_rare
    return angles if is_other else np.unwrap(angles)


def _named(signals: Signals, name: str) -> Series:
    """Return the signal that a name means: a joint, a topic of one number, a frame that turns."""
    known = (*signals.joints, *signals.numbers)
    chosen = [one for one in known if name in (one.names[0], one.topic)]
    if len(chosen) == 1 or (chosen and all(one.names[0] == name for one in chosen)):
        return max(chosen, key=lambda one: float(np.ptp(one.values)))
    if name in signals.tree.turning:
        return _angle_of_transform(signals.tree.turning[name])
    frames = (f"{child} (a frame that turns)" for child in signals.tree.turning)
    raise MissingGimbalAngleError(
        f"No joint is called {name}; the recording has "
        f"{', '.join((*_names(known), *frames)) or 'none'}. Name one with {_NAMING}."
    )


def _of_joints(joints: Sequence[Series], tree: FrameTree, frame: str) -> Series | None:
    """Return the gimbal's angle from a joint, else from a transform that turns."""
    pool = [one for one in joints if "gimbal" in one.names[0]] or joints
    moving = [one for one in pool if np.ptp(one.values) > _MOVES]
    if len(pool) == 1 or len(moving) == 1:
        return (moving if len(moving) == 1 else pool)[0]
    head = tree.head_of(frame)
    if head in tree.turning:
        return _angle_of_transform(tree.turning[head])
    if pool:
        found = moving or pool
        raise MissingGimbalAngleError(
            f"{len(found)} joints could be the gimbal: {', '.join(_names(found))}. Name the one of "
            f"the gimbal with {_NAMING}."
        )
    return None


def _names(series: Iterable[Series]) -> list[str]:
    """Return joints with their topics as phrases."""
    return [f"{one.names[0]} of {one.topic}" for one in series]


def _angle_of_transform(series: Series) -> Series:
    """Return the angle by which a transform turns about its own z axis."""
    x, y, z, w = series.values[:, 3:].T
    if np.hypot(x, y).max() > _UPRIGHT:
        raise MissingGimbalAngleError(
            f"The transform from {series.names[1]} to {series.names[0]} does not turn about z "
            f"(up to {np.degrees(2 * np.arcsin(min(np.hypot(x, y).max(), 1.0))):.0f} deg off it)."
        )
    return replace(series, values=2.0 * np.arctan2(z, w)[:, None])


def _on_head(imu: Series, rig: Rig | None) -> Rig | None:
    """Return the rig with the AHRS on its head, if the AHRS turns about one axis by itself.

    Where ``R_i a`` is the same for all orientations ``R_i``, the mean of these maps the axis ``a``
    of the gimbal to a vector of length 1 and all others to shorter ones.
    """
    from scipy.spatial.transform import Rotation  # slow to import

    rotations = Rotation.from_quat(imu.values)
    _, _, axes = np.linalg.svd(rotations.as_matrix().mean(axis=0))
    axis = axes[0] * np.sign(rotations.apply(axes[0]).mean(axis=0)[2] or 1.0)
    turned = np.unwrap((rotations[0].inv() * rotations).as_rotvec() @ axis)
    if np.ptp(turned) < _HALF_TURN:
        return rig
    R_mount_imu, _ = Rotation.align_vectors(np.array([[0.0, 0.0, 1.0]]), axis[None])
    if rig is None:
        from spheremark.pipelines.scan.rigs import tilted_vlp16

        rig = tilted_vlp16("", (0.0, 0.0))
    return replace(rig, imu_mount=ImuMount.HEAD, R_mount_imu=R_mount_imu.as_matrix())


def _of_ahrs(imu: Series | None, rig: Rig | None) -> Series | None:
    """Return the gimbal's angle from an AHRS that turns with the head.

    The axis of the gimbal is where the head's z axis points on average; the angle is the rotation
    about it, from the heading in which the AHRS's own x axis began.
    """
    from scipy.spatial.transform import Rotation  # slow to import

    if imu is None or rig is None or rig.imu_mount is not ImuMount.HEAD:
        return None
    R_world_head = Rotation.from_quat(imu.values).as_matrix() @ rig.R_mount_imu.T
    axis = R_world_head[:, :, 2].mean(axis=0)
    swing, _ = Rotation.align_vectors(axis[None], np.array([[0.0, 0.0, 1.0]]))
    R_base_head = swing.as_matrix().T @ R_world_head
    angles = np.arctan2(R_base_head[:, 1, 0], R_base_head[:, 0, 0])
    note = f"The gimbal's angle is the orientation of {imu.topic}; no joint was recorded."
    return replace(imu, values=angles[:, None], notes=(*imu.notes, note))


def _of_numbers(signals: Signals) -> Series:
    """Return the only plain number that changes."""
    moving = [one for one in signals.numbers if np.ptp(one.values) > 0.0]
    if len(moving) == 1:
        note = f"The gimbal's angle is the number on {moving[0].topic}, taken as its unit says."
        return replace(moving[0], notes=(*moving[0].notes, note))
    if moving:
        raise MissingGimbalAngleError(
            f"{len(moving)} topics of numbers could be the gimbal: {', '.join(_names(moving))}. "
            f"Name the one of the gimbal with {_NAMING}."
        )
    joints = f", with {len(signals.joints)} joints" if signals.joints else ""
    raise MissingGimbalAngleError(
        "No topic holds the angle of the gimbal. Expected a sensor_msgs/msg/JointState with "
        "its joint, a transform that turns (tf2_msgs/msg/TFMessage), a sensor_msgs/msg/Imu "
        "with orientation on the head, or a number (std_msgs) that --joint names. Found: "
        f"{listed(signals.found)}{joints}. Where another file holds it, read both together "
        "(a folder, a zip, or --pcap)."
    )


def level_by_gravity(
    imus: Mapping[str, Orientations], tree: FrameTree, rig: Rig | None, frame: str
) -> tuple[Series | None, Rig | None, float, tuple[str, ...]]:
    """Return orientations from accelerations, the rig with their mounting, sigma and notes.

    Accelerations are averaged over a second: vibration has no mean, and what a steady turn adds on
    the head has none in the base. The heading is unknown and not used.
    """
    found = [one for imu in imus.values() for one in imu.accelerations() if len(one.stamps_ns)]
    series = max(found, key=lambda one: len(one.stamps_ns), default=None)
    if series is None:
        return None, rig, 0.0, ()
    blocks = (series.stamps_ns - series.stamps_ns[0]) // _AVERAGED
    _, begins, counts = np.unique(blocks, return_index=True, return_counts=True)
    means = np.add.reduceat(series.values, begins) / counts[:, None]
    norms = np.linalg.norm(means, axis=1)
    is_gravity = np.abs(norms - _GRAVITY) < _GRAVITY_OFF
    if not is_gravity.any():
        note = (
            f"The accelerations of {series.topic} are {np.median(norms):.2f} m/s^2 and not those "
            "of gravity: they do not level the base."
        )
        return None, rig, 0.0, (note,)
    up = means[is_gravity] / norms[is_gravity, None]
    roll, pitch = np.arctan2(up[:, 1], up[:, 2]), np.arctan2(-up[:, 0], np.hypot(*up[:, 1:].T))
    a, b, c, d = np.cos(roll / 2), np.sin(roll / 2), np.cos(pitch / 2), np.sin(pitch / 2)
    note = (
        f"No orientation was recorded: the base is levelled by the accelerations of {series.topic}."
    )
    middle = (
        series.stamps_ns[begins]
        + (series.stamps_ns[begins + counts - 1] - series.stamps_ns[begins]) // 2
    )
    level = replace(
        series,
        stamps_ns=middle[is_gravity],
        values=np.column_stack([b * c, a * d, -b * d, a * c]),
    )
    if rig is not None:
        mounted, _ = recorded_rig(tree, frame, series.names[0])
        if mounted is not None:
            rig = replace(rig, imu_mount=mounted.imu_mount, R_mount_imu=mounted.R_mount_imu)
    return level, rig, _SIGMA_GRAVITY, (note,)


def require_overlap(returns: Returns, gimbal: Series) -> None:
    """Raise RecordingError if the clocks have no instant in common."""
    lidar, other = returns.stamps_ns, gimbal.stamps_ns
    if lidar[0] <= other[-1] and other[0] <= lidar[-1]:
        return
    away = (int(other[0]) - int(lidar[0])) * 1e-9
    raise RecordingError(
        f"The clocks of LiDAR and gimbal do not overlap: {returns.topic} runs {_span(lidar)}, "
        f"{gimbal.topic} {_span(other)}. Both must stamp by one clock; if they were recorded "
        f"together, --lidar-offset-s {away:.3f} (lidar_offset_s=... in a request) sets the first "
        "stamps equal."
    )


def _span(stamps_ns: Nanos) -> str:
    """Return first and last instant as a phrase."""
    first, last = (
        datetime.fromtimestamp(int(ns) / 1e9, UTC).isoformat(timespec="milliseconds")
        for ns in stamps_ns[[0, -1]]
    )
    return f"from {first} to {last}"
