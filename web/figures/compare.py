"""The differences of points that two results share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go

from spheremark.web import theme
from spheremark.web.columns import MM
from spheremark.web.figures.elements import add_points, blank_figure
from spheremark.web.pages.base import Row

_N_SHOWN = 60
_CHANCE = float(np.sqrt(7.814727903251179 / 3.0))  # 95 % of chi-squared of 3, over a 3-D sigma
_NOT = theme.Style("within chance", theme.MUTED, "circle")
_SIGNIFICANT = theme.Style("significant", theme.TOLERANCE, "diamond")


def difference_figure(rows: Sequence[Row]) -> go.Figure:
    """Draw the largest differences by name, with what chance gives to each."""
    figure = blank_figure("Largest differences", "Point", "Difference, 3-D [mm]")
    shown = rows[:_N_SHOWN]
    names = [row["name"] for row in shown]
    chance = [MM * _CHANCE * row["sigma_3d_m"] for row in shown]
    look = {"name": "by chance, 95 %", "marker_color": theme.OURS_BAND, "hoverinfo": "skip"}
    figure.add_bar(x=names, y=chance, **look)
    for style, is_significant in ((_NOT, False), (_SIGNIFICANT, True)):
        own = [row for row in shown if row["is_significant"] is is_significant]
        hover = "<b>{x}</b><br>{y:.2f} mm, sigma {sigma_3d_m:mm} mm"
        columns = {"sigma_3d_m": np.array([row["sigma_3d_m"] for row in own])}
        y = [MM * row["difference_3d_m"] for row in own]
        ids = [row["href"] for row in own]
        add_points(figure, [row["name"] for row in own], y, style, hover, columns, ids=ids)
    figure.update_xaxes(type="category", categoryorder="array", categoryarray=names)
    figure.update_yaxes(rangemode="tozero")
    return figure
