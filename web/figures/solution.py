"""Figures of the chosen solution: its map, and its heights."""

from __future__ import annotations

import numpy as np
import plotly.graph_objects as go

from spheremark.web import theme
from spheremark.web.columns import MM, Columns, floats, texts
from spheremark.web.figures.elements import (
    add_note,
    add_points,
    add_strokes,
    add_zero,
    blank_figure,
    make_map,
)
from spheremark.web.figures.maps import NAMES, ellipse_factor, ellipse_outline
from spheremark.web.links import stop_url

_HALF_95 = 1.96  # half of a 95 % interval, in sigmas
_N_NAMED = 60  # stations whose names stand beside them
_MARK = theme.Style("control mark", theme.MARK, "circle-cross-open")
_STATION = theme.Style("station", theme.OURS)


def solution_map(marks: Columns, stations: Columns) -> go.Figure:
    """Draw marks and the stations of one solution, with ellipses and errors to one scale."""
    figure = blank_figure("Stations and control marks")
    factor = ellipse_factor(marks, stations)
    named = {"mode": "markers+text", "cliponaxis": False} | NAMES
    hover = "<b>{text}</b><br>x {x:.3f} m<br>y {y:.3f} m<br>z {z_m:.3f} m"
    x, y = floats(marks, "x_m"), floats(marks, "y_m")
    look = named | {"text": texts(marks, "mark"), "marker_size": 10}
    add_points(figure, x, y, _MARK, hover, marks, **look)
    x, y = floats(stations, "x_m"), floats(stations, "y_m")
    hover = (
        "<b>{station}</b><br>x {x:.4f} m<br>y {y:.4f} m<br>z {z_m:.4f} m<br>"
        "sigma {sigma_3d_m:mm} mm (3-D), {sigma_z_m:mm} mm (height)"
    )
    ids = _links(stations)
    look = {"marker_size": 7, "ids": ids}
    if len(x) <= _N_NAMED:
        look |= named | {"text": short_names(texts(stations, "station"))}
    add_points(figure, x, y, _STATION, hover, stations, **look)
    hidden = {"showlegend": False, "line_width": 1.5}
    outlines = [ellipse_outline(stations, i, factor)[::2] for i in range(len(x))] if factor else []
    if outlines:
        linked = {"links": ids, "step": len(outlines[0]) + 1}
        add_strokes(figure, outlines, _STATION, meta=linked, hoverinfo="none", **hidden)
    places = np.column_stack([x, y])
    ends = places - factor * np.column_stack([floats(stations, f"error_{k}_m") for k in "xy"])
    lines = np.stack([places, ends], axis=1)
    errors = list(lines[np.isfinite(lines).all(axis=(1, 2))])
    add_strokes(figure, errors, _STATION, **hidden)
    make_map(figure, "")
    if factor:
        what = "ellipses and errors" if errors else "ellipses"
        add_note(figure, f"{what} \N{MULTIPLICATION SIGN}{factor:g}")
    return figure


def short_names(names: list[str]) -> list[str]:
    """Return names without their common beginning, up to its numbers."""
    low, high = min(names, default=""), max(names, default="")
    n = next((i for i, (a, b) in enumerate(zip(low, high, strict=False)) if a != b), len(low))
    common = low[:n].rstrip("0123456789")
    short = [name.removeprefix(common) for name in names]
    return short if len(names) > 1 and all(short) else names


def heights(stations: Columns) -> go.Figure:
    """Draw the 95 % interval of the height of each station, and its error where it is known."""
    figure = blank_figure("Heights", "Station", "Height [mm]")
    half = _HALF_95 * MM * floats(stations, "sigma_z_m")
    error = MM * floats(stations, "error_z_m")
    names = texts(stations, "station")
    bars = {"type": "data", "array": half, "thickness": 2, "width": 5, "color": theme.OURS}
    style = theme.Style("95 % interval", theme.OURS, "line-ns-open")
    hover = "<b>{x}</b><br>height known to ±{half:.2f} mm (95 %)"
    zero = np.zeros(len(names))
    ids = _links(stations)
    look = {"error_y": bars, "marker_size": 9, "marker_line_width": 2, "ids": ids}
    add_points(figure, names, zero, style, hover, {"half": half}, **look)
    if np.isfinite(error).any():
        style = theme.Style("error against truth", theme.PAPER, "diamond")
        add_points(figure, names, error, style, "<b>{x}</b><br>height error {y:.2f} mm", ids=ids)
    add_zero(figure)
    ticks = short_names(names) if len(names) <= _N_NAMED else names
    return figure.update_xaxes(type="category", tickvals=names, ticktext=ticks)


def _links(stations: Columns) -> list[str]:
    """Return the address of the stop of each station."""
    names = zip(texts(stations, "survey"), texts(stations, "stop"), strict=True)
    return [stop_url(survey, stop) for survey, stop in names]
