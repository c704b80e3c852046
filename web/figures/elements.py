"""Elements that several figures share: blank figures, tolerance, bins, notes, equal axes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from spheremark.web import theme
from spheremark.web.columns import MM, Columns, floats, rms, texts

_RATIOS = [step * 10.0**power for power in range(-2, 5) for step in (1, 2, 5)]
RATIO_AXIS = {
    "type": "log",
    "tickvals": _RATIOS,
    "ticktext": [f"{value:g}" for value in _RATIOS],
}


def blank_figure(title: str) -> go.Figure:
    """Return an empty figure with the template and a title."""
    return go.Figure(layout={"template": theme.template(), "title": {"text": title}})


def add_tolerance(figure: go.Figure, tolerance_m: float) -> None:
    """Draw the tolerance as a dashed line."""
    figure.add_hline(
        y=tolerance_m * MM,
        line={"color": theme.TOLERANCE, "width": 1.5, "dash": "dash"},
        annotation={
            "text": f"tolerance {tolerance_m * MM:g} mm",
            "font": {"size": 12, "color": theme.TOLERANCE},
            "bgcolor": theme.RAISED,
            "borderpad": 1,
            "yshift": 2,
        },
        annotation_position="top right",
    )


def add_zero(figure: go.Figure) -> None:
    """Draw the zero of residuals."""
    figure.add_hline(y=0, line={"color": theme.LINE, "width": 1}, layer="below")


def add_note(figure: go.Figure, text: str) -> None:
    """Write a note into the lower right corner."""
    figure.add_annotation(
        text=text,
        x=1,
        y=0,
        xref="x domain",
        yref="y domain",
        xanchor="right",
        yanchor="bottom",
        showarrow=False,
        font={"size": 12, "color": theme.MUTED},
        bgcolor=theme.RAISED,
    )


def make_map(figure: go.Figure, frame: str = "") -> None:
    """Give a map equal axes."""
    figure.update_xaxes(title_text=f"x{frame} [m]", constrain="domain")
    figure.update_yaxes(title_text=f"y{frame} [m]", scaleanchor="x", scaleratio=1)


def group_by_axis(figure: go.Figure, x_title: str, y_title: str, gap: float) -> None:
    """Set the axes of a figure with three coordinates beside each other in each category."""
    add_zero(figure)
    figure.update_xaxes(title_text=x_title, type="category")
    figure.update_yaxes(title_text=y_title)
    figure.update_layout(scattermode="group", scattergap=gap)


def make_log(figure: go.Figure) -> None:
    """Make the axis of errors logarithmic; Plotly takes annotations as logarithms, lines not."""
    figure.update_yaxes(**RATIO_AXIS, rangemode="normal")
    for line, note in zip(figure.layout.shapes, figure.layout.annotations, strict=False):
        if note.yref == "y":
            note.y = float(np.log10(line.y0))


def details(
    rows: Columns, words: Sequence[str], numbers: Sequence[str] = (), in_mm: Sequence[str] = ()
) -> list[list[Any]]:
    """Return the values of the hover text of each row: words, numbers, lengths in millimetres."""
    columns: list[Iterable[Any]] = [texts(rows, name) for name in words]
    columns += [floats(rows, name).round(4).tolist() for name in numbers]
    columns += [(MM * floats(rows, name)).tolist() for name in in_mm]
    return [list(row) for row in zip(*columns, strict=True)]


def add_binned(
    figure: go.Figure,
    style: theme.MethodStyle,
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    width: float,
) -> None:
    """Draw the RMS of each bin as a line."""
    middles, values = binned_rms(x, y, width)
    figure.add_scatter(
        x=middles,
        y=values,
        mode="lines",
        name=f"{style.label}: RMS of bins",
        legendgroup=style.label,
        showlegend=False,
        line={"color": style.colour, "width": 2.5},
        hovertemplate=f"RMS %{{y:.1f}} mm about %{{x:.4g}}<extra>{style.label}</extra>",
    )


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
