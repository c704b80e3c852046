"""A log that none of our code has written, from formulas that none of our code knows.

The world is flat ground with spheres on poles; the log is written by the ROS 2 support of the MCAP
project, with frames, joint names, a tilt and an AHRS mounting that our simulator does not use.
"""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from mcap_ros2.writer import Writer
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

RADIUS = 0.100
SIGMA = 0.005  # [m]
START_NS = 1_750_000_000_123_456_789
TURN = 6.3  # [s]
REVOLUTION = 0.1  # [s]
CYCLE = 55.296e-6  # [s]

POINTCLOUD = """std_msgs/Header header
uint32 height
uint32 width
sensor_msgs/PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
================================================================================
MSG: sensor_msgs/PointField
string name
uint32 offset
uint8 datatype
uint32 count
"""
SEPARATOR = "=" * 80 + "\n"
HEADER = SEPARATOR + SEPARATOR.join(POINTCLOUD.split(SEPARATOR)[1:3])
JOINTS = f"""std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
{HEADER}"""
QUATERNION = (
    "=" * 80 + "\nMSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
)
VECTOR = "=" * 80 + "\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
IMU = f"""std_msgs/Header header
geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
float64[9] linear_acceleration_covariance
{HEADER}{QUATERNION}{VECTOR}"""
TF = f"""geometry_msgs/TransformStamped[] transforms
{"=" * 80}
MSG: geometry_msgs/TransformStamped
std_msgs/Header header
string child_frame_id
geometry_msgs/Transform transform
{"=" * 80}
MSG: geometry_msgs/Transform
geometry_msgs/Vector3 translation
geometry_msgs/Quaternion rotation
{HEADER}{QUATERNION}{VECTOR}"""


def world():
    """Marks, poses and mountings of the test's own world."""
    azimuths = np.radians([5, 50, 85, 140, 200, 230, 290, 335])
    ranges = np.array([5.1, 6.0, 7.2, 5.6, 6.6, 8.1, 4.7, 7.7])
    heights = np.array([1.0, 0.8, 1.3, 0.9, 1.1, 0.7, 1.2, 1.4])
    marks = np.stack([ranges * np.cos(azimuths), ranges * np.sin(azimuths), heights], axis=1)
    return SimpleNamespace(
        marks=marks + np.array([100.0, 50.0, 0.0]),
        R_site_base=Rotation.from_euler("ZYX", [40, -3, 2], degrees=True).as_matrix(),
        station=np.array([100.3, 49.6, 1.05]),
        R_head_lidar=Rotation.from_euler("xz", [-89, 7], degrees=True).as_matrix(),
        offset=np.array([0.05, -0.03, 0.0]),
        R_base_imu=Rotation.from_euler("z", 90, degrees=True).as_matrix(),
        start_angle=1.0,
    )


def shoot(w, rng):
    """Return time, ring, coordinates in the LiDAR frame of every return of one turn."""
    n = int(TURN / CYCLE)
    ring = np.tile(np.arange(16), n)
    time = np.repeat(np.arange(n) * CYCLE, 16) + 2.304e-6 * ((ring % 8) * 2 + ring // 8)
    azimuth = 2 * np.pi * time / REVOLUTION
    elevation = np.radians(-15 + 2 * ring)
    u_lidar = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            -np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        axis=1,
    )
    height = -0.04191 * np.tan(elevation)
    angle = w.start_angle + 2 * np.pi * time / TURN
    c, s = np.cos(angle), np.sin(angle)

    def to_site(v):
        v = v @ w.R_head_lidar.T
        return v, np.stack([c * v[:, 0] - s * v[:, 1], s * v[:, 0] + c * v[:, 1], v[:, 2]], axis=1)

    _, u = to_site(u_lidar)
    o_head = height[:, None] * w.R_head_lidar[:, 2] + w.offset
    o = np.stack(
        [c * o_head[:, 0] - s * o_head[:, 1], s * o_head[:, 0] + c * o_head[:, 1], o_head[:, 2]], 1
    )
    u, o = u @ w.R_site_base.T, o @ w.R_site_base.T + w.station
    r = cast(o, u, w.marks)
    keep = np.isfinite(r) & (r < 40)
    r = r[keep] + rng.normal(0, SIGMA, keep.sum())
    p = r[:, None] * u_lidar[keep]
    p[:, 2] += height[keep]
    return time[keep], ring[keep], p


def cast(o, u, marks):
    """Range to ground, spheres and poles along each beam; infinite where there is nothing."""
    with np.errstate(divide="ignore", invalid="ignore"):
        r = np.where(u[:, 2] < 0, -o[:, 2] / u[:, 2], np.inf)
        for mark in marks:
            m = mark - o
            b = np.einsum("ij,ij->i", m, u)
            q = np.einsum("ij,ij->i", m, m) - b**2
            sphere = b - np.sqrt(RADIUS**2 - q)
            r = np.where((q < RADIUS**2) & (sphere > 0) & (sphere < r), sphere, r)
            a = (u[:, :2] ** 2).sum(axis=1)
            b2 = np.einsum("ij,ij->i", m[:, :2], u[:, :2])
            pole = (b2 - np.sqrt(b2**2 - a * ((m[:, :2] ** 2).sum(axis=1) - 0.015**2))) / a
            z = o[:, 2] + pole * u[:, 2]
            r = np.where((pole > 0) & (pole < r) & (z > 0) & (z < mark[2] - 0.09), pole, r)
    return r


def stamp(seconds):
    ns = START_NS + round(seconds * 1e9)
    return {"sec": ns // 10**9, "nanosec": ns % 10**9}, ns


def quaternion(R):
    return dict(zip("xyzw", Rotation.from_matrix(R).as_quat().tolist(), strict=True))


def vector(v):
    return dict(zip("xyz", np.asarray(v, float).tolist(), strict=True))


def write(path, w, rng):
    time, ring, p = shoot(w, rng)
    layout = np.dtype(
        {
            "names": ["x", "y", "z", "intensity", "ring", "time"],
            "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<f4"],
            "offsets": [0, 4, 8, 16, 20, 24],
            "itemsize": 32,
        }
    )
    kinds = [7, 7, 7, 7, 4, 7]
    fields = [
        {"name": n, "offset": layout.fields[n][1], "datatype": k, "count": 1}
        for n, k in zip(layout.names, kinds, strict=True)
    ]
    zeros = [0.0] * 9
    with path.open("wb") as stream:
        out = Writer(stream)
        cloud = out.register_msgdef("sensor_msgs/msg/PointCloud2", POINTCLOUD)
        joints = out.register_msgdef("sensor_msgs/msg/JointState", JOINTS)
        imu = out.register_msgdef("sensor_msgs/msg/Imu", IMU)
        tf = out.register_msgdef("tf2_msgs/msg/TFMessage", TF)

        def send(topic, schema, message, ns):
            out.write_message(topic, schema, message, log_time=ns, publish_time=ns)

        start, ns = stamp(0.0)
        mountings = [
            ("gimbal_link", "lidar_top", w.offset, w.R_head_lidar),
            ("base_link", "ahrs", [0.1, 0.0, -0.2], w.R_base_imu),
        ]
        send("/tf_static", tf, {"transforms": [
            {"header": {"stamp": start, "frame_id": parent}, "child_frame_id": child,
             "transform": {"translation": vector(t), "rotation": quaternion(R)}}
            for parent, child, t, R in mountings
        ]}, ns)  # fmt: skip
        for t in np.arange(-0.02, TURN + 0.03, 0.01):
            when, ns = stamp(t)
            angle = w.start_angle + 2 * np.pi * t / TURN
            wrapped = float((angle + np.pi) % (2 * np.pi) - np.pi)
            send("/gimbal/state", joints, {
                "header": {"stamp": when, "frame_id": ""}, "name": ["pan"],
                "position": [wrapped], "velocity": [], "effort": [],
            }, ns)  # fmt: skip
            send("/ahrs", imu, {
                "header": {"stamp": when, "frame_id": "ahrs"},
                "orientation": quaternion(w.R_site_base @ w.R_base_imu),
                "orientation_covariance": zeros, "angular_velocity": vector([0, 0, 0]),
                "angular_velocity_covariance": zeros,
                "linear_acceleration": vector([0, 0, 9.81]),
                "linear_acceleration_covariance": zeros,
            }, ns)  # fmt: skip
        for k in range(int(np.ceil(TURN / REVOLUTION))):
            these = (time >= k * REVOLUTION) & (time < (k + 1) * REVOLUTION)
            rows = np.zeros(these.sum(), layout)
            rows["x"], rows["y"], rows["z"] = p[these].T
            rows["intensity"], rows["ring"] = 60.0, ring[these]
            rows["time"] = time[these] - k * REVOLUTION
            when, ns = stamp(k * REVOLUTION)
            send("/points", cloud, {
                "header": {"stamp": when, "frame_id": "lidar_top"}, "height": 1, "width": len(rows),
                "fields": fields, "is_bigendian": False, "point_step": 32,
                "row_step": 32 * len(rows), "data": rows.tobytes(), "is_dense": True,
            }, ns)  # fmt: skip
        out.finish()


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    folder = tmp_path_factory.mktemp("others")
    w = world()
    write(folder / "foreign.mcap", w, np.random.default_rng(11))
    rows = [f"T{i},{x:.6f},{y:.6f},{z:.6f}" for i, (x, y, z) in enumerate(w.marks)]
    (folder / "marks.csv").write_text("\n".join(["mark,x_m,y_m,z_m", *rows]) + "\n")
    return folder, w


def process(log, *arguments):
    from typer.testing import CliRunner

    from spheremark.service.cli.main import app

    folder, _ = log
    answer = CliRunner().invoke(
        app, ["process", str(folder / "foreign.mcap"), "--json", *arguments]
    )
    assert answer.exit_code == 0, answer.output
    return json.loads(answer.stdout)["stops"][0]


def ours(stop):
    return [m for m in stop["markers"] if m["method"] == "along_beam"]


def test_centres_in_the_base_frame_are_where_the_spheres_are(log):
    _, w = log
    stop = process(log, "--frame", "base")
    true = (w.marks - w.station) @ w.R_site_base
    found = np.array([m["centre_m"] for m in ours(stop)])
    assert stop["frame"] == "base"
    assert len(found) == len(true)
    distances = np.linalg.norm(found[:, None] - true, axis=2)
    assert_allclose(distances.min(axis=0), 0, rtol=0, atol=5 * SIGMA / np.sqrt(15))


def test_centres_in_the_station_frame_are_levelled(log):
    _, w = log
    stop = process(log, "--frame", "station")
    levelled = Rotation.from_euler("ZYX", [0, -3, 2], degrees=True).as_matrix()
    true = (w.marks - w.station) @ w.R_site_base @ levelled.T
    found = np.array([m["centre_m"] for m in ours(stop)])
    distances = np.linalg.norm(found[:, None] - true, axis=2)
    assert_allclose(distances.min(axis=0), 0, rtol=0, atol=5 * SIGMA / np.sqrt(15))


def test_the_station_is_where_it_stood(log):
    folder, w = log
    stop = process(log, "--control", str(folder / "marks.csv"))
    station = stop["station"]
    assert station["status"] == "ok"
    error = np.array(station["position_m"]) - w.station
    sigma = np.sqrt(np.diag(station["position_covariance_m2"]))
    assert np.linalg.norm(error) < 0.005
    assert (np.abs(error) < 4 * sigma).all()
    yaw = Rotation.from_euler("z", 40, degrees=True).as_matrix()
    assert_allclose(np.array(station["rotation"]), yaw, rtol=0, atol=0.002)


def test_the_range_runs_from_the_beams_to_the_centre(log):
    _, w = log
    stop = process(log)
    origin = w.station  # the LiDAR circles about it at 6 cm, level with it
    expected = np.sort(np.linalg.norm(w.marks - origin, axis=1))
    assert_allclose(np.sort([m["range_m"] for m in ours(stop)]), expected, rtol=0, atol=0.08)
