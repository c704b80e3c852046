"""Routes of the pages of networks and calibrations, and the forms that start their jobs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any
from urllib.parse import parse_qsl

from fastapi import APIRouter, Depends, Request
from fastapi.responses import HTMLResponse, RedirectResponse

from spheremark.pipelines.errors import InputError
from spheremark.service.http.api.jobs import start
from spheremark.service.http.api.models import NewJob
from spheremark.service.http.pages.frame import frame_of, survey_row
from spheremark.service.http.state import Current, Service
from spheremark.service.http.uploads import media_type_of
from spheremark.service.jobs.handlers import KINDS
from spheremark.storage.catalogue.solutions import chosen_solution
from spheremark.web.links import survey_url
from spheremark.web.pages.calibration import calibration_page
from spheremark.web.pages.network import adjustment_page

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

_ADJUSTMENT = """
SELECT a.*, s.name AS survey, s.tolerance_m, c.rig_digest AS adjusted_rig
FROM adjustments AS a JOIN surveys AS s USING (survey_id)
LEFT JOIN calibrations AS c ON c.calibration_id = a.adjustment_id
WHERE a.adjustment_id = $id
"""
_TABLES = {
    "adjusted_stations": "station",
    "adjusted_marks": "mark",
    "adjusted_observations": "kind, station, marker, mark",
    "control_checks": "mark",
    "repeated_stops": "station, again",
    "mark_decisions": "mark",
    "mark_evidence": "mark, station",
    "refused_stations": "station",
}
"""Tables of a network, and the order of their rows."""
_CALIBRATION = """
SELECT c.*, s.name AS survey, s.rig_digest AS chosen_rig
FROM calibrations AS c JOIN surveys AS s USING (survey_id) WHERE c.calibration_id = $id
"""
_PARAMETERS = "SELECT * FROM calibrated_parameters WHERE calibration_id = $id ORDER BY place"
_GAPS = "SELECT * FROM calibration_gaps WHERE calibration_id = $id ORDER BY stop, marker"
_ADJUSTMENTS = """
SELECT a.adjustment_id, a.datum, a.status, a.n_stations, a.n_marks, a.passes_global_test, a.sigma0,
    a.finished_at,
    (SELECT sqrt(avg(x.sigma_3d_m ^ 2)) FROM adjusted_stations AS x
        WHERE x.adjustment_id = a.adjustment_id) AS station_sigma_rms_m,
    (SELECT max(x.difference_3d_m) FROM control_checks AS x
        WHERE x.adjustment_id = a.adjustment_id) AS control_max_m
FROM adjustments AS a WHERE a.survey_id = $id ORDER BY a.finished_at DESC LIMIT 20
"""
_CALIBRATIONS = """
SELECT calibration_id, rig_digest, len(stops) AS n_stops, gap_rms_before_m, gap_rms_after_m,
    finished_at
FROM calibrations WHERE survey_id = $id ORDER BY finished_at DESC LIMIT 20
"""
_N_CONTROL = "SELECT count(*) AS n FROM control_marks WHERE survey_id = $id"
_FILES = "SELECT name FROM documents WHERE result_id = $id ORDER BY name"
_FORM = "application/x-www-form-urlencoded"


@router.get("/surveys/{name:path}/network")
def network(name: str, service: Current) -> str:
    """Show the chosen network of a survey, else its newest, and all others by name."""
    found = survey_row(service, name)
    solution = chosen_solution(service.catalogue, found["survey_id"])
    return _network(service, found, solution.adjustment_id if solution else None)


@router.get("/adjustments/{adjustment_id}")
def adjustment(adjustment_id: str, service: Current) -> str:
    """Show an adjusted network."""
    found = service.row(_ADJUSTMENT, adjustment_id, "adjustment")
    return _network(service, survey_row(service, found["survey_id"]), adjustment_id)


def _network(service: Service, survey: Mapping[str, Any], shown: str | None) -> str:
    """Return the page of a network of a survey; without one, how to adjust."""
    frame = frame_of(service, survey["name"], "network")
    rows, key = service.catalogue.rows, {"id": survey["survey_id"]}
    all_of_survey = rows(_ADJUSTMENTS, key)
    control = rows(_N_CONTROL, key)[0]["n"]
    if shown is None and not all_of_survey:
        n_logs = len(service.catalogue.recordings_of_survey(survey["survey_id"]))
        return adjustment_page(frame, None, {}, (), n_control=control, n_logs=n_logs)
    shown = shown or all_of_survey[0]["adjustment_id"]
    sql = "SELECT * FROM {} WHERE adjustment_id = $id ORDER BY {}"
    tables = {
        table: service.catalogue.columns(sql.format(table, order), {"id": shown})
        for table, order in _TABLES.items()
    }
    solution = chosen_solution(service.catalogue, survey["survey_id"])
    return adjustment_page(
        frame,
        service.row(_ADJUSTMENT, shown, "adjustment"),
        tables,
        _files(service, shown),
        networks=all_of_survey,
        n_control=control,
        chosen=(solution and solution.adjustment_id) or "",
    )


@router.get("/surveys/{name:path}/rig")
def rig(name: str, service: Current) -> str:
    """Show the newest calibration of a survey, and all others by name."""
    return _rig(service, survey_row(service, name), None)


@router.get("/calibrations/{calibration_id}")
def calibration(calibration_id: str, service: Current) -> str:
    """Show a calibration."""
    found = service.row(_CALIBRATION, calibration_id, "calibration")
    return _rig(service, survey_row(service, found["survey_id"]), calibration_id)


def _rig(service: Service, survey: Mapping[str, Any], shown: str | None) -> str:
    """Return the page of a calibration of a survey; without one, how to calibrate."""
    frame = frame_of(service, survey["name"], "rig")
    columns = service.catalogue.columns
    all_of_survey = service.catalogue.rows(_CALIBRATIONS, {"id": survey["survey_id"]})
    more: dict[str, Any] = {"calibrations": all_of_survey, "rig": survey["rig_digest"]}
    if shown is None and not all_of_survey:
        return calibration_page(frame, None, {}, {}, files=(), is_chosen=False, **more)
    shown = shown or all_of_survey[0]["calibration_id"]
    found, key = service.row(_CALIBRATION, shown, "calibration"), {"id": shown}
    more["is_chosen"] = found["chosen_rig"] == found["rig_digest"]
    more["files"] = _files(service, shown)
    return calibration_page(frame, found, columns(_PARAMETERS, key), columns(_GAPS, key), **more)


async def form(request: Request) -> dict[str, str]:
    """Read the fields of a form."""
    media_type = media_type_of(request.headers)
    if media_type != _FORM:
        raise InputError(f"The body is {media_type or 'of no type'}; this page sends {_FORM}.")
    return dict(parse_qsl((await request.body()).decode("utf-8", "replace")))


Fields = Annotated[dict[str, str], Depends(form)]


@router.post("/surveys/{name:path}/jobs")
def start_job(name: str, fields: Fields, service: Current) -> RedirectResponse:
    """Start a job on a survey as a whole, and show it."""
    kinds = {kind.value: kind for kind, about in KINDS.items() if not about.takes_one_log}
    kind = kinds.get(fields.get("kind", ""))
    if kind is None:
        raise InputError(f"The kind is {fields.get('kind')!r}; it is one of {', '.join(kinds)}.")
    options = {
        name: fields[name] == "yes"
        for name in ("control", "calibrate", "reprocess")
        if name in fields
    }
    job = start(service, NewJob(kind=kind, survey=name, options=options))
    return RedirectResponse(f"/jobs/{job.job_id}", status_code=303)


@router.post("/surveys/{name:path}/rig")
def choose_rig(name: str, fields: Fields, service: Current) -> RedirectResponse:
    """Let later jobs of a survey use a rig, or again the one that each log describes."""
    survey = service.catalogue.choose_rig(name, fields.get("rig") or None)
    back = fields.get("back", "")
    is_ours = back.startswith("/calibrations/")
    target = back if is_ours else survey_url(survey.name, "rig")
    return RedirectResponse(target, status_code=303)


def _files(service: Service, key: str) -> tuple[str, ...]:
    """Return the names of the files of a result."""
    return tuple(row["name"] for row in service.catalogue.rows(_FILES, {"id": key}))
