"""Figures and tables by address: which queries they need, and what is made of the rows."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
from plotly.graph_objects import Figure

from spheremark.pipelines.accuracy.tolerance import CONFIDENCE, DistanceBins, tolerance_reach
from spheremark.pipelines.errors import InputError, NotFoundError
from spheremark.service.http.state import Service
from spheremark.storage.catalogue import accuracy
from spheremark.storage.catalogue.accuracy import QUERIES, TABLES, Selection
from spheremark.web.columns import by_method
from spheremark.web.figures import accuracy as figures
from spheremark.web.figures.captions import CAPTIONS
from spheremark.web.figures.solution import heights, solution_map
from spheremark.web.links import stop_url, survey_url
from spheremark.web.pages.statements import exponents, statements

ROWS_MAX = 200_000  # of one file
MEDIA = {
    "json": "application/json",
    "csv": "text/csv",
    "parquet": "application/vnd.apache.parquet",
    "sql": "application/sql",
}
_OF_SOLUTION = ("solution", "heights")  # figures of the same rows
_PART = "SELECT * FROM ({rows}) ORDER BY {order} LIMIT $limit OFFSET $after"
_COUNT = "SELECT count(*) AS n FROM ({rows})"


@dataclass(frozen=True, slots=True, kw_only=True)
class Chosen:
    """A selection with the values of its queries."""

    selection: Selection
    values: Mapping[str, Any]
    is_log: bool = False


def choose(service: Service, selection: Selection, *, is_log: bool = False) -> Chosen:
    """Return a selection with names of surveys, and the tolerance of the survey if it is one."""
    found = [service.catalogue.get_survey(one) for one in selection.surveys]
    selection = replace(selection, surveys=tuple(one.name for one in found))
    if len(found) == 1:
        selection = replace(selection, tolerance_m=found[0].tolerance)
    values = accuracy.parameters(service.catalogue, selection)
    return Chosen(selection=selection, values=values, is_log=is_log)


def data_of(service: Service, name: str, chosen: Chosen) -> pa.Table:
    """Return the rows that a figure draws."""
    sql = _query(name)
    return service.catalogue.table(sql, accuracy.used_by(sql, chosen.values))


def figure_sql(name: str, chosen: Chosen) -> str:
    """Return the query of a figure as one runs it on the page for SQL."""
    return accuracy.as_text(_query(name), chosen.values) + "\n"


def table_sql(name: str, chosen: Chosen) -> str:
    """Return the query of a whole table as one runs it on the page for SQL."""
    sql, _ = _table(name)
    return accuracy.as_text(sql, chosen.values) + "\n"


def figure_of(service: Service, name: str, chosen: Chosen) -> dict[str, Any]:
    """Return a figure with its title and caption, and how many rows are behind it."""
    data = data_of(service, name, chosen)
    shown = figures.Shown(
        is_error=chosen.values["is_error"],
        tolerance_m=chosen.selection.tolerance_m,
        is_log=chosen.is_log,
        n_marks=chosen.selection.n_marks,
        resection=chosen.selection.resection,
    )
    figure = _drawn(service, name, data, shown, chosen)
    caption = CAPTIONS[name].format(n=accuracy.N_WORST)
    if (
        "n_all" in data.column_names
        and data.num_rows
        and (n_all := data["n_all"][0].as_py()) > data.num_rows
    ):
        caption += f" The worst {data.num_rows:,} of {n_all:,} are drawn."
    return {
        "title": str(figure.layout.title.text),
        "caption": caption,
        "n_rows": data.num_rows,
        "figure": figure.to_plotly_json(),
    }


def _drawn(
    service: Service, name: str, data: pa.Table, shown: figures.Shown, chosen: Chosen
) -> Figure:
    """Draw a figure from its rows."""
    if name == "map":
        marks = accuracy.used_by(QUERIES["marks"], chosen.values)
        columns = {one: np.asarray(data[one].to_numpy()) for one in data.column_names}
        return figures.field_map(service.catalogue.columns(QUERIES["marks"], marks), columns)
    if name in _OF_SOLUTION:
        return _solution(service, name, data, chosen)
    rows = data.to_pylist()
    if name == "distribution":
        return figures.distribution(rows, shown)
    if name == "surveys":
        return figures.surveys(rows, shown)
    return figures.binned(name, rows, shown)


def _solution(service: Service, name: str, data: pa.Table, chosen: Chosen) -> Figure:
    """Draw the stations of chosen solutions; a free network has a frame of its own."""
    stations = {one: np.asarray(data[one].to_numpy()) for one in data.column_names}
    if name == "heights":
        return heights(stations)
    marks = service.catalogue.columns(
        QUERIES["marks"], accuracy.used_by(QUERIES["marks"], chosen.values)
    )
    if "free network" in stations["solution"]:
        marks = {column: values[:0] for column, values in marks.items()}
        stations |= {f"error_{axis}_m": np.full(len(data), np.nan) for axis in "xy"}
    return solution_map(marks, stations)


def limits_of(service: Service, chosen: Chosen) -> list[dict[str, Any]]:
    """Return by method how far the tolerance is kept, from bins alone and by the error model."""
    summary = data_of(service, "distribution", chosen).to_pylist()
    reach = _reaches(service, chosen) if chosen.values["is_error"] else {}
    models = _models(service, chosen) if chosen.values["is_error"] else {}
    return [
        {
            "fit_method": row["fit_method"],
            "n": row["n"],
            "n_stops": row["n_stops"],
            "share_within": row["n_within"] / row["n"],
            "median_m": row["median_m"],
            "p95_m": row["p95_m"],
            "rms_m": row["rms_m"],
            "largest_m": row["largest_m"],
            "ratio_rms": row["ratio_rms"] if chosen.values["is_error"] else None,
            **reach.get(row["fit_method"], {}),
            **models.get(row["fit_method"], {}),
        }
        for row in summary
    ]


def _reaches(service: Service, chosen: Chosen) -> dict[str, dict[str, Any]]:
    """Return how far the tolerance is kept, from counts in ten bins of distance."""
    edges = accuracy.edges(service.catalogue, chosen.values)
    if not edges:
        return {}
    sql = QUERIES["within"]
    values = accuracy.used_by(sql, {**chosen.values, "edges_m": edges})
    found = {}
    for method, rows in by_method(service.catalogue.columns(sql, values)):
        names = {"n": "n", "n_within": "n_within", "n_scans": "n_stops"}
        names |= {name: name for name in ("kk", "kn", "nn")} | {"farthest": "range_to_m"}
        columns = {to: rows[name].astype(np.float64) for to, name in names.items()}
        reach = tolerance_reach(DistanceBins(**columns))
        found[method] = {
            "reach_m": reach.estimate,
            "reach_confident_m": reach.confident,
            "confidence": CONFIDENCE,
            "n_stops_needed": reach.scans_needed,
        }
    return found


def _models(service: Service, chosen: Chosen) -> dict[str, dict[str, Any]]:
    """Return the limits of the error model of each method, as texts with their intervals."""
    sql = QUERIES["model"]
    rows = service.catalogue.columns(sql, accuracy.used_by(sql, chosen.values))
    return {
        one.method: {
            "model_distance": one.distance,
            "model_count": one.count,
            "model_mean_distance": one.mean_distance,
            "model": exponents(one),
        }
        for one in statements(rows, chosen.selection.tolerance_m)
    }


def page_of(
    service: Service, name: str, chosen: Chosen, sort: str, after: int, limit: int
) -> pa.Table:
    """Return a part of a table; the column to sort by may begin with a minus."""
    sql, ties = _table(name)
    values = accuracy.used_by(sql, chosen.values)
    column, order = sort.removeprefix("-"), "DESC" if sort.startswith("-") else "ASC"
    if column:
        known = service.catalogue.table(f"{sql.strip()} LIMIT 0", values).column_names
        if column not in known:
            raise InputError(f"sort is {sort!r}; it must be one of {', '.join(known)}.")
    first = [f'"{column}" {order} NULLS LAST'] if column else []
    ordered = ", ".join(first + [one for one in ties if one != column])
    text = _PART.format(rows=sql.strip(), order=ordered)
    return service.catalogue.table(text, {**values, "limit": limit, "after": after})


def count_of(service: Service, name: str, chosen: Chosen) -> int:
    """Return how many rows a table has."""
    sql, _ = _table(name)
    text = _COUNT.format(rows=sql.strip())
    return int(service.catalogue.rows(text, accuracy.used_by(sql, chosen.values))[0]["n"])


def with_links(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return rows with the address of what each is about."""
    return [row | {"href": _address(row)} for row in rows]


def _address(row: Mapping[str, Any]) -> str:
    """Return the address of the survey, stop or marker of a row."""
    if "stop" not in row:
        return survey_url(row["survey"], "accuracy")
    return stop_url(row["survey"], row["stop"], row["fit_method"], row.get("marker", ""))


def as_file(table: pa.Table, kind: str) -> bytes:
    """Return rows as CSV or Parquet; columns of several values are not in a CSV."""
    sink = io.BytesIO()
    if kind == "parquet":
        pq.write_table(table, sink, compression="zstd")
    else:
        nested = [field.name for field in table.schema if pa.types.is_nested(field.type)]
        pyarrow.csv.write_csv(table.drop_columns(nested), sink)
    return sink.getvalue()


def _query(name: str) -> str:
    """Return the query of a figure."""
    if name not in CAPTIONS:
        raise NotFoundError(f"There is no figure {name!r}; there are {', '.join(CAPTIONS)}.")
    return QUERIES["solution" if name in _OF_SOLUTION else name]


def _table(name: str) -> tuple[str, tuple[str, ...]]:
    """Return the query of a table, and the columns that order its ties."""
    if name not in TABLES:
        raise NotFoundError(f"There is no table {name!r}; there are {', '.join(TABLES)}.")
    return TABLES[name]
