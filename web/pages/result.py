"""The tab that a survey opens with: its decision, its coordinates, its map, what to do next."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from spheremark.web.columns import Columns, has_errors, plain_rows
from spheremark.web.figures.solution import heights, solution_map
from spheremark.web.links import query_text, survey_url
from spheremark.web.pages.base import Frame, Panel
from spheremark.web.templating import render

_MAP = "Ellipses are those of 95 % probability, horizontal"
_MAP_ERRORS = "; the line from a station points to its true position, with the same scale"
_HEIGHTS = "Bars are the 95 % interval of each height"
_HEIGHT_ERRORS = "; dots are the height error against truth"


def result_page(frame: Frame, result: Any, marks: Columns, true_stops: Columns, **more: Any) -> str:
    """Return the result of a survey; ``result`` has its solution, decision, checks and stations.

    ``more`` are the tolerance, the number of logs and of other results, and the active jobs.
    """
    stations, has_truth = result.stations, has_errors(result.stations)
    is_valid = all(good is None or bool(good) for good in stations["passes_global_test"])
    panels = []
    if len(stations["station"]):
        free = result.solution.solution == "free network"
        given = {name: column[:0] for name, column in marks.items()} if free else marks
        shown = true_stops if not free else {n: c[:0] for n, c in true_stops.items()}
        text = _MAP + (_MAP_ERRORS if len(shown["stop"]) else "")
        sql = query_text("chosen_stations", survey=frame.survey)
        note = f"{_HEIGHTS}{_HEIGHT_ERRORS * has_truth}."
        panels = [
            Panel("map", solution_map(given, stations, shown), f"{text}.", "tall", sql),
            Panel("heights", heights(stations), note, "tall", sql),
        ]
    return render(
        "result.html",
        frame=frame,
        decision=result.decision,
        solution=result.solution,
        checks=result.checks,
        rows=plain_rows({name: stations[name] for name in _SHOWN}),
        missing=result.missing,
        panels=panels,
        has_truth=has_truth,
        is_valid=is_valid,
        steps=next_steps(frame.survey, result, more["n_logs"], more["counts"]),
        **more,
    )


_SHOWN = (
    *("station", "stop", "status", "reason", "x_m", "y_m", "z_m", "yaw_deg", "sigma_yaw_deg"),
    *("cov_xx_m2", "cov_yy_m2", "cov_zz_m2", "sigma_3d_m", "error_3d_m", "error_z_m"),
    *("n_markers", "passes_global_test", "sigma0"),
)


def next_steps(
    survey: str, result: Any, n_logs: int, counts: Mapping[str, Any]
) -> list[tuple[str, str, str]]:
    """Return what to do next: a sentence, an address, and the kind of job if it starts one."""
    steps: list[tuple[str, str, str]] = []
    solution = result.solution
    changed = counts["control_changed_at"]
    if not n_logs:
        return [("Upload the logs of its stops.", survey_url(survey, "logs"), "")]
    if solution is None:
        steps.append(("Process its logs, or read why that failed.", survey_url(survey, "logs"), ""))
    elif solution.adjustment_id is None and counts["n_stops"] > 1:
        steps.append(
            (
                "Adjust all stations together: they then share marks and control each other.",
                "",
                "adjust",
            )
        )
    elif solution.adjustment_id is not None and result.missing:
        steps.append(("Adjust again: stops were processed after this network.", "", "adjust"))
    elif changed is not None and changed > solution.finished_at:
        steps.append(("Adjust again: control marks were set after this result.", "", "adjust"))
    if not counts["n_control"]:
        text = "Give it control marks, for coordinates in the site frame."
        steps.append((text, survey_url(survey, "logs") + "#control", ""))
    if result.decision.status in ("refused", "weak"):
        steps.append(("See which observations do not fit.", survey_url(survey, "network"), ""))
    if result.decision.status in ("accepted", "weak"):
        steps.append(("Print or sign the report.", survey_url(survey, "report"), ""))
    if solution is not None and not counts["n_products"]:
        steps.append(("Make the cloud and the ground of the site.", survey_url(survey, "site"), ""))
    return steps
