"""Routes of the pages of networks and calibrations, and the forms that start their jobs."""

from __future__ import annotations

from typing import Annotated
from urllib.parse import parse_qsl, quote

from fastapi import APIRouter, Depends, Request
from fastapi.responses import HTMLResponse, RedirectResponse

from spheremark.pipelines.errors import InputError
from spheremark.service.http.api.jobs import start
from spheremark.service.http.api.models import NewJob
from spheremark.service.http.pages.frame import frame_of
from spheremark.service.http.state import Current, Service
from spheremark.service.jobs.handlers import KINDS
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
    "refused_stations": "station",
}
"""Tables of a network, and the order of their rows."""
_CALIBRATION = """
SELECT c.*, s.name AS survey, s.rig_digest AS chosen_rig
FROM calibrations AS c JOIN surveys AS s USING (survey_id) WHERE c.calibration_id = $id
"""
_PARAMETERS = "SELECT * FROM calibrated_parameters WHERE calibration_id = $id ORDER BY place"
_GAPS = "SELECT * FROM calibration_gaps WHERE calibration_id = $id ORDER BY stop, marker"
_FILES = "SELECT name FROM documents WHERE result_id = $id ORDER BY name"
_FORM = "application/x-www-form-urlencoded"


@router.get("/adjustments/{adjustment_id}")
def adjustment(adjustment_id: str, service: Current) -> str:
    """Show an adjusted network."""
    found = service.row(_ADJUSTMENT, adjustment_id, "adjustment")
    sql = "SELECT * FROM {} WHERE adjustment_id = $id ORDER BY {}"
    tables = {
        table: service.catalogue.columns(sql.format(table, order), {"id": adjustment_id})
        for table, order in _TABLES.items()
    }
    frame, files = frame_of(service, found["survey"]), _files(service, adjustment_id)
    return adjustment_page(frame, found, tables, files)


@router.get("/calibrations/{calibration_id}")
def calibration(calibration_id: str, service: Current) -> str:
    """Show a calibration."""
    found = service.row(_CALIBRATION, calibration_id, "calibration")
    columns, key = service.catalogue.columns, {"id": calibration_id}
    more = {"is_chosen": found["chosen_rig"] == found["rig_digest"]}
    more["files"] = _files(service, calibration_id)
    frame = frame_of(service, found["survey"])
    return calibration_page(frame, found, columns(_PARAMETERS, key), columns(_GAPS, key), **more)


async def form(request: Request) -> dict[str, str]:
    """Read the fields of a form."""
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
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
    options = {name: fields[name] == "yes" for name in ("control", "calibrate") if name in fields}
    job = start(service, NewJob(kind=kind, survey=name, options=options))
    return RedirectResponse(f"/jobs/{job.job_id}", status_code=303)


@router.post("/surveys/{name:path}/rig")
def choose_rig(name: str, fields: Fields, service: Current) -> RedirectResponse:
    """Let later jobs of a survey use a rig, or again the one that each log describes."""
    survey = service.catalogue.choose_rig(name, fields.get("rig") or None)
    back = fields.get("back", "")
    is_ours = back.startswith("/calibrations/")
    target = back if is_ours else f"/surveys/{quote(survey.name, safe='')}"
    return RedirectResponse(target, status_code=303)


def _files(service: Service, key: str) -> tuple[str, ...]:
    """Return the names of the files of a result."""
    return tuple(row["name"] for row in service.catalogue.rows(_FILES, {"id": key}))
