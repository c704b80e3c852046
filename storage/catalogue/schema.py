"""Tables and views as the SQL files declare them: their comments, and the Arrow types of columns.

The comment above a ``CREATE`` describes the table or view, one behind a column the column, also
where a later file adds it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Hashable, Iterator, Mapping, Sequence
from functools import cache
from importlib import resources
from typing import Any, NamedTuple, cast

import pyarrow as pa

from spheremark.storage.catalogue.rows import Row, plain

_OBJECT = re.compile(
    r"^-- (?P<about>[^\n]*)\nCREATE (?P<kind>TABLE|VIEW) (?P<name>\w+)(?P<body>.*?);$", re.M | re.S
)
_COLUMN = re.compile(r"^    (?P<sql>.*?),?(?:  -- (?P<about>.*))?$", re.M)
_ADDED = re.compile(
    r"^ALTER TABLE (?P<table>\w+) ADD COLUMN (?P<name>\w+) (?P<type>\S+);  -- (?P<about>.*)$", re.M
)
_COLUMN_NAME = re.compile(r"(?P<name>\w+?)(?:_(?P<unit>m|deg|s))?")
_TYPES = {
    "VARCHAR": pa.string(),
    "JSON": pa.string(),
    "DOUBLE": pa.float64(),
    "INTEGER": pa.int32(),
    "BIGINT": pa.int64(),
    "BOOLEAN": pa.bool_(),
    "TIMESTAMPTZ": pa.timestamp("us", "UTC"),
}


class _Column(NamedTuple):
    """A column: its name, its comment, and its type; views have no types here."""

    name: str
    about: str
    type: str


class _Object(NamedTuple):
    """A table or view with its comment and columns; of a view, those with comments."""

    name: str
    kind: str
    about: str
    columns: tuple[_Column, ...]


def comments(sql: str) -> str:
    """Return the statements that write the comments of a schema into the database."""
    pairs = [
        (what, about)
        for one in _objects(sql)
        for what, about in (
            (f"{one.kind} {one.name}", one.about),
            *((f"COLUMN {one.name}.{column.name}", column.about) for column in one.columns),
        )
    ]
    pairs += [(f"COLUMN {table}.{column.name}", column.about) for table, column in _added(sql)]
    return "".join(
        f"COMMENT ON {what} IS '{about.replace(chr(39), 2 * chr(39))}';\n"
        for what, about in pairs
        if about
    )


def _objects(sql: str) -> Iterator[_Object]:
    """Yield the tables and views of a schema."""
    for found in _OBJECT.finditer(sql):
        columns = _columns(found["body"], is_view=found["kind"] == "VIEW")
        yield _Object(found["name"], found["kind"], found["about"], tuple(columns))


def _added(sql: str) -> Iterator[tuple[str, _Column]]:
    """Yield the columns that a schema adds to tables of earlier files, with these tables."""
    for found in _ADDED.finditer(sql):
        yield found["table"], _Column(found["name"], found["about"], found["type"])


def _columns(body: str, *, is_view: bool) -> Iterator[_Column]:
    """Yield the columns of a table, or those of a view that have comments."""
    for found in _COLUMN.finditer(body):
        words, about = found["sql"].split(), found["about"] or ""
        if is_view and about:
            yield _Column(words[-1].rpartition(".")[2], about, "")
        elif not is_view and words[0] != "PRIMARY":
            yield _Column(words[0], about, words[1])


def _arrow(kind: str) -> pa.DataType:
    """Return the Arrow type of a type of the database."""
    return pa.list_(_TYPES[kind[:-2]]) if kind.endswith("[]") else _TYPES[kind]


def _schemas() -> dict[str, pa.Schema]:
    """Return the columns of every table, in the order of the database."""
    files = resources.files(__package__).joinpath("migrations").iterdir()
    named = sorted(files, key=lambda file: file.name)
    texts = [file.read_text(encoding="utf-8") for file in named if file.name.endswith(".sql")]
    tables = {
        one.name: list(one.columns)
        for text in texts
        for one in _objects(text)
        if one.kind == "TABLE"
    }
    for text in texts:
        for table, column in _added(text):
            tables[table].append(column)
    return {
        name: pa.schema([(column.name, _arrow(column.type)) for column in columns])
        for name, columns in tables.items()
    }


SCHEMAS: Mapping[str, pa.Schema] = _schemas()
"""Columns of every table, in the order of the database."""


def row_of(table: str, value: Any, prefix: str = "") -> Row:
    """Return the attributes of a value that a table has columns for.

    A column ``x``, ``x_m`` or ``x_s`` is the attribute ``x``, ``x_deg`` that attribute in degrees;
    with a prefix, columns that begin with it are attributes without it.
    """
    row, kind = {}, cast(Hashable, type(value))  # mypy takes the __hash__ of its instances
    for column, attribute, is_angle in _attributes(table, kind, prefix):
        found = getattr(value, attribute)
        row[column] = math.degrees(found) if is_angle else found
    return row


@cache
def _attributes(table: str, kind: Hashable, prefix: str) -> tuple[tuple[str, str, bool], ...]:
    """Return the columns of a table that a class has attributes for, with these."""
    found = (_COLUMN_NAME.fullmatch(column.removeprefix(prefix)) for column in SCHEMAS[table].names)
    return tuple(
        (prefix + match[0], match["name"], match["unit"] == "deg")
        for match in found
        if match and hasattr(kind, match["name"])
    )


def table_of(name: str, rows: Sequence[Row]) -> pa.Table:
    """Return rows as an Arrow table with the columns of a table of the database.

    Parameters
    ----------
    name : str
        The table.
    rows : sequence of dict
        A missing column is NULL; unknown and non-finite numbers become NULL.

    Returns
    -------
    Table
        The rows.
    """
    known = [{key: plain(value) for key, value in row.items()} for row in rows]
    array = pa.array(known, pa.struct(list(SCHEMAS[name])))  # half of what from_pylist costs
    return pa.Table.from_batches([pa.RecordBatch.from_struct_array(array)])


def tables_of(
    names: Sequence[str], rows: Mapping[str, Sequence[Row]], **shared: Any
) -> dict[str, pa.Table]:
    """Return rows as Arrow tables with the columns of tables of the database.

    Parameters
    ----------
    names : sequence of str
        The tables.
    rows : mapping of str to sequence of dict
        Rows by table; a table that is not named has none.
    **shared
        Values that all rows have, where their table has such a column.

    Returns
    -------
    dict of str to Table
        One for each name.
    """
    return {name: table_of(name, [shared | row for row in rows.get(name, ())]) for name in names}
