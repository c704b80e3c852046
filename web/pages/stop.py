"""The page of a stop: its scan, its markers and its position."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spheremark.web.columns import Columns, floats, has_errors, plain_rows, select, texts
from spheremark.web.figures import scene
from spheremark.web.figures import survey as figures
from spheremark.web.pages.base import Frame, Panel, Row
from spheremark.web.templating import render


@dataclass(frozen=True, slots=True, kw_only=True)
class StopPage:
    """One stop by one method; ``marker`` is shown in detail, if any.

    ``namesakes`` are all stops of this name, from several logs of the survey.
    """

    frame: Frame
    survey: str
    tolerance_m: float
    stop: Row
    run: Row
    stops: tuple[str, ...]
    method: str
    methods: tuple[str, ...]
    marker: str
    fits: Columns
    rejections: Columns
    fixes: tuple[Row, ...]
    observations: Columns
    scan: scene.Scan | None
    namesakes: tuple[Row, ...] = ()


def stop_page(page: StopPage) -> str:
    """Return one stop: its scan, its markers, its position."""
    markers = plain_rows(page.fits)
    place = page.stops.index(page.stop["stop"])
    return render(
        "stop.html",
        page,
        here="survey",
        markers=markers,
        rejected=plain_rows(page.rejections),
        used=plain_rows(page.observations),
        panels=_stop_panels(page),
        fix=next((fix for fix in page.fixes if fix["fit_method"] == page.method), None),
        before=page.stops[place - 1] if place else "",
        after=page.stops[place + 1] if place + 1 < len(page.stops) else "",
        has_truth=has_errors(page.fits),
    )


def _stop_panels(page: StopPage) -> dict[str, Panel]:
    """Return the figures of a stop by name."""
    panels = _residual_panel(page)
    names = texts(page.fits, "marker")
    if page.scan is None:
        return panels
    if page.marker in names:
        place = names.index(page.marker)
        panels["scene"] = Panel(
            name="scene",
            figure=scene.marker_close_up(page.scan, page.fits, place),
            caption="Blue returns are too near, orange ones too far. Seen from the LiDAR.",
            kind="tall",
        )
        panels["returns"] = Panel(
            name="returns",
            figure=scene.marker_residuals(page.scan, page.fits, place),
            caption="Returns that the fit used, seen from the LiDAR. A pattern across the sphere "
            "indicates a wrong radius or beams that hit an edge.",
        )
    else:
        panels["scene"] = Panel(
            name="scene",
            figure=scene.stop_scene(page.scan, page.fits, page.rejections),
            caption="Drag to rotate, scroll to zoom. Choose a marker in the table for its details.",
            kind="tall",
        )
    return panels


def _residual_panel(page: StopPage) -> dict[str, Panel]:
    """Return the residuals of the station, if it has any."""
    used = select(page.observations, np.isfinite(floats(page.observations, "residual_x_m")))
    if not len(used["marker"]):
        return {}
    return {
        "residuals": Panel(
            name="residuals",
            figure=figures.station_residuals(used, page.tolerance_m),
            caption="In the site frame, observed minus computed. Grey bars are twice the sigma of "
            "the centre.",
        )
    }
