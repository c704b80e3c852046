"""The page of a site: its ground with marks and stations, and its files."""

from __future__ import annotations

from typing import Any

from spheremark.pipelines.ground_model import ElevationModel
from spheremark.web.columns import Columns
from spheremark.web.figures import site as figures
from spheremark.web.pages.base import Frame, Panel
from spheremark.web.templating import render

_GROUND = (
    "Mean height of the ground in each cell, without rocks, poles and markers. Blank cells have no "
    "returns."
)
_SIGMA = (
    "Standard deviation of these heights on a logarithmic scale: noise, grazing beams, poses, "
    "roughness and interpolation."
)


def site_page(
    frame: Frame, model: ElevationModel | None, marks: Columns, stations: Columns, **more: Any
) -> str:
    """Return the page of a site; ``more`` are its files, newest first, and its active jobs."""
    panels = []
    if model is not None:
        panels = [
            Panel("ground", figures.ground(model, marks, stations), _GROUND, "tall"),
            Panel("sigma", figures.sigma(model, marks, stations), _SIGMA, "tall"),
        ]
    return render("site.html", frame=frame, survey=frame.survey, panels=panels, **more)
