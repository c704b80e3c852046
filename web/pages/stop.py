"""The page of a stop: its scan, its markers and its position."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from spheremark.web.columns import Columns, floats, has_errors, plain_rows, select, texts
from spheremark.web.figures import scene
from spheremark.web.figures import survey as figures
from spheremark.web.links import query_text, stop_url
from spheremark.web.pages.base import Frame, Panel, Row
from spheremark.web.templating import render

_CLOSE_UP = "Blue returns are too near, orange ones too far. Seen from the LiDAR."
_RETURNS = (
    "Returns that the fit used, seen from the LiDAR. A pattern across the sphere indicates a wrong "
    "radius or beams that hit an edge."
)
_SCENE = "Drag to rotate, scroll to zoom. Choose a marker in the table for its details."
_RESIDUALS = (
    "In the site frame, observed minus computed. Grey bars are twice the sigma of the centre."
)


def stop_page(
    frame: Frame, stop: Row, tables: Mapping[str, Columns], scan: scene.Scan | None, **more: Any
) -> str:
    """Return one stop by one method: its scan, its markers, its position.

    ``more`` are the tolerance, the names of all stops and methods, the method and the marker that
    were chosen, the stations by all methods as ``fixes``, and the stops of this name as
    ``namesakes`` where several logs have one.
    """
    place = more["stops"].index(stop["stop"])
    names = ("", *more["stops"], "")
    groups = plain_rows(tables["rejections"])
    return render(
        "stop.html",
        frame=frame,
        survey=frame.survey,
        stop=stop,
        markers=plain_rows(tables["fits"]),
        **{
            name: [row for row in groups if row["is_possible"] == (name == "possible")]
            for name in ("possible", "rejected")
        },
        used=plain_rows(tables["observations"]),
        panels=_panels(
            tables, scan, more["marker"], more["tolerance_m"], _Links(frame, stop, more)
        ),
        fix=next((fix for fix in more["fixes"] if fix["fit_method"] == more["method"]), None),
        before=names[place],
        after=names[place + 2],
        has_truth=has_errors(tables["fits"]),
        **more,
    )


class _Links:
    """Links to the markers of a stop by one method, and queries of its rows."""

    def __init__(self, frame: Frame, stop: Row, more: Mapping[str, Any]) -> None:
        self._stop = (frame.survey, str(stop["stop"]), str(more["method"]))
        self._run = str(stop["run_id"])

    def of(self, markers: Sequence[str]) -> list[str]:
        """Return the address of each marker."""
        return [stop_url(*self._stop, marker) for marker in markers]

    def query(self, table: str) -> str:
        """Return the query of the rows of a table."""
        return query_text(table, run_id=self._run, stop=self._stop[1], fit_method=self._stop[2])


def _panels(
    tables: Mapping[str, Columns],
    scan: scene.Scan | None,
    marker: str,
    tolerance_m: float,
    links: _Links,
) -> dict[str, Panel]:
    """Return the figures of a stop by name."""
    panels, fit_rows = [], links.query("marker_fits")
    fits, observations = tables["fits"], tables["observations"]
    used = select(observations, np.isfinite(floats(observations, "residual_x_m")))
    if len(used["marker"]):
        markers = links.of(texts(used, "marker"))
        figure = figures.station_residuals(used, tolerance_m, links=markers)
        panels.append(Panel("residuals", figure, _RESIDUALS, sql=links.query("observations")))
    if scan is not None and marker in (names := texts(fits, "marker")):
        i = names.index(marker)
        panels.append(
            Panel("scene", scene.marker_close_up(scan, fits, i), _CLOSE_UP, "tall", fit_rows)
        )
        residuals = scene.marker_residuals(scan, fits, i)
        panels.append(Panel("returns", residuals, _RETURNS, sql=fit_rows))
    elif scan is not None:
        markers = links.of(texts(fits, "marker"))
        figure = scene.stop_scene(scan, fits, tables["rejections"], links=markers)
        panels.append(Panel("scene", figure, _SCENE, "tall", fit_rows))
    return {panel.name: panel for panel in panels}


def stops_page(frame: Frame, rows: Sequence[Row], **more: Any) -> str:
    """Return the stops of a survey by its chosen solution.

    ``more`` are the tolerance, and which part of all stops these rows are.
    """
    return render(
        "stops.html",
        frame=frame,
        rows=rows,
        has_truth=any(row["error_rms_m"] is not None for row in rows),
        has_remarks=any(
            row["solution"] is None or row["station_reason"] or row["notes"] for row in rows
        ),
        **more,
    )
