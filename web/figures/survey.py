"""Figures of a survey: errors of sphere centres, and residuals of a station.

Errors exist only against truth; without truth the figure shows the predicted sigma, and its title
names it.
"""

from __future__ import annotations

from collections.abc import Sequence

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
    add_binned,
    add_tolerance,
    binned_rms,
    blank_figure,
    details,
    group_by_axis,
    make_log,
)

_RANGE_BIN = 1.0  # [m]; as the view accuracy_by_distance
_COUNT_BIN = 20  # as the view accuracy_by_point_count
ANGLE_BIN = 10.0  # [deg]; as the view accuracy_by_included_angle


_LABEL_GAP = 0.05  # between names of lanes, as a share of the largest error


def error_against_distance(fits: Columns, tolerance_m: float, *, is_log: bool = False) -> go.Figure:
    """Draw the error of each sphere centre against its distance."""
    figure = _quality_figure(fits, "sphere centres against distance", tolerance_m)
    _add_fits(figure, fits, floats(fits, "range_m"), _RANGE_BIN)
    _add_study(figure, fits, TABLE_2.ranges)
    _scale(figure, "Distance [m]", is_log=is_log)
    return figure


def error_against_count(fits: Columns, tolerance_m: float, *, is_log: bool = False) -> go.Figure:
    """Draw the error of each sphere centre against its returns, on a logarithmic axis."""
    figure = _quality_figure(fits, "sphere centres against point count", tolerance_m)
    _add_fits(figure, fits, floats(fits, "n_points"), _COUNT_BIN)
    _add_study(figure, fits, TABLE_2.n_points)
    _scale(figure, "Returns on the sphere", is_log=is_log)
    figure.update_xaxes(**RATIO_AXIS)
    return figure


def error_along_lane(fits: Columns, tolerance_m: float) -> go.Figure:
    """Draw the mean error of the centres at each stop along its lane (Figure 11 of the study)."""
    figure = _quality_figure(fits, "sphere centres along the lane, mean per stop", tolerance_m)
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
        figure.update_xaxes(
            title_text="Stop", type="category", categoryorder="array", categoryarray=order
        )
    figure.update_yaxes(rangemode="tozero")
    return figure


def station_residuals(observations: Columns, tolerance_m: float) -> go.Figure:
    """Draw the residuals of each marker by axis, with twice their sigma."""
    figure = blank_figure("Residuals of the station, by marker and axis")
    names = [
        mark or marker
        for marker, mark in zip(
            texts(observations, "marker"), texts(observations, "mark"), strict=True
        )
    ]
    for axis, symbol in (("x", "circle"), ("y", "diamond"), ("z", "square")):
        _add_residuals(figure, observations, names, axis, symbol)
    if len(names) and largest(floats(observations, "residual_x_m")) > tolerance_m / 2:
        add_tolerance(figure, tolerance_m)
    group_by_axis(figure, "Mark", "Observed - computed [mm]", 0.35)
    return figure


def _quality_figure(columns: Columns, what: str, tolerance_m: float) -> go.Figure:
    """Return a figure with an axis for error, or for predicted sigma where there is no truth."""
    quality = "Error" if has_errors(columns) else "Predicted sigma"
    figure = blank_figure(f"{quality} of {what}")
    figure.update_yaxes(title_text=f"{quality}, 3-D [mm]")
    add_tolerance(figure, tolerance_m)
    return figure


def _scale(figure: go.Figure, x_title: str, *, is_log: bool) -> None:
    """Set the axes of a scatter: from zero, or both logarithmic."""
    kind = "log" if is_log else "linear"
    figure.update_xaxes(title_text=x_title, type=kind)
    figure.update_yaxes(type=kind, rangemode="normal" if is_log else "tozero")
    if is_log:
        figure.update_xaxes(**RATIO_AXIS)
        make_log(figure)


def _quality_mm(columns: Columns) -> NDArray[np.float64]:
    """Return the error, or the predicted sigma where there is no truth [mm]."""
    return floats(columns, "error_3d_m" if has_errors(columns) else "sigma_3d_m") * MM


def _add_fits(figure: go.Figure, fits: Columns, x: NDArray[np.float64], width: float) -> None:
    """Draw the centres of each method, the RMS of each bin, and the predicted sigma."""
    is_error = has_errors(fits)
    methods = np.array(texts(fits, "fit_method"), dtype=object)
    for method, rows in by_method(fits):
        style, own_x = theme.method_style(method), x[methods == method]
        y = floats(rows, "error_3d_m" if is_error else "sigma_3d_m") * MM
        _add_points(figure, style, own_x, y, rows)
        add_binned(figure, style, own_x, y, width)
        if is_error and method == "along_beam":
            known = np.isfinite(y)
            sigma = floats(rows, "sigma_3d_m")[known] * MM
            _add_prediction(figure, style, own_x[known], sigma, width)


def _add_points(
    figure: go.Figure,
    style: theme.MethodStyle,
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    rows: Columns,
) -> None:
    """Draw one point for each centre whose quality is known; weak ones are hollow."""
    known = np.isfinite(y)
    x, y, rows = x[known], y[known], select(rows, known)
    weak = np.array(texts(rows, "status"), dtype=object) != "ok"
    about = details(rows, ("stop", "marker", "mark", "reason"), ("range_m", "n_points"))
    figure.add_scatter(
        x=x,
        y=y,
        mode="markers",
        name=style.label,
        legendgroup=style.label,
        marker={
            "color": style.colour,
            "size": 6,
            "opacity": 0.55,
            "symbol": np.where(weak, f"{style.symbol}-open", style.symbol).tolist(),
        },
        customdata=about,
        hovertemplate=(
            "<b>%{customdata[0]} %{customdata[1]}</b> %{customdata[2]}<br>%{y:.1f} mm at "
            "%{customdata[4]:.2f} m, %{customdata[5]:.0f} returns<br>%{customdata[3]}"
            f"<extra>{style.label}</extra>"
        ),
    )


def _add_study(figure: go.Figure, fits: Columns, x: NDArray[np.float64]) -> None:
    """Draw the published Table 2 over errors."""
    if not has_errors(fits):
        return
    figure.add_scatter(
        x=x,
        y=TABLE_2.errors_3d * MM,
        mode="markers",
        name="study, Table 2",
        marker={"symbol": "x-thin", "size": 8, "line": {"color": theme.TEXT, "width": 1.5}},
        customdata=np.column_stack([TABLE_2.ranges, TABLE_2.n_points]),
        hovertemplate="%{y:.1f} mm at %{customdata[0]:.2f} m, %{customdata[1]:.0f} returns"
        "<extra>study, Table 2</extra>",
    )


def _add_prediction(
    figure: go.Figure,
    style: theme.MethodStyle,
    x: NDArray[np.float64],
    sigma_mm: NDArray[np.float64],
    width: float,
) -> None:
    """Draw the predicted sigma of each bin as an area."""
    middles, values = binned_rms(x, sigma_mm, width)
    figure.add_scatter(
        x=middles,
        y=values,
        mode="lines",
        name="predicted sigma (ours)",
        line={"color": style.colour, "width": 1.5, "dash": "dot"},
        fill="tozeroy",
        fillcolor=style.band,
        hovertemplate="predicted %{y:.1f} mm about %{x:.4g}<extra></extra>",
    )


def _add_lanes(
    figure: go.Figure, method: str, rows: Columns, order: Sequence[str], *, is_numbered: bool
) -> None:
    """Draw the mean per stop of one method, a line for each lane, and the largest as a whisker."""
    style, stops = theme.method_style(method), np.array(texts(rows, "stop"), dtype=object)
    quality = _quality_mm(rows)
    lanes: dict[str, list[str]] = {}
    for stop in order:
        if np.isfinite(quality[stops == stop]).any():
            lanes.setdefault(lane_and_number(stop)[0], []).append(stop)
    for i, (lane, members) in enumerate(lanes.items()):
        samples = [known_values(quality[stops == stop]) for stop in members]
        _add_lane(figure, style, members, samples, is_numbered=is_numbered)
        figure.data[-1].update(showlegend=i == 0, meta=lane)


def _name_lanes(figure: go.Figure) -> None:
    """Write the name of each lane before its first stop, without overlap."""
    lines = figure.data
    ends = np.array([line.y[0] for line in lines])
    top = max(float(np.max(np.add(line.y, line.error_y.array))) for line in lines)
    first, last = min(min(line.x) for line in lines), max(max(line.x) for line in lines)
    for line, y in zip(lines, apart(ends, _LABEL_GAP * top), strict=True):
        figure.add_annotation(
            x=line.x[0],
            y=y,
            text=line.meta,
            showarrow=False,
            xanchor="right",
            xshift=-8,
            font={"size": 11, "color": line.line.color},
        )
    figure.update_xaxes(range=[first - 0.9, last + 0.35])


def apart(values: NDArray[np.float64], gap: float) -> NDArray[np.float64]:
    """Return the values nearest to the given ones with a gap between any two."""
    order = np.argsort(values)
    steps = gap * np.arange(len(values))
    moved = np.empty(len(values))
    moved[order] = isotonic_regression(values[order] - steps).x + steps
    return moved


def _add_lane(
    figure: go.Figure,
    style: theme.MethodStyle,
    stops: Sequence[str],
    samples: Sequence[NDArray[np.float64]],
    *,
    is_numbered: bool,
) -> None:
    """Draw the mean of each sample along one lane, and the largest as a whisker."""
    means = np.array([sample.mean() for sample in samples])
    largest = np.array([sample.max() for sample in samples])
    figure.add_scatter(
        x=[lane_and_number(stop)[1] for stop in stops] if is_numbered else list(stops),
        y=means,
        mode="lines+markers",
        name=style.label,
        legendgroup=style.label,
        line={"color": style.colour, "width": 2.5},
        marker={"color": style.colour, "size": 9, "symbol": style.symbol},
        error_y={
            "type": "data",
            "symmetric": False,
            "array": largest - means,
            "arrayminus": np.zeros(len(stops)),
            "color": style.colour,
            "thickness": 1,
            "width": 5,
        },
        customdata=[[stop, len(s), s.max()] for stop, s in zip(stops, samples, strict=True)],
        hovertemplate="<b>%{customdata[0]}</b><br>mean %{y:.1f} mm of %{customdata[1]} markers<br>"
        f"largest %{{customdata[2]:.1f}} mm<extra>{style.label}</extra>",
    )


def _add_residuals(
    figure: go.Figure, observations: Columns, names: Sequence[str], axis: str, symbol: str
) -> None:
    """Draw the residuals of one axis with bars of twice their sigma about zero."""
    sigma = floats(observations, f"sigma_{axis}_m") * MM
    values = floats(observations, f"residual_{axis}_m") * MM
    figure.add_scatter(
        x=list(names),
        y=np.where(np.isfinite(values), 0.0, np.nan),
        mode="lines",
        line={"width": 0},
        offsetgroup=axis,
        legendgroup=axis,
        showlegend=False,
        hoverinfo="skip",
        error_y={"array": 2.0 * sigma, "color": theme.BAR, "thickness": 5, "width": 0},
    )
    figure.add_scatter(
        x=list(names),
        y=values,
        mode="markers",
        name=f"{axis}, with ±2 sigma",
        offsetgroup=axis,
        legendgroup=axis,
        marker={"color": theme.AXES[axis], "size": 8, "symbol": symbol},
        customdata=sigma,
        hovertemplate=f"<b>%{{x}}</b><br>{axis} %{{y:.1f}} mm, sigma %{{customdata:.1f}} mm"
        "<extra></extra>",
    )
