"""Figures of a calibration: differences of the two faces before and after, biases of lasers."""

from __future__ import annotations

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from spheremark.web import theme
from spheremark.web.columns import MM, Columns, floats, texts
from spheremark.web.figures.elements import blank_figure, details

_BEYOND = 2.0  # sigmas
_WAYS = {"radial": "along the line of sight", "across": "across it", "up": "up"}
_STYLES = (("before", theme.MUTED, "circle-open"), ("after", theme.OURS, "circle"))


def face_gaps(before: Columns, after: Columns) -> go.Figure:
    """Draw the difference of the two faces of each sphere, before and after a calibration."""
    figure = blank_figure("Front minus back of each sphere")
    make_subplots(len(_WAYS), 1, shared_xaxes=True, vertical_spacing=0.06, figure=figure)
    for row, (way, label) in enumerate(_WAYS.items(), start=1):
        for columns, style in zip((before, after), _STYLES, strict=True):
            _add_gaps(figure, columns, way, style, row)
        figure.add_hline(y=0, line={"color": theme.LINE, "width": 1}, layer="below", row=row, col=1)
        figure.update_yaxes(title_text=f"{label} [mm]", row=row, col=1)
    figure.update_xaxes(range=[-180, 180], dtick=60)
    figure.update_xaxes(title_text="Azimuth in base [deg]", row=len(_WAYS), col=1)
    return figure


def _add_gaps(
    figure: go.Figure, rows: Columns, way: str, style: tuple[str, str, str], row: int
) -> None:
    """Draw the gaps along one direction with one rig."""
    name, colour, symbol = style
    figure.add_scatter(
        x=floats(rows, "azimuth_deg"),
        y=MM * floats(rows, f"gap_{way}_m"),
        mode="markers",
        name=name,
        legendgroup=name,
        showlegend=row == 1,
        marker={"color": colour, "symbol": symbol, "size": 6},
        customdata=details(rows, ("stop", "marker"), ("range_m",)),
        hovertemplate="<b>%{customdata[0]}</b> %{customdata[1]}, %{customdata[2]:.1f} m<br>"
        f"%{{y:.1f}} mm {_WAYS[way]}<extra>{name}</extra>",
        row=row,
        col=1,
    )


def laser_biases(parameters: Columns) -> go.Figure:
    """Draw the range bias of each laser before and after, with twice its sigma."""
    figure = blank_figure("Range bias of each laser")
    lasers = [int(name.rsplit("_", 1)[1]) for name in texts(parameters, "parameter")]
    for (name, colour, symbol), column in zip(_STYLES, ("start_value", "estimate"), strict=True):
        figure.add_scatter(
            x=lasers,
            y=MM * floats(parameters, column),
            mode="markers",
            name=name,
            marker={"color": colour, "symbol": symbol, "size": 8},
            error_y={
                "type": "data",
                "array": _BEYOND * MM * floats(parameters, "sigma"),
                "color": colour,
                "thickness": 1.5,
                "width": 3,
                "visible": column == "estimate",
            },
            hovertemplate=f"laser %{{x}}: %{{y:.1f}} mm<extra>{name}</extra>",
        )
    figure.add_hline(y=0, line={"color": theme.LINE, "width": 1}, layer="below")
    figure.update_xaxes(title_text="Laser, from the lowest", dtick=1)
    figure.update_yaxes(title_text="Measured too long [mm]")
    return figure
