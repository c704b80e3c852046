"""The demonstration: the service as it is, and a rover that surveys one lane beside it.

Stops are simulated by a process of its own and uploaded over HTTP as soon as each is ready.
"""

from __future__ import annotations

import json
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime
from pathlib import Path
from typing import Any, ClassVar

import httpx
from rich.console import Console
from rich.table import Table

from spheremark.pipelines.errors import SpheremarkError
from spheremark.service.serving import serve
from spheremark.service.settings import Settings

SURVEY = "paper-field"
LANE = "lane3"
_N_STOPS = 7
_CHUNK = 1 << 20  # [bytes] of a log that are sent at once
_POLL = 0.2  # [s] between two looks at a job
_SUMMARY = """
SELECT 'sphere centres' AS what, fit_method, count(*) AS n, sqrt(avg(error_3d_m ^ 2)) AS rms_m,
    max(error_3d_m) AS max_m, sqrt(avg(sigma_3d_m ^ 2)) AS sigma_m
FROM latest_marker_fits WHERE survey = 'paper-field' AND error_3d_m IS NOT NULL GROUP BY ALL
UNION ALL
SELECT 'stations', fit_method, count(*), sqrt(avg(error_3d_m ^ 2)), max(error_3d_m),
    sqrt(avg(sigma_3d_m ^ 2))
FROM latest_station_fixes WHERE survey = 'paper-field' AND error_3d_m IS NOT NULL GROUP BY ALL
ORDER BY ALL
"""


class SimulationFailedError(SpheremarkError):
    """The process that simulates the survey ended before it was done."""

    code: ClassVar[str] = "simulation_failed"


class AnsweredError(SpheremarkError):
    """The service answered a request of our own with a problem."""

    code: ClassVar[str] = "answered"


def run(settings: Settings, console: Console) -> None:
    """Serve, and have one lane surveyed where there is nothing to serve yet."""
    surveyor: list[threading.Thread] = []
    leaving = threading.Event()

    def ready(address: str) -> None:
        console.print(f"Serving on [bold]{address}[/]  (data in {settings.data.resolve()})")
        rover = Rover(settings, address, console, leaving)
        surveyor.append(threading.Thread(target=rover.drive, name="rover"))
        surveyor[0].start()

    try:
        serve(settings, ready=ready)
    finally:
        leaving.set()
        for thread in surveyor:
            thread.join()
    console.print("Stopped.")


class Rover:
    """A client of the service that simulates stops and uploads them."""

    def __init__(
        self, settings: Settings, address: str, console: Console, leaving: threading.Event
    ) -> None:
        token = settings.token.get_secret_value() if settings.token else ""
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        self._http = httpx.Client(base_url=f"{address}/api/v1", headers=headers, timeout=60.0)
        self._folder = settings.data.resolve() / "simulated"
        self._address = address
        self._console = console
        self._leaving = leaving
        self._begin = time.monotonic()

    def drive(self) -> None:
        """Survey the lane, or only say what is there; the service lives on whatever happens."""
        try:
            stops = self._missing()
            if stops:
                self._survey(stops)
            self._summarise()
        except (httpx.HTTPError, SpheremarkError, OSError) as error:
            if not self._leaving.is_set():
                self._console.print(f"[red]The demonstration ended early: {error}[/]")
        finally:
            self._http.close()

    def _missing(self) -> list[str]:
        """Return the stops of the lane to be surveyed: none where others have data."""
        lane = [f"{LANE}-stop{place}" for place in range(1, _N_STOPS + 1)]
        known = {one["name"] for one in self._get("/recordings", limit=1000)["items"]}
        is_ours = not self._get("/surveys")["items"] or self._folder.exists()
        return [stop for stop in lane if stop not in known] if is_ours else []

    def _survey(self, stops: list[str]) -> None:
        """Simulate and upload stop after stop, and say how each job ended."""
        self._console.print(
            f"Simulating {len(stops)} stops of the study's field; each one is uploaded as soon "
            "as it is ready."
        )
        jobs: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        with ThreadPoolExecutor(1) as pool:
            uploads = pool.submit(self._bring, stops, jobs)
            while (job := jobs.get()) is not None:
                self._await(job)
            uploads.result()
        if not self._leaving.is_set():
            self._await(self._adjust())

    def _adjust(self) -> str:
        """Ask for all stations and marks to be adjusted together; return the id of the job."""
        asked = {"kind": "adjust", "survey": SURVEY}
        job: str = _checked(self._http.post("/jobs", json=asked))["job_id"]
        return job

    def _bring(self, stops: list[str], jobs: queue.SimpleQueue[str | None]) -> None:
        """Simulate and upload stop after stop; pass on the job of each, and none at the end."""
        try:
            for made in self._simulated(stops):
                self._put(f"/surveys/{SURVEY}/control", self._folder / "control.csv", "text/csv")
                self._put(f"/surveys/{SURVEY}/truth", Path(made["truth"]), "application/json")
                jobs.put(self._upload(made))
        finally:
            jobs.put(None)

    def _simulated(self, stops: list[str]) -> Iterator[dict[str, str]]:
        """Yield each stop as soon as a process of its own has written it."""
        command = [
            sys.executable,
            "-m",
            "spheremark.service.cli",
            "simulate",
            str(self._folder),
            "--json",
        ]
        with subprocess.Popen(
            [*command, "--stops", ",".join(stops)],
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,  # Ctrl-C is for the service, which then ends this
        ) as process:
            threading.Thread(target=self._stop_with_us, args=(process,), daemon=True).start()
            for line in process.stdout or ():
                yield json.loads(line)
        if process.returncode and not self._leaving.is_set():
            raise SimulationFailedError("The simulation failed; what it says is above.")

    def _stop_with_us(self, process: subprocess.Popen[str]) -> None:
        """End a simulation that nobody waits for any more."""
        while process.poll() is None:
            if self._leaving.wait(_POLL):
                process.terminate()

    def _upload(self, made: dict[str, str]) -> str:
        """Stream a log to the service; return the id of its job."""
        with Path(made["log"]).open("rb") as body:
            answer = self._http.post(
                "/recordings",
                params={"name": made["stop"], "survey": SURVEY, "process": "true"},
                headers={"Content-Type": "application/vnd.mcap"},
                content=iter(lambda: body.read(_CHUNK), b""),
            )
        job: str = _checked(answer)["job"]["job_id"]
        return job

    def _await(self, job_id: str) -> None:
        """Wait for the end of a job and say what it gave, or why it gave nothing."""
        job = self._get(f"/jobs/{job_id}")
        while job["status"] in ("accepted", "running") and not self._leaving.wait(_POLL):
            job = self._get(f"/jobs/{job_id}")
        if job["finished_at"] is None:
            return
        asked, ended = (datetime.fromisoformat(job[at]) for at in ("created_at", "finished_at"))
        said = job["message"] if job["status"] == "successful" else job["error_reason"]
        self._console.print(
            f"{said}  [dim]{(ended - asked).total_seconds():.1f} s after its upload, "
            f"{time.monotonic() - self._begin:.0f} s after the start[/]",
            soft_wrap=True,
        )

    def _summarise(self) -> None:
        """Print the numbers that matter, and where to see more."""
        rows = _checked(self._http.post("/sql", json={"sql": _SUMMARY}))["rows"]
        if rows:
            self._console.print(summary_table(rows))
        self._console.print(
            f"Open [bold]{self._address}/surveys/{SURVEY}[/]; Ctrl-C stops the service."
        )

    def _get(self, path: str, **query: Any) -> dict[str, Any]:
        """Ask the service."""
        return _checked(self._http.get(path, params=query))

    def _put(self, path: str, file: Path, media_type: str) -> None:
        """Send a small file to the service."""
        headers = {"Content-Type": media_type}
        _checked(self._http.put(path, content=file.read_bytes(), headers=headers))


def summary_table(rows: list[list[Any]]) -> Table:
    """Return errors against truth as a table."""
    table = Table(title="Errors against truth [mm]")
    for name in ("", "fit", "n", "RMS", "maximum", "predicted"):
        table.add_column(name, justify="left" if name in ("", "fit") else "right")
    for what, method, n, *lengths in rows:
        table.add_row(what, method, str(n), *(f"{1e3 * length:.1f}" for length in lengths))
    return table


def _checked(answer: httpx.Response) -> dict[str, Any]:
    """Return what the service answered; raise what it refused."""
    body: dict[str, Any] = answer.json()
    if answer.is_error:
        raise AnsweredError(body.get("detail", answer.reason_phrase))
    return body
