"""Results as an MCAP log, read by other libraries."""

from contextlib import closing

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
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
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return {
            channel.topic: (schema.name, message.log_time, decoded)
            for schema, channel, message, decoded in reader.iter_decoded_messages()
        }


def test_each_message_is_of_a_schema_that_viewers_know_at_the_time_of_its_stop(messages):
    assert {topic: name for topic, (name, _, _) in messages.items()} == {
        "/spheremark/tf": "foxglove.FrameTransforms",
        "/spheremark/markers": "foxglove.SceneUpdate",
        "/spheremark/cloud": "foxglove.PointCloud",
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
