"""Snapshots of the database file, for processes that do not own it."""

from __future__ import annotations

import secrets
import subprocess
import threading
from pathlib import Path
from time import monotonic, sleep

import duckdb

from spheremark.pipelines.errors import ConflictError
from spheremark.storage.files import unwritten

_PATIENCE = 10.0  # [s] to wait for readers; a static query takes milliseconds
_PAUSE = 0.002  # [s] between two tries
_N_KEPT = 3  # one may still be being opened while the next two are made
_KINDS = ("snapshot", "portable", "lent")  # first words of the names of files


class Snapshots:
    """Snapshots of one database file in a folder; those of an earlier process are deleted."""

    def __init__(self, path: Path, folder: Path) -> None:
        self._path = path
        self._folder = folder
        self._version: int | None = None
        self._converting = threading.Lock()
        folder.mkdir(parents=True, exist_ok=True)
        for stale in (one for kind in _KINDS for one in folder.glob(f"{kind}-*")):
            stale.unlink(missing_ok=True)

    def take(self, connection: duckdb.DuckDBPyConnection, version: int) -> Path:
        """Return the snapshot of a version, new if needed; the caller holds the write lock."""
        files = self._files()
        if files and version == self._version:
            return files[-1]
        _checkpoint(connection)
        number = 1 + (int(files[-1].stem.split("-")[1]) if files else 0)
        target = self._folder / f"snapshot-{number:09d}.duckdb"
        _copy(self._path, target)
        self._version = version
        for old in files[: 1 - _N_KEPT]:
            old.unlink(missing_ok=True)
        return target

    def lend(self, connection: duckdb.DuckDBPyConnection, version: int) -> Path:
        """Return a snapshot by a name of its own, which no later one removes."""
        return self._lent(self.take(connection, version))

    def lend_portable(self, snapshot: Path) -> Path:
        """Return a copy of a lent snapshot that DuckDB 1.0 can open, lent in the same way."""
        number = snapshot.stem.rpartition("-")[2]
        portable = self._folder / f"portable-{number}.duckdb"
        with self._converting:  # one at a time: others find it made
            if not portable.exists():
                _copy_portable(snapshot, portable)
            for old in self._folder.glob("portable-*.duckdb"):
                if old != portable:
                    old.unlink(missing_ok=True)
            return self._lent(portable)

    def _lent(self, copy: Path) -> Path:
        """Return a copy by another name, which ends in its number."""
        number = copy.stem.rpartition("-")[2]
        lent = self._folder / f"lent-{secrets.token_hex(8)}-{number}.duckdb"
        lent.hardlink_to(copy)
        return lent

    def _files(self) -> list[Path]:
        """Return the present snapshots, oldest first."""
        return sorted(self._folder.glob("snapshot-*.duckdb"))


def _copy_portable(snapshot: Path, target: Path) -> None:
    """Copy a snapshot in the storage version of DuckDB 1.0, which all later ones open as well."""
    part = target.with_suffix(".part")
    try:
        with duckdb.connect(config={"threads": "1", "memory_limit": "1GB"}) as connection:
            connection.execute(f"ATTACH '{_quoted(snapshot)}' AS source (READ_ONLY)")
            connection.execute(f"ATTACH '{_quoted(part)}' AS target (STORAGE_VERSION 'v1.0.0')")
            connection.execute("COPY FROM DATABASE source TO target")
            connection.execute("DETACH target")
        part.replace(target)
    except (duckdb.IOException, OSError) as error:
        raise unwritten(target, error) from error
    finally:
        part.unlink(missing_ok=True)


def _quoted(path: Path) -> str:
    """Return a path as the inside of an SQL literal."""
    return str(path).replace("'", "''")


def _checkpoint(connection: duckdb.DuckDBPyConnection) -> None:
    """Write the log into the file; DuckDB refuses while a reader is on an older state."""
    deadline = monotonic() + _PATIENCE
    while True:
        try:
            connection.execute("CHECKPOINT")
        except duckdb.TransactionException:
            if monotonic() > deadline:
                raise
            sleep(_PAUSE)
        else:
            return


def _copy(source: Path, target: Path) -> None:
    """Copy a file in another process, sharing blocks where the file system can."""
    part = target.with_suffix(".part")
    command = ["cp", "--reflink=auto", "--", str(source), str(part)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        part.unlink(missing_ok=True)
        if "No space left" in done.stderr:
            raise unwritten(part, OSError(done.stderr))
        raise ConflictError(f"No snapshot of {source} could be made: {done.stderr.strip()}.")
    part.replace(target)
