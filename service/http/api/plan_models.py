"""The wire format of plans: requests, and responses with units in their names."""

from __future__ import annotations

import math
from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from spheremark.pipelines.placement import (
    MARKS_MOST,
    Costs,
    Goal,
    PlaceRules,
    RandomPlanSpec,
    Sensor,
)
from spheremark.service.http.api.models import Strict

_FAR = 1e8  # [m]; projected coordinates, zone in front, have at most eight digits
Coordinate = Annotated[float, Field(ge=-_FAR, le=_FAR)]
Point = tuple[Coordinate, Coordinate, float]
Area = Annotated[list[tuple[Coordinate, Coordinate]], Field(min_length=3, max_length=200)]
Name = Annotated[str, Field(min_length=1, max_length=50)]


class RequestedMark(Strict):
    """A mark: on a pole of some height, or with its centre at a position."""

    name: Name
    x_m: Coordinate | None = None
    y_m: Coordinate | None = None
    pole_height_m: float | None = Field(
        default=None, description="Height of the sphere's centre above the ground [m]."
    )
    position_m: Point | None = Field(
        default=None, description="Centre of the sphere in the site frame [m], as in responses."
    )
    ground_m: float | None = Field(default=None, description="As in responses; not read.")

    @model_validator(mode="after")
    def _has_a_place(self) -> RequestedMark:
        """Refuse a mark without a place."""
        if self.position_m is None and None in (self.x_m, self.y_m, self.pole_height_m):
            raise ValueError("a mark needs position_m, or x_m, y_m and pole_height_m")
        return self


class RequestedStop(Strict):
    """A stop, with the LiDAR at its usual height above the ground."""

    name: Name
    x_m: Coordinate
    y_m: Coordinate


class ScanOptions(Strict):
    """The motion of gimbal and LiDAR in the scans."""

    turn_s: float = Field(default=13.2, gt=0, le=3600, description="Time of a turn [s].")
    spin_rpm: float = Field(default=600.0, description="Revolutions of the LiDAR per minute.")
    sweep_deg: float = Field(
        default=360.0,
        ge=6,
        le=360,
        description="Angle that the gimbal turns through; less than 360 in evaluations only [deg].",
    )
    step_deg: float = Field(
        default=0.0, description="Step of a gimbal that rests between; 0 turns evenly [deg]."
    )
    rest_revolutions: int = Field(
        default=3, description="Revolutions of the LiDAR during each rest."
    )
    noise_m: float | None = Field(
        default=None,
        gt=0,
        le=0.5,
        description="Noise of a range to a sphere; of a VLP-16 by default [m].",
    )

    def to_sensor(self) -> Sensor:
        """Return the sensor of the core."""
        return Sensor(
            turn=self.turn_s,
            spin_rpm=self.spin_rpm,
            sweep=math.radians(self.sweep_deg),
            step=math.radians(self.step_deg),
            rest_revolutions=self.rest_revolutions,
            noise=self.noise_m,
        )


class PlanRequest(ScanOptions):
    """An arrangement on a field, and the requirement of its evaluation."""

    site: str = Field(default="paper-field", description="Key of the field, as GET /plans/sites.")
    marks: list[RequestedMark] = Field(default_factory=list, max_length=500)
    stops: list[RequestedStop] | None = Field(
        default=None, max_length=5000, description="The field's own stops by default."
    )
    keep_out_m: list[Area] = Field(
        default_factory=list,
        max_length=50,
        description="Areas where no mark is put, as corners x, y in the site frame [m].",
    )
    method: Literal["free_station", "paper"] = "free_station"
    tolerance_m: float = Field(default=0.03, gt=0, le=10)
    sigma_marks_m: float = Field(
        default=0.0, ge=0, le=1, description="Sigma per axis of the marks themselves [m]."
    )
    occlusion: float = Field(
        default=0.0,
        ge=0,
        le=0.9,
        description="Probability that people or vehicles that pass hide a mark from a stop.",
    )
    pole_heights_m: tuple[float, float] | None = Field(
        default=None, description="Least and greatest height of a centre; of the field by default."
    )
    model: str = Field(
        default="auto",
        description="Accuracy of centres: 'sensor'; 'survey:<name>', from its marker_fits; or "
        "'auto', from those of all surveys where there are enough, else the sensor.",
    )


class EvaluationRequest(PlanRequest):
    """An arrangement to evaluate."""

    field_cells: int = Field(
        default=0, ge=0, le=200, description="Places across the map of the field; 0 for none."
    )
    viewshed_of: str | None = Field(
        default=None, description="Mark of which the map shows from where it is found."
    )


class PlaceOptions(Strict):
    """Where marks may stand."""

    reach_m: float = Field(default=6.0, description="Farthest from the nearest stop [m].")
    slope_max_deg: float = Field(default=15.0, description="Steepest ground for a pole [deg].")
    clear_m: float = Field(default=1.0, description="Least distance from stops [m].")
    apart_m: float = Field(default=1.0, description="Least distance between two marks [m].")
    is_inside_allowed: bool = Field(
        default=False, description="Whether marks may stand between the stops."
    )
    spacing_m: float = Field(
        default=0.0, description="Grid of places that are tried; 0 takes one that suits [m]."
    )
    placement_m: float = Field(
        default=0.0, description="How far from its place a mark may end up [m]."
    )

    def to_rules(self) -> PlaceRules:
        """Return the rules of the core."""
        return PlaceRules(
            reach=self.reach_m,
            slope_max=math.radians(self.slope_max_deg),
            clear=self.clear_m,
            apart=self.apart_m,
            is_inside_allowed=self.is_inside_allowed,
            spacing=self.spacing_m,
            placement=self.placement_m,
        )


class SuggestionRequest(PlanRequest):
    """An arrangement that gets one more mark."""

    rules: PlaceOptions = Field(default_factory=PlaceOptions)


class OptimisationRequest(SuggestionRequest):
    """A field whose best arrangement is searched."""

    n_marks: int | None = Field(
        default=None,
        ge=2,
        le=MARKS_MOST,
        description="How many; by default as few as keep the tolerance at every stop.",
    )
    is_robust: bool = Field(
        default=True, description="Whether the tolerance holds after the loss of any one mark."
    )
    loss_weight: float = Field(
        default=0.03,
        ge=0.0,
        le=1.0,
        description="Weight of the worst stop after a loss: 0 ignores it, 1 counts it alone.",
    )
    probability: float = Field(
        default=0.95, gt=0, lt=1, description="With which the tolerance is kept at every stop."
    )
    most: int = Field(
        default=20, ge=2, le=MARKS_MOST, description="Most marks where the fewest are searched."
    )
    objective: Literal["worst", "after_loss", "mean"] = Field(
        default="worst", description="What is least: the worst stop's sigma, after a loss, or mean."
    )
    walk_weight: float = Field(
        default=0.0, ge=0, le=1, description="Weight of the way past all marks: 0 ignores it."
    )
    stop_reach_m: float = Field(
        default=0.0, ge=0, le=20, description="How far stops may be moved to better places [m]."
    )
    keep_marks: bool = Field(
        default=False, description="Whether the marks of the request stand already and stay."
    )
    cost_per_mark: float = Field(default=0.0, ge=0, description="Of a mark, in any unit.")
    cost_per_metre: float = Field(default=0.0, ge=0, description="Of the way past all marks.")

    def to_goal(self) -> Goal:
        """Return the goal of the core."""
        return Goal(
            n_marks=self.n_marks,
            probability=self.probability,
            is_robust=self.is_robust,
            most=self.most,
            objective=self.objective,
            loss_weight=self.loss_weight,
            walk_weight=self.walk_weight,
            stop_reach=self.stop_reach_m,
        )

    def costs(self) -> Costs:
        """Return the costs."""
        return Costs(per_mark=self.cost_per_mark, per_metre=self.cost_per_metre)


class TradeOffRequest(OptimisationRequest):
    """A field whose best arrangements of several numbers of marks are compared."""

    numbers: list[Annotated[int, Field(ge=2, le=MARKS_MOST)]] = Field(
        default=[4, 5, 6, 8, 10, 14], max_length=20, description="Numbers of marks."
    )
    loss_weights: list[Annotated[float, Field(ge=0, le=1)]] = Field(
        default=[],
        max_length=10,
        description="Weights of a loss, with n_marks marks or the largest of numbers.",
    )

    @model_validator(mode="after")
    def _has_work(self) -> TradeOffRequest:
        """Refuse a comparison of nothing."""
        if not self.numbers and not self.loss_weights:
            raise ValueError("give numbers of marks, or loss_weights")
        return self


class NewPlan(PlanRequest):
    """A plan to store."""

    name: str = Field(min_length=1, max_length=200)
    survey: str | None = Field(default=None, description="Survey of the plan.")


class RandomPlansRequest(ScanOptions):
    """Random arrangements, as in the study."""

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
        default="paper", description="Fitting method whose results give distance and window."
    )
    model: str = Field(default="auto", description="As for a plan.")

    def to_spec(self) -> RandomPlanSpec:
        """Return the specification of the core, without distances and angles."""
        return RandomPlanSpec(
            n_arrangements=self.n_arrangements,
            n_marks=(self.n_marks_min, self.n_marks_max),
            error=self.error_per_axis_m,
            tolerance=self.tolerance_m,
            seed=self.seed,
        )


class NewSearch(Strict):
    """A search to start: exactly one of its kinds."""

    optimise: OptimisationRequest | None = None
    trade_off: TradeOffRequest | None = None
    random: RandomPlansRequest | None = None

    @model_validator(mode="after")
    def _is_one(self) -> NewSearch:
        """Refuse none and several."""
        given = [name for name in type(self).model_fields if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError("give one of optimise, trade_off and random")
        return self

    @property
    def kind(self) -> str:
        """Which it is."""
        return next(name for name in type(self).model_fields if getattr(self, name) is not None)


class Plain(BaseModel):
    """A response; a field that is not described here is an error."""

    model_config = ConfigDict(extra="forbid")


class Key(Plain):
    """A field that can be planned on."""

    key: str
    name: str


class Place(Plain):
    """A stop in the site frame."""

    name: str
    position_m: Point


class Mark(Plain):
    """A mark to stake out."""

    name: str
    position_m: Point = Field(description="Centre of the sphere in the site frame [m].")
    ground_m: float | None
    pole_height_m: float | None


class GroundHeights(Plain):
    """Heights of the ground, rows along y; null where unknown."""

    x_m: list[float]
    y_m: list[float]
    ground_m: list[list[float | None]]


class PlanSite(Plain):
    """A field: its ground, its stops, and marks to begin with."""

    key: str
    name: str
    extent_m: tuple[float, float, float, float] = Field(description="x and y from, x and y to [m].")
    pole_heights_m: tuple[float, float]
    marker_radius_m: float
    mast_m: float
    keep_out_m: list[list[tuple[float, float]]]
    ground: GroundHeights
    stops: list[Place]
    marks: list[Mark]


class CentreModelOrigin(Plain):
    """The model of centres behind a prediction."""

    version: str = Field(description="Digest of its numbers.")
    source: Literal["sensor", "fitted"]
    n_rows: int
    n_stops: int
    surveys: list[str]
    fit_method: str | None
    newest: str | None
    text: str
    warning: str | None = Field(description="Problem of the two speeds of the scan.")


class MarkAtStop(Plain):
    """A mark as predicted from a stop."""

    name: str
    is_seen: bool
    probability_found: float = Field(description="Detected and matched, and not hidden by chance.")
    visible_share: float
    surface_behind_m: float | None
    range_m: float
    n_points: float
    redundancy: float
    minimal_detectable_bias_m: float | None
    external_reliability_m: float | None


class StopEvaluation(Plain):
    """Predicted accuracy of a stop; null where there is no position."""

    name: str
    position_m: Point
    sigma_3d_m: float | None
    rms_error_3d_m: float | None = Field(
        description="Over the sets of marks that may be found and give a position."
    )
    probability_within_tolerance: float
    covariance_m2: list[list[float | None]]
    visible_marks: list[str]
    n_used: int
    included_angle_min_deg: float | None
    included_angle_max_deg: float | None
    dop: float | None
    dof: int
    reason: str
    marks: list[MarkAtStop]


class FieldEvaluation(Plain):
    """Predicted accuracy on a grid, rows along y."""

    x_m: list[float]
    y_m: list[float]
    sigma_3d_m: list[list[float | None]]
    probability_within_tolerance: list[list[float | None]]
    n_seen: list[list[int]]
    viewshed: list[list[int]] | None = Field(
        default=None, description="1 where the requested mark is found from."
    )


class SiteName(Plain):
    """The field of an evaluation."""

    name: str


class PlanEvaluation(Plain):
    """Predicted accuracy of an arrangement."""

    site: SiteName
    method: str
    tolerance_m: float
    model: CentreModelOrigin
    marks: list[Mark]
    stops: list[StopEvaluation]
    worst_stop: str
    worst_sigma_3d_m: float | None
    mean_sigma_3d_m: float | None
    worst_sigma_3d_after_loss_m: float | None
    worst_probability_within_tolerance: float
    keeps_tolerance_95: bool


class MappedEvaluation(PlanEvaluation):
    """An evaluation, with a map if it was requested."""

    field: FieldEvaluation | None = None


class OptimumQuality(Plain):
    """Quality of an optimised arrangement."""

    keeps_tolerance: bool
    probability: float
    is_robust: bool
    worst_sigma_3d_after_loss_m: float | None
    information_gain: float | None
    information_gain_bound: float | None
    share_of_bound: float | None
    worst_sigma_3d_bound_m: float | None
    excess_over_bound: float | None
    bound_spacing_m: float | None
    n_bounded: int
    objective: str
    worst_sigma_3d_after_loss_bound_m: float | None
    worst_sigma_3d_as_placed_m: float | None = Field(
        description="With marks beside their places, exceeded by 5 % of such arrangements."
    )
    walk_m: float = Field(description="Round from the first stop past all marks.")
    cost: float
    unreachable: str = Field(description="Why the goal cannot be reached; empty if it can.")
    n_candidates: int
    n_exchanges: int


class OptimisedPlan(PlanEvaluation):
    """The best arrangement that was found."""

    optimum: OptimumQuality
    notes: list[str]


class TradeOff(Plain):
    """The best arrangements of several numbers of marks, and of several weights of a loss."""

    by_number: list[OptimisedPlan]
    by_loss_weight: list[OptimisedPlan]
    numbers: list[int]
    loss_weights: list[float]
    cheapest: int | None = Field(description="Fewest costs that reach the goal: number of marks.")


class PlanSearch(Plain):
    """A search of plans: how far it has come, and its result."""

    search_id: str
    kind: Literal["optimise", "trade_off", "random"]
    status: Literal["running", "successful", "failed", "dismissed"]
    progress_percent: float
    message: str
    n_marks: int | None
    worst_sigma_3d_m: float | None = Field(description="Of the best arrangement so far.")
    worst_sigma_3d_bound_m: float | None = Field(description="That no arrangement goes below.")
    created_at: datetime
    finished_at: datetime | None
    error_code: str | None
    error_reason: str | None
    request: dict[str, Any]
    optimised: OptimisedPlan | None = None
    trade_off: TradeOff | None = None
    random: RandomPlansResult | None = None


class StopChange(Plain):
    """Accuracy of a stop without and with one more mark."""

    name: str
    sigma_3d_before_m: float | None
    sigma_3d_m: float | None


class SuggestedMark(Mark):
    """The one more mark that helps most."""

    worst_sigma_3d_before_m: float | None
    worst_sigma_3d_m: float | None
    mean_sigma_3d_before_m: float | None
    mean_sigma_3d_m: float | None
    worst_probability_within_tolerance: float
    stops: list[StopChange]


class ResultLimits(Plain):
    """Greatest distance and window of angles, and where they come from."""

    greatest_distance_m: float
    angle_min_deg: float
    angle_max_deg: float
    distance_source: str
    angle_source: str


class PassRate(Plain):
    """Share of a class of arrangements within the tolerance."""

    n: int
    pass_rate: float | None
    median_error_3d_m: float | None
    p95_error_3d_m: float | None


class PassRateOfNumber(PassRate):
    """Pass rate of a number of marks."""

    n_marks: int


class PassRateOfAngle(PassRate):
    """Pass rate of a class of worst included angles."""

    angle_from_deg: float
    angle_to_deg: float


class ErrorOfAngle(Plain):
    """Error of a position by the included angle of two marks."""

    included_angle_deg: float
    median_error_3d_m: float


class Table3Row(ErrorOfAngle):
    """The same beside the study's."""

    study_error_3d_m: float


class RandomPlansResult(Plain):
    """Pass rates of random arrangements."""

    n_arrangements: int
    seed: int
    tolerance_m: float
    error_per_axis_m: float | None
    model: CentreModelOrigin | None
    distance_min_m: float
    distance_max_m: float
    angle_min_deg: float
    angle_max_deg: float
    limits: ResultLimits
    n_in_window: int
    pass_rate: float
    pass_rate_in_window: float | None
    pass_rate_outside: float | None
    by_number_of_marks: list[PassRateOfNumber]
    by_worst_angle: list[PassRateOfAngle]
    by_included_angle: list[ErrorOfAngle]
    table3: list[Table3Row]
    window_that_keeps_tolerance_deg: tuple[float, float] | None


class StoredStop(Plain):
    """A stop of a stored plan: the prediction and, once surveyed, the result."""

    stop: str
    n_seen: int
    n_used: int
    sigma_3d_m: float | None
    probability_within_tolerance: float
    included_angle_min_deg: float | None
    included_angle_max_deg: float | None
    dop: float | None
    reason: str
    run_id: str | None
    n_markers: int | None
    achieved_sigma_3d_m: float | None
    error_3d_m: float | None
    is_within_tolerance: bool | None


class PlanSummary(Plain):
    """A stored plan without its stops."""

    placement_id: str
    name: str
    survey_id: str | None
    survey: str | None
    site_name: str
    resection_method: str
    tolerance_m: float
    marks: list[Mark]
    n_marks: int
    model_version: str
    model_source: str
    request: dict[str, Any] = Field(description="The complete request.")
    created_at: datetime
    n_stops: int
    n_surveyed: int
    worst_sigma_3d_m: float | None


class StoredPlan(PlanSummary):
    """A stored plan with its stops."""

    stops: list[StoredStop]
