"""What is made of a survey as files: kept by digest, listed in the table ``site_products``."""

from __future__ import annotations

import hashlib
import posixpath
import secrets
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import fsspec
import pyarrow as pa

from spheremark.pipelines.errors import NotFoundError
from spheremark.storage.catalogue.rows import Row, table_of

_TEXT, _REAL, _WHOLE = pa.string(), pa.float64(), pa.int64()
_BLOCK = 1 << 20  # bytes at a time

SCHEMA: Mapping[str, pa.DataType] = {
    **dict.fromkeys(("product_id", "job_id", "survey_id", "kind", "url", "sha256"), _TEXT),
    "size_bytes": _WHOLE,
    "n_points": _WHOLE,
    "n_stations": pa.int32(),
    "poses": _TEXT,
    "adjustment_id": _TEXT,
    **dict.fromkeys([f"{end}_{axis}_m" for end in ("min", "max") for axis in "xyz"], _REAL),
    **dict.fromkeys(("cell_m", "share_known", "sigma_median_m"), _REAL),
    **dict.fromkeys(("config_digest", "code_version"), _TEXT),
    "finished_at": pa.timestamp("us", "UTC"),
}
"""Columns of ``site_products``, in the order of the database."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KeptFile:
    """A file under the name of its digest.

    Attributes
    ----------
    url : str
        Path or URL.
    sha256 : str
        Digest of its bytes, in hexadecimal.
    size : int
        Number of its bytes.
    """

    url: str
    sha256: str
    size: int


def product_rows(rows: Sequence[Row]) -> pa.Table:
    """Return rows as the table ``site_products``.

    Parameters
    ----------
    rows : sequence of dict
        One for each product; what a row does not tell is NULL.

    Returns
    -------
    Table
        The rows.
    """
    return table_of(SCHEMA, rows)


def keep_file(path: Path, folder: str) -> KeptFile:
    """Copy a file to where files are kept, under the name of its digest.

    Parameters
    ----------
    path : Path
        A local file.
    folder : str
        Path or fsspec URL of a folder; it is made when missing.

    Returns
    -------
    KeptFile
        ``<folder>/<SHA-256><ending>``; the same bytes give the same.
    """
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    url = posixpath.join(folder, f"{digest}{path.suffix}")
    files, target = fsspec.core.url_to_fs(url)
    if not files.exists(target):
        files.makedirs(posixpath.dirname(target), exist_ok=True)
        part = f"{target}.{secrets.token_hex(4)}.part"  # nobody sees half a file
        files.put_file(str(path), part)
        files.mv(part, target)
    return KeptFile(url=url, sha256=digest, size=path.stat().st_size)


def read_file(url: str) -> Iterator[bytes]:
    """Read a kept file, a part at a time.

    Parameters
    ----------
    url : str
        What ``keep_file`` returned.

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
