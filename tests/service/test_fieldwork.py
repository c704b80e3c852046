"""Simulated surveys as files."""

import json
from dataclasses import replace

from typer.testing import CliRunner

from spheremark.pipelines.scan.rigs import rig_digest
from spheremark.pipelines.simulation import SimulationConfig, draw_config
from spheremark.service.cli.fieldwork import Assignment, survey
from spheremark.service.cli.main import app
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


def test_a_random_world_is_its_first_stop_with_a_truth_that_no_log_holds(tmp_path):
    done = CliRunner().invoke(
        app, ["simulate", str(tmp_path), "--world", "random", "--seed", "6", "--turn-s", "1"]
    )
    assert done.exit_code == 0, done.stderr
    truth = read_truth(tmp_path / "stop1.truth.json")
    assert truth.about["family"] == "rig"
    assert truth.about["simulation"]["turn"] == 1.0  # given, all else drawn
    assert truth.about["simulation"]["optics"]["gate"] != SimulationConfig().optics.gate
    assert set(truth.about["returns"]["stop1"]) == set(truth.marks.names)
    log = read_log(tmp_path / "stop1.mcap")
    assert rig_digest(log.rig) != rig_digest(truth.rig)
    assert not list(tmp_path.glob("stop2*"))


def test_other_stops_of_a_random_world_are_simulated_when_named(tmp_path):
    config = replace(draw_config(2), turn=0.5, only_near_spheres=True)
    assignment = replace(assigned("random", "2-3"), config=config)
    assert [made.name for made in survey(tmp_path, assignment)] == ["stop2", "stop3"]
