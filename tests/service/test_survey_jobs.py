"""Jobs over a survey as a whole: its network adjusted and its gimbal calibrated over HTTP."""

import json
from dataclasses import replace
from types import SimpleNamespace
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from fastapi.testclient import TestClient

from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.simulation import SimulationConfig
from spheremark.service.cli.fieldwork import Assignment, survey
from spheremark.service.http.app import create_app
from spheremark.service.jobs.handlers.calibrate import logs_of
from spheremark.service.jobs.specification import JobKind, JobSpecification, Log
from spheremark.service.settings import Settings
from spheremark.storage.recordings import read_log, write_log

STOPS = ("lane2-stop2", "lane4-stop3")


@pytest.fixture(scope="module")
def field(tmp_path_factory):
    """Return two stops on disk: only beams near spheres, which is all that centres need."""
    wanted = Assignment(
        scenario="paper-field",
        stops=",".join(STOPS),
        seed=11,
        config=SimulationConfig(only_near_spheres=True),
        compression="none",
    )
    made = tuple(survey(tmp_path_factory.mktemp("field"), wanted))
    return SimpleNamespace(stops=made, control=(made[0].log.parent / "control.csv").read_text())


@pytest.fixture(scope="module")
def site(tmp_path_factory, field, open_site):
    """Return a service with a survey whose two logs were processed."""
    settings = Settings(data=tmp_path_factory.mktemp("data"), workers=1)
    with TestClient(create_app(settings), base_url="http://127.0.0.1:8000") as client:
        site = open_site(client, field.stops[0], field.control)
        site.survey("field")
        for stop in field.stops:
            truth = {"content": stop.truth.read_bytes(),
                     "headers": {"Content-Type": "application/json"}}  # fmt: skip
            client.put("/api/v1/surveys/field/truth", **truth).raise_for_status()
            job = site.upload(stop.log.read_bytes(), stop.name, survey="field", process="true")
            assert site.ended(job.json()["job"]["job_id"])["status"] == "successful"
        yield site


@pytest.fixture(scope="module")
def run(site):
    """Return what asks for a job and waits for its end."""

    def asked(kind, survey="field", **more):
        answer = site.client.post("/api/v1/jobs", json={"kind": kind, "survey": survey, **more})
        assert answer.status_code == 202, answer.text
        return site.ended(answer.json()["job_id"])

    return asked


@pytest.fixture(scope="module")
def rows(site):
    """Return what asks the service for the rows of a table that a job wrote."""

    def asked(table, job):
        key = "calibration_id" if table.startswith("calibrat") else "adjustment_id"
        whole = "calibrations" if table.startswith("calibrat") else "adjustments"
        key = "job_id" if table == "runs" else key
        whole = "jobs" if table == "runs" else whole
        sql = (
            f"SELECT x.* FROM {table} AS x WHERE {key} IN "  # noqa: S608
            f"(SELECT {key} FROM {whole} WHERE job_id = '{job['job_id']}')"
        )
        answer = site.client.post("/api/v1/sql", json={"sql": sql}).json()
        names = [column["name"] for column in answer["columns"]]
        return [dict(zip(names, row, strict=True)) for row in answer["rows"]]

    return asked


@pytest.fixture(scope="module")
def tied(run):
    """Return the job of the network with control."""
    return run("adjust")


@pytest.fixture(scope="module")
def free(run):
    """Return the job of the free network."""
    return run("adjust", options={"control": False})


@pytest.fixture(scope="module")
def calibrated(site, run):
    """Return the job of the calibration."""
    recording = site.client.get("/api/v1/recordings").json()["items"][0]["recording_id"]
    return run("calibrate", recordings=[recording])


def test_a_network_with_control_is_near_the_truth_and_says_how_near(tied, rows):
    assert tied["status"] == "successful", tied
    found = rows("adjusted_stations", tied)
    assert {row["station"] for row in found} == set(STOPS)
    for row in found:
        assert row["sigma_3d_m"] < 0.003
        assert row["error_3d_m"] < 4.0 * row["sigma_3d_m"]
        assert 0.0 < row["mean_redundancy"] < 3.0


def test_adjusting_takes_the_centres_of_earlier_runs_and_makes_no_new_ones(site, tied, rows):
    assert not rows("runs", tied)
    known = {run["run_id"]: run for run in site.client.get("/api/v1/runs").json()["items"]}
    for row in rows("adjusted_stations", tied):
        assert row["rig_digest"] == known[row["run_id"]]["rig_digest"]


def test_centres_that_were_read_back_adjust_as_those_that_are_fitted_anew(run, rows, tied):
    again = run("adjust", options={"reprocess": True})
    assert again["status"] == "successful", again
    assert len(rows("runs", again)) == len(STOPS)
    first, second = (
        sorted(rows("adjusted_stations", job), key=lambda row: row["station"])
        for job in (tied, again)
    )
    for one, other in zip(first, second, strict=True):
        for axis in ("x_m", "y_m", "z_m", "sigma_3d_m"):
            assert one[axis] == pytest.approx(other[axis], abs=1e-9)


def test_the_errors_of_a_free_network_are_those_after_it_was_laid_on_the_truth(free, rows):
    (whole,) = rows("adjustments", free)
    found = rows("adjusted_marks", free)
    assert whole["datum"] == "free"
    assert not any(row["is_control"] for row in found)
    flat = [np.hypot(row["error_x_m"], row["error_y_m"]) for row in found]
    assert np.sqrt(np.mean(np.square(flat))) < 0.003  # [m] it lies in the frame of the first stop
    normed = [row["error_3d_m"] / row["sigma_3d_m"] for row in found]
    assert 0.3 < np.sqrt(np.mean(np.square(normed))) < 2.0  # levelling tilts all marks together


def test_every_control_mark_is_left_out_in_turn(tied, free, rows):
    found = rows("control_checks", tied)
    assert len(found) > 8
    normed = [row["difference_3d_m"] / row["sigma_3d_m"] for row in found]
    assert 0.5 < np.sqrt(np.mean(np.square(normed))) < 1.7
    assert not rows("control_checks", free)


def test_the_evidence_of_all_stations_is_in_rows_a_file_and_on_the_page(site, tied, rows):
    decisions, evidence = rows("mark_decisions", tied), rows("mark_evidence", tied)
    used = {row["mark"] for row in rows("adjusted_marks", tied)}
    assert {row["mark"] for row in decisions if row["is_used"]} == used
    for one in decisions:
        own = [row for row in evidence if row["mark"] == one["mark"]]
        total = one["log_odds_prior"] + one["log_odds_radius"]
        assert total + sum(row["log_odds"] for row in own) == pytest.approx(one["log_odds"])
        assert one["n_marker"] == sum(row["finding"] == "marker" for row in own)
    assert {row["decision"] for row in decisions if row["is_used"]} == {"confirmed"}
    (whole,) = rows("adjustments", tied)
    url = f"/api/v1/adjustments/{whole['adjustment_id']}"
    written = site.client.get(f"{url}/files/evidence.csv").text.splitlines()
    assert len(written) == 1 + len(evidence)
    assert len(site.client.get(url).json()["mark_evidence"]) == len(evidence)
    page = site.client.get(f"/adjustments/{whole['adjustment_id']}").text
    assert "Evidence of all stations" in page


def test_what_is_not_used_stands_in_the_rows_with_a_reason(tied, rows):
    found = rows("adjusted_observations", tied)
    assert {row["kind"] for row in found} == {"centre", "gravity", "control"}
    for row in found:
        assert row["used"] == (row["reason"] == "")


def test_a_network_can_be_downloaded_in_four_forms(site, tied, rows):
    (whole,) = rows("adjustments", tied)
    url = f"/api/v1/adjustments/{whole['adjustment_id']}/files"
    points = ("coordinates.csv", "coordinates.dxf", "coordinates.xml")
    names = ("adjustment.json", "report.txt", *points, "gama.xml")
    texts = {name: site.client.get(f"{url}/{name}") for name in names}
    assert {answer.status_code for answer in texts.values()} == {200}
    assert len(json.loads(texts["adjustment.json"].text)["stations"]) == len(STOPS)
    assert "NETWORK ADJUSTMENT" in texts["report.txt"].text
    assert texts["coordinates.csv"].headers["content-type"].startswith("text/csv")
    assert ET.fromstring(texts["gama.xml"].text).tag.endswith("gama-local")
    assert site.client.get(f"{url}/other.txt").status_code == 404


def test_an_adjustment_is_one_answer_with_its_stations_and_marks(site, tied):
    items = site.client.get("/api/v1/adjustments", params={"survey": "field"}).json()["items"]
    (listed,) = [one for one in items if one["job_id"] == tied["job_id"]]
    answer = site.client.get(f"/api/v1/adjustments/{listed['adjustment_id']}").json()
    assert answer["sigma0"] == listed["sigma0"]
    assert {one["station"] for one in answer["stations"]} == set(STOPS)
    assert {"marks", "control_checks", "refused", "files"} <= set(answer)


def test_a_calibration_brings_the_faces_together_and_its_rig_is_kept(site, calibrated, rows):
    assert calibrated["status"] == "successful", calibrated
    (whole,) = rows("calibrations", calibrated)
    assert whole["gap_rms_after_m"] < whole["gap_rms_before_m"]
    assert whole["gap_rms_after_m"] == pytest.approx(whole["gap_sigma_after_m"], rel=0.5)
    parameters = rows("calibrated_parameters", calibrated)
    assert all(one["sigma"] > 0 for one in parameters if one["is_estimated"])
    assert [one for one in parameters if not one["is_estimated"] and one["reason"]]
    rig = site.client.get(f"/api/v1/rigs/{whole['rig_digest']}").json()
    file = site.client.get(f"/api/v1/calibrations/{whole['calibration_id']}/files/rig.json").json()
    assert rig["rig"] == file


def test_a_network_can_estimate_the_rig_with_its_stations(site, run, rows):
    job = run("adjust", options={"calibrate": True})
    assert job["status"] == "successful", job
    (network,) = rows("adjustments", job)
    (rig,) = rows("calibrations", job)
    assert rig["calibration_id"] == network["adjustment_id"]
    assert rig["gap_rms_after_m"] < rig["gap_rms_before_m"]
    answer = site.client.get(f"/api/v1/adjustments/{network['adjustment_id']}").json()
    assert {"report.txt", "rig.json"} <= set(answer["files"])
    page = site.client.get(f"/adjustments/{network['adjustment_id']}").text
    link = f'href="/calibrations/{rig["calibration_id"]}">{rig["rig_digest"]}</a>'
    assert f"{rig['start_rig_digest']}, adjusted to <a {link}" in page
    for row in rows("adjusted_stations", job):
        assert row["error_3d_m"] < 4.0 * row["sigma_3d_m"]


def test_later_jobs_use_the_rig_that_was_chosen_and_name_it(site, calibrated, run, rows):
    (whole,) = rows("calibrations", calibrated)
    url = "/api/v1/surveys/field/rig"
    chosen = site.client.put(url, json={"rig_digest": whole["rig_digest"]}).json()
    assert chosen["rig_digest"] == whole["rig_digest"]
    job = run("adjust")
    site.client.put(url, json={"rig_digest": None}).raise_for_status()
    assert job["status"] == "successful", job
    assert job["options"]["rig"] == whole["rig_digest"]
    assert {row["rig_digest"] for row in rows("adjusted_stations", job)} == {whole["rig_digest"]}
    assert run("adjust")["options"].get("rig") is None


def test_a_job_takes_a_rig_as_json_and_processes_with_it(site, run, rows):
    digest = site.client.get("/api/v1/runs").json()["items"][0]["rig_digest"]
    rig = site.client.get(f"/api/v1/rigs/{digest}").json()["rig"] | {"name": "bench"}
    recording = site.client.get("/api/v1/recordings").json()["items"][0]["recording_id"]
    job = run("process", recording=recording, rig=rig)
    (done,) = rows("runs", job)
    assert done["rig_digest"] == job["options"]["rig"] != digest


def test_a_survey_without_logs_cannot_be_adjusted(site):
    site.client.post("/api/v1/surveys", json={"name": "nothing"}).raise_for_status()
    answer = site.client.post("/api/v1/jobs", json={"kind": "adjust", "survey": "nothing"})
    assert answer.status_code == 400
    assert "no log" in answer.json()["detail"]


def test_an_unknown_option_is_refused_with_its_name(site):
    new = {"kind": "adjust", "survey": "field", "options": {"colour": True}}
    answer = site.client.post("/api/v1/jobs", json=new)
    assert (answer.status_code, answer.json()["code"]) == (422, "input.validation")
    assert "options.colour" in answer.json()["detail"]


def test_one_station_makes_no_free_network_and_costs_nothing_else(site, run, tied):
    recording = site.client.get("/api/v1/recordings").json()["items"][0]["recording_id"]
    job = run("adjust", recordings=[recording], options={"control": False})
    assert (job["status"], job["error_code"]) == ("failed", "solve.degenerate"), job
    assert "no network" in job["error_reason"]
    items = site.client.get("/api/v1/adjustments").json()["items"]
    assert tied["job_id"] in {one["job_id"] for one in items}


def test_one_control_mark_gives_no_datum(site, run, field):
    one = "\n".join(field.control.strip().splitlines()[:2])
    kind = {"Content-Type": "text/csv"}
    site.client.put("/api/v1/surveys/one mark/control", content=one, headers=kind)
    items = site.client.get("/api/v1/recordings").json()["items"]
    recordings = [item["recording_id"] for item in items]
    job = run("adjust", survey="one mark", recordings=recordings)
    assert (job["status"], job["error_code"]) == ("failed", "solve.degenerate"), job
    assert "control mark" in job["error_reason"]


def page(site, path):
    answer = site.client.get(path, headers={"accept": "text/html"})
    assert answer.status_code == 200, answer.text[-2000:]
    return answer.text


def test_the_page_of_a_network_has_what_surveyors_look_for(site, tied, rows):
    (whole,) = rows("adjustments", tied)
    text = page(site, f"/adjustments/{whole['adjustment_id']}")
    for name in ("map", "residuals", "tests", "checks"):
        assert f'id="figure-{name}"' in text
    assert "a posteriori" in text
    assert "Control left out in turn" in text
    assert "report.txt" in text
    assert "against truth" in text


def test_the_page_of_a_free_network_leaves_out_no_control(site, free, rows):
    (whole,) = rows("adjustments", free)
    text = page(site, f"/adjustments/{whole['adjustment_id']}")
    assert 'id="figure-checks"' not in text
    assert "after a fit to the truth" in text


def test_where_truth_is_not_known_no_page_of_a_network_speaks_of_errors(site, run, rows):
    kind = {"Content-Type": "text/csv"}
    site.client.put("/api/v1/surveys/dark/control", content=site.control, headers=kind)
    items = site.client.get("/api/v1/recordings").json()["items"]
    job = run("adjust", survey="dark", recordings=[item["recording_id"] for item in items])
    (whole,) = rows("adjustments", job)
    assert {row["error_3d_m"] for row in rows("adjusted_stations", job)} == {None}
    text = page(site, f"/adjustments/{whole['adjustment_id']}").split("<footer")[0]
    assert "truth not known" in text
    assert "RMS error" not in text
    assert "Error <small>" not in text


def test_the_page_of_a_calibration_lets_one_use_its_rig(site, calibrated, rows):
    (whole,) = rows("calibrations", calibrated)
    path = f"/calibrations/{whole['calibration_id']}"
    text = page(site, path)
    assert 'id="figure-gaps"' in text
    assert "Not determined by these scans" in text
    fields = {"rig": whole["rig_digest"], "back": path}
    answer = site.client.post("/surveys/field/rig", data=fields, follow_redirects=False)
    assert (answer.status_code, answer.headers["location"]) == (303, path)
    assert "Use the rig of each log again" in page(site, path)
    site.client.post("/surveys/field/rig", data={"rig": "", "back": "//elsewhere"})
    assert site.client.get("/api/v1/surveys/field").json()["rig_digest"] is None


@pytest.mark.usefixtures("tied", "calibrated")
def test_the_survey_offers_work_on_the_whole_and_lists_what_came_of_it(site):
    text = page(site, "/surveys/field/network")
    assert "Adjust all stations" in text
    assert "the chosen solution of the survey" in text
    assert "Calibrate the gimbal" in page(site, "/surveys/field/rig")
    assert "network with control" in page(site, "/surveys/field")
    answer = site.client.post(
        "/surveys/field/jobs", data={"kind": "adjust", "control": "no"}, follow_redirects=False
    )
    assert answer.status_code == 303
    job = site.ended(answer.headers["location"].removeprefix("/jobs/"))
    assert (job["kind"], job["options"]["control"]) == ("adjust", False)
    assert "/adjustments/" in page(site, answer.headers["location"])


def test_a_form_that_asks_for_nothing_known_is_refused(site):
    answer = site.client.post("/surveys/field/jobs", data={"kind": "process"})
    assert (answer.status_code, answer.json()["code"]) == (400, "input")
    assert site.client.post("/surveys/field/jobs", json={"kind": "adjust"}).status_code == 400


@pytest.fixture(scope="module")
def cut(field, tmp_path_factory):
    """Return a log whose gimbal turned by less than half a turn, and one that shows no sphere."""
    folder, log = tmp_path_factory.mktemp("cut"), read_log(field.stops[0].log)
    stamps = log.stamps_lidar_ns
    part = stamps < stamps[0] + 0.4 * (stamps[-1] - stamps[0])
    rows = {"part": np.flatnonzero(part), "bare": np.arange(0, len(stamps), 600)}
    columns = ("p_lidar", "intensities", "rings", "stamps_lidar_ns")
    for name, keep in rows.items():
        few = {column: getattr(log, column)[keep].copy() for column in columns}
        write_log(replace(log, **few), folder / f"{name}.mcap")
    return {name: (folder / f"{name}.mcap").read_bytes() for name in rows}


def test_less_than_half_a_turn_cannot_calibrate(site, run, cut):
    part = site.upload(cut["part"], "part").json()["recording_id"]
    job = run("calibrate", recordings=[part])
    assert (job["status"], job["error_code"]) == ("failed", "solve.degenerate"), job
    assert "both faces" in job["error_reason"]


def test_a_log_that_shows_no_sphere_costs_a_network_no_other(site, run, rows, cut):
    bare = site.upload(cut["bare"], "bare").json()["recording_id"]
    items = site.client.get("/api/v1/recordings").json()["items"]
    good = [item["recording_id"] for item in items if item["name"] in STOPS]
    job = run("adjust", recordings=[bare, *good])
    assert job["status"] == "successful", job
    assert {row["station"] for row in rows("adjusted_stations", job)} == set(STOPS)
    (refused,) = rows("refused_stations", job)
    assert (refused["station"], refused["code"]) == ("bare", "solve.no_markers")
    assert "Without bare" in job["message"]


def test_logs_that_all_show_no_sphere_fail_with_the_reason_of_the_first(site, run, cut):
    bare = site.upload(cut["bare"], "bare").json()["recording_id"]
    for kind in ("adjust", "calibrate"):
        job = run(kind, recordings=[bare])
        assert job["status"] == "failed"
        assert job["error_code"].startswith("solve.")
        assert job["error_reason"]


def test_logs_that_were_uploaded_for_a_survey_belong_to_it_before_any_job_read_them(
    site, field, run, rows
):
    site.survey("later")
    for stop in field.stops:
        answer = site.upload(stop.log.read_bytes(), "again", survey="later")
        assert answer.json()["job"] is None
    assert site.client.get("/api/v1/surveys/later").json()["n_recordings"] == 2
    text = site.client.get("/surveys/later", headers={"Accept": "text/html"}).text
    assert "2 logs belong to this survey" in text
    text = site.client.get("/surveys/later/network", headers={"Accept": "text/html"}).text
    assert "Adjust all stations</button>" in text
    job = run("adjust", survey="later")
    assert job["status"] == "successful", job
    assert {row["station"] for row in rows("adjusted_stations", job)} == set(STOPS)


def test_logs_of_one_name_are_told_apart_alike_by_networks_and_calibrations(field):
    logs = tuple(
        Log(recording_id=str(i) * 64, name=name, url=str(field.stops[i % 2].log))
        for i, name in enumerate(("a", "a (2)", "a", "b", "a"))
    )
    order = JobSpecification(
        job_id="j", kind=JobKind.ADJUST, result_id="r", survey_id="s", logs=logs,
        config=SurveyConfig(), marks=None, rig=None, clouds_url="",
    )  # fmt: skip
    assert order.log_names == ("a", "a (2)", "a (3)", "b", "a (4)")
    assert [log.origin.name for log in logs_of(order)] == list(order.log_names)


def test_a_job_names_the_jobs_whose_results_it_reads_and_waits_for_them(site):
    site.survey("in turn")
    processed = site.upload(survey="in turn", process=True).json()["job"]["job_id"]
    adjust = site.client.post("/api/v1/jobs", json={"kind": "adjust", "survey": "in turn"}).json()
    made = site.client.post("/api/v1/jobs", json={"kind": "site", "survey": "in turn"}).json()
    calibrate = {"kind": "calibrate", "survey": "in turn"}
    assert site.client.post("/api/v1/jobs", json=calibrate).json()["waits_for"] == []
    assert adjust["waits_for"] == [processed]
    assert made["waits_for"] == [processed, adjust["job_id"]]
    assert made["message"] == "Waiting for 2 jobs of the survey."
    ended = [site.ended(one) for one in (processed, adjust["job_id"], made["job_id"])]
    assert [one["waits_for"] for one in ended] == [[], [], []]
    begins = [one["started_at"] for one in ended]
    ends = [one["finished_at"] for one in ended]
    assert ends[0] <= begins[1]
    assert ends[1] <= begins[2]
    report = site.client.get("/api/v1/surveys/in turn/report.html").text
    assert "Network adjustment report" in report
    assert "Observed centres" in report
    assert STOPS[0] in report  # the same bytes have the name that they first had
    decision = site.client.get("/api/v1/surveys/in turn/result").json()
    assert decision["solution"] == "network with control"
    assert decision["sentence"].rpartition(": ")[0] in report


def test_a_job_that_waits_for_another_can_be_dismissed(site):
    site.survey("left waiting")
    processed = site.upload(survey="left waiting", process=True).json()["job"]["job_id"]
    adjust = {"kind": "adjust", "survey": "left waiting"}
    job = site.client.post("/api/v1/jobs", json=adjust).json()["job_id"]
    assert site.client.delete(f"/api/v1/jobs/{job}").json()["status"] == "dismissed"
    assert site.ended(processed)["status"] == "successful"
    assert site.client.get(f"/api/v1/jobs/{job}").json()["status"] == "dismissed"
