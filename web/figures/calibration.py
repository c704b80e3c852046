"""Figures of a calibration: differences of the two faces before and after, biases of lasers."""

from __future__ import annotations

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from spheremark.web import theme
from spheremark.web.columns import MM, Columns, floats, texts
from spheremark.web.figures.elements import add_points, add_zero, blank_figure

_BEYOND = 2.0  # sigmas
_WAYS = {"radial": "along the line of sight", "across": "across it", "up": "up"}
_AXES = {"radial": "along [mm]", "across": "across [mm]", "up": "up [mm]"}
_BEFORE = theme.Style("before", theme.MUTED, "circle-open")
_AFTER = theme.Style("after", theme.OURS)


def face_gaps(before: Columns, after: Columns) -> go.Figure:
    """Draw the difference of the two faces of each sphere, before and after a calibration."""
    figure = blank_figure("Front minus back of each sphere")
    make_subplots(len(_WAYS), 1, shared_xaxes=True, vertical_spacing=0.06, figure=figure)
    for row, (way, label) in enumerate(_WAYS.items(), start=1):
        hover = f"<b>{{stop}}</b> {{marker}}, {{range_m:.1f}} m<br>{{y:.1f}} mm {label}"
        for rows, style in ((before, _BEFORE), (after, _AFTER)):
            x, y = floats(rows, "azimuth_deg"), MM * floats(rows, f"gap_{way}_m")
            place = {"legendgroup": style.label, "showlegend": row == 1, "row": row, "col": 1}
            add_points(figure, x, y, style, hover, rows, marker_size=6, **place)
        add_zero(figure, row=row, col=1)
        figure.update_yaxes(title_text=_AXES[way], row=row, col=1)
    figure.update_xaxes(range=[-180, 180], dtick=60)
    figure.update_xaxes(title_text="Azimuth in base [deg]", row=len(_WAYS), col=1)
    return figure


def laser_biases(parameters: Columns) -> go.Figure:
    """Draw the range bias of each laser before and after, with twice its sigma."""
    figure = blank_figure(
        "Range bias of each laser", "Laser, from the lowest", "Measured too long [mm]"
    )
    lasers = [int(name.rsplit("_", 1)[1]) for name in texts(parameters, "parameter")]
    bars = {"array": _BEYOND * MM * floats(parameters, "sigma"), "thickness": 1.5, "width": 3}
    hover = "laser {x}: {y:.1f} mm"
    add_points(figure, lasers, MM * floats(parameters, "start_value"), _BEFORE, hover)
    estimates = MM * floats(parameters, "estimate")
    add_points(figure, lasers, estimates, _AFTER, hover, error_y=bars | {"color": theme.OURS})
    add_zero(figure)
    figure.update_xaxes(dtick=1)
    return figure
