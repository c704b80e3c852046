"""Sample surveys: simulated by a process of their own, and taken in like logs of a user."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import AsyncIterator
from pathlib import Path
from typing import TYPE_CHECKING

from spheremark.pipelines.errors import SpheremarkError
from spheremark.service.http.uploads import take_in
from spheremark.service.jobs.handlers import JobKind
from spheremark.service.processes import simulated
from spheremark.storage.imports.survey_files import parse_control, parse_truth
from spheremark.storage.recordings import LogOptions
from spheremark.storage.scratch import scratch

if TYPE_CHECKING:
    from spheremark.service.http.state import Service

logger = logging.getLogger(__name__)

_STOPS = ("lane3-stop2", "lane3-stop4", "lane3-stop6")
_BLOCK = 1 << 20  # [bytes]


class Samples:
    """The sample surveys that are being made, one at a time."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._leaving = threading.Event()
        self._thread: threading.Thread | None = None
        self._name = self._survey_id = ""
        self._n_made = 0

    def begin(self, service: Service) -> str:
        """Begin a sample survey and return its name; that of the present one while it is made."""
        with self._lock:
            if self._thread is None or not self._thread.is_alive():
                known = {row["name"] for row in service.catalogue.rows("SELECT name FROM surveys")}
                names = ("sample", *(f"sample {i}" for i in range(2, len(known) + 3)))
                self._name = next(name for name in names if name not in known)
                self._survey_id = service.catalogue.create_survey(self._name).survey_id
                self._n_made = 0
                self._thread = threading.Thread(
                    target=self._make, args=(service, self._survey_id), name="sample"
                )
                self._thread.start()
            return self._name

    def message(self, survey_id: str) -> str:
        """Return what is being made of a survey; empty if nothing is."""
        is_alive = self._thread is not None and self._thread.is_alive()
        if survey_id != self._survey_id or not is_alive:
            return ""
        return f"Simulating stop {min(self._n_made + 1, len(_STOPS))} of {len(_STOPS)}."

    def close(self) -> None:
        """End a simulation, and wait for its thread."""
        self._leaving.set()
        if self._thread is not None:
            self._thread.join()

    def _make(self, service: Service, survey_id: str) -> None:
        """Simulate, take in and process stop after stop, then adjust."""
        from spheremark.service.http.api.jobs import start
        from spheremark.service.http.api.models import NewJob

        try:
            with scratch() as folder:
                for made in simulated(folder, _STOPS, self._leaving):
                    recording = self._take_in(service, survey_id, folder, made)
                    start(service, NewJob(survey=survey_id, recording=recording))
                    self._n_made += 1
            if self._n_made == len(_STOPS):
                start(service, NewJob(kind=JobKind.ADJUST, survey=survey_id))
        except (SpheremarkError, OSError, ValueError) as error:
            if not self._leaving.is_set():
                logger.warning("The sample survey was not completed: %s", error)

    def _take_in(self, service: Service, survey_id: str, folder: Path, made: dict[str, str]) -> str:
        """Enter the log of a stop with the control and the truth of its field."""
        log, catalogue = Path(made["log"]), service.catalogue
        control = (folder / "control.csv").read_text(encoding="utf-8")
        catalogue.put_control_marks(survey_id, parse_control(control))
        catalogue.put_truth(survey_id, parse_truth(Path(made["truth"]).read_text(encoding="utf-8")))
        headers = {"content-length": str(log.stat().st_size)}
        most = service.settings.max_upload_bytes
        received = asyncio.run(service.inbox.receive(_chunks(log), most, headers))
        recording, _ = take_in(catalogue, received, made["stop"], LogOptions())
        catalogue.add_to_survey(survey_id, recording.recording_id)
        return recording.recording_id


async def _chunks(path: Path) -> AsyncIterator[bytes]:
    """Yield the bytes of a file."""
    with path.open("rb") as file:  # in a loop of its own
        while block := file.read(_BLOCK):
            yield block
