"""One simulated stop, and a running service on a folder of its own, for the tests of this room."""

import time
from contextlib import suppress

import psutil
import pytest
from fastapi.testclient import TestClient

from spheremark.pipelines.simulation import SimulationConfig
from spheremark.service.cli.fieldwork import Assignment, survey
from spheremark.service.http.app import create_app
from spheremark.service.settings import Settings

PATIENCE = 300.0  # [s] ends a test that would hang; one that passes never waits for it
MCAP = {"Content-Type": "application/vnd.mcap"}


def is_worker(process):
    """Whether a process is a worker that lives: of a service, or of a scheduler besides."""
    with suppress(psutil.Error):
        is_forked = runs(process, "forkserver") and runs(process.parent(), "forkserver")
        return is_forked or runs(process, "spawn_main")
    return False


def runs(process, what):
    """Whether a process lives and its command names something."""
    try:
        return what in " ".join(process.cmdline())
    except psutil.Error:  # it ended since it was listed
        return False


class Site:
    """A service that runs, and the steps that many tests begin with."""

    def __init__(self, client, stop, control):
        self.client, self.stop, self.control = client, stop, control

    def survey(self, name):
        """Make a survey with control and truth."""
        kind = {"Content-Type": "text/csv"}
        url = f"/api/v1/surveys/{name}"
        self.client.put(f"{url}/control", content=self.control, headers=kind).raise_for_status()
        kind = {"Content-Type": "application/json"}
        truth = self.stop.truth.read_bytes()
        self.client.put(f"{url}/truth", content=truth, headers=kind).raise_for_status()

    def upload(self, body=None, name="lane1-stop1", **query):
        """Send a log."""
        return self.client.post(
            "/api/v1/recordings",
            params={"name": name, **query},
            content=self.stop.log.read_bytes() if body is None else body,
            headers=MCAP,
        )

    def workers(self):
        """Wait for all worker processes of the service, without the one that tests share."""
        wanted = self.client.app.state.service.settings.workers
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            own = [one for one in psutil.Process().children() if not runs(one, "tests.scheduler")]
            found = [one for part in own for one in part.children() if is_worker(one)]
            n_ready = self.client.get("/healthz").json()["cluster"]["workers"]
            if min(len(found), n_ready) >= wanted:
                return found
            time.sleep(0.05)
        raise TimeoutError(f"fewer than {wanted} workers are ready after {PATIENCE} s")

    def begun(self, job_id):
        """Wait for the beginning of a job, which on a busy machine may be seen after its end."""
        deadline = time.monotonic() + PATIENCE
        while self.client.get(f"/api/v1/jobs/{job_id}").json()["status"] == "accepted":
            if time.monotonic() > deadline:
                raise TimeoutError(f"job {job_id} did not begin within {PATIENCE} s")
            time.sleep(0.005)

    def ended(self, job_id):
        """Wait for the end of a job."""
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            job = self.client.get(f"/api/v1/jobs/{job_id}").json()
            if job["status"] not in ("accepted", "running"):
                return job
            time.sleep(0.2)  # each look takes some of the processor that the job needs
        raise TimeoutError(f"job {job_id} did not end within {PATIENCE} s")


@pytest.fixture(scope="session")
def stop(tmp_path_factory):
    """Return a simulated stop on disk: only beams near spheres, which is all that centres need."""
    wanted = Assignment(
        scenario="paper-field",
        stops="lane1-stop1",
        seed=3,
        config=SimulationConfig(only_near_spheres=True),
        compression="none",
    )
    (made,) = survey(tmp_path_factory.mktemp("simulated"), wanted)
    return made


@pytest.fixture(scope="session")
def control(stop):
    """Return the control marks of the simulated field as CSV."""
    return (stop.log.parent / "control.csv").read_text()


@pytest.fixture(scope="module")
def site(tmp_path_factory, stop, control, scheduler):
    """Return a service that computes on the worker that tests share."""
    settings = Settings(data=tmp_path_factory.mktemp("data"), scheduler=scheduler)
    with TestClient(create_app(settings), base_url="http://127.0.0.1:8000") as client:
        yield Site(client, stop, control)


@pytest.fixture(scope="session")
def open_site():
    """Return what wraps a client of a test's own service."""
    return Site
