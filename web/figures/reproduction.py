"""Figures of the reproduction: the study's figures drawn again from simulated scans."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from spheremark.pipelines.accuracy.error_model import ErrorModel
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
from spheremark.web.columns import MM, Columns, by_method, floats, select
from spheremark.web.figures.elements import (
    RATIO_AXIS,
    Look,
    add_line,
    add_note,
    add_points,
    add_tolerance,
    blank_figure,
    hover_of,
    make_log,
    outline,
)
from spheremark.web.figures.included_angle import THEORIES, add_limits_of_study

_REACH = 1.75  # radii of the sphere that are shown about its centre
_N_MEAN_MIN = 3  # errors that make a mean worth drawing
_COLOURS = (theme.OURS, theme.PAPER, theme.GREEN)
_WAYS = (
    (CIRCLES, "study", theme.PAPER, {"line_width": 2.5}),
    (PAIR, "free station", theme.OURS, {"line_width": 1.75, "line_dash": "dot"}),
    (TRIPLE, "free station", theme.OURS, {"line_width": 2.5}),
)
_SPHERE = theme.Style("true sphere", theme.MUTED)


def model_against_count(
    fits: Columns, models: Mapping[str, ErrorModel], tolerance_m: float, distances: Sequence[float]
) -> go.Figure:
    """Draw mean errors against count, one line for each distance; the model as a dashed line."""
    title = "Point count varied at fixed distance, by the time of the turn"
    figure = blank_figure(title, "Returns on the sphere, mean per turn", "Mean error, 3-D [mm]")
    for method, rows in by_method(fits):
        style = theme.method_style(method)
        for i, distance in enumerate(distances):
            own = select(rows, np.abs(floats(rows, "range_m") - distance) < 0.6)
            _add_count_line(figure, style, own, distance, is_first=i == 0)
            if method in models and len(own["range_m"]):
                counts = floats(own, "n_points")
                x = np.geomspace(counts.min(), counts.max(), 12)
                y = models[method].predict(distance, x, "mean") * MM
                named = style._replace(label=f"{style.label}: model")
                look = {"line_width": 1.25, "line_dash": "dot", "showlegend": i == 0}
                add_line(figure, x, y, named, legendgroup=named.label, **look)
    add_tolerance(figure, tolerance_m)
    figure.update_xaxes(**RATIO_AXIS)
    make_log(figure)
    return figure


def _add_count_line(
    figure: go.Figure, style: theme.Style, rows: Columns, distance: float, *, is_first: bool
) -> None:
    """Draw the mean error at one distance for each time of the turn."""
    turns, errors, counts = (floats(rows, name) for name in ("turn_s", "error_3d_m", "n_points"))
    groups = [turns == turn for turn in np.unique(turns)]
    groups = [one for one in groups if one.sum() >= _N_MEAN_MIN]
    about = {
        "turn_s": np.array([turns[one][0] for one in groups]),
        "n": np.array([one.sum() for one in groups]),
    }
    hover = (
        f"<b>{distance:g} m</b>, turn of {{turn_s:g}} s<br>mean {{y:.1f}} mm with {{x:.0f}} "
        "returns, {n:.0f} spheres"
    )
    text = [f"{distance:g} m"] + [""] * (len(groups) - 1)
    named: Look = {"text": text, "textposition": "top left", "mode": "lines+markers+text"}
    named |= {"textfont": {"size": 11, "color": style.colour}, "line_width": 2}
    group = {"legendgroup": style.label, "showlegend": is_first}
    x = [float(counts[one].mean()) for one in groups]
    y = [float(errors[one].mean()) * MM for one in groups]
    look = {"marker_size": 7, "line_color": style.colour}
    add_points(figure, x, y, style, hover, about, **(look | named | group))


def before_and_after_cut(example: Example) -> go.Figure:
    """Draw one marker's returns as the LiDAR sees them, before and after the cut (Figure 9)."""
    title = f"Sphere points before and after the study's cut, at {example.distance:.2f} m"
    figure = _pair(title, ["Before", "After"], shared_yaxes=True, horizontal_spacing=0.04)
    mm = example.points_station * MM
    everything = np.ones(len(mm), dtype=np.bool_)
    for column, keep in ((1, everything), (2, example.is_left)):
        place = {"showlegend": column == 1, "row": 1, "col": column}
        x, y = outline(example.radius * MM)
        add_line(figure, x, y, _SPHERE, legendgroup="sphere", **place)
        for shown, style in (
            (keep & example.is_left, theme.Style("kept", theme.OURS)),
            (keep & ~example.is_left, theme.Style("lost to the cut", theme.PAPER)),
        ):
            look = {"marker_size": 6, "marker_opacity": 0.75, "legendgroup": style.label} | place
            hover = "{x:.0f} mm right, {y:.0f} mm up"
            add_points(figure, -mm[shown, 1], mm[shown, 2], style, hover, **look)
        for height, dash in ((example.cut, "dash"), (example.ground, "dot")):
            if abs(height) < _REACH * example.radius:
                line = {"color": theme.TEXT, "width": 1.5, "dash": dash}
                figure.add_hline(y=height * MM, line=line, row=1, col=column)
    figure.update_xaxes(title_text="Right of the centre [mm]")
    figure.update_yaxes(title_text="Above the centre [mm]", col=1)
    return _about_sphere(figure, example)


def models_of_icp(example: Example, labels: Mapping[str, str]) -> go.Figure:
    """Draw from the side where each method puts the sphere of one marker (Figure 3)."""
    title = f"Sphere of each model, from the side, at {example.distance:.2f} m"
    x_title = "Beyond the centre, away from the LiDAR [mm]"
    figure = blank_figure(title, x_title, "Above the centre [mm]")
    mm = example.points_station[example.is_left] * MM
    x, y = outline(example.radius * MM)
    add_line(figure, x, y, _SPHERE)
    left, hover = theme.Style("returns that the cut leaves", theme.CLOUD), "{x:.0f}, {y:.0f} mm"
    add_points(figure, mm[:, 0], mm[:, 2], left, hover, marker_size=5)
    for (method, centre), colour in zip(example.centres_station.items(), _COLOURS, strict=False):
        label = f"{labels[method]}: {np.linalg.norm(centre) * MM:.1f} mm"
        beyond, _, above = centre * MM
        x, y = outline(example.radius * MM, (beyond, above))
        add_line(figure, x, y, theme.Style(label, colour), legendgroup=label)
        style = theme.Style(label, colour, "cross-thin")
        look = {"marker_line": {"width": 2, "color": colour}, "marker_size": 9}
        add_points(figure, [beyond], [above], style, legendgroup=label, showlegend=False, **look)
    return _about_sphere(figure, example)


def noise_by_reflectivity(noises: Mapping[str, RangeNoise]) -> go.Figure:
    """Draw the noise of single ranges by reflectivity, simulated beside real."""
    figure = blank_figure("Noise of a single range, by reflectivity")
    names = [f"{low:g} to {high:g}" for low, high in pairwise(REFLECTIVITY_BINS)]
    for (label, noise), colour in zip(noises.items(), _COLOURS, strict=False):
        style, about = theme.Style(label, colour), {"n": noise.n}
        hover = hover_of("{y:.1f} mm from {n:,.0f} triples", style, about)
        figure.add_bar(x=names, y=noise.sigmas * MM, name=label, marker_color=colour, **hover)
    figure.update_xaxes(title_text="Reflectivity, 0-255", type="category")
    figure.update_yaxes(title_text="Sigma [mm]", rangemode="tozero")
    figure.update_layout(barmode="group", bargap=0.35)
    return figure


def study_claims(figure: go.Figure, *, of: str) -> go.Figure:
    """Mark the study's limit of 3 cm in a figure of distance or count."""
    is_distance = of == "distance"
    x = GREATEST_DISTANCE if is_distance else SMALLEST_COUNT
    line = {"color": theme.MUTED, "width": 1, "dash": "dot"}
    figure.add_shape(type="line", x0=x, x1=x, y0=0, y1=1, yref="y domain", line=line)
    text = f"study: to {GREATEST_DISTANCE:g} m" if is_distance else "study: from 100"
    place = {"x": x, "xanchor": "left"} if is_distance else {"x": math.log10(x), "xanchor": "right"}
    add_note(figure, text, y=1, yanchor="top", **place)
    return figure


def station_by_angle(made: AngleExperiment) -> go.Figure:
    """Draw the study's Figure 10 again: the station's error by included angle, both methods."""
    title = "Error of the station by included angle, 17 mm granted to each axis"
    figure = blank_figure(title, "Included angle [deg]", "Error, median over signs [mm]")
    for name, how, colour, look in _WAYS:
        style, y = theme.Style(f"{name} ({how})", colour), made.curves[name] * MM
        add_line(figure, np.degrees(made.angles), y, style, "{y:.1f} mm at {x:.0f} deg", **look)
    within = made.tolerance >= TABLE_3.errors
    for keep, label, colour in (
        (within, "study, Table 3: within", "var(--below)"),
        (~within, "study, Table 3: beyond", "var(--above)"),
    ):
        x, y = np.degrees(TABLE_3.included_angles[keep]), TABLE_3.errors[keep] * MM
        style = theme.Style(label, colour, "x")
        add_points(figure, x, y, style, "{y:.1f} mm at {x:.2f} deg", marker_size=9)
    add_tolerance(figure, made.tolerance)
    add_limits_of_study(figure, is_shaded=True)
    figure.update_yaxes(range=[0.0, 80.0])
    figure.update_xaxes(range=[0, 180], dtick=30)
    return figure


def limit_by_sigma(limits: Sequence[Plain], tolerance_m: float) -> go.Figure:
    """Draw between which angles two marks keep the tolerance, by the sigma of the centres."""
    title = f"Angles at which two marks keep {tolerance_m * MM:g} mm"
    figure = blank_figure(title, "Sigma of a centre per axis [mm]", "Included angle [deg]")
    widest = tolerance_m / np.sqrt(2.0)  # beyond which circles keep it nowhere
    sigmas = np.sort(np.append(np.linspace(0.0005, tolerance_m, 200), widest * (1.0 - 1e-9)))
    hover = "{y:.0f} deg at {x:.1f} mm"
    for method, (name, colour, dash) in THEORIES.items():
        known = np.degrees([angles_that_keep(method, float(s), tolerance_m) for s in sigmas])
        style, look = theme.Style(name, colour), {"line_width": 2, "line_dash": dash}
        for i in (0, 1):
            group = {"legendgroup": name, "showlegend": i == 0}
            add_line(figure, sigmas * MM, known[:, i], style, hover, **look, **group)
    tried = [one for one in limits if np.isfinite(one["two_centres_from_deg"])]
    keys = ("sigma_axis_m", "two_centres_from_deg", "two_centres_error_horizontal_rms_m")
    x, y, errors = (np.array([one[key] for one in tried]) for key in keys)
    named: Look = {"mode": "markers+text", "text": [f"{one:.0f}" for one in y]}
    named |= {"textposition": "bottom right", "textfont": {"size": 11, "color": theme.OURS}}
    style = theme.Style("free station, tried there", theme.OURS)
    hover = "{y:.1f} deg at {x:.0f} mm: RMS {rms:mm} mm"
    add_points(figure, x * MM, y, style, hover, {"rms": errors}, **named)
    figure.update_xaxes(range=[0, tolerance_m * MM])
    figure.update_yaxes(range=[-16, 185], dtick=30)
    return figure


def circles_of_study(arcs: Arcs) -> go.Figure:
    """Draw the study's Figure 4 again: three circles through the station, and from near."""
    degrees = np.degrees(arcs.included_angle)
    title = f"Position from three circles, included angle {degrees:.2f} deg"
    figure = _pair(title, ["Field", "From near"], horizontal_spacing=0.2)
    for i in range(len(arcs.radii)):
        _add_circle(figure, arcs, i)
    for style, p, columns in (
        (theme.Style("marks", theme.MARK), arcs.marks_site, (1,)),
        (theme.Style("true station", theme.TEXT, "cross-thin"), np.zeros((1, 2)), (1, 2)),
        (theme.Style("where they meet best", theme.PAPER, "diamond"), arcs.p_site[None], (1, 2)),
    ):
        look = {"marker_size": 9, "marker_line": {"color": style.colour, "width": 2}}
        for column in columns:
            place = {"row": 1, "col": column, "showlegend": column == 1}
            x, y = p.T * (1.0 if column == 1 else MM)
            add_points(figure, x, y, style, style.label, legendgroup=style.label, **look, **place)
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
    style = theme.Style("circles about the shifted marks", theme.PAPER)
    for column, turn, unit in ((1, whole, 1.0), (2, by_station, MM)):
        x, y = (mark[:, None] + radius * np.stack([np.cos(turn), np.sin(turn)])) * unit
        place = {"legendgroup": "circles", "showlegend": i == 0 and column == 1}
        add_line(figure, x, y, style, line_width=1.5, row=1, col=column, **place)


def _pair(title: str, names: Sequence[str], **spacing: object) -> go.Figure:
    """Return an empty figure of two panels side by side."""
    figure = blank_figure(title)
    make_subplots(cols=2, column_titles=list(names), figure=figure, **spacing)
    figure.update_layout(margin={"t": 92}, legend={"y": 1.14})
    figure.update_annotations(font={"size": 13, "color": theme.MUTED})
    return figure


def _about_sphere(figure: go.Figure, example: Example) -> go.Figure:
    """Give all axes one scale, with space about the sphere."""
    reach = _REACH * example.radius * MM
    axis = {"range": [-reach, reach], "constrain": "domain", "dtick": 50}
    figure.update_xaxes(scaleanchor="y", **axis)
    return figure.update_yaxes(**axis)
