"""Upkeep of a data folder: its faults, what ended processes left, backups, and back again.

Every file that a row names is never changed, so that a copy of the database and then of its files
is consistent whatever the service does meanwhile.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
import posixpath
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ClassVar

import duckdb

from spheremark.pipelines.errors import ConflictError, InputError
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.catalogue.migrations import released
from spheremark.storage.files import sync_folder, unwritten

logger = logging.getLogger(__name__)

MANIFEST = "manifest.json"
_DATABASE = "results.duckdb"  # in a backup
_FORMAT = "spheremark-backup/1"
_REPORTS = ("coverage.json", "coverage.csv", "worlds.json")
_RESULT_LOGS = "clouds/*.mcap"  # each called after its run
_MADE_AGAIN = ("clouds/*", "terrains/*", "octrees/*.part")  # by a job or an upload
_SET_ASIDE = "recordings/.damaged/*"
_SEARCHES = "searches/*.json"
_URLS = (
    ("recordings", "url"),
    ("terrains", "url"),
    ("stops", "cloud_url"),
    ("site_products", "url"),
)
_FILES = """
SELECT 'recordings' AS of, url, recording_id AS sha256, size_bytes FROM recordings
UNION ALL SELECT 'terrains', url, NULL, NULL FROM terrains
UNION ALL SELECT DISTINCT 'stops', cloud_url, NULL, NULL FROM stops WHERE cloud_url IS NOT NULL
UNION ALL SELECT DISTINCT 'site_products', url, sha256, size_bytes FROM site_products
"""
_OLDEST_RUNNING = "SELECT min(epoch(started_at)) FROM jobs WHERE status = 'running'"
_PARENTS = (
    ("runs", "recording_id", "recordings"),
    ("runs", "survey_id", "surveys"),
    *((name, "run_id", "runs") for name in ("stops", "marker_fits", "station_fixes")),
    *((name, "run_id", "runs") for name in ("rejections", "observations", "resections")),
    *((name, "run_id", "runs") for name in ("group_likelihoods", "possible_fits")),
    *((f"adjusted_{name}", "adjustment_id", "adjustments") for name in ("stations", "marks")),
    *((f"mark_{name}", "adjustment_id", "adjustments") for name in ("decisions", "evidence")),
    ("planned_stops", "placement_id", "plans"),
)
_LOST = "SELECT count(*) FROM {child} WHERE {key} NOT IN (SELECT {key} FROM {parent})"
_SCHEMA = "SELECT number, sha256 FROM schema_migrations ORDER BY number"


class DamagedBackupError(InputError):
    """A backup is incomplete, or one of its files is not what was copied."""

    code: ClassVar[str] = "input.backup"


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """Something that is wrong with a data folder: its kind, where, and what to do."""

    kind: str
    place: str
    advice: str


@dataclass(frozen=True, slots=True, kw_only=True)
class _File:
    """A file that a row names, with its digest and size where the row has them."""

    table: str
    path: Path
    sha256: str | None
    size: int | None


def examine(database: Path, data: Path, served_at: float = math.inf) -> list[Finding]:
    """Examine a data folder against a copy of its database.

    Parameters
    ----------
    database : Path
        A snapshot or an export; it is only read.
    data : Path
        The data folder.
    served_at : float
        When the copy was requested, where a service goes on using the folder [s since 1970]: what
        its running jobs have written is no fault.

    Returns
    -------
    list of Finding
        What is wrong; empty where nothing is.
    """
    try:
        with duckdb.connect(str(database), read_only=True) as connection:
            files = list(_files(connection))
            found = [*_schema_findings(connection), *_row_findings(connection)]
            abandoned = _abandoned(connection, data)
            if served_at < math.inf:
                ((begin,),) = connection.execute(_OLDEST_RUNNING).fetchall()
                before = min(served_at, begin or math.inf)
                abandoned = [path for path in abandoned if path.stat().st_mtime < before]
    except duckdb.Error as error:
        advice = f"{str(error).splitlines()[0]}. Check the disk, and restore the newest backup."
        return [Finding(kind="database.damaged", place=str(database), advice=advice)]
    for file in files:
        found += _file_findings(file)
    known = {file.path.name for file in files}
    logs = (path for path in (data / "recordings").glob("*") if path.is_file())
    found += [_unknown(path, _ENTERED) for path in sorted(logs) if path.name not in known]
    found += [_unknown(path, _REMOVED) for path in abandoned]
    for path in sorted(data.glob(_SET_ASIDE)):
        advice = "Its bytes are not those of its digest: upload the log again, then remove this."
        found.append(Finding(kind="recordings.set_aside", place=str(path), advice=advice))
    if data.stat().st_mode & 0o077:
        advice = f"Others can read it; chmod 700 {data.name}."
        found.append(Finding(kind="permissions", place=str(data), advice=advice))
    return found


_ENTERED = "The service is reading it, or enters it at its next start."
_REMOVED = "An ended process left it; the next start of the service removes it, or doctor --mend."


def _unknown(path: Path, advice: str) -> Finding:
    """Return the finding of a file without a row."""
    return Finding(kind=f"{path.parent.name}.without_row", place=str(path), advice=advice)


def _abandoned(connection: duckdb.DuckDBPyConnection, data: Path) -> list[Path]:
    """Return files that no row names and that can be made again.

    Files are compared by name, a digest or the id of a run: the folder may have been moved.
    """
    known = {posixpath.basename(row[1]) for row in connection.execute(_FILES).fetchall()}
    known |= {path.name for path in _result_logs(connection, data)}
    paths = (path for pattern in _MADE_AGAIN for path in data.glob(pattern))
    return sorted(path for path in paths if path.is_file() and path.name not in known)


def remove_abandoned(catalogue: Catalogue, data: Path) -> int:
    """Remove the files of results that ended processes left; to be called before any job begins.

    Parameters
    ----------
    catalogue : Catalogue
        The open database of the folder.
    data : Path
        The data folder.

    Returns
    -------
    int
        Number of files.
    """
    with catalogue.reading() as cursor:
        abandoned = _abandoned(cursor, data)
    try:
        for path in abandoned:
            path.unlink()
    except OSError as error:  # a disk that is read-only for now is no reason not to serve
        logger.warning("%s cannot be removed: %s", error.filename, error.strerror)
    if abandoned:
        logger.warning("Removed %d files that ended processes left.", len(abandoned))
    return len(abandoned)


def mend(findings: list[Finding]) -> list[Finding]:
    """Remove files without rows that can be made again.

    Parameters
    ----------
    findings : list of Finding
        Those of ``examine``, of a data folder that no service uses.

    Returns
    -------
    list of Finding
        Those that are left.
    """
    left = []
    for one in findings:
        if one.advice == _REMOVED:
            Path(one.place).unlink(missing_ok=True)
        elif one.kind == "permissions":
            Path(one.place).chmod(0o700)
        else:
            left.append(one)
    return left


def back_up(database: Path, data: Path, target: Path) -> int:
    """Copy a data folder; files that the target has already are not copied again.

    Parameters
    ----------
    database : Path
        A copy of its database.
    data : Path
        The data folder.
    target : Path
        Folder of the backup; created when missing.

    Returns
    -------
    int
        Number of files in the backup.

    Raises
    ------
    InputError
        If a file that a row names is not there, or not what it was.
    StorageError
        If the target cannot be written.
    """
    with duckdb.connect(str(database), read_only=True) as connection:
        paths = {file.path: file.sha256 for file in _files(connection)}
        paths |= dict.fromkeys(_result_logs(connection, data))
    paths |= {data / name: None for name in _REPORTS if (data / name).exists()}
    paths |= dict.fromkeys(one for one in data.glob(_SEARCHES) if _has_ended(one))
    entries: dict[str, dict[str, Any]] = {}
    try:
        target.mkdir(parents=True, exist_ok=True, mode=0o700)
        for path, expected in paths.items():
            name = (
                str(path.relative_to(data)) if path.is_relative_to(data) else f"other/{path.name}"
            )
            digest = _copied(path, target / name)
            if expected not in (None, digest):
                raise InputError(f"{path} is damaged: its SHA-256 is {digest}, not {expected}.")
            entries[name] = {"sha256": digest, "size": (target / name).stat().st_size}
        entries[_DATABASE] = {"sha256": _copied(database, target / _DATABASE, is_new=True)}
        about = {
            "format": _FORMAT,
            "made_at": datetime.now(UTC).isoformat(timespec="seconds"),
            "data": str(data),
            "files": entries,
        }
        part = target / f"{MANIFEST}.part"
        part.write_text(json.dumps(about, indent=1), encoding="utf-8")
        part.replace(target / MANIFEST)
        sync_folder(target)
    except FileNotFoundError as error:
        raise InputError(f"{error.filename} is not there; run `spheremark doctor`.") from error
    except OSError as error:
        raise unwritten(target, error) from error
    return len(entries)


def restore(source: Path, data: Path) -> int:
    """Make a data folder of a backup, whose files are compared with their digests first.

    Parameters
    ----------
    source : Path
        Folder of the backup.
    data : Path
        The new data folder.

    Returns
    -------
    int
        Number of files.

    Raises
    ------
    DamagedBackupError
        If a file is missing or not what was copied.
    ConflictError
        If the folder holds a database already.
    """
    database = data / "spheremark.duckdb"
    if database.exists():
        raise ConflictError(f"{data} has a database already; restore into another folder.")
    about = _manifest(source)
    for name, entry in about["files"].items():
        if not (source / name).is_file() or _digest(source / name) != entry["sha256"]:
            raise DamagedBackupError(f"{name} is missing or damaged in the backup {source}.")
    data.mkdir(parents=True, exist_ok=True, mode=0o700)
    for name in about["files"]:
        _copied(source / name, database if name == _DATABASE else data / name)
    with Catalogue(database, snapshots=data / "snapshots") as catalogue:
        _relocate(catalogue, about["data"], str(data.resolve()))
    return len(about["files"])


def _relocate(catalogue: Catalogue, before: str, after: str) -> None:
    """Let rows name the files of another folder."""
    with catalogue.writing() as cursor:
        for table, column in _URLS:
            cursor.execute(
                f"UPDATE {table} SET {column} = $after || substr({column}, length($before) + 1) "  # noqa: S608
                f"WHERE starts_with({column}, $before || '/')",
                {"before": before, "after": after},
            )


def _manifest(source: Path) -> dict[str, Any]:
    """Return the manifest of a backup, with no file outside it."""
    try:
        about: dict[str, Any] = json.loads((source / MANIFEST).read_text("utf-8"))
        files: Mapping[str, Any] = about["files"]
        is_ours = about["format"] == _FORMAT and _DATABASE in files
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DamagedBackupError(f"{source} is no backup of spheremark: {error}.") from error
    inside = all(not Path(name).is_absolute() and ".." not in Path(name).parts for name in files)
    if not is_ours or not inside:
        raise DamagedBackupError(f"{source} is no backup that this version of spheremark reads.")
    return about


def _files(connection: duckdb.DuckDBPyConnection) -> Iterator[_File]:
    """Yield the local files that rows name."""
    for table, url, sha256, size in connection.execute(_FILES).fetchall():
        if "://" not in url:
            yield _File(table=table, path=Path(url), sha256=sha256, size=size)


def _result_logs(connection: duckdb.DuckDBPyConnection, data: Path) -> list[Path]:
    """Return the logs of the results of runs."""
    runs = {run for (run,) in connection.execute("SELECT run_id FROM runs").fetchall()}
    return [path for path in data.glob(_RESULT_LOGS) if path.stem in runs]


def _has_ended(search: Path) -> bool:
    """Return whether a search of plans has ended, so that its file does not change any more."""
    try:
        return bool(json.loads(search.read_text("utf-8"))["status"] != "running")
    except (FileNotFoundError, ValueError, KeyError, TypeError):  # removed just now, or damaged
        return False


def _file_findings(file: _File) -> Iterator[Finding]:
    """Yield what is wrong with a file."""
    if not file.path.is_file():
        advice = "Restore it from a backup, or upload it again."
        yield Finding(kind=f"{file.table}.missing", place=str(file.path), advice=advice)
    elif file.size not in (None, file.path.stat().st_size) or (
        file.sha256 is not None and _digest(file.path) != file.sha256
    ):
        advice = "It was changed on disk: restore it from a backup, and test the disk."
        yield Finding(kind=f"{file.table}.damaged", place=str(file.path), advice=advice)


def _row_findings(connection: duckdb.DuckDBPyConnection) -> Iterator[Finding]:
    """Yield tables with rows that belong to nothing."""
    for child, key, parent in _PARENTS:
        sql = _LOST.format(child=child, key=key, parent=parent)
        ((n,),) = connection.execute(sql).fetchall()
        if n:
            advice = f"{n} rows belong to no row of {parent}; restore a backup, and report this."
            yield Finding(kind="rows.lost", place=child, advice=advice)


def _schema_findings(connection: duckdb.DuckDBPyConnection) -> Iterator[Finding]:
    """Yield the difference of the schema to the one of this version."""
    expected = [(one.number, one.sha256) for one in released()]
    if connection.execute(_SCHEMA).fetchall() != expected:
        advice = "Use the version of spheremark that made the database."
        yield Finding(kind="schema", place="schema_migrations", advice=advice)


def _digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _copied(source: Path, target: Path, *, is_new: bool = False) -> str:
    """Copy a file, unless the same is there, and return its SHA-256."""
    digest = _digest(source)
    if is_new or not target.exists() or _digest(target) != digest:
        target.parent.mkdir(parents=True, exist_ok=True)
        part = target.with_name(f"{target.name}.part")
        shutil.copyfile(source, part)
        with part.open("rb") as file:
            os.fsync(file.fileno())
        part.chmod(0o600)
        part.replace(target)
        sync_folder(target.parent)
    return digest
