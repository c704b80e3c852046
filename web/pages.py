"""Pages: from what was asked of the catalogue to HTML; every text is escaped by the templates.

Each page is a frozen context and a function. Rows are mappings named as the database names them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from functools import cache
from typing import Any

import numpy as np
import plotly.graph_objects as go
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from numpy.typing import NDArray
from plotly.io.json import to_json_plotly

from pipelines.accuracy import ErrorSummary, summarise
from web import assets, figures, scene, theme
from web.figures import (
    Columns,
    by_method,
    floats,
    has_errors,
    lane_and_number,
    on_marks,
    select,
    texts,
)
from web.filters import Filters

Row = Mapping[str, Any]
_MM = 1e3  # [mm/m]
_UNKNOWN = "\N{EN DASH}"
_ENDINGS = {
    "_deg_per_s": "deg/s",
    "_deg": "deg",
    "_rpm": "rpm",
    "_hz": "Hz",
    "_bytes": "B",
    "_s": "s",
    "_m": "m",
}


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
    pairs: Columns


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
class SurveyPage:
    """The dashboard of a survey."""

    frame: Frame
    data: SurveyData
    filters: Filters
    jobs: tuple[Row, ...]
    address: str


@dataclass(frozen=True, slots=True, kw_only=True)
class StopPage:
    """One stop by one method; ``marker`` is the one to look at from near, if any."""

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


@dataclass(frozen=True, slots=True, kw_only=True)
class JobsPage:
    """The newest jobs."""

    frame: Frame
    jobs: tuple[Row, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class JobPage:
    """One job, and the stops that it gave."""

    frame: Frame
    job: Row
    stops: tuple[Row, ...]


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
    columns: tuple[Row, ...]
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Readout:
    """A number that matters, with its unit and what it means."""

    label: str
    value: str
    unit: str
    note: str
    method: str = ""


def overview_page(page: OverviewPage) -> str:
    """Return the first page."""
    newest = page.newest
    readouts = headline(newest.fits, newest.fixes, newest.tolerance_m) if newest else ()
    return _render("overview.html", page, here="overview", readouts=readouts)


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
        pairs=keep(data.pairs),
    )
    stops = sorted(set(texts(data.fits, "stop")), key=_lane_order)
    return _render(
        "survey.html",
        page,
        here="survey",
        readouts=headline(shown.fits, shown.fixes, data.tolerance_m),
        panels=_survey_panels(shown, is_log=page.filters.is_log),
        rows=_stop_rows(shown),
        all_stops=stops,
        all_lanes=list(dict.fromkeys(lane_and_number(stop)[0] for stop in stops)),
        all_methods=[method for method, _ in by_method(data.fits)],
        n_shown=len(shown.fits["stop"]),
        n_all=len(data.fits["stop"]),
        has_truth=has_errors(data.fits),
    )


def stop_page(page: StopPage) -> str:
    """Return one stop: its scan, its markers, its position."""
    markers = _rows(page.fits)
    place = page.stops.index(page.stop["stop"])
    return _render(
        "stop.html",
        page,
        here="survey",
        markers=markers,
        rejected=_rows(page.rejections),
        used=_rows(page.observations),
        panels=_stop_panels(page),
        fix=next((fix for fix in page.fixes if fix["fit_method"] == page.method), None),
        before=page.stops[place - 1] if place else "",
        after=page.stops[place + 1] if place + 1 < len(page.stops) else "",
        has_truth=has_errors(page.fits),
    )


def jobs_page(page: JobsPage) -> str:
    """Return the list of jobs."""
    return _render("jobs.html", page, here="jobs")


def job_page(page: JobPage) -> str:
    """Return one job with its progress."""
    config = json.dumps(json.loads(page.job["config"]), indent=2)
    return _render("job.html", page, here="jobs", config=config)


def recording_page(page: RecordingPage) -> str:
    """Return one recording with its preflight report."""
    return _render("recording.html", page, here="overview")


def sql_page(page: SqlPage) -> str:
    """Return the workbench for queries."""
    by_table: dict[str, list[Row]] = {}
    for column in page.columns:
        by_table.setdefault(column["table_name"], []).append(column)
    schema = {table: [row["column_name"] for row in rows] for table, rows in by_table.items()}
    return _render(
        "sql.html",
        page,
        here="sql",
        by_table=by_table,
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
    return _render("error.html", page, here="")


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
        "    error_3d_rms_m * 1000 AS rms_mm, sigma_3d_rms_m * 1000 AS predicted_mm\n"
        "FROM accuracy_by_included_angle\nWHERE n_marks = 2\n"
        "ORDER BY fit_method, included_angle_from_deg;",
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


def headline(fits: Columns, fixes: Columns, tolerance_m: float) -> tuple[Readout, ...]:
    """Return the few numbers that matter: centres and stations, each method, and the sigma."""
    readouts = []
    for method, rows in by_method(fits):
        real = on_marks(rows)
        n_others = int(np.count_nonzero(~real))
        readouts.append(
            _quality("Centres", method, select(rows, real), tolerance_m, n_others=n_others)
        )
    for method, rows in by_method(fixes):
        readouts.append(_quality("Stations", method, rows, tolerance_m))
    ours = [rows for method, rows in by_method(fits) if method == "along_beam"]
    return (*readouts, *(_predicted(rows) for rows in ours if has_errors(rows)))


def _quality(
    what: str, method: str, rows: Columns, tolerance_m: float, *, n_others: int = 0
) -> Readout:
    """Return the error of one method against truth; without truth its predicted sigma."""
    style = theme.method_style(method)
    is_error = has_errors(rows)
    summary = summarise(floats(rows, "error_3d_m" if is_error else "sigma_3d_m"), tolerance_m)
    return Readout(
        label=f"{what}, {style.label}",
        value=_number(summary.rms * _MM, 1),
        unit="mm RMS error" if is_error else "mm predicted sigma",
        note=_share(summary, tolerance_m, is_error=is_error)
        + (f"; {n_others} on no mark" if n_others else ""),
        method=method,
    )


def _share(summary: ErrorSummary, tolerance_m: float, *, is_error: bool) -> str:
    """Say how many are within the tolerance, and how large the largest is."""
    if not summary.n:
        return "none yet"
    within = round(summary.share_within * summary.n)
    what = "within" if is_error else "with a sigma within"
    return (
        f"{within} of {summary.n} {what} {tolerance_m * _MM:g} mm, "
        f"largest {summary.largest * _MM:.1f} mm"
    )


def _predicted(rows: Columns) -> Readout:
    """Say what our sigma promised, and how that compares with the error."""
    error, sigma = floats(rows, "error_3d_m"), floats(rows, "sigma_3d_m")
    known = np.isfinite(error)
    sigma_rms = float(np.sqrt(np.mean(sigma[known] ** 2)))
    ratio = float(np.sqrt(np.mean(error[known] ** 2))) / sigma_rms if sigma_rms else math.nan
    return Readout(
        label="Centres, predicted by us",
        value=_number(sigma_rms * _MM, 1),
        unit="mm sigma",
        note=f"error over sigma {ratio:.2f}; 1 is honest",
        method="along_beam",
    )


def _survey_panels(data: SurveyData, *, is_log: bool) -> tuple[Panel, ...]:
    """Return the figures of the dashboard; none of an empty table."""
    if not len(data.fits["stop"]):
        return ()
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
    return (distance, count, *_map_panel(data), *_angle_panel(data, is_log=is_log), lane)


def _angle_panel(data: SurveyData, *, is_log: bool) -> tuple[Panel, ...]:
    """Return the figure of included angles, if there are any."""
    if not len(data.pairs["stop"]):
        return ()
    figure = figures.error_against_angle(data.pairs, data.fixes, data.tolerance_m, is_log=is_log)
    return (
        Panel(
            name="angle",
            figure=figure,
            caption="Small points: the station from two marks alone, with gravity. Large: from "
            "all marks, at their least angle. Shaded: outside the study's 30 to 150 deg.",
        ),
    )


def _map_panel(data: SurveyData) -> tuple[Panel, ...]:
    """Return the map of the field, if there is anything to place on it."""
    placed = np.isfinite(floats(data.fixes, "x_m"))
    if not len(data.marks["mark"]) and not placed.any():
        return ()
    caption = "Ellipses hold the true place in 95 of 100 cases"
    if len(data.true_stops["stop"]):
        caption += "; the line from each station ends there, enlarged alike"
    return (
        Panel(
            name="map",
            figure=figures.site_map(data.marks, select(data.fixes, placed), data.true_stops),
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
    fixes = {(row["stop"], row["fit_method"]): row for row in _rows(data.fixes)}
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


def _rows(columns: Columns) -> list[dict[str, Any]]:
    """Return columns as rows of plain values."""
    lists: list[list[Any]] = [_plain(column) for column in columns.values()]
    return [dict(zip(columns, row, strict=True)) for row in zip(*lists, strict=True)]


def _plain(column: NDArray[Any]) -> list[Any]:
    """Return a column as plain values, with None for what is not known."""
    values: list[Any] = column.tolist()
    return [None if isinstance(value, float) and math.isnan(value) else value for value in values]


def _render(template: str, page: Any, **more: Any) -> str:
    """Fill a template with the fields of a page and what was made of them."""
    context = {field.name: getattr(page, field.name) for field in fields(page)}
    return _environment().get_template(template).render(**context, **more)


@cache
def _environment() -> Environment:
    """Return the templates with the filters that they use."""
    environment = Environment(
        loader=PackageLoader("web"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(
        metres=lambda value: _number(value, 3),
        mm=lambda value: _number(None if value is None else value * _MM, 1),
        fixed=_number,
        mib=lambda value: _number(None if value is None else value / 2**20, 1),
        moment=_moment,
        json_block=json_block,
        figure_block=lambda figure: _as_block(str(to_json_plotly(figure.to_plotly_json()))),
        method=lambda name: theme.method_style(name).label,
        unit=unit_of,
        heading=heading,
    )
    environment.globals.update(assets=assets)
    return environment


def json_block(value: Any) -> Markup:
    """Return a value as JSON that may stand inside a script element."""
    return _as_block(json.dumps(value))


def _as_block(text: str) -> Markup:
    """Mark JSON as safe, once nothing in it can end the element that holds it."""
    return Markup(text.replace("<", "\\u003c").replace("&", "\\u0026"))


def unit_of(column: str) -> str:
    """Return the unit that the name of a column ends in."""
    if column == "cov_motion":
        return "rad, m"
    units = {"m": "m", "m2": "m²", "deg": "deg", "s": "s", "bytes": "B", "percent": "%"}
    return units.get(column.rpartition("_")[2], "") if "_" in column else ""


def heading(name: str) -> str:
    """Return the name of a column or key as people write it, with its unit in brackets."""
    for ending, unit in _ENDINGS.items():
        if name.endswith(ending):
            return f"{_words(name.removesuffix(ending))} [{unit}]"
    return _words(name)


def _words(name: str) -> str:
    """Return a name as words, the first with a capital."""
    words = name.removeprefix("n_").removeprefix("has_").replace("_", " ")
    return words[:1].upper() + words[1:]


def _number(value: float | None, decimals: int = 2) -> str:
    """Write a number, or a dash for what is not known."""
    if value is None or not math.isfinite(value):
        return _UNKNOWN
    return f"{value:.{decimals}f}"


def _moment(value: datetime | None) -> str:
    """Write an instant in UTC."""
    return _UNKNOWN if value is None else f"{value.astimezone(UTC):%Y-%m-%d %H:%M:%S} UTC"
