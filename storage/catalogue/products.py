"""The documents of a result, which can be downloaded, as rows."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import PurePath

import pyarrow as pa

from spheremark.storage.catalogue.rows import named
from spheremark.storage.catalogue.schema import SCHEMAS, table_of

_MEDIA_TYPES = {
    ".json": "application/json",
    ".csv": "text/csv",
    ".txt": "text/plain",
    ".xml": "application/xml",
    ".dxf": "image/vnd.dxf",
}


def documents(result_id: str, texts: Mapping[str, str]) -> pa.Table:
    """Return the downloadable files of a result as rows of ``documents``.

    Parameters
    ----------
    result_id : str
        The result that they belong to.
    texts : mapping of str to str
        Content by file name; its ending, json, csv, txt, xml or dxf, decides the media type.

    Returns
    -------
    Table
        One row for each.
    """
    values = ((name, _MEDIA_TYPES[PurePath(name).suffix], text) for name, text in texts.items())
    columns = SCHEMAS["documents"].names
    return table_of("documents", [named(columns, (result_id, *row)) for row in values])
