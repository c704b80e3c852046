"""What the included angle between marks does to a station: figures against it, with theory.

Horizontal errors, because the theory is one of the plane: heights rest on the levelling.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from spheremark.pipelines.evaluation.reproduction import AngleExperiment, AngleLimit, Arcs
from spheremark.pipelines.evaluation.reproduction.included_angle import CIRCLES, PAIR, TRIPLE
from spheremark.pipelines.positioning.subsets import angles_that_keep, theory_of_pairs
from spheremark.pipelines.published import LEAST_ANGLE, TABLE_3, WIDEST_ANGLE
from spheremark.web import theme
from spheremark.web.columns import MM, Columns, by_method, floats, known_values, rms, select, texts
from spheremark.web.figures.elements import add_binned, add_tolerance, blank_figure, make_log
from spheremark.web.figures.survey import ANGLE_BIN

_N_DRAWN = 3000  # points of one method; more are one blot, and make a page slow
_ANGLES = np.radians(np.concatenate([np.arange(2.0, 178.5, 0.5), [179.0]]))
_COUNTS = {2: "two marks", 3: "three marks"}
_HOW = {"free_station": "3-D centres", "paper": "circles", "ranges": "slope distances"}
_THEORIES = {
    "free_station": ("theory, two centres", theme.TEXT, "solid"),
    "paper": ("theory, two circles", theme.MUTED, "dash"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Subsets:
    """Positions from pairs or triples by one resection method, and what they are compared with."""

    rows: Columns
    fixes: Columns
    n_marks: int
    resection: str
    sigma_axis_m: float

    @property
    def has_errors(self) -> bool:
        """Whether anything is known about the truth of these rows."""
        return bool(np.isfinite(floats(self.rows, "error_horizontal_m")).any())

    @property
    def quality(self) -> str:
        """Name of the column that is drawn, but for its end."""
        return "error" if self.has_errors else "sigma"


def error_against_angle(shown: Subsets, tolerance_m: float, *, is_log: bool = False) -> go.Figure:
    """Draw the horizontal error of the station from few marks against their included angle."""
    quality = "Error" if shown.has_errors else "Predicted sigma"
    few = f"{_COUNTS[shown.n_marks]} by {_HOW.get(shown.resection, shown.resection)}"
    figure = blank_figure(f"{quality} of the station from {few}")
    figure.update_yaxes(title_text=f"{quality}, horizontal [mm]")
    add_tolerance(figure, tolerance_m)
    for method, rows in by_method(shown.rows):
        _add_rows(figure, method, rows, shown)
    for method, rows in by_method(shown.fixes):
        _add_all_marks(figure, method, rows, shown)
    add_theory(figure, shown.sigma_axis_m)
    add_limits_of_study(figure, is_shaded=shown.resection == "paper")
    worst = known_values(floats(shown.rows, f"{shown.quality}_horizontal_m"))
    if is_log:
        make_log(figure)
    elif len(worst):
        top = 1.3 * max(float(np.quantile(worst, 0.97)), tolerance_m) * MM
        figure.update_yaxes(range=[0.0, top])
    which = "" if shown.n_marks == 2 else ", the widest of three"
    figure.update_xaxes(title_text=f"Included angle{which} [deg]", range=[0, 180], dtick=30)
    return figure


def add_theory(figure: go.Figure, sigma_axis_m: float) -> None:
    """Draw what two marks give in theory, by centres and by circles; nothing without a sigma."""
    if not np.isfinite(sigma_axis_m):
        return
    for method, (name, colour, dash) in _THEORIES.items():
        figure.add_scatter(
            x=np.degrees(_ANGLES),
            y=theory_of_pairs(method, sigma_axis_m, _ANGLES) * MM,
            mode="lines",
            name=f"{name}, {sigma_axis_m * MM:.2g} mm",
            line={"color": colour, "width": 1.5, "dash": dash},
            hovertemplate=f"{name}: %{{y:.1f}} mm at %{{x:.0f}} deg<extra></extra>",
        )


def add_limits_of_study(figure: go.Figure, *, is_shaded: bool) -> None:
    """Mark the angles that the study recommends, shaded outside where its own method is shown."""
    low, high = np.degrees([LEAST_ANGLE, WIDEST_ANGLE])
    for x in (low, high):
        figure.add_vline(x=x, line={"color": theme.MUTED, "width": 1, "dash": "dot"}, layer="below")
    for x0, x1 in ((0.0, low), (high, 180.0)) if is_shaded else ():
        figure.add_vrect(x0=x0, x1=x1, fillcolor=theme.SHADE, line_width=0, layer="below")
    figure.add_annotation(
        x=(low + high) / 2.0,
        y=1,
        yref="y domain",
        yanchor="top",
        showarrow=False,
        text=f"study, for circles: {low:.0f} to {high:.0f} deg",
        font={"size": 12, "color": theme.MUTED},
        bgcolor=theme.RAISED,
    )


def _add_rows(figure: go.Figure, method: str, rows: Columns, shown: Subsets) -> None:
    """Draw the station from each few marks, and the RMS of bins."""
    style = theme.method_style(method)
    x = floats(rows, "included_angle_max_deg")
    y = floats(rows, f"{shown.quality}_horizontal_m") * MM
    drawn = np.zeros(len(x), dtype=np.bool_)
    drawn[:: max(1, -(-len(x) // _N_DRAWN))] = True
    few = select(rows, drawn)
    marks = [" + ".join(str(mark) for mark in names) for names in few["marks"]]
    figure.add_scatter(
        x=x[drawn],
        y=y[drawn],
        mode="markers",
        name=f"{style.label}, {_COUNTS[shown.n_marks]}",
        legendgroup=style.label,
        marker={"color": style.colour, "size": 4, "opacity": 0.3, "symbol": style.symbol},
        customdata=[
            list(row)
            for row in zip(
                texts(few, "stop"), marks, floats(few, "included_angle_deg").round(1), strict=True
            )
        ],
        hovertemplate="<b>%{customdata[0]}</b> from %{customdata[1]}<br>%{y:.1f} mm at "
        f"%{{x:.1f}} deg, smallest %{{customdata[2]}} deg<extra>{style.label}</extra>",
    )
    add_binned(figure, style, x, y, ANGLE_BIN)


def _add_all_marks(figure: go.Figure, method: str, rows: Columns, shown: Subsets) -> None:
    """Draw the RMS of the stations from all their marks as a line: it has no angle of its own."""
    style = theme.method_style(method)
    known = known_values(floats(rows, f"{shown.quality}_horizontal_m"))
    if not len(known):
        return
    level = rms(known) * MM
    figure.add_scatter(
        x=[0.0, 180.0],
        y=[level, level],
        mode="lines",
        name=f"{style.label}, all marks: {level:.1f} mm",
        line={"color": style.colour, "width": 1.5, "dash": "dashdot"},
        hovertemplate=f"RMS of {len(known)} stations from all their marks: %{{y:.2f}} mm"
        f"<extra>{style.label}</extra>",
    )


def centres_sigma(fits: Columns) -> float:
    """Return what the centres that count are predicted to be good to, per axis [m]; or NaN."""
    counts: Mapping[str, Columns] = dict(by_method(fits))
    first = next(iter(counts.values()), None)
    known: NDArray[np.float64] = (
        np.zeros(0) if first is None else known_values(floats(first, "sigma_axis_m"))
    )
    return rms(known) if len(known) else np.nan


_WAYS = (
    (CIRCLES, theme.PAPER, "solid"),
    (PAIR, theme.OURS, "dot"),
    (TRIPLE, theme.OURS, "solid"),
)


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
    for keep, said, colour in (
        (within, "study, Table 3: within", "var(--below)"),
        (~within, "study, Table 3: beyond", "var(--above)"),
    ):
        figure.add_scatter(
            x=np.degrees(TABLE_3.included_angles[keep]),
            y=TABLE_3.errors[keep] * MM,
            mode="markers",
            name=said,
            marker={"symbol": "x", "size": 9, "color": colour},
            hovertemplate="study: %{y:.1f} mm at %{x:.2f} deg<extra></extra>",
        )
    add_tolerance(figure, made.tolerance)
    add_limits_of_study(figure, is_shaded=True)
    figure.update_yaxes(title_text="Error, median over signs [mm]", range=[0.0, 80.0])
    figure.update_xaxes(title_text="Included angle [deg]", range=[0, 180], dtick=30)
    return figure


def limit_by_sigma(limits: Sequence[AngleLimit], tolerance_m: float) -> go.Figure:
    """Draw between which angles two marks keep the tolerance, by how good the centres are."""
    figure = blank_figure(f"Angles at which two marks keep {tolerance_m * MM:g} mm")
    widest = tolerance_m / np.sqrt(2.0)  # beyond which circles keep it nowhere
    sigmas = np.sort(np.append(np.linspace(0.0005, tolerance_m, 200), widest * (1.0 - 1e-9)))
    for method, (name, colour, dash) in _THEORIES.items():
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
    tried = [one for one in limits if np.isfinite(one.least)]
    figure.add_scatter(
        x=[one.sigma * MM for one in tried],
        y=[np.degrees(one.least) for one in tried],
        mode="markers+text",
        text=[f"{np.degrees(one.least):.0f}" for one in tried],
        textposition="bottom right",
        textfont={"size": 11, "color": theme.OURS},
        name="free station, tried there",
        marker={"color": theme.OURS, "size": 8},
        customdata=[one.rms * MM for one in tried],
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
