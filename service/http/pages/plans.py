"""Routes of the pages of plans."""

from __future__ import annotations

from typing import Any, TypeVar
from urllib.parse import urlencode

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse
from pydantic import BaseModel, ValidationError

from spheremark.pipelines.errors import InputError
from spheremark.pipelines.placement import round_trip
from spheremark.service.http.api.plan_models import PlanRequest, RandomPlansRequest
from spheremark.service.http.api.plans import assembled_of, random_specification, sites
from spheremark.service.http.pages.frame import frame_of
from spheremark.service.http.state import Current, Service
from spheremark.service.planning import plans
from spheremark.storage.catalogue import plans as stored
from spheremark.web.pages import planner
from spheremark.web.templating import render

Model = TypeVar("Model", bound=BaseModel)

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)


@router.get("/plan")
def plan(service: Current) -> str:
    """Show the planner; its script reads the address."""
    kept = stored.list_plans(service.catalogue)
    return render("planner.html", frame=frame_of(service), sites=sites(service), plans=kept)


@router.get("/plan/random")
def random_marks(request: Request, service: Current) -> str:
    """Show the results of random arrangements: the study's own procedure."""
    given: dict[str, Any] = {key: text for key, text in request.query_params.items() if text}
    if "error_per_axis_mm" in given:
        error = _number(given.pop("error_per_axis_mm"))
        given["error_per_axis_m"] = error / 1000 if error else None
    if "tolerance_mm" in given:
        given["tolerance_m"] = _number(given.pop("tolerance_mm")) / 1000
    options = _valid(RandomPlansRequest, given)
    given = options.model_dump(mode="json")
    found = service.searches.find("random", given)
    if found is None:
        random_specification(service, options)  # refuses what its search would
    return planner.random_plans_page(frame_of(service), given, found)


@router.get("/plan/search/{search}")
def search_of_plans(search: str, service: Current) -> str:
    """Show a search of plans: how far it has come, or what it found."""
    return planner.search_page(frame_of(service), service.searches.get(search))


@router.get("/plan/sheet")
async def field_sheet(request: Request, service: Current) -> str:
    """Show the field sheet of the plan of an address, as the planner writes it."""
    return await service.plans.run(request, _sheet, service, dict(request.query_params))


def _sheet(service: Service, query: dict[str, str]) -> str:
    """Return a field sheet."""
    assembled = assembled_of(service, _requested(query))
    found = plans.evaluate(assembled, service.planner.visibility)
    walk = round_trip(assembled.stops.p_site[0], assembled.marks.p_site)
    opened = f"/plan?{urlencode(query)}"
    return planner.sheet_page(frame_of(service), found, walk, opened)


def _requested(query: dict[str, str]) -> PlanRequest:
    """Return the plan of an address."""
    marks = _places(query.get("a", ""), ("x_m", "y_m", "pole_height_m"))
    if not marks:
        raise InputError("The address holds no marks; open the field sheet from a plan with some.")
    given: dict[str, Any] = {"marks": marks}
    if "stops" in query:
        given["stops"] = _places(query["stops"], ("x_m", "y_m"))
    given |= {key: query[key] for key in ("site", "method", "model") if key in query}
    for name, key, scale in _NUMBERS:
        if query.get(name):
            given[key] = scale * _number(query[name])
    if query.get("pole_low") and query.get("pole_high"):
        given["pole_heights_m"] = [_number(query["pole_low"]), _number(query["pole_high"])]
    return _valid(PlanRequest, given)


_NUMBERS = (
    ("tolerance", "tolerance_m", 1e-3),
    ("turn", "turn_s", 1.0),
    ("rpm", "spin_rpm", 1.0),
    ("step", "step_deg", 1.0),
    ("rests", "rest_revolutions", 1.0),
    ("noise", "noise_m", 1e-3),
    ("sigma_marks", "sigma_marks_m", 1e-3),
    ("occlusion", "occlusion", 1e-2),
)


def _places(text: str, keys: tuple[str, ...]) -> list[dict[str, Any]]:
    """Return places of an address: name:x,y;name:x,y with further numbers for some."""
    places = []
    for part in filter(None, text.split(";")):
        name, _, numbers = part.partition(":")
        values = [_number(one) for one in numbers.split(",")]
        if len(values) != len(keys):
            raise InputError(f"{part!r} of the address has {len(values)} numbers, not {len(keys)}.")
        places.append({"name": name, **dict(zip(keys, values, strict=True))})
    return places


def _valid(model: type[Model], given: dict[str, Any]) -> Model:
    """Return options that are checked."""
    try:
        return model.model_validate(given)
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}.") from error


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
