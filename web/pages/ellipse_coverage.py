"""The page on the coverage of error ellipses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import plotly.graph_objects as go
from scipy.stats import chi2

from spheremark.web import theme
from spheremark.web.figures.elements import blank_figure
from spheremark.web.pages.base import Frame, Panel
from spheremark.web.templating import render

_LABELS = {
    "free_station": "each station alone",
    "network": "network",
    "horizontal": "horizontal ellipse (2-D)",
    "position": "ellipsoid (3-D)",
    "pose": "pose with heading and levelling (6-D)",
}
_STYLES = {"free_station": (theme.OURS, "circle"), "network": (theme.PAPER, "diamond")}
_WITHIN = 0.05  # by which a share may be off


@dataclass(frozen=True, slots=True, kw_only=True)
class CoveragePage:
    """A report of many simulated surveys, if there is one."""

    frame: Frame
    report: Mapping[str, Any] | None


def coverage_page(page: CoveragePage) -> str:
    """Return the page."""
    report = page.report
    return render(
        "coverage.html",
        page,
        here="coverage",
        panels=() if report is None else _panels(report),
        labels=_LABELS,
        rows=() if report is None else _rows(report),
        within=_WITHIN,
    )


def _panels(report: Mapping[str, Any]) -> list[Panel]:
    """Return curves of shares, then histograms of squared errors, for each quantity."""
    quantities = ("horizontal", "position")
    curves = [
        Panel(
            name=f"curve-{quantity}",
            figure=calibration_figure(report, quantity),
            caption="Share of stations inside, against the nominal share; the band is five points "
            "wide each way, bars are 95 % intervals.",
        )
        for quantity in quantities
    ]
    histograms = [
        Panel(
            name=f"squares-{quantity}",
            figure=squares_figure(report, quantity),
            caption="Squared error in units of the covariance; the line is the chi-square "
            "distribution that honest covariances give.",
        )
        for quantity in quantities
    ]
    return curves + histograms


def _rows(report: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return a row for each method and quantity, with its share at each level."""
    return [
        {
            **row,
            "shares": [
                one
                for one in report["levels"]
                if (one["method"], one["quantity"]) == (row["method"], row["quantity"])
            ],
        }
        for row in report["nees"]
    ]


def calibration_figure(report: Mapping[str, Any], quantity: str) -> go.Figure:
    """Draw found shares against nominal ones."""
    figure = blank_figure(f"Coverage: {_LABELS[quantity]}")
    line = np.array([0.0, 100.0])
    figure.add_scatter(
        x=[*line, *line[::-1]],
        y=[*(line - 100 * _WITHIN), *(line[::-1] + 100 * _WITHIN)],
        fill="toself",
        fillcolor=theme.SHADE,
        line={"width": 0},
        mode="lines",
        hoverinfo="skip",
        name="within 5 points",
    )
    for method, (colour, symbol) in _STYLES.items():
        rows = [
            one for one in report["curve"] if (one["method"], one["quantity"]) == (method, quantity)
        ]
        share = np.array([100 * one["share"] for one in rows])
        figure.add_scatter(
            x=[100 * one["level"] for one in rows],
            y=share,
            error_y={
                "type": "data",
                "symmetric": False,
                "array": [100 * one["high"] for one in rows] - share,
                "arrayminus": share - [100 * one["low"] for one in rows],
                "thickness": 1,
                "width": 0,
            },
            mode="markers",
            marker={"symbol": symbol, "size": 8, "color": colour},
            name=_LABELS[method],
            hovertemplate="nominal %{x:.0f} %, found %{y:.1f} %<extra></extra>",
        )
    figure.update_xaxes(title_text="Nominal share [%]", range=[0, 101])
    figure.update_yaxes(title_text="Stations inside [%]", range=[0, 103])
    return figure


def squares_figure(report: Mapping[str, Any], quantity: str) -> go.Figure:
    """Draw the distribution of squared errors."""
    figure = blank_figure(f"Squared errors: {_LABELS[quantity]}")
    edges = np.array(report["bins"])
    middle, width = (edges[1:] + edges[:-1]) / 2, float(edges[1] - edges[0])
    dimensions = 2
    for row in report["nees"]:
        if row["quantity"] != quantity:
            continue
        dimensions = row["dimensions"]
        counts = np.array(row["counts"], dtype=np.float64)
        figure.add_bar(
            x=middle,
            y=counts / max(counts.sum(), 1.0) / width,
            width=width,
            opacity=0.55,
            marker={"color": _STYLES[row["method"]][0], "line": {"width": 0}},
            name=_LABELS[row["method"]],
            hovertemplate="square %{x:.2f}, density %{y:.3f}<extra></extra>",
        )
    x = np.linspace(0.02, edges[-1], 300)
    figure.add_scatter(
        x=x,
        y=chi2.pdf(x, dimensions),
        mode="lines",
        line={"color": theme.TEXT, "width": 2},
        name=f"chi-square, {dimensions} dimensions",
        hoverinfo="skip",
    )
    figure.update_layout(barmode="overlay")
    figure.update_xaxes(title_text="Squared error in units of its covariance", range=[0, 14])
    figure.update_yaxes(title_text="Density")
    return figure
