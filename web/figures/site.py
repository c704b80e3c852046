"""Figures of the ground of a site: heights with shading, and their standard deviations."""

from __future__ import annotations

from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from spheremark.pipelines.ground_model import ElevationModel
from spheremark.web import theme
from spheremark.web.columns import MM, Columns, floats, texts
from spheremark.web.figures.elements import add_points, blank_figure, make_map

_CELLS_MAX = 400  # displayed cells along an edge
_SUN = (np.radians(315.0), np.radians(40.0))  # azimuth, clockwise from y, and height of the light
_STEEPER = 3.0  # exaggeration of slopes in the shading
_TAIL = 0.02  # share of the cells below and above the colour scale
_SHADES = [[0.0, "rgba(0,0,0,0.55)"], [0.5, "rgba(0,0,0,0)"], [1.0, "rgba(255,255,255,0.45)"]]
_STATIONS = theme.Style("stations", theme.OURS)
_MARKS = theme.Style("control marks", theme.MARK, "triangle-up")


def ground(model: ElevationModel, marks: Columns, stations: Columns) -> go.Figure:
    """Draw heights as colours and their slopes as shade, with stations and marks."""
    step = _step(model)
    heights = np.asarray(model.heights[::step, ::step], dtype=np.float64)
    figure = blank_figure("Ground of the site")
    low, high = (float(np.nanquantile(heights, share)) for share in (_TAIL, 1.0 - _TAIL))
    scale = {"zmin": low, "zmax": high, "colorscale": list(theme.HEIGHTS)}
    cells = {"x": model.xs[::step], "y": model.ys[::step]}
    hover = "x %{x:.2f} m, y %{y:.2f} m<br>height %{z:.3f} m<extra></extra>"
    bar = _bar("Height [m]")
    figure.add_heatmap(**cells, z=np.round(heights, 4), **scale, colorbar=bar, hovertemplate=hover)
    shade = np.round(hillshade(heights, model.cell * step), 2)
    scale = {"zmin": 0.0, "zmax": 1.0, "colorscale": _SHADES}
    figure.add_heatmap(**cells, z=shade, **scale, showscale=False, hoverinfo="skip")
    return _with_places(figure, marks, stations)


def sigma(model: ElevationModel, marks: Columns, stations: Columns) -> go.Figure:
    """Draw the standard deviation of each height."""
    step = _step(model)
    sigmas = MM * np.asarray(model.sigmas[::step, ::step], dtype=np.float64)
    figure = blank_figure("Standard deviation of the ground")
    low, high = np.nanmin(sigmas), np.nanmax(sigmas)
    ticks = [value for value in (0.5, 1, 2, 5, 10, 20, 50, 100, 200) if low <= value <= high]
    names = [f"{value:g}" for value in ticks]
    figure.add_heatmap(
        x=model.xs[::step],
        y=model.ys[::step],
        z=np.round(np.log10(sigmas), 3),
        customdata=np.round(sigmas, 1),
        colorscale=list(theme.HEIGHTS),
        colorbar=_bar("Sigma [mm]", tickvals=np.log10(ticks), ticktext=names),
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


def _with_places(figure: go.Figure, marks: Columns, stations: Columns) -> go.Figure:
    """Add stations and marks to a map, and give it equal axes."""
    edge = {"marker_line": {"width": 1.5, "color": theme.RAISED}, "marker_size": 9}
    for rows, name, style in ((stations, "name", _STATIONS), (marks, "mark", _MARKS)):
        if len(rows["x_m"]):
            x, y = floats(rows, "x_m"), floats(rows, "y_m")
            add_points(figure, x, y, style, "{text}", text=texts(rows, name), **edge)
    make_map(figure, ", site")
    return figure
