"""Files that a result can be downloaded as, kept as rows: written with it, or not at all."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import PurePath

import pyarrow as pa

from spheremark.storage.catalogue.rows import table_of

_COLUMNS = dict.fromkeys(("result_id", "name", "media_type", "text"), pa.string())
_MEDIA_TYPES = {
    ".json": "application/json",
    ".csv": "text/csv",
    ".txt": "text/plain",
    ".xml": "application/xml",
}


def documents(result_id: str, texts: Mapping[str, str]) -> pa.Table:
    """Return files as rows of ``documents``.

    Parameters
    ----------
    result_id : str
        The result that they belong to.
    texts : mapping of str to str
        What each file holds, by its name, whose ending tells its type: json, csv, txt or xml.

    Returns
    -------
    Table
        One row for each.
    """
    rows = [
        {
            "result_id": result_id,
            "name": name,
            "media_type": _MEDIA_TYPES[PurePath(name).suffix],
            "text": text,
        }
        for name, text in texts.items()
    ]
    return table_of(_COLUMNS, rows)
