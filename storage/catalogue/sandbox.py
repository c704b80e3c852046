"""SQL of users: each query in its own process, on a snapshot, with hard limits.

Why a process: DuckDB in the owner's process is no sandbox (a SELECT can insert, an interrupt is no
time limit, the memory limit is shared). The isolation rests on four things: the file is opened
read-only, nothing outside it can be reached, the operating system limits memory and forbids writing
files, and its timer ends the process at the deadline. The check for one SELECT only gives advice.
"""

from __future__ import annotations

import csv
import io
import json
import logging
import math
import signal
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter
from typing import IO, Any, ClassVar

import duckdb
import numpy as np

from spheremark.pipelines.errors import InputError, SpheremarkError
from spheremark.storage.confined import Limits, UnreadableFileError, keep_ready, run_confined

_WHOLE_TYPES = ("TINYINT", "SMALLINT", "INTEGER", "BIGINT")
_PLAIN_TYPES = frozenset(
    ("BOOLEAN", "FLOAT", "DOUBLE", "VARCHAR", *_WHOLE_TYPES, *(f"U{kind}" for kind in _WHOLE_TYPES))
)
_INSTANT_TYPES = ("TIMESTAMP", "TIMESTAMP WITH TIME ZONE")
_INSTANT_FORMAT = "%Y-%m-%dT%H:%M:%S.%f"
_HEADROOM = 1 << 30  # [bytes] of addresses for Python and DuckDB themselves, beyond the limit
_MESSAGE_MAX = 600  # characters of DuckDB's own message
_START_MAX = 20.0  # [s] that a query may take besides, on a machine that is busy
_FRAME_MAX = 1 << 20  # [bytes] of a response besides the rows
_AT_ONCE = 8  # processes of queries
_KINDS = ("SELECT", "EXPLAIN")
_MODULE = "spheremark.storage.catalogue.sandbox"

logger = logging.getLogger(__name__)


class QueryRejectedError(InputError):
    """The query cannot be run."""

    code: ClassVar[str] = "query.rejected"


class QueryTimeoutError(InputError):
    """The query ran into its time limit."""

    code: ClassVar[str] = "query.timeout"


class QueryStarvedError(SpheremarkError):
    """The machine was too busy for the query; try again later."""

    code: ClassVar[str] = "query.busy"


@dataclass(frozen=True, slots=True, kw_only=True)
class QueryLimits:
    """Limits of one query.

    Attributes
    ----------
    seconds : float
        Computing time after which the query is ended [s].
    memory_bytes : int
        Memory of DuckDB for the query.
    rows, result_bytes : int
        Number of rows, and length of the result as JSON; more is cut, and ``truncated`` is set.
    """

    seconds: float = 10.0
    memory_bytes: int = 512 << 20
    rows: int = 10_000
    result_bytes: int = 32 << 20


@dataclass(frozen=True, slots=True, kw_only=True)
class QueryColumn:
    """A column of a result: its name, which may repeat, and DuckDB's name of its type."""

    name: str
    type: str


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class QueryResult:
    """The result of a query.

    Attributes
    ----------
    columns : tuple of QueryColumn
        Its columns.
    rows : tuple of tuple
        Values that JSON can hold: instants in ISO 8601, lists and objects as such, and None for
        NULL, NaN and infinite numbers.
    truncated : bool
        Whether rows were cut at a limit.
    elapsed_ms : float
        Time of the query inside its process.
    """

    columns: tuple[QueryColumn, ...]
    rows: tuple[tuple[Any, ...], ...]
    truncated: bool
    elapsed_ms: float


def run_query(
    snapshot: Path,
    sql: str,
    limits: QueryLimits,
    parameters: Mapping[str, Any] | None = None,
) -> QueryResult:
    """Run one query of a user on a snapshot.

    Parameters
    ----------
    snapshot : Path
        A DuckDB file that does not change.
    sql : str
        One SELECT or EXPLAIN; ``$name`` stands for a parameter.
    limits : QueryLimits
        Its limits.
    parameters : mapping, optional
        Values of its parameters, plain.

    Returns
    -------
    QueryResult
        Rows up to the limits.

    Raises
    ------
    QueryRejectedError
        If the query is not allowed, is wrong, or needs too much memory.
    QueryTimeoutError
        If it does not end within its computing time.
    QueryStarvedError
        If the machine had no time for it.

    Notes
    -----
    Takes about 0.5 s more than the query itself, for the process; 0.02 s after
    ``keep_queries_ready``.
    """
    response = _in_child(snapshot, sql, dict(parameters or {}), limits)
    if "rejected" in response:
        raise QueryRejectedError(response["rejected"])
    return QueryResult(
        columns=tuple(QueryColumn(name=name, type=kind) for name, kind in response["columns"]),
        rows=tuple(tuple(row) for row in response["rows"]),
        truncated=response["truncated"],
        elapsed_ms=response["elapsed_ms"],
    )


def keep_queries_ready() -> None:
    """Fork the processes of queries from one that has loaded DuckDB."""
    keep_ready(_MODULE, _AT_ONCE)


def to_csv(result: QueryResult) -> str:
    """Return a result as CSV (RFC 4180) with a header.

    Parameters
    ----------
    result : QueryResult
        The result of a query.

    Returns
    -------
    str
        NULL is an empty field, lists and objects are JSON. When rows were cut, the last line
        begins with ``# truncated``.
    """
    text = csv_text([column.name for column in result.columns], result.rows)
    if result.truncated:
        text += f"# truncated: only the first {len(result.rows)} rows are here\r\n"
    return text


def csv_text(names: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return plain rows as CSV (RFC 4180), lists and objects as JSON.

    Parameters
    ----------
    names : sequence of str
        Names of the columns.
    rows : iterable of sequence
        Values of each row.

    Returns
    -------
    str
        The table with its header.
    """
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(names)
    writer.writerows([_csv_field(value) for value in row] for row in rows)
    return text.getvalue()


def _csv_field(value: object) -> object:
    """Return a value as a field of CSV."""
    return json.dumps(value) if isinstance(value, list | dict | bool) else value


def _in_child(
    snapshot: Path, sql: str, parameters: Mapping[str, Any], limits: QueryLimits
) -> dict[str, Any]:
    """Return the response of a child, whose timer counts what the query itself computes."""
    bounds = Limits(
        seconds=limits.seconds + _START_MAX,
        memory_bytes=limits.memory_bytes + _HEADROOM,
        result_bytes=limits.result_bytes + _FRAME_MAX,
    )
    given = {"sql": sql, "parameters": parameters, "query_limits": asdict(limits)}
    try:
        found = run_confined(
            f"{_MODULE}:respond", snapshot, bounds, name="the query", by_path=True, **given
        )
    except FileNotFoundError as error:
        raise QueryRejectedError(f"There is no database {snapshot.name}.") from error
    except UnreadableFileError as error:
        return {"rejected": _reason(error, limits)}
    response: dict[str, Any] = json.loads(bytes(found["response"]))
    return response


def _reason(error: UnreadableFileError, limits: QueryLimits) -> str:
    """Say why a child gave no response; raise where the query is not too large."""
    if error.signal == signal.SIGALRM:
        raise _starved(limits) from error
    if error.signal == signal.SIGPROF:
        raise QueryTimeoutError(
            f"The query was ended after {limits.seconds:g} s, its time limit. "
            "Reduce it: filter earlier, aggregate, or add a LIMIT."
        ) from error
    if error.signal is None:
        logger.error("The process of a query failed: %s", error)
        raise SpheremarkError(
            "The process of the query failed; the service's log has the reason."
        ) from error
    ended = signal.Signals(error.signal).name  # by the allocator or the operating system
    return f"{_too_much_memory(limits.memory_bytes)} It ended with {ended}."


def _starved(limits: QueryLimits) -> QueryStarvedError:
    """Return the error of a query for which the machine had no time."""
    return QueryStarvedError(
        f"The query had less than {limits.seconds:g} s of computing, its time limit, within "
        f"{limits.seconds + _START_MAX:g} s: the machine is too busy. Try again later."
    )


def _too_much_memory(limit: int) -> str:
    """Return the message for a query that needed too much memory."""
    return (
        f"The query needed more than {limit >> 20} MiB, its memory limit. "
        "Reduce it: filter earlier, aggregate, or add a LIMIT."
    )


# The functions below run in the child.


def prepare() -> None:
    """Do nothing: what queries need is imported above."""


def respond(
    _file: IO[bytes],
    *,
    name: str,  # noqa: ARG001  every reader is given one
    path: str,
    sql: str,
    parameters: Mapping[str, Any],
    query_limits: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the response to a query, as JSON."""
    bounds = QueryLimits(**query_limits)
    signal.setitimer(signal.ITIMER_PROF, bounds.seconds)  # nothing handles it: it ends the process
    try:
        response = _respond(Path(path), sql, parameters, bounds)
    except (duckdb.OutOfMemoryException, MemoryError):
        response = {"rejected": _too_much_memory(bounds.memory_bytes)}
    except duckdb.Error as error:
        response = {"rejected": _shortened(str(error))}
    except QueryRejectedError as error:
        response = {"rejected": str(error)}
    except RecursionError:
        response = {"rejected": "A value of the result is nested too deeply to be read."}
    except (TypeError, ValueError) as error:
        response = {"rejected": f"The query or its result cannot be read: {_shortened(str(error))}"}
    text = json.dumps(response, allow_nan=False).encode()
    return {"response": np.frombuffer(text, np.uint8)}


def _respond(
    snapshot: Path, sql: str, parameters: Mapping[str, Any], limits: QueryLimits
) -> dict[str, Any]:
    """Run the query and return the response."""
    statement = _one_statement(sql)
    connection = _open(snapshot, limits)
    begin = perf_counter()
    relation = connection.sql(statement, params=dict(parameters) or None)
    kinds = [str(kind) for kind in relation.types]
    plain = relation.project(", ".join(_plain_sql(i, kind) for i, kind in enumerate(kinds, 1)))
    rows, truncated = _fetch(plain, kinds, limits)
    return {
        "columns": list(zip(relation.columns, kinds, strict=True)),
        "rows": rows,
        "truncated": truncated,
        "elapsed_ms": 1e3 * (perf_counter() - begin),
    }


def _open(snapshot: Path, limits: QueryLimits) -> duckdb.DuckDBPyConnection:
    """Open the snapshot read-only, without files, network and changes of the configuration."""
    connection = duckdb.connect(
        str(snapshot),
        read_only=True,
        config={
            "enable_external_access": "false",
            "autoinstall_known_extensions": "false",
            "autoload_known_extensions": "false",
            "memory_limit": f"{limits.memory_bytes}B",
            "temp_directory": "",
            "threads": "1",
        },
    )
    connection.execute("SET TimeZone = 'UTC'")
    connection.execute("SET lock_configuration = true")
    return connection


def _one_statement(sql: str) -> str:
    """Return the only statement of a text; refuse statements that do not read."""
    statements = duckdb.extract_statements(sql)
    if len(statements) != 1:
        found = "no statement" if not statements else f"{len(statements)} statements"
        raise QueryRejectedError(f"The text holds {found}; send one SELECT at a time.")
    try:
        kind = statements[0].type.name
    except ValueError:  # a kind that DuckDB's own module does not know
        kind = "This statement"
    if kind == "MULTI":
        raise QueryRejectedError(
            "Say which columns the PIVOT gives: PIVOT t ON c IN ('a', 'b') USING sum(x)."
        )
    if kind not in _KINDS:
        raise QueryRejectedError(
            f"{kind} is not possible here: the database can only be read. "
            "Use SELECT, EXPLAIN, DESCRIBE or SUMMARIZE."
        )
    return _without_end(str(statements[0].query))


def _without_end(statement: str) -> str:
    """Return a statement without its semicolon and the text behind, as a subquery needs it."""
    text = statement.encode()  # positions of tokens count bytes
    ends = [at for at, _ in duckdb.tokenize(statement) if text[at : at + 1] == b";"]
    return text[: ends[0]].decode() if ends else statement


def _plain_sql(place: int, kind: str) -> str:
    """Return SQL that makes a column text or numbers that JSON can hold."""
    if kind in _PLAIN_TYPES:
        return f"#{place}"
    if kind in _INSTANT_TYPES:
        zone = "Z" if kind == "TIMESTAMP WITH TIME ZONE" else ""
        return f"strftime(#{place}, '{_INSTANT_FORMAT}{zone}')"
    return f"CAST(to_json(#{place}) AS VARCHAR)"


def _fetch(
    relation: duckdb.DuckDBPyRelation, kinds: Sequence[str], limits: QueryLimits
) -> tuple[list[list[Any]], bool]:
    """Return rows up to the limits, and whether there were more."""
    is_json = [kind not in _PLAIN_TYPES and kind not in _INSTANT_TYPES for kind in kinds]
    rows: list[list[Any]] = []
    size = 0
    for row in relation.limit(limits.rows + 1).fetchall():
        values = [
            _finite(json.loads(value) if parse and value is not None else value)
            for value, parse in zip(row, is_json, strict=True)
        ]
        size += len(json.dumps(values))
        if len(rows) == limits.rows or size > limits.result_bytes:
            return rows, True
        rows.append(values)
    return rows, False


def _finite(value: Any) -> Any:
    """Return a value with None in place of numbers that JSON cannot hold."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, list):
        return [_finite(item) for item in value]
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    return value


def _shortened(message: str) -> str:
    """Return the beginning of a message of DuckDB."""
    text = message.strip()
    return text if len(text) <= _MESSAGE_MAX else f"{text[:_MESSAGE_MAX]} ..."
