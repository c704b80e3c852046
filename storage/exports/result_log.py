"""Results of stops as an MCAP log, for Foxglove, Lichtblick and Rerun, beside the scan log.

Messages of Foxglove's schemas in protobuf, and the pose of ROS 2, at the instant of each stop. The
frames are ``site``, ``station`` and ``base_link``, to which the transforms of the scan log attach
its sensors.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import IO, Any

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema
from scipy.spatial.transform import Rotation

from spheremark.pipelines.geometry import by_motion, levelling_rotation
from spheremark.pipelines.model import Array, MarkerFit, StationFix, Status, StopResult
from spheremark.storage.clouds.stop import view
from spheremark.storage.files import keep_named
from spheremark.storage.recordings.definitions import definition, store

ELLIPSOID_SCALE = 100.0
"""How much larger than they are the 95 % ellipsoids of the centres are drawn."""

_POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
_SITE, _STATION, _BASE = "site", "station", "base_link"
_N_MAX = 200_000  # returns of a stop, away from markers
_CHI_95 = 2.7955  # square root of the 95 % quantile of chi squared with 3 degrees of freedom
_COLOURS = {Status.OK: (0.1, 0.7, 0.3), Status.WEAK: (0.95, 0.6, 0.1)}


class ResultLog:
    """Spheres, ellipsoids, clouds and poses of stops in one MCAP log, written stop by stop.

    Markers and stations are those of the first methods.

    Parameters
    ----------
    target : str, Path or binary file
        Where to write.
    """

    def __init__(self, target: str | Path | IO[bytes]) -> None:
        self._own: IO[bytes] | None = None
        if isinstance(target, str | Path):
            self._own = Path(target).open("wb")  # noqa: SIM115  closed by close
        self._writer = Writer(self._own or target, compression=CompressionType.ZSTD)  # type: ignore[arg-type]
        self._writer.start(profile="", library="spheremark")
        self._channels: dict[str, int] = {}

    def add(self, stop: StopResult) -> None:
        """Write one stop."""
        stamp_ns = stop.cloud.start_ns
        for topic, message in _messages(stop, stamp_ns):
            data = message.SerializeToString()
            self._add(topic, "protobuf", stamp_ns, data, message)
        fix = next(iter(stop.fixes.values()), None)
        if isinstance(fix, StationFix):
            self._add("/spheremark/pose", "cdr", stamp_ns, _ros_pose(fix, stamp_ns))

    def _add(
        self, topic: str, encoding: str, stamp_ns: int, data: bytes, message: Any = None
    ) -> None:
        """Write a message; the first of a topic with its schema."""
        if topic not in self._channels:
            if message is None:
                schema = self._writer.register_schema(_POSE, "ros2msg", definition(_POSE).encode())
            else:
                schema = register_schema(self._writer, type(message))
            self._channels[topic] = self._writer.register_channel(topic, encoding, schema)
        self._writer.add_message(self._channels[topic], stamp_ns, data, stamp_ns)

    def close(self) -> None:
        """Write the end of the file."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        if self._own is not None:
            self._own.close()


def write_result_log(stops: Sequence[StopResult], folder: str, run_id: str) -> str:
    """Write the results of a run as a log into a folder of clouds.

    Parameters
    ----------
    stops : sequence of StopResult
        The stops of the run.
    folder : str
        Path or fsspec URL of a folder; created when missing.
    run_id : str
        Id of the run, which names the file.

    Returns
    -------
    str
        Path or URL of the file.
    """
    buffer = io.BytesIO()
    with closing(ResultLog(buffer)) as log:
        for stop in stops:
            log.add(stop)
    return keep_named(buffer.getvalue(), f"{run_id}.mcap", folder)


def _ros_pose(fix: StationFix, stamp_ns: int) -> bytes:
    """Return the pose of a station as ROS has it.

    Its covariance is ordered position, rotation, both along the axes of the site, and the rotation
    is about the station, not about the origin of the site.
    """
    motion = np.eye(6)
    motion[3:, :3] = by_motion(fix.p_site)[:, :3]
    cov = motion @ fix.cov_T_site_station @ motion.T
    cov[3:, 3:] = fix.cov_p_site
    order = [3, 4, 5, 0, 1, 2]
    kinds = store().types
    pose = _pose(fix.p_site, fix.T_site_station[:3, :3])
    p, q = pose.position, pose.orientation
    stamp = kinds["builtin_interfaces/msg/Time"](
        sec=stamp_ns // 1_000_000_000, nanosec=stamp_ns % 1_000_000_000
    )
    point = kinds["geometry_msgs/msg/Point"](x=p.x, y=p.y, z=p.z)
    turn = kinds["geometry_msgs/msg/Quaternion"](x=q.x, y=q.y, z=q.z, w=q.w)
    message = kinds[_POSE](
        header=kinds["std_msgs/msg/Header"](stamp=stamp, frame_id=_SITE),
        pose=kinds["geometry_msgs/msg/PoseWithCovariance"](
            pose=kinds["geometry_msgs/msg/Pose"](position=point, orientation=turn),
            covariance=cov[np.ix_(order, order)].ravel(),
        ),
    )
    return bytes(store().serialize_cdr(message, _POSE))


def _messages(stop: StopResult, stamp_ns: int) -> Iterator[tuple[str, Any]]:
    """Yield topics and messages of a stop."""
    stamp = Timestamp()
    stamp.FromNanoseconds(stamp_ns)
    R = levelling_rotation(stop.cloud.levelling)
    yield "/spheremark/tf", FrameTransforms(transforms=list(_transforms(stop, R, stamp)))
    found = next(iter(stop.fits.values())).fits
    entities = [one for fit in found for one in _entities(fit, R, stamp)]
    yield "/spheremark/markers", SceneUpdate(entities=entities)
    yield "/spheremark/cloud", _cloud(stop, stamp)


def _transforms(stop: StopResult, R: Array, stamp: Timestamp) -> Iterator[FrameTransform]:
    """Yield the pose of the station in the site, if it has one, and the levelling of the base."""
    fix = next(iter(stop.fixes.values()), None)
    if isinstance(fix, StationFix):
        T = fix.T_site_station
        pose = _pose(T[:3, 3], T[:3, :3])
        yield FrameTransform(
            timestamp=stamp,
            parent_frame_id=_SITE,
            child_frame_id=_STATION,
            translation=pose.position,
            rotation=pose.orientation,
        )
    turn = _pose(np.zeros(3), R).orientation
    yield FrameTransform(
        timestamp=stamp, parent_frame_id=_STATION, child_frame_id=_BASE, rotation=turn
    )


def _entities(fit: MarkerFit, R: Array, stamp: Timestamp) -> Iterator[SceneEntity]:
    """Yield a marker as a sphere with its name, and the ellipsoid of its centre."""
    red, green, blue = _COLOURS.get(fit.status, (0.5, 0.5, 0.5))
    p = R @ fit.p_base
    entity = SceneEntity(timestamp=stamp, frame_id=_STATION, id=f"marker {fit.name}")
    sphere = entity.spheres.add(
        pose=_pose(p, np.eye(3)), color=Color(r=red, g=green, b=blue, a=0.6)
    )
    sphere.size.x = sphere.size.y = sphere.size.z = 2.0 * fit.radius
    above = p + np.array([0.0, 0.0, 2.0 * fit.radius])
    entity.texts.add(
        pose=_pose(above, np.eye(3)),
        billboard=True,
        font_size=fit.radius,
        color=Color(r=red, g=green, b=blue, a=1.0),
        text=fit.name,
    )
    for key, value in (("status", fit.status), ("range_m", f"{fit.mean_range:.3f}")):
        entity.metadata.add(key=key, value=str(value))
    yield entity
    if np.isfinite(fit.cov_p_base).all():
        variances, axes = np.linalg.eigh(R @ fit.cov_p_base @ R.T)
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        size = 2.0 * ELLIPSOID_SCALE * _CHI_95 * np.sqrt(np.maximum(variances, 0.0))
        scaled = f"{ELLIPSOID_SCALE:g} times its 95 % ellipsoid"
        other = SceneEntity(timestamp=stamp, frame_id=_STATION, id=f"{fit.name}: {scaled}")
        ellipsoid = other.spheres.add(
            pose=_pose(p, axes), color=Color(r=red, g=green, b=blue, a=0.3)
        )
        ellipsoid.size.x, ellipsoid.size.y, ellipsoid.size.z = size.tolist()
        yield other


def _pose(p: Array, R: Array) -> Pose:
    """Return a pose."""
    pose = Pose()
    pose.position.x, pose.position.y, pose.position.z = (float(value) for value in p)
    x, y, z, w = Rotation.from_matrix(R).as_quat().tolist()
    pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = x, y, z, w
    return pose


def _cloud(stop: StopResult, stamp: Timestamp) -> PointCloud:
    """Return a sample of the returns of a stop, with all of those near markers."""
    sample = view(stop, _N_MAX)
    columns = np.column_stack([sample.p_station, sample.intensities]).astype("<f4")
    names = ("x", "y", "z", "intensity")
    return PointCloud(
        timestamp=stamp,
        frame_id=_STATION,
        pose=_pose(np.zeros(3), np.eye(3)),
        point_stride=columns.strides[0],
        fields=[
            PackedElementField(name=name, offset=4 * i, type=PackedElementField.FLOAT32)
            for i, name in enumerate(names)
        ],
        data=columns.tobytes(),
    )
