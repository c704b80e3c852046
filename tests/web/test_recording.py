"""The page of a recording: findings and timeline."""

import pytest

from spheremark.storage.recordings import Preflight
from spheremark.web.pages.base import Frame
from spheremark.web.pages.recording import findings, recording_page, timeline_of

GOOD = {
    "verdict": "ok", "code": "", "reasons": [], "notes": [], "size_bytes": 7,
    "n_returns": 3_000_000,
    "has_shot_times": True, "has_orientation": True, "rig": "recorded", "duration_s": 10.0,
    "clock_skew_s": 0.0, "n_stops": 1, "gimbal_coverage_deg": 360.0, "gimbal_speed_deg_per_s": 36.0,
    "lidar_speed_rpm": 600.0, "coverage_gap_deg": 0.1, "reading": {}, "diagnosis": [],
    "log_duration_s": 10.0, "gimbal_times_s": [0.0, 5.0, 10.0],
    "gimbal_angles_deg": [0.0, 180.0, 360.0],
    "stop_spans_s": [[1.0, 9.0]],
    "topics": [
        {"topic": "/points", "schema": "sensor_msgs/msg/PointCloud2", "encoding": "cdr",
         "n_messages": 100, "rate_hz": 10.0, "longest_gap_s": 2.0,
         "counts": [1] * 40 + [0] * 20 + [1] * 60, "gaps_s": [[3.3, 5.0]]},
        {"topic": "/tf_static", "schema": "tf2_msgs/msg/TFMessage", "encoding": "cdr",
         "n_messages": 1, "rate_hz": 0.0, "longest_gap_s": 0.0,
         "counts": [1] + [0] * 119, "gaps_s": []},
    ],
}  # fmt: skip
RECORDING = {
    "recording_id": "a" * 64, "name": "<stop>", "size_bytes": 7, "uploaded_at": None,
    "verdict": "ok",
}  # fmt: skip


def page(preflight, **changes):
    return recording_page(Frame(), RECORDING | changes, preflight, [], ["quarry"])


def test_a_good_log_misses_nothing():
    assert {one.state for one in findings(GOOD)} == {"ok"}
    assert "Nothing is missing" in page(GOOD)
    assert "&lt;stop&gt;" in page(GOOD)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("has_shot_times", False, "field time"),
        ("has_orientation", False, "record the IMU"),
        ("rig", "", "/tf_static"),
        ("gimbal_coverage_deg", 120.0, "turn it by 360 deg"),
        ("coverage_gap_deg", 2.0, "beyond 5.7 m"),
        ("coverage_gap_deg", None, "not known"),
    ],
)
def test_what_is_missing_comes_with_its_advice(key, value, words):
    bad = [one for one in findings(GOOD | {key: value}) if one.state != "ok"]
    assert len(bad) == 1
    assert words in bad[0].advice


def test_a_truncated_log_offers_what_is_readable():
    report = Preflight(verdict="refused", code="input.recording.truncated", reasons=("It is cut.",))
    shown = page(report.to_mapping(), verdict="refused")
    assert "Use what is readable" in shown
    assert 'value="true" checked' in shown


def test_the_timeline_has_topics_gaps_angle_and_stops():
    found = timeline_of(GOOD)
    points, static = found.lanes
    assert [round(bar.x) for bar in points.gaps] == [330]
    assert points.gaps[0].title == "1.70 s silent"
    assert (points.bars[0].x, points.bars[0].shade) == (0.0, 1.0)
    assert sum(bar.width for bar in static.bars) < 100.0
    assert [(bar.x, bar.width) for bar in found.stops] == [(100.0, 800.0)]
    assert found.line == "0.0,100.0 500.0,50.0 1000.0,0.0"
    assert found.ticks[-1] == (100.0, "10")
    assert page(GOOD).count("<polyline") == 1


def test_a_log_of_one_instant_has_no_timeline_and_a_page():
    found = GOOD | {"log_duration_s": 0.0}
    assert timeline_of(found) is None
    assert "/points" in page(found)
