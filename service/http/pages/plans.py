"""Routes of the pages of plans."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse
from pydantic import ValidationError

from spheremark.pipelines.errors import InputError
from spheremark.service.http.api.plans import RandomTrial, sites, tried
from spheremark.service.http.pages.frame import frame_of
from spheremark.service.http.state import Current
from spheremark.storage.catalogue import plans as kept
from spheremark.web.pages import planner

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)


@router.get("/plan")
def plan(service: Current) -> str:
    """Show the planner; its script reads the address."""
    return planner.planner_page(
        planner.PlannerPage(
            frame=frame_of(service),
            sites=sites(service),
            plans=kept.list_plans(service.catalogue),
        )
    )


@router.get("/plan/random")
def random_marks(request: Request, service: Current) -> str:
    """Show what comes of marks at random: the study's own procedure."""
    asked: dict[str, Any] = {key: text for key, text in request.query_params.items() if text}
    if "error_per_axis_mm" in asked:
        error = _number(asked.pop("error_per_axis_mm"))
        asked["error_per_axis_m"] = error / 1000 if error else None
    if "tolerance_mm" in asked:
        asked["tolerance_m"] = _number(asked.pop("tolerance_mm")) / 1000
    try:
        wanted = RandomTrial.model_validate(asked)
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}.") from error
    return planner.trials_page(
        planner.TrialsPage(
            frame=frame_of(service), wanted=wanted.model_dump(), answer=tried(service, wanted)
        )
    )


def _number(text: str) -> float:
    """Return a number that was typed."""
    try:
        return float(text)
    except ValueError as error:
        raise InputError(f"{text!r} is no number.") from error


@router.get("/plan/{placement_id}")
def kept_plan(placement_id: str, service: Current) -> str:
    """Show a kept plan, and what came of it."""
    found = kept.get_plan(service.catalogue, placement_id)
    return planner.plan_page(
        planner.PlanPage(frame=frame_of(service, found["survey"] or ""), plan=found)
    )
