"""Routes of the pages of plans."""

from __future__ import annotations

from fastapi import APIRouter
from fastapi.responses import HTMLResponse

from service.api.plans import sites
from service.pages import frame_of
from service.state import Current
from storage import plans as kept
from web import planner

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


@router.get("/plan/{placement_id}")
def kept_plan(placement_id: str, service: Current) -> str:
    """Show a kept plan, and what came of it."""
    found = kept.get_plan(service.catalogue, placement_id)
    return planner.plan_page(
        planner.PlanPage(frame=frame_of(service, found["survey"] or ""), plan=found)
    )
