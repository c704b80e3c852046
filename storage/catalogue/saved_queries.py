"""Queries that are kept under a name."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from spheremark.pipelines.errors import NotFoundError
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.catalogue.records import json_text
from spheremark.storage.catalogue.surveys import check_address, now

_ALL = "SELECT * FROM saved_queries ORDER BY name"
_ONE = "SELECT * FROM saved_queries WHERE name = $name"


def list_queries(catalogue: Catalogue) -> list[dict[str, Any]]:
    """Return all queries that are kept, by name.

    Parameters
    ----------
    catalogue : Catalogue
        The database.

    Returns
    -------
    list of dict
        ``name``, ``sql``, ``parameters`` and ``changed_at``.
    """
    return [_readable(row) for row in catalogue.rows(_ALL)]


def get_query(catalogue: Catalogue, name: str) -> dict[str, Any]:
    """Return a query by its name.

    Parameters
    ----------
    catalogue : Catalogue
        The database.
    name : str
        Its name.

    Returns
    -------
    dict
        ``name``, ``sql``, ``parameters`` and ``changed_at``.

    Raises
    ------
    NotFoundError
        If there is none.
    """
    rows = catalogue.rows(_ONE, {"name": name})
    if not rows:
        raise NotFoundError(f"There is no query {name!r}.")
    return _readable(rows[0])


def put_query(
    catalogue: Catalogue, name: str, sql: str, parameters: Mapping[str, Any]
) -> dict[str, Any]:
    """Keep a query under a name, in place of the one that has it.

    Parameters
    ----------
    catalogue : Catalogue
        The database.
    name : str
        Its name.
    sql : str
        One SELECT.
    parameters : mapping
        Values of its parameters, plain.

    Returns
    -------
    dict
        The query as kept.
    """
    check_address("The name of a query", name)
    row = [name, sql, json_text(parameters), now()]
    with catalogue.writing() as cursor:
        cursor.execute("INSERT OR REPLACE INTO saved_queries VALUES (?, ?, ?, ?)", row)
    return get_query(catalogue, name)


def delete_query(catalogue: Catalogue, name: str) -> None:
    """Forget a query.

    Parameters
    ----------
    catalogue : Catalogue
        The database.
    name : str
        Its name.

    Raises
    ------
    NotFoundError
        If there is none.
    """
    get_query(catalogue, name)
    with catalogue.writing() as cursor:
        cursor.execute("DELETE FROM saved_queries WHERE name = ?", [name])


def _readable(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row with its JSON as values."""
    return {**row, "parameters": json.loads(row["parameters"])}
