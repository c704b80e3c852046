"""Logs that are no MCAP, or that need a word about their joint, by command and over HTTP."""

import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.rosbag2 import StoragePlugin, Writer

from spheremark.service.client import Client
from spheremark.storage.recordings import read_log, write_log
from tests.service.test_commands import run
from tests.storage.recorder import STORE, record


@pytest.fixture(scope="module")
def bag(stop, tmp_path_factory):
    """Return the simulated stop as a folder of rosbag2, written by rosbags."""
    folder = tmp_path_factory.mktemp("bags") / "field"
    with (
        stop.log.open("rb") as file,
        Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as written,
    ):
        known = {}
        for schema, channel, message in make_reader(file).iter_messages():
            if channel.topic not in known:
                known[channel.topic] = written.add_connection(
                    channel.topic, schema.name, typestore=STORE
                )
            written.write(known[channel.topic], message.log_time, message.data)
    return folder


@pytest.fixture(scope="module")
def zipped(bag):
    path = bag.with_suffix(".zip")
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for one in bag.iterdir():
            archive.write(one, f"field/{one.name}")
    return path


@pytest.fixture(scope="module")
def clockwise(stop, tmp_path_factory):
    """Return the simulated stop with its angles in degrees, clockwise, on a joint among others."""
    log = read_log(stop.log)
    path = tmp_path_factory.mktemp("logs") / "clockwise.mcap"
    write_log(replace(log, gimbal_angles=-np.degrees(log.gimbal_angles)), path)
    return path


def centres(answer):
    return np.array([one["centre_m"] for one in answer["stops"][0]["markers"]])


def test_a_folder_and_its_zip_give_the_centres_of_the_mcap(stop, bag, zipped):
    expected = centres(json.loads(run("process", stop.log, "--json").stdout))
    for log in (bag, zipped):
        answer = json.loads(run("process", log, "--json").stdout)
        np.testing.assert_array_equal(centres(answer), expected)
        assert answer["stops"][0]["name"] == "field"
    assert "/velodyne_points" in run("inspect", bag).stdout


def test_joint_unit_and_sign_mend_a_log_on_the_command_line(stop, clockwise):
    refused = json.loads(run("inspect", clockwise, "--json", code=1).stdout)
    assert "--joint-unit" in refused["reasons"][0]
    options = ("--joint", "gimbal_joint", "--joint-unit", "deg", "--joint-sign", "-1")
    answer = json.loads(run("process", clockwise, *options, "--json").stdout)
    expected = centres(json.loads(run("process", stop.log, "--json").stdout))
    np.testing.assert_allclose(centres(answer), expected, rtol=0, atol=1e-6)


def test_options_that_cannot_be_are_a_misuse(stop):
    assert "joint_unit" in run("inspect", stop.log, "--joint-unit", "gon", code=2).stderr


def test_a_zip_is_uploaded_and_processed(site, zipped):
    site.survey("bags")
    answer = site.upload(zipped.read_bytes(), name="field.zip", survey="bags", process=True)
    assert answer.status_code == 201, answer.text
    assert answer.json()["name"] == "field"
    assert site.ended(answer.json()["job"]["job_id"])["status"] == "successful"


def test_an_upload_says_how_it_is_read_and_jobs_may_say_otherwise(site, clockwise):
    site.survey("clockwise")
    body = clockwise.read_bytes()
    refused = site.upload(body, name="clockwise", survey="clockwise")
    assert refused.status_code == 422
    assert "The gimbal of clockwise would turn" in refused.json()["detail"]
    digest = refused.json()["recording_id"]
    job = {"survey": "clockwise", "recording": digest}
    options = {"joint_unit": "deg", "joint_sign": -1}
    done = site.client.post("/api/v1/jobs", json={**job, "options": options})
    assert site.ended(done.json()["job_id"])["status"] == "successful"
    mended = site.upload(body, name="clockwise", survey="clockwise", process=True, **options)
    assert (mended.status_code, mended.json()["preflight"]["reading"]) == (200, options)
    assert site.ended(mended.json()["job"]["job_id"])["status"] == "successful"
    wrong = site.client.post("/api/v1/jobs", json={**job, "options": {"joint_unit": "gon"}})
    assert (wrong.status_code, "joint_unit" in wrong.text) == (422, True)


def test_a_damaged_upload_is_used_when_that_is_accepted(site):
    site.survey("damaged")
    octets = site.stop.log.read_bytes()
    cut = octets[: int(0.97 * len(octets))]
    refused = site.upload(cut, name="cut", survey="damaged")
    assert (refused.status_code, "recover" in refused.json()["detail"]) == (422, True)
    answer = site.upload(cut, name="cut", survey="damaged", process=True, recover=True)
    assert answer.json()["verdict"] == "weak"
    job = site.ended(answer.json()["job"]["job_id"])
    assert job["status"] == "successful"
    assert "weak" in job["message"]


def test_diagnosis_names_the_option_that_mends_a_log(stop, tmp_path):
    log = read_log(stop.log)
    start = log.stamps_gimbal_ns[0]
    slow = replace(  # 5 deg/s in degrees are 286 deg/s in radians, which a gimbal could do
        log,
        gimbal_angles=-np.degrees(log.gimbal_angles),
        stamps_gimbal_ns=start + 6 * (log.stamps_gimbal_ns - start),
        stamps_lidar_ns=start + 6 * (log.stamps_lidar_ns - start),
    )
    write_log(slow, tmp_path / "slow.mcap", revolution=0.6)
    found = json.loads(run("inspect", tmp_path / "slow.mcap", "--diagnose", "--json").stdout)
    assert "--joint-unit deg --joint-sign -1" in found["diagnosis"][0]
    failed = run("process", tmp_path / "slow.mcap", "--radius-m", "0.5", code=1)
    assert "--joint-unit deg --joint-sign -1" in failed.stderr
    good = json.loads(run("inspect", stop.log, "--diagnose", "--json").stdout)
    assert "no other sign" in good["diagnosis"][0]


def test_diagnosis_names_the_steps_of_an_encoder_and_the_unit_of_times(stop, tmp_path):
    angles, times = tmp_path / "angles.mcap", tmp_path / "times.mcap"
    log, items = read_log(stop.log), []
    write_log(replace(log, gimbal_angles=log.gimbal_angles * 4096 / (2 * np.pi)), angles)
    found = json.loads(run("inspect", angles, "--diagnose", "--json", code=1).stdout)
    assert "With --joint-unit 4096 (joint_unit=4096 in a request)" in found["diagnosis"][0]
    with stop.log.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            one = STORE.deserialize_cdr(message.data, schema.name)
            if schema.name.endswith("PointCloud2"):
                at = next(field.offset for field in one.fields if field.name == "time")
                rows = one.data.copy().reshape(-1, one.point_step)
                micros = np.ascontiguousarray(rows[:, at : at + 4]).view("<f4") * np.float32(1e6)
                rows[:, at : at + 4] = micros.view(np.uint8)
                one.data = rows.ravel()
            items.append((channel.topic, message.log_time, one))
    record(times, items)
    mended = read_log(times)
    np.testing.assert_allclose(mended.stamps_lidar_ns, log.stamps_lidar_ns, rtol=0, atol=100)
    read_so = ("--time-unit", "ns", "--diagnose", "--json")  # as it was for a driver of whole ones
    found = json.loads(run("inspect", times, *read_so).stdout)
    assert "--time-unit us" in found["diagnosis"][0]


def test_the_files_of_a_folder_are_uploaded_in_one_form_as_one_log(site, bag):
    site.survey("folders")
    query = {"name": "field", "survey": "folders", "process": True}
    parts = [("file", (f"field/{one.name}", one.read_bytes())) for one in sorted(bag.iterdir())]
    answer = site.client.post("/api/v1/recordings", params=query, files=parts)
    assert answer.status_code == 201, answer.text
    assert {one["topic"] for one in answer.json()["preflight"]["topics"]} >= {"/velodyne_points"}
    job = site.ended(answer.json()["job"]["job_id"])
    assert (job["status"], "good enough" in job["message"]) == ("successful", True)
    again = Client(http=site.client).upload(bag, survey="folders", process=False)
    assert again["recording_id"] == answer.json()["recording_id"]


PART = b'--x\r\nContent-Disposition: form-data; name="a"; filename="%s"\r\n\r\nA'


@pytest.mark.parametrize(
    ("body", "kind", "words"),
    [
        (b"", "multipart/form-data; boundary=x", "empty"),
        (b"--x\r\n\r\n", "multipart/form-data", "boundary"),
        (b"--x--\r\n", "multipart/form-data; boundary=x", "no files"),
        (b"--x--\r\n", "Multipart/Form-Data; boundary=x", "no files"),
        (PART % b"a", None, "cut"),
        (PART % b"1/a.bag" + b"\r\n" + PART % b"2/a.bag", None, "two files called 'a.bag'"),
        (b"no boundary here", None, "well-formed"),
    ],
)
def test_a_form_that_is_cut_or_has_no_files_is_refused_and_leaves_nothing(site, body, kind, words):
    kind = kind or "multipart/form-data; boundary=x"
    answer = site.client.post(
        "/api/v1/recordings?name=a", content=body, headers={"Content-Type": kind}
    )
    assert (answer.status_code, words in answer.json()["detail"]) == (400, True), answer.text
    partial = site.client.app.state.service.inbox.partial
    assert [one for one in partial.iterdir() if one.is_file()] == []
