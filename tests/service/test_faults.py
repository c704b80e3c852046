"""Faults of the machine: disk, database, clock and memory. Each has a clear state and an end."""

import asyncio
import os
import re
import subprocess
import sys
import time

import pytest
from fastapi.testclient import TestClient

from spheremark.service.http.app import create_app
from spheremark.service.settings import Settings
from spheremark.storage.files import StorageError
from tests.hoard import take_memory

PATIENCE = 120.0  # [s] ends a test that would hang; one that passes never waits for it
UNAVAILABLE = (503, 507)


def opened(folder, **more):
    return TestClient(
        create_app(Settings(data=folder, min_free_bytes=0, **more)),
        base_url="http://127.0.0.1",
        raise_server_exceptions=False,
    )


def mount(*arguments):
    return subprocess.run(["mount", *arguments], capture_output=True, check=False).returncode == 0


@pytest.fixture
def folder(tmp_path):
    """A folder that can be made read-only under a service; skipped where this user may not."""
    place = tmp_path / "recordings"
    place.mkdir()
    if not mount("--bind", place, place):
        pytest.skip("NOT TESTED: a read-only disk; nothing can be mounted")
    yield tmp_path
    subprocess.run(["umount", "-l", place], check=True)


def test_a_read_only_disk_is_named_and_needs_no_restart(
    folder, stop, control, open_site, scheduler
):
    with opened(folder, scheduler=scheduler) as client:
        site = open_site(client, stop, control)
        site.survey("before")
        assert mount("-o", "remount,bind,ro", folder / "recordings")
        refused = site.upload()
        assert refused.status_code in UNAVAILABLE, refused.text
        assert refused.json()["code"] == "storage"
        tus = {"Tus-Resumable": "1.0.0", "Upload-Length": "9"}
        assert client.post("/api/v1/uploads", headers=tus).status_code in UNAVAILABLE
        assert client.get("/healthz").status_code == 200
        assert client.get("/readyz").json()["disk"] != "ok"
        assert client.post("/api/v1/sql", json={"sql": "SELECT 1"}).status_code in (200, 503)
        assert client.get("/api/v1/surveys").json()["items"][0]["name"] == "before"
        assert mount("-o", "remount,bind,rw", folder / "recordings")
        job = site.upload(survey="before", process="true").json()["job"]["job_id"]
        assert site.ended(job)["status"] == "successful"
        assert client.get("/readyz").status_code == 200


def test_a_corrupt_page_of_the_database_is_named_by_doctor_and_service(tmp_path, scheduler):
    with opened(tmp_path, scheduler=scheduler) as client:
        for number in range(30):
            client.post("/api/v1/surveys", json={"name": f"s{number:03d}"}).raise_for_status()
    database = tmp_path / "spheremark.duckdb"
    content = bytearray(database.read_bytes())
    places = [one.start() for one in re.finditer(b"s02[0-9]", content)]
    assert places
    for at in places:
        content[at] ^= 0xFF
    database.write_bytes(content)
    found = subprocess.run(
        [sys.executable, "-m", "spheremark.service.cli", "doctor"],
        env={**os.environ, "SPHEREMARK_DATA": str(tmp_path)},
        capture_output=True, text=True, timeout=PATIENCE, check=False,
    )  # fmt: skip
    assert found.returncode == 1
    assert "restore the newest backup" in " ".join((found.stdout + found.stderr).split())
    assert "Traceback" not in found.stderr
    try:
        with opened(tmp_path, scheduler=scheduler) as client:
            answer = client.get("/api/v1/surveys", params={"limit": 1000})
            said = answer.json()["detail"] if answer.status_code == 503 else ""
    except StorageError as error:  # where the page is read at the start
        said = str(error)
    assert "damaged on its disk" in said


@pytest.mark.parametrize("jump", [-400 * 86400, 400 * 86400], ids=["backwards", "forwards"])
def test_a_jump_of_the_clock_loses_nothing(
    tmp_path, stop, control, open_site, scheduler, monkeypatch, jump
):
    now = time.time
    with opened(tmp_path, scheduler=scheduler) as client:
        site = open_site(client, stop, control)
        site.survey("clock")
        first = site.upload(survey="clock", process="true").json()["job"]["job_id"]
        site.begun(first)
        monkeypatch.setattr(time, "time", lambda: now() + jump)
        monkeypatch.setattr(time, "time_ns", lambda: int((now() + jump) * 1e9))
        assert site.ended(first)["status"] == "successful"
        new = client.post("/api/v1/jobs", json={"kind": "process", "survey": "clock",
                          "recording": client.get("/api/v1/recordings").json()["items"][0]
                          ["recording_id"]})  # fmt: skip
        job = new.json()["job_id"]
        assert site.ended(job)["status"] == "successful"
        events = client.get(f"/api/v1/jobs/{job}/events").text
        numbers = [int(line[4:]) for line in events.splitlines() if line.startswith("id: ")]
        assert numbers == sorted(set(numbers))
        assert client.get("/readyz").status_code == 200


def test_a_worker_out_of_memory_fails_its_job_and_the_next_is_served(
    tmp_path, stop, control, open_site
):
    limit = 1 << 30
    with opened(tmp_path, workers=1, job_memory_bytes=limit, job_attempts=1) as client:
        site = open_site(client, stop, control)
        site.survey("memory")
        jobs = client.app.state.service.jobs
        made = site.upload(survey="memory", process="true").json()
        site.begun(made["job"]["job_id"])

        async def hoard():
            await jobs._client.run(take_memory, limit, on_error="ignore")

        asyncio.run_coroutine_threadsafe(hoard(), jobs._loop)
        ended = site.ended(made["job"]["job_id"])
        assert (ended["status"], ended["error_code"]) == ("failed", "worker_died"), ended
        assert "memory ran out" in ended["error_reason"]
        new = {"kind": "process", "survey": "memory", "recording": made["recording_id"]}
        job = client.post("/api/v1/jobs", json=new).json()["job_id"]
        assert site.ended(job)["status"] == "successful"
