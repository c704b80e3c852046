"""The page on the coverage of error ellipses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import plotly.graph_objects as go

from spheremark.web import theme
from spheremark.web.figures.elements import add_line, add_points, blank_figure, hover_of
from spheremark.web.pages.base import Frame, Panel
from spheremark.web.templating import render

_LABELS = {
    "free_station": "each station alone",
    "network": "network",
    "horizontal": "horizontal ellipse (2-D)",
    "position": "ellipsoid (3-D)",
    "pose": "pose with heading and levelling (6-D)",
}
_STYLES = {
    "free_station": theme.Style(_LABELS["free_station"], theme.OURS),
    "network": theme.Style(_LABELS["network"], theme.PAPER, "diamond"),
}
_CURVES = (
    "Share of stations inside, against the nominal share; the band is five points wide each way, "
    "bars are 95 % intervals."
)
_SQUARES = (
    "Squared error in units of the covariance; the line is the chi-square distribution that "
    "covariances of the right size give."
)
_WITHIN = 0.05  # by which a share may be off


def coverage_page(frame: Frame, report: Mapping[str, Any]) -> str:
    """Return the page of a report of many simulated surveys."""
    return render(
        "coverage.html",
        frame=frame,
        report=report,
        panels=_panels(report),
        labels=_LABELS,
        rows=report["nees"],
        is_released=report.get("is_released", False),
        is_of=_is_of,
        within=_WITHIN,
    )


def _panels(report: Mapping[str, Any]) -> list[Panel]:
    """Return curves of shares, then histograms of squared errors, for each quantity."""
    quantities = ("horizontal", "position")
    curves = [Panel(f"curve-{q}", calibration_figure(report, q), _CURVES) for q in quantities]
    return curves + [Panel(f"squares-{q}", squares_figure(report, q), _SQUARES) for q in quantities]


def calibration_figure(report: Mapping[str, Any], quantity: str) -> go.Figure:
    """Draw found shares against nominal ones."""
    title = f"Coverage: {_LABELS[quantity]}"
    figure = blank_figure(title, "Nominal share [%]", "Stations inside [%]")
    ends = np.array([0.0, 100.0, 100.0, 0.0])
    band = ends + 100 * _WITHIN * np.array([-1, -1, 1, 1])
    area = {"fill": "toself", "fillcolor": theme.SHADE, "line_width": 0}
    add_line(figure, ends, band, theme.Style("within 5 points", theme.SHADE), **area)
    for method, style in _STYLES.items():
        rows = [one for one in report["curve"] if _is_of(one, method, quantity)]
        names = ("level", "share", "low", "high")
        level, share, low, high = (np.array([100 * row[name] for row in rows]) for name in names)
        bars = {"symmetric": False, "array": high - share, "arrayminus": share - low}
        bars |= {"thickness": 1, "width": 0}
        hover = "nominal {x:.0f} %, found {y:.1f} %"
        add_points(figure, level, share, style, hover, error_y=bars)
    figure.update_xaxes(range=[0, 101])
    return figure.update_yaxes(range=[0, 103])


def squares_figure(report: Mapping[str, Any], quantity: str) -> go.Figure:
    """Draw the distribution of squared errors, and that of chi-square."""
    from scipy.stats import chi2  # slow to import

    title = f"Squared errors: {_LABELS[quantity]}"
    figure = blank_figure(title, "Squared error in units of its covariance", "Density")
    edges = np.array(report["bins"])
    middle, width = (edges[1:] + edges[:-1]) / 2, float(edges[1] - edges[0])
    rows = [row for row in report["nees"] if row["quantity"] == quantity]
    for row in rows:
        style, counts = _STYLES[row["method"]], np.array(row["counts"], dtype=np.float64)
        density = counts / max(counts.sum(), 1.0) / width
        hover = hover_of("square {x:.2f}, density {y:.3f}", style)
        look = {"marker": {"color": style.colour, "line": {"width": 0}}, "opacity": 0.55}
        figure.add_bar(x=middle, y=density, width=width, name=style.label, **(look | hover))
    x, dimensions = np.linspace(0.02, edges[-1], 300), rows[0]["dimensions"] if rows else 2
    style = theme.Style(f"chi-square, {dimensions} dimensions", theme.TEXT)
    add_line(figure, x, chi2.pdf(x, dimensions), style, line_width=2)
    figure.update_layout(barmode="overlay")
    return figure.update_xaxes(range=[0, 14])


def _is_of(row: Mapping[str, Any], method: str, quantity: str) -> bool:
    """Whether a row of a report is of a method and a quantity."""
    return (row["method"], row["quantity"]) == (method, quantity)
