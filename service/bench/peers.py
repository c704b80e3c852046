"""The same chain from the usual libraries, for comparison.

mcap-ros2-support decodes messages, velodyne-decoder packets; SciPy rotates, Open3D cuts the
ground with a plane, clusters with DBSCAN and registers a hemisphere to each cluster; DuckDB takes
the rows one by one. Each step is written as its documentation shows it, in arrays where the library
allows, and with the parameters that suit the field. Where the tools of PCL are installed, they cut
and cluster too.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any, ClassVar, TypeVar

import numpy as np

from spheremark.pipelines.errors import InputError
from spheremark.pipelines.model import Array, Column, Rig

_PLANE_NEAR = 0.15  # [m] from the plane: ground
_PLANE_TRIALS = 100
_CLUSTER_GAP = 0.10  # [m] between neighbours in a cluster
_CLUSTER_MIN = 10  # neighbours of a point inside a cluster
_N_POINTS = 20  # of a cluster that may be a marker
_RMS_MAX = 0.03  # [m] about the sphere
_USUAL_RADIUS, _VOXEL = 0.1, 0.02  # [m] cubes that thin a cloud about markers of that radius
_RADIUS_OFF, _INLIERS = 0.2, 0.8  # by which a radius may be off, and the share of inliers wanted
_N_MODEL = 1000  # points of the hemisphere
_PCL = {  # the tools of PCL for each step, with parameters that suit the field
    "plane": f"pcl_sac_segmentation_plane -thresh {_PLANE_NEAR} -max_it {_PLANE_TRIALS}".split(),
    "clusters": f"pcl_cluster_extraction -tolerance {_CLUSTER_GAP} -min {_CLUSTER_MIN}".split(),
}
_PCL_DONE = re.compile(r"\[done, ([\d.]+) ms(?:, plane has)? : (\d+) (?:points\]\s*Model|clusters)")
_TYPES = ("PointCloud2", "VelodyneScan", "JointState")
_KINDS = ("", "i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")  # by PointField.datatype

PEERS = ("Open3D", "pyransac3d")
"""Libraries that find spheres, by the name of their column."""

_Made = TypeVar("_Made")


class MissingPeerError(InputError):
    """A library that the comparison needs is not installed."""

    code: ClassVar[str] = "missing_peer"


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PeerRun:
    """Time by step of our own chain [s], and centres of spheres in the base frame, (n, 3) [m]."""

    seconds: dict[str, float] = field(default_factory=dict)
    centres: Array


def run_peers(log: Path, rig: Rig, radius: float) -> PeerRun:
    """Run the chain once, from the file to committed rows."""
    _require()
    seconds: dict[str, float] = {}
    p_lidar, stamps, joints = _timed(seconds, "read log", lambda: _decode(log))
    p_base = _timed(seconds, "stitching", lambda: _stitch(p_lidar, stamps, joints, rig))
    clusters = _timed(seconds, "extraction", lambda: _clusters(p_base))
    centres = _timed(seconds, "fitting", lambda: _fitted(clusters, radius))
    _timed(seconds, "rows and commit", lambda: _commit(centres, log.with_suffix(".peer.duckdb")))
    return PeerRun(seconds=seconds, centres=centres)


def ransac_centre(points: Array) -> Array | None:
    """Return the centre of a sphere by pyransac3d; None where it finds none or is missing."""
    try:
        import pyransac3d
    except ModuleNotFoundError:
        return None
    np.random.seed(0)  # noqa: NPY002  the library draws from NumPy's global state
    centre, _, _ = pyransac3d.Sphere().fit(points, thresh=0.02, maxIteration=500)
    return np.asarray(centre, dtype=np.float64) if len(centre) == 3 else None


def spheres_of_peers(p_base: Array, radius: float) -> dict[str, Array]:
    """Return the centres that Open3D and pyransac3d find in a cloud, by name of the method.

    Both take the compact clusters off the ground of the thinned cloud: a hemisphere registered to
    each, and a sphere of free radius through it by RANSAC, which must come near the given one.
    """
    scale = radius / _USUAL_RADIUS
    clusters = [
        points
        for points in _clusters(_thinned(p_base, _VOXEL * scale), scale)
        if len(points) >= _CLUSTER_MIN and np.ptp(points[:, :2], axis=0).max() <= 4.0 * radius
    ]
    return {PEERS[0]: _fitted(clusters, radius, _CLUSTER_MIN), PEERS[1]: _ransac(clusters, radius)}


def _thinned(p: Array, edge: float) -> Array:
    """Return one mean point of each cube [m]."""
    from open3d import geometry, utility

    cloud = geometry.PointCloud(utility.Vector3dVector(p))
    return np.asarray(cloud.voxel_down_sample(edge).points)


def _ransac(clusters: list[Array], radius: float) -> Array:
    """Return the centres of the spheres by RANSAC that are about as large as wanted."""
    import pyransac3d

    np.random.seed(0)  # noqa: NPY002  the library draws from NumPy's global state
    centres = []
    for points in clusters:
        top = points[points[:, 2] > points[:, 2].max() - 2.0 * radius]
        if len(top) < _CLUSTER_MIN:
            continue
        centre, found, inliers = pyransac3d.Sphere().fit(top, thresh=0.02, maxIteration=200)
        if abs(found - radius) < _RADIUS_OFF * radius and len(inliers) > _INLIERS * len(top):
            centres.append(centre)
    return np.array(centres, dtype=np.float64).reshape(-1, 3)


def registered_centre(points: Array, radius: float) -> Array:
    """Return the centre of a hemisphere of known radius by Open3D's point-to-point ICP."""
    from open3d import geometry, pipelines, utility

    model = geometry.PointCloud(utility.Vector3dVector(_hemisphere(points.mean(axis=0), radius)))
    start = np.eye(4)
    start[:3, 3] = points.mean(axis=0)
    cloud = geometry.PointCloud(utility.Vector3dVector(points))
    result = pipelines.registration.registration_icp(model, cloud, 3.0 * radius, start)
    return np.array(result.transformation[:3, 3])


def _require() -> None:
    """Refuse to compare where a library is missing."""
    try:
        import mcap_ros2.decoder  # noqa: F401
        import velodyne_decoder  # noqa: F401
    except ModuleNotFoundError as error:
        raise MissingPeerError(
            f"{error.name} is not installed. The comparison needs the development packages: "
            "pip install 'spheremark[dev]', or use `spheremark bench --quick`."
        ) from error


def _timed(seconds: dict[str, float], step: str, work: Callable[[], _Made]) -> _Made:
    """Run a step and record its time [s]."""
    start = perf_counter()
    made = work()
    seconds[step] = perf_counter() - start
    return made


def _decode(log: Path) -> tuple[Array, Array, Array]:
    """Return points, their instants and joint samples (instant, angle) [s from the first]."""
    points, stamps, joints = [], [], []
    unpack = _packet_decoder()
    for kind, message in _messages(log):
        stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
        if kind == "JointState":
            joints.append((stamp, message.position[0]))
            continue
        p, times = _cloud(message) if kind == "PointCloud2" else unpack(message)
        points.append(p)
        stamps.append(stamp + (times * 1e9).astype(np.int64))
    first = joints[0][0]
    table = np.array([((stamp - first) * 1e-9, angle) for stamp, angle in joints])
    return np.concatenate(points), (np.concatenate(stamps) - first) * 1e-9, table


def _messages(log: Path) -> Iterator[tuple[str, Any]]:
    """Give the messages of LiDAR and gimbal, decoded, with their types."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with log.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        channels = summary.channels.values() if summary else ()
        kinds = {schema.id: schema.name for schema in summary.schemas.values()} if summary else {}
        topics = [one.topic for one in channels if kinds[one.schema_id].endswith(_TYPES)]
        for _, channel, _, message in reader.iter_decoded_messages(topics):
            yield kinds[channel.schema_id].rpartition("/")[2], message


def _cloud(message: Any) -> tuple[Array, Array]:
    """Return the points of a PointCloud2 and their times since its stamp [s]."""
    rows = np.frombuffer(bytes(message.data), _layout(message))
    return np.stack([rows["x"], rows["y"], rows["z"]], axis=1).astype(np.float64), rows["time"]


def _packet_decoder() -> Callable[[Any], tuple[Array, Array]]:
    """Return a function to the points of a VelodyneScan and their times since its stamp [s]."""
    import velodyne_decoder as vd

    config = vd.Config(model=vd.Model.VLP16, timestamp_first_packet=True)
    decoder = vd.ScanDecoder(config)

    def unpack(message: Any) -> tuple[Array, Array]:
        packets = vd.PacketVector()
        for one in message.packets:
            instant = one.stamp.sec + one.stamp.nanosec * 1e-9
            packets.append(vd.VelodynePacket(instant, bytes(one.data)))
        start, points = decoder.decode(packets)
        stamp = message.header.stamp
        since = start.host - stamp.sec - stamp.nanosec * 1e-9
        return points[:, :3].astype(np.float64), points[:, 4].astype(np.float64) + since

    return unpack


def _layout(cloud: Any) -> np.dtype[np.void]:
    """Return the type of a point of a PointCloud2."""
    return np.dtype(
        {
            "names": [one.name for one in cloud.fields],
            "formats": [_KINDS[one.datatype] for one in cloud.fields],
            "offsets": [one.offset for one in cloud.fields],
            "itemsize": cloud.point_step,
        }
    )


def _stitch(p_lidar: Array, stamps: Array, joints: Array, rig: Rig) -> Array:
    """Turn points into the base frame, each by the gimbal angle at its instant."""
    from scipy.spatial.transform import Rotation

    angles = np.interp(stamps, joints[:, 0], joints[:, 1])
    T = rig.T_head_lidar
    p_head = p_lidar @ T[:3, :3].T + T[:3, 3]
    return np.asarray(Rotation.from_euler("z", angles[:, None]).apply(p_head))


def _clusters(p_base: Array, scale: float = 1.0) -> list[Array]:
    """Return clusters of the points off the ground, of markers of a scale."""
    rest = _off_ground(p_base)
    labels = np.asarray(rest.cluster_dbscan(scale * _CLUSTER_GAP, _CLUSTER_MIN))
    points = np.asarray(rest.points)[np.argsort(labels, kind="stable")]
    return np.split(points, np.cumsum(np.bincount(labels + 1))[:-1])[1:]


def _off_ground(p_base: Array) -> Any:
    """Return Open3D's cloud of the points off the largest plane."""
    from open3d import geometry, utility

    utility.random.seed(0)
    cloud = geometry.PointCloud(utility.Vector3dVector(p_base))
    _, ground = cloud.segment_plane(_PLANE_NEAR, 3, _PLANE_TRIALS)
    return cloud.select_by_index(ground, invert=True)


def pcl_seconds(p: Column) -> dict[str, float] | None:
    """Return the times of PCL's tools for plane and clusters, without files; None without PCL.

    Clusters are sought in the points that Open3D leaves off the ground, as for the others.
    """
    if not all(shutil.which(tool) for tool, *_ in _PCL.values()):
        return None
    p_base = p.astype(np.float64)
    clouds = {"plane": p_base, "clusters": np.asarray(_off_ground(p_base).points)}
    found: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        for step, (tool, *options) in _PCL.items():
            _write_pcd(folder / "in.pcd", clouds[step])
            command = [tool, str(folder / "in.pcd"), str(folder / "out.pcd"), *options]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            if found_text := _PCL_DONE.search(done.stdout + done.stderr):
                found[f"{step}_seconds"] = float(found_text[1]) * 1e-3
                found[f"n_{step}"] = int(found_text[2])
    return found


def _write_pcd(path: Path, p: Array) -> None:
    """Write points in the format of PCL."""
    fields = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1"
    head = f"VERSION 0.7\n{fields}\nWIDTH {len(p)}\nHEIGHT 1\nPOINTS {len(p)}\nDATA binary\n"
    path.write_bytes(head.encode() + p.astype("<f4").tobytes())


def _fitted(clusters: list[Array], radius: float, n_points: int = _N_POINTS) -> Array:
    """Return the centres of the clusters whose top fits a sphere of known radius."""
    centres = []
    for points in clusters:
        top = points[points[:, 2] > points[:, 2].max() - 2.0 * radius]  # without the pole
        if len(top) < n_points or np.ptp(points[:, :2], axis=0).max() > 4.0 * radius:
            continue
        centre = registered_centre(top, radius)
        off = np.linalg.norm(top - centre, axis=1) - radius
        if np.sqrt(np.mean(off**2)) < _RMS_MAX:
            centres.append(centre)
    return np.array(centres).reshape(-1, 3)


def _hemisphere(toward: Array, radius: float) -> Array:
    """Return points spread evenly over the half of a sphere about zero that faces the sensor."""
    z = 1.0 - (np.arange(2 * _N_MODEL) + 0.5) / _N_MODEL
    phi = np.pi * (1.0 + np.sqrt(5.0)) * np.arange(2 * _N_MODEL)
    rho = np.sqrt(1.0 - z**2)
    sphere = radius * np.column_stack([rho * np.cos(phi), rho * np.sin(phi), z])
    return np.asarray(sphere[sphere @ toward < 0.0])


def _commit(centres: Array, path: Path) -> None:
    """Write the centres into a new database, row by row in one transaction."""
    import duckdb

    path.unlink(missing_ok=True)
    with duckdb.connect(str(path)) as connection:
        connection.execute("CREATE TABLE fits (marker INTEGER, x DOUBLE, y DOUBLE, z DOUBLE)")
        connection.execute("BEGIN")
        rows = [(i, *centre) for i, centre in enumerate(centres.tolist())]
        if rows:
            connection.executemany("INSERT INTO fits VALUES (?, ?, ?, ?)", rows)
        connection.execute("COMMIT")
    path.unlink()
