"""From a file to a ``ScanLog``: chooses the topics of LiDAR, gimbal, frames and AHRS."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import TypeVar

import numpy as np

from spheremark.pipelines.errors import InputError, MissingLidarError
from spheremark.pipelines.model import RING_UNKNOWN, Origin, Rig, ScanLog
from spheremark.pipelines.scan.diagnosis import diagnose
from spheremark.storage.recordings.decoding import LIDAR_TYPES, Decoders
from spheremark.storage.recordings.families import LidarDecoder, Returns, Series, SeriesDecoder
from spheremark.storage.recordings.frames import FrameTree, recorded_rig
from spheremark.storage.recordings.gimbal import (
    Signals,
    choose_gimbal,
    level_by_gravity,
    require_overlap,
)
from spheremark.storage.recordings.lasers import carries_heights, with_lasers
from spheremark.storage.recordings.options import TIME_UNITS, LogOptions, listed
from spheremark.storage.recordings.pointclouds import PointClouds
from spheremark.storage.recordings.sources import file_digest, opened

_T = TypeVar("_T")

_EARLY = (-1.25, -0.5)  # of the points' duration: so early are clouds that are stamped at their end
_WITHOUT_HEIGHTS = (
    "The points of {} are without the vertical offsets of their beams, as their lines show: they "
    "are read so, whatever the rig says of cloud_carries_heights."
)
_UNREAD = ("LaserScan", "Packet", "Packets", "PacketMsg", "UdpFrame", "CompressedPointCloud")


@dataclass(frozen=True, slots=True, kw_only=True)
class LogFile:
    """A log on this machine, and how to read it.

    Attributes
    ----------
    path : Path
        A file or a folder.
    options : LogOptions
        What cannot be found in it.
    beside : tuple of Path
        Further files of the same log.
    """

    path: Path
    options: LogOptions = field(default_factory=LogOptions)
    beside: tuple[Path, ...] = ()

    def read(self) -> ScanLog:
        """Read the log."""
        return read_log(self.path, self.options, beside=self.beside)


def read_log(
    url: str | Path,
    options: LogOptions | None = None,
    *,
    beside: Sequence[Path] = (),
    topics: Collection[str] | None = None,
    joint: str | None = None,
    digest: str = "",
) -> ScanLog:
    """Read a recording.

    Parameters
    ----------
    url : str or Path
        A file (MCAP, .db3 of rosbag2, ROS 1 bag, PCAP, or a zip of these), a folder of them, or any
        address of a file that fsspec knows.
    options : LogOptions, optional
        Topics, joint and clocks, where they cannot be found.
    beside : sequence of Path
        Further files of the same log, such as the PCAP of the LiDAR.
    topics : collection of str, optional
        In place of those of the options.
    joint : str, optional
        In place of that of the options.
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
        If it is no log of a known kind.
    TruncatedRecordingError
        If it is incomplete or damaged, and the options do not accept that.
    MissingLidarError
        If no topic holds LiDAR returns.
    MissingGimbalAngleError
        If no topic holds the gimbal's angle, or several joints could.
    RecordingError
        If a named topic or joint is missing, the clocks of LiDAR and gimbal do not overlap, or the
        gimbal turns faster than a gimbal can.

    Notes
    -----
    One walk over the mapped file; memory is that of the result. Cost grows linearly with the file.
    """
    options = options or LogOptions()
    if topics is not None:
        options = replace(options, topic=tuple(topics))
    if joint is not None:
        options = replace(options, joint=joint)
    with (
        ThreadPoolExecutor(1) as other,
        opened(url, beside, recover=options.recover) as recording,
    ):
        hashing = None if digest else other.submit(file_digest, url)
        decoders = Decoders(recording)
        for batch in recording.batches():
            decoders.add(batch)
        digest = hashing.result() if hashing else digest
    return assemble(decoders, options, Origin(name=stem(url), digest=digest))


def diagnosis(
    log: ScanLog,
    options: LogOptions,
    read: Callable[[LogOptions], ScanLog],
    rig: Rig | None = None,
) -> tuple[str, ...]:
    """Try other signs, units and clocks on a log.

    Parameters
    ----------
    log : ScanLog
        As it was read.
    options : LogOptions
        How it was read.
    read : callable
        Reads it with other options.
    rig : Rig, optional
        How the LiDAR sits on the gimbal; that of the log by default.

    Returns
    -------
    tuple of str
        Sentences: the option that makes the scan consistent, or that none does.
    """
    others = _in_other_units(log, options, read)
    scale, offset = options.joint_scale, options.lidar_offset_s
    return diagnose(log, rig, others, joint_scale=scale, lidar_offset=offset)


def _in_other_units(
    log: ScanLog, options: LogOptions, read: Callable[[LogOptions], ScanLog]
) -> Iterator[tuple[str, ScanLog]]:
    """Yield a log with other units of its points' times, and the option of each."""
    for unit in TIME_UNITS:
        try:
            other = read(replace(options, time_unit=unit))
        except InputError:  # as clocks that have no instant in common with that unit
            continue
        if not np.array_equal(other.stamps_lidar_ns, log.stamps_lidar_ns):
            yield f"--time-unit {unit}", other


def stem(url: str | Path) -> str:
    """Return the name of a recording: that of its file, without the ending."""
    return PurePosixPath(str(url)).stem


def assemble(decoders: Decoders, options: LogOptions, origin: Origin) -> ScanLog:
    """Choose among the decoded topics and build the log."""
    found = decoders.recording.topics()
    options.check(found)
    lidar, returns = _choose_lidar(_among(decoders.lidars, options), found, options)
    tree = FrameTree()
    for series in _all_series(_among(decoders.frames, options)):
        tree.add(series)
    imus = _among(decoders.ahrs, options)
    imu = _choose_ahrs(_all_series(imus))
    rig, rig_notes = recorded_rig(tree, returns.frame, imu.names[0] if imu else None)
    signals = Signals(
        joints=_all_series(_among(decoders.joints, options)),
        numbers=_all_series(_among(decoders.numbers, options)),
        tree=tree,
        imu=imu,
        found=found,
    )
    gimbal, rig = choose_gimbal(signals, options, returns.frame, rig)
    returns = _from_start(lidar, returns, gimbal, options)
    require_overlap(returns, gimbal)
    lasers = with_lasers(rig, returns)
    rig, laser_notes = lasers.rig, lasers.notes
    has_heights = carries_heights(lasers, returns)
    if has_heights is False and returns.has_heights is None:
        laser_notes = (*laser_notes, _WITHOUT_HEIGHTS.format(returns.topic))
    sigma, level_notes = 0.0, tuple[str, ...]()
    if imu is None:
        imu, rig, sigma, level_notes = level_by_gravity(imus, tree, rig, returns.frame)
    weaknesses = (*decoders.recording.lost, *lasers.weaknesses)
    notes = (
        *decoders.all_notes(),
        *returns.notes,
        *gimbal.notes,
        *(imu.notes if imu else ()),
        *rig_notes,
        *laser_notes,
        *level_notes,
    )
    return ScanLog(
        p_lidar=returns.p_lidar,
        intensities=returns.intensities,
        rings=lasers.rings,
        stamps_lidar_ns=returns.stamps_ns,
        has_pulse_times=returns.has_pulse_times,
        gimbal_angles=gimbal.values[:, 0],
        stamps_gimbal_ns=gimbal.stamps_ns,
        quaternions_imu=imu.values if imu else np.empty((0, 4)),
        stamps_imu_ns=imu.stamps_ns if imu else np.empty(0, np.int64),
        rig=rig,
        origin=origin,
        notes=tuple(dict.fromkeys(notes)),
        has_heights=has_heights,
        weaknesses=weaknesses,
        sigma_levelling=sigma,
    )


def _among(decoders: dict[str, _T], options: LogOptions) -> dict[str, _T]:
    """Return the decoders of the topics that are named, or all if none of them is."""
    named = {topic: one for topic, one in decoders.items() if topic in options.topic}
    return named or decoders


def _all_series(decoders: Mapping[str, SeriesDecoder]) -> list[Series]:
    """Return the signals of all topics that have samples."""
    return [s for one in decoders.values() for s in one.series() if len(s.stamps_ns)]


def _choose_lidar(
    lidars: dict[str, LidarDecoder], found: Mapping[str, str], options: LogOptions
) -> tuple[LidarDecoder, Returns]:
    """Return the topic with the best returns: with pulse times, with rings, with most."""
    if not lidars:
        unread = [f"{t} ({s})" for t, s in sorted(found.items()) if s.split("/")[-1] in _UNREAD]
        hint = (
            f"{', '.join(unread)} cannot be read: record the driver's point clouds."
            if unread
            else "Where another file holds it, read both together (a folder, a zip, or --pcap)."
        )
        raise MissingLidarError(
            f"The recording holds no LiDAR topic. Found: {listed(found)}. Expected one of: "
            f"{', '.join(LIDAR_TYPES)}. {hint}"
        )
    read = [
        (
            lidar,
            lidar.returns(options.time_unit) if isinstance(lidar, PointClouds) else lidar.returns(),
        )
        for lidar in lidars.values()
    ]
    lidar, best = max(
        read,
        key=lambda pair: (
            len(pair[1].p_lidar) > 0,
            pair[1].has_pulse_times,
            _has_rings(pair[1]),
            len(pair[1].p_lidar),
        ),
    )
    if not len(best.p_lidar):
        reasons = " ".join(note for _, one in read for note in one.notes)
        raise MissingLidarError(
            f"The LiDAR topics hold no returns: {', '.join(lidars)}. {reasons}".strip()
        )
    if len(lidars) == 1:
        return lidar, best
    others = ", ".join(topic for topic in lidars if topic != best.topic)
    note = f"{best.topic} is used; {others} could be chosen with --topic (topic=... in a request)."
    return lidar, replace(best, notes=(note, *best.notes))


def _has_rings(returns: Returns) -> bool:
    """Return whether the lasers of the returns were recorded."""
    return len(returns.rings) > 0 and int(returns.rings[0]) != RING_UNKNOWN


def _choose_ahrs(candidates: list[Series]) -> Series | None:
    """Return the orientation with most samples."""
    return max(candidates, key=lambda one: len(one.stamps_ns), default=None)


def _from_start(
    lidar: LidarDecoder, returns: Returns, gimbal: Series, options: LogOptions
) -> Returns:
    """Return the returns on the gimbal's clock, from the start of each message.

    A message is recorded after its last point was measured. One that is stamped with its end, and
    whose times count from its first point, seems to be recorded by its duration too early.
    """
    if isinstance(lidar, PointClouds) and returns.span_ns:
        early = (returns.lateness_ns - gimbal.lateness_ns) / returns.span_ns
        is_end = options.stamp == "auto" and _EARLY[0] < early < _EARLY[1]
        note = (
            f"The points of {returns.topic} would be measured up to {returns.span_ns * 1e-9:.3f} s "
            "after they were recorded: its stamps are taken as those of the last point (--stamp "
            "start if they are not)."
        )
        if is_end or options.stamp == "end":
            notes = (*returns.notes, note) if is_end else returns.notes
            returns = replace(lidar.stamped_at_end(options.time_unit), notes=notes)
    if options.lidar_offset_s:
        offset = np.int64(round(options.lidar_offset_s * 1e9))
        returns = replace(returns, stamps_ns=returns.stamps_ns + offset)
    return returns
