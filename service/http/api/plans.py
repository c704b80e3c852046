"""Routes of plans: where markers should stand, and what an arrangement promises."""

from __future__ import annotations

import asyncio
import math
from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.responses import JSONResponse, PlainTextResponse
from pydantic import BaseModel, ConfigDict, Field, model_validator

from spheremark.pipelines.placement import Requirement, Sensor
from spheremark.pipelines.placement.candidates import PlaceRules
from spheremark.pipelines.placement.optimisation import MARKS_MOST, Goal
from spheremark.service.http.api.models import Listing, Strict
from spheremark.service.http.state import Current, Service
from spheremark.service.http.uploads import Received
from spheremark.service.planning import plans as siting
from spheremark.service.planning import random_plans as trials
from spheremark.service.planning.requests import (
    SCENARIOS,
    TERRAIN,
    Asked,
    Place,
    marks_at,
    stops_at,
)
from spheremark.service.serialise.plans import Plain, site_json, to_csv, to_geojson
from spheremark.storage.catalogue import plans as kept
from spheremark.storage.imports.terrain import KEPT, check_ending, read_terrain, write_grid

router = APIRouter(tags=["plans"])

GEOJSON = "application/geo+json"
_MARKER_RADIUS = 0.100  # [m]
_GROUND_ACROSS = 150  # places of the ground's heights that a map shows

SiteKey = Annotated[
    str, Path(description="paper-field, paper-field@3 (another seed), or terrain:<id>.")
]


class Said(BaseModel):
    """An answer as the command line gives it, too: units are in its names."""

    model_config = ConfigDict(extra="allow")


class PlannedMark(Strict):
    """A mark: on a pole of some height, or with its centre at a position."""

    name: str = Field(min_length=1, max_length=50)
    x_m: float | None = None
    y_m: float | None = None
    pole_height_m: float | None = Field(
        default=None, description="Height of the sphere's centre above the ground [m]."
    )
    position_m: tuple[float, float, float] | None = Field(
        default=None, description="Centre of the sphere in the site frame [m], as answers give it."
    )
    ground_m: float | None = Field(default=None, description="Of an answer; not read.")

    @model_validator(mode="after")
    def _has_a_place(self) -> PlannedMark:
        """Refuse a mark that is nowhere."""
        if self.position_m is None and None in (self.x_m, self.y_m, self.pole_height_m):
            raise ValueError("a mark needs position_m, or x_m, y_m and pole_height_m")
        return self


class ChosenStop(Strict):
    """A stop, with the LiDAR at its usual height above the ground."""

    name: str = Field(min_length=1, max_length=50)
    x_m: float
    y_m: float


Corner = tuple[
    Annotated[float, Field(allow_inf_nan=False)], Annotated[float, Field(allow_inf_nan=False)]
]
Area = Annotated[list[Corner], Field(min_length=3, max_length=200)]


class Driven(Strict):
    """How the scans are driven."""

    turn_s: float = Field(default=13.2, gt=0, le=3600, description="Time of a turn [s].")
    spin_rpm: float = Field(default=600.0, description="Revolutions of the LiDAR per minute.")
    step_deg: float = Field(
        default=0.0, description="Step of a gimbal that rests between; 0 turns evenly [deg]."
    )
    rest_revolutions: int = Field(
        default=3, description="Revolutions of the LiDAR during each rest."
    )

    def to_sensor(self) -> Sensor:
        """Return the sensor as the core has it."""
        return Sensor(
            turn=self.turn_s,
            spin_rpm=self.spin_rpm,
            step=math.radians(self.step_deg),
            rest_revolutions=self.rest_revolutions,
        )


class Plan(Driven):
    """An arrangement to judge, or to better."""

    site: str = Field(default="paper-field", description="Key of the field, as GET /plans/sites.")
    marks: list[PlannedMark] = Field(default_factory=list, max_length=500)
    stops: list[ChosenStop] | None = Field(
        default=None, max_length=5000, description="The field's own stops by default."
    )
    keep_out_m: list[Area] = Field(
        default_factory=list,
        max_length=50,
        description="Areas where no mark is put, as corners x, y in the site frame [m].",
    )
    method: Literal["free_station", "paper"] = "free_station"
    tolerance_m: float = Field(default=0.03, gt=0, le=10)
    model: str = Field(
        default="auto",
        description="Accuracy of centres: 'sensor'; 'survey:<name>', from its marker_fits; or "
        "'auto', from those of all surveys where there are enough, else the sensor.",
    )


class Rules(Strict):
    """Where marks may stand."""

    reach_m: float = Field(default=6.0, description="Farthest from the nearest stop [m].")
    slope_max_deg: float = Field(default=15.0, description="Steepest ground for a pole [deg].")
    clear_m: float = Field(default=1.0, description="Least distance from stops [m].")
    apart_m: float = Field(default=1.0, description="Least distance between two marks [m].")
    is_inside_allowed: bool = Field(
        default=False, description="Whether marks may stand between the stops."
    )

    def to_values(self) -> PlaceRules:
        """Return them as the core has them."""
        return PlaceRules(
            reach=self.reach_m,
            slope_max=math.radians(self.slope_max_deg),
            clear=self.clear_m,
            apart=self.apart_m,
            is_inside_allowed=self.is_inside_allowed,
        )


class JudgedPlan(Plan):
    """An arrangement to judge."""

    field_cells: int = Field(
        default=0, ge=0, le=200, description="Places across the map of the field; 0 for none."
    )


class WantedPlan(Plan):
    """A field for which an arrangement is wanted."""

    n_marks: int | None = Field(
        default=None,
        ge=2,
        le=MARKS_MOST,
        description="How many; by default as few as keep the tolerance at every stop.",
    )

    is_robust: bool = Field(
        default=True, description="Whether the tolerance shall outlast the loss of any one mark."
    )
    rules: Rules = Field(default_factory=Rules)


class BetterPlan(Plan):
    """An arrangement that one more mark shall better."""

    rules: Rules = Field(default_factory=Rules)


class RandomTrial(Driven):
    """Arrangements at random, as the study tries them."""

    n_arrangements: int = Field(default=100_000, ge=1, le=1_000_000)
    n_marks_min: int = 3
    n_marks_max: int = 14
    distance_max_m: float | None = Field(default=None, description="Of the results by default [m].")
    angle_min_deg: float | None = Field(
        default=None, description="Window of included angles; of the results by default [deg]."
    )
    angle_max_deg: float | None = None
    error_per_axis_m: float | None = Field(
        default=0.017, description="On each axis of a centre; null takes the model of centres [m]."
    )
    tolerance_m: float = Field(default=0.03, gt=0, le=10)
    seed: int = Field(default=0, ge=0)
    fit_method: str = Field(
        default="paper", description="Fitting method whose results tell distance and window."
    )
    model: str = Field(default="auto", description="As for a plan.")


class NamedPlan(Plan):
    """A plan to keep."""

    name: str = Field(min_length=1, max_length=200)
    survey: str | None = Field(default=None, description="Survey that it is for.")


@router.get("/plans/sites", name="list_sites")
def list_sites(service: Current) -> Listing[Said]:
    """List the fields that can be planned on."""
    return Listing(items=[Said.model_validate(one) for one in sites(service)])


def sites(service: Service) -> list[Plain]:
    """Return the fields that can be planned on, as key and name."""
    own = [
        {"key": TERRAIN + one["terrain_id"], "name": one["name"]}
        for one in kept.list_terrains(service.catalogue)
    ]
    return [{"key": key, "name": name} for key, name in SCENARIOS.items()] + own


@router.get("/plans/sites/{site}", name="get_site")
def get_site(site: SiteKey, service: Current) -> Said:
    """Return a field: its ground, its stops, and marks to begin with."""
    ground = service.planner.ground(site)
    answer = site_json(ground.site, ground.stops, ground.marks, n_across=_GROUND_ACROSS)
    return Said.model_validate({"key": ground.key, **answer, "extent_m": list(ground.view)})


@router.post("/plans/evaluate", name="evaluate_plan", response_model=Said)
def evaluate_plan(plan: JudgedPlan, request: Request, service: Current) -> Response:
    """Say what an arrangement promises at every stop, as JSON, CSV or GeoJSON, and on a map."""
    answer = _evaluated(service, plan, field_cells=plan.field_cells)
    accept = request.headers.get("accept", "")
    if accept.startswith("text/csv"):
        return PlainTextResponse(to_csv(answer), media_type="text/csv")
    if accept.startswith(GEOJSON):
        return JSONResponse(to_geojson(answer), media_type=GEOJSON)
    return JSONResponse(answer)


@router.post("/plans/optimise", name="optimise_plan")
def optimise_plan(plan: WantedPlan, service: Current) -> Said:
    """Find the best places for a number of marks, or the fewest that keep the tolerance."""
    goal = Goal(n_marks=plan.n_marks, is_robust=plan.is_robust)
    answer = siting.optimise(_fenced(service, plan), plan.rules.to_values(), goal)
    return Said.model_validate(answer)


@router.post("/plans/suggest", name="suggest_mark")
def suggest_mark(plan: BetterPlan, service: Current) -> Said:
    """Name the one more mark that would help most."""
    answer = siting.one_more(_fenced(service, plan), plan.rules.to_values())
    return Said.model_validate(answer)


@router.post("/plans/random", name="try_at_random")
def try_at_random(wanted: RandomTrial, service: Current) -> Said:
    """Try arrangements at random, as the study does: an error on every centre, pass or fail."""
    return Said.model_validate(tried(service, wanted))


def tried(service: Service, wanted: RandomTrial) -> Plain:
    """Return what came of arrangements at random."""
    planner = service.planner
    survey = wanted.model.partition("survey:")[2]  # which fits tell, they tell of limits too
    limits = trials.limits_of_results(planner.ask, wanted.fit_method, wanted.tolerance_m, survey)
    angles = (
        None if angle is None else math.radians(angle)
        for angle in (wanted.angle_min_deg, wanted.angle_max_deg)
    )
    angle_min, angle_max = angles
    trial = trials.Wanted(
        n_arrangements=wanted.n_arrangements,
        n_marks=(wanted.n_marks_min, wanted.n_marks_max),
        distance=wanted.distance_max_m,
        angle_min=angle_min,
        angle_max=angle_max,
        error=wanted.error_per_axis_m,
        tolerance=wanted.tolerance_m,
        seed=wanted.seed,
    ).trial(limits)
    model = planner.model(wanted.model, wanted.to_sensor(), _MARKER_RADIUS)
    return trials.run(trial, model, limits)


@router.post("/plans", name="keep_plan", status_code=201)
def keep_plan(plan: NamedPlan, service: Current, response: Response) -> Said:
    """Keep a plan: its promises become rows of placements."""
    survey = service.catalogue.get_survey(plan.survey).survey_id if plan.survey else None
    answer = _evaluated(service, plan)
    placement_id = kept.keep_plan(service.catalogue, _to_keep(plan, survey, answer))
    response.headers["Location"] = f"/api/v1/plans/{placement_id}"
    return Said.model_validate(kept.get_plan(service.catalogue, placement_id))


@router.get("/plans", name="list_plans")
def list_plans(
    service: Current,
    survey: Annotated[str | None, Query(description="Id or name of a survey.")] = None,
) -> Listing[Said]:
    """List kept plans, newest first."""
    survey_id = service.catalogue.get_survey(survey).survey_id if survey else None
    rows = kept.list_plans(service.catalogue, survey_id)
    return Listing(items=[Said.model_validate(row) for row in rows])


@router.get("/plans/{plan}", name="get_plan")
def get_plan(plan: Annotated[str, Path(description="Id of the plan.")], service: Current) -> Said:
    """Return a kept plan: what it promised at each stop, and what came of it."""
    return Said.model_validate(kept.get_plan(service.catalogue, plan))


@router.post("/terrains", name="upload_terrain", status_code=201)
async def upload_terrain(
    request: Request,
    service: Current,
    name: Annotated[str, Query(min_length=1, max_length=200, description="Name of the file.")],
) -> Said:
    """Keep the grid of a terrain to plan on: GeoTIFF, ESRI ASCII grid, or cloud (LAS, LAZ, PLY)."""
    check_ending(name)
    most = service.settings.max_upload_bytes
    async with service.terrains.received(request.stream(), most) as received:
        return await asyncio.to_thread(_enter_terrain, service, received, name)


def _enter_terrain(service: Service, received: Received, name: str) -> Said:
    """Keep the grid of a terrain and enter it; the file itself is not kept."""
    write_grid(read_terrain(received.path, name=name), received.path)
    grid = service.terrains.keep(received, KEPT)
    entered = kept.keep_terrain(
        service.catalogue,
        received.digest,
        name=name,
        size_bytes=received.size_bytes,
        url=str(grid),
    )
    for older in grid.parent.glob(f"{received.digest}.*"):
        if older != grid:
            older.unlink(missing_ok=True)  # the file itself, which earlier versions kept
    return Said.model_validate({"key": TERRAIN + received.digest, "name": entered["name"]})


def _evaluated(service: Service, plan: Plan, *, field_cells: int = 0) -> Plain:
    """Judge an arrangement."""
    asked = _asked(service, plan)
    answer = service.planner.evaluate(asked)
    if field_cells:
        answer["field"] = service.planner.field(asked, field_cells)
    return answer


def _asked(service: Service, plan: Plan) -> Asked:
    """Return what is asked as values."""
    ground = service.planner.ground(plan.site)
    return Asked(
        ground=ground,
        stops=ground.stops
        if plan.stops is None
        else stops_at(ground.site, [(one.name, one.x_m, one.y_m) for one in plan.stops]),
        marks=marks_at(ground.site, [_place(one) for one in plan.marks]),
        model=service.planner.model(plan.model, plan.to_sensor(), ground.site.marker_radius),
        requirement=Requirement(tolerance=plan.tolerance_m, method=plan.method),
    )


def _fenced(service: Service, plan: Plan) -> Asked:
    """Return what is asked, on a field with the areas where no mark may be put."""
    asked = _asked(service, plan)
    own = tuple(np.array(area, dtype=np.float64) for area in plan.keep_out_m)
    site = asked.ground.site
    site = replace(site, keep_out=(*site.keep_out, *own)) if own else site
    return replace(asked, ground=replace(asked.ground, site=site))


def _place(mark: PlannedMark) -> Place:
    """Return where a mark stands."""
    if mark.position_m is not None:
        return Place(mark.name, *mark.position_m[:2], z=mark.position_m[2])
    return Place(mark.name, mark.x_m or 0.0, mark.y_m or 0.0, pole=mark.pole_height_m)


def _to_keep(plan: NamedPlan, survey_id: str | None, answer: Plain) -> kept.NewPlan:
    """Return a plan as it is kept."""
    model = answer["model"]
    return kept.NewPlan(
        name=plan.name,
        survey_id=survey_id,
        site_name=answer["site"]["name"],
        resection_method=plan.method,
        tolerance_m=plan.tolerance_m,
        marks=answer["marks"],
        model_version=model["version"],
        model_source=model["source"],
        request=plan.model_dump(exclude={"name", "survey"}),
        stops=[_planned_stop(i, stop) for i, stop in enumerate(answer["stops"])],
    )


def _planned_stop(place: int, stop: Plain) -> kept.PlannedStop:
    """Return a stop of an answer as it is kept."""
    x, y, z = stop["position_m"]
    return kept.PlannedStop(
        stop=stop["name"],
        place=place,
        x_m=x,
        y_m=y,
        z_m=z,
        n_seen=len(stop["visible_marks"]),
        n_used=stop["n_used"],
        sigma_3d_m=stop["sigma_3d_m"],
        probability_within_tolerance=stop["probability_within_tolerance"],
        included_angle_min_deg=stop["included_angle_min_deg"],
        included_angle_max_deg=stop["included_angle_max_deg"],
        dop=stop["dop"],
        reason=stop["reason"],
    )
