"""Theory and limits of the error of a station against the included angle of its marks.

Errors are horizontal, as the theory is: heights depend on the levelling.
"""

from __future__ import annotations

import numpy as np
import plotly.graph_objects as go

from spheremark.pipelines.positioning.subsets import theory_of_pairs
from spheremark.pipelines.published import LEAST_ANGLE, WIDEST_ANGLE
from spheremark.web import theme
from spheremark.web.columns import MM
from spheremark.web.figures.elements import add_line, add_note

_ANGLES = np.radians(np.concatenate([np.arange(2.0, 178.5, 0.5), [179.0]]))
THEORIES = {
    "free_station": ("theory, two centres", theme.TEXT, "solid"),
    "paper": ("theory, two circles", theme.MUTED, "dash"),
}
"""Name, colour and dash of each theory, by resection method."""


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
