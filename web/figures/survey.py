"""Figures of a survey: from columns, named and in the units of the database, to Plotly.

Metres come in and millimetres are drawn where that is what one reads. Errors exist only against
truth; where there is none, the same figure shows the predicted sigma and says so in its title.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from spheremark.pipelines.published import TABLE_2
from spheremark.web import theme

Columns = Mapping[str, NDArray[Any]]

_MM = 1e3  # [mm/m]
_RANGE_BIN = 1.0  # [m]; as the view accuracy_by_distance
_COUNT_BIN = 20  # as the view accuracy_by_point_count
ANGLE_BIN = 10.0  # [deg]; as the view accuracy_by_included_angle
_RATIOS = [step * 10.0**power for power in range(-2, 5) for step in (1, 2, 5)]
_RATIO_AXIS = {
    "type": "log",
    "tickvals": _RATIOS,
    "ticktext": [f"{value:g}" for value in _RATIOS],
}
_LABEL_GAP = 0.05  # between names of lanes, as a share of the largest error
_STOP_NUMBER = re.compile(r"^(.*?)[\s._-]*(?:[A-Za-z]*)(\d+)$")


def floats(columns: Columns, name: str) -> NDArray[np.float64]:
    """Return a column as floats; NULL is NaN."""
    return np.asarray(columns[name], dtype=np.float64)


def texts(columns: Columns, name: str) -> list[str]:
    """Return a column as texts; NULL is nothing."""
    return ["" if value is None else str(value) for value in columns[name]]


def select(columns: Columns, keep: NDArray[np.bool_]) -> dict[str, NDArray[Any]]:
    """Return the rows of a table that are to be kept."""
    return {name: column[keep] for name, column in columns.items()}


def has_errors(columns: Columns) -> bool:
    """Whether anything is known about the truth of these rows."""
    return bool(np.isfinite(floats(columns, "error_3d_m")).any())


def on_marks(columns: Columns) -> NDArray[np.bool_]:
    """Tell which fits stand on a mark; all of them where no mark is known."""
    known = np.isfinite(floats(columns, "error_3d_m"))
    if known.any():
        return known
    matched = np.array([mark != "" for mark in texts(columns, "mark")], dtype=np.bool_)
    return matched if matched.any() else np.ones(len(matched), dtype=np.bool_)


def lane_and_number(stop: str) -> tuple[str, int | None]:
    """Split the name of a stop into its lane and its number along it: ``lane-2-stop-5``."""
    found = _STOP_NUMBER.match(stop)
    return (found[1] or "lane", int(found[2])) if found else (stop, None)


def error_against_distance(fits: Columns, tolerance_m: float, *, is_log: bool = False) -> go.Figure:
    """Draw the error of each sphere centre against its distance."""
    figure = _quality_figure(fits, "sphere centres against distance", tolerance_m)
    _add_fits(figure, fits, floats(fits, "range_m"), _RANGE_BIN)
    _add_study(figure, fits, TABLE_2.ranges)
    _scale(figure, "Distance [m]", is_log=is_log)
    return figure


def error_against_count(fits: Columns, tolerance_m: float, *, is_log: bool = False) -> go.Figure:
    """Draw the error of each sphere centre against the number of its returns, always by ratio."""
    figure = _quality_figure(fits, "sphere centres against point count", tolerance_m)
    _add_fits(figure, fits, floats(fits, "n_points"), _COUNT_BIN)
    _add_study(figure, fits, TABLE_2.n_points)
    _scale(figure, "Returns on the sphere", is_log=is_log)
    figure.update_xaxes(**_RATIO_AXIS)
    return figure


def error_along_lane(fits: Columns, tolerance_m: float) -> go.Figure:
    """Draw the mean error of the centres at each stop along its lane (Figure 11 of the study)."""
    figure = _quality_figure(fits, "sphere centres along the lane, mean per stop", tolerance_m)
    order = _in_lane_order(texts(fits, "stop"))
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
    """Draw what each marker disagrees with the station, by axis, with twice its sigma."""
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
    figure.add_hline(y=0, line={"color": theme.LINE, "width": 1}, layer="below")
    figure.update_xaxes(title_text="Mark", type="category")
    figure.update_yaxes(title_text="Observed - computed [mm]")
    figure.update_layout(scattermode="group", scattergap=0.35)
    return figure


def by_method(columns: Columns) -> Iterator[tuple[str, dict[str, NDArray[Any]]]]:
    """Return the rows of each fitting method, the one that counts first."""
    methods = np.array(texts(columns, "fit_method"), dtype=object)
    for method in sorted(set(methods.tolist()), key=lambda name: (name != "along_beam", name)):
        yield method, select(columns, methods == method)


def blank_figure(title: str) -> go.Figure:
    """Return an empty figure that looks like all others."""
    return go.Figure(layout={"template": theme.template(), "title": {"text": title}})


def _quality_figure(columns: Columns, what: str, tolerance_m: float) -> go.Figure:
    """Return a figure with an axis for error, or for predicted sigma where there is no truth."""
    quality = "Error" if has_errors(columns) else "Predicted sigma"
    figure = blank_figure(f"{quality} of {what}")
    figure.update_yaxes(title_text=f"{quality}, 3-D [mm]")
    add_tolerance(figure, tolerance_m)
    return figure


def add_tolerance(figure: go.Figure, tolerance_m: float) -> None:
    """Draw the tolerance: one look, everywhere."""
    figure.add_hline(
        y=tolerance_m * _MM,
        line={"color": theme.TOLERANCE, "width": 1.5, "dash": "dash"},
        annotation={
            "text": f"tolerance {tolerance_m * _MM:g} mm",
            "font": {"size": 12, "color": theme.TOLERANCE},
            "bgcolor": theme.RAISED,
            "borderpad": 1,
            "yshift": 2,
        },
        annotation_position="top right",
    )


def _scale(figure: go.Figure, x_title: str, *, is_log: bool) -> None:
    """Choose the axes of a scatter: from zero, or both logarithmic."""
    kind = "log" if is_log else "linear"
    figure.update_xaxes(title_text=x_title, type=kind)
    figure.update_yaxes(type=kind, rangemode="normal" if is_log else "tozero")
    if is_log:
        figure.update_xaxes(**_RATIO_AXIS)
        make_log(figure)


def make_log(figure: go.Figure) -> None:
    """Make the axis of errors logarithmic; Plotly wants logarithms of annotations, not of lines."""
    figure.update_yaxes(**_RATIO_AXIS, rangemode="normal")
    for line, note in zip(figure.layout.shapes, figure.layout.annotations, strict=False):
        if note.yref == "y":
            note.y = float(np.log10(line.y0))


def _quality_mm(columns: Columns) -> NDArray[np.float64]:
    """Return the error, or the predicted sigma where there is no truth [mm]."""
    return floats(columns, "error_3d_m" if has_errors(columns) else "sigma_3d_m") * _MM


def _add_fits(figure: go.Figure, fits: Columns, x: NDArray[np.float64], width: float) -> None:
    """Draw the centres of each method, the RMS of each bin, and what was predicted."""
    is_error = has_errors(fits)
    methods = np.array(texts(fits, "fit_method"), dtype=object)
    for method, rows in by_method(fits):
        style, own_x = theme.method_style(method), x[methods == method]
        y = floats(rows, "error_3d_m" if is_error else "sigma_3d_m") * _MM
        _add_points(figure, style, own_x, y, rows)
        add_binned(figure, style, own_x, y, width)
        if is_error and method == "along_beam":
            known = np.isfinite(y)
            sigma = floats(rows, "sigma_3d_m")[known] * _MM
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


def details(rows: Columns, words: Sequence[str], numbers: Sequence[str]) -> list[list[Any]]:
    """Return what a person reads when pointing at a row."""
    columns: list[Iterable[Any]] = [texts(rows, name) for name in words]
    columns += [floats(rows, name).round(4).tolist() for name in numbers]
    return [list(row) for row in zip(*columns, strict=True)]


def _add_study(figure: go.Figure, fits: Columns, x: NDArray[np.float64]) -> None:
    """Lay the study's own Table 2 over errors; a click on its name in the legend takes it away."""
    if not has_errors(fits):
        return
    figure.add_scatter(
        x=x,
        y=TABLE_2.errors_3d * _MM,
        mode="markers",
        name="study, Table 2",
        marker={"symbol": "x-thin", "size": 8, "line": {"color": theme.TEXT, "width": 1.5}},
        customdata=np.column_stack([TABLE_2.ranges, TABLE_2.n_points]),
        hovertemplate="%{y:.1f} mm at %{customdata[0]:.2f} m, %{customdata[1]:.0f} returns"
        "<extra>study, Table 2</extra>",
    )


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
        line={"color": style.colour, "width": 2.5, "dash": style.dash},
        hovertemplate=f"RMS %{{y:.1f}} mm about %{{x:.4g}}<extra>{style.label}</extra>",
    )


def _add_prediction(
    figure: go.Figure,
    style: theme.MethodStyle,
    x: NDArray[np.float64],
    sigma_mm: NDArray[np.float64],
    width: float,
) -> None:
    """Draw the predicted sigma of each bin, as the area that it fills."""
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


def binned_rms(
    x: NDArray[np.float64], y: NDArray[np.float64], width: float
) -> tuple[list[float], list[float]]:
    """Return the mean place and the RMS of y in bins of x, leaving out what is not known."""
    known = np.isfinite(x) & np.isfinite(y)
    x, y = x[known], y[known]
    bins = np.floor(x / width)
    members = [bins == value for value in np.unique(bins)]
    return (
        [float(np.mean(x[member])) for member in members],
        [float(np.sqrt(np.mean(y[member] ** 2))) for member in members],
    )


def _in_lane_order(stops: Iterable[str]) -> list[str]:
    """Return the stops once each, lane by lane, in the order of their numbers."""
    return sorted(set(stops), key=lambda stop: (lane_and_number(stop)[0], _number(stop), stop))


def _number(stop: str) -> int:
    """Return the number of a stop along its lane; one without comes first."""
    number = lane_and_number(stop)[1]
    return -1 if number is None else number


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
    """Write the name of each lane before its first stop, one above the other."""
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
    """Return values moved as little as it takes to leave a gap between any two."""
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
    sigma = floats(observations, f"sigma_{axis}_m") * _MM
    values = floats(observations, f"residual_{axis}_m") * _MM
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


def known_values(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what is known of a column."""
    return values[np.isfinite(values)]


def largest(values: NDArray[np.float64]) -> float:
    """Return the largest magnitude that is known, or zero."""
    known = known_values(values)
    return float(np.abs(known).max()) if len(known) else 0.0
