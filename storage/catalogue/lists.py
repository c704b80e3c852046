"""Records of the database, one by one and in parts of long lists."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping
from datetime import datetime
from typing import Any, TypeVar

from spheremark.pipelines.errors import InputError, NotFoundError
from spheremark.storage.catalogue.database import Database
from spheremark.storage.catalogue.records import Page

_Record = TypeVar("_Record")

_PAGE_MAX = 1000  # records in one part of a list


class Lists(Database):
    """A database whose lists are read in parts: each part names the place where the next begins."""

    def _one(self, sql: str, parameters: Mapping[str, Any], what: str) -> dict[str, Any]:
        """Return the first row of a query."""
        rows = self.rows(sql, parameters)
        if not rows:
            raise NotFoundError(f"There is no {what}.")
        return rows[0]

    def _part(
        self, sql: str, wanted: Mapping[str, Any], after: str | None, limit: int
    ) -> list[dict[str, Any]]:
        """Return the rows of one part of a list, and one more to tell whether another follows."""
        if not 1 <= limit <= _PAGE_MAX:
            raise InputError(f"The limit is {limit}; it must be from 1 to {_PAGE_MAX}.")
        instant, identifier = (None, None) if after is None else _read_mark(after)
        return self.rows(sql, {**wanted, "at": instant, "id": identifier, "n": limit + 1})


def page_of(
    rows: list[dict[str, Any]],
    limit: int,
    instant: str,
    identifier: str,
    build: Callable[[dict[str, Any]], _Record],
) -> Page[_Record]:
    """Build a part of a list from its rows, of which one more was asked for."""
    last = rows[limit - 1] if len(rows) > limit else None
    mark = None if last is None else _write_mark(last[instant], last[identifier])
    return Page(items=tuple(build(row) for row in rows[:limit]), next=mark)


def _write_mark(instant: datetime, identifier: str) -> str:
    """Return the place in a list as text that needs no quoting in a URL."""
    return base64.urlsafe_b64encode(f"{instant.isoformat()} {identifier}".encode()).decode()


def _read_mark(mark: str) -> tuple[datetime, str]:
    """Return the place in a list that ``_write_mark`` wrote."""
    try:
        instant, identifier = base64.urlsafe_b64decode(mark.encode()).decode().split(" ", 1)
        return datetime.fromisoformat(instant), identifier
    except ValueError as error:
        raise InputError(
            f"{mark!r} is no place in this list; pass the 'next' of the part before."
        ) from error
