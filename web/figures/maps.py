"""The map of a field: marks, stations, and their ellipses and errors with one scale factor."""

from __future__ import annotations

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from spheremark.web import theme
from spheremark.web.columns import Columns, by_method, floats, known_values, largest, texts
from spheremark.web.figures.elements import (
    add_note,
    add_points,
    add_strokes,
    blank_figure,
    make_map,
)

_ELLIPSE_SHARE = 0.08  # the largest ellipse is drawn at most this large, as a share of the field
MARK_STYLE = theme.Style("control mark", theme.MARK, "circle-cross-open")
NAMES = {"textposition": "top center", "textfont": {"size": 11, "color": theme.MUTED}}
"""How names stand beside points of a map."""


def site_map(marks: Columns, fixes: Columns, true_stops: Columns) -> go.Figure:
    """Draw marks, stations, and their 95 % ellipses and errors with one scale factor."""
    figure = blank_figure("Field, stations and 95 % ellipses")
    factor = ellipse_factor(marks, fixes)
    named = {"mode": "markers+text", "text": texts(marks, "mark"), "cliponaxis": False} | NAMES
    hover = "<b>{text}</b><br>x {x:.3f} m<br>y {y:.3f} m<br>z {z_m:.3f} m"
    x, y = floats(marks, "x_m"), floats(marks, "y_m")
    add_points(figure, x, y, MARK_STYLE, hover, marks, marker_size=10, **named)
    for method, rows in by_method(fixes):
        _add_stations(figure, method, rows, factor, true_stops)
    make_map(figure, ", site")
    if factor:
        what = "ellipses and errors" if len(true_stops["stop"]) else "ellipses"
        add_note(figure, f"{what} \N{MULTIPLICATION SIGN}{factor:g}")
    return figure


def ellipse_factor(marks: Columns, fixes: Columns) -> float:
    """Return the scale factor of ellipses: 1, 2 or 5 times a power of ten; 0 without any."""
    widest = largest(floats(fixes, "ellipse_major_95_m"))
    across = [
        np.ptp(known) if len(known) else 0.0
        for axis in ("x_m", "y_m")
        for known in [known_values(np.concatenate([floats(marks, axis), floats(fixes, axis)]))]
    ]
    if not widest or not max(across):
        return 0.0
    limit = _ELLIPSE_SHARE * float(max(across)) / widest
    power = 10.0 ** np.floor(np.log10(limit))
    return float(power * max(step for step in (1, 2, 5) if step * power <= limit))


def ellipse_outline(
    fixes: Columns, i: int, factor: float, *, size: str = "_95"
) -> NDArray[np.float64]:
    """Return the scaled outline of an ellipse; ``size`` is empty for the standard one."""
    turn = np.linspace(0.0, 2.0 * np.pi, 61)
    major = factor * floats(fixes, f"ellipse_major{size}_m")[i] * np.cos(turn)
    minor = factor * floats(fixes, f"ellipse_minor{size}_m")[i] * np.sin(turn)
    bearing = np.radians(floats(fixes, "ellipse_bearing_deg")[i])
    x = floats(fixes, "x_m")[i] + major * np.sin(bearing) + minor * np.cos(bearing)
    y = floats(fixes, "y_m")[i] + major * np.cos(bearing) - minor * np.sin(bearing)
    return np.column_stack([x, y])


def _add_stations(
    figure: go.Figure, method: str, rows: Columns, factor: float, true_stops: Columns
) -> None:
    """Draw the stations of one method with their scaled ellipses and errors."""
    style = theme.method_style(method)
    x, y = floats(rows, "x_m"), floats(rows, "y_m")
    hover = (
        "<b>{stop}</b> {status}<br>x {x:.3f} m<br>y {y:.3f} m<br>z {z_m:.3f} m<br>"
        "sigma {sigma_3d_m:mm} mm, {n_markers:.0f} marks"
    )
    add_points(figure, x, y, style, hover, rows, marker_size=6, legendgroup=style.label)
    outlines = [ellipse_outline(rows, i, factor) for i in range(len(x))]
    hidden = {"legendgroup": style.label, "showlegend": False}
    add_strokes(figure, outlines, style, line_width=1.5, **hidden)
    add_strokes(figure, _errors(rows, true_stops, factor), style, line_width=1.0, **hidden)


def _errors(rows: Columns, true_stops: Columns, factor: float) -> list[NDArray[np.float64]]:
    """Return the scaled line from each station towards its true position."""

    def places(columns: Columns) -> zip[tuple[str, NDArray[np.float64]]]:
        xy = np.column_stack([floats(columns, "x_m"), floats(columns, "y_m")])
        return zip(texts(columns, "stop"), xy, strict=True)

    truth = dict(places(true_stops))
    return [
        np.stack([start, start + factor * (truth[stop] - start)])
        for stop, start in places(rows)
        if stop in truth
    ]
