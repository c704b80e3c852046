"""The owner of the DuckDB file: opening, transactions, our own queries, and snapshots.

While it is open no other process can open the file, not even for reading (DuckDB allows one owner),
so workers return Arrow tables and people query snapshots (``sandbox``). Every read has a
cursor of its own and may run in any thread; writes take turns. The file is never opened and closed
again by this process: that would drop the lock that DuckDB holds on it.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import duckdb
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from spheremark.pipelines.errors import ConflictError, InputError
from spheremark.storage.catalogue import migrations
from spheremark.storage.catalogue.records import TableInfo, tables_of
from spheremark.storage.catalogue.snapshots import Snapshots

_N_ROWS_MAX = 200_000  # of one of our own queries; a page that needs more should aggregate
_COLUMNS = """
SELECT c.table_name, c.column_name, c.data_type, c.comment, t.kind, t.comment AS table_comment
FROM duckdb_columns() AS c JOIN (
    SELECT table_name, 'table' AS kind, comment FROM duckdb_tables() WHERE NOT internal
    UNION ALL
    SELECT view_name, 'view', comment FROM duckdb_views() WHERE NOT internal
) AS t USING (table_name)
WHERE NOT c.internal ORDER BY t.kind DESC, c.table_name, c.column_index
"""


class Database:
    """A DuckDB file and the only process that has it open.

    Parameters
    ----------
    path : Path
        The DuckDB file; it and its folder are made when missing.
    snapshots : Path
        Folder for the copies that others read; on the same disk, so that a copy costs little.
    memory_limit : str
        What DuckDB may use before it spills to disk, in its own words.

    Raises
    ------
    ConflictError
        If another process, or this one, has the file open.
    SchemaConflictError
        If another version of spheremark made the file.
    InputError
        If the file is not a DuckDB database.

    Notes
    -----
    Safe to use from many threads. Once open, the database cannot reach files or the network,
    and its configuration is locked. A query runs in the thread that asks: to share out the few rows
    of a page or of a result among threads costs more than they do.
    """

    def __init__(self, path: Path, *, snapshots: Path, memory_limit: str = "1GB") -> None:
        self.path = path
        self._lock = threading.RLock()
        self._version = 0
        self._connection = _open(path, memory_limit)
        self._writer = self._connection.cursor()
        self._statements: dict[str, duckdb.Statement] = {}
        self._snapshots = Snapshots(path, snapshots)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Give the file back; the catalogue cannot be used any more."""
        with self._lock:
            self._writer.close()
            self._connection.close()

    def columns(
        self, sql: str, parameters: Mapping[str, Any] | None = None
    ) -> dict[str, NDArray[Any]]:
        """Run one of our own static queries, for a figure."""
        table = self.table(sql, parameters)
        return {name: _to_numpy(table.column(name)) for name in table.column_names}

    def rows(self, sql: str, parameters: Mapping[str, Any] | None = None) -> list[dict[str, Any]]:
        """Run one of our own static queries like ``columns``, for a list: one mapping per row."""
        return list(self.table(sql, parameters).to_pylist())

    def table(self, sql: str, parameters: Mapping[str, Any] | None = None) -> pa.Table:
        """Run one of our own static queries like ``columns``, for a file: an Arrow table."""
        with self.reading() as cursor:
            return fetch(cursor, sql, parameters or {})

    def schema(self) -> tuple[TableInfo, ...]:
        """Return the views and tables that people may query, with units and comments."""
        return tables_of(self.rows(_COLUMNS))

    def snapshot(self) -> Path:
        """Return a consistent copy of the database file, as fresh as the last committed result.

        Notes
        -----
        Made only when something but progress was committed since the last one. The copy is
        made by another process: opening and closing the file here would drop DuckDB's lock.
        """
        with self._lock:
            return self._snapshots.take(self._connection, self._version)

    @contextmanager
    def reading(self) -> Iterator[duckdb.DuckDBPyConnection]:
        """Lend a cursor of its own, for this thread."""
        with closing(self._connection.cursor()) as cursor:
            yield cursor

    @contextmanager
    def writing(self, *, is_result: bool = True) -> Iterator[duckdb.DuckDBPyConnection]:
        """Hold the write lock and a transaction: all that is done in it is done, or nothing."""
        with self._lock:
            cursor = self._writer
            try:
                cursor.execute(self._statement("BEGIN"))
                yield cursor
                cursor.execute(self._statement("COMMIT"))
            except BaseException:
                with suppress(duckdb.Error):
                    cursor.execute("ROLLBACK")
                raise
            self._version += is_result

    def _statement(self, sql: str) -> duckdb.Statement:
        """Return a static statement for the cursor that writes; DuckDB reads its text only once."""
        if sql not in self._statements:
            (self._statements[sql],) = self._writer.extract_statements(sql)
        return self._statements[sql]


def _open(path: Path, memory_limit: str) -> duckdb.DuckDBPyConnection:
    """Open the file as its owner, bring its schema up to date, and shut the doors."""
    path.parent.mkdir(parents=True, exist_ok=True)
    connection = _connect(path, memory_limit)
    try:
        _require_alone(connection, path)
        connection.execute("SET GLOBAL TimeZone = 'UTC'")
        migrations.migrate(connection, migrations.released())
        connection.execute("SET enable_external_access = false")
        connection.execute("SET lock_configuration = true")
    except BaseException:
        connection.close()
        raise
    return connection


def _require_alone(connection: duckdb.DuckDBPyConnection, path: Path) -> None:
    """Refuse a file that this process has open: DuckDB would share it, locked doors and all."""
    if connection.sql("SELECT current_setting('lock_configuration')").fetchall()[0][0]:
        raise ConflictError(f"{path} is already open in this process; close that first.")


def _connect(path: Path, memory_limit: str) -> duckdb.DuckDBPyConnection:
    """Open the file, or say in plain words why that is not possible."""
    config: dict[str, str | bool | int | float | list[str]] = {
        "autoinstall_known_extensions": "false",
        "autoload_known_extensions": "false",
        "memory_limit": memory_limit,
        "threads": "1",
    }
    try:
        return duckdb.connect(str(path), config=config)
    except duckdb.IOException as error:
        if "lock" in str(error):
            owner = re.search(r"PID (\d+)", str(error))
            raise ConflictError(
                f"{path} is in use by another process{f' ({owner[0]})' if owner else ''}. "
                "One spheremark serves one data folder: stop the other one, or use another folder."
            ) from error
        raise InputError(f"{path} is not a database of spheremark: {error}") from error
    except duckdb.ConnectionException as error:
        raise ConflictError(f"{path} is already open in this process; close that first.") from error


def fetch(cursor: duckdb.DuckDBPyConnection, sql: str, parameters: Mapping[str, Any]) -> pa.Table:
    """Run a SELECT of ours and return at most the rows that one answer may have."""
    table = cursor.sql(sql, params=dict(parameters)).to_arrow_table()
    if table.num_rows > _N_ROWS_MAX:
        raise InputError(
            f"The answer has {table.num_rows} rows; the limit is {_N_ROWS_MAX}. Narrow the filter."
        )
    return _without_decimals(table)


def _without_decimals(table: pa.Table) -> pa.Table:
    """Return a table with plain numbers; DuckDB sums whole numbers to 128 bits, a decimal here."""
    for i, field in enumerate(table.schema):
        if pa.types.is_decimal(field.type):
            plain = pa.float64() if field.type.scale else pa.int64()
            table = table.set_column(i, field.name, table.column(i).cast(plain))
    return table


class Planned:
    """A statement over rows that come again and again: hides that it is read and planned only once.

    Rows of many columns take longer to plan than to write.

    Parameters
    ----------
    cursor : DuckDBPyConnection
        On which it will run; not inside a transaction, which might take the names back.
    name : str
        What the statement is called among those of the cursor.
    sql : str
        Static text that sees the rows of each table as ``incoming_<table>``.
    schemas : mapping of str to Schema
        Columns of the rows by table.

    Attributes
    ----------
    names : set of str
        The tables.
    """

    def __init__(
        self,
        cursor: duckdb.DuckDBPyConnection,
        name: str,
        sql: str,
        schemas: Mapping[str, pa.Schema],
    ) -> None:
        self._cursor = cursor
        self._incoming = {table: _Incoming(schema) for table, schema in schemas.items()}
        self.names = set(schemas)
        for table, incoming in self._incoming.items():
            cursor.register(f"incoming_{table}", incoming)
        cursor.execute(f"PREPARE planned_{name} AS {sql}")
        (self._call,) = cursor.extract_statements(f"EXECUTE planned_{name}")

    def run(self, tables: Mapping[str, pa.Table]) -> None:
        """Run the statement on some rows, on its cursor; without any do nothing."""
        if not any(rows.num_rows for rows in tables.values()):
            return
        try:
            for table, rows in tables.items():
                self._incoming[table].take(rows)
            self._cursor.execute(self._call).fetchall()  # which ends it
        finally:
            for incoming in self._incoming.values():
                incoming.rows = None


class _Incoming:
    """Rows that are others each time, in the same columns."""

    def __init__(self, schema: pa.Schema) -> None:
        self.schema = schema
        self.rows: pa.Table | None = None

    def take(self, rows: pa.Table) -> None:
        """Take rows in, with the types of the schema."""
        self.rows = rows if rows.schema.equals(self.schema) else rows.cast(self.schema)

    def __arrow_c_stream__(self, requested_schema: object = None) -> object:
        """Return the rows as a stream; DuckDB asks for it, before there are any too."""
        rows = self.schema.empty_table() if self.rows is None else self.rows
        return rows.__arrow_c_stream__(requested_schema)


def execute_on(cursor: duckdb.DuckDBPyConnection, sql: str, table: pa.Table) -> None:
    """Run SQL that sees an Arrow table as ``incoming``."""
    cursor.register("incoming", table)
    cursor.execute(sql)
    cursor.unregister("incoming")


def _to_numpy(column: pa.ChunkedArray) -> NDArray[Any]:
    """Return a column as an array; NULL becomes NaN among numbers and None among objects."""
    if pa.types.is_timestamp(column.type):
        column = column.cast(pa.timestamp("us"))  # NumPy's instants carry no zone; ours are UTC
    return np.asarray(column.to_numpy())
