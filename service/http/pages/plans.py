"""Routes of the pages of plans."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse
from pydantic import ValidationError

from spheremark.pipelines.errors import InputError
from spheremark.service.http.api.plan_models import RandomPlansRequest
from spheremark.service.http.api.plans import simulated, sites
from spheremark.service.http.pages.frame import frame_of
from spheremark.service.http.state import Current
from spheremark.storage.catalogue import plans as stored
from spheremark.web.pages import planner
from spheremark.web.templating import render

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)


@router.get("/plan")
def plan(service: Current) -> str:
    """Show the planner; its script reads the address."""
    plans = stored.list_plans(service.catalogue)
    return render("planner.html", frame=frame_of(service), sites=sites(service), plans=plans)


@router.get("/plan/random")
def random_marks(request: Request, service: Current) -> str:
    """Show the results of random arrangements: the study's own procedure."""
    given: dict[str, Any] = {key: text for key, text in request.query_params.items() if text}
    if "error_per_axis_mm" in given:
        error = _number(given.pop("error_per_axis_mm"))
        given["error_per_axis_m"] = error / 1000 if error else None
    if "tolerance_mm" in given:
        given["tolerance_m"] = _number(given.pop("tolerance_mm")) / 1000
    try:
        options = RandomPlansRequest.model_validate(given)
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}.") from error
    results = simulated(service, options)
    return planner.random_plans_page(frame_of(service), options.model_dump(), results)


def _number(text: str) -> float:
    """Return a number of the form."""
    try:
        return float(text)
    except ValueError as error:
        raise InputError(f"{text!r} is not a number.") from error


@router.get("/plan/{placement_id}")
def stored_plan(placement_id: str, service: Current) -> str:
    """Show a stored plan and, once surveyed, its results."""
    found = stored.get_plan(service.catalogue, placement_id)
    return planner.plan_page(frame_of(service, found["survey"] or ""), found)
