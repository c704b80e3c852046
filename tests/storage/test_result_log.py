"""Results as an MCAP log, read by other libraries."""

from contextlib import closing

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from mcap_ros2.decoder import DecoderFactory as RosDecoderFactory
from scipy.spatial.transform import Rotation

from spheremark.pipelines.geometry import levelling_rotation
from spheremark.storage.exports.result_log import ELLIPSOID_SCALE, ResultLog
from tests.storage.made_up import stop


@pytest.fixture(scope="module")
def messages(tmp_path_factory):
    path = tmp_path_factory.mktemp("results") / "results.mcap"
    with closing(ResultLog(path)) as log:
        log.add(stop())
    with path.open("rb") as file:
        factories = [DecoderFactory(), RosDecoderFactory()]
        reader = make_reader(file, decoder_factories=factories)
        return {
            channel.topic: (schema.name, message.log_time, decoded)
            for schema, channel, message, decoded in reader.iter_decoded_messages()
        }


def test_each_message_is_of_a_schema_that_viewers_know_at_the_time_of_its_stop(messages):
    assert {topic: name for topic, (name, _, _) in messages.items()} == {
        "/spheremark/tf": "foxglove.FrameTransforms",
        "/spheremark/markers": "foxglove.SceneUpdate",
        "/spheremark/cloud": "foxglove.PointCloud",
        "/spheremark/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    }
    assert {time for _, time, _ in messages.values()} == {stop().cloud.start_ns}


def test_the_transforms_lead_from_the_site_to_the_base(messages):
    station, base = messages["/spheremark/tf"][2].transforms
    assert (station.parent_frame_id, station.child_frame_id) == ("site", "station")
    assert (base.parent_frame_id, base.child_frame_id) == ("station", "base_link")
    T = stop().fixes["along_beam", "free_station"].T_site_station
    t, q = station.translation, station.rotation
    np.testing.assert_allclose([t.x, t.y, t.z], T[:3, 3])
    turned = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    np.testing.assert_allclose(turned, T[:3, :3], atol=1e-12)


def test_spheres_stand_at_their_centres_with_their_ellipsoids(messages):
    entities = {one.id: one for one in messages["/spheremark/markers"][2].entities}
    R = levelling_rotation(stop().cloud.levelling)
    for fit in stop().fits["along_beam"].fits:
        sphere = entities[f"marker {fit.name}"].spheres[0]
        p = sphere.pose.position
        np.testing.assert_allclose([p.x, p.y, p.z], R @ fit.p_base)
        assert sphere.size.x == pytest.approx(2 * fit.radius)
        assert entities[f"marker {fit.name}"].texts[0].text == fit.name
        if not np.isfinite(fit.cov_p_base).all():
            continue
        (name,) = [one for one in entities if one.startswith(f"{fit.name}: ")]
        ellipsoid = entities[name].spheres[0]
        q = ellipsoid.pose.orientation
        axes = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
        half = np.array([ellipsoid.size.x, ellipsoid.size.y, ellipsoid.size.z]) / 2
        cov = axes @ np.diag((half / ELLIPSOID_SCALE) ** 2 / 7.815) @ axes.T
        np.testing.assert_allclose(cov, R @ fit.cov_p_base @ R.T, rtol=1e-3, atol=1e-12)


def test_the_cloud_has_the_returns_in_the_frame_of_the_station(messages):
    cloud = messages["/spheremark/cloud"][2]
    assert cloud.frame_id == "station"
    rows = np.frombuffer(cloud.data, "<f4").reshape(-1, cloud.point_stride // 4)
    expected = stop().cloud.p_base @ levelling_rotation(stop().cloud.levelling).T
    assert len(rows) == len(expected)
    np.testing.assert_allclose(rows[:, :3], expected, atol=1e-5)


def test_the_pose_of_ros_has_its_covariance_about_the_station_in_axes_of_the_site(messages):
    """By numbers drawn: small motions about the origin, as positions and rotations about itself."""
    fix = stop().fixes["along_beam", "free_station"]
    message = messages["/spheremark/pose"][2]
    assert message.header.frame_id == "site"
    p, q = message.pose.pose.position, message.pose.pose.orientation
    np.testing.assert_allclose([p.x, p.y, p.z], fix.p_site)
    turned = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    np.testing.assert_allclose(turned, fix.T_site_station[:3, :3], atol=1e-12)
    rng = np.random.default_rng(2)
    motions = rng.multivariate_normal(np.zeros(6), fix.cov_T_site_station, 200_000)
    moved = motions[:, 3:] + np.cross(motions[:, :3], fix.p_site)
    drawn = np.cov(np.hstack([moved, motions[:, :3]]).T)
    cov = np.array(message.pose.covariance).reshape(6, 6)
    scale = np.sqrt(np.outer(np.diag(cov), np.diag(cov)))
    np.testing.assert_allclose(drawn / scale, cov / scale, rtol=0, atol=0.02)


def test_other_libraries_find_no_fault_in_the_file(tmp_path):
    """Summary, statistics, checksums and index agree with what the messages are."""
    path = tmp_path / "results.mcap"
    with closing(ResultLog(path)) as log:
        log.add(stop())
        log.add(stop("L1S2", seed=4))
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        n = sum(1 for _ in reader.iter_messages())
    assert summary.statistics.message_count == n == 8
    assert summary.statistics.channel_count == len(summary.channels) == 4
    assert {one.encoding for one in summary.schemas.values()} == {"protobuf", "ros2msg"}
