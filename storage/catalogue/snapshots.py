"""Copies of the database file for everybody who is not its owner."""

from __future__ import annotations

import subprocess
from pathlib import Path
from time import monotonic, sleep

import duckdb

from spheremark.pipelines.errors import ConflictError

_PATIENCE = 10.0  # [s] to wait for readers: a query of ours takes milliseconds
_PAUSE = 0.002  # [s] between two tries
_N_KEPT = 3  # one may still be being opened while the next two are made


class Snapshots:
    """The copies of one database file in a folder of their own.

    Parameters
    ----------
    path : Path
        The database file.
    folder : Path
        Where the copies go; made when missing, and emptied of copies from an earlier life.
    """

    def __init__(self, path: Path, folder: Path) -> None:
        self._path = path
        self._folder = folder
        self._version: int | None = None
        folder.mkdir(parents=True, exist_ok=True)
        for stale in self._files():
            stale.unlink(missing_ok=True)

    def take(self, connection: duckdb.DuckDBPyConnection, version: int) -> Path:
        """Return the newest copy if it has this version, else make it; the caller holds writers."""
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

    def _files(self) -> list[Path]:
        """Return the copies that are there, oldest first."""
        return sorted(self._folder.glob("snapshot-*.duckdb"))


def _checkpoint(connection: duckdb.DuckDBPyConnection) -> None:
    """Write everything into the file; DuckDB refuses while somebody still reads an older state."""
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
    """Copy a file in a process of its own, sharing blocks where the file system can."""
    part = target.with_suffix(".part")
    command = ["cp", "--reflink=auto", "--", str(source), str(part)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise ConflictError(f"No snapshot of {source} could be made: {done.stderr.strip()}.")
    part.replace(target)
