"""The owner of the DuckDB file: opening, transactions, static queries, and snapshots.

While it is open no other process can open the file, not even for reading (DuckDB allows one owner):
workers return Arrow tables, and queries of users run on snapshots (``sandbox``). Every read has its
own cursor and may run in any thread; writes take turns. This process must not open and close the
file again: that would drop the lock that DuckDB holds on it.
"""

from __future__ import annotations

import logging
import re
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import closing, contextmanager, suppress
from enum import Enum
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

import duckdb
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from spheremark.pipelines.errors import ConflictError, InputError
from spheremark.storage.catalogue import migrations
from spheremark.storage.catalogue.records import TableInfo, tables_of
from spheremark.storage.catalogue.snapshots import Snapshots
from spheremark.storage.files import Reserve, StorageError, StorageFullError, unwritten

logger = logging.getLogger(__name__)

_Value = TypeVar("_Value")

_RESERVE = "reserve"  # name of the file beside the database
_RESERVE_BYTES = 32 << 20  # what DuckDB needs to write its log into the file, many times over
_DAMAGED = "Corrupt database file"  # in DuckDB's errors of pages that were changed
_PATIENCE = 10.0  # [s] for queries that still run on an invalid database; they fail at once
_N_KEPT = 64  # values that are computed from the present state
_N_ROWS_MAX = 200_000  # of one static query; a page that needs more should aggregate
_COLUMNS = """
SELECT c.table_name, c.column_name, c.data_type, c.comment, t.kind, t.comment AS table_comment
FROM duckdb_columns() AS c JOIN (
    SELECT table_name, 'table' AS kind, comment FROM duckdb_tables() WHERE NOT internal
    UNION ALL
    SELECT view_name, 'view', comment FROM duckdb_views() WHERE NOT internal
) AS t USING (table_name)
WHERE NOT c.internal ORDER BY t.kind DESC, c.table_name, c.column_index
"""


class Changed(Enum):
    """What a transaction changes, at most."""

    RESULTS = "results, surveys, control"
    QUEUE = "logs and jobs"
    PROGRESS = "progress of a job"


class Database:
    """A DuckDB file and the only process that has it open.

    Parameters
    ----------
    path : Path
        The DuckDB file; it and its folder are created when missing.
    snapshots : Path
        Folder of the snapshots; on the same disk, so that a copy costs little.
    memory_limit : str
        Memory that DuckDB may use before it spills to disk, in its notation.

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
    and its configuration is locked. A query uses one thread: the rows of a page or of a result are
    too few for more.

    A write that the disk refuses makes DuckDB invalid for good. The file is then opened anew, with
    all that was committed; where the disk is full, the reserve beside the file is given up for it.
    """

    def __init__(self, path: Path, *, snapshots: Path, memory_limit: str = "1GB") -> None:
        self.path = path
        self._memory_limit = memory_limit
        self._lock = threading.RLock()
        self._readers = 0
        self._none_reads = threading.Condition()
        self._failure: duckdb.Error | None = None
        self._version = self._results_version = 0
        self._schema: tuple[TableInfo, ...] | None = None
        self._kept: OrderedDict[Hashable, Future[Any]] = OrderedDict()
        self._kept_version = 0
        self._keeping = threading.Lock()
        self._open()
        self._reserve = Reserve(path.with_name(_RESERVE), _RESERVE_BYTES)
        self._reserve.hold()
        self._snapshots = Snapshots(path, snapshots)

    def _open(self) -> None:
        """Open the file, and what depends on the connection."""
        self._connection = _open(self.path, self._memory_limit)
        self._writer = self._connection.cursor()
        self._statements: dict[str, duckdb.Statement] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def is_usable(self) -> bool:
        """Whether no write has made the database invalid since it was opened."""
        return self._failure is None

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._writer.close()
            self._connection.close()
            self._reserve.release()

    def columns(
        self, sql: str, parameters: Mapping[str, Any] | None = None
    ) -> dict[str, NDArray[Any]]:
        """Run a static query and return its columns as arrays."""
        table = self.table(sql, parameters)
        return {name: _to_numpy(table.column(name)) for name in table.column_names}

    def rows(self, sql: str, parameters: Mapping[str, Any] | None = None) -> list[dict[str, Any]]:
        """Run a static query and return one mapping per row."""
        return list(self.table(sql, parameters).to_pylist())

    def table(self, sql: str, parameters: Mapping[str, Any] | None = None) -> pa.Table:
        """Run a static query and return an Arrow table."""
        with self.reading() as cursor:
            return fetch(cursor, sql, parameters or {})

    def computed(self, key: Hashable, compute: Callable[[], _Value]) -> _Value:
        """Return what a function computes from results, kept until one of them changes.

        Parameters
        ----------
        key : hashable
            The function and its arguments.
        compute : callable
            Reads results, surveys and control alone: neither logs nor jobs.

        Returns
        -------
        object
            Its value, which others get too and must not change.
        """
        with self._keeping:
            if self._kept_version != self._results_version:
                self._kept.clear()
                self._kept_version = self._results_version
            kept = self._kept.get(key)
            own = kept or self._kept.setdefault(key, Future())
            if len(self._kept) > _N_KEPT:
                self._kept.popitem(last=False)
        if kept is None:
            try:
                own.set_result(compute())
            except BaseException as error:
                with self._keeping:
                    if self._kept.get(key) is own:
                        del self._kept[key]
                own.set_exception(error)
                raise
        return own.result()  # type: ignore[no-any-return]  # of the function under this key

    def schema(self) -> tuple[TableInfo, ...]:
        """Return the tables and views that may be queried, with units and comments."""
        if self._schema is None:
            self._schema = tables_of(self.rows(_COLUMNS))
        return self._schema

    def snapshot(self) -> Path:
        """Return a consistent copy of the database file, as fresh as the last committed result.

        Notes
        -----
        Copied only when more than progress was committed since the last copy, and by another
        process: opening and closing the file here would drop DuckDB's lock.
        """
        with self._lock, self._usable():
            self._reserve.hold()
            return self._snapshots.take(self._connection, self._version)

    @contextmanager
    def lent_snapshot(self) -> Iterator[Path]:
        """Lend a snapshot that stays until the end, however many results are committed meanwhile.

        Yields
        ------
        Path
            The file, as ``snapshot`` returns it.
        """
        with self._lock, self._usable():
            self._reserve.hold()
            lent = self._snapshots.lend(self._connection, self._version)
        try:
            yield lent
        finally:
            lent.unlink(missing_ok=True)

    @contextmanager
    def lent_export(self) -> Iterator[Path]:
        """Lend a copy like ``lent_snapshot`` that DuckDB 1.0 and all later versions can open.

        Yields
        ------
        Path
            The file.
        """
        with self.lent_snapshot() as snapshot:
            lent = self._snapshots.lend_portable(snapshot)
        try:
            yield lent
        finally:
            lent.unlink(missing_ok=True)

    @contextmanager
    def reading(self) -> Iterator[duckdb.DuckDBPyConnection]:
        """Give this thread its own cursor."""
        with self._usable(), self._counted(), closing(self._connection.cursor()) as cursor:
            yield cursor

    @contextmanager
    def writing(self, changed: Changed = Changed.RESULTS) -> Iterator[duckdb.DuckDBPyConnection]:
        """Hold the write lock and a transaction."""
        with self._lock, self._usable():
            cursor = self._writer
            try:
                cursor.execute(self._statement("BEGIN"))
                yield cursor
                cursor.execute(self._statement("COMMIT"))
            except BaseException:
                with suppress(duckdb.Error):
                    cursor.execute("ROLLBACK")
                raise
            self._version += changed is not Changed.PROGRESS
            self._results_version += changed is Changed.RESULTS

    @contextmanager
    def _usable(self) -> Iterator[None]:
        """Open the database anew if it was invalid, and note if it becomes so."""
        if self._failure is not None:
            self._reopen()
        try:
            yield
        except duckdb.FatalException as error:
            self._failure = error
            raise self._unwritten(error) from error
        except (duckdb.IOException, duckdb.TransactionException) as error:
            if "Could not write" not in str(error):
                raise
            raise self._unwritten(error) from error
        except duckdb.Error as error:
            if _DAMAGED not in str(error):
                raise
            raise damaged(self.path, error) from error

    def _unwritten(self, error: duckdb.Error) -> StorageError:
        """Return why the file could not be written; a full disk gets the room of the reserve."""
        found = unwritten(self.path, error)
        logger.error("%s", found)
        if isinstance(found, StorageFullError):
            self._reserve.release()
        return found

    @contextmanager
    def _counted(self) -> Iterator[None]:
        """Count those who read: their cursors keep an invalid database in memory."""
        with self._none_reads:
            self._readers += 1
        try:
            yield
        finally:
            with self._none_reads:
                self._readers -= 1
                self._none_reads.notify_all()

    def _reopen(self) -> None:
        """Replace an invalid connection; with the room of the reserve if there is no other."""
        with self._lock, self._none_reads:
            if self._failure is None or not self._none_reads.wait_for(
                lambda: not self._readers, _PATIENCE
            ):
                return
            with suppress(duckdb.Error):
                self._writer.close()
                self._connection.close()
            try:
                self._open()
            except (duckdb.Error, InputError) as error:
                raise unwritten(self.path, error) from error
            self._failure = None
            logger.warning("The database is open again: %s", self.path)

    def _statement(self, sql: str) -> duckdb.Statement:
        """Return a static statement for the writing cursor, parsed only once."""
        if sql not in self._statements:
            (self._statements[sql],) = self._writer.extract_statements(sql)
        return self._statements[sql]


def _open(path: Path, memory_limit: str) -> duckdb.DuckDBPyConnection:
    """Open the file as its owner, update its schema, and cut it off from files and network."""
    path.parent.mkdir(parents=True, exist_ok=True)
    connection = _connect(path, memory_limit)
    try:
        _require_alone(connection, path)
        connection.execute("SET GLOBAL TimeZone = 'UTC'")
        migrations.migrate(connection, migrations.released())
        connection.execute("SET enable_external_access = false")
        connection.execute("SET lock_configuration = true")
    except BaseException as error:
        connection.close()
        if isinstance(error, duckdb.Error) and _DAMAGED in str(error):
            raise damaged(path, error) from error
        raise
    return connection


def damaged(path: Path, error: duckdb.Error) -> StorageError:
    """Return the error of a file of which pages were changed on the disk.

    Parameters
    ----------
    path : Path
        The database.
    error : duckdb.Error
        What DuckDB found.

    Returns
    -------
    StorageError
        Where the damage is, and what to do.
    """
    return StorageError(
        f"{path.name} is damaged on its disk: {str(error).strip().splitlines()[0]}. Check the "
        "disk, and restore the newest backup (spheremark restore)."
    )


def _require_alone(connection: duckdb.DuckDBPyConnection, path: Path) -> None:
    """Refuse a file that this process has open: DuckDB would share the instance."""
    if connection.sql("SELECT current_setting('lock_configuration')").fetchall()[0][0]:
        raise ConflictError(f"{path} is already open in this process; close that first.")


def _connect(path: Path, memory_limit: str) -> duckdb.DuckDBPyConnection:
    """Open the file; translate the errors of DuckDB."""
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
                "One service owns one data folder: stop the other one, or use another folder."
            ) from error
        raise InputError(f"{path} is not a database of spheremark: {error}") from error
    except duckdb.ConnectionException as error:
        raise ConflictError(f"{path} is already open in this process; close that first.") from error
    except duckdb.Error as error:
        raise damaged(path, error) from error


def fetch(cursor: duckdb.DuckDBPyConnection, sql: str, parameters: Mapping[str, Any]) -> pa.Table:
    """Run a static SELECT; refuse a result of too many rows."""
    table = cursor.sql(sql, params=dict(parameters)).to_arrow_table()
    if table.num_rows > _N_ROWS_MAX:
        raise InputError(
            f"The result has {table.num_rows} rows; the limit is {_N_ROWS_MAX}. Narrow the filter."
        )
    return _without_decimals(table)


def _without_decimals(table: pa.Table) -> pa.Table:
    """Return a table with plain numbers; sums of integers are 128-bit, a decimal in Arrow."""
    for i, field in enumerate(table.schema):
        if pa.types.is_decimal(field.type):
            plain = pa.float64() if field.type.scale else pa.int64()
            table = table.set_column(i, field.name, table.column(i).cast(plain))
    return table


class Planned:
    """A statement that is planned once and run on different rows; planning costs more than writing.

    Parameters
    ----------
    cursor : DuckDBPyConnection
        Runs the statement; not in a transaction now, whose rollback would drop the names.
    name : str
        Name of the statement on the cursor.
    sql : str
        Static text that reads the rows of each table as ``incoming_<table>``.
    schemas : mapping of str to Schema
        Columns of the rows by table.
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
        for table, incoming in self._incoming.items():
            cursor.register(f"incoming_{table}", incoming)
        cursor.execute(f"PREPARE planned_{name} AS {sql}")
        (self._call,) = cursor.extract_statements(f"EXECUTE planned_{name}")

    def run(self, tables: Mapping[str, pa.Table]) -> None:
        """Run the statement; without any rows do nothing."""
        if not any(rows.num_rows for rows in tables.values()):
            return
        try:
            for table, rows in tables.items():
                self._incoming[table].take(rows)
            self._cursor.execute(self._call).fetchall()  # fetching ends the statement
        finally:
            for incoming in self._incoming.values():
                incoming.rows = None


class _Incoming:
    """An Arrow stream of the present rows, in fixed columns."""

    def __init__(self, schema: pa.Schema) -> None:
        self.schema = schema
        self.rows: pa.Table | None = None

    def take(self, rows: pa.Table) -> None:
        """Set the rows, with the types of the schema."""
        self.rows = rows if rows.schema.equals(self.schema) else rows.cast(self.schema)

    def __arrow_c_stream__(self, requested_schema: object = None) -> object:
        """Return the rows as a stream; DuckDB also reads it while there are none."""
        rows = self.schema.empty_table() if self.rows is None else self.rows
        return rows.__arrow_c_stream__(requested_schema)


def execute_on(cursor: duckdb.DuckDBPyConnection, sql: str, table: pa.Table) -> None:
    """Run SQL that reads an Arrow table as ``incoming``."""
    cursor.register("incoming", table)
    cursor.execute(sql)
    cursor.unregister("incoming")


def _to_numpy(column: pa.ChunkedArray) -> NDArray[Any]:
    """Return a column as an array; NULL becomes NaN among numbers and None among objects."""
    if pa.types.is_timestamp(column.type):
        column = column.cast(pa.timestamp("us"))  # NumPy's instants have no zone; these are UTC
    return np.asarray(column.to_numpy())
