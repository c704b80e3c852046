"""The parts of figures: traces with hover texts, levels, notes, bins, and axes of some kinds."""

from __future__ import annotations

from collections.abc import Sequence
from string import Formatter
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import ArrayLike, NDArray

from spheremark.web import theme
from spheremark.web.columns import MM, Columns, floats, rms, texts
from spheremark.web.theme import Style

Look = dict[str, Any]  # arguments of a trace

_RATIOS = [step * 10.0**power for power in range(-2, 5) for step in (1, 2, 5)]
RATIO_AXIS = {
    "type": "log",
    "tickvals": _RATIOS,
    "ticktext": [f"{value:g}" for value in _RATIOS],
}


def blank_figure(title: str, x: str = "", y: str = "") -> go.Figure:
    """Return an empty figure with the template, a title and the titles of its axes."""
    figure = go.Figure(layout={"template": theme.template(), "title": {"text": title}})
    if x:
        figure.update_layout(xaxis_title_text=x, yaxis_title_text=y)
    return figure


def hover_of(template: str, style: Style, rows: Columns | None = None) -> dict[str, Any]:
    """Return the hover text of a trace; none without a template.

    ``{y:.1f}`` is a value of the trace and ``{range_m:.2f}`` one of a column of ``rows``;
    ``{sigma_m:mm}`` is in millimetres.
    """
    if not template:
        return {"hoverinfo": "skip"}
    text, columns = "", []
    for literal, name, form, _ in Formatter().parse(template):
        text += literal
        if name is not None and rows is not None and name in rows:
            columns.append(_hover_column(rows, name, form or ""))
            name = f"customdata[{len(columns) - 1}]"
        if name is not None:
            form = ".1f" if form == "mm" else form
            text += f"%{{{name}:{form}}}" if form else f"%{{{name}}}"
    found: dict[str, Any] = {"hovertemplate": f"{text}<extra>{style.label}</extra>"}
    return found | ({"customdata": list(zip(*columns, strict=True))} if columns else {})


def _hover_column(rows: Columns, name: str, form: str) -> list[Any]:
    """Return a column for a hover text: texts without a format, else numbers."""
    if not form:
        return texts(rows, name)
    values = floats(rows, name)
    return list((MM * values if form == "mm" else values.round(4)).tolist())


def add_points(
    figure: go.Figure,
    x: ArrayLike,
    y: ArrayLike,
    style: Style,
    hover: Any = "",
    rows: Any = None,
    **more: Any,
) -> None:
    """Draw points, each with the ``link`` of its row if there is one; more goes to the trace."""
    look: Look = {"mode": "markers", "name": style.label, "marker_size": 8}
    look |= {"marker_color": style.colour, "marker_symbol": style.symbol}
    look |= hover_of(hover, style, rows)
    look |= {"ids": texts(rows, "link")} if rows is not None and "link" in rows else {}
    figure.add_scatter(x=x, y=y, **(look | more))


def add_line(
    figure: go.Figure, x: ArrayLike, y: ArrayLike, style: Style, hover: Any = "", **more: Any
) -> None:
    """Draw a line; further arguments go to the trace."""
    look = {"mode": "lines", "line_color": style.colour, "name": style.label}
    figure.add_scatter(x=x, y=y, **(look | hover_of(hover, style) | more))


def add_strokes(
    figure: go.Figure, strokes: Sequence[NDArray[np.float64]], style: Style, **more: Any
) -> None:
    """Draw many lines as one trace."""
    if strokes:
        x, y = joined_strokes(strokes).T
        add_line(figure, x, y, style, **more)


def add_tolerance(figure: go.Figure, tolerance_m: float) -> None:
    """Draw the tolerance as a dashed line."""
    add_limit(figure, tolerance_m * MM, f"tolerance {tolerance_m * MM:g} mm", yshift=2)


def add_limit(figure: go.Figure, y: float, text: str, **note: Any) -> None:
    """Draw a limit as a dashed line with its name; further arguments go to the name."""
    look = {"font": {"size": 12, "color": theme.TOLERANCE}, "bgcolor": theme.RAISED, "borderpad": 1}
    figure.add_hline(
        y=y,
        line={"color": theme.TOLERANCE, "width": 1.5, "dash": "dash"},
        annotation={"text": text} | look | note,
        annotation_position="top left" if "x" in note else "top right",
    )


def add_zero(figure: go.Figure, **place: int) -> None:
    """Draw the zero of residuals."""
    line = {"color": theme.LINE, "width": 1}
    figure.add_hline(y=0, line=line, layer="below", **place)


def add_note(figure: go.Figure, text: str, **place: Any) -> None:
    """Write a note, by default into the lower right corner."""
    corner = {"x": 1, "y": 0, "xref": "x domain", "xanchor": "right", "yanchor": "bottom"}
    look = {"font": {"size": 12, "color": theme.MUTED}, "bgcolor": theme.RAISED}
    shown = {"text": text, "yref": "y domain", "showarrow": False} | look | (place or corner)
    figure.add_annotation(**shown)


def make_map(figure: go.Figure, frame: str = "") -> None:
    """Give a map equal axes."""
    figure.update_xaxes(title_text=f"x{frame} [m]", constrain="domain")
    figure.update_yaxes(title_text=f"y{frame} [m]", scaleanchor="x", scaleratio=1)


def group_by_axis(figure: go.Figure, gap: float) -> None:
    """Set the axes of a figure with three coordinates beside each other in each category."""
    add_zero(figure)
    figure.update_xaxes(type="category")
    figure.update_layout(scattermode="group", scattergap=gap)


def make_log(figure: go.Figure) -> None:
    """Make the axis of errors logarithmic; Plotly takes annotations as logarithms, lines not."""
    figure.update_yaxes(**RATIO_AXIS, rangemode="normal")
    for line, note in zip(figure.layout.shapes, figure.layout.annotations, strict=False):
        if note.yref == "y":
            note.y = float(np.log10(line.y0))


def add_binned(
    figure: go.Figure, style: Style, x: NDArray[np.float64], y: NDArray[np.float64], width: float
) -> None:
    """Draw the RMS of each bin as a line."""
    hover, group = "RMS {y:.1f} mm about {x:.4g}", {"legendgroup": style.label, "showlegend": False}
    name = f"{style.label}: RMS of bins"
    middles, values = binned_rms(x, y, width)
    add_line(figure, middles, values, style, hover, line_width=2.5, **group)
    figure.data[-1].name = name


def binned_rms(
    x: NDArray[np.float64], y: NDArray[np.float64], width: float
) -> tuple[list[float], list[float]]:
    """Return the mean of x and the RMS of the known y in bins of x."""
    known = np.isfinite(x) & np.isfinite(y)
    x, y = x[known], y[known]
    bins = np.floor(x / width)
    members = [bins == value for value in np.unique(bins)]
    return (
        [float(np.mean(x[member])) for member in members],
        [rms(y[member]) for member in members],
    )


def joined_strokes(strokes: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return many lines as one with gaps, (n, dimensions)."""
    gap = np.full((1, strokes[0].shape[1] if strokes else 2), np.nan)
    return np.concatenate([part for stroke in strokes for part in (stroke, gap)] or [gap])


def outline(radius: float, centre: Sequence[float] = (0.0, 0.0)) -> NDArray[np.float64]:
    """Return a circle about a centre, (2, n)."""
    turn = np.linspace(0.0, 2.0 * np.pi, 91)
    return np.stack([centre[0] + radius * np.cos(turn), centre[1] + radius * np.sin(turn)])
