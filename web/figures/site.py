"""Figures of the ground of a site: heights with shading, and their standard deviations."""

from __future__ import annotations

from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from spheremark.pipelines.ground_model import ElevationModel
from spheremark.web import theme
from spheremark.web.columns import Columns, floats, texts
from spheremark.web.figures.elements import blank_figure, make_map

_CELLS_MAX = 400  # displayed cells along an edge
_SUN = (np.radians(315.0), np.radians(40.0))  # azimuth, clockwise from y, and height of the light
_STEEPER = 3.0  # exaggeration of slopes in the shading
_TAIL = 0.02  # share of the cells below and above the colour scale


def ground(model: ElevationModel, marks: Columns, stations: Columns) -> go.Figure:
    """Draw heights as colours and their slopes as shade, with stations and marks."""
    step = _step(model)
    heights = _thinned(model.heights, step)
    figure = blank_figure("Ground of the site")
    cells = {"x": model.xs[::step], "y": model.ys[::step]}
    figure.add_heatmap(
        **cells,
        z=np.round(heights, 4),
        zmin=float(np.nanquantile(heights, _TAIL)),
        zmax=float(np.nanquantile(heights, 1.0 - _TAIL)),
        colorscale=list(theme.HEIGHTS),
        colorbar=_bar("Height [m]"),
        hovertemplate="x %{x:.2f} m, y %{y:.2f} m<br>height %{z:.3f} m<extra></extra>",
    )
    figure.add_heatmap(
        **cells,
        z=np.round(hillshade(heights, model.cell * step), 2),
        colorscale=[
            [0.0, "rgba(0,0,0,0.55)"],
            [0.5, "rgba(0,0,0,0)"],
            [1.0, "rgba(255,255,255,0.45)"],
        ],
        zmin=0.0,
        zmax=1.0,
        showscale=False,
        hoverinfo="skip",
    )
    return _with_places(figure, marks, stations)


def sigma(model: ElevationModel, marks: Columns, stations: Columns) -> go.Figure:
    """Draw the standard deviation of each height."""
    step = _step(model)
    sigmas = 1e3 * _thinned(model.sigmas, step)
    figure = blank_figure("Standard deviation of the ground")
    low, high = np.nanmin(sigmas), np.nanmax(sigmas)
    ticks = [value for value in (0.5, 1, 2, 5, 10, 20, 50, 100, 200) if low <= value <= high]
    figure.add_heatmap(
        x=model.xs[::step],
        y=model.ys[::step],
        z=np.round(np.log10(sigmas), 3),
        customdata=np.round(sigmas, 1),
        colorscale=list(theme.HEIGHTS),
        colorbar=_bar(
            "Sigma [mm]", tickvals=np.log10(ticks), ticktext=[f"{value:g}" for value in ticks]
        ),
        hovertemplate="x %{x:.2f} m, y %{y:.2f} m<br>sigma %{customdata:.1f} mm<extra></extra>",
    )
    return _with_places(figure, marks, stations)


def hillshade(heights: NDArray[Any], cell: float) -> NDArray[np.float64]:
    """Return the brightness of a surface lit from the north-west; level ground is 0.5."""
    along_y, along_x = np.gradient(np.asarray(heights, dtype=np.float64), cell)
    azimuth, height = _SUN
    light = np.array([np.sin(azimuth) * np.cos(height), np.cos(azimuth) * np.cos(height)])
    sloped = -_STEEPER * (along_x * light[0] + along_y * light[1]) + np.sin(height)
    lit = sloped / np.sqrt(1.0 + _STEEPER**2 * (along_x**2 + along_y**2))
    return np.asarray(np.clip(0.5 + 0.5 * (lit - np.sin(height)), 0.0, 1.0))


def _bar(title: str, **ticks: object) -> dict[str, object]:
    """Return the colour bar of a map."""
    return {"title": {"text": title, "side": "right"}, "thickness": 12, "outlinewidth": 0, **ticks}


def _step(model: ElevationModel) -> int:
    """Return the step between displayed cells."""
    return int(np.ceil(max(model.heights.shape) / _CELLS_MAX))


def _thinned(values: NDArray[Any], step: int) -> NDArray[np.float64]:
    """Return every ``step``-th cell in both directions."""
    return np.asarray(values[::step, ::step], dtype=np.float64)


def _with_places(figure: go.Figure, marks: Columns, stations: Columns) -> go.Figure:
    """Add stations and marks to a map, and give it equal axes."""
    places = (
        ("stations", stations, "name", "circle", theme.OURS),
        ("control marks", marks, "mark", "triangle-up", theme.MARK),
    )
    for label, rows, name, symbol, colour in places:
        if len(rows["x_m"]):
            figure.add_scatter(
                x=floats(rows, "x_m"),
                y=floats(rows, "y_m"),
                text=texts(rows, name),
                mode="markers",
                name=label,
                marker={
                    "symbol": symbol,
                    "size": 9,
                    "color": colour,
                    "line": {"width": 1.5, "color": theme.RAISED},
                },
                hovertemplate="%{text}<extra></extra>",
            )
    make_map(figure, ", site")
    return figure
