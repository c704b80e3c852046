"""The page for queries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import plotly.graph_objects as go
from markupsafe import Markup

from spheremark.web import theme
from spheremark.web.pages.base import Frame, Row
from spheremark.web.templating import render

EXAMPLES: tuple[tuple[str, str], ...] = (
    (
        "Error by distance",
        "SELECT fit_method, range_from_m, n_errors,\n"
        "    round(error_3d_rms_m * 1000, 1) AS rms_mm,\n"
        "    round(error_3d_p95_m * 1000, 1) AS p95_mm,\n"
        "    round(sigma_3d_rms_m * 1000, 1) AS predicted_mm\n"
        "FROM accuracy_by_distance\nORDER BY fit_method, range_from_m;",
    ),
    (
        "Worst markers",
        "SELECT survey, stop, marker, mark, fit_method, range_m, n_points,\n"
        "    coalesce(error_3d_m, sigma_3d_m) * 1000 AS error_or_sigma_mm, status, reason\n"
        "FROM latest_marker_fits\nORDER BY error_or_sigma_mm DESC\nLIMIT 20;",
    ),
    (
        "Stations",
        "SELECT survey, stop, fit_method, x_m, y_m, z_m,\n"
        "    sigma_3d_m * 1000 AS sigma_mm, error_3d_m * 1000 AS error_mm, n_markers, sigma0\n"
        "FROM latest_station_fixes\nORDER BY survey, stop, fit_method;",
    ),
    (
        "Error by included angle",
        "SELECT fit_method, included_angle_from_deg, n_resections,\n"
        "    error_3d_rms_m * 1000 AS rms_mm, sigma_3d_rms_m * 1000 AS predicted_mm,\n"
        "    resection_method, n_marks\n"
        "FROM accuracy_by_included_angle\n"
        "ORDER BY n_marks, resection_method, fit_method, included_angle_from_deg;",
    ),
    (
        "Errors against sigmas",
        "SELECT survey, fit_method, count(error_3d_m) AS n,\n"
        "    sqrt(avg(error_3d_m ^ 2)) * 1000 AS error_rms_mm,\n"
        "    sqrt(avg(sigma_3d_m ^ 2)) * 1000 AS predicted_mm,\n"
        "    sqrt(avg(error_3d_m ^ 2) / avg(sigma_3d_m ^ 2)) AS error_over_sigma\n"
        "FROM latest_marker_fits\nWHERE error_3d_m IS NOT NULL\nGROUP BY ALL\nORDER BY ALL;",
    ),
    (
        "Time of each step",
        "SELECT stop, n_returns, timings_s\nFROM stops\nORDER BY stop;",
    ),
)
"""Example queries by title."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SqlQuery:
    """The query of an address: its text, the values of its parameters, and its name if kept."""

    text: str = ""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    name: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Schema:
    """Tables and views: the panel that shows them, and the columns of each by name."""

    panel: Markup
    names: Mapping[str, Sequence[str]]


def schema_of(tables: Sequence[Row]) -> Schema:
    """Render tables and views, which are the same for all who open the page."""
    return Schema(
        panel=Markup(render("schema.html", tables=tables)),
        names={table["name"]: [row["name"] for row in table["columns"]] for table in tables},
    )


def sql_page(
    frame: Frame,
    query: SqlQuery,
    schema: Schema,
    limits: Mapping[str, Any],
    saved: Sequence[Row] = (),
) -> str:
    """Return the page for queries: schema, limits, and the query of the address."""
    return render(
        "sql.html",
        frame=frame,
        query=query.text or EXAMPLES[0][1],
        name=query.name,
        parameters=dict(query.parameters),
        saved=saved,
        schema=schema,
        limits=limits,
        examples=EXAMPLES,
        chart_template=_chart_template(),
    )


@cache
def _chart_template() -> dict[str, Any]:
    """Return what charts of results look like."""
    layout = go.Figure(layout={"template": theme.template()}).to_plotly_json()["layout"]
    colours = {name: theme.method_style(name).colour for name in ("along_beam", "paper")}
    return {"layout": layout, "colours": colours}
