"""The demonstration: the service, and a simulated rover that surveys one lane.

A process of its own simulates the stops; each is uploaded over HTTP as soon as it is ready.
"""

from __future__ import annotations

import queue
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime
from pathlib import Path
from typing import Any

import httpx
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from spheremark.pipelines.errors import SpheremarkError
from spheremark.service.client import Client
from spheremark.service.processes import simulated
from spheremark.service.serving import serve
from spheremark.service.settings import Settings

SURVEY = "paper-field"
LANE = "lane3"
_N_STOPS = 7
_PATIENCE = 600.0  # [s] of a request: on a busy machine kernels are loaded beside the first one
_POLL = 0.2  # [s] between two requests for the state of a job
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


def run(settings: Settings, console: Console) -> None:
    """Serve, and survey one lane if the service has no data yet."""
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
        self._client = Client(address, token=settings.token_text, timeout=_PATIENCE)
        self._folder = settings.data.resolve() / "simulated"
        self._address = address
        self._console = console
        self._leaving = leaving
        self._begin = time.monotonic()

    def drive(self) -> None:
        """Survey the lane if it is missing and print the results; errors do not end the service."""
        try:
            stops = self._missing()
            if stops:
                self._survey(stops)
            self._summarise()
        except (httpx.HTTPError, SpheremarkError, OSError) as error:
            if not self._leaving.is_set():
                self._console.print(f"[red]The demonstration ended early: {error}[/]")
        finally:
            self._client.close()

    def _missing(self) -> list[str]:
        """Return the stops of the lane that are missing; none if the service has other data."""
        lane = [f"{LANE}-stop{place}" for place in range(1, _N_STOPS + 1)]
        found = self._client.request("GET", "/recordings", params={"limit": 1000})["items"]
        known = {one["name"] for one in found}
        is_ours = not self._client.request("GET", "/surveys")["items"] or self._folder.exists()
        return [stop for stop in lane if stop not in known] if is_ours else []

    def _survey(self, stops: list[str]) -> None:
        """Simulate and upload stop after stop, and print the end of each job."""
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
            self._await(self._client.start("adjust", SURVEY)["job_id"])

    def _bring(self, stops: list[str], jobs: queue.SimpleQueue[str | None]) -> None:
        """Simulate and upload stop after stop; queue the job of each, then None."""
        try:
            for made in simulated(self._folder, stops, self._leaving):
                self._client.set_control(SURVEY, self._folder / "control.csv")
                self._client.request(
                    "PUT",
                    f"/surveys/{SURVEY}/truth",
                    content=Path(made["truth"]).read_bytes(),
                    headers={"Content-Type": "application/json"},
                )
                upload = self._client.upload(made["log"], survey=SURVEY, name=made["stop"])
                jobs.put(upload["job"]["job_id"])
        finally:
            jobs.put(None)

    def _await(self, job_id: str) -> None:
        """Wait for the end of a job and print its message or the reason of its failure."""
        job = self._client.request("GET", f"/jobs/{job_id}")
        while job["status"] in ("accepted", "running") and not self._leaving.wait(_POLL):
            job = self._client.request("GET", f"/jobs/{job_id}")
        if job["finished_at"] is None:
            return
        created, ended = (datetime.fromisoformat(job[at]) for at in ("created_at", "finished_at"))
        text = job["message"] if job["status"] == "successful" else job["error_reason"]
        self._console.print(
            f"{text}  [dim]{(ended - created).total_seconds():.1f} s after its upload, "
            f"{time.monotonic() - self._begin:.0f} s after the start[/]",
            soft_wrap=True,
        )

    def _summarise(self) -> None:
        """Print the errors against truth and the address of the survey."""
        rows = self._client.request("POST", "/sql", json={"sql": _SUMMARY})["rows"]
        if rows:
            self._console.print(summary_table(rows))
        self._console.print(
            f"Open [bold]{self._address}/surveys/{SURVEY}[/]; Ctrl-C stops the service."
        )


def summary_table(rows: list[list[Any]]) -> Table:
    """Return errors against truth as a table."""
    table = Table(title=escape("Errors against truth [mm]"))
    for name in ("", "fit", "n", "RMS", "maximum", "predicted"):
        table.add_column(name, justify="left" if name in ("", "fit") else "right")
    for what, method, n, *lengths in rows:
        table.add_row(what, method, str(n), *(f"{1e3 * length:.1f}" for length in lengths))
    return table
