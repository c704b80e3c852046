import hashlib
import re
from dataclasses import replace

import duckdb
import pytest

from spheremark.storage.catalogue.migrations import (
    Migration,
    SchemaConflictError,
    migrate,
    released,
)
from spheremark.storage.catalogue.schema import SCHEMAS


def kinds(schema):
    same = {"extension<arrow.json>": "string", "list<l: string>": "list<item: string>"}
    same["list<l: double>"] = "list<item: double>"
    return [same.get(str(field.type), str(field.type)) for field in schema]


def views(connection):
    query = "SELECT view_name FROM duckdb_views() WHERE NOT internal"
    return {name for (name,) in connection.execute(query).fetchall()}


N = len(released())
NEXT = Migration(number=N + 1, name="next", sql="CREATE TABLE extra (x_m DOUBLE);")


def tables(connection):
    return {name for (name,) in connection.execute("SHOW TABLES").fetchall()}


def test_released_migrations_are_numbered_without_gaps():
    assert [m.number for m in released()] == list(range(1, len(released()) + 1))


def test_a_new_database_gets_every_migration_and_an_entry_for_each():
    connection = duckdb.connect()
    assert migrate(connection, released()) == tuple(m.number for m in released())
    query = "SELECT number, name, sha256 FROM schema_migrations ORDER BY number"
    expected = [(m.number, m.name, hashlib.sha256(m.sql.encode()).hexdigest()) for m in released()]
    assert connection.execute(query).fetchall() == expected


def test_the_columns_of_every_table_are_known_with_their_types():
    connection = duckdb.connect()
    migrate(connection, released())
    connection.execute("SET TimeZone = 'UTC'")
    assert set(SCHEMAS) == tables(connection) - {"schema_migrations"} - views(connection)
    for name, schema in SCHEMAS.items():
        found = connection.sql(f"SELECT * FROM {name}").to_arrow_table().schema  # noqa: S608
        assert found.names == schema.names, name
        assert kinds(found) == kinds(schema), name


def test_a_comment_of_the_schema_is_one_of_the_database():
    connection = duckdb.connect()
    migrate(connection, released())
    sql = "".join(one.sql for one in released())
    n_columns = len(re.findall(r"^(?:    |ALTER TABLE ).*  -- .", sql, re.M))
    query = "SELECT count(*) FROM duckdb_columns() WHERE comment IS NOT NULL"
    assert connection.execute(query).fetchall() == [(n_columns,)]
    query = "SELECT comment FROM duckdb_columns() WHERE table_name = ? AND column_name = ?"
    for table, column, expected in (
        ("control_marks", "z_m", "Centre of the sphere in the site frame, up."),
        (
            "possible_fits",
            "sigma_height_shared_m",
            "Standard deviation of the error of height that all centres of the stop share.",
        ),
        ("accuracy_by_distance", "mean_n_points", "Mean number of returns of a fit."),
        ("accuracy_by_stop", "status", "Status of the station: ok, weak or failed."),
    ):
        assert connection.execute(query, [table, column]).fetchall() == [(expected,)]


def test_a_second_opening_applies_nothing():
    connection = duckdb.connect()
    migrate(connection, released())
    assert migrate(connection, released()) == ()


def test_only_what_is_missing_is_applied():
    connection = duckdb.connect()
    migrate(connection, released())
    assert migrate(connection, (*released(), NEXT)) == (N + 1,)
    assert "extra" in tables(connection)


def test_a_changed_migration_is_refused():
    connection = duckdb.connect()
    migrate(connection, (*released(), NEXT))
    changed = replace(NEXT, sql="CREATE TABLE extra (x_deg DOUBLE);")
    with pytest.raises(
        SchemaConflictError, match=rf"{N + 1} \(next\) was applied .* in another form"
    ):
        migrate(connection, (*released(), changed))


def test_a_database_of_an_unreleased_version_is_refused():
    connection = duckdb.connect()
    (first, *_) = released()
    migrate(connection, (replace(first, name="first", sql="CREATE TABLE surveys (name VARCHAR);"),))
    with pytest.raises(SchemaConflictError, match=r"1 \(first\) .* or another data folder"):
        migrate(connection, released())
    assert tables(connection) == {"schema_migrations", "surveys"}


def test_a_database_of_a_newer_version_is_refused():
    connection = duckdb.connect()
    migrate(connection, (*released(), NEXT))
    with pytest.raises(SchemaConflictError, match="Use the newer version"):
        migrate(connection, released())


def test_a_migration_that_fails_leaves_nothing_behind():
    connection = duckdb.connect()
    broken = replace(NEXT, sql="CREATE TABLE extra (x_m DOUBLE); SELECT * FROM nowhere;")
    with pytest.raises(duckdb.CatalogException):
        migrate(connection, (*released(), broken))
    assert "extra" not in tables(connection)
    assert migrate(connection, (*released(), NEXT)) == (N + 1,)
