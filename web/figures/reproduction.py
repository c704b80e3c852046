"""Figures of the reproduction: the study's figures drawn again from simulated scans."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from spheremark.pipelines.error_model import ErrorModel
from spheremark.pipelines.evaluation.experiment import Plain
from spheremark.pipelines.evaluation.reproduction.included_angle import (
    CIRCLES,
    PAIR,
    TRIPLE,
    AngleExperiment,
    Arcs,
)
from spheremark.pipelines.evaluation.reproduction.noise import REFLECTIVITY_BINS, RangeNoise
from spheremark.pipelines.evaluation.reproduction.scans import Example
from spheremark.pipelines.positioning.subsets import angles_that_keep
from spheremark.pipelines.published import GREATEST_DISTANCE, SMALLEST_COUNT, TABLE_3
from spheremark.web import theme
from spheremark.web.columns import MM, Columns, by_method, floats
from spheremark.web.figures.elements import RATIO_AXIS, add_tolerance, blank_figure, make_log
from spheremark.web.figures.included_angle import THEORIES, add_limits_of_study

_REACH = 1.75  # radii of the sphere that are shown about its centre
_N_MEAN_MIN = 3  # errors that make a mean worth drawing
_WAYS = (
    (CIRCLES, theme.PAPER, "solid"),
    (PAIR, theme.OURS, "dot"),
    (TRIPLE, theme.OURS, "solid"),
)


def model_against_count(
    fits: Columns, models: Mapping[str, ErrorModel], tolerance_m: float, distances: Sequence[float]
) -> go.Figure:
    """Draw mean errors against count, one line for each distance; the model as a dashed line."""
    figure = blank_figure("Point count varied at fixed distance, by the time of the turn")
    for method, rows in by_method(fits):
        style = theme.method_style(method)
        for i, distance in enumerate(distances):
            own = np.abs(floats(rows, "range_m") - distance) < 0.6
            _add_count_line(figure, style, rows, own, distance, is_first=i == 0)
            if method in models and own.any():
                counts = floats(rows, "n_points")[own]
                _add_model_line(figure, method, models[method], counts, distance)
                figure.data[-1].update(showlegend=i == 0)
    add_tolerance(figure, tolerance_m)
    figure.update_xaxes(title_text="Returns on the sphere, mean per turn", **RATIO_AXIS)
    figure.update_yaxes(title_text="Mean error, 3-D [mm]")
    make_log(figure)
    return figure


def _add_count_line(
    figure: go.Figure,
    style: theme.MethodStyle,
    rows: Columns,
    own: NDArray[np.bool_],
    distance: float,
    *,
    is_first: bool,
) -> None:
    """Draw the mean error at one distance for each time of the turn."""
    turns, errors = floats(rows, "turn_s")[own], floats(rows, "error_3d_m")[own]
    counts = floats(rows, "n_points")[own]
    times = [turn for turn in np.unique(turns) if np.sum(turns == turn) >= _N_MEAN_MIN]
    figure.add_scatter(
        x=[float(counts[turns == turn].mean()) for turn in times],
        y=[float(errors[turns == turn].mean()) * MM for turn in times],
        mode="lines+markers+text",
        text=[f"{distance:g} m"] + [""] * (len(times) - 1),
        textposition="top left",
        textfont={"size": 11, "color": style.colour},
        name=style.label,
        legendgroup=style.label,
        showlegend=is_first,
        line={"color": style.colour, "width": 2},
        marker={"color": style.colour, "size": 7, "symbol": style.symbol},
        customdata=[[turn, int(np.sum(turns == turn))] for turn in times],
        hovertemplate=f"<b>{distance:g} m</b>, turn of %{{customdata[0]:g}} s<br>mean %{{y:.1f}} mm"
        f" with %{{x:.0f}} returns, %{{customdata[1]}} spheres<extra>{style.label}</extra>",
    )


def _add_model_line(
    figure: go.Figure,
    method: str,
    model: ErrorModel,
    counts: NDArray[np.float64],
    distance: float,
) -> None:
    """Draw the mean error of a model at one distance, over the counts there."""
    style = theme.method_style(method)
    x = np.geomspace(counts.min(), counts.max(), 12)
    figure.add_scatter(
        x=x,
        y=model.predict(distance, x, "mean") * MM,
        mode="lines",
        name=f"{style.label}: model",
        legendgroup=f"{style.label}: model",
        line={"color": style.colour, "width": 1.25, "dash": "dot"},
        hoverinfo="skip",
    )


def before_and_after_cut(example: Example) -> go.Figure:
    """Draw one marker's returns as the LiDAR sees them, before and after the cut (Figure 9)."""
    figure = make_subplots(
        cols=2, shared_yaxes=True, horizontal_spacing=0.04, column_titles=["Before", "After"]
    )
    figure.update_layout(
        template=theme.template(),
        title={
            "text": f"Sphere points before and after the study's cut, at {example.distance:.2f} m"
        },
    )
    figure.update_layout(margin={"t": 92}, legend={"y": 1.14})
    figure.update_annotations(font={"size": 13, "color": theme.MUTED})
    mm = example.points_station * MM
    for column, keep in ((1, np.ones(len(mm), dtype=np.bool_)), (2, example.is_left)):
        true = _outline(example.radius, (0.0, 0.0), theme.MUTED, "true sphere")
        figure.add_trace(true.update(showlegend=column == 1), row=1, col=column)
        for shown, name, colour in (
            (keep & example.is_left, "kept", theme.OURS),
            (keep & ~example.is_left, "lost to the cut", theme.PAPER),
        ):
            figure.add_scatter(
                x=-mm[shown, 1],
                y=mm[shown, 2],
                mode="markers",
                name=name,
                legendgroup=name,
                showlegend=column == 1,
                marker={"color": colour, "size": 6, "opacity": 0.75},
                hovertemplate="%{x:.0f} mm right, %{y:.0f} mm up<extra></extra>",
                row=1,
                col=column,
            )
        for height, dash in ((example.cut, "dash"), (example.ground, "dot")):
            if abs(height) < _REACH * example.radius:
                figure.add_hline(
                    y=height * MM,
                    line={"color": theme.TEXT, "width": 1.5, "dash": dash},
                    row=1,
                    col=column,
                )
        figure.update_xaxes(title_text="Right of the centre [mm]", row=1, col=column)
    figure.update_yaxes(title_text="Above the centre [mm]", col=1)
    _equal_axes(figure, example, n_columns=2)
    return figure


def models_of_icp(example: Example, labels: Mapping[str, str]) -> go.Figure:
    """Draw from the side where each method puts the sphere of one marker (Figure 3)."""
    figure = blank_figure(f"Sphere of each model, from the side, at {example.distance:.2f} m")
    mm = example.points_station * MM
    figure.add_trace(_outline(example.radius, (0.0, 0.0), theme.MUTED, "true sphere"))
    figure.add_scatter(
        x=mm[example.is_left, 0],
        y=mm[example.is_left, 2],
        mode="markers",
        name="returns that the cut leaves",
        marker={"color": theme.CLOUD, "size": 5},
        hovertemplate="%{x:.0f} mm beyond, %{y:.0f} mm up<extra></extra>",
    )
    colours = (theme.OURS, theme.PAPER, theme.GREEN)
    for (method, centre), colour in zip(example.centres_station.items(), colours, strict=False):
        label = f"{labels[method]}: {np.linalg.norm(centre) * MM:.1f} mm"
        beyond, _, above = centre
        figure.add_trace(_outline(example.radius, (beyond, above), colour, label))
        figure.add_scatter(
            x=[beyond * MM],
            y=[above * MM],
            mode="markers",
            legendgroup=label,
            showlegend=False,
            marker={"color": colour, "size": 9, "symbol": "cross-thin", "line": {"width": 2}},
            hoverinfo="skip",
        )
        figure.data[-1].marker.line.color = colour
    figure.update_xaxes(title_text="Beyond the centre, away from the LiDAR [mm]")
    figure.update_yaxes(title_text="Above the centre [mm]")
    _equal_axes(figure, example, n_columns=1)
    return figure


def noise_by_reflectivity(noises: Mapping[str, RangeNoise]) -> go.Figure:
    """Draw the noise of single ranges by reflectivity, simulated beside real."""
    figure = blank_figure("Noise of a single range, by reflectivity")
    names = [f"{low:g} to {high:g}" for low, high in pairwise(REFLECTIVITY_BINS)]
    for (label, noise), colour in zip(
        noises.items(), (theme.OURS, theme.PAPER, theme.GREEN), strict=False
    ):
        figure.add_bar(
            x=names,
            y=noise.sigmas * MM,
            name=label,
            marker={"color": colour},
            customdata=noise.n,
            hovertemplate=f"%{{y:.1f}} mm from %{{customdata:,}} triples<extra>{label}</extra>",
        )
    figure.update_xaxes(title_text="Reflectivity, 0-255", type="category")
    figure.update_yaxes(title_text="Sigma [mm]", rangemode="tozero")
    figure.update_layout(barmode="group", bargap=0.35)
    return figure


def study_claims(figure: go.Figure, *, of: str) -> go.Figure:
    """Mark the study's limit of 3 cm in a figure of distance or count."""
    x = GREATEST_DISTANCE if of == "distance" else math.log10(SMALLEST_COUNT)
    figure.add_shape(
        type="line",
        x0=x if of == "distance" else SMALLEST_COUNT,
        x1=x if of == "distance" else SMALLEST_COUNT,
        y0=0,
        y1=1,
        yref="y domain",
        line={"color": theme.MUTED, "width": 1, "dash": "dot"},
    )
    figure.add_annotation(
        x=x,
        y=1,
        yref="y domain",
        yanchor="top",
        xanchor="left" if of == "distance" else "right",
        showarrow=False,
        text=f"study: to {GREATEST_DISTANCE:g} m" if of == "distance" else "study: from 100",
        font={"size": 12, "color": theme.MUTED},
        bgcolor=theme.RAISED,
    )
    return figure


def station_by_angle(made: AngleExperiment) -> go.Figure:
    """Draw the study's Figure 10 again: the station's error by included angle, both methods."""
    figure = blank_figure("Error of the station by included angle, 17 mm granted to each axis")
    for name, colour, dash in _WAYS:
        figure.add_scatter(
            x=np.degrees(made.angles),
            y=made.curves[name] * MM,
            mode="lines",
            name=f"{name} ({'study' if name == CIRCLES else 'free station'})",
            line={"color": colour, "width": 2.5 if dash == "solid" else 1.75, "dash": dash},
            hovertemplate=f"{name}: %{{y:.1f}} mm at %{{x:.0f}} deg<extra></extra>",
        )
    within = made.tolerance >= TABLE_3.errors
    for keep, label, colour in (
        (within, "study, Table 3: within", "var(--below)"),
        (~within, "study, Table 3: beyond", "var(--above)"),
    ):
        figure.add_scatter(
            x=np.degrees(TABLE_3.included_angles[keep]),
            y=TABLE_3.errors[keep] * MM,
            mode="markers",
            name=label,
            marker={"symbol": "x", "size": 9, "color": colour},
            hovertemplate="study: %{y:.1f} mm at %{x:.2f} deg<extra></extra>",
        )
    add_tolerance(figure, made.tolerance)
    add_limits_of_study(figure, is_shaded=True)
    figure.update_yaxes(title_text="Error, median over signs [mm]", range=[0.0, 80.0])
    figure.update_xaxes(title_text="Included angle [deg]", range=[0, 180], dtick=30)
    return figure


def limit_by_sigma(limits: Sequence[Plain], tolerance_m: float) -> go.Figure:
    """Draw between which angles two marks keep the tolerance, by the sigma of the centres."""
    figure = blank_figure(f"Angles at which two marks keep {tolerance_m * MM:g} mm")
    widest = tolerance_m / np.sqrt(2.0)  # beyond which circles keep it nowhere
    sigmas = np.sort(np.append(np.linspace(0.0005, tolerance_m, 200), widest * (1.0 - 1e-9)))
    for method, (name, colour, dash) in THEORIES.items():
        known = np.array([angles_that_keep(method, float(s), tolerance_m) for s in sigmas])
        for bounds, is_first in ((known[:, 0], True), (known[:, 1], False)):
            figure.add_scatter(
                x=sigmas * MM,
                y=np.degrees(bounds),
                mode="lines",
                name=name,
                legendgroup=name,
                showlegend=is_first,
                line={"color": colour, "width": 2, "dash": dash},
                hovertemplate=f"{name}: %{{y:.0f}} deg at %{{x:.1f}} mm<extra></extra>",
            )
    tried = [one for one in limits if np.isfinite(one["two_centres_from_deg"])]
    figure.add_scatter(
        x=[one["sigma_axis_m"] * MM for one in tried],
        y=[one["two_centres_from_deg"] for one in tried],
        mode="markers+text",
        text=[f"{one['two_centres_from_deg']:.0f}" for one in tried],
        textposition="bottom right",
        textfont={"size": 11, "color": theme.OURS},
        name="free station, tried there",
        marker={"color": theme.OURS, "size": 8},
        customdata=[one["two_centres_error_horizontal_rms_m"] * MM for one in tried],
        hovertemplate="%{y:.1f} deg at %{x:.0f} mm: RMS %{customdata:.1f} mm<extra></extra>",
    )
    figure.update_xaxes(title_text="Sigma of a centre per axis [mm]", range=[0, tolerance_m * MM])
    figure.update_yaxes(title_text="Included angle [deg]", range=[-16, 185], dtick=30)
    return figure


def circles_of_study(arcs: Arcs) -> go.Figure:
    """Draw the study's Figure 4 again: three circles through the station, and from near."""
    degrees = np.degrees(arcs.included_angle)
    figure = make_subplots(cols=2, horizontal_spacing=0.2, column_titles=["Field", "From near"])
    figure.update_layout(
        template=theme.template(),
        title={"text": f"Position from three circles, included angle {degrees:.2f} deg"},
        margin={"t": 92},
        legend={"y": 1.14},
    )
    figure.update_annotations(font={"size": 13, "color": theme.MUTED})
    for i in range(len(arcs.radii)):
        _add_circle(figure, arcs, i)
    for name, p, colour, symbol, columns in (
        ("marks", arcs.marks_site, theme.MARK, "circle", (1,)),
        ("true station", np.zeros((1, 2)), theme.TEXT, "cross-thin", (1, 2)),
        ("where they meet best", arcs.p_site[None], theme.PAPER, "diamond", (1, 2)),
    ):
        look = {"color": colour, "size": 9, "symbol": symbol, "line": {"color": colour, "width": 2}}
        for column in columns:
            x, y = p.T * (1.0 if column == 1 else MM)
            figure.add_scatter(
                x=x, y=y, mode="markers", name=name, legendgroup=name, showlegend=column == 1,
                marker=look, hovertemplate=f"{name}<extra></extra>", row=1, col=column,
            )  # fmt: skip
    reach = 1.6 * float(np.linalg.norm(arcs.p_site)) * MM + 25.0
    near = {"range": [-reach, reach], "constrain": "domain", "col": 2}
    figure.update_xaxes(title_text="x [m]", scaleanchor="y", constrain="domain", col=1)
    figure.update_yaxes(title_text="y [m]", constrain="domain", col=1)
    figure.update_xaxes(title_text="x [mm]", scaleanchor="y2", **near)
    figure.update_yaxes(title_text="y [mm]", **near)
    return figure


def _add_circle(figure: go.Figure, arcs: Arcs, i: int) -> None:
    """Draw one circle whole, and its arc by the station."""
    mark, radius = arcs.shifted_site[i], arcs.radii[i]
    whole = np.linspace(0.0, 2.0 * np.pi, 181)
    by_station = np.arctan2(-mark[1], -mark[0]) + np.linspace(-0.02, 0.02, 41)
    for column, turn, unit in ((1, whole, 1.0), (2, by_station, MM)):
        figure.add_scatter(
            x=(mark[0] + radius * np.cos(turn)) * unit,
            y=(mark[1] + radius * np.sin(turn)) * unit,
            mode="lines",
            name="circles about the shifted marks",
            legendgroup="circles",
            showlegend=i == 0 and column == 1,
            hoverinfo="skip",
            line={"color": theme.PAPER, "width": 1.5},
            row=1,
            col=column,
        )


def _outline(radius: float, centre: Sequence[float], colour: str, name: str) -> go.Scatter:
    """Return the outline of a sphere [m] about a centre in the figure."""
    turn = np.linspace(0.0, 2.0 * np.pi, 91)
    return go.Scatter(
        x=(centre[0] + radius * np.cos(turn)) * MM,
        y=(centre[1] + radius * np.sin(turn)) * MM,
        mode="lines",
        name=name,
        legendgroup=name,
        line={"color": colour, "width": 2},
        hoverinfo="skip",
    )


def _equal_axes(figure: go.Figure, example: Example, *, n_columns: int) -> None:
    """Give all axes one scale, with space about the sphere."""
    reach = _REACH * example.radius * MM
    for column in range(1, n_columns + 1):
        number = "" if column == 1 else str(column)
        axis = {"range": [-reach, reach], "scaleanchor": "y", "constrain": "domain", "dtick": 50}
        figure.update_layout({f"xaxis{number}": axis})
    figure.update_yaxes(range=[-reach, reach], dtick=50, constrain="domain")
