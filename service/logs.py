"""Lines of the log: as text, or as JSON with the ids of request and job."""

from __future__ import annotations

import json
import logging
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Literal

LogFormat = Literal["text", "json"]
REQUEST: ContextVar[str] = ContextVar("request", default="")
"""Id of the request that is being handled, if one is."""

_FIELDS = ("job", "worker", "method", "path", "status", "seconds", "client")  # given as ``extra``


class _Text(logging.Formatter):
    """Level, logger and message, then the ids in brackets."""

    def format(self, record: logging.LogRecord) -> str:
        """Return a record as text."""
        text = f"{record.levelname} {record.name}: {super().format(record)}"
        ids = " ".join(f"{name} {value}" for name, value in _ids(record).items())
        return f"{text} [{ids}]" if ids else text


class _Json(logging.Formatter):
    """One JSON object a line."""

    def format(self, record: logging.LogRecord) -> str:
        """Return a record as JSON."""
        found = {
            "at": datetime.fromtimestamp(record.created, UTC).isoformat(),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **_ids(record),
        }
        if record.exc_info:
            found["traceback"] = self.formatException(record.exc_info)
        return json.dumps(found, default=str)


def log_to_stderr(form: LogFormat) -> None:
    """Write all records of this process to standard error, in one format."""
    handler = logging.StreamHandler()
    handler.setFormatter(_Json() if form == "json" else _Text("%(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)


def event_level(form: LogFormat) -> int:
    """Return the level of what happens all the time, such as requests: programs read it."""
    return logging.INFO if form == "json" else logging.DEBUG


def _ids(record: logging.LogRecord) -> dict[str, object]:
    """Return the ids and other fields that a record carries."""
    found = {name: getattr(record, name) for name in _FIELDS if hasattr(record, name)}
    request = REQUEST.get()
    return {"request": request, **found} if request else found
