"""Colours by role, the Plotly template, and one style per method.

Colours are names of CSS variables (``var(--ours)``). static/tokens.css has the values for light and
dark; the script of the page substitutes them when it draws.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import plotly.graph_objects as go

FONT = "'IBM Plex Sans', system-ui, sans-serif"
MONO = "'IBM Plex Mono', ui-monospace, monospace"

TEXT = "var(--text)"
MUTED = "var(--text-muted)"
FAINT = "var(--text-faint)"
LINE = "var(--line)"
BAR = "var(--line-strong)"
GRID = "var(--grid)"
RAISED = "var(--raised)"
OURS = "var(--ours)"
OURS_BAND = "var(--ours-band)"
PAPER = "var(--paper)"
PAPER_BAND = "var(--paper-band)"
GREEN = "var(--third)"
GREEN_BAND = "var(--third-band)"
FIFTH = "var(--fifth)"
AXES = {"x": "var(--axis-x)", "y": "var(--axis-y)", "z": "var(--axis-z)"}
TOLERANCE = "var(--tolerance)"
MARK = "var(--mark)"
CLOUD = "var(--cloud)"
SHADE = "var(--shade)"

DIVERGING = (
    (0.0, "var(--below)"),
    (0.5, "var(--middle)"),
    (1.0, "var(--above)"),
)
"""From too near to too far, neutral at zero; distinguishable without red and green."""

HEIGHTS = ((0.0, "var(--low)"), (1.0, "var(--high)"))


class Style(NamedTuple):
    """Style of a method or a part in all figures."""

    label: str
    colour: str
    symbol: str = "circle"
    band: str = ""


_METHODS = {
    "along_beam": Style("along beam (ours)", OURS, "circle", OURS_BAND),
    "paper": Style("paper's method", PAPER, "diamond", PAPER_BAND),
    "silhouette": Style("silhouette", GREEN, "square", GREEN_BAND),
    "astm_e3125": Style("astm e3125", "var(--fourth)", "triangle-up", GREEN_BAND),
    "free_radius": Style("free radius", FIFTH, "triangle-down", GREEN_BAND),
    "algebraic": Style("algebraic", "var(--sixth)", "pentagon", GREEN_BAND),
}


def method_style(method: str) -> Style:
    """Return the style of a method; each has its own colour and symbol."""
    return _METHODS.get(method) or Style(method.replace("_", " "), MUTED, "hexagon", GREEN_BAND)


def template() -> go.layout.Template:
    """Return the template of all figures: hairline grid, monospaced tick labels."""
    axis = {
        "gridcolor": GRID,
        "linecolor": LINE,
        "zerolinecolor": LINE,
        "tickcolor": LINE,
        "ticks": "outside",
        "ticklen": 4,
        "tickfont": {"family": MONO, "size": 12, "color": MUTED},
        "title": {"font": {"size": 13, "color": TEXT}, "standoff": 10},
        "automargin": True,
        "zeroline": False,
    }
    legend = {"orientation": "h", "x": 0, "y": 1.02, "xanchor": "left", "yanchor": "bottom"}
    return go.layout.Template(
        layout={
            "font": {"family": FONT, "size": 13, "color": TEXT},
            "paper_bgcolor": "rgba(0,0,0,0)",
            "plot_bgcolor": "rgba(0,0,0,0)",
            "colorway": [OURS, PAPER, GREEN],
            "margin": {"l": 56, "r": 16, "t": 44, "b": 48},
            "xaxis": axis,
            "yaxis": axis,
            "legend": {
                **legend,
                "font": {"size": 12},
                "bgcolor": "rgba(0,0,0,0)",
                "itemsizing": "constant",
            },
            "hoverlabel": {
                "bgcolor": RAISED,
                "bordercolor": LINE,
                "font": {"family": MONO, "size": 12, "color": TEXT},
                "align": "left",
            },
            "hovermode": "closest",
            "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": FAINT, "activecolor": TEXT},
            "scene": {name: _axis_3d() for name in ("xaxis", "yaxis", "zaxis")},
        }
    )


def _axis_3d() -> dict[str, object]:
    """Return the style of an axis of a 3-D scene."""
    return {
        "gridcolor": GRID,
        "zerolinecolor": LINE,
        "linecolor": LINE,
        "showbackground": False,
        "showspikes": False,
        "tickfont": {"family": MONO, "size": 11, "color": MUTED},
        "title": {"font": {"size": 12, "color": TEXT}},
    }


def coloured(value: object, tokens: Mapping[str, str]) -> object:
    """Return the values of a figure with CSS variables replaced by their colours."""
    if isinstance(value, str):
        name = value.removeprefix("var(").removesuffix(")")
        return tokens.get(name, value) if value.startswith("var(") else value
    if isinstance(value, Mapping):
        return {key: coloured(item, tokens) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [coloured(item, tokens) for item in value]
    return value
