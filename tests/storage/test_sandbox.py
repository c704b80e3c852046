import csv
import hashlib
import io
import json
import socket
from pathlib import Path

import psutil
import pytest

from spheremark.pipelines.errors import ConflictError
from spheremark.pipelines.progress import checked_by
from spheremark.storage import confined
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.catalogue.sandbox import (
    QueryLimits,
    QueryRejectedError,
    QueryStarvedError,
    QueryTimeoutError,
    keep_queries_ready,
    run_query,
    to_csv,
)
from tests.storage.hostile_queries import TEXTS

SANDBOX = "spheremark.storage.catalogue.sandbox"
LIMITS = QueryLimits(seconds=20.0, memory_bytes=256 << 20, rows=1000)


@pytest.fixture(scope="module")
def snapshot(tmp_path_factory):
    folder = tmp_path_factory.mktemp("owner")
    with Catalogue(folder / "results.duckdb", snapshots=folder / "snapshots") as catalogue:
        catalogue.create_survey("lane")
        copy = catalogue.snapshot()
        yield copy
        assert catalogue.rows("SELECT name FROM surveys") == [{"name": "lane"}]


@pytest.fixture(scope="module", autouse=True)
def ready():
    """The process from which those of queries are forked, as in the service."""
    keep_queries_ready()
    yield confined._FORKS[SANDBOX]
    confined._FORKS.pop(SANDBOX).end()


@pytest.fixture
def query(snapshot):
    def run(sql, parameters=None, **limits):
        wanted = {name: getattr(LIMITS, name) for name in QueryLimits.__slots__} | limits
        return run_query(snapshot, sql, QueryLimits(**wanted), parameters)

    return run


def test_a_select_gives_columns_with_types_and_rows(query):
    found = query("SELECT name, tolerance_m, created_at FROM surveys")
    assert [(c.name, c.type) for c in found.columns] == [
        ("name", "VARCHAR"),
        ("tolerance_m", "DOUBLE"),
        ("created_at", "TIMESTAMP WITH TIME ZONE"),
    ]
    ((name, tolerance, instant),) = found.rows
    assert (name, tolerance, found.truncated) == ("lane", 0.03, False)
    assert instant.endswith("Z")
    assert found.elapsed_ms > 0


def test_every_type_becomes_what_json_can_hold(query):
    cases = {
        "170141183460469231731687303715884105727::HUGEINT": 2**127 - 1,
        "340282366920938463463374607431768211455::UHUGEINT": 2**128 - 1,
        "18446744073709551615::UBIGINT": 2**64 - 1,
        "1000000000000000000000000000000000000000000::BIGNUM": 10**42,
        "1.25::DECIMAL(10, 2)": 1.25,
        "true": True,
        "'nan'::DOUBLE": None,
        "'-inf'::FLOAT": None,
        "NULL": None,
        "['nan'::DOUBLE, 1.5]": [None, 1.5],
        "[1, 2]::INTEGER[2]": [1, 2],
        "{'a': 1, 'b': [DATE '2026-01-02']}": {"a": 1, "b": ["2026-01-02"]},
        "MAP {'k': 1}": {"k": 1},
        "'a'::ENUM('a', 'b')": "a",
        "'{\"a\": [1]}'::JSON": {"a": [1]},
        "'z\\xAA'::BLOB": "z\\xAA",
        "'101'::BIT": "101",
        "INTERVAL '1 month 2 days'": "1 month 2 days",
        "DATE '2026-01-02'": "2026-01-02",
        "'infinity'::DATE": "infinity",
        "TIME '01:02:03.5'": "01:02:03.5",
        "TIMESTAMP '2026-01-02 03:04:05'": "2026-01-02T03:04:05.000000",
        "TIMESTAMPTZ '2026-01-02 03:04:05+01'": "2026-01-02T02:04:05.000000Z",
        "TIMESTAMP_NS '2026-01-02 03:04:05.123456789'": "2026-01-02 03:04:05.123456789",
        "'0b9c6c0a-0000-4000-8000-000000000000'::UUID": "0b9c6c0a-0000-4000-8000-000000000000",
    }
    (row,) = query("SELECT " + ", ".join(cases)).rows
    assert dict(zip(cases, row, strict=True)) == cases
    json.dumps(row, allow_nan=False)


def test_columns_of_one_name_and_the_order_of_rows_are_kept(query):
    found = query("SELECT i AS a, -i AS a FROM range(300) AS t(i) ORDER BY i DESC")
    assert [c.name for c in found.columns] == ["a", "a"]
    assert found.rows == tuple((i, -i) for i in range(299, -1, -1))


def test_parameters_are_bound(query):
    evil = "x'; DROP TABLE surveys; --"
    assert query("SELECT $a, $b + 1", {"a": evil, "b": 1}).rows == ((evil, 2),)
    with pytest.raises(QueryRejectedError, match="not provided for the following parameters: a"):
        query("SELECT $a")


def test_rows_beyond_the_limit_are_cut_and_marked(query):
    assert not query("SELECT * FROM range(1000)").truncated
    found = query("SELECT * FROM range(1000000000000)")
    assert found.truncated
    assert len(found.rows) == 1000


def test_a_result_that_is_too_long_is_cut_and_marked(query):
    found = query("SELECT repeat('x', 100000) FROM range(100)", result_bytes=1_000_000)
    assert found.truncated
    assert len(found.rows) == 9


def test_csv_has_a_header_and_marks_missing_rows(query):
    found = query("SELECT i, NULL AS n, [i] AS l, 'a,\"b' AS s FROM range(5) AS t(i)", rows=2)
    *rows, last = list(csv.reader(io.StringIO(to_csv(found))))
    assert rows == [["i", "n", "l", "s"], ["0", "", "[0]", 'a,"b'], ["1", "", "[1]", 'a,"b']]
    assert last == ["# truncated: only the first 2 rows are here"]
    assert "# truncated" not in to_csv(query("SELECT 1"))


@pytest.mark.parametrize(
    "sql",
    [
        "EXPLAIN SELECT * FROM surveys",
        "DESCRIBE marker_fits",
        "SUMMARIZE surveys",
        "FROM surveys",
        "VALUES (1)",
        "PIVOT surveys ON name IN ('lane') USING count(*)",
        "SELECT ';é€' /* ; */ ; -- and no more;",
        "SELECT 1 -- one",
    ],
)
def test_what_only_reads_is_allowed(query, sql):
    assert query(sql).rows


@pytest.mark.parametrize(
    ("sql", "reason"),
    [
        ("INSERT INTO surveys VALUES ('a', 'b', 1, now(), NULL)", "INSERT is not possible here"),
        (
            "WITH x AS (INSERT INTO surveys VALUES ('a', 'b', 1, now(), NULL) RETURNING *) FROM x",
            "read-only mode",
        ),
        ("COPY surveys TO '/tmp/stolen.csv'", "COPY is not possible here"),
        ("ATTACH ':memory:' AS other", "ATTACH is not possible here"),
        ("CREATE TEMP TABLE t AS SELECT 1", "CREATE is not possible here"),
        ("INSTALL httpfs", "not possible here"),
        ("LOAD httpfs", "LOAD is not possible here"),
        ("PRAGMA database_list", "PRAGMA is not possible here"),
        ("SET memory_limit = '90GB'", "SET is not possible here"),
        ("CHECKPOINT", "not possible here"),
        ("CALL pragma_version()", "CALL is not possible here"),
        ("SELECT * FROM read_csv('/etc/passwd')", "disabled by configuration"),
        ("SELECT * FROM '/etc/passwd'", "/etc/passwd"),
        ("SELECT * FROM read_text('/proc/self/environ')", "disabled by configuration"),
        ("SELECT * FROM glob('/*')", "disabled by configuration"),
        ("SELECT * FROM 'https://example.org/x.parquet'", "example.org"),
        ("SELECT getenv('HOME')", "getenv does not exist"),
        ("PIVOT surveys ON name USING count(*)", "Say which columns the PIVOT gives"),
        ("SELECT 1; SELECT 2", "2 statements"),
        ("", "no statement"),
        ("-- nothing", "no statement"),
        ("SELEC 1", "syntax error"),
        ("SELECT (repeat('[', 1000000) || repeat(']', 1000000))::JSON", "nested too|memory limit"),
        ("SELECT * FROM nowhere", "nowhere does not exist"),
    ],
)
def test_what_is_no_query_of_the_snapshot_is_refused(query, snapshot, sql, reason):
    before = hashlib.sha256(snapshot.read_bytes()).digest()
    with pytest.raises(QueryRejectedError, match=reason) as refusal:
        query(sql)
    assert len(str(refusal.value)) < 1000
    assert hashlib.sha256(snapshot.read_bytes()).digest() == before
    assert sorted(path.name for path in snapshot.parent.iterdir()) == [snapshot.name]


@pytest.fixture(scope="module")
def outside(tmp_path_factory):
    """Return a file that no query may read, its folder, and an address that none may reach."""
    folder = tmp_path_factory.mktemp("outside")
    file = folder / "secret.csv"
    file.write_text("a\nthe secret of this machine\n")
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.setblocking(False)
        port = listener.getsockname()[1]
        yield {"file": file, "folder": folder, "address": f"http://127.0.0.1:{port}"}
        assert list(folder.iterdir()) == [file]
        assert file.read_text() == "a\nthe secret of this machine\n"
        with pytest.raises(BlockingIOError):
            listener.accept()


@pytest.mark.slow
@pytest.mark.parametrize("text", TEXTS, ids=lambda text: text[:60])
def test_no_query_leaves_the_snapshot(query, snapshot, outside, text):
    before = hashlib.sha256(snapshot.read_bytes()).digest()
    with pytest.raises(QueryRejectedError) as refusal:
        query(text.format(**outside))
    assert "secret of this" not in str(refusal.value)
    assert hashlib.sha256(snapshot.read_bytes()).digest() == before
    assert list(outside["folder"].iterdir()) == [outside["file"]]


@pytest.mark.parametrize(
    "sql",
    [
        "SELECT repeat('x', 2000000000)",
        "SELECT list(i) FROM range(1000000000) AS t(i)",
        "SELECT repeat('x', 10000000) FROM range(100)",
        "SELECT count(*) FROM (SELECT DISTINCT hash(i) FROM range(100000000) AS t(i))",
    ],
)
def test_a_query_that_needs_too_much_memory_is_refused(query, sql):
    with pytest.raises(QueryRejectedError, match="more than 256 MiB, its memory limit"):
        query(sql)


ENDLESS = "SELECT sum(hash(a.range * b.range)) FROM range(1000000000) a, range(1000000) b"


def processes_left(ready):
    """Processes of queries that are still there a moment after their end."""
    server = psutil.Process(ready._process.pid)
    _, alive = psutil.wait_procs(server.children(), timeout=10)
    return alive


def test_a_query_that_runs_too_long_is_ended_and_its_process_gone(query, ready):
    with pytest.raises(QueryTimeoutError, match=r"ended after 0\.6 s, its time limit"):
        query(ENDLESS, seconds=0.6)
    assert not processes_left(ready)


def test_a_query_for_which_the_machine_has_no_time_is_to_be_sent_again(query, ready, monkeypatch):
    """Half a second passes before the query has had its share, as on a machine that is busy."""
    monkeypatch.setattr(f"{SANDBOX}._START_MAX", 0.5 - LIMITS.seconds)
    with pytest.raises(QueryStarvedError, match="the machine is too busy"):
        query(ENDLESS)
    assert not processes_left(ready)


def test_a_query_ends_with_the_client_that_sent_it(query, ready):
    def leave():
        raise ConflictError("the client has left")

    with checked_by(leave), pytest.raises(ConflictError, match="has left"):
        query(ENDLESS)
    assert not processes_left(ready)


def test_a_command_runs_a_query_without_a_process_that_is_kept(query, monkeypatch):
    monkeypatch.delitem(confined._FORKS, SANDBOX)
    assert query("SELECT name FROM surveys").rows == (("lane",),)
    with pytest.raises(QueryTimeoutError):
        query(ENDLESS, seconds=0.6)
    with pytest.raises(QueryRejectedError, match="disabled by configuration"):
        query("SELECT * FROM read_text('/etc/passwd')")
    assert not confined._CHILDREN


def test_the_process_of_a_query_sees_no_settings_of_the_service(query, monkeypatch):
    monkeypatch.setenv("SPHEREMARK_TOKEN", "secret")
    monkeypatch.setenv("TZ", "Asia/Tokyo")
    assert query("SELECT current_setting('TimeZone')").rows == (("UTC",),)


def test_a_missing_snapshot_is_an_error(tmp_path):
    with pytest.raises(QueryRejectedError, match="nowhere"):
        run_query(Path(tmp_path / "nowhere.duckdb"), "SELECT 1", LIMITS)


@pytest.mark.parametrize(
    ("sql", "reason"),
    [
        ("UPDATE EXTENSIONS", "can only be read"),
        ("SELECT (repeat('[', 9999) || repeat(']', 9999))::JSON", "nested too deeply"),
        (f"SELECT {'(' * 5000}1{')' * 5000}", "depth"),
        ("SELECT '\ud800'", "cannot be read"),
    ],
)
def test_what_no_query_is_gets_a_reason(query, sql, reason):
    with pytest.raises(QueryRejectedError, match=reason):
        query(sql)


def test_a_query_does_not_learn_where_the_data_folder_is(query, snapshot):
    found = query("SELECT * FROM pragma_database_list")
    assert snapshot.name in str(found.rows)
    assert str(snapshot.parent) not in str(found.rows)
    settings = query("SELECT value FROM duckdb_settings()")
    assert str(snapshot.parent) not in str(settings.rows)
