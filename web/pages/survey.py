"""The overview, and the page of a survey: figures and a table of its stops under filters."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from spheremark.pipelines import published as study
from spheremark.pipelines.accuracy import summarise
from spheremark.web.columns import (
    Columns,
    by_method,
    floats,
    has_errors,
    lane_and_number,
    lane_order,
    on_marks,
    plain_rows,
    select,
    texts,
)
from spheremark.web.figures import included_angle as angles
from spheremark.web.figures import maps
from spheremark.web.figures import survey as figures
from spheremark.web.pages.base import Frame, Panel
from spheremark.web.pages.filters import Filters
from spheremark.web.pages.readouts import headline
from spheremark.web.pages.statements import statements
from spheremark.web.templating import render

_DISTANCE = (
    "Each point is a sphere at one stop; lines are the RMS in bins of 1 m. Hollow points are weak "
    "fits."
)
_COUNT = (
    "The same spheres by the number of returns that the fit used; lines are the RMS in bins of 20."
)
_LANE = "The study's Figure 11. Whiskers end at the largest of each stop."
_ANGLE = (
    "Each point is a stop from two or three of its marks, lines are their RMS in bins of 10 deg, "
    "level lines are from all marks. The theory is for two marks with the predicted sigma of our "
    "centres per axis. Two circles touch near 0 and 180 deg, hence the limits of the study; 3-D "
    "centres lose nothing towards 180 deg."
)
_MAP = "Ellipses are those of 95 % probability"
_ERRORS = "; the line from each station points to its true position, with the same scale"


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyData:
    """The newest results of one survey, as columns of the database."""

    name: str
    tolerance_m: float
    marks: Columns
    true_stops: Columns
    fits: Columns
    fixes: Columns
    subsets: Columns
    subset_methods: tuple[str, ...]


def overview_page(frame: Frame, newest: SurveyData | None, **more: Any) -> str:
    """Return the overview: the newest survey with results, all surveys, the newest recordings."""
    readouts = headline(newest.fits, newest.fixes, newest.tolerance_m) if newest else ()
    return render("overview.html", frame=frame, newest=newest, readouts=readouts, **more)


def survey_page(frame: Frame, data: SurveyData, filters: Filters, **more: Any) -> str:
    """Return the page of a survey under its filters.

    ``more`` are its active jobs, the number of its logs, the address of the service, and the
    results on the whole survey: ``adjustments``, ``calibrations`` and the rig of its jobs.
    """
    keep = filters.apply
    shown = replace(data, fits=keep(data.fits), fixes=keep(data.fixes), subsets=keep(data.subsets))
    stops = sorted(set(texts(data.fits, "stop")), key=lane_order)
    return render(
        "survey.html",
        frame=frame,
        data=data,
        filters=filters,
        readouts=headline(shown.fits, shown.fixes, data.tolerance_m),
        panels=_panels(shown, filters),
        rows=_stop_rows(shown),
        kept=statements(select(shown.fits, on_marks(shown.fits)), data.tolerance_m),
        study=study,
        all_stops=stops,
        all_lanes=list(dict.fromkeys(lane_and_number(stop)[0] for stop in stops)),
        all_methods=[method for method, _ in by_method(data.fits)],
        n_shown=len(shown.fits["stop"]),
        n_all=len(data.fits["stop"]),
        has_truth=has_errors(data.fits),
        **more,
    )


def _panels(data: SurveyData, filters: Filters) -> list[Panel]:
    """Return the figures of a survey; none of an empty table."""
    fits, limit, is_log = data.fits, data.tolerance_m, filters.is_log
    if not len(fits["stop"]):
        return []
    distance = figures.error_against_distance(fits, limit, is_log=is_log)
    count = figures.error_against_count(fits, limit, is_log=is_log)
    panels = [Panel("distance", distance, _DISTANCE), Panel("count", count, _COUNT)]
    fixes = select(data.fixes, np.isfinite(floats(data.fixes, "x_m")))
    if len(data.marks["mark"]) or len(fixes["stop"]):
        caption = _MAP + (_ERRORS if len(data.true_stops["stop"]) else "")
        figure = maps.site_map(data.marks, fixes, data.true_stops)
        panels.append(Panel("map", figure, f"{caption}."))
    if len(data.subsets["stop"]):
        figure = angles.error_against_angle(_subsets(data, filters), limit, is_log=is_log)
        panels.append(Panel("angle", figure, _ANGLE, "keyed"))
    return [*panels, Panel("lane", figures.error_along_lane(fits, limit), _LANE)]


def _subsets(data: SurveyData, filters: Filters) -> angles.Subsets:
    """Return the positions from few marks, and those from all of them."""
    counts = np.array(texts(data.fixes, "resection_method")) == "free_station"
    return angles.Subsets(
        rows=data.subsets,
        fixes=select(data.fixes, counts),
        n_marks=filters.n_marks,
        resection=filters.resection,
        sigma_axis_m=angles.centres_sigma(data.fits),
    )


def _stop_rows(data: SurveyData) -> list[dict[str, Any]]:
    """Return the table of stops: one row per stop and method."""
    rows = []
    fixes = {(row["stop"], row["fit_method"]): row for row in plain_rows(data.fixes)}
    for method, fits in by_method(data.fits):
        stops = np.array(texts(fits, "stop"), dtype=object)
        for stop in sorted(set(stops.tolist()), key=lane_order):
            names = {"stop": stop, "method": method, "fix": fixes.get((stop, method))}
            rows.append(names | _of_stop(select(fits, stops == stop), data.tolerance_m))
    return sorted(rows, key=lambda row: (lane_order(row["stop"]), row["method"]))


def _of_stop(fits: Columns, tolerance_m: float) -> dict[str, Any]:
    """Return the numbers of the table of stops for the fits of a stop."""
    n_all, fits = len(fits["stop"]), select(fits, on_marks(fits))
    errors = summarise(floats(fits, "error_3d_m"), tolerance_m)
    return {
        "n_markers": len(fits["stop"]),
        "n_others": n_all - len(fits["stop"]),
        "mean_range_m": float(np.mean(floats(fits, "range_m"))),
        "error_mean_m": errors.mean,
        "error_max_m": errors.largest,
        "sigma_rms_m": summarise(floats(fits, "sigma_3d_m"), tolerance_m).rms,
    }
