"""The JSON of a query: columns with units, rows, and the limits that applied."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from spheremark.service.serialise.plain import Plain
from spheremark.storage.catalogue.records import unit_of
from spheremark.storage.catalogue.sandbox import QueryLimits, QueryResult


def serialise_query(result: QueryResult, limits: QueryLimits, snapshot: Path) -> Plain:
    """Return the result of a query on a snapshot."""
    snapshot_at = datetime.fromtimestamp(snapshot.stat().st_mtime, UTC)
    return {
        "columns": [
            {"name": one.name, "type": one.type, "unit": unit_of(one.name)}
            for one in result.columns
        ],
        "rows": [list(row) for row in result.rows],
        "truncated": result.truncated,
        "row_limit": limits.rows,
        "elapsed_ms": round(result.elapsed_ms, 3),
        "snapshot_at": snapshot_at.isoformat().replace("+00:00", "Z"),
    }
