"""The command `adjust`: a survey of simulated logs, from the outside."""

import csv
import json
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from types import SimpleNamespace
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.scan.rigs import rig_from_mapping, rig_to_mapping
from spheremark.pipelines.simulation import SimulationConfig
from spheremark.service.cli.fieldwork import Assignment, survey
from spheremark.service.cli.main import main
from spheremark.service.log_files import Fieldbook, adjust_scans, read_scans, with_calibration
from spheremark.service.serialise.models import NetworkDocument
from spheremark.service.serialise.network import serialise_network
from spheremark.storage.imports.survey_files import read_control, read_truth
from spheremark.storage.recordings import LogFile

CONFIG = SurveyConfig.from_mapping({"fitting": {"methods": ["along_beam"]}})
STOPS = ("lane2-stop2", "lane3-stop5", "lane4-stop3")


def run(*arguments, code=0, command="adjust"):
    """Run a command as its process would, and return what it wrote."""
    out, err = StringIO(), StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        patch.setattr("sys.argv", ["spheremark", command, *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
    assert (ended.value.code or 0) == code, err.getvalue()
    return SimpleNamespace(stdout=out.getvalue(), stderr=err.getvalue())


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Return the logs of three stops, with control.csv and truths beside them."""
    wanted = Assignment(
        scenario="paper-field",
        stops=",".join(STOPS),
        seed=11,
        config=SimulationConfig(only_near_spheres=True),
        compression="none",
    )
    return [made.log for made in survey(tmp_path_factory.mktemp("survey"), wanted)]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Return the folder into which the free network is written."""
    return tmp_path_factory.mktemp("network")


@pytest.fixture(scope="module")
def free(logs, files):
    """Return the JSON of the free network."""
    written = ("--gama", files / "n.xml", "--csv", files / "n.csv", "--report", files / "n.txt")
    return json.loads(run(*logs, *written, "--json").stdout)


@pytest.fixture(scope="module")
def tied(logs):
    """Return the JSON of the network with control."""
    return json.loads(run(*logs, "--control", logs[0].parent / "control.csv", "--json").stdout)


def true_places(logs):
    truths = [read_truth(log.with_name(f"{log.stem}.truth.json")) for log in logs]
    places = {stop.name: stop.T_site_base[:3, 3] for truth in truths for stop in truth.stops}
    return places, truths[0].marks


def test_the_json_of_networks_has_the_declared_keys_and_no_others(free, tied):
    for network in (free, tied):
        declared = NetworkDocument.model_validate(network)
        assert declared.model_dump(exclude_unset=True) == network


def test_the_answer_has_the_keys_that_others_rely_on(free):
    assert {"marks", "stations", "observations", "excluded", "refused", "dof", "sigma0"} <= set(
        free
    )
    assert {"name", "position_m", "covariance_m2"} <= set(free["marks"][0])
    assert {
        "name", "position_m", "rotation", "covariance", "position_covariance_m2",
    } <= set(free["stations"][0])  # fmt: skip
    assert {
        "residual_m", "redundancy", "w", "minimal_detectable_bias_m",
        "external_reliability_station_m", "external_reliability_mark_m",
    } <= set(free["observations"][0])  # fmt: skip
    assert [station["name"] for station in free["stations"]] == list(STOPS)
    assert np.shape(free["stations"][0]["covariance"]) == (6, 6)
    assert free["datum"]["kind"] == "free"


def test_with_control_stations_are_where_they_truly_are(tied, logs):
    places, _ = true_places(logs)
    control = read_control(logs[0].parent / "control.csv")
    assert {mark["name"] for mark in tied["marks"] if mark["is_control"]} == set(control.names)
    for station in tied["stations"]:
        off = np.array(station["position_m"]) - places[station["name"]]
        assert off @ np.linalg.solve(station["position_covariance_m2"], off) < 21.1  # 0.9999
        assert np.linalg.norm(off) < 0.01


def test_without_control_the_shape_is_true(free, logs):
    places, marks = true_places(logs)
    p = np.array([station["position_m"] for station in free["stations"]])
    true = np.array([places[station["name"]] for station in free["stations"]])
    spans, expected = (np.linalg.norm(x - np.roll(x, 1, axis=0), axis=1) for x in (p, true))
    np.testing.assert_allclose(spans, expected, rtol=0, atol=0.01)
    assert len(free["marks"]) == len(marks.names)


def test_redundancies_add_up_to_the_degrees_of_freedom(tied):
    kinds = ("observations", "gravity", "control", "shared_unknowns", "station_heights")
    rows = [row for kind in kinds for row in tied[kind]]
    assert [row["station"] for row in tied["station_heights"]] == list(STOPS)
    assert sum(row["redundancy"] or 0.0 for row in rows) == pytest.approx(tied["dof"], abs=1e-3)


def test_files_say_the_same_as_the_answer(free, files):
    rows = {row["name"]: row for row in csv.DictReader(StringIO((files / "n.csv").read_text()))}
    for one in (*free["stations"], *free["marks"]):
        written = [float(rows[one["name"]][f"{axis}_m"]) for axis in "xyz"]
        np.testing.assert_allclose(written, one["position_m"], rtol=0, atol=1e-5)
    points = (
        ET.parse(files / "n.xml")
        .getroot()
        .iter("{http://www.gnu.org/software/gama/gama-local}point")
    )
    assert {point.get("id") for point in points} == set(rows)
    report = (files / "n.txt").read_text()
    assert f"Degrees of freedom              {free['dof']:8d}" in report
    for one in (*free["stations"], *free["marks"]):
        x, y, z = one["position_m"]
        assert f"{x:12.4f} {y:12.4f} {z:12.4f}" in report


def test_a_log_that_cannot_be_read_costs_no_other(logs, tmp_path):
    bad = tmp_path / "broken.mcap"
    bad.write_bytes(b"no log at all")
    answer = json.loads(run(bad, *logs[:2], "--json").stdout)
    (refused,) = answer["refused"]
    assert (refused["station"], refused["code"]) == ("broken", "input.recording.not_mcap")
    assert [station["name"] for station in answer["stations"]] == list(STOPS[:2])


def test_control_of_another_field_is_a_refusal_with_a_reason(logs, tmp_path):
    other = tmp_path / "other.csv"
    other.write_text("mark,x_m,y_m,z_m\nA,0,0,0\nB,31.7,2,1\nC,15,44.2,3\n")
    done = run(*logs[:2], "--control", other, "--json", code=1)
    assert json.loads(done.stdout)["code"] == "solve.degenerate"
    assert "There is no network" in done.stderr


def test_people_get_tables(logs):
    text = run(*logs[:2]).stdout
    assert "Network: ok" in text
    assert "lane2-stop2" in text
    assert "M14" in text


def test_each_control_mark_is_predicted_by_all_else(tied, logs):
    given = dict(zip(*control_of(logs), strict=True))
    for row in tied["control"]:
        off = np.array(row["predicted_minus_given_m"])
        sigma = np.array(row["sigma_predicted_minus_given_m"])
        assert row["mark"] in given
        assert np.all(np.abs(off) < 5 * sigma)
        assert 0 < np.linalg.norm(off) < 0.03
        assert np.all(sigma > 1e-4)


def control_of(logs):
    control = read_control(logs[0].parent / "control.csv")
    return control.names, control.p_site


def test_control_in_feet_at_the_feet_of_poles_gives_the_same_stations(tied, logs, tmp_path):
    names, p = control_of(logs)
    foot, height = 0.3048, 1.25
    rows = [
        f"{name},{n / foot!r},{e / foot!r},{(u - height) / foot!r},ball"
        for name, (e, n, u) in zip(names, p.tolist(), strict=True)
    ]
    path = tmp_path / "book.csv"
    path.write_text("\n".join(rows))
    options = ("--control-axes", "neu", "--control-unit", "ft", "--target-height-m", height)
    answer = json.loads(run(*logs, "--control", path, *options, "--json").stdout)
    for one, other in zip(answer["stations"], tied["stations"], strict=True):
        np.testing.assert_allclose(one["position_m"], other["position_m"], rtol=0, atol=1e-6)


def test_a_stop_that_was_scanned_twice_is_compared_with_itself(logs, tmp_path):
    again = tmp_path / "again.mcap"
    again.write_bytes(logs[0].read_bytes())
    answer = json.loads(run(logs[0], again, logs[1], "--json").stdout)
    (repeat,) = answer["repeated_stops"]
    assert set(repeat["stations"]) == {STOPS[0], "again"}
    assert repeat["apart_3d_m"] < 1e-6
    assert repeat["difference_rms_m"] < 1e-6 < 1e-3 < repeat["predicted_rms_m"]


def test_the_joint_covariance_of_marks_has_theirs_on_its_diagonal(free):
    joint = np.array(free["marks_covariance_m2"])
    for i, mark in enumerate(free["marks"]):
        block = joint[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
        np.testing.assert_allclose(block, mark["covariance_m2"], rtol=1e-9)
    assert all(mark["status"] == "ok" for mark in free["marks"])


def test_a_rig_is_adjusted_with_the_network_and_serves_as_a_rig(logs, tmp_path):
    answer = json.loads(run(*logs[:2], "--calibrate", "--json").stdout)
    assert NetworkDocument.model_validate(answer).calibration is not None
    rig = answer["calibration"]
    names = [row["name"] for row in rig["parameters"]]
    assert names[:2] == ["axis_offset_x", "axis_offset_y"]
    assert np.shape(rig["covariance"]) == (len(names), len(names))
    assert "common_range_bias" in [row["name"] for row in answer["shared_unknowns"]]
    kinds = ("observations", "gravity", "shared_unknowns", "station_heights")
    rows = [row for kind in kinds for row in answer[kind]]
    assert sum(row["redundancy"] or 0.0 for row in rows) == pytest.approx(answer["dof"], abs=1e-3)
    truth = read_truth(logs[0].with_name(f"{logs[0].stem}.truth.json")).rig
    place = names.index("axis_offset_x")
    off = rig["parameters"][place]["estimate"] - truth.T_head_lidar[0, 3]
    assert abs(off) < 4 * rig["parameters"][place]["sigma"] < 4e-3
    path = tmp_path / "rig.json"
    path.write_text(json.dumps(rig))
    again = json.loads(run(*logs[:2], "--rig", path, "--json").stdout)
    assert again["passes_global_test"]


def test_a_rig_that_the_logs_do_not_determine_stays_and_the_network_stands(logs):
    upright = rig_to_mapping(read_truth(logs[0].with_name(f"{logs[0].stem}.truth.json")).rig)
    upright["T_head_lidar"] = np.eye(4).tolist()
    book = Fieldbook(scans=scans_of(logs[:2]), refused=())
    calibrated = with_calibration(
        book, log_files(logs[:2]), CONFIG, rig_from_mapping(upright), lambda _share, _what: None
    )
    answer = serialise_network(
        adjust_scans(calibrated, None, CONFIG), CONFIG, uncalibrated=calibrated.uncalibrated
    )
    assert answer["calibration"] is None
    assert any("two faces" in warning for warning in answer["warnings"])
    assert len(answer["stations"]) == 2


def log_files(logs):
    return [LogFile(path=path) for path in logs]


def scans_of(logs):
    book = read_scans(log_files(logs), CONFIG, None, lambda _share, _what: None)
    assert not book.refused
    return book.scans


def test_truth_adds_errors_and_changes_nothing_else(free, logs):
    truths = [item for log in logs for item in ("--truth", log.with_name(f"{log.stem}.truth.json"))]
    answer = json.loads(run(*logs, *truths, "--json").stdout)
    errors = answer.pop("errors")
    assert answer == free
    assert 0 < errors["rms_marks_m"] < 0.01
    assert 0 < errors["rms_stations_m"] < 0.01
    assert {row["true_mark"] for row in errors["marks"]} == set(control_of(logs)[0])
    assert errors["n_false_marks"] == 0


def test_a_scan_tells_on_site_which_control_mark_is_given_wrongly(logs, tmp_path):
    names, p = control_of(logs)
    rows = [[name, *place] for name, place in zip(names, p.tolist(), strict=True)]
    rows[3][1] += 0.09
    path = tmp_path / "wrong.csv"
    path.write_text("\n".join(",".join(map(str, row)) for row in rows))
    done = run(logs[0], "--control", path, "--json", command="process")
    stop = json.loads(done.stdout)["stops"][0]
    distances = stop["distances"]
    assert distances["suspects"][:1] == [names[3]]
    assert all(names[3] in pair["marks"] for pair in distances["pairs"] if pair["is_off"])
    assert distances["n_off"] == sum(pair["is_off"] for pair in distances["pairs"]) > 5
    station = stop["station"]
    left = {row["mark"]: row for row in station["without_each"]}
    assert names[3] not in left
    assert all(0 < row["station_shift_3d_m"] < 0.005 for row in left.values())
