"""The map of a field: marks, stations, and their ellipses and errors with one scale factor."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from spheremark.web import theme
from spheremark.web.columns import Columns, by_method, floats, known_values, largest, texts
from spheremark.web.figures.elements import (
    add_note,
    blank_figure,
    details,
    joined_strokes,
    make_map,
)

_ELLIPSE_SHARE = 0.08  # the largest ellipse is drawn at most this large, as a share of the field


def site_map(marks: Columns, fixes: Columns, true_stops: Columns) -> go.Figure:
    """Draw marks, stations, and their 95 % ellipses and errors with one scale factor."""
    figure = blank_figure("Field, stations and 95 % ellipses")
    factor = ellipse_factor(marks, fixes)
    _add_marks(figure, marks)
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


def _add_marks(figure: go.Figure, marks: Columns) -> None:
    """Draw the control marks with their names."""
    figure.add_scatter(
        x=floats(marks, "x_m"),
        y=floats(marks, "y_m"),
        mode="markers+text",
        name="control mark",
        text=texts(marks, "mark"),
        textposition="top center",
        textfont={"size": 11, "color": theme.MUTED},
        marker={"color": theme.MARK, "size": 10, "symbol": "circle-cross-open"},
        cliponaxis=False,
        customdata=floats(marks, "z_m").tolist(),
        hovertemplate="<b>%{text}</b><br>x %{x:.3f} m<br>y %{y:.3f} m<br>z %{customdata:.3f} m"
        "<extra>control mark</extra>",
    )


def _add_stations(
    figure: go.Figure, method: str, rows: Columns, factor: float, true_stops: Columns
) -> None:
    """Draw the stations of one method with their scaled ellipses and errors."""
    style = theme.method_style(method)
    x, y = floats(rows, "x_m"), floats(rows, "y_m")
    figure.add_scatter(
        x=x,
        y=y,
        mode="markers",
        name=style.label,
        legendgroup=style.label,
        marker={"color": style.colour, "size": 6, "symbol": style.symbol},
        customdata=details(rows, ("stop", "status"), ("n_markers", "z_m"), ("sigma_3d_m",)),
        hovertemplate="<b>%{customdata[0]}</b> %{customdata[1]}<br>x %{x:.3f} m<br>y %{y:.3f} m<br>"
        "z %{customdata[3]:.3f} m<br>sigma %{customdata[4]:.1f} mm, %{customdata[2]:.0f} marks"
        f"<extra>{style.label}</extra>",
    )
    outlines = [ellipse_outline(rows, i, factor) for i in range(len(x))]
    _add_strokes(figure, outlines, style, 1.5)
    _add_strokes(figure, _errors(rows, true_stops, factor), style, 1.0)


def _errors(rows: Columns, true_stops: Columns, factor: float) -> list[NDArray[np.float64]]:
    """Return the scaled line from each station towards its true position."""
    truth = dict(
        zip(
            texts(true_stops, "stop"),
            zip(floats(true_stops, "x_m"), floats(true_stops, "y_m"), strict=True),
            strict=True,
        )
    )
    lines = []
    for stop, x, y in zip(
        texts(rows, "stop"), floats(rows, "x_m"), floats(rows, "y_m"), strict=True
    ):
        if stop in truth:
            start = np.array([x, y])
            lines.append(np.stack([start, start + factor * (np.array(truth[stop]) - start)]))
    return lines


def _add_strokes(
    figure: go.Figure,
    strokes: Sequence[NDArray[np.float64]],
    style: theme.MethodStyle,
    width: float,
) -> None:
    """Draw many lines as one trace."""
    if not strokes:
        return
    joined = joined_strokes(strokes)
    figure.add_scatter(
        x=joined[:, 0],
        y=joined[:, 1],
        mode="lines",
        legendgroup=style.label,
        showlegend=False,
        line={"color": style.colour, "width": width},
        hoverinfo="skip",
    )
