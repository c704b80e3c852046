"""From a file to a ``ScanLog``: chooses the topics of LiDAR, gimbal, frames and AHRS."""

from __future__ import annotations

from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import TypeVar

import numpy as np

from spheremark.pipelines.errors import MissingGimbalAngleError, MissingLidarError, RecordingError
from spheremark.pipelines.model import RING_UNKNOWN, ImuMount, Nanos, Origin, Rig, ScanLog
from spheremark.storage.recordings import (
    joint_states,
    orientations,
    packets,
    pointclouds,
    transforms,
)
from spheremark.storage.recordings.cdr import definition_agrees
from spheremark.storage.recordings.container import Batch, Channel, Container, file_digest, opened
from spheremark.storage.recordings.families import LidarDecoder, Returns, Series, SeriesDecoder
from spheremark.storage.recordings.frames import FrameTree, recorded_rig

# By encoding and message type: the decoder, and the definition that it reads. A new family is a
# module and a line here.
_LIDARS: dict[tuple[str, str], tuple[Callable[[Channel, int], LidarDecoder], str]] = {
    ("cdr", pointclouds.SCHEMA): (pointclouds.PointClouds, pointclouds.DEFINITION),
    ("cdr", packets.SCHEMA): (packets.Packets, packets.DEFINITION),
}
_JOINTS: dict[tuple[str, str], tuple[Callable[[Channel], SeriesDecoder], str]] = {
    ("cdr", joint_states.SCHEMA): (joint_states.JointStates, joint_states.DEFINITION),
}
_FRAMES: dict[tuple[str, str], tuple[Callable[[Channel], SeriesDecoder], str]] = {
    ("cdr", transforms.SCHEMA): (transforms.Transforms, transforms.DEFINITION),
}
_AHRS: dict[tuple[str, str], tuple[Callable[[Channel], SeriesDecoder], str]] = {
    ("cdr", orientations.SCHEMA): (orientations.Orientations, orientations.DEFINITION),
}

_T = TypeVar("_T")

_MOVES = np.radians(1.0)  # a joint that turns less is not the gimbal of a scan
_UPRIGHT = 0.1  # sine of half the tilt that a gimbal's transform may have off its own z axis


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Choice:
    """The topics and the joint that the caller chose.

    Attributes
    ----------
    topics : collection of str or None
        Topics to use for the roles that they can have.
    joint : str or None
        Name of the gimbal's joint.
    """

    topics: Collection[str] | None = None
    joint: str | None = None

    def check(self, found: dict[str, str]) -> None:
        """Refuse names of topics that are not there."""
        missing = sorted(set(self.topics or ()) - set(found))
        if missing:
            raise RecordingError(
                f"The recording has no topic {missing[0]}; it has {_listed(found)}. Topics are "
                "named exactly as they were recorded."
            )

    def among(self, decoders: dict[str, _T]) -> dict[str, _T]:
        """Return the decoders of the topics that are named, or all if none of them is."""
        named = {topic: one for topic, one in decoders.items() if topic in (self.topics or ())}
        return named or decoders


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Decoders:
    """The decoders of one recording, by role and topic.

    Attributes
    ----------
    container : Container
        The recording; its likely size reserves memory.
    lidars, joints, frames, ahrs : dict of str to decoder
        By topic.
    by_channel : dict of Channel to decoder or None
        None for channels of no use.
    notes : list of str
        What was left out, as sentences.
    """

    container: Container
    lidars: dict[str, LidarDecoder] = field(default_factory=dict)
    joints: dict[str, SeriesDecoder] = field(default_factory=dict)
    frames: dict[str, SeriesDecoder] = field(default_factory=dict)
    ahrs: dict[str, SeriesDecoder] = field(default_factory=dict)
    by_channel: dict[Channel, LidarDecoder | SeriesDecoder | None] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def add(self, batch: Batch) -> None:
        """Decode a batch, if its channel has a decoder."""
        if batch.channel not in self.by_channel:
            self.by_channel[batch.channel] = self._find(batch.channel)
        decoder = self.by_channel[batch.channel]
        if decoder is not None:
            decoder.add(batch)

    def all_notes(self) -> tuple[str, ...]:
        """Return notes on what was left out: whole channels, and messages of signals."""
        signals = (self.joints, self.frames, self.ahrs)
        return (*self.notes, *(n for role in signals for one in role.values() for n in one.notes()))

    def _find(self, channel: Channel) -> LidarDecoder | SeriesDecoder | None:
        """Make the decoder of a channel, or take that of its topic."""
        key = (channel.encoding, channel.schema)
        if key in _LIDARS and self._is_readable(channel, _LIDARS[key][1]):
            decoder = _LIDARS[key][0](channel, self.container.likely_size)
            return self.lidars.setdefault(channel.topic, decoder)
        tables = ((_JOINTS, self.joints), (_FRAMES, self.frames), (_AHRS, self.ahrs))
        for table, mine in tables:
            if key in table and self._is_readable(channel, table[key][1]):
                return mine.setdefault(channel.topic, table[key][0](channel))
        return None

    def _is_readable(self, channel: Channel, definition: str) -> bool:
        """Return whether the definition is that of the decoder; note it if not."""
        if definition_agrees(channel, definition):
            return True
        self.notes.append(
            f"{channel.topic} is left out: its definition of {channel.schema} is not that of ROS 2."
        )
        return False


def read_log(
    url: str | Path,
    *,
    topics: Collection[str] | None = None,
    joint: str | None = None,
    digest: str = "",
) -> ScanLog:
    """Read a recording.

    Parameters
    ----------
    url : str or Path
        A path, or any address that fsspec knows.
    topics : collection of str, optional
        Topics to use. Where one is named for a role (LiDAR, joint, frames, AHRS), others in that
        role are ignored; roles without a named topic are found by their message types.
    joint : str, optional
        Name of the gimbal's joint, where several could be it.
    digest : str
        SHA-256 of the file, if the caller knows it; computed otherwise.

    Returns
    -------
    ScanLog
        Returns in the order of their instants, gimbal angles, orientations, and the rig if the
        recording describes it.

    Raises
    ------
    NotFoundError
        If there is no such file.
    NotMcapError
        If it is not an MCAP file.
    TruncatedRecordingError
        If it is incomplete or damaged.
    MissingLidarError
        If no topic holds LiDAR returns.
    MissingGimbalAngleError
        If no topic holds the gimbal's angle, or several joints could.
    RecordingError
        If a named topic is missing, or the clocks of LiDAR and gimbal do not overlap.

    Notes
    -----
    One walk over the mapped file; memory is that of the result. Cost grows linearly with the file.
    """
    with ThreadPoolExecutor(1) as beside, opened(url) as container:
        hashing = None if digest else beside.submit(file_digest, url)
        decoders = Decoders(container=container)
        for batch in container.batches():
            decoders.add(batch)
        found = container.topics()
        digest = hashing.result() if hashing else digest
    origin = Origin(name=stem(url), digest=digest)
    return assemble(decoders, found, Choice(topics=topics, joint=joint), origin)


def stem(url: str | Path) -> str:
    """Return the name of a recording: that of its file, without the ending."""
    return PurePosixPath(str(url)).stem


def assemble(decoders: Decoders, found: dict[str, str], choice: Choice, origin: Origin) -> ScanLog:
    """Choose among the decoded topics and build the log."""
    choice.check(found)
    returns, lidar_notes = _choose_lidar(choice.among(decoders.lidars), found)
    tree = FrameTree()
    for series in _all_series(choice.among(decoders.frames)):
        tree.add(series)
    imu = _choose_ahrs(_all_series(choice.among(decoders.ahrs)))
    rig, rig_notes = recorded_rig(tree, returns.frame, imu.names[0] if imu else None)
    joints = _all_series(choice.among(decoders.joints))
    gimbal = _choose_gimbal(joints, choice.joint, tree, returns.frame)
    if gimbal is None:
        gimbal = _angle_of_ahrs(imu, rig, joints, found)
    _require_overlap(returns, gimbal)
    imu_notes = imu.notes if imu else ()
    notes = (
        *decoders.all_notes(),
        *lidar_notes,
        *returns.notes,
        *gimbal.notes,
        *imu_notes,
        *rig_notes,
    )
    return ScanLog(
        p_lidar=returns.p_lidar,
        intensities=returns.intensities,
        rings=returns.rings,
        stamps_lidar_ns=returns.stamps_ns,
        has_pulse_times=returns.has_pulse_times,
        gimbal_angles=np.unwrap(gimbal.values[:, 0]),
        stamps_gimbal_ns=gimbal.stamps_ns,
        quaternions_imu=imu.values if imu else np.empty((0, 4)),
        stamps_imu_ns=imu.stamps_ns if imu else np.empty(0, np.int64),
        rig=rig,
        origin=origin,
        notes=tuple(dict.fromkeys(notes)),
        has_heights=returns.has_heights,
    )


def _listed(found: dict[str, str]) -> str:
    """Return topics with their message types as a phrase."""
    return ", ".join(f"{t} ({s or 'no type'})" for t, s in sorted(found.items())) or "no topics"


def _all_series(decoders: dict[str, SeriesDecoder]) -> list[Series]:
    """Return the signals of all topics that have samples."""
    return [s for one in decoders.values() for s in one.series() if len(s.stamps_ns)]


def _choose_lidar(
    lidars: dict[str, LidarDecoder], found: dict[str, str]
) -> tuple[Returns, tuple[str, ...]]:
    """Return the topic with the best returns: with pulse times, with rings, with most."""
    if not lidars:
        raise MissingLidarError(
            f"The recording holds no LiDAR topic. Found: {_listed(found)}. Expected one of: "
            f"{', '.join(f'{schema} ({encoding})' for encoding, schema in _LIDARS)}."
        )
    all_returns = [lidar.returns() for lidar in lidars.values()]
    best = max(
        all_returns,
        key=lambda r: (len(r.p_lidar) > 0, r.has_pulse_times, _has_rings(r), len(r.p_lidar)),
    )
    if not len(best.p_lidar):
        reasons = " ".join(note for r in all_returns for note in r.notes)
        raise MissingLidarError(
            f"The LiDAR topics hold no returns: {', '.join(lidars)}. {reasons}".strip()
        )
    if len(lidars) == 1:
        return best, ()
    others = ", ".join(topic for topic in lidars if topic != best.topic)
    return best, (f"{best.topic} is used; {others} could be chosen by naming the topic.",)


def _has_rings(returns: Returns) -> bool:
    """Return whether the lasers of the returns were recorded."""
    return len(returns.rings) > 0 and int(returns.rings[0]) != RING_UNKNOWN


def _choose_ahrs(candidates: list[Series]) -> Series | None:
    """Return the orientation with most samples."""
    return max(candidates, key=lambda one: len(one.stamps_ns), default=None)


def _choose_gimbal(
    joints: list[Series], joint: str | None, tree: FrameTree, frame: str
) -> Series | None:
    """Return the gimbal's angle from a joint, else from a transform that turns."""
    if joint is not None:
        joints = [one for one in joints if one.names[0] == joint]
    called = [one for one in joints if "gimbal" in one.names[0]]
    pool = called or joints
    moving = [one for one in pool if np.ptp(one.values) > _MOVES]
    if len(pool) == 1 or len(moving) == 1:
        return (moving if len(moving) == 1 else pool)[0]
    head = tree.head_of(frame)
    if head in tree.turning:
        return _angle_of_transform(tree.turning[head])
    if pool:
        names = ", ".join(f"{one.names[0]} of {one.topic}" for one in moving or pool)
        raise MissingGimbalAngleError(
            f"{len(moving or pool)} joints could be the gimbal: {names}. Name the joint of "
            "the gimbal, or its topic."
        )
    return None


def _angle_of_transform(series: Series) -> Series:
    """Return the angle by which a transform turns about its own z axis."""
    x, y, z, w = series.values[:, 3:].T
    if np.hypot(x, y).max() > _UPRIGHT:
        raise MissingGimbalAngleError(
            f"The transform from {series.names[1]} to {series.names[0]} does not turn about z "
            f"(up to {np.degrees(2 * np.arcsin(min(np.hypot(x, y).max(), 1.0))):.0f} deg off it)."
        )
    return replace(series, values=2.0 * np.arctan2(z, w)[:, None])


def _angle_of_ahrs(
    imu: Series | None, rig: Rig | None, joints: list[Series], found: dict[str, str]
) -> Series:
    """Return the gimbal's angle from an AHRS that turns with the head.

    The axis of the gimbal is where the head's z axis points on average; the angle is the rotation
    about it, from the heading in which the AHRS's own x axis began.
    """
    from scipy.spatial.transform import Rotation  # slow to import

    if imu is None or rig is None or rig.imu_mount is not ImuMount.HEAD:
        raise MissingGimbalAngleError(
            "No topic holds the angle of the gimbal. Expected a sensor_msgs/msg/JointState with "
            "its joint, a transform that turns (tf2_msgs/msg/TFMessage), or a sensor_msgs/msg/Imu "
            f"with orientation that /tf_static puts on the head. Found: {_listed(found)}"
            f"{f', with {len(joints)} joints' if joints else ''}."
        )
    R_world_head = Rotation.from_quat(imu.values).as_matrix() @ rig.R_mount_imu.T
    axis = R_world_head[:, :, 2].mean(axis=0)
    swing, _ = Rotation.align_vectors(axis[None], np.array([[0.0, 0.0, 1.0]]))
    R_base_head = swing.as_matrix().T @ R_world_head
    angles = np.arctan2(R_base_head[:, 1, 0], R_base_head[:, 0, 0])
    note = f"The gimbal's angle is the orientation of {imu.topic}; no joint was recorded."
    return replace(imu, values=angles[:, None], notes=(*imu.notes, note))


def _require_overlap(returns: Returns, gimbal: Series) -> None:
    """Raise RecordingError if the clocks have no instant in common."""
    lidar, other = returns.stamps_ns, gimbal.stamps_ns
    if lidar[0] <= other[-1] and other[0] <= lidar[-1]:
        return
    raise RecordingError(
        f"The clocks of LiDAR and gimbal do not overlap: {returns.topic} runs {_span(lidar)}, "
        f"{gimbal.topic} {_span(other)}. Both must stamp by one clock."
    )


def _span(stamps_ns: Nanos) -> str:
    """Return first and last instant as a phrase."""
    first, last = (
        datetime.fromtimestamp(int(ns) / 1e9, UTC).isoformat(timespec="milliseconds")
        for ns in stamps_ns[[0, -1]]
    )
    return f"from {first} to {last}"
