"""The command line: what it writes for people and programs, and how it ends."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from contextlib import ExitStack, redirect_stderr, redirect_stdout
from io import StringIO
from types import SimpleNamespace

import httpx
import numpy as np
import pytest
from rich.console import Console

from spheremark.pipelines.geometry import levelling_rotation
from spheremark.pipelines.model import Levelling
from spheremark.service.cli.demo import summary_table
from spheremark.service.cli.main import main
from spheremark.service.processes import SimulationFailedError, simulated
from spheremark.service.serialise.models import LogDocument

COMMAND = (sys.executable, "-m", "spheremark.service.cli")
# on a busy machine Dask's worker may report that it lost the scheduler before it was stopped
DASK_RECORD = re.compile(
    rb"^\d{4}-[^\n]* - distributed\.[^\n]*\n(?:(?!\d{4}-)[^\n]*\n)*", re.MULTILINE
)


def run(*arguments, code=0, **environment):
    """Run a command as its process would, and return what it wrote."""
    out, err = StringIO(), StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        patch.setattr(sys, "argv", ["spheremark", *map(str, arguments)])
        for name, value in environment.items():
            patch.setenv(name, value)
        with pytest.raises(SystemExit) as ended:
            main()
    assert (ended.value.code or 0) == code, err.getvalue()
    return SimpleNamespace(stdout=out.getvalue(), stderr=err.getvalue())


@pytest.fixture(scope="module")
def answer(stop):
    """Return what `process --json` says of the simulated stop, by both methods."""
    done = run(
        *("process", stop.log, "--control", stop.log.parent / "control.csv", "--truth", stop.truth),
        *("--method", "along_beam", "--method", "paper", "--json"),
    )
    return json.loads(done.stdout)


def test_help_is_instant_because_it_imports_nothing_heavy():
    command = [sys.executable, "-X", "importtime", *COMMAND[1:], "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    imported = {line.rsplit("|", 1)[1].strip() for line in done.stderr.splitlines()}
    assert "typer" in imported
    heavy = {"numpy", "numba", "scipy", "open3d", "duckdb", "fastapi", "pydantic", "distributed"}
    assert not heavy & imported
    assert "simulate" in done.stdout


def test_the_json_of_a_log_has_the_declared_keys_and_no_others(answer):
    assert LogDocument.model_validate(answer).model_dump(exclude_unset=True) == answer
    (stop,) = answer["stops"]
    assert (stop["name"], stop["frame"]) == ("lane1-stop1", "station")
    methods = [marker["method"] for marker in stop["markers"]]
    assert methods == sorted(methods)  # all of the first method, then all of the second
    assert min(methods.count("along_beam"), methods.count("paper")) > 8
    assert stop["markers"][0]["id"] == "M01"
    assert stop["station"]["fit_method"] == "along_beam"
    assert {one["fit_method"] for one in stop["stations"]} == {"along_beam", "paper"}


def test_the_station_maps_centres_onto_marks(answer, control):
    (stop,) = answer["stops"]
    rows = [line.split(",") for line in control.strip().splitlines()[1:]]
    marks = {name: [float(value) for value in rest[:3]] for name, *rest in rows}
    station = stop["station"]
    R, t = np.array(station["rotation"]), np.array(station["position_m"])
    centres = {m["id"]: m["centre_m"] for m in stop["markers"] if m["method"] == "along_beam"}
    assert len(station["matches"]) > 8
    for match in station["matches"]:
        computed = R @ centres[match["marker"]] + t
        # observed minus computed, and the fix adds gravity: a tenth of a millimetre between them
        off = np.linalg.norm(computed - marks[match["mark"]])
        assert off == pytest.approx(np.linalg.norm(match["residual_m"]), abs=3e-3)
    assert np.shape(station["covariance"]) == (6, 6)
    trace = np.trace(station["position_covariance_m2"])
    assert station["sigma_3d_m"] == pytest.approx(trace**0.5)
    assert station["error_3d_m"] < 0.005  # [m]


def test_frames_differ_by_the_levelling_alone(answer, stop):
    base = json.loads(run("process", stop.log, "--frame", "base", "--json").stdout)["stops"][0]
    levelled = answer["stops"][0]
    lean = levelled["levelling"]
    R = levelling_rotation(
        Levelling(
            roll=np.radians(lean["roll_deg"]),
            pitch=np.radians(lean["pitch_deg"]),
            sigma=0.0,
            is_measured=True,
        )
    )
    p_base = np.array([m["centre_m"] for m in base["markers"]])
    p_station = np.array([m["centre_m"] for m in levelled["markers"]][: len(p_base)])
    np.testing.assert_allclose(p_base @ R.T, p_station, rtol=0, atol=1e-9)


def test_without_control_the_station_is_null_with_a_reason(stop):
    (found,) = json.loads(run("process", stop.log, "--json").stdout)["stops"]
    assert found["station"] is None
    assert "control" in found["reason"]
    assert {marker["method"] for marker in found["markers"]} == {"along_beam"}


def test_truth_adds_errors_and_changes_nothing_else(answer, stop):
    control = stop.log.parent / "control.csv"
    plain = json.loads(run("process", stop.log, "--control", control, "--json").stdout)
    ours = plain["stops"][0]["markers"]
    for without, with_truth in zip(ours, answer["stops"][0]["markers"], strict=False):
        assert {k: with_truth[k] for k in without} == without
        assert "error_3d_m" in set(with_truth) - set(without)


def test_a_better_clock_makes_a_heading_surer_and_moves_no_station(stop):
    control = stop.log.parent / "control.csv"
    options = ("process", stop.log, "--control", control, "--json")
    known, unknown = (
        json.loads(run(*options, "--sigma-clock-s", value).stdout)["stops"][0]["station"]
        for value in ("0", "0.03")
    )
    assert known["sigma_yaw_deg"] < 0.05 < 0.5 < unknown["sigma_yaw_deg"]
    for name in ("position_m", "sigma_3d_m", "yaw_deg"):
        assert known[name] == unknown[name]


def test_people_get_a_table_and_programs_get_json(stop):
    assert "M08" in run("process", stop.log).stdout
    assert json.loads(run("inspect", stop.log, "--json").stdout)["verdict"] in ("ok", "weak")
    table = run("inspect", stop.log).stdout
    assert "/velodyne_points" in table
    assert "duration [s]" in table


def test_a_failure_is_one_sentence_and_exit_code_1(tmp_path):
    garbage = tmp_path / "garbage.mcap"
    garbage.write_bytes(b"no log at all")
    failed = run("process", garbage, code=1)
    assert "Traceback" not in failed.stderr
    assert "not an MCAP file" in failed.stderr
    problem = json.loads(run("process", garbage, "--json", code=1).stdout)
    assert problem["code"] == "input.recording.not_mcap"
    assert json.loads(run("inspect", garbage, "--json", code=1).stdout)["verdict"] == "refused"


@pytest.mark.parametrize(
    "arguments",
    [("process",), ("process", "nowhere.mcap"), ("serve", "--port", "port"), ("fly",)],
)
def test_misuse_is_exit_code_2(arguments):
    run(*arguments, code=2)


def test_a_wrong_setting_is_misuse_and_named():
    assert "SPHEREMARK_WORKERS" in run("serve", code=2, SPHEREMARK_WORKERS="none").stderr
    refused = run("serve", "--host", "0.0.0.0", code=2).stderr
    assert refused.startswith("Error: host is 0.0.0.0")
    assert "`spheremark token create NAME`" in refused
    assert "SPHEREMARK_TOKEN" in refused


def test_an_unknown_method_is_refused_by_name(stop):
    assert "along_beam" in run("process", stop.log, "--method", "magic", code=2).stderr


def test_commensurate_speeds_are_warned_about(tmp_path):
    arguments = ("simulate", tmp_path, "--stops", "99", "--turn-s", "18", "--rpm", "600")
    assert "ommensurate" in run(*arguments, code=2).stderr


def test_a_service_is_asked_exported_and_stopped_by_a_signal(tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    address = f"http://127.0.0.1:{port}"
    settings = {"SPHEREMARK_PORT": str(port), "SPHEREMARK_DATA": str(tmp_path / "data")}
    environment = {**os.environ, **settings, "SPHEREMARK_WORKERS": "1"}
    with (
        subprocess.Popen([*COMMAND, "serve"], env=environment, stderr=subprocess.PIPE) as process,
        ExitStack() as stack,
    ):
        stack.callback(process.kill)  # where something fails, its end would be awaited for ever
        said = [process.stderr.readline()]
        while said[-1] and address.encode() not in said[-1]:  # on a busy machine, Dask comes first
            said.append(process.stderr.readline())
        assert address.encode() in said.pop()
        asked = run("query", "SELECT 1 AS one_m", "--json", **settings)
        assert json.loads(asked.stdout)["rows"] == [[1]]
        run("export", tmp_path / "copy.duckdb", "--url", address)
        assert run("doctor", **settings).stdout == ""
        run("backup", tmp_path / "backup", **settings)
        assert run("doctor", "--mend", code=1, **settings).stdout == ""
        half_an_upload(port)
        in_use = run("query", "SELECT 1", "--data", tmp_path / "data", code=1)
        assert "in use" in in_use.stderr
        with httpx.stream("GET", f"{address}/api/v1/jobs/events"):
            process.send_signal(signal.SIGTERM)
            assert process.wait(120) == 0  # an open stream that kept it running would last for ever
        assert DASK_RECORD.sub(b"", b"".join([*said, process.stderr.read()])) == b""
    assert (tmp_path / "copy.duckdb").stat().st_size > 0
    assert not [one for one in (tmp_path / "data/recordings/.partial").rglob("*") if one.is_file()]
    files = [one for one in (tmp_path / "data").rglob("*") if one.is_file()]
    assert not [one for one in files if one.stat().st_mode & 0o077]
    run("restore", tmp_path / "backup", "--data", tmp_path / "again")
    assert "Nothing is wrong" in run("doctor", "--data", tmp_path / "again").stderr
    sql = "SELECT count(*) AS n, ['a'] AS names FROM recordings"
    offline = run("query", sql, "--csv", **settings)
    assert offline.stdout.split() == ["n,names", '0,"[""a""]"']  # lists as in the service's CSV


def half_an_upload(port):
    """Begin an upload over a real connection, and go away."""
    head = (
        "POST /api/v1/recordings?name=half HTTP/1.1\r\nHost: 127.0.0.1\r\n"
        "Content-Type: application/vnd.mcap\r\nContent-Length: 20000000\r\n\r\n"
    )
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.sendall(head.encode() + b"x" * 5_000_000)


def test_of_several_logs_the_one_that_cannot_be_read_is_named(stop, tmp_path):
    (tmp_path / "broken.mcap").write_bytes(b"no log")
    done = run("calibrate", stop.log, tmp_path / "broken.mcap", code=1)
    assert "Error: broken.mcap: " in done.stderr


def test_a_calibrated_rig_is_one_that_processing_takes(stop, tmp_path):
    rig = tmp_path / "rig.json"
    answer = json.loads(run("calibrate", stop.log, "--json", "--out", rig).stdout)
    assert {"rig", "parameters", "covariance", "not_separable", "stops"} <= set(answer)
    n = len(answer["parameters"])
    sigmas = [parameter["sigma"] for parameter in answer["parameters"]]
    np.testing.assert_allclose(np.sqrt(np.diag(answer["covariance"])), sigmas)
    assert n == 6 + 16
    assert answer["residual_rms_after_m"] < answer["residual_rms_before_m"]
    assert all(held["reason"] for held in answer["not_separable"])
    (tmp_path / "answer.json").write_text(json.dumps(answer))
    for given in (rig, tmp_path / "answer.json"):
        processed = json.loads(run("process", stop.log, "--rig", given, "--json").stdout)
        assert processed["rig"]["digest"] == answer["rig_digest"]
    assert "spin_zero" in run("calibrate", stop.log).stdout


def test_what_is_wrong_with_a_file_is_said_word_by_word(stop, tmp_path):
    control = tmp_path / "marks.csv"
    control.write_text("mark,x,y,z,[/m]\nA,1,2,3,4\n")
    assert "'[/m]'" in run("process", stop.log, "--control", control, code=1).stderr


def test_a_service_that_does_not_answer_is_named():
    asked = run("query", "SELECT 1", "--url", "http://127.0.0.1:9", code=1)
    assert "No service answers at http://127.0.0.1:9" in asked.stderr


def test_a_compression_that_nobody_knows_is_refused_before_anything_is_written(tmp_path):
    out = tmp_path / "logs"
    run("simulate", out, "--compression", "gz", code=2)
    assert not out.exists()


def test_errors_of_the_demonstration_are_shown_with_their_unit():
    out = Console(file=StringIO(), width=80)
    out.print(summary_table([["stations", "along_beam", 7, 0.0003, 0.0004, 0.0005]]))
    shown = out.file.getvalue()
    assert "Errors against truth [mm]" in shown
    assert re.search(r"stations.*along_beam.*7.*0\.3.*0\.4.*0\.5", shown)


def test_a_simulation_ends_with_the_service_and_is_an_error_when_it_fails(tmp_path):
    leaving = threading.Event()
    with pytest.raises(SimulationFailedError, match="its message is above"):
        list(simulated(tmp_path, ["nowhere"], leaving))
    leaving.set()
    assert list(simulated(tmp_path, ["lane3-stop2"], leaving)) == []
