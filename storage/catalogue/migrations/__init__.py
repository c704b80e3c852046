"""The schema of the database as numbered SQL files, and the rule by which they are applied.

A file is called ``<four digits>_<name>.sql`` and never changes once released: the digest of each
one that was applied is kept in ``schema_migrations`` and compared at every opening.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import resources
from typing import ClassVar

import duckdb

from spheremark.pipelines.errors import ConflictError
from spheremark.storage.catalogue.schema import comments

_LEDGER = """
CREATE TABLE IF NOT EXISTS schema_migrations (
    number INTEGER PRIMARY KEY,
    name VARCHAR NOT NULL,
    sha256 VARCHAR NOT NULL,
    applied_at TIMESTAMPTZ NOT NULL
);
COMMENT ON TABLE schema_migrations IS 'Which numbered files of the schema were applied, and when.';
"""


class SchemaConflictError(ConflictError):
    """The database was made by another version of spheremark."""

    code: ClassVar[str] = "conflict.schema"


@dataclass(frozen=True, slots=True, kw_only=True)
class Migration:
    """One numbered step of the schema, from 1: its name and its statements."""

    number: int
    name: str
    sql: str

    @property
    def sha256(self) -> str:
        """SHA-256 of the statements, in hexadecimal."""
        return hashlib.sha256(self.sql.encode()).hexdigest()


def released() -> tuple[Migration, ...]:
    """Return the migrations of this version.

    Returns
    -------
    tuple of Migration
        In order.
    """
    files = (f for f in resources.files(__name__).iterdir() if f.name.endswith(".sql"))
    return tuple(
        Migration(
            number=int(file.name[:4]),
            name=file.name[5:].removesuffix(".sql"),
            sql=file.read_text(encoding="utf-8"),
        )
        for file in sorted(files, key=lambda file: file.name)
    )


def migrate(
    connection: duckdb.DuckDBPyConnection, migrations: tuple[Migration, ...]
) -> tuple[int, ...]:
    """Apply the missing migrations to a database and return their numbers."""
    connection.execute(_LEDGER)
    applied = {
        int(number): (str(name), str(sha256))
        for number, name, sha256 in connection.execute(
            "SELECT number, name, sha256 FROM schema_migrations ORDER BY number"
        ).fetchall()
    }
    _check(applied, {migration.number: migration for migration in migrations})
    missing = [migration for migration in migrations if migration.number not in applied]
    for migration in missing:
        _apply(connection, migration)
    return tuple(migration.number for migration in missing)


def _check(applied: dict[int, tuple[str, str]], known: dict[int, Migration]) -> None:
    """Refuse a database whose applied migrations are unknown or changed."""
    for number, (name, sha256) in applied.items():
        if number not in known:
            raise SchemaConflictError(
                f"The database has the schema change {number} ({name}), which this version of "
                f"spheremark does not know: it ends at {max(known, default=0)}. "
                "Use the newer version that made the database, or another data folder."
            )
        if known[number].sha256 != sha256:
            raise SchemaConflictError(
                f"The schema change {number} ({name}) was applied to the database in another form "
                f"than this version of spheremark has ({sha256[:12]}, not "
                f"{known[number].sha256[:12]}). Use the version that made the database, or "
                "another data folder."
            )


def _apply(connection: duckdb.DuckDBPyConnection, migration: Migration) -> None:
    """Apply one migration and its entry in the ledger, both or neither."""
    connection.execute("BEGIN")
    try:
        connection.execute(migration.sql + comments(migration.sql))
        connection.execute(
            "INSERT INTO schema_migrations VALUES (?, ?, ?, ?)",
            [migration.number, migration.name, migration.sha256, datetime.now(UTC)],
        )
        connection.execute("COMMIT")
    except BaseException:
        connection.execute("ROLLBACK")
        raise
