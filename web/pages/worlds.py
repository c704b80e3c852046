"""The page on random worlds: detection, centres and stations against their truth."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import plotly.graph_objects as go

from spheremark.web import theme
from spheremark.web.figures.elements import add_line, add_points, blank_figure
from spheremark.web.pages.base import Frame, Panel
from spheremark.web.templating import render

_COLOURS = (theme.OURS, theme.PAPER, theme.TEXT, theme.TOLERANCE, theme.GREEN, theme.FIFTH)
_CURVE = (
    "Share of markers found against false markers in a scan, as the level of decision falls. "
    "Diamonds: the markers that are called ok."
)


def worlds_page(frame: Frame, report: Mapping[str, Any] | None) -> str:
    """Return the page of a report of many random worlds, if there is one."""
    return render(
        "worlds.html",
        frame=frame,
        report=report,
        panels=() if report is None else [Panel("curve", curve_figure(report), _CURVE)],
        tables=() if report is None else report["tables"],
    )


def curve_figure(report: Mapping[str, Any]) -> go.Figure:
    """Draw recall against the rate of false markers, by class of marker, with the working point."""
    figure = blank_figure(
        "Recall and false markers", "False markers in a scan", "Markers found [%]"
    )
    rates = [one["rate"] for one in report["curve"]]
    working = next(one for one in report["methods"] if one["method"] == "ok")["false_per_scan"]
    for i, (marker, colour) in enumerate(zip(report["markers"], _COLOURS, strict=False)):
        if not marker["n"]:
            continue
        shares = [100 * one[f"recall_{i}"] for one in report["curve"]]
        add_line(figure, rates, shares, theme.Style(marker["class"], colour))
        ok, style = 100 * marker["n_ok"] / marker["n"], theme.Style("ok", colour, "diamond")
        hover = "ok: {y:.1f} %"
        add_points(figure, [max(working, rates[0])], [ok], style, hover, showlegend=False)
    figure.update_xaxes(type="log")
    return figure.update_yaxes(range=[0, 103])
