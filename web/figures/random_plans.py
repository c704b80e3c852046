"""Figures of the study's procedure: pass rates of random arrangements, and their cause."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import plotly.graph_objects as go

from spheremark.pipelines.published import LEAST_ANGLE, TABLE_3, WIDEST_ANGLE
from spheremark.web import theme
from spheremark.web.figures.elements import add_tolerance

_MM = 1e3  # [mm/m]


def pass_rate_by_number(results: Mapping[str, Any]) -> go.Figure:
    """Draw the share of arrangements that pass against their number of marks."""
    rows = results["by_number_of_marks"]
    figure = go.Figure(
        go.Bar(
            x=[row["n_marks"] for row in rows],
            y=[_percent(row["pass_rate"]) for row in rows],
            marker_color=theme.MUTED,
            hovertemplate="%{x} marks: %{y:.1f} % pass<extra></extra>",
        )
    )
    figure.update_xaxes(title="Number of marks", dtick=1)
    return _finished(figure, "Arrangements at random that keep the tolerance")


def pass_rate_by_angle(results: Mapping[str, Any]) -> go.Figure:
    """Draw the share of arrangements that pass against their worst included angle."""
    rows = [row for row in results["by_worst_angle"] if row["n"]]
    middles = [(row["angle_from_deg"] + row["angle_to_deg"]) / 2 for row in rows]
    figure = go.Figure(
        go.Bar(
            x=middles,
            y=[_percent(row["pass_rate"]) for row in rows],
            width=[row["angle_to_deg"] - row["angle_from_deg"] for row in rows],
            marker_color=theme.MUTED,
            customdata=[row["n"] for row in rows],
            hovertemplate="about %{x:.0f} deg: %{y:.1f} % of %{customdata:,} pass<extra></extra>",
        )
    )
    figure.update_xaxes(title="Included angle farthest from a right one [deg]")
    return _finished(figure, "The same by the worst included angle of the three marks used")


def error_by_angle(results: Mapping[str, Any]) -> go.Figure:
    """Draw the error of a position against the included angle, with what the study published."""
    rows = results["by_included_angle"]
    figure = go.Figure(
        go.Scatter(
            x=[row["included_angle_deg"] for row in rows],
            y=[_MM * row["median_error_3d_m"] for row in rows],
            mode="lines",
            name="three circles, median over signs",
            line={"color": theme.TEXT},
        )
    )
    figure.add_scatter(
        x=np.degrees(TABLE_3.included_angles),
        y=_MM * TABLE_3.errors,
        mode="markers",
        name="the study, Table 3",
        marker={"color": theme.MUTED, "symbol": "diamond", "size": 9},
    )
    add_tolerance(figure, results["tolerance_m"])
    figure.add_vrect(
        x0=float(np.degrees(LEAST_ANGLE)),
        x1=float(np.degrees(WIDEST_ANGLE)),
        line_width=0,
        fillcolor=theme.MUTED,
        opacity=0.12,
    )
    figure.update_xaxes(title="Included angle of the first two marks [deg]")
    figure.update_yaxes(title="3-D error [mm]", rangemode="tozero")
    figure.update_layout(title="What the included angle does to a position by three circles")
    figure.update_layout(template=theme.template())
    return figure


def _percent(share: float | None) -> float | None:
    """Return a share in percent."""
    return None if share is None else 100.0 * share


def _finished(figure: go.Figure, title: str) -> go.Figure:
    """Return a figure of shares with its axis and title."""
    figure.update_yaxes(title="Share that passes [%]", range=[0, 100])
    figure.update_layout(title=title, template=theme.template())
    return figure
