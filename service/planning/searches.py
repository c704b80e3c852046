"""Searches of plans: started, followed, ended, and kept with their results under an address.

Each is a file of JSON in the data folder; while it runs, its process writes how far it has come
beside it. A search that a restart interrupted is a failed one.
"""

from __future__ import annotations

import json
import logging
import secrets
from collections.abc import Callable, Mapping
from concurrent.futures import CancelledError, Future, wait
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from threading import Lock
from time import monotonic
from typing import Any

from spheremark.pipelines.errors import ConflictError, NotFoundError, SpheremarkError
from spheremark.pipelines.placement import SearchState
from spheremark.pipelines.progress import checkpoint
from spheremark.service.errors import BusyError
from spheremark.service.planning.predictions import Predictions
from spheremark.service.serialise.plans import Plain, number_or_null
from spheremark.storage.files import StorageError, unwritten

logger = logging.getLogger(__name__)

_KEPT = 200  # searches; beyond, the oldest that have ended are removed
_OPEN_MOST = 8  # that run or wait
_LOOK_EVERY = 0.2  # [s] whether the caller still waits
_REPORT_EVERY = 0.3  # [s] between two reports of a search
_ID_DIGITS = 16


class Searches:
    """The searches of one service.

    Parameters
    ----------
    predictions : Predictions
        Processes that search.
    folder : Path
        Where searches are kept.
    """

    def __init__(self, predictions: Predictions, folder: Path) -> None:
        self._predictions, self._folder = predictions, folder
        self._lock = Lock()
        self._running: dict[str, Future[Plain]] = {}
        self._unwritten: dict[str, Plain] = {}  # that have ended, and their disk took no file

    def open(self) -> None:
        """Make the folder, and record which searches a restart interrupted.

        A damaged file is renamed, so that it is kept and read no more.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        for path in self._folder.glob("*.json"):
            try:
                found = json.loads(path.read_text(encoding="utf-8"))
                is_open = found["status"] == "running"
            except (ValueError, TypeError, KeyError):
                logger.warning("Search %s is damaged; its file is renamed.", path.stem)
                path.rename(path.with_suffix(".damaged"))
                continue
            if is_open:
                reason = "The service was restarted while this search ran; start it again."
                self._end(found, "failed", code="interrupted", reason=reason)

    def start(
        self, kind: str, request: Mapping[str, Any], function: Callable[..., Plain], *arguments: Any
    ) -> Plain:
        """Start a search: a function that takes the arguments and a report, and return it."""
        search_id, _ = self._begin(kind, request, function, arguments)
        return self.get(search_id)

    def run(
        self,
        kind: str,
        request: Mapping[str, Any],
        seconds: float,
        function: Callable[..., Plain],
        *arguments: Any,
    ) -> tuple[Plain | None, str]:
        """Return the result of a search, or None if it takes longer than some time, and its id.

        The search goes on then; where a checkpoint raises, it ends. Its errors are raised.
        """
        search_id, future = self._begin(kind, request, function, arguments)
        end = monotonic() + seconds
        try:
            while not wait((future,), min(_LOOK_EVERY, max(end - monotonic(), 0.0))).done:
                checkpoint()
                if monotonic() >= end:
                    return None, search_id
        except BaseException:
            future.cancel()
            raise
        return self._predictions.result_of(future), search_id

    def _begin(
        self,
        kind: str,
        request: Mapping[str, Any],
        function: Callable[..., Plain],
        arguments: tuple[Any, ...],
    ) -> tuple[str, Future[Plain]]:
        """Start a search, and return its id and its future."""
        with self._lock:
            if len(self._running) >= _OPEN_MOST:
                raise BusyError(
                    f"{_OPEN_MOST} searches of plans run or wait, the most; wait for one to end."
                )
            record: Plain = {
                "search_id": secrets.token_hex(_ID_DIGITS // 2),
                "kind": kind,
                "status": "running",
                "progress_percent": 0.0,
                "message": "Waiting for a process",
                "n_marks": None,
                "worst_sigma_3d_m": None,
                "worst_sigma_3d_bound_m": None,
                "created_at": datetime.now(UTC).isoformat(),
                "finished_at": None,
                "error_code": None,
                "error_reason": None,
                "request": dict(request),
            }
            _write(self._file(record["search_id"]), record)
            path = self._beside(record["search_id"])
            future = self._predictions.start(_reported, str(path), function, arguments)
            self._running[record["search_id"]] = future
        future.add_done_callback(lambda done: self._ended(record, done))
        self._forget()
        return record["search_id"], future

    def get(self, search_id: str) -> Plain:
        """Return a search; raise NotFoundError if there is none."""
        if not (len(search_id) == _ID_DIGITS and search_id.isalnum()):
            raise NotFoundError(f"There is no search {search_id!r}.")
        if (ended := self._unwritten.get(search_id)) is not None:
            self._keep(ended)
            return dict(ended)
        try:
            found: Plain = json.loads(self._file(search_id).read_text(encoding="utf-8"))
        except FileNotFoundError as error:
            raise NotFoundError(f"There is no search {search_id!r}.") from error
        if found["status"] == "running":
            with suppress(FileNotFoundError, ValueError):
                found |= json.loads(self._beside(search_id).read_text(encoding="utf-8"))
        return found

    def list(self) -> list[Plain]:
        """Return all searches without their results, newest first."""
        every = []
        for path in self._folder.glob("*.json"):
            with suppress(NotFoundError):  # removed in the meantime
                every.append(self.get(path.stem))
        every.sort(key=lambda one: one["created_at"], reverse=True)
        return [{k: v for k, v in one.items() if k not in _RESULTS} for one in every]

    def dismiss(self, search_id: str) -> Plain:
        """End a search; raise ConflictError if it has ended."""
        found = self.get(search_id)
        with self._lock:
            future = self._running.get(search_id)
        if future is None:
            raise ConflictError(f"Search {search_id} is {found['status']} and cannot be ended.")
        future.cancel()
        self._end(found, "dismissed", reason="Ended on request.")
        return self.get(search_id)

    def find(self, kind: str, request: Mapping[str, Any]) -> Plain | None:
        """Return the newest search with a request that has not failed, if there is one."""
        alike = (one for one in self.list() if one["kind"] == kind and one["request"] == request)
        newest = next((one for one in alike if one["status"] in ("running", "successful")), None)
        return None if newest is None else self.get(newest["search_id"])

    def _ended(self, record: Plain, future: Future[Plain]) -> None:
        """Record the end of a search."""
        with self._lock:
            self._running.pop(record["search_id"], None)
        found = self.get(record["search_id"])
        if found["status"] != "running":
            return
        try:
            result = self._predictions.result_of(future)
        except CancelledError:
            self._end(found, "dismissed", reason="Ended on request.")
        except SpheremarkError as error:
            self._end(found, "failed", code=error.code, reason=str(error))
        except Exception as error:  # noqa: BLE001  it becomes the recorded failure, as of a job
            reason = f"{type(error).__name__}: {error}"
            self._end(found, "failed", code="internal", reason=reason)
        else:
            kind = str(record["kind"])
            name = {"optimise": "optimised"}.get(kind, kind)
            self._end(found | {name: result, "progress_percent": 100.0}, "successful")

    def _end(self, found: Plain, status: str, *, code: str | None = None, reason: str = "") -> None:
        """Write the end of a search."""
        ended = {"status": status, "finished_at": datetime.now(UTC).isoformat()}
        why = {"error_code": code, "error_reason": reason or None}
        message = {"successful": "Done.", "dismissed": reason}.get(status, reason)
        self._keep(found | ended | why | {"message": message})
        with suppress(OSError):  # of a disk that is read-only; the file is not read any more
            self._beside(found["search_id"]).unlink(missing_ok=True)

    def _keep(self, record: Plain) -> None:
        """Write a search that has ended; hold it in memory while the disk takes no file."""
        search_id = record["search_id"]
        try:
            _write(self._file(search_id), record)
        except StorageError as error:
            if search_id not in self._unwritten:
                logger.warning("Search %s is in memory alone: %s", search_id, error)
            self._unwritten[search_id] = record
        else:
            self._unwritten.pop(search_id, None)

    def _file(self, search_id: str) -> Path:
        """Return the file of a search."""
        return self._folder / f"{search_id}.json"

    def _beside(self, search_id: str) -> Path:
        """Return the file in which its process writes how far it has come."""
        return self._folder / f"{search_id}.progress"

    def _forget(self) -> None:
        """Remove the oldest searches that have ended, beyond those that are kept."""
        for one in self.list()[_KEPT:]:
            if one["status"] != "running":
                self._file(one["search_id"]).unlink(missing_ok=True)


_RESULTS = ("optimised", "trade_off", "random")


def _write(path: Path, record: Mapping[str, Any]) -> None:
    """Write a file whole or not at all; raise StorageError where the disk takes none."""
    part = path.with_suffix(f".{secrets.token_hex(4)}")
    try:
        part.write_text(json.dumps(record), encoding="utf-8")
        part.replace(path)
    except OSError as error:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        raise unwritten(path, error) from error


def _reported(path: str, function: Callable[..., Plain], arguments: tuple[Any, ...]) -> Plain:
    """Return what a function returns, while it writes how far it has come."""
    last = 0.0

    def report(state: SearchState) -> None:
        nonlocal last
        if monotonic() - last < _REPORT_EVERY:
            return
        last = monotonic()
        come = {
            "progress_percent": round(100.0 * state.share, 1),
            "message": state.step,
            "n_marks": state.n_marks or None,
            "worst_sigma_3d_m": number_or_null(state.worst),
            "worst_sigma_3d_bound_m": state.bound or None,
        }
        with suppress(StorageError):  # a full disk ends no search
            _write(Path(path), come)

    return function(*arguments, report)
