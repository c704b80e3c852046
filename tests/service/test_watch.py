"""Decisions on stops, when their recordings are closed: by the command line and on the page."""

import io
import json
import shutil
import subprocess
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.rosbag2 import StoragePlugin

from spheremark.storage.recordings import closed_logs
from tests.service.conftest import PATIENCE
from tests.service.test_commands import COMMAND, run
from tests.storage.recorder import record, small_log
from tests.storage.test_recordings_of_others import rosbag2


class Elsewhere(BaseHTTPRequestHandler):
    """A server of something else, which has a page for every address."""

    def do_GET(self):
        self.send_response(200)
        self.end_headers()
        self.wfile.write(b"<h1>It works!</h1>")

    def do_POST(self):
        self.do_GET()


@pytest.mark.parametrize("plugin", list(StoragePlugin))
def test_a_bag_is_closed_by_its_metadata_and_all_its_parts(tmp_path, plugin):
    folder = tmp_path / "rover"
    folder.mkdir()
    bag = rosbag2(tmp_path / "bag", small_log(np.random.default_rng(2)), plugin)
    (part,) = (one for one in bag.iterdir() if one.name != "metadata.yaml")
    (folder / "bag").mkdir()
    shutil.copy(part, folder / "bag")
    assert closed_logs(folder) == []
    (folder / "bag" / "metadata.yaml").write_bytes(b"\xff\xfe no text")
    assert closed_logs(folder) == []
    shutil.copy(bag / "metadata.yaml", folder / "bag")
    assert closed_logs(folder) == [folder / "bag"]
    copied = folder / "bag" / part.name
    copied.write_bytes(part.read_bytes()[: part.stat().st_size - 20])  # a copy that goes on
    assert closed_logs(folder) == []
    copied.unlink()
    assert closed_logs(folder) == []


def test_an_mcap_file_is_closed_by_its_footer_and_a_ros1_bag_by_its_name(tmp_path):
    path = record(tmp_path / "a.mcap", small_log(np.random.default_rng(2)))
    assert closed_logs(tmp_path) == [path]
    path.write_bytes(path.read_bytes()[:-1])
    (tmp_path / "b.bag.active").write_bytes(b"#ROSBAG V2.0\n")
    (tmp_path / "notes.txt").write_text("no log")
    (tmp_path / "short.mcap").write_bytes(b"\x89MCAP")
    assert closed_logs(tmp_path) == []
    (tmp_path / "b.bag.active").rename(tmp_path / "b.bag")
    assert closed_logs(tmp_path) == [tmp_path / "b.bag"]


def test_each_bag_is_decided_on_when_it_is_closed(stop, tmp_path):
    (tmp_path / "before.bag").write_bytes(b"#ROSBAG V2.0\nnothing")
    control = stop.log.parent / "control.csv"
    command = [*COMMAND, "watch", tmp_path, "--control", control, "--count", "2", "--json"]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True) as watching:
        assert "Watching" in watching.stderr.readline()
        (tmp_path / "cut.mcap").write_bytes(stop.log.read_bytes()[:5000])
        (tmp_path / "bad.bag").write_bytes(b"#ROSBAG V2.0\nnothing")
        first = watching.stdout.readline()
        shutil.copy(stop.log, tmp_path / "stop1.mcap")
        written, complaints = watching.communicate(timeout=PATIENCE)
    assert watching.returncode == 0, complaints
    bad, good = (json.loads(line) for line in (first, written))
    assert (bad["log"], bad["code"].startswith("input.recording")) == ("bad.bag", True)
    (decision,) = good["stops"]
    assert (good["log"], decision["stop"]) == ("stop1.mcap", "stop1")
    assert decision["is_good_enough"]
    assert "of them on marks" in decision["summary"]
    assert good["seconds"] > 0.0


def test_logs_that_were_there_before_are_taken_on_request(stop, tmp_path):
    shutil.copy(stop.log, tmp_path / "stop1.mcap")
    shown = run("watch", tmp_path, "--existing", "--count", "1").stdout
    assert "no control marks, so no position" in shown


def test_a_server_needs_a_survey_and_has_its_control(stop, tmp_path):
    assert "--survey" in run("watch", tmp_path, "--server", "http://127.0.0.1:1", code=2).stderr
    control = stop.log.parent / "control.csv"
    both = ("--server", "http://127.0.0.1:1", "--survey", "a", "--control", control)
    assert "those of the survey" in run("watch", tmp_path, *both, code=2).stderr


def test_a_server_that_is_no_spheremark_is_said_so(stop, tmp_path):
    shutil.copy(stop.log, tmp_path / "stop1.mcap")
    with ThreadingHTTPServer(("127.0.0.1", 0), Elsewhere) as elsewhere:
        threading.Thread(target=elsewhere.serve_forever, daemon=True).start()
        server = f"http://127.0.0.1:{elsewhere.server_port}"
        wanted = ("--server", server, "--survey", "a", "--existing", "--count", "1")
        try:
            shown = run("watch", tmp_path, *wanted).stdout
        finally:
            elsewhere.shutdown()
    assert "no result" in shown
    assert server in shown


def test_the_page_shows_the_decision_on_each_stop(site):
    site.survey("live")
    sent = site.upload(survey="live", process=True).json()
    assert site.ended(sent["job"]["job_id"])["status"] == "successful"
    page = site.client.get("/live").text
    assert f">{sent['name']}</a>" in page
    assert '<span class="chip ok">good enough</span>' in page


def test_the_results_of_a_run_are_downloaded_as_a_log(site):
    site.survey("out")
    sent = site.upload(survey="out", process=True).json()
    job = sent["job"]["job_id"]
    assert site.ended(job)["status"] == "successful"
    (run_of_job,) = site.client.get("/api/v1/runs", params={"job": job}).json()["items"]
    url = f"/api/v1/runs/{run_of_job['run_id']}/result.mcap"
    answer = site.client.get(url)
    assert answer.status_code == 200
    reader = make_reader(io.BytesIO(answer.content))
    topics = {channel.topic for channel in reader.get_summary().channels.values()}
    assert topics == {f"/spheremark/{one}" for one in ("tf", "markers", "cloud", "pose")}
    assert url in site.client.get(f"/surveys/out/stops/{sent['name']}").text
    assert site.client.get("/api/v1/runs/none/result.mcap").status_code == 404
