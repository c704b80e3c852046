"""The scheduler of the jobs, a process that was there before the service, is lost."""

import gc
import socket
import subprocess
import sys
import time
from contextlib import suppress

import psutil
import pytest
from distributed.client import default_client
from fastapi.testclient import TestClient

from spheremark.service.http.app import create_app
from spheremark.service.settings import Settings

PATIENCE = 240.0  # [s] ends a test that would hang; one that passes never waits for it


def wait_until(condition):
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.1)


@pytest.fixture
def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def open_client():
    """The client of the service, if it has one."""
    with suppress(ValueError):
        return default_client()


def end(process):
    """Kill a scheduler and its workers."""
    if process.poll() is None:
        for one in (*psutil.Process(process.pid).children(recursive=True), process):
            one.kill()
    process.wait(60)


def scheduler_at(port):
    """A scheduler in a process of its own, with one worker."""
    code = (
        "import asyncio, sys\n"
        "from distributed import Nanny, Scheduler\n"
        "async def main():\n"
        "    async with Scheduler(host='127.0.0.1', port=int(sys.argv[1])) as one:\n"
        "        async with Nanny(one.address, nthreads=1):\n"
        "            await one.finished()\n"
        "if __name__ == '__main__':\n"
        "    asyncio.run(main())\n"
    )
    return subprocess.Popen([sys.executable, "-c", code, str(port)])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # of Dask's client
def test_a_job_survives_the_loss_of_its_scheduler(tmp_path, stop, control, open_site, free_port):
    lost = scheduler_at(free_port)
    settings = Settings(data=tmp_path, scheduler=f"tcp://127.0.0.1:{free_port}")
    another = None
    try:
        with TestClient(create_app(settings), base_url="http://127.0.0.1") as client:
            site = open_site(client, stop, control)
            site.survey("lost")
            wait_until(lambda: client.get("/readyz").status_code == 200)
            job = site.upload(survey="lost", process="true").json()["job"]["job_id"]
            site.begun(job)
            end(lost)
            wait_until(lambda: client.get("/healthz").json()["status"] == "degraded")
            another = scheduler_at(free_port)
            assert site.ended(job)["status"] == "successful"
            fixes = client.get("/api/v1/station-fixes", params={"survey": "lost"}).json()["items"]
            assert len({one["run_id"] for one in fixes}) == 1
            wait_until(lambda: client.get("/readyz").status_code == 200)
    finally:
        for one in (lost, another):
            if one is not None:
                end(one)
        gc.collect()  # what Dask's client did not await, while this test ignores it


@pytest.mark.slow
def test_a_connection_that_was_closed_is_made_again(tmp_path, scheduler):
    settings = Settings(data=tmp_path, scheduler=scheduler)
    with TestClient(create_app(settings), base_url="http://127.0.0.1") as client:
        wait_until(lambda: client.get("/readyz").status_code == 200)
        closed = default_client()
        client.portal.call(closed.close)
        wait_until(lambda: open_client() not in (None, closed))
        wait_until(lambda: client.get("/readyz").status_code == 200)
