"""The page of a site: its ground with marks and stations, and its files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from spheremark.pipelines.ground_model import ElevationModel
from spheremark.web.columns import Columns
from spheremark.web.figures import site as figures
from spheremark.web.pages.base import Frame, Panel
from spheremark.web.templating import render


@dataclass(frozen=True, slots=True, kw_only=True)
class SitePage:
    """The products of all stops of a survey, newest first, and the newest ground."""

    frame: Frame
    survey: str
    products: tuple[Mapping[str, Any], ...]
    model: ElevationModel | None
    marks: Columns
    stations: Columns
    jobs: tuple[str, ...]


def site_page(page: SitePage) -> str:
    """Return the page of a site."""
    panels = []
    if page.model is not None:
        panels = [
            Panel(
                name="ground",
                figure=figures.ground(page.model, page.marks, page.stations),
                caption="Mean height of the ground in each cell, without rocks, poles and markers. "
                "Blank cells have no returns.",
                kind="tall",
            ),
            Panel(
                name="sigma",
                figure=figures.sigma(page.model, page.marks, page.stations),
                caption="Standard deviation of these heights on a logarithmic scale: noise, "
                "grazing beams, poses, roughness and interpolation.",
                kind="tall",
            ),
        ]
    return render("site.html", page, here="surveys", panels=panels)
