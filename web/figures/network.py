"""Figures of an adjusted network: map, residuals, tests, and control marks left out in turn."""

from __future__ import annotations

import numpy as np
import plotly.graph_objects as go

from spheremark.web import theme
from spheremark.web.columns import MM, Columns, floats, select, texts
from spheremark.web.figures.elements import (
    Look,
    add_limit,
    add_note,
    add_points,
    add_strokes,
    blank_figure,
    group_by_axis,
    make_map,
)
from spheremark.web.figures.maps import NAMES, ellipse_factor, ellipse_outline

_BEYOND = 2.0  # sigmas of the bars
_ELLIPSES = (("95 %", "_95", 1.5, "solid"), ("standard", "", 1.0, "dot"))
_N_NAMES = 60  # marks whose names can be read on one map
_BELOW = {"x": 0.0, "xanchor": "left", "y": -0.16, "yanchor": "top", "orientation": "h"}
_REDUNDANCY = {"text": "mean redundancy, of 3", "side": "top", "font": {"size": 12}}
_BAR = _BELOW | {"title": _REDUNDANCY, "thickness": 8, "len": 0.5, "outlinewidth": 0, "dtick": 1}
_SCALE = {"cmin": 0.0, "cmax": 3.0, "colorscale": [list(stop) for stop in theme.HEIGHTS]}


def network_map(stations: Columns, marks: Columns) -> go.Figure:
    """Draw stations and marks by redundancy, with scaled standard and 95 % ellipses."""
    figure = blank_figure("Network: ellipses and redundancy")
    names = ("x_m", "y_m", "ellipse_major_95_m")
    both = {name: np.concatenate([floats(stations, name), floats(marks, name)]) for name in names}
    factor = ellipse_factor(marks, both)
    for rows, colour in ((stations, theme.OURS), (marks, theme.MARK)):
        for kind, size, width, dash in _ELLIPSES:
            lines = [ellipse_outline(rows, i, factor, size=size) for i in range(len(rows["x_m"]))]
            shown = {"legendgroup": kind, "showlegend": rows is stations}
            style = theme.Style(f"{kind} ellipse", colour)
            add_strokes(figure, lines, style, line_width=width, line_dash=dash, **shown)
    _add_points(figure, stations, "station", "circle")
    _add_points(figure, marks, "mark", "diamond")
    make_map(figure)
    if factor:
        add_note(figure, f"ellipses \N{MULTIPLICATION SIGN}{factor:g}")
    return figure


def _add_points(figure: go.Figure, rows: Columns, kind: str, symbol: str) -> None:
    """Draw stations or marks, coloured by the mean redundancy of their centres."""
    names = texts(rows, kind)
    is_named = kind == "mark" and len(names) <= _N_NAMES
    look = {"symbol": symbol, "size": 9, "color": floats(rows, "mean_redundancy")}
    look |= {"line": {"color": theme.TEXT, "width": 1}, "showscale": kind == "station"}
    hover = (
        "<b>{text}</b><br>x {x:.4f} m<br>y {y:.4f} m<br>sigma {sigma_3d_m:mm} mm, "
        "{n_observations:.0f} centres, redundancy {mean_redundancy:.2f}"
    )
    x, y, style = floats(rows, "x_m"), floats(rows, "y_m"), theme.Style(kind, theme.TEXT, symbol)
    named = {"mode": "markers+text" if is_named else "markers", "text": names} | NAMES
    add_points(figure, x, y, style, hover, rows, cliponaxis=False, **named)
    figure.data[-1].marker = look | _SCALE | {"colorbar": _BAR}


def residuals(observations: Columns) -> go.Figure:
    """Draw the residuals of the centres by station; excluded ones have another symbol."""
    figure = blank_figure("Residuals of the centres", "Station", "Observed - computed [mm]")
    used = np.asarray(observations["used"], dtype=bool)
    for axis, colour in theme.AXES.items():
        for is_used in (True, False):
            rows = select(observations, used == is_used)
            name, symbol = (axis, "circle") if is_used else (f"{axis}, left out", "x-thin-open")
            y = MM * floats(rows, f"residual_{axis}_m")
            if len(y):
                style = theme.Style(name, colour, symbol)
                hover = "<b>{x}</b> {marker} on {mark}<br>{y:.1f} mm"
                look: Look = {"offsetgroup": axis, "marker_opacity": 0.75}
                look |= {"marker_size": 6 if is_used else 9}
                look |= {"marker_line_width": 0 if is_used else 2}
                add_points(figure, texts(rows, "station"), y, style, hover, rows, **look)
    group_by_axis(figure, 0.4)
    figure.update_xaxes(tickangle=-40)
    return figure


def tests(observations: Columns, w_limit: float) -> go.Figure:
    """Draw the w-statistic of each centre against its redundancy, and the limit."""
    figure = blank_figure("Local tests of the centres", "Redundancy, of 3", "Largest w")
    hover = (
        "<b>{station}</b> {marker} on {mark}<br>w {y:.2f}, redundancy {x:.2f}<br>"
        "detectable bias {minimal_detectable_bias_m:mm} mm"
    )
    x, y = floats(observations, "redundancy"), floats(observations, "w")
    look = {"marker_size": 7, "marker_opacity": 0.7, "showlegend": False}
    add_points(figure, x, y, theme.Style("centre", theme.OURS), hover, observations, **look)
    add_limit(figure, w_limit, f"limit {w_limit:.2f}", xanchor="left", x=0.01)
    figure.update_xaxes(range=[0, 3])
    figure.update_yaxes(rangemode="tozero")
    return figure


def control_differences(checks: Columns) -> go.Figure:
    """Draw the position of each control mark from the network without it, minus the given one."""
    figure = blank_figure(
        "Control marks left out in turn", "Control mark", "Predicted - given [mm]"
    )
    for axis, colour in theme.AXES.items():
        sigmas = _BEYOND * MM * floats(checks, f"sigma_{axis}_m")
        bars = {"array": sigmas, "color": theme.BAR, "thickness": 3, "width": 0}
        y, style = MM * floats(checks, f"difference_{axis}_m"), theme.Style(axis, colour)
        more = {"offsetgroup": axis, "error_y": bars}
        add_points(figure, texts(checks, "mark"), y, style, "<b>{x}</b><br>{y:.1f} mm", **more)
    group_by_axis(figure, 0.35)
    return figure
