"""Dashboards of accuracy from aggregates: medians, bands of 95 %, the worst rows by name.

The ``ids`` of a trace are the links of its points: an address, or a filter that begins with ``?``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
import plotly.graph_objects as go

from spheremark.pipelines.positioning.subsets import theory_of_pairs
from spheremark.pipelines.published import TABLE_2
from spheremark.web import theme
from spheremark.web.columns import MM, Columns, by_method, floats, known_values, texts
from spheremark.web.figures.elements import (
    RATIO_AXIS,
    add_line,
    add_note,
    add_points,
    add_strokes,
    add_tolerance,
    blank_figure,
    make_log,
    make_map,
)
from spheremark.web.figures.included_angle import THEORIES, add_limits_of_study, add_theory
from spheremark.web.figures.maps import MARK_STYLE, NAMES, ellipse_factor, ellipse_outline
from spheremark.web.links import filter_link, stop_url, survey_url

Row = Mapping[str, Any]

LEVELS = (0.5, 1, 2, 3, 5, 7, 10, *range(15, 90, 5), 90, 93, 95, 97, 98, 99, 99.5)
"""Percentages of the quantiles of a distribution."""
_TOP = 1.25  # of the greatest 97.5 % quantile is the end of a linear axis
_N_OUTLINES = 150  # ellipses of one map: those of the worst stations
_N_NAMED = 40  # marks and stations with their names
_STUDY = theme.Style("study, Table 2", theme.TEXT, "x-thin")


@dataclass(frozen=True, slots=True, kw_only=True)
class Shown:
    """What all figures of a selection share."""

    is_error: bool
    tolerance_m: float
    is_log: bool = False
    n_marks: int = 2
    resection: str = "free_station"

    @property
    def quality(self) -> str:
        """The name of what is drawn."""
        return "Error" if self.is_error else "Predicted sigma"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Variable:
    """A variable on the x axis of bins, with the filters that choose a bin."""

    title: str
    axis: str
    unit: str
    filters: tuple[str, str] | None = None
    is_log: bool = False


_VARIABLES = {
    "distance": _Variable(
        title="{quality} of sphere centres against distance",
        axis="Distance [m]",
        unit="m",
        filters=("range_from_m", "range_to_m"),
    ),
    "count": _Variable(
        title="{quality} of sphere centres against point count",
        axis="Returns on the sphere",
        unit="returns",
        filters=("count_from", "count_to"),
        is_log=True,
    ),
    "incidence": _Variable(
        title="{quality} of sphere centres against incidence",
        axis="Mean incidence of the used beams [deg]",
        unit="deg",
        filters=("incidence_from_deg", "incidence_to_deg"),
    ),
    "angle": _Variable(
        title="{quality} of the station against included angle",
        axis="Included angle of two marks [deg]",
        unit="deg",
    ),
}


def binned(name: str, rows: Sequence[Row], shown: Shown) -> go.Figure:
    """Draw medians, bands of 95 % and the worst rows in bins of a variable."""
    about = _VARIABLES[name]
    horizontal = "horizontal" if name == "angle" else "3-D"
    figure = blank_figure(
        about.title.format(quality=shown.quality), about.axis, f"{shown.quality}, {horizontal} [mm]"
    )
    add_tolerance(figure, shown.tolerance_m)
    for method, bins in _methods(rows):
        _add_band(figure, method, bins)
    for method, bins in _methods(rows):
        _add_worst(figure, method, bins, about)
        _add_medians(figure, method, bins, about)
        if shown.is_error and method == "along_beam":
            _add_predicted(figure, bins)
    if name in ("distance", "count") and shown.is_error:
        _add_study(figure, name)
    if name == "angle":
        add_theory(figure, _sigma_axis(rows, shown.resection))
        add_limits_of_study(figure, is_shaded=shown.resection == "paper")
        figure.update_xaxes(range=[0, 180], dtick=30)
    if about.is_log:
        figure.update_xaxes(**RATIO_AXIS)
    if shown.is_log:
        make_log(figure)
    else:
        highest = [MM * shown.tolerance_m, *_mm(rows, "p975_m").tolist()]
        highest += [float(max(line.y)) for line in figure.data if line.name == _STUDY.label]
        figure.update_yaxes(range=[0.0, _TOP * float(np.nanmax(highest))])
    return figure


def distribution(rows: Sequence[Row], shown: Shown) -> go.Figure:
    """Draw the share of centres whose error is at most a length, by method."""
    quality = shown.quality
    figure = blank_figure(
        f"Share of sphere centres within an {quality.lower()}"
        if shown.is_error
        else "Share of sphere centres within a predicted sigma",
        f"{quality}, 3-D [mm]",
        "Centres within [%]",
    )
    for row in rows:
        style = theme.method_style(row["fit_method"])
        x = MM * np.array(row["quantiles_m"])
        add_line(figure, x, LEVELS, style, "{y:.1f} % within {x:.1f} mm", line_width=2.5)
    line = {"color": theme.TOLERANCE, "width": 1.5, "dash": "dash"}
    figure.add_vline(x=MM * shown.tolerance_m, line=line)
    text = f"tolerance {MM * shown.tolerance_m:g} mm"
    place = {"x": float(np.log10(MM * shown.tolerance_m)), "y": 0.02, "yanchor": "bottom"}
    add_note(figure, text, **place, xanchor="right", xshift=-4)
    figure.update_xaxes(**RATIO_AXIS)
    figure.update_yaxes(range=[0, 101], dtick=20)
    figure.add_hline(y=95.0, line={"color": theme.LINE, "width": 1}, layer="below")
    return figure


def surveys(rows: Sequence[Row], shown: Shown) -> go.Figure:
    """Draw the median and the band of 95 % of each survey by method."""
    title = f"{shown.quality} of sphere centres by survey"
    figure = blank_figure(title, "Survey", f"{shown.quality}, 3-D [mm]")
    add_tolerance(figure, shown.tolerance_m)
    for method, found in _methods(rows):
        style, median = theme.method_style(method), _mm(found, "median_m")
        bars = {
            "symmetric": False,
            "array": _mm(found, "p975_m") - median,
            "arrayminus": median - _mm(found, "p025_m"),
            "thickness": 1.5,
            "width": 4,
        }
        hover = "<b>{x}</b><br>median {y:.1f} mm, 95 % within {p95_m:mm} mm<br>{n:.0f} centres"
        ids = [survey_url(row["survey"], "accuracy") for row in found]
        x = [row["survey"] for row in found]
        more = {"error_y": bars, "offsetgroup": method, "ids": ids, "marker_size": 9}
        add_points(figure, x, median, style, hover, _columns(found, "p95_m", "n"), **more)
    figure.update_xaxes(type="category")
    figure.update_layout(scattermode="group", scattergap=0.4)
    figure.update_yaxes(rangemode="tozero")
    if shown.is_log:
        make_log(figure)
        figure.update_yaxes(type="log")
    return figure


def field_map(marks: Columns, fixes: Columns) -> go.Figure:
    """Draw marks and stations with ellipses, and errors in plan and height, in one scale.

    A station whose error is known has a line to its true place and, upwards or downwards on the
    map, a bar of its error of height; without truth the bar is twice the sigma of the height.
    """
    figure = blank_figure("Field, stations and 95 % ellipses")
    factor = ellipse_factor(marks, fixes)
    n = len(marks["mark"])
    look: dict[str, Any] = {"marker_size": 10, "cliponaxis": False}
    if n <= _N_NAMED:
        look |= {"mode": "markers+text", "text": texts(marks, "mark")} | NAMES
    x, y = floats(marks, "x_m"), floats(marks, "y_m")
    hover = "<b>{mark}</b><br>x {x:.3f} m<br>y {y:.3f} m<br>z {z_m:.3f} m"
    add_points(figure, x, y, MARK_STYLE, hover, marks, **look)
    for method, rows in reversed(list(by_method(fixes))):
        _add_stations(figure, method, rows, factor)
    make_map(figure, ", site")
    if factor:
        is_known = np.isfinite(floats(fixes, "error_3d_m")).any()
        what = "ellipses, errors, heights" if is_known else "ellipses, 2 sigma of heights"
        add_note(figure, f"{what} \N{MULTIPLICATION SIGN}{factor:g}")
    return figure


def _add_stations(figure: go.Figure, method: str, rows: Columns, factor: float) -> None:
    """Draw the stations of a method; a click on a dot, ellipse or line leads to the stop."""
    style = theme.method_style(method)
    x, y = floats(rows, "x_m"), floats(rows, "y_m")
    names = zip(texts(rows, "survey"), texts(rows, "stop"), strict=True)
    ids = [stop_url(survey, stop, method) for survey, stop in names]
    hidden = {"legendgroup": style.label, "showlegend": False, "hoverinfo": "none"}
    few = range(min(len(x), _N_OUTLINES))
    outlines = [ellipse_outline(rows, i, factor)[::2] for i in few]
    linked = {"links": [ids[i] for i in few], "step": len(outlines[0]) + 1}
    add_strokes(figure, outlines, style, line_width=1.5, meta=linked, **hidden)
    errors = np.column_stack([floats(rows, f"error_{axis}_m") for axis in "xy"])
    places = np.column_stack([x, y])
    lines = [np.stack([places[i], places[i] - factor * errors[i]]) for i in few]
    known = [line for line in lines if np.isfinite(line).all()]
    add_strokes(figure, known, style, line_width=1.0, **hidden)
    heights = floats(rows, "error_z_m")
    heights = np.where(np.isfinite(heights), heights, 2.0 * floats(rows, "sigma_z_m"))
    bars = [places[i] + [[0.0, 0.0], [0.0, factor * heights[i]]] for i in few]
    bars = [bar for bar in bars if np.isfinite(bar).all()]
    bar_look = {"line_width": 4.0, "line_color": theme.AXES["z"], "opacity": 0.6}
    add_strokes(figure, bars, style, **(hidden | bar_look))
    hover = (
        "<b>{stop}</b> {status}<br>x {x:.3f} m<br>y {y:.3f} m<br>z {z_m:.3f} m<br>"
        "sigma {sigma_3d_m:mm} mm, {n_markers:.0f} marks"
    )
    if np.isfinite(floats(rows, "error_3d_m")).any():
        hover += "<br>error {error_3d_m:mm} mm, of height {error_z_m:mm} mm"
    more = {"marker_size": 7, "legendgroup": style.label, "ids": ids}
    add_points(figure, x, y, style, hover, rows, **more)


def _methods(rows: Sequence[Row]) -> Iterator[tuple[str, list[Row]]]:
    """Yield the rows of each method, ours first."""

    def order(row: Row) -> tuple[bool, str]:
        return (row["fit_method"] != "along_beam", row["fit_method"])

    for (_, method), found in groupby(sorted(rows, key=order), key=order):
        yield method, list(found)


def _mm(rows: Sequence[Row], name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return a length of rows [mm]."""
    return MM * np.array([np.nan if row[name] is None else row[name] for row in rows], dtype=float)


def _columns(rows: Sequence[Row], *names: str) -> Columns:
    """Return columns of rows."""
    return {name: np.array([row[name] for row in rows]) for name in names}


def _add_band(figure: go.Figure, method: str, bins: Sequence[Row]) -> None:
    """Draw the band that holds 95 % of a method's rows in each bin."""
    style, x = theme.method_style(method), np.array([row["mean_x"] for row in bins])
    edge = np.concatenate([_mm(bins, "p025_m"), _mm(bins, "p975_m")[::-1]])
    look = {"fill": "toself", "fillcolor": style.band, "line_width": 0, "showlegend": False}
    add_line(figure, np.concatenate([x, x[::-1]]), edge, style, legendgroup=style.label, **look)
    figure.data[-1].name = f"{style.label}: 95 % of each bin"


def _add_medians(figure: go.Figure, method: str, bins: Sequence[Row], about: _Variable) -> None:
    """Draw the median of each bin; a click filters to the bin."""
    style = theme.method_style(method)
    x = [row["mean_x"] for row in bins]
    columns = _columns(bins, "bin_from", "bin_to", "p025_m", "p975_m", "p95_m", "n", "n_stops")
    hover = (
        "<b>{bin_from:.4g} to {bin_to:.4g} " + about.unit + "</b><br>median {y:.1f} mm"
        "<br>95 % from {p025_m:mm} to {p975_m:mm} mm<br>{n:.0f} of {n_stops:.0f} stops"
    )
    look = {"mode": "lines+markers", "line_width": 2.5, "legendgroup": style.label}
    look |= {"line_color": style.colour, "marker_size": 7}
    if about.filters:
        low, high = about.filters
        look["ids"] = [
            filter_link(**{low: f"{row['bin_from']:g}", high: f"{row['bin_to']:g}"}) for row in bins
        ]
    named = style._replace(label=f"{style.label}, median")
    add_points(figure, x, _mm(bins, "median_m"), named, hover, columns, **look)


def _add_worst(figure: go.Figure, method: str, bins: Sequence[Row], about: _Variable) -> None:
    """Draw the worst rows of each bin, each a link to its marker."""
    style, found = theme.method_style(method), [one for row in bins for one in row["worst"]]
    if not found:
        return
    weak = [one["status"] not in ("ok", "") for one in found]
    columns = _columns(found, "survey", "stop", "marker")
    hover = f"<b>{{stop}} {{marker}}</b><br>{{y:.1f}} mm at {{x:.4g}} {about.unit}<br>{{survey}}"
    look: dict[str, Any] = {"marker_size": 5, "marker_opacity": 0.45, "showlegend": False}
    look |= {"legendgroup": style.label, "ids": [_link(one, method) for one in found]}
    look["marker_symbol"] = [f"{style.symbol}-open" if one else style.symbol for one in weak]
    x, y = [one["x"] for one in found], _mm(found, "value_m")
    add_points(figure, x, y, style, hover, columns, **look)
    figure.data[-1].name = f"{style.label}: worst of each bin"


def _link(row: Row, method: str) -> str:
    """Return the address of a centre, or of a stop where several marks give a station."""
    marker = "" if " + " in row["marker"] else row["marker"]
    return stop_url(row["survey"], row["stop"], method, marker)


def _add_predicted(figure: go.Figure, bins: Sequence[Row]) -> None:
    """Draw the predicted sigma, as RMS of each bin."""
    style = theme.Style("predicted sigma (ours)", theme.OURS)
    look = {"line_dash": "dot", "line_width": 1.5}
    x = [row["mean_x"] for row in bins]
    add_line(figure, x, _mm(bins, "sigma_rms_m"), style, "predicted {y:.1f} mm", **look)


def _add_study(figure: go.Figure, name: str) -> None:
    """Draw the published Table 2."""
    x = TABLE_2.ranges if name == "distance" else TABLE_2.n_points
    edge = {"marker_line": {"color": theme.TEXT, "width": 1.5}}
    add_points(figure, x, TABLE_2.errors_3d * MM, _STUDY, "{y:.1f} mm", **edge)


def _sigma_axis(rows: Sequence[Row], resection: str) -> float:
    """Return the sigma of our centres per axis, from stations of two marks near 90 degrees."""
    if resection not in THEORIES:
        return np.nan
    ours = [row for row in rows if row["fit_method"] == "along_beam" and 80 <= row["mean_x"] <= 100]
    found = known_values(_mm(ours, "sigma_rms_m") / MM)
    at_90 = float(theory_of_pairs(resection, 1.0, np.array([np.pi / 2.0]))[0])
    return float(np.median(found)) / at_90 if len(found) else np.nan
