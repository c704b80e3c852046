"""Records one by one, and lists in pages: hides the text that marks the place of the next page."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from datetime import datetime
from typing import Any, TypeVar

from spheremark.pipelines.errors import InputError, NotFoundError
from spheremark.storage.catalogue.database import Database
from spheremark.storage.catalogue.records import (
    JobRecord,
    Page,
    RecordingRecord,
    RunRecord,
    SurveyRecord,
    record_of,
)

_Kind = TypeVar("_Kind", SurveyRecord, RecordingRecord, JobRecord, RunRecord)

_PAGE_MAX = 1000  # records in one page
_ORDER = {
    SurveyRecord: ("created_at", "survey_id"),
    RecordingRecord: ("uploaded_at", "recording_id"),
    JobRecord: ("created_at", "job_id"),
    RunRecord: ("finished_at", "run_id"),
}
"""Columns that order the list of each kind, newest first."""


class Lists(Database):
    """A database whose lists are read in pages."""

    def _one(self, sql: str, parameters: Mapping[str, Any], what: str) -> dict[str, Any]:
        """Return the first row of a query."""
        rows = self.rows(sql, parameters)
        if not rows:
            raise NotFoundError(f"There is no {what}.")
        return rows[0]

    def _page(
        self,
        kind: type[_Kind],
        sql: str,
        filters: Mapping[str, Any],
        after: str | None,
        limit: int,
    ) -> Page[_Kind]:
        """Return the page of a list that begins after a place."""
        if not 1 <= limit <= _PAGE_MAX:
            raise InputError(f"The limit is {limit}; it must be from 1 to {_PAGE_MAX}.")
        instant, identifier = (None, None) if after is None else _read_place(after)
        place = {"at": instant, "id": identifier, "n": limit + 1}  # one more: is there a next page?
        rows = self.rows(sql, {**filters, **place})
        more = len(rows) > limit
        last = _write_place(*(rows[limit - 1][name] for name in _ORDER[kind])) if more else None
        return Page(items=tuple(record_of(kind, row) for row in rows[:limit]), next=last)


def _write_place(instant: datetime, identifier: str) -> str:
    """Return a place in a list as text that needs no quoting in a URL."""
    return base64.urlsafe_b64encode(f"{instant.isoformat()} {identifier}".encode()).decode()


def _read_place(text: str) -> tuple[datetime, str]:
    """Return the place in a list that ``_write_place`` wrote."""
    try:
        instant, identifier = base64.urlsafe_b64decode(text.encode()).decode().split(" ", 1)
        return datetime.fromisoformat(instant), identifier
    except ValueError as error:
        raise InputError(
            f"{text!r} is no place in this list; pass the 'next' of the page before."
        ) from error
