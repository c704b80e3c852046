"""Figures of a survey: errors of sphere centres, and residuals of a station.

Errors exist only against truth; without truth the figure shows the predicted sigma, and its title
names it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from spheremark.pipelines.published import TABLE_2
from spheremark.web import theme
from spheremark.web.columns import (
    MM,
    Columns,
    by_method,
    floats,
    has_errors,
    known_values,
    lane_and_number,
    lane_order,
    largest,
    select,
    texts,
)
from spheremark.web.figures.elements import (
    RATIO_AXIS,
    Look,
    add_binned,
    add_line,
    add_points,
    add_tolerance,
    binned_rms,
    blank_figure,
    group_by_axis,
    make_log,
)

_RANGE_BIN = 1.0  # [m]; as the view accuracy_by_distance
_COUNT_BIN = 20  # as the view accuracy_by_point_count
_LABEL_GAP = 0.05  # between names of lanes, as a share of the largest error
_STUDY = theme.Style("study, Table 2", theme.TEXT, "x-thin")
_SYMBOLS = {"x": "circle", "y": "diamond", "z": "square"}


def error_against_distance(fits: Columns, tolerance_m: float, *, is_log: bool = False) -> go.Figure:
    """Draw the error of each sphere centre against its distance."""
    figure = _quality_figure(fits, "sphere centres against distance", "Distance [m]", tolerance_m)
    _add_fits(figure, fits, "range_m", _RANGE_BIN)
    _add_study(figure, fits, TABLE_2.ranges)
    _scale(figure, is_log=is_log)
    return figure


def error_against_count(fits: Columns, tolerance_m: float, *, is_log: bool = False) -> go.Figure:
    """Draw the error of each sphere centre against its returns, on a logarithmic axis."""
    what = "sphere centres against point count"
    figure = _quality_figure(fits, what, "Returns on the sphere", tolerance_m)
    _add_fits(figure, fits, "n_points", _COUNT_BIN)
    _add_study(figure, fits, TABLE_2.n_points)
    _scale(figure, is_log=is_log)
    figure.update_xaxes(**RATIO_AXIS)
    return figure


def error_along_lane(fits: Columns, tolerance_m: float) -> go.Figure:
    """Draw the mean error of the centres at each stop along its lane (Figure 11 of the study)."""
    what = "sphere centres along the lane, mean per stop"
    figure = _quality_figure(fits, what, "Stop", tolerance_m)
    order = sorted(set(texts(fits, "stop")), key=lane_order)
    is_numbered = all(lane_and_number(stop)[1] is not None for stop in order)
    for method, rows in by_method(fits):
        _add_lanes(figure, method, rows, order, is_numbered=is_numbered)
    if is_numbered:
        lanes = sorted({lane_and_number(stop)[0] for stop in order})
        title = f"Stop along {lanes[0]}" if len(lanes) == 1 else "Stop along its lane"
        figure.update_xaxes(title_text=title, dtick=1)
        if len(lanes) > 1:
            _name_lanes(figure)
    else:
        figure.update_xaxes(type="category", categoryorder="array", categoryarray=order)
    figure.update_yaxes(rangemode="tozero")
    return figure


def station_residuals(
    observations: Columns, tolerance_m: float, *, links: Sequence[str] = ()
) -> go.Figure:
    """Draw the residuals of each marker by axis, with bars of twice their sigma about zero."""
    title = "Residuals of the station, by marker and axis"
    figure = blank_figure(title, "Mark", "Observed - computed [mm]")
    pairs = zip(texts(observations, "mark"), texts(observations, "marker"), strict=True)
    names = [mark or marker for mark, marker in pairs]
    for axis, symbol in _SYMBOLS.items():
        sigmas = floats(observations, f"sigma_{axis}_m") * MM
        values = floats(observations, f"residual_{axis}_m") * MM
        zeros = np.where(np.isfinite(values), 0.0, np.nan)
        style = theme.Style(f"{axis}, with ±2 sigma", theme.AXES[axis], symbol)
        bars = {"array": 2.0 * sigmas, "color": theme.BAR, "thickness": 5, "width": 0}
        group = {"offsetgroup": axis, "legendgroup": axis}
        add_line(figure, names, zeros, style, error_y=bars, line_width=0, showlegend=False, **group)
        hover = f"<b>{{x}}</b><br>{axis} {{y:.1f}} mm, sigma {{sigma_{axis}_m:mm}} mm"
        linked = group | ({"ids": links} if links else {})
        add_points(figure, names, values, style, hover, observations, **linked)
    if len(names) and largest(floats(observations, "residual_x_m")) > tolerance_m / 2:
        add_tolerance(figure, tolerance_m)
    group_by_axis(figure, 0.35)
    return figure


def _quality_figure(columns: Columns, what: str, x_title: str, tolerance_m: float) -> go.Figure:
    """Return a figure with an axis for error, or for predicted sigma where there is no truth."""
    quality = "Error" if has_errors(columns) else "Predicted sigma"
    figure = blank_figure(f"{quality} of {what}", x_title, f"{quality}, 3-D [mm]")
    add_tolerance(figure, tolerance_m)
    return figure


def _scale(figure: go.Figure, *, is_log: bool) -> None:
    """Set the axes of a scatter: from zero, or both logarithmic."""
    kind = "log" if is_log else "linear"
    figure.update_xaxes(type=kind)
    figure.update_yaxes(type=kind, rangemode="normal" if is_log else "tozero")
    if is_log:
        figure.update_xaxes(**RATIO_AXIS)
        make_log(figure)


def _add_fits(figure: go.Figure, fits: Columns, column: str, width: float) -> None:
    """Draw the centres of each method, the RMS of each bin, and the predicted sigma."""
    quality = "error_3d_m" if has_errors(fits) else "sigma_3d_m"
    hover = (
        "<b>{stop} {marker}</b> {mark}<br>{y:.1f} mm at {range_m:.2f} m, {n_points:.0f} returns"
        "<br>{reason}"
    )
    for method, rows in by_method(fits):
        style = theme.method_style(method)
        known = select(rows, np.isfinite(floats(rows, quality)))
        x, y = floats(known, column), floats(known, quality) * MM
        weak = np.array(texts(known, "status"), dtype=object) != "ok"
        look = {"marker_size": 6, "marker_opacity": 0.55, "legendgroup": style.label}
        look["marker_symbol"] = np.where(weak, f"{style.symbol}-open", style.symbol).tolist()
        add_points(figure, x, y, style, hover, known, **look)
        add_binned(figure, style, x, y, width)
        if quality == "error_3d_m" and method == "along_beam":
            middles, sigmas = binned_rms(x, floats(known, "sigma_3d_m") * MM, width)
            area = {"line_dash": "dot", "fill": "tozeroy", "fillcolor": style.band}
            named = style._replace(label="predicted sigma (ours)")
            hover_area = "predicted {y:.1f} mm about {x:.4g}"
            add_line(figure, middles, sigmas, named, hover_area, line_width=1.5, **area)


def _add_study(figure: go.Figure, fits: Columns, x: NDArray[np.float64]) -> None:
    """Draw the published Table 2 over errors."""
    if has_errors(fits):
        rows = {"range_m": TABLE_2.ranges, "n_points": TABLE_2.n_points}
        hover = "{y:.1f} mm at {range_m:.2f} m, {n_points:.0f} returns"
        edge = {"marker_line": {"color": theme.TEXT, "width": 1.5}}
        add_points(figure, x, TABLE_2.errors_3d * MM, _STUDY, hover, rows, **edge)


def _add_lanes(
    figure: go.Figure, method: str, rows: Columns, order: Sequence[str], *, is_numbered: bool
) -> None:
    """Draw the mean per stop of one method, a line for each lane, and the largest as a whisker."""
    style, stops = theme.method_style(method), np.array(texts(rows, "stop"), dtype=object)
    quality = floats(rows, "error_3d_m" if has_errors(rows) else "sigma_3d_m") * MM
    samples = {stop: known_values(quality[stops == stop]) for stop in order}
    lanes: dict[str, list[str]] = {}
    for stop in order:
        if len(samples[stop]):
            lanes.setdefault(lane_and_number(stop)[0], []).append(stop)
    for i, (lane, members) in enumerate(lanes.items()):
        own = [samples[stop] for stop in members]
        about = {
            "stop": np.array(members, dtype=object),
            "n": np.array([len(sample) for sample in own]),
            "largest": np.array([sample.max() for sample in own]),
        }
        means = np.array([sample.mean() for sample in own])
        bars = {"symmetric": False, "array": about["largest"] - means, "arrayminus": 0.0 * means}
        bars |= {"color": style.colour, "thickness": 1, "width": 5}
        x: list[Any] = [lane_and_number(stop)[1] for stop in members] if is_numbered else members
        hover = "<b>{stop}</b><br>mean {y:.1f} mm of {n:.0f} markers<br>largest {largest:.1f} mm"
        line: Look = {"mode": "lines+markers", "line": {"color": style.colour, "width": 2.5}}
        line |= {"legendgroup": style.label, "showlegend": i == 0, "meta": lane}
        add_points(figure, x, means, style, hover, about, marker_size=9, error_y=bars, **line)


def _name_lanes(figure: go.Figure) -> None:
    """Write the name of each lane before its first stop, without overlap."""
    lines = figure.data
    ends = np.array([line.y[0] for line in lines])
    top = max(float(np.max(np.add(line.y, line.error_y.array))) for line in lines)
    first, last = min(min(line.x) for line in lines), max(max(line.x) for line in lines)
    place = {"showarrow": False, "xanchor": "right", "xshift": -8}
    for line, y in zip(lines, apart(ends, _LABEL_GAP * top), strict=True):
        font = {"size": 11, "color": line.line.color}
        figure.add_annotation(x=line.x[0], y=y, text=line.meta, font=font, **place)
    figure.update_xaxes(range=[first - 0.9, last + 0.35])


def apart(values: NDArray[np.float64], gap: float) -> NDArray[np.float64]:
    """Return the values nearest to the given ones with a gap between any two."""
    order = np.argsort(values)
    steps = gap * np.arange(len(values))
    moved = np.empty(len(values))
    moved[order] = isotonic_regression(values[order] - steps).x + steps
    return moved
