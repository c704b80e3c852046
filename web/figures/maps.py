"""Parts of maps: names, and ellipses with one scale factor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from spheremark.web import theme
from spheremark.web.columns import Columns, floats, known_values, largest

_ELLIPSE_SHARE = 0.08  # the largest ellipse is drawn at most this large, as a share of the field
MARK_STYLE = theme.Style("control mark", theme.MARK, "circle-cross-open")
NAMES = {"textposition": "top center", "textfont": {"size": 11, "color": theme.MUTED}}
"""How names stand beside points of a map."""


def ellipse_factor(marks: Columns, fixes: Columns) -> float:
    """Return the scale factor of ellipses: 1, 2 or 5 times a power of ten; 0 without any."""
    widest = largest(floats(fixes, "ellipse_major_95_m"))
    across = [
        np.ptp(known) if len(known) else 0.0
        for axis in ("x_m", "y_m")
        for known in [known_values(np.concatenate([floats(marks, axis), floats(fixes, axis)]))]
    ]
    if not widest or not max(across):
        return 0.0
    limit = _ELLIPSE_SHARE * float(max(across)) / widest
    power = 10.0 ** np.floor(np.log10(limit))
    return float(power * max(step for step in (1, 2, 5) if step * power <= limit))


def ellipse_outline(
    fixes: Columns, i: int, factor: float, *, size: str = "_95"
) -> NDArray[np.float64]:
    """Return the scaled outline of an ellipse; ``size`` is empty for the standard one."""
    turn = np.linspace(0.0, 2.0 * np.pi, 61)
    major = factor * floats(fixes, f"ellipse_major{size}_m")[i] * np.cos(turn)
    minor = factor * floats(fixes, f"ellipse_minor{size}_m")[i] * np.sin(turn)
    bearing = np.radians(floats(fixes, "ellipse_bearing_deg")[i])
    x = floats(fixes, "x_m")[i] + major * np.sin(bearing) + minor * np.cos(bearing)
    y = floats(fixes, "y_m")[i] + major * np.cos(bearing) - minor * np.sin(bearing)
    return np.column_stack([x, y])
