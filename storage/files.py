"""Files named by the SHA-256 of their bytes, in folders that are paths or fsspec URLs.

A file is written under another name and moved, so that a reader never sees a part of one.
"""

from __future__ import annotations

import errno
import hashlib
import os
import posixpath
import secrets
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import fsspec

from spheremark.pipelines.errors import NotFoundError, SpheremarkError

_BLOCK = 1 << 20  # [bytes] read at a time
_FULL = (errno.ENOSPC, errno.EDQUOT)


class StorageError(SpheremarkError):
    """The disk of the data folder cannot be written at the moment."""

    code: ClassVar[str] = "storage"


class StorageFullError(StorageError):
    """The disk of the data folder has too little free space."""

    code: ClassVar[str] = "storage.full"


def unwritten(path: Path, error: Exception) -> StorageError:
    """Return why a file could not be written.

    Parameters
    ----------
    path : Path
        The file.
    error : Exception
        What the operating system or a library said.

    Returns
    -------
    StorageError
        A ``StorageFullError`` where space ran out.
    """
    if getattr(error, "errno", None) in _FULL or "No space left" in str(error):
        return StorageFullError(
            f"The disk of {path.parent.name or path.parent} is full ({free_bytes(path):,} bytes "
            "are free). Nothing that was acknowledged is lost; free space, then try again."
        )
    return StorageError(f"{path.name} cannot be written: {str(error).strip().splitlines()[0]}")


def free_bytes(path: Path) -> int:
    """Return the free space of the disk on which a file or folder is.

    Parameters
    ----------
    path : Path
        It, or what shall be made in an existing folder.

    Returns
    -------
    int
        What this user may still write [bytes].
    """
    return shutil.disk_usage(path if path.exists() else path.parent).free


def require_free(path: Path, n_bytes: int) -> None:
    """Refuse to write what would leave too little space for the database.

    Parameters
    ----------
    path : Path
        Folder on the disk.
    n_bytes : int
        What must be free, the reserve included.

    Raises
    ------
    StorageFullError
        If less is free.
    StorageError
        If nothing may be written there.
    """
    if path.exists() and not os.access(path, os.W_OK):
        raise StorageError(
            f"{path.name} cannot be written: its disk is read-only, or the folder is not ours. "
            "Check the disk, then mount it for writing."
        )
    if (free := free_bytes(path)) < n_bytes:
        raise StorageFullError(
            f"The disk has {free:,} bytes free; {n_bytes:,} are needed, with what is kept free for "
            "the database. Free space, or use a data folder on another disk."
        )


def sync_folder(folder: Path) -> None:
    """Make the names in a folder last through a loss of power.

    Parameters
    ----------
    folder : Path
        The folder.
    """
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class Reserve:
    """Space on a disk that is kept for the database, as a file.

    Parameters
    ----------
    path : Path
        The file.
    size : int
        Its size [bytes].
    """

    def __init__(self, path: Path, size: int) -> None:
        self._path, self._size = path, size

    def hold(self) -> None:
        """Take the space, if twice as much is free and it is not taken already."""
        if self._path.exists() or free_bytes(self._path) < 2 * self._size:
            return
        with suppress(OSError), self._path.open("wb") as file:
            if sys.platform == "linux":
                os.posix_fallocate(file.fileno(), 0, self._size)
            else:
                file.writelines(bytes(_BLOCK) for _ in range(self._size // _BLOCK))

    def release(self) -> None:
        """Give the space back."""
        self._path.unlink(missing_ok=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class KeptFile:
    """Path or URL of a file, its digest in hexadecimal, and its length [bytes]."""

    url: str
    sha256: str
    size: int


def keep_file(path: Path, folder: str) -> KeptFile:
    """Copy a file into a folder, under the name of its digest.

    Parameters
    ----------
    path : Path
        A local file.
    folder : str
        Path or fsspec URL of a folder; created when missing.

    Returns
    -------
    KeptFile
        ``<folder>/<SHA-256><ending>``; the same bytes give the same.
    """
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    url = posixpath.join(folder, f"{digest}{path.suffix}")
    _put(url, lambda files, target: files.put_file(str(path), target))
    return KeptFile(url=url, sha256=digest, size=path.stat().st_size)


def keep_bytes(content: bytes, ending: str, folder: str) -> str:
    """Write bytes into a folder, under the name of their digest.

    Parameters
    ----------
    content : bytes
        The content of the file.
    ending : str
        Ending of its name, with the dot.
    folder : str
        Path or fsspec URL of a folder; created when missing.

    Returns
    -------
    str
        Path or URL of the file; the same bytes give the same.
    """
    return keep_named(content, f"{hashlib.sha256(content).hexdigest()}{ending}", folder)


def keep_named(content: bytes, name: str, folder: str) -> str:
    """Write bytes into a folder, unless there is a file of that name.

    Parameters
    ----------
    content : bytes
        The content of the file.
    name : str
        Its name.
    folder : str
        Path or fsspec URL of a folder; created when missing.

    Returns
    -------
    str
        Path or URL of the file.
    """
    url = posixpath.join(folder, name)
    _put(url, lambda files, target: files.pipe_file(target, content))
    return url


def _put(url: str, write: Callable[[Any, str], None]) -> None:
    """Create a file that does not exist yet: write a part, then move it."""
    files, target = fsspec.core.url_to_fs(url)
    if not files.exists(target):
        files.makedirs(posixpath.dirname(target), exist_ok=True)
        part = f"{target}.{secrets.token_hex(4)}.part"
        write(files, part)
        files.mv(part, target)


def read_file(url: str) -> Iterator[bytes]:
    """Read a file in blocks.

    Parameters
    ----------
    url : str
        ``url`` of a ``KeptFile``.

    Yields
    ------
    bytes
        Its bytes, in order.

    Raises
    ------
    NotFoundError
        If it is not there.
    """
    files, path = fsspec.core.url_to_fs(url)
    if not files.exists(path):
        raise NotFoundError(f"The file {url} is not there any more; make it again.")
    with files.open(path, "rb") as file:
        while block := file.read(_BLOCK):
            yield block
