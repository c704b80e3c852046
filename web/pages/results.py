"""Pages: from what was asked of the catalogue to HTML; every text is escaped by the templates.

Each page is a frozen context and a function. Rows are mappings named as the database names them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from spheremark.pipelines import published as study
from spheremark.pipelines.accuracy import summarise
from spheremark.web import theme
from spheremark.web.figures import included_angle as angles
from spheremark.web.figures import maps, scene
from spheremark.web.figures import survey as figures
from spheremark.web.figures.survey import (
    Columns,
    by_method,
    floats,
    has_errors,
    lane_and_number,
    on_marks,
    select,
    texts,
)
from spheremark.web.pages.filters import Filters
from spheremark.web.pages.readouts import headline
from spheremark.web.pages.statements import statements
from spheremark.web.templating import render

Row = Mapping[str, Any]
_MM = 1e3  # [mm/m]


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """What every page shows around itself."""

    surveys: tuple[str, ...] = ()
    survey: str = ""


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
    """What there is: the newest survey with results, all surveys, the newest recordings."""

    frame: Frame
    address: str
    newest: SurveyData | None
    surveys: tuple[Row, ...]
    recordings: tuple[Row, ...]
    n_active_jobs: int


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyResults:
    """What was made of a survey as a whole, and the rig that its jobs use."""

    adjustments: tuple[Row, ...] = ()
    calibrations: tuple[Row, ...] = ()
    rig_digest: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyPage:
    """The dashboard of a survey; ``n_logs`` belong to it, with results or not yet."""

    frame: Frame
    data: SurveyData
    results: SurveyResults
    filters: Filters
    jobs: tuple[Row, ...]
    address: str
    n_logs: int


@dataclass(frozen=True, slots=True, kw_only=True)
class StopPage:
    """One stop by one method; ``marker`` is the one to look at from near, if any.

    ``namesakes`` are this stop and others of its name, from other logs of the survey.
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


@dataclass(frozen=True, slots=True, kw_only=True)
class JobsPage:
    """The newest jobs."""

    frame: Frame
    jobs: tuple[Row, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class JobPage:
    """One job, the stops that it gave, and what it made of a survey as a whole."""

    frame: Frame
    job: Row
    stops: tuple[Row, ...]
    made: tuple[Row, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingPage:
    """One recording: its preflight report and its jobs."""

    frame: Frame
    recording: Row
    preflight: Mapping[str, Any]
    jobs: tuple[Row, ...]
    address: str


@dataclass(frozen=True, slots=True, kw_only=True)
class SqlPage:
    """The workbench for queries: schema, limits, and the query of the address."""

    frame: Frame
    query: str
    tables: tuple[Row, ...]
    seconds: float
    rows: int
    memory_bytes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorPage:
    """What went wrong, for people."""

    frame: Frame
    status: int
    title: str
    detail: str
    code: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """A figure with what the page says about it."""

    name: str
    figure: go.Figure
    caption: str
    kind: str = ""

    @property
    def title(self) -> str:
        """The title of the figure."""
        return str(self.figure.layout.title.text)


def overview_page(page: OverviewPage) -> str:
    """Return the first page."""
    newest = page.newest
    readouts = headline(newest.fits, newest.fixes, newest.tolerance_m) if newest else ()
    return render("overview.html", page, here="overview", readouts=readouts)


def survey_page(page: SurveyPage) -> str:
    """Return the dashboard of a survey under its filters."""
    data, keep = page.data, page.filters.apply
    shown = SurveyData(
        name=data.name,
        tolerance_m=data.tolerance_m,
        marks=data.marks,
        true_stops=data.true_stops,
        fits=keep(data.fits),
        fixes=keep(data.fixes),
        subsets=keep(data.subsets),
        subset_methods=data.subset_methods,
    )
    stops = sorted(set(texts(data.fits, "stop")), key=_lane_order)
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


def jobs_page(page: JobsPage) -> str:
    """Return the list of jobs."""
    return render("jobs.html", page, here="jobs")


def job_page(page: JobPage) -> str:
    """Return one job with its progress."""
    config = json.dumps(json.loads(page.job["config"]), indent=2)
    options = json.loads(page.job["options"] or "{}")
    return render("job.html", page, here="jobs", config=config, options=options)


def recording_page(page: RecordingPage) -> str:
    """Return one recording with its preflight report."""
    return render("recording.html", page, here="overview")


def sql_page(page: SqlPage) -> str:
    """Return the workbench for queries."""
    schema = {table["name"]: [row["name"] for row in table["columns"]] for table in page.tables}
    return render(
        "sql.html",
        page,
        here="sql",
        schema=schema,
        examples=EXAMPLES,
        chart_template=_chart_template(),
    )


def _chart_template() -> dict[str, Any]:
    """Return the look of a chart of a query's result, and the colour of each method."""
    layout = go.Figure(layout={"template": theme.template()}).to_plotly_json()["layout"]
    colours = {name: theme.method_style(name).colour for name in ("along_beam", "paper")}
    return {"layout": layout, "colours": colours}


def error_page(page: ErrorPage) -> str:
    """Return what went wrong in the look of all pages."""
    return render("error.html", page, here="")


EXAMPLES: tuple[tuple[str, str], ...] = (
    (
        "Error by distance",
        "SELECT fit_method, range_from_m, n_errors,\n"
        "    round(error_3d_rms_m * 1000, 1) AS rms_mm,\n"
        "    round(error_3d_p95_m * 1000, 1) AS p95_mm,\n"
        "    round(sigma_3d_rms_m * 1000, 1) AS predicted_mm\n"
        "FROM accuracy_by_distance\nORDER BY fit_method, range_from_m;",
    ),
    (
        "Worst markers",
        "SELECT survey, stop, marker, mark, fit_method, range_m, n_points,\n"
        "    coalesce(error_3d_m, sigma_3d_m) * 1000 AS error_or_sigma_mm, status, reason\n"
        "FROM latest_marker_fits\nORDER BY error_or_sigma_mm DESC\nLIMIT 20;",
    ),
    (
        "Stations",
        "SELECT survey, stop, fit_method, x_m, y_m, z_m,\n"
        "    sigma_3d_m * 1000 AS sigma_mm, error_3d_m * 1000 AS error_mm, n_markers, sigma0\n"
        "FROM latest_station_fixes\nORDER BY survey, stop, fit_method;",
    ),
    (
        "Error by included angle",
        "SELECT fit_method, included_angle_from_deg, n_resections,\n"
        "    error_3d_rms_m * 1000 AS rms_mm, sigma_3d_rms_m * 1000 AS predicted_mm,\n"
        "    resection_method, n_marks\n"
        "FROM accuracy_by_included_angle\n"
        "ORDER BY n_marks, resection_method, fit_method, included_angle_from_deg;",
    ),
    (
        "Are the sigmas honest?",
        "SELECT survey, fit_method, count(error_3d_m) AS n,\n"
        "    sqrt(avg(error_3d_m ^ 2)) * 1000 AS error_rms_mm,\n"
        "    sqrt(avg(sigma_3d_m ^ 2)) * 1000 AS predicted_mm,\n"
        "    sqrt(avg(error_3d_m ^ 2) / avg(sigma_3d_m ^ 2)) AS error_over_sigma\n"
        "FROM latest_marker_fits\nWHERE error_3d_m IS NOT NULL\nGROUP BY ALL\nORDER BY ALL;",
    ),
    (
        "Time of each step",
        "SELECT stop, n_returns, timings_s\nFROM stops\nORDER BY stop;",
    ),
)
"""Queries to begin with, by what they answer."""


def _survey_panels(data: SurveyData, filters: Filters) -> tuple[Panel, ...]:
    """Return the figures of the dashboard; none of an empty table."""
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
        "Each point is a stop from a few of its marks alone, lines their RMS in bins of 10 deg; "
        "level lines: from all marks. Theory: two marks, centres as good as ours are predicted, "
        "per axis. Circles touch instead of cutting near 0 and 180 deg, which gives the study its "
        "limits; 3-D centres lose nothing towards 180 deg."
    )
    figure = angles.error_against_angle(shown, data.tolerance_m, is_log=filters.is_log)
    return (Panel(name="angle", figure=figure, caption=caption, kind="keyed"),)


def _map_panel(data: SurveyData) -> tuple[Panel, ...]:
    """Return the map of the field, if there is anything to place on it."""
    placed = np.isfinite(floats(data.fixes, "x_m"))
    if not len(data.marks["mark"]) and not placed.any():
        return ()
    caption = "Ellipses are those of 95 % probability"
    if len(data.true_stops["stop"]):
        caption += "; the line from each station ends at its true place, enlarged alike"
    return (
        Panel(
            name="map",
            figure=maps.site_map(data.marks, select(data.fixes, placed), data.true_stops),
            caption=f"{caption}.",
        ),
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
            caption="Returns that the fit used, as one sees them from the LiDAR: a pattern "
            "across the sphere would mean a wrong radius or beams that met an edge.",
        )
    else:
        panels["scene"] = Panel(
            name="scene",
            figure=scene.stop_scene(page.scan, page.fits, page.rejections),
            caption="Drag to turn, scroll to come nearer; choose a marker in the table to see it "
            "from near.",
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
            caption="In the site frame, observed minus computed; grey bars are twice the sigma of "
            "the centre.",
        )
    }


def _stop_rows(data: SurveyData) -> list[dict[str, Any]]:
    """Return the table of stops: one row per stop and method."""
    rows = []
    fixes = {(row["stop"], row["fit_method"]): row for row in plain_rows(data.fixes)}
    for method, fits in by_method(data.fits):
        stops = np.array(texts(fits, "stop"), dtype=object)
        for stop in sorted(set(stops.tolist()), key=_lane_order):
            own = select(fits, stops == stop)
            rows.append(_stop_row(stop, method, own, fixes.get((stop, method)), data.tolerance_m))
    return sorted(rows, key=lambda row: (_lane_order(row["stop"]), row["method"]))


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


def _lane_order(stop: str) -> tuple[str, int, str]:
    """Sort stops lane by lane and by number."""
    lane, number = lane_and_number(stop)
    return (lane, -1 if number is None else number, stop)


def plain_rows(columns: Columns) -> list[dict[str, Any]]:
    """Return columns as rows of plain values."""
    lists: list[list[Any]] = [_plain(column) for column in columns.values()]
    return [dict(zip(columns, row, strict=True)) for row in zip(*lists, strict=True)]


def _plain(column: NDArray[Any]) -> list[Any]:
    """Return a column as plain values, with None for what is not known."""
    values: list[Any] = column.tolist()
    return [None if isinstance(value, float) and math.isnan(value) else value for value in values]
