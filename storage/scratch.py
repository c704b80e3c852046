"""Folders for temporary files, which are removed even where their process was killed."""

from __future__ import annotations

import fcntl
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir

_PREFIX, _IN_USE = "spheremark-", "in-use"  # of folders, and the file that their process locks


@contextmanager
def scratch() -> Iterator[Path]:
    """Lend a folder for temporary files.

    Yields
    ------
    Path
        The folder; it holds a file that is locked while this process lives.
    """
    while True:
        with TemporaryDirectory(prefix=_PREFIX) as name, (Path(name) / _IN_USE).open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not Path(name).exists():  # removed by another process before it was locked
                continue
            yield Path(name)
            return


def remove_abandoned() -> int:
    """Remove the folders of processes that were killed.

    Returns
    -------
    int
        Number of folders.
    """
    n_removed = 0
    for left in Path(gettempdir()).glob(f"{_PREFIX}*"):
        with suppress(OSError), (left / _IN_USE).open() as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # refused while its process lives
            shutil.rmtree(left)
            n_removed += 1
    return n_removed
