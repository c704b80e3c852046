"""Routes of plans: where markers should stand, and the predicted accuracy of an arrangement."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Header, Path, Query, Request, Response
from fastapi.responses import JSONResponse, PlainTextResponse

from spheremark.pipelines.placement import CentreModel, RandomPlanSpec, Requirement
from spheremark.service.http.api.models import Listing
from spheremark.service.http.api.plan_models import (
    EvaluationRequest,
    Key,
    MappedEvaluation,
    NewPlan,
    NewSearch,
    OptimisationRequest,
    OptimisedPlan,
    PlanRequest,
    PlanSearch,
    PlanSite,
    PlanSummary,
    RandomPlansRequest,
    RandomPlansResult,
    RequestedMark,
    StoredPlan,
    SuggestedMark,
    SuggestionRequest,
)
from spheremark.service.http.api.sql import ORIGIN, POINT_MEDIA
from spheremark.service.http.state import Current, Service
from spheremark.service.http.uploads import Received
from spheremark.service.planning import plans, random_plans
from spheremark.service.planning.requests import (
    SCENARIOS,
    TERRAIN,
    Place,
    Plan,
    marks_at,
    spread_stops,
    stops_at,
)
from spheremark.service.serialise.plans import Plain, plan_points, site_json, to_csv
from spheremark.storage.catalogue import plans as stored
from spheremark.storage.exports.points import GeographicOrigin, format_points
from spheremark.storage.imports.terrain import KEPT, check_ending, read_terrain, write_grid

router = APIRouter(tags=["plans"])

_MARKER_RADIUS = 0.100  # [m]
_GROUND_ACROSS = 150  # places of the ground's heights that a map shows
_TERRAIN = {
    "requestBody": {
        "required": True,
        "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
    }
}

_WAIT = 90.0  # [s] that a request waits for a search at most: proxies end silent ones at 100 s
_ACCEPTED: dict[int | str, dict[str, Any]] = {
    202: {
        "model": PlanSearch,
        "description": "It takes longer than the request waits: a search, with its address.",
        "headers": {
            "Location": {"description": "Address of the search.", "schema": {"type": "string"}}
        },
    }
}
Preference = Annotated[
    str | None,
    Header(
        description="How long the request waits: `wait=10` seconds, 90 at most and by default, or "
        "`respond-async`, not at all (RFC 7240)."
    ),
]

SiteKey = Annotated[
    str, Path(description="paper-field, paper-field@3 (another seed), or terrain:<id>.")
]


@router.get("/plans/sites", name="list_sites")
def list_sites(service: Current) -> Listing[Key]:
    """List the fields that can be planned on."""
    return Listing(items=[Key.model_validate(one) for one in sites(service)])


def sites(service: Service) -> list[Plain]:
    """Return the fields that can be planned on, as key and name."""
    uploaded = [
        {"key": TERRAIN + one["terrain_id"], "name": one["name"]}
        for one in stored.list_terrains(service.catalogue)
    ]
    return [{"key": key, "name": name} for key, name in SCENARIOS.items()] + uploaded


@router.get("/plans/sites/{site}", name="get_site")
def get_site(site: SiteKey, service: Current) -> PlanSite:
    """Return a field: its ground, its stops, and marks to begin with."""
    ground = service.planner.ground(site)
    found = site_json(ground.site, ground.stops, ground.marks, n_across=_GROUND_ACROSS)
    return PlanSite.model_validate({"key": ground.key, **found, "extent_m": ground.view})


@router.post("/plans/evaluate", name="evaluate_plan", response_model=MappedEvaluation)
async def evaluate_plan(
    plan: EvaluationRequest,
    request: Request,
    service: Current,
    origin: Annotated[str | None, Query(description=ORIGIN)] = None,
) -> Response:
    """Predict the accuracy of every stop, as JSON, CSV, DXF, LandXML or GeoJSON, and on a map."""
    accept = request.headers.get("accept", "")
    return await service.plans.run(request, _evaluated, service, plan, accept, origin)


def _evaluated(
    service: Service, plan: EvaluationRequest, accept: str, origin: str | None
) -> Response:
    """Return an evaluation in the format that is accepted."""
    place = GeographicOrigin.parse(origin) if origin else None
    assembled = assembled_of(service, plan)
    found = plans.evaluate(assembled, service.planner.visibility)
    if plan.field_cells:
        cache = service.planner.visibility
        seen = plan.viewshed_of
        found["field"] = plans.evaluate_field(assembled, plan.field_cells, cache, seen)
    if accept.startswith("text/csv"):
        return PlainTextResponse(to_csv(found), media_type="text/csv")
    for kind, media_type in POINT_MEDIA.items():
        if accept.startswith(media_type):
            text = format_points(plan_points(found), f".{kind}", place)
            return Response(text, media_type=media_type)
    return JSONResponse(found)


@router.post(
    "/plans/optimise", name="optimise_plan", response_model=OptimisedPlan, responses=_ACCEPTED
)
async def optimise_plan(
    plan: OptimisationRequest,
    request: Request,
    service: Current,
    prefer: Preference = None,
) -> OptimisedPlan | Response:
    """Find the best places for a number of marks, or the fewest that keep the tolerance."""
    new = NewSearch(optimise=plan)
    found = await service.plans.run(request, _awaited, service, new, _seconds(prefer))
    return found if isinstance(found, Response) else OptimisedPlan.model_validate(found)


@router.post("/plans/searches", name="start_search", status_code=202)
async def start_search(
    new: NewSearch, request: Request, service: Current, response: Response
) -> PlanSearch:
    """Start a search of plans: of the best one, of several to choose from, or at random."""
    found = await service.plans.run(request, _started, service, new)
    response.headers["Location"] = f"/api/v1/plans/searches/{found['search_id']}"
    return PlanSearch.model_validate(found)


def _started(service: Service, new: NewSearch) -> Plain:
    """Start a search."""
    return service.searches.start(new.kind, _request(new), *_call(service, new))


def _awaited(service: Service, new: NewSearch, seconds: float) -> Plain | Response:
    """Return the result of a search, or its address if it takes longer than some time."""
    call = _call(service, new)
    found, search_id = service.searches.run(new.kind, _request(new), seconds, *call)
    if found is not None:
        return found
    search = PlanSearch.model_validate(service.searches.get(search_id))
    headers = {"Location": f"/api/v1/plans/searches/{search_id}"}
    return JSONResponse(search.model_dump(mode="json"), 202, headers)


def _request(new: NewSearch) -> Plain:
    """Return the request of a search, as kept."""
    request: Plain = getattr(new, new.kind).model_dump(mode="json")
    return request


def _call(service: Service, new: NewSearch) -> tuple[Any, ...]:
    """Return the function of a search and its arguments."""
    if new.random is not None:
        return random_plans.run_reported, *random_specification(service, new.random)
    given = getattr(new, new.kind)
    assembled, aim = assembled_of(service, given), _aim(given)
    if new.trade_off is not None:
        return plans.trade_off, assembled, aim, new.trade_off.numbers, new.trade_off.loss_weights
    return plans.optimise, assembled, aim


def _seconds(prefer: str | None) -> float:
    """Return how long a request waits for its result, by the header Prefer (RFC 7240) [s]."""
    preferences = [one.strip().lower() for one in (prefer or "").split(",")]
    waits = [one.removeprefix("wait=") for one in preferences if one.startswith("wait=")]
    if waits and waits[0].isdecimal():
        return min(float(waits[0]), _WAIT)
    return 0.0 if "respond-async" in preferences else _WAIT


def _aim(plan: OptimisationRequest) -> plans.Aim:
    """Return what a search is for."""
    return plans.Aim(
        rules=plan.rules.to_rules(),
        goal=plan.to_goal(),
        costs=plan.costs(),
        keeps_marks=plan.keep_marks,
    )


SearchId = Annotated[str, Path(description="Id of the search.")]


@router.get("/plans/searches", name="list_searches")
def list_searches(service: Current) -> Listing[PlanSearch]:
    """List searches of plans without their results, newest first."""
    every = service.searches.list()
    return Listing(items=[PlanSearch.model_validate(one) for one in every])


@router.get("/plans/searches/{search}", name="get_search")
def get_search(search: SearchId, service: Current) -> PlanSearch:
    """Return a search: how far it has come and, once it has ended, its result."""
    return PlanSearch.model_validate(service.searches.get(search))


@router.delete("/plans/searches/{search}", name="dismiss_search")
def dismiss_search(search: SearchId, service: Current) -> PlanSearch:
    """End a search."""
    return PlanSearch.model_validate(service.searches.dismiss(search))


@router.post("/plans/suggest", name="suggest_mark")
async def suggest_mark(
    plan: SuggestionRequest, request: Request, service: Current
) -> SuggestedMark:
    """Return the one more mark that would help most."""

    def suggested() -> Plain:
        rules = plan.rules.to_rules()
        return service.predictions.run(plans.suggest, assembled_of(service, plan), rules)

    return SuggestedMark.model_validate(await service.plans.run(request, suggested))


@router.post(
    "/plans/random", name="try_at_random", response_model=RandomPlansResult, responses=_ACCEPTED
)
async def simulate_random_plans(
    options: RandomPlansRequest,
    request: Request,
    service: Current,
    prefer: Preference = None,
) -> RandomPlansResult | Response:
    """Simulate random arrangements as in the study: an error on every centre, pass or fail."""
    new = NewSearch(random=options)
    found = await service.plans.run(request, _awaited, service, new, _seconds(prefer))
    return found if isinstance(found, Response) else RandomPlansResult.model_validate(found)


def random_specification(
    service: Service, options: RandomPlansRequest
) -> tuple[RandomPlanSpec, CentreModel, Plain]:
    """Return what random arrangements are drawn by: their specification, model and limits."""
    planner = service.planner
    survey = options.model.partition("survey:")[2]  # its fits give the limits too
    limits = random_plans.limits_of_results(
        planner.query, options.fit_method, options.tolerance_m, survey
    )
    low, high = (
        None if angle is None else math.radians(angle)
        for angle in (options.angle_min_deg, options.angle_max_deg)
    )
    spec = random_plans.within_limits(
        options.to_spec(), limits, options.distance_max_m, (low, high)
    )
    model = planner.model(options.model, options.to_sensor(), _MARKER_RADIUS)
    return spec, model, limits


@router.post("/plans", name="keep_plan", status_code=201)
async def store_plan(
    plan: NewPlan, request: Request, service: Current, response: Response
) -> StoredPlan:
    """Store a plan: its predictions become rows of placements."""
    stored_plan = await service.plans.run(request, _store, service, plan)
    response.headers["Location"] = f"/api/v1/plans/{stored_plan.placement_id}"
    return stored_plan


def _store(service: Service, plan: NewPlan) -> StoredPlan:
    """Evaluate a plan and store it."""
    survey = service.catalogue.get_survey(plan.survey).survey_id if plan.survey else None
    found = plans.evaluate(assembled_of(service, plan), service.planner.visibility)
    placement_id = stored.keep_plan(service.catalogue, _to_store(plan, survey, found))
    return StoredPlan.model_validate(stored.get_plan(service.catalogue, placement_id))


@router.get("/plans", name="list_plans")
def list_plans(
    service: Current,
    survey: Annotated[str | None, Query(description="Id or name of a survey.")] = None,
) -> Listing[PlanSummary]:
    """List stored plans, newest first."""
    survey_id = service.catalogue.id_of_survey(survey) if survey else None
    rows = stored.list_plans(service.catalogue, survey_id)
    return Listing(items=[PlanSummary.model_validate(row) for row in rows])


@router.get("/plans/{plan}", name="get_plan")
def get_plan(
    plan: Annotated[str, Path(description="Id of the plan.")], service: Current
) -> StoredPlan:
    """Return a stored plan: its prediction at each stop and, once surveyed, the result."""
    return StoredPlan.model_validate(stored.get_plan(service.catalogue, plan))


@router.post("/terrains", name="upload_terrain", status_code=201, openapi_extra=_TERRAIN)
async def upload_terrain(
    request: Request,
    service: Current,
    name: Annotated[str, Query(min_length=1, max_length=200, description="Name of the file.")],
) -> Key:
    """Keep the grid of a terrain to plan on: GeoTIFF, ESRI ASCII grid, or cloud (LAS, LAZ, PLY)."""
    check_ending(name)
    most = service.settings.max_upload_bytes
    async with service.terrains.received(request.stream(), most) as received:
        return await service.readers.run(request, _enter_terrain, service, received, name)


def _enter_terrain(service: Service, received: Received, name: str) -> Key:
    """Keep the grid of a terrain and enter it; the file itself is not stored."""
    site = read_terrain(received.path, name=name)
    spread_stops(site)  # raises where nothing can be planned
    write_grid(site, received.path)
    grid = service.terrains.keep(received, KEPT)
    entered = stored.keep_terrain(
        service.catalogue,
        received.digest,
        name=name,
        size_bytes=received.size_bytes,
        url=str(grid),
    )
    return Key.model_validate({"key": TERRAIN + received.digest, "name": entered["name"]})


def assembled_of(service: Service, plan: PlanRequest) -> Plan:
    """Return a requested plan as values."""
    ground = service.planner.ground(plan.site)
    areas = tuple(np.array(area, dtype=np.float64) for area in plan.keep_out_m)
    site = replace(ground.site, keep_out=(*ground.site.keep_out, *areas)) if areas else ground.site
    if plan.pole_heights_m is not None:
        site = replace(site, pole_heights=plan.pole_heights_m)
    stops = ground.stops
    if plan.stops is not None:
        stops = stops_at(site, [(one.name, one.x_m, one.y_m) for one in plan.stops])
    assembled = Plan(
        ground=replace(ground, site=site),
        stops=stops,
        marks=marks_at(site, [_place(one) for one in plan.marks]),
        model=service.planner.model(plan.model, plan.to_sensor(), site.marker_radius),
        requirement=Requirement(
            tolerance=plan.tolerance_m,
            method=plan.method,
            sigma_marks=plan.sigma_marks_m,
            occlusion=plan.occlusion,
        ),
    )
    plans.require_small(assembled)
    return assembled


def _place(mark: RequestedMark) -> Place:
    """Return the place of a mark."""
    if mark.position_m is not None:
        return Place(mark.name, *mark.position_m[:2], z=mark.position_m[2])
    return Place(mark.name, mark.x_m or 0.0, mark.y_m or 0.0, pole=mark.pole_height_m)


def _to_store(plan: NewPlan, survey_id: str | None, found: Plain) -> stored.NewPlan:
    """Return a plan and its evaluation as rows."""
    return stored.NewPlan(
        name=plan.name,
        survey_id=survey_id,
        site_name=found["site"]["name"],
        resection_method=plan.method,
        tolerance_m=plan.tolerance_m,
        marks=found["marks"],
        model_version=found["model"]["version"],
        model_source=found["model"]["source"],
        request=plan.model_dump(exclude={"name", "survey"}),
        stops=[_stop_to_store(i, stop) for i, stop in enumerate(found["stops"])],
    )


def _stop_to_store(place: int, stop: Plain) -> stored.PlannedStop:
    """Return the evaluation of a stop as a row."""
    x, y, z = stop["position_m"]
    same = ("n_used", "sigma_3d_m", "probability_within_tolerance", "dop", "reason")
    angles = ("included_angle_min_deg", "included_angle_max_deg")
    return stored.PlannedStop(
        stop=stop["name"],
        place=place,
        x_m=x,
        y_m=y,
        z_m=z,
        n_seen=len(stop["visible_marks"]),
        **{key: stop[key] for key in (*same, *angles)},
    )
