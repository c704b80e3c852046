"""One stop in 3-D: its cloud, the fitted spheres, and the residuals of their returns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from spheremark.pipelines.model import Array, Column, Index
from spheremark.web import theme
from spheremark.web.columns import MM, Columns, floats, on_marks, select, texts
from spheremark.web.figures.elements import (
    add_points,
    add_zero,
    blank_figure,
    hover_of,
    joined_strokes,
)

_CELLS = (0.15, 0.2, 0.3, 0.4)  # [m]; of the surroundings one return is shown in each cell
_N_SHOWN = 30_000  # returns of the surroundings; more makes a browser without a GPU slow
_MARGIN = 2.0  # [m] of surroundings shown beyond the farthest marker that stands on a mark
_REACH = 1.3  # returns within so many radii of a centre are shown with it
_LEAST = 8.0  # [m] that a scene shows at least, before the margin
_COLOUR_SIGMAS = 3.0  # the colours of residuals end here
_N_MERIDIANS, _N_PARALLELS = 18, 8  # of a drawn sphere
_CAMERA = {"eye": {"x": 0.95, "y": -1.1, "z": 0.7}, "center": {"x": 0, "y": 0, "z": -0.1}}


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Scan:
    """A sample of a stop's cloud in the station frame.

    ``markers`` is the index of a point's marker in ``names``, or negative; ``residuals`` are along
    the beam by ``fit_method`` [m], NaN for returns that it did not use.
    """

    p_station: Column
    markers: Index
    residuals: Column
    names: tuple[str, ...]
    fit_method: str


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MarkerReturns:
    """The returns near one sphere, their residuals, and whether the fit used them."""

    p_station: Array
    residuals: Array
    is_used: NDArray[np.bool_]


def stop_scene(
    scan: Scan, fits: Columns, rejections: Columns, *, links: Sequence[str] = ()
) -> go.Figure:
    """Draw a stop: surroundings by height, spheres, and returns coloured by their residual."""
    figure = _figure_3d(f"Scan, spheres and {_what(scan, fits).lower()}")
    reach = _reach(fits)
    near = floats(fits, "range_m") <= reach
    links = [link for link, is_shown in zip(links, near, strict=False) if is_shown]
    fits = select(fits, near)
    shown = scan.p_station[_surroundings(scan, reach)]
    heights = {"size": 1.6, "color": shown[:, 2], "colorscale": theme.HEIGHTS}
    _add_3d(figure, shown, "surroundings", marker=heights)
    returns = [marker_returns(scan, fits, i) for i in range(len(fits["marker"]))]
    if returns:
        _add_returns(figure, returns, floats(fits, "rms_m"), _what(scan, fits), size=2.5)
        _add_labels(figure, fits, links)
    if len(rejections["reason"]):
        more = {"text": texts(rejections, "reason"), "visible": "legendonly"}
        look = {"size": 4, "color": theme.MUTED, "symbol": "cross"}
        _add_3d(figure, _centres(rejections), "rejected", "{text}", marker=look, **more)
    return figure


def marker_close_up(scan: Scan, fits: Columns, i: int) -> go.Figure:
    """Draw one marker in detail: its sphere, and its returns coloured by their residual."""
    name, mark, centre = texts(fits, "marker")[i], texts(fits, "mark")[i], _centres(fits)[i]
    figure = _figure_3d(f"Marker {name}{f' on mark {mark}' if mark else ''} and its returns")
    sphere = centre + float(floats(fits, "radius_m")[i]) * joined_strokes(_graticule())
    _add_3d(figure, sphere, "sphere", mode="lines", line={"color": theme.CLOUD, "width": 1.5})
    returns = marker_returns(scan, fits, i)
    left_out = {"size": 4, "color": theme.FAINT, "symbol": "cross"}
    rest = returns.p_station[~returns.is_used]
    _add_3d(figure, rest, "left out: pole, edges", marker=left_out)
    _add_returns(figure, [returns], floats(fits, "rms_m")[[i]], _what(scan, fits), size=5)
    towards = -centre / np.linalg.norm(centre)
    eye = 1.7 * towards + np.array([0.5 * towards[1], -0.5 * towards[0], 0.5])
    figure.update_scenes(camera_eye=dict(zip("xyz", eye.tolist(), strict=True)))
    return figure


def marker_residuals(scan: Scan, fits: Columns, i: int) -> go.Figure:
    """Draw the residuals of one marker's returns across the sphere, with their sigma."""
    returns, what, centre = marker_returns(scan, fits, i), _what(scan, fits), _centres(fits)[i]
    sigma_mm = float(floats(fits, "rms_m")[i]) * MM
    style = theme.method_style(texts(fits, "fit_method")[i])
    title = f"{what} of marker {texts(fits, 'marker')[i]}"
    figure = blank_figure(title, "Right of the line of sight [mm]", f"{what} [mm]")
    figure.add_hrect(y0=-sigma_mm, y1=sigma_mm, fillcolor=style.band, line_width=0, layer="below")
    add_zero(figure)
    right = np.array([centre[1], -centre[0]]) / np.hypot(centre[0], centre[1])
    x = MM * (returns.p_station - centre)[returns.is_used, :2] @ right
    y = returns.residuals[returns.is_used] * MM
    named = style._replace(label=f"return; band: ±sigma, {sigma_mm:.1f} mm")
    look = {"marker_size": 6, "marker_opacity": 0.7, "showlegend": True}
    add_points(figure, x, y, named, "{y:.1f} mm at {x:.0f} mm", **look)
    return figure


def marker_returns(scan: Scan, fits: Columns, i: int) -> MarkerReturns:
    """Return the returns near one fitted sphere."""
    centre, radius = _centres(fits)[i], float(floats(fits, "radius_m")[i])
    members = _within(scan.p_station, centre, _REACH * radius)
    p_station = scan.p_station[members].astype(np.float64)
    name = texts(fits, "marker")[i]
    if _is_along_beam(scan, fits) and name in scan.names:
        own = scan.markers[members] == scan.names.index(name)
        residuals = np.where(own, scan.residuals[members].astype(np.float64), np.nan)
    else:
        residuals = np.linalg.norm(p_station - centre, axis=1) - radius
    return MarkerReturns(p_station=p_station, residuals=residuals, is_used=np.isfinite(residuals))


def _is_along_beam(scan: Scan, fits: Columns) -> bool:
    """Whether the residuals in the cloud are those of these fits."""
    return set(texts(fits, "fit_method")) <= {scan.fit_method}


def _what(scan: Scan, fits: Columns) -> str:
    """Return the quantity of the colours of returns."""
    return "Residual along the beam" if _is_along_beam(scan, fits) else "Distance from the sphere"


def _within(p: NDArray[np.float32], centre: Array, reach: float) -> Index:
    """Return the points within a distance of a position."""
    near = np.flatnonzero(np.abs(p[:, 0] - np.float32(centre[0])) < reach)
    distances = np.linalg.norm(p[near] - centre, axis=1)
    return np.asarray(near[distances < reach], dtype=np.intp)


def _reach(fits: Columns) -> float:
    """Return the radius of a scene: beyond the farthest fit on a mark [m]."""
    return float(np.max(floats(fits, "range_m")[on_marks(fits)], initial=_LEAST)) + _MARGIN


def _surroundings(scan: Scan, reach: float) -> Index:
    """Return one return per cell, in the finest grid with few enough cells."""
    is_near = np.linalg.norm(scan.p_station, axis=1) < reach
    near = np.flatnonzero(is_near & (scan.markers < 0))
    chosen = near
    for cell in _CELLS:
        cells = np.floor(scan.p_station[near] / cell).astype(np.int64) + 1000
        keys = (cells[:, 0] * 10_000 + cells[:, 1]) * 10_000 + cells[:, 2]
        chosen = near[np.unique(keys, return_index=True)[1]]
        if len(chosen) <= _N_SHOWN:
            break
    return np.asarray(chosen, dtype=np.intp)


def _figure_3d(title: str) -> go.Figure:
    """Return an empty scene with equal axes in the station frame."""
    titles = {f"{axis}axis": {"title": {"text": f"{axis}, station [m]"}} for axis in "xyz"}
    axes = {name: axis | {"nticks": 6} for name, axis in titles.items()}
    scene = {"aspectmode": "data", "camera": _CAMERA, "dragmode": "turntable"}
    figure = blank_figure(title)
    figure.update_layout(scene=axes | scene, margin={"l": 0, "r": 0, "t": 36, "b": 0})
    return figure


def _add_3d(
    figure: go.Figure,
    p: NDArray[np.floating],
    name: str,
    hover: Any = "",
    rows: Any = None,
    **more: Any,
) -> None:
    """Draw points of a scene in single precision; further arguments go to the trace."""
    xyz = {axis: np.asarray(p[:, i], dtype=np.float32) for i, axis in enumerate("xyz")}
    look = {"mode": "markers", "name": name} | hover_of(hover, theme.Style(name, ""), rows)
    figure.add_scatter3d(**(xyz | look | more))


def _add_returns(
    figure: go.Figure,
    returns: list[MarkerReturns],
    rms: NDArray[np.float64],
    what: str,
    size: float,
) -> None:
    """Draw the returns that fits used, coloured by residual: too near, right, too far."""
    p = np.concatenate([one.p_station[one.is_used] for one in returns])
    residuals = {"mm": np.concatenate([one.residuals[one.is_used] for one in returns]) * MM}
    end = max(1.0, float(np.ceil(_COLOUR_SIGMAS * np.nanmedian(rms) * MM)))
    title = {"text": f"{what} [mm], to ±{_COLOUR_SIGMAS:g} sigma", "side": "right"}
    ticks = {"tickfont": {"family": theme.MONO, "size": 11}}
    bar = {"title": title, "thickness": 10, "len": 0.7, "outlinewidth": 0} | ticks
    scale = {"colorscale": theme.DIVERGING, "cmin": -end, "cmax": end, "colorbar": bar}
    look = {"size": size, "color": residuals["mm"]} | scale
    _add_3d(figure, p, "returns of markers", "{mm:.1f} mm", residuals, marker=look)


def _add_labels(figure: go.Figure, fits: Columns, links: Sequence[str]) -> None:
    """Draw the centres with their names."""
    style = theme.method_style(texts(fits, "fit_method")[0])
    names = zip(texts(fits, "marker"), texts(fits, "mark"), strict=True)
    shown = [f"{marker} · {mark}" if mark else marker for marker, mark in names]
    font = {"textposition": "top center", "textfont": {"size": 11, "color": theme.TEXT}}
    look = {"size": 5, "color": style.colour, "symbol": "circle-open"}
    hover = "<b>{text}</b><br>{range_m:.2f} m, {n_points:.0f} returns"
    more = {"mode": "markers+text", "text": shown, "marker": look} | font
    more |= {"ids": links} if links else {}
    _add_3d(figure, _centres(fits), f"centres, {style.label}", hover, fits, **more)


def _graticule() -> list[Array]:
    """Return meridians and parallels of the unit sphere."""
    turn = np.linspace(0.0, 2.0 * np.pi, 73)
    half = np.linspace(-np.pi / 2.0, np.pi / 2.0, 37)
    meridians = np.linspace(0.0, 2.0 * np.pi, _N_MERIDIANS, endpoint=False)
    parallels = np.linspace(-np.pi / 2.0, np.pi / 2.0, _N_PARALLELS + 2)[1:-1]
    places = [(np.full_like(half, longitude), half) for longitude in meridians]
    places += [(turn, np.full_like(turn, latitude)) for latitude in parallels]
    return [
        np.column_stack([np.cos(b) * np.cos(a), np.cos(b) * np.sin(a), np.sin(b)])
        for a, b in places
    ]


def _centres(rows: Columns) -> Array:
    """Return the places of fits in the station frame, (n, 3) [m]."""
    return np.column_stack([floats(rows, f"{axis}_m") for axis in "xyz"])
