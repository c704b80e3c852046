"""Rows of files: the products of a whole survey, and the documents of one result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import PurePath

import pyarrow as pa

from spheremark.storage.catalogue.rows import Row, table_of

_TEXT, _REAL, _WHOLE = pa.string(), pa.float64(), pa.int64()

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

_DOCUMENT = dict.fromkeys(("result_id", "name", "media_type", "text"), _TEXT)
_MEDIA_TYPES = {
    ".json": "application/json",
    ".csv": "text/csv",
    ".txt": "text/plain",
    ".xml": "application/xml",
}


def product_rows(rows: Sequence[Row]) -> pa.Table:
    """Return rows as the table ``site_products``.

    Parameters
    ----------
    rows : sequence of dict
        One for each product; a missing column is NULL.

    Returns
    -------
    Table
        The rows.
    """
    return table_of(SCHEMA, rows)


def documents(result_id: str, texts: Mapping[str, str]) -> pa.Table:
    """Return the downloadable files of a result as rows of ``documents``.

    Parameters
    ----------
    result_id : str
        The result that they belong to.
    texts : mapping of str to str
        Content by file name; its ending, json, csv, txt or xml, decides the media type.

    Returns
    -------
    Table
        One row for each.
    """
    values = ((name, _MEDIA_TYPES[PurePath(name).suffix], text) for name, text in texts.items())
    return table_of(
        _DOCUMENT, [dict(zip(_DOCUMENT, (result_id, *row), strict=True)) for row in values]
    )
