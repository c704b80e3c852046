"""The study's figures drawn again from simulated scans, and the page that holds them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from spheremark.pipelines import published as study
from spheremark.pipelines.accuracy import ErrorSummary
from spheremark.pipelines.error_model import ErrorModel
from spheremark.pipelines.evaluation.reproduction import (
    CENTRE,
    CENTRE_REAL,
    FIELD,
    FULL_SPHERE,
    GROUND,
    LANE,
    OURS,
    PAPER,
    REAL,
    REFLECTIVITY_BINS,
    AngleExperiment,
    Example,
    RangeNoise,
    Reading,
    Table2Row,
    Table4Row,
)
from spheremark.pipelines.evaluation.reproduction.included_angle import CIRCLES, PAIR, TRIPLE
from spheremark.pipelines.published import GREATEST_DISTANCE, SMALLEST_COUNT, TABLE_2
from spheremark.web import theme
from spheremark.web.columns import Columns, by_method, floats, texts
from spheremark.web.figures.included_angle import circles_of_study, limit_by_sigma, station_by_angle
from spheremark.web.figures.survey import (
    error_against_count,
    error_against_distance,
    error_along_lane,
)
from spheremark.web.pages.base import Panel
from spheremark.web.pages.readouts import Readout
from spheremark.web.pages.statements import Statement
from spheremark.web.templating import environment, number

_MM = 1e3  # [mm/m]
_REACH = 1.75  # radii of the sphere that are shown about its centre
_N_MEAN_MIN = 3  # errors that make a mean worth drawing
_TICKS = [step * 10.0**power for power in range(-1, 4) for step in (1, 2, 5)]
_RATIOS = {"type": "log", "tickvals": _TICKS, "ticktext": [f"{value:g}" for value in _TICKS]}


def model_against_count(
    fits: Columns, models: Mapping[str, ErrorModel], tolerance_m: float, distances: Sequence[float]
) -> go.Figure:
    """Draw mean errors against count, one line for each distance; the model as a dashed line."""
    figure = _figure("Point count varied at fixed distance, by the time of the turn")
    for method, rows in by_method(fits):
        style = theme.method_style(method)
        for i, distance in enumerate(distances):
            own = np.abs(floats(rows, "range_m") - distance) < 0.6
            _add_count_line(figure, style, rows, own, distance, is_first=i == 0)
            if method in models and own.any():
                counts = floats(rows, "n_points")[own]
                _add_model_line(figure, method, models[method], counts, distance)
                figure.data[-1].update(showlegend=i == 0)
    _add_tolerance(figure, tolerance_m)
    figure.update_xaxes(title_text="Returns on the sphere, mean per turn", **_RATIOS)
    figure.update_yaxes(title_text="Mean error, 3-D [mm]", **_RATIOS)
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
        y=[float(errors[turns == turn].mean()) * _MM for turn in times],
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
    """Draw the mean error that a model expects at one distance, over the counts seen there."""
    style = theme.method_style(method)
    x = np.geomspace(counts.min(), counts.max(), 12)
    figure.add_scatter(
        x=x,
        y=model.predict(distance, x, "mean") * _MM,
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
    mm = example.points_station * _MM
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
                    y=height * _MM,
                    line={"color": theme.TEXT, "width": 1.5, "dash": dash},
                    row=1,
                    col=column,
                )
        figure.update_xaxes(title_text="Right of the centre [mm]", row=1, col=column)
    figure.update_yaxes(title_text="Above the centre [mm]", col=1)
    _equal_axes(figure, example, n_columns=2)
    return figure


def models_of_icp(example: Example, labels: Mapping[str, str]) -> go.Figure:
    """Draw from aside where each method puts the sphere of one marker (Figure 3)."""
    figure = _figure(f"Where each model puts the sphere, from aside, at {example.distance:.2f} m")
    mm = example.points_station * _MM
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
        label = f"{labels[method]}: {np.linalg.norm(centre) * _MM:.1f} mm"
        beyond, _, above = centre
        figure.add_trace(_outline(example.radius, (beyond, above), colour, label))
        figure.add_scatter(
            x=[beyond * _MM],
            y=[above * _MM],
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
    figure = _figure("Noise of a single range, by reflectivity")
    names = [f"{low:g} to {high:g}" for low, high in pairwise(REFLECTIVITY_BINS)]
    for (label, noise), colour in zip(
        noises.items(), (theme.OURS, theme.PAPER, theme.GREEN), strict=False
    ):
        figure.add_bar(
            x=names,
            y=noise.sigmas * _MM,
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
    """Mark in a figure of distance or count up to where the study says that 3 cm is kept."""
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


def _figure(title: str) -> go.Figure:
    """Return an empty figure that looks like all others."""
    return go.Figure(layout={"template": theme.template(), "title": {"text": title}})


def _add_tolerance(figure: go.Figure, tolerance_m: float) -> None:
    """Draw the tolerance on a logarithmic axis."""
    figure.add_hline(
        y=tolerance_m * _MM,
        line={"color": theme.TOLERANCE, "width": 1.5, "dash": "dash"},
        annotation={
            "text": f"tolerance {tolerance_m * _MM:g} mm",
            "font": {"size": 12, "color": theme.TOLERANCE},
            "bgcolor": theme.RAISED,
            "y": math.log10(tolerance_m * _MM),
        },
        annotation_position="top left",
    )


def _outline(radius: float, centre: Sequence[float], colour: str, name: str) -> go.Scatter:
    """Return the outline of a sphere [m] about a centre in the figure."""
    turn = np.linspace(0.0, 2.0 * np.pi, 91)
    return go.Scatter(
        x=(centre[0] + radius * np.cos(turn)) * _MM,
        y=(centre[1] + radius * np.sin(turn)) * _MM,
        mode="lines",
        name=name,
        legendgroup=name,
        line={"color": colour, "width": 2},
        hoverinfo="skip",
    )


def _equal_axes(figure: go.Figure, example: Example, *, n_columns: int) -> None:
    """Give all axes one scale and room for the sphere and what stands about it."""
    reach = _REACH * example.radius * _MM
    for column in range(1, n_columns + 1):
        number = "" if column == 1 else str(column)
        figure.update_layout(
            {
                f"xaxis{number}": {
                    "range": [-reach, reach],
                    "scaleanchor": "y",
                    "constrain": "domain",
                    "dtick": 50,
                }
            }
        )
    figure.update_yaxes(range=[-reach, reach], dtick=50, constrain="domain")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ReproductionPage:
    """What the page of a reproduction shows.

    ``centre``, ``lane``, ``distances`` and ``real`` are columns of fits as the database names them,
    with ``turn_s``; the last are the distances with the noise of a real sensor.
    """

    tolerance_m: float
    scans: Sequence[Mapping[str, Any]]
    statements: tuple[Statement, ...]
    table_2: tuple[Table2Row, ...]
    table_4: tuple[Table4Row, ...]
    readings: tuple[Reading, ...]
    angles: AngleExperiment
    icp: Mapping[str, ErrorSummary]
    example: Example
    centre: Columns
    lane: Columns
    distances: Columns
    real: Columns
    noises: Mapping[str, RangeNoise]
    spheres: Sequence[Mapping[str, Any]]
    code_version: str
    config_digest: str
    seed: int


_ICP_LABELS = {OURS: "ours", PAPER: "hemisphere", FULL_SPHERE: "full sphere"}


def reproduction_page(page: ReproductionPage) -> str:
    """Return the page: one file, with Plotly's script beside it."""
    context = {field.name: getattr(page, field.name) for field in dataclasses.fields(page)}
    return (
        environment()
        .get_template("reproduction.html")
        .render(
            **context,
            panels={panel.name: panel for panel in panels(page)},
            readouts=_readouts(page),
            methods=(OURS, PAPER),
            cuts={PAPER: "half of each sphere", GROUND: "below the highest ground"},
            noises_of={
                CENTRE: f"{study.SIGMA_RANGE * _MM:g} mm, the study's simulator",
                CENTRE_REAL: "7 to 14 mm, a real VLP-16",
            },
            ways=(CIRCLES, PAIR, TRIPLE),
            total=_total(page.table_2),
            study=study,
        )
    )


def panels(page: ReproductionPage) -> tuple[Panel, ...]:
    """Return all figures of a reproduction."""
    return (
        *_centre_panels(page),
        *_far_panels(page),
        *_angle_panels(page),
        Panel(
            name="figure9",
            figure=before_and_after_cut(page.example),
            caption="Figure 9. One simulated marker as the LiDAR sees it. Dashed: the cut, which "
            "leaves the hemisphere that the study shows; dotted, where it is near: the highest "
            "ground point of this scan.",
        ),
        Panel(
            name="figure3",
            figure=models_of_icp(page.example, _ICP_LABELS),
            caption="Figure 3. The same marker from aside, the LiDAR to the left: where ICP with a "
            "hemisphere, ICP with a full sphere, and our fit put the sphere.",
        ),
        Panel(
            name="figure11",
            figure=error_along_lane(page.lane, page.tolerance_m),
            caption="Figure 11. Mean over markers and worlds at each stop; whiskers end at the "
            "largest.",
        ),
        Panel(
            name="noise",
            figure=noise_by_reflectivity(page.noises),
            caption="From runs of twelve shots of one laser on one surface, freed of a parabola"
            + ("; real: packets of a VLP-16." if len(page.noises) > 1 else "; the first scan."),
        ),
    )


def _centre_panels(page: ReproductionPage) -> tuple[Panel, ...]:
    """Return the two halves of Figure 8."""
    distance = error_against_distance(page.centre, page.tolerance_m)
    count = error_against_count(page.centre, page.tolerance_m)
    return (
        Panel(
            name="figure8-distance",
            figure=study_claims(distance, of="distance"),
            caption="Figure 8, left. Every point is a sphere seen from the centre stop of one "
            "world; crosses are the study's own Table 2.",
        ),
        Panel(
            name="figure8-count",
            figure=study_claims(count, of="count"),
            caption="Figure 8, right. The same spheres by the returns that each method used: the "
            "study's cut leaves it fewer.",
        ),
    )


def _far_panels(page: ReproductionPage) -> tuple[Panel, ...]:
    """Return the figures that tell distance and count apart."""
    models = {one.method: one.model for one in page.statements if one.place == LANE and one.model}
    ladder = error_against_distance(page.distances, page.tolerance_m, is_log=True)
    ladder.update_layout(title_text="Error of sphere centres to 30 m, noise 30 mm")
    real = error_against_distance(page.real, page.tolerance_m, is_log=True)
    real.update_layout(title_text="Error of sphere centres to 30 m, noise of a real VLP-16")
    return (
        Panel(
            name="turns",
            figure=model_against_count(page.distances, models, page.tolerance_m, _DISTANCES_SHOWN),
            caption="Each line is one distance, each point one time of the turn: "
            "along a line only the count changes, from line to line only the distance. Dotted: the "
            "error model.",
        ),
        Panel(
            name="ladder",
            figure=ladder,
            caption="The same spheres, all times of the turn; lines are the RMS in bins of 1 m. "
            "The study's field ends at 9.3 m.",
        ),
        Panel(
            name="ladder-real",
            figure=real,
            caption="The same again with the noise by reflectivity of real packets, under 14 mm.",
        ),
    )


def _angle_panels(page: ReproductionPage) -> tuple[Panel, ...]:
    """Return the figures of the station by included angle."""
    return (
        Panel(
            name="figure10",
            figure=station_by_angle(page.angles),
            caption="Figure 10. Lines: medians over all signs of the errors. Crosses: the study's "
            "printed errors. The free station has the lower limit and no upper one.",
        ),
        Panel(
            name="limits",
            figure=limit_by_sigma(page.angles.limits, page.tolerance_m),
            caption="Between the lines the horizontal error of two marks is within. Two centres "
            "have a lower limit that falls with their sigma, two circles an upper one too.",
        ),
        Panel(
            name="figure4",
            figure=circles_of_study(page.angles.arcs),
            caption="Figure 4. Circles of the true distances about marks that are off by 17 mm per "
            "axis; of all signs of the errors, those whose error is the median.",
        ),
    )


_DISTANCES_SHOWN = (5.0, 7.5, 10.0, 15.0, 20.0)  # [m]


_PLACES = {FIELD: "the study's field", LANE: "noise 30 mm", REAL: "noise of a real VLP-16"}


def _readouts(page: ReproductionPage) -> tuple[Readout, ...]:
    """Return the numbers that matter: mean error against the study's, and how far 3 cm reaches."""
    found = []
    published = float(TABLE_2.errors_3d.mean())
    for method in (PAPER, OURS):
        errors = floats(page.centre, "error_3d_m")[
            np.array(texts(page.centre, "fit_method")) == method
        ]
        found.append(
            Readout(
                label=f"Table 2, {theme.method_style(method).label}",
                value=number(float(errors.mean()) * _MM, 1),
                unit="mm mean error",
                note=f"the study: {published * _MM:.1f} mm; {len(errors)} spheres here",
                method=method,
            )
        )
    for one in page.statements:
        if one.method == OURS:
            value, _, interval = one.distance.partition(" m")
            where = _PLACES[one.place]
            found.append(
                Readout(
                    label=f"{page.tolerance_m * _MM:g} mm kept, {where}",
                    value=value,
                    unit="m",
                    note=interval.strip(" ()") or "as far as markers stand there",
                    method=OURS,
                )
            )
    return tuple(found)


def _total(rows: Sequence[Table2Row]) -> dict[str, float]:
    """Return the mean of Table 2's column of each method [m]."""
    return {
        method: float(np.nanmean([row.errors[method].mean for row in rows]))
        for method in (OURS, PAPER)
    }
