import hashlib
from dataclasses import replace

import duckdb
import pytest

from spheremark.storage.catalogue.migrations import (
    Migration,
    SchemaConflictError,
    migrate,
    released,
)

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
