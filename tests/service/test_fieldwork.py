"""Simulated surveys as files."""

import json

from spheremark.pipelines.simulation import SimulationConfig
from spheremark.service.cli.fieldwork import Assignment, survey
from spheremark.storage.imports.survey_files import read_truth
from spheremark.storage.recordings import inspect_log, read_log

QUICK = SimulationConfig(turn=0.5, only_near_spheres=True)


def assigned(scenario, stops="", **changes):
    return Assignment(
        scenario=scenario, stops=stops, seed=2, config=QUICK, compression="none", **changes
    )


def test_packets_and_points_of_one_stop_are_the_same_returns(tmp_path):
    logs = {}
    for packets in (False, True):
        folder = tmp_path / str(packets)
        (made,) = survey(folder, assigned("range-lane", packets=packets))
        logs[packets] = read_log(made.log)
    assert len(logs[True].p_lidar) == len(logs[False].p_lidar)
    assert abs(logs[True].p_lidar - logs[False].p_lidar).max() < 1e-4
    topics = [topic.topic for topic in inspect_log(made.log).topics]
    assert "/velodyne_packets" in topics
    assert "/velodyne_points" not in topics


def test_worlds_without_lanes_are_simulated_whole_when_no_stop_is_named(tmp_path):
    (made,) = survey(tmp_path, assigned("range-lane"))
    assert made.name == "centre"
    truth = read_truth(made.truth)
    assert len(truth.marks.names) == 88
    assert set(truth.about["visible_shares"]["centre"]) == set(truth.marks.names)
    assert json.loads(made.truth.read_text())["about"]["scenario"] == "range-lane"
