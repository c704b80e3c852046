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
from spheremark.web.pages.base import Frame, Panel, Row
from spheremark.web.pages.filters import Filters
from spheremark.web.pages.readouts import headline
from spheremark.web.pages.statements import statements
from spheremark.web.templating import render


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


@dataclass(frozen=True, slots=True, kw_only=True)
class OverviewPage:
    """The newest survey with results, all surveys, the newest recordings."""

    frame: Frame
    address: str
    newest: SurveyData | None
    surveys: tuple[Row, ...]
    recordings: tuple[Row, ...]
    n_active_jobs: int


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyResults:
    """Results on the whole survey, and the rig of its jobs."""

    adjustments: tuple[Row, ...] = ()
    calibrations: tuple[Row, ...] = ()
    rig_digest: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyPage:
    """The page of a survey; ``n_logs`` counts logs with and without results."""

    frame: Frame
    data: SurveyData
    results: SurveyResults
    filters: Filters
    jobs: tuple[Row, ...]
    address: str
    n_logs: int


def overview_page(page: OverviewPage) -> str:
    """Return the overview."""
    newest = page.newest
    readouts = headline(newest.fits, newest.fixes, newest.tolerance_m) if newest else ()
    return render("overview.html", page, here="overview", readouts=readouts)


def survey_page(page: SurveyPage) -> str:
    """Return the page of a survey under its filters."""
    data, keep = page.data, page.filters.apply
    shown = replace(data, fits=keep(data.fits), fixes=keep(data.fixes), subsets=keep(data.subsets))
    stops = sorted(set(texts(data.fits, "stop")), key=lane_order)
    return render(
        "survey.html",
        page,
        here="survey",
        readouts=headline(shown.fits, shown.fixes, data.tolerance_m),
        panels=_survey_panels(shown, page.filters),
        rows=_stop_rows(shown),
        kept=statements(select(shown.fits, on_marks(shown.fits)), data.tolerance_m),
        study=study,
        all_stops=stops,
        all_lanes=list(dict.fromkeys(lane_and_number(stop)[0] for stop in stops)),
        all_methods=[method for method, _ in by_method(data.fits)],
        n_shown=len(shown.fits["stop"]),
        n_all=len(data.fits["stop"]),
        has_truth=has_errors(data.fits),
    )


def _survey_panels(data: SurveyData, filters: Filters) -> tuple[Panel, ...]:
    """Return the figures of a survey; none of an empty table."""
    if not len(data.fits["stop"]):
        return ()
    is_log = filters.is_log
    distance = Panel(
        name="distance",
        figure=figures.error_against_distance(data.fits, data.tolerance_m, is_log=is_log),
        caption="Each point is a sphere at one stop; lines are the RMS in bins of 1 m. "
        "Hollow points are weak fits.",
    )
    count = Panel(
        name="count",
        figure=figures.error_against_count(data.fits, data.tolerance_m, is_log=is_log),
        caption="The same spheres by the number of returns that the fit used; lines are the RMS "
        "in bins of 20.",
    )
    lane = Panel(
        name="lane",
        figure=figures.error_along_lane(data.fits, data.tolerance_m),
        caption="The study's Figure 11. Whiskers end at the largest of each stop.",
    )
    return (distance, count, *_map_panel(data), *_angle_panel(data, filters), lane)


def _angle_panel(data: SurveyData, filters: Filters) -> tuple[Panel, ...]:
    """Return the figure of included angles, if there are any."""
    if not len(data.subsets["stop"]):
        return ()
    counts = np.array(texts(data.fixes, "resection_method")) == "free_station"
    shown = angles.Subsets(
        rows=data.subsets,
        fixes=select(data.fixes, counts),
        n_marks=filters.n_marks,
        resection=filters.resection,
        sigma_axis_m=angles.centres_sigma(data.fits),
    )
    caption = (
        "Each point is a stop from two or three of its marks, lines are their RMS in bins of "
        "10 deg, level lines are from all marks. The theory is for two marks with the predicted "
        "sigma of our centres per axis. Two circles touch near 0 and 180 deg, hence the limits of "
        "the study; 3-D centres lose nothing towards 180 deg."
    )
    figure = angles.error_against_angle(shown, data.tolerance_m, is_log=filters.is_log)
    return (Panel(name="angle", figure=figure, caption=caption, kind="keyed"),)


def _map_panel(data: SurveyData) -> tuple[Panel, ...]:
    """Return the map of the field, if it has a mark or a station."""
    placed = np.isfinite(floats(data.fixes, "x_m"))
    if not len(data.marks["mark"]) and not placed.any():
        return ()
    caption = "Ellipses are those of 95 % probability"
    if len(data.true_stops["stop"]):
        caption += "; the line from each station points to its true position, with the same scale"
    return (
        Panel(
            name="map",
            figure=maps.site_map(data.marks, select(data.fixes, placed), data.true_stops),
            caption=f"{caption}.",
        ),
    )


def _stop_rows(data: SurveyData) -> list[dict[str, Any]]:
    """Return the table of stops: one row per stop and method."""
    rows = []
    fixes = {(row["stop"], row["fit_method"]): row for row in plain_rows(data.fixes)}
    for method, fits in by_method(data.fits):
        stops = np.array(texts(fits, "stop"), dtype=object)
        for stop in sorted(set(stops.tolist()), key=lane_order):
            own = select(fits, stops == stop)
            rows.append(_stop_row(stop, method, own, fixes.get((stop, method)), data.tolerance_m))
    return sorted(rows, key=lambda row: (lane_order(row["stop"]), row["method"]))


def _stop_row(
    stop: str, method: str, fits: Columns, fix: Row | None, tolerance_m: float
) -> dict[str, Any]:
    """Return one row of the table of stops."""
    n_all, fits = len(fits["stop"]), select(fits, on_marks(fits))
    errors = summarise(floats(fits, "error_3d_m"), tolerance_m)
    sigmas = summarise(floats(fits, "sigma_3d_m"), tolerance_m)
    return {
        "stop": stop,
        "method": method,
        "n_markers": len(fits["stop"]),
        "n_others": n_all - len(fits["stop"]),
        "mean_range_m": float(np.mean(floats(fits, "range_m"))),
        "error_mean_m": errors.mean,
        "error_max_m": errors.largest,
        "sigma_rms_m": sigmas.rms,
        "fix": fix,
    }
