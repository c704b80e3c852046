"""The tab that a survey opens with: its decision, its coordinates, its map, what to do next."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from spheremark.web.columns import has_errors, plain_rows
from spheremark.web.links import survey_url
from spheremark.web.pages.base import Frame, Part, Place
from spheremark.web.templating import render

_N_ROWS = 100  # stations in one part of the table
_FIGURES = ("solution", "heights")


def result_page(frame: Frame, result: Any, *, after: int, **more: Any) -> str:
    """Return the result of a survey; ``result`` has its solution, decision, checks and stations.

    ``after`` is the place of the first station in the table; ``more`` are the tolerance, the number
    of logs and of other results, and the active jobs.
    """
    stations = {name: result.stations[name] for name in _SHOWN}
    part = slice(after, after + _N_ROWS)
    return render(
        "result.html",
        frame=frame,
        decision=result.decision,
        solution=result.solution,
        checks=result.checks,
        rows=plain_rows({name: column[part] for name, column in stations.items()}),
        part=Part(after, _N_ROWS, len(stations["station"])),
        places=[Place.of(name, frame.survey, "tall") for name in _FIGURES],
        has_truth=has_errors(result.stations),
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
