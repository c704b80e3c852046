"""Files named by the SHA-256 of their bytes, in folders that are paths or fsspec URLs.

A file is written under another name and moved, so that a reader never sees a part of one.
"""

from __future__ import annotations

import hashlib
import posixpath
import secrets
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import fsspec

from spheremark.pipelines.errors import NotFoundError

_BLOCK = 1 << 20  # [bytes] read at a time


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
    url = posixpath.join(folder, f"{hashlib.sha256(content).hexdigest()}{ending}")
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
