"""Results of queries as files with types: Parquet and Arrow."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

import pyarrow as pa
from pyarrow import ipc, parquet

from spheremark.storage.catalogue.sandbox import QueryRejectedError, QueryResult

_TYPES = {
    "BOOLEAN": pa.bool_(),
    "TINYINT": pa.int8(),
    "SMALLINT": pa.int16(),
    "INTEGER": pa.int32(),
    "BIGINT": pa.int64(),
    "UTINYINT": pa.uint8(),
    "USMALLINT": pa.uint16(),
    "UINTEGER": pa.uint32(),
    "UBIGINT": pa.uint64(),
    "FLOAT": pa.float32(),
    "DOUBLE": pa.float64(),
    "VARCHAR": pa.string(),
    "TIMESTAMP": pa.timestamp("us"),
    "TIMESTAMP WITH TIME ZONE": pa.timestamp("us", "UTC"),
}


def to_parquet(result: QueryResult) -> bytes:
    """Return a result as Parquet.

    Parameters
    ----------
    result : QueryResult
        The result of a query.

    Returns
    -------
    bytes
        The file; the metadata of its schema say whether rows were cut (``truncated``).
    """
    sink = pa.BufferOutputStream()
    parquet.write_table(_table(result), sink)
    return bytes(sink.getvalue().to_pybytes())


def to_arrow(result: QueryResult) -> bytes:
    """Return a result as a stream of Arrow.

    Parameters
    ----------
    result : QueryResult
        The result of a query.

    Returns
    -------
    bytes
        The stream; the metadata of its schema say whether rows were cut (``truncated``).
    """
    table = _table(result)
    sink = pa.BufferOutputStream()
    with ipc.new_stream(sink, table.schema) as writer:
        writer.write_table(table)
    return bytes(sink.getvalue().to_pybytes())


def _table(result: QueryResult) -> pa.Table:
    """Return a result as a table; types without a counterpart become text, as JSON if nested."""
    columns = list(zip(*result.rows, strict=True)) or [()] * len(result.columns)
    kinds = [column.type for column in result.columns]
    names = [column.name for column in result.columns]
    arrays = [_array(*one) for one in zip(names, kinds, columns, strict=True)]
    table = pa.Table.from_arrays(arrays, names=names)
    return table.replace_schema_metadata({"truncated": str(result.truncated).lower()})


def _array(name: str, kind: str, values: Sequence[Any]) -> pa.Array:
    """Return the values of a column."""
    if kind in ("TIMESTAMP", "TIMESTAMP WITH TIME ZONE"):
        try:
            instants = [None if one is None else _instant(one) for one in values]
        except ValueError as error:
            raise QueryRejectedError(
                f"The column {name!r} has an instant that no file takes ({error}): files have the "
                f"years 1 to 9999. Cast it in the query: {name}::VARCHAR."
            ) from error
        return pa.array(instants, pa.timestamp("us", "UTC")).cast(_TYPES[kind])
    if kind in _TYPES:
        return pa.array(values, _TYPES[kind])
    return pa.array([None if one is None else _text(one) for one in values], pa.string())


def _instant(text: str) -> datetime:
    """Return an instant, which DuckDB gives in UTC."""
    return datetime.fromisoformat(text.removesuffix("Z")).replace(tzinfo=UTC)


def _text(value: Any) -> str:
    """Return a value as text."""
    return value if isinstance(value, str) else json.dumps(value)
