"""Figures of the error of a station against the included angle of its marks, with theory.

Errors are horizontal, as the theory is: heights depend on the levelling.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go

from spheremark.pipelines.positioning.subsets import theory_of_pairs
from spheremark.pipelines.published import LEAST_ANGLE, WIDEST_ANGLE
from spheremark.web import theme
from spheremark.web.columns import MM, Columns, by_method, floats, known_values, rms, select
from spheremark.web.figures.elements import (
    add_binned,
    add_line,
    add_note,
    add_points,
    add_tolerance,
    blank_figure,
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
    def quality(self) -> str:
        """Prefix of the column that is drawn: errors where any is known."""
        has_errors = np.isfinite(floats(self.rows, "error_horizontal_m")).any()
        return "error" if has_errors else "sigma"


def error_against_angle(shown: Subsets, tolerance_m: float, *, is_log: bool = False) -> go.Figure:
    """Draw the horizontal error of the station from few marks against their included angle."""
    quality = {"error": "Error", "sigma": "Predicted sigma"}[shown.quality]
    few = f"{_COUNTS[shown.n_marks]} by {_HOW.get(shown.resection, shown.resection)}"
    which = "" if shown.n_marks == 2 else ", the widest of three"
    figure = blank_figure(
        f"{quality} of the station from {few}",
        f"Included angle{which} [deg]",
        f"{quality}, horizontal [mm]",
    )
    add_tolerance(figure, tolerance_m)
    for method, rows in by_method(shown.rows):
        _add_rows(figure, theme.method_style(method), rows, shown)
    for method, rows in by_method(shown.fixes):
        _add_all_marks(figure, theme.method_style(method), rows, shown)
    add_theory(figure, shown.sigma_axis_m)
    add_limits_of_study(figure, is_shaded=shown.resection == "paper")
    worst = known_values(floats(shown.rows, f"{shown.quality}_horizontal_m"))
    if is_log:
        make_log(figure)
    elif len(worst):
        top = 1.3 * max(float(np.quantile(worst, 0.97)), tolerance_m) * MM
        figure.update_yaxes(range=[0.0, top])
    figure.update_xaxes(range=[0, 180], dtick=30)
    return figure


def add_theory(figure: go.Figure, sigma_axis_m: float) -> None:
    """Draw the theory of two marks, by centres and by circles; nothing without a sigma."""
    if not np.isfinite(sigma_axis_m):
        return
    for method, (name, colour, dash) in THEORIES.items():
        errors = theory_of_pairs(method, sigma_axis_m, _ANGLES) * MM
        style = theme.Style(f"{name}, {sigma_axis_m * MM:.2g} mm", colour)
        look = {"line_width": 1.5, "line_dash": dash}
        add_line(figure, np.degrees(_ANGLES), errors, style, "{y:.1f} mm at {x:.0f} deg", **look)


def add_limits_of_study(figure: go.Figure, *, is_shaded: bool) -> None:
    """Mark the recommended angles of the study; shade the others where its method is shown."""
    low, high = np.degrees([LEAST_ANGLE, WIDEST_ANGLE])
    for x in (low, high):
        figure.add_vline(x=x, line={"color": theme.MUTED, "width": 1, "dash": "dot"}, layer="below")
    for x0, x1 in ((0.0, low), (high, 180.0)) if is_shaded else ():
        figure.add_vrect(x0=x0, x1=x1, fillcolor=theme.SHADE, line_width=0, layer="below")
    text = f"study, for circles: {low:.0f} to {high:.0f} deg"
    add_note(figure, text, x=(low + high) / 2.0, y=1, yanchor="top")


def _add_rows(figure: go.Figure, style: theme.Style, rows: Columns, shown: Subsets) -> None:
    """Draw the station from each pair or triple, and the RMS of bins."""
    x = floats(rows, "included_angle_max_deg")
    y = floats(rows, f"{shown.quality}_horizontal_m") * MM
    drawn = np.zeros(len(x), dtype=np.bool_)
    drawn[:: max(1, -(-len(x) // _N_DRAWN))] = True
    few = select(rows, drawn)
    few["marks"] = np.array([" + ".join(map(str, names)) for names in few["marks"]], dtype=object)
    hover = (
        "<b>{stop}</b> from {marks}<br>{y:.1f} mm at {x:.1f} deg, smallest "
        "{included_angle_deg:.1f} deg"
    )
    named = style._replace(label=f"{style.label}, {_COUNTS[shown.n_marks]}")
    look = {"marker_size": 4, "marker_opacity": 0.3, "legendgroup": style.label}
    add_points(figure, x[drawn], y[drawn], named, hover, few, **look)
    add_binned(figure, style, x, y, ANGLE_BIN)


def _add_all_marks(figure: go.Figure, style: theme.Style, rows: Columns, shown: Subsets) -> None:
    """Draw the RMS of the stations from all marks as a level line."""
    known = known_values(floats(rows, f"{shown.quality}_horizontal_m"))
    if not len(known):
        return
    level = rms(known) * MM
    named = style._replace(label=f"{style.label}, all marks: {level:.1f} mm")
    hover = f"RMS of {len(known)} stations from all their marks: {{y:.2f}} mm"
    look = {"line_width": 1.5, "line_dash": "dashdot"}
    add_line(figure, [0.0, 180.0], [level, level], named, hover, **look)


def centres_sigma(fits: Columns) -> float:
    """Return the predicted sigma of the centres of the first method, per axis [m]; or NaN."""
    first = next((rows for _, rows in by_method(fits)), {"sigma_axis_m": np.zeros(0)})
    known = known_values(floats(first, "sigma_axis_m"))
    return rms(known) if len(known) else np.nan
