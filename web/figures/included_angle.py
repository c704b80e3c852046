"""Figures of the error of a station against the included angle of its marks, with theory.

Errors are horizontal, as the theory is: heights depend on the levelling.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from spheremark.pipelines.positioning.subsets import theory_of_pairs
from spheremark.pipelines.published import LEAST_ANGLE, WIDEST_ANGLE
from spheremark.web import theme
from spheremark.web.columns import MM, Columns, by_method, floats, known_values, rms, select
from spheremark.web.figures.elements import (
    add_binned,
    add_tolerance,
    blank_figure,
    details,
    make_log,
)
from spheremark.web.figures.survey import ANGLE_BIN

_N_DRAWN = 3000  # points of one method; more overlap and slow the page
_ANGLES = np.radians(np.concatenate([np.arange(2.0, 178.5, 0.5), [179.0]]))
_COUNTS = {2: "two marks", 3: "three marks"}
_HOW = {"free_station": "3-D centres", "paper": "circles", "ranges": "slope distances"}
THEORIES = {
    "free_station": ("theory, two centres", theme.TEXT, "solid"),
    "paper": ("theory, two circles", theme.MUTED, "dash"),
}
"""Name, colour and dash of each theory, by resection method."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Subsets:
    """Positions from pairs or triples by one resection method, and those from all marks."""

    rows: Columns
    fixes: Columns
    n_marks: int
    resection: str
    sigma_axis_m: float

    @property
    def has_errors(self) -> bool:
        """Whether the error of any row is known."""
        return bool(np.isfinite(floats(self.rows, "error_horizontal_m")).any())

    @property
    def quality(self) -> str:
        """Prefix of the column that is drawn."""
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
    """Draw the theory of two marks, by centres and by circles; nothing without a sigma."""
    if not np.isfinite(sigma_axis_m):
        return
    for method, (name, colour, dash) in THEORIES.items():
        figure.add_scatter(
            x=np.degrees(_ANGLES),
            y=theory_of_pairs(method, sigma_axis_m, _ANGLES) * MM,
            mode="lines",
            name=f"{name}, {sigma_axis_m * MM:.2g} mm",
            line={"color": colour, "width": 1.5, "dash": dash},
            hovertemplate=f"{name}: %{{y:.1f}} mm at %{{x:.0f}} deg<extra></extra>",
        )


def add_limits_of_study(figure: go.Figure, *, is_shaded: bool) -> None:
    """Mark the recommended angles of the study; shade the others where its method is shown."""
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
    """Draw the station from each pair or triple, and the RMS of bins."""
    style = theme.method_style(method)
    x = floats(rows, "included_angle_max_deg")
    y = floats(rows, f"{shown.quality}_horizontal_m") * MM
    drawn = np.zeros(len(x), dtype=np.bool_)
    drawn[:: max(1, -(-len(x) // _N_DRAWN))] = True
    few = select(rows, drawn)
    marks = np.array([" + ".join(map(str, names)) for names in few["marks"]], dtype=object)
    figure.add_scatter(
        x=x[drawn],
        y=y[drawn],
        mode="markers",
        name=f"{style.label}, {_COUNTS[shown.n_marks]}",
        legendgroup=style.label,
        marker={"color": style.colour, "size": 4, "opacity": 0.3, "symbol": style.symbol},
        customdata=details(few | {"marks": marks}, ("stop", "marks"), ("included_angle_deg",)),
        hovertemplate="<b>%{customdata[0]}</b> from %{customdata[1]}<br>%{y:.1f} mm at "
        f"%{{x:.1f}} deg, smallest %{{customdata[2]:.1f}} deg<extra>{style.label}</extra>",
    )
    add_binned(figure, style, x, y, ANGLE_BIN)


def _add_all_marks(figure: go.Figure, method: str, rows: Columns, shown: Subsets) -> None:
    """Draw the RMS of the stations from all marks as a level line."""
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
    """Return the predicted sigma of the centres of the first method, per axis [m]; or NaN."""
    counts: Mapping[str, Columns] = dict(by_method(fits))
    first = next(iter(counts.values()), None)
    known: NDArray[np.float64] = (
        np.zeros(0) if first is None else known_values(floats(first, "sigma_axis_m"))
    )
    return rms(known) if len(known) else np.nan
