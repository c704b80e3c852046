"""Figures of an adjusted network: map, residuals, tests, and control marks left out in turn."""

from __future__ import annotations

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from spheremark.web import theme
from spheremark.web.columns import MM, Columns, floats, select, texts
from spheremark.web.figures.elements import (
    add_note,
    blank_figure,
    details,
    group_by_axis,
    joined_strokes,
    make_map,
)
from spheremark.web.figures.maps import ellipse_factor, ellipse_outline

_BEYOND = 2.0  # sigmas of the bars
_AXES = ("x", "y", "z")
_ELLIPSES = (("95 %", "_95", 1.5, "solid"), ("standard", "", 1.0, "dot"))
_N_NAMES = 60  # marks whose names can be read on one map


def network_map(stations: Columns, marks: Columns) -> go.Figure:
    """Draw stations and marks by redundancy, with scaled standard and 95 % ellipses."""
    figure = blank_figure("Network: ellipses and redundancy")
    factor = ellipse_factor(marks, _both(stations, marks))
    for rows, colour in ((stations, theme.OURS), (marks, theme.MARK)):
        for kind, size, width, dash in _ELLIPSES:
            outlines = [
                ellipse_outline(rows, i, factor, size=size) for i in range(len(rows["x_m"]))
            ]
            joined = joined_strokes(outlines)
            figure.add_scatter(
                x=joined[:, 0],
                y=joined[:, 1],
                mode="lines",
                line={"color": colour, "width": width, "dash": dash},
                hoverinfo="skip",
                legendgroup=kind,
                showlegend=rows is stations,
                name=f"{kind} ellipse",
            )
    _add_points(figure, stations, "station", "circle", 9)
    _add_points(figure, marks, "mark", "diamond", 9)
    make_map(figure)
    if factor:
        add_note(figure, f"ellipses \N{MULTIPLICATION SIGN}{factor:g}")
    return figure


def _both(stations: Columns, marks: Columns) -> dict[str, NDArray[np.float64]]:
    """Return positions and ellipses of stations and marks together."""
    names = ("x_m", "y_m", "ellipse_major_95_m")
    return {name: np.concatenate([floats(stations, name), floats(marks, name)]) for name in names}


def _add_points(figure: go.Figure, rows: Columns, kind: str, symbol: str, size: int) -> None:
    """Draw stations or marks, coloured by the mean redundancy of their centres."""
    names = texts(rows, kind)
    figure.add_scatter(
        x=floats(rows, "x_m"),
        y=floats(rows, "y_m"),
        mode="markers+text" if kind == "mark" and len(names) <= _N_NAMES else "markers",
        name=kind,
        text=names,
        textposition="top center",
        textfont={"size": 11, "color": theme.MUTED},
        cliponaxis=False,
        marker={
            "symbol": symbol,
            "size": size,
            "color": floats(rows, "mean_redundancy"),
            "cmin": 0.0,
            "cmax": 3.0,
            "colorscale": [list(stop) for stop in theme.HEIGHTS],
            "line": {"color": theme.TEXT, "width": 1},
            "showscale": kind == "station",
            "colorbar": {
                "title": {"text": "mean redundancy, of 3", "side": "top", "font": {"size": 12}},
                "orientation": "h",
                "thickness": 8,
                "len": 0.5,
                "x": 0.0,
                "xanchor": "left",
                "y": -0.16,
                "yanchor": "top",
                "outlinewidth": 0,
                "dtick": 1,
            },
        },
        customdata=details(rows, (), ("n_observations", "mean_redundancy"), ("sigma_3d_m",)),
        hovertemplate="<b>%{text}</b><br>x %{x:.4f} m<br>y %{y:.4f} m<br>"
        "sigma %{customdata[2]:.1f} mm, %{customdata[0]:.0f} centres, redundancy "
        f"%{{customdata[1]:.2f}}<extra>{kind}</extra>",
    )


def residuals(observations: Columns) -> go.Figure:
    """Draw the residuals of the centres by station; excluded ones have another symbol."""
    figure = blank_figure("Residuals of the centres")
    used = np.asarray(observations["used"], dtype=bool)
    for axis in _AXES:
        for is_used in (True, False):
            rows = select(observations, used == is_used)
            if len(rows["station"]):
                _add_residuals(figure, rows, axis, is_used=is_used)
    group_by_axis(figure, "Station", "Observed - computed [mm]", 0.4)
    figure.update_xaxes(tickangle=-40)
    return figure


def _add_residuals(figure: go.Figure, rows: Columns, axis: str, *, is_used: bool) -> None:
    """Draw the residuals along one axis."""
    figure.add_scatter(
        x=texts(rows, "station"),
        y=MM * floats(rows, f"residual_{axis}_m"),
        mode="markers",
        name=axis if is_used else f"{axis}, left out",
        offsetgroup=axis,
        marker={
            "color": theme.AXES[axis],
            "size": 6 if is_used else 9,
            "symbol": "circle" if is_used else "x-thin-open",
            "opacity": 0.75,
            "line": {"width": 0 if is_used else 2},
        },
        customdata=details(rows, ("marker", "mark")),
        hovertemplate="<b>%{x}</b> %{customdata[0]} on %{customdata[1]}<br>%{y:.1f} mm"
        f"<extra>{axis}</extra>",
    )


def tests(observations: Columns, w_limit: float) -> go.Figure:
    """Draw the w-statistic of each centre against its redundancy, and the limit."""
    figure = blank_figure("Local tests of the centres")
    w, redundancy = floats(observations, "w"), floats(observations, "redundancy")
    figure.add_scatter(
        x=redundancy,
        y=w,
        mode="markers",
        name="centre",
        showlegend=False,
        marker={"color": theme.OURS, "size": 7, "opacity": 0.7},
        customdata=details(
            observations, ("station", "marker", "mark"), in_mm=("minimal_detectable_bias_m",)
        ),
        hovertemplate="<b>%{customdata[0]}</b> %{customdata[1]} on %{customdata[2]}<br>w %{y:.2f}, "
        "redundancy %{x:.2f}<br>detectable bias %{customdata[3]:.0f} mm<extra></extra>",
    )
    figure.add_hline(
        y=w_limit,
        line={"color": theme.TOLERANCE, "width": 1.5, "dash": "dash"},
        annotation={
            "text": f"limit {w_limit:.2f}",
            "font": {"color": theme.TOLERANCE, "size": 12},
            "xanchor": "left",
            "x": 0.01,
        },
        annotation_position="top left",
    )
    figure.update_xaxes(title_text="Redundancy, of 3", range=[0, 3])
    figure.update_yaxes(title_text="Largest w", rangemode="tozero")
    return figure


def control_differences(checks: Columns) -> go.Figure:
    """Draw the position of each control mark from the network without it, minus the given one."""
    figure = blank_figure("Control marks left out in turn")
    names = texts(checks, "mark")
    for axis in _AXES:
        figure.add_scatter(
            x=names,
            y=MM * floats(checks, f"difference_{axis}_m"),
            mode="markers",
            name=axis,
            offsetgroup=axis,
            marker={"color": theme.AXES[axis], "size": 8},
            error_y={
                "type": "data",
                "array": _BEYOND * MM * floats(checks, f"sigma_{axis}_m"),
                "color": theme.BAR,
                "thickness": 3,
                "width": 0,
            },
            hovertemplate=f"<b>%{{x}}</b><br>{axis} %{{y:.1f}} mm<extra></extra>",
        )
    group_by_axis(figure, "Control mark", "Predicted - given [mm]", 0.35)
    return figure
