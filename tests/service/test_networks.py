"""The command `adjust`: a survey of simulated logs, from the outside."""

import csv
import json
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from types import SimpleNamespace
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from pipelines.simulation import SimulationConfig
from service.cli import main
from service.fieldwork import Assignment, survey
from storage.site_files import read_control, read_truth

STOPS = ("lane2-stop2", "lane3-stop5", "lane4-stop3")


def run(*arguments, code=0):
    """Run a command as its process would, and return what it wrote."""
    out, err = StringIO(), StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        patch.setattr("sys.argv", ["spheremark", "adjust", *map(str, arguments)])
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
    rows = [*tied["observations"], *tied["gravity"], *tied["control"], tied["range_bias"]]
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
