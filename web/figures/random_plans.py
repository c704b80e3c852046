"""Figures of the study's procedure: pass rates of random arrangements, and their cause."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from spheremark.pipelines.published import LEAST_ANGLE, TABLE_3, WIDEST_ANGLE
from spheremark.web import theme
from spheremark.web.columns import MM
from spheremark.web.figures.elements import (
    add_line,
    add_points,
    add_tolerance,
    blank_figure,
    hover_of,
)


def pass_rate_by_number(results: Mapping[str, Any]) -> go.Figure:
    """Draw the share of arrangements that pass against their number of marks."""
    rows = results["by_number_of_marks"]
    title = "Arrangements at random that keep the tolerance"
    figure = _rates(title, "Number of marks", [row["n_marks"] for row in rows], rows)
    return figure.update_xaxes(dtick=1)


def pass_rate_by_angle(results: Mapping[str, Any]) -> go.Figure:
    """Draw the share of arrangements that pass against their worst included angle."""
    rows = [row for row in results["by_worst_angle"] if row["n"]]
    middles = [(row["angle_from_deg"] + row["angle_to_deg"]) / 2 for row in rows]
    title = "The same by the worst included angle of the three marks used"
    figure = _rates(title, "Included angle farthest from a right one [deg]", middles, rows)
    widths = [row["angle_to_deg"] - row["angle_from_deg"] for row in rows]
    return figure.update_traces(width=widths)


def error_by_angle(results: Mapping[str, Any]) -> go.Figure:
    """Draw the error of a position against the included angle, with what the study published."""
    rows = results["by_included_angle"]
    figure = blank_figure(
        "What the included angle does to a position by three circles",
        "Included angle of the first two marks [deg]",
        "3-D error [mm]",
    )
    angles = [row["included_angle_deg"] for row in rows]
    errors = [MM * row["median_error_3d_m"] for row in rows]
    hover = "{y:.1f} mm at {x:.1f} deg"
    add_line(
        figure, angles, errors, theme.Style("three circles, median over signs", theme.TEXT), hover
    )
    style = theme.Style("the study, Table 3", theme.MUTED, "diamond")
    x, y = np.degrees(TABLE_3.included_angles), MM * TABLE_3.errors
    add_points(figure, x, y, style, hover, marker_size=9)
    add_tolerance(figure, results["tolerance_m"])
    low, high = np.degrees([LEAST_ANGLE, WIDEST_ANGLE]).tolist()
    figure.add_vrect(x0=low, x1=high, line_width=0, fillcolor=theme.MUTED, opacity=0.12)
    return figure.update_yaxes(rangemode="tozero")


def _rates(
    title: str, x_title: str, x: Sequence[float], rows: Sequence[Mapping[str, Any]]
) -> go.Figure:
    """Draw the shares of classes of arrangements that pass."""
    figure = blank_figure(title, x_title, "Share that passes [%]")
    shares = [None if row["pass_rate"] is None else 100.0 * row["pass_rate"] for row in rows]
    counts = {"n": np.array([row["n"] for row in rows])}
    hover = hover_of("{x:.0f}: {y:.1f} % of {n:,.0f} pass", theme.Style("", theme.MUTED), counts)
    figure.add_bar(x=x, y=shares, marker_color=theme.MUTED, **hover)
    return figure.update_yaxes(range=[0, 100])
