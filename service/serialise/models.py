"""The JSON of the commands, declared: what ``serialise`` writes, no key more and none less.

Lengths in metres, covariances in the frame of the result, null for what is unknown.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

Vector = list[float | None]
Matrix = list[list[float | None]]


class _Declared(BaseModel):
    """An object of which every key is declared."""

    model_config = ConfigDict(extra="forbid")


class _Ellipse(_Declared):
    """The error ellipse of a horizontal position; bearing clockwise from y."""

    ellipse_major_m: float
    ellipse_minor_m: float
    ellipse_bearing_deg: float
    ellipse_major_95_m: float
    ellipse_minor_95_m: float


class Marker(_Declared):
    """A sphere centre; the last two fields with a truth only."""

    id: str
    status: Literal["ok", "weak"]
    reason: str
    method: str
    centre_m: Vector
    covariance_m2: Matrix
    sigma_3d_m: float | None
    range_m: float | None
    n_points: int
    n_rejected: int
    n_rings: int
    coverage: float | None
    incidence_deg: float | None
    variant: str
    rms_m: float | None
    sigma0: float | None
    radius_m: float
    radius_free_m: float | None
    sigma_radius_free_m: float | None
    mean_intensity: float | None
    probability: float | None = None
    hypothesis: str = ""
    true_mark: str | None = None
    error_3d_m: float | None = None


class Rejected(_Declared):
    """A group of returns that is not a marker."""

    centre_m: Vector
    reason: str
    n_points: int
    probability: float | None = None


class Match(_Declared):
    """A marker used as a mark."""

    marker: str
    mark: str
    residual_m: Vector
    redundancy: float | None
    w: float | None
    minimal_detectable_bias_m: float | None
    external_reliability_m: float | None


class WithoutMarker(_Declared):
    """A station without one of its markers."""

    marker: str
    mark: str
    station_shift_m: Vector
    station_shift_3d_m: float | None
    mark_predicted_minus_given_m: Vector
    sigma_predicted_minus_given_m: Vector


class ExcludedMarker(_Declared):
    """A marker that a station does not use."""

    marker: str
    reason: str


class NoStation(_Declared):
    """A station that could not be positioned."""

    status: Literal["failed"]
    reason: str
    code: str
    method: str
    fit_method: str


class Station(_Ellipse):
    """A station in the site frame; the last two fields with a truth only."""

    status: Literal["ok", "weak"]
    reason: str
    method: str
    fit_method: str
    position_m: Vector
    rotation: Matrix
    yaw_deg: float
    sigma_yaw_deg: float
    covariance: Matrix
    position_covariance_m2: Matrix
    sigma_3d_m: float | None
    dop: float | None
    sigma_levelling_rad: float
    dof: int
    sigma0_a_priori: float
    sigma0: float | None
    passes_global_test: bool
    included_angle_min_deg: float | None
    included_angle_max_deg: float | None
    matches: list[Match]
    residuals_m: Matrix
    without_each: list[WithoutMarker]
    excluded: list[ExcludedMarker]
    error_3d_m: float | None = None
    error_yaw_deg: float | None = None


class Distance(_Declared):
    """The distance between two marks in one scan against the control."""

    markers: list[str]
    marks: list[str]
    measured_m: float
    given_m: float
    residual_m: float
    sigma_m: float
    is_off: bool


class Distances(_Declared):
    """All distances of one scan."""

    reason: str
    n: int
    n_off: int
    suspects: list[str]
    pairs: list[Distance]


class Levelling(_Declared):
    """Roll and pitch of the base."""

    roll_deg: float
    pitch_deg: float
    sigma_levelling_rad: float
    is_measured: bool


class Scan(_Declared):
    """Extent of a scan."""

    n_returns: int
    coverage_deg: float
    duration_s: float
    notes: list[str]


class Stop(_Declared):
    """The results of one stop; ``reason`` without a station only."""

    name: str
    frame: Literal["station", "base"]
    markers: list[Marker]
    rejected: list[Rejected]
    possible: list[Rejected] = []
    station: Station | None
    stations: list[Station | NoStation]
    distances: Distances | None
    levelling: Levelling
    sigma_heading_rad: float
    scan: Scan
    tolerance_m: float
    timings_s: dict[str, float]
    reason: str = ""


class LogName(_Declared):
    """Name and digest of a log."""

    name: str
    sha256: str
    notes: list[str]


class LogDocument(_Declared):
    """``spheremark process --json``: the results of one log."""

    log: LogName
    rig: dict[str, Any]
    config: dict[str, Any]
    stops: list[Stop]


class Parameter(_Declared):
    """A parameter of a rig before and after its calibration."""

    name: str
    unit: str
    start: float
    estimate: float
    sigma: float


class Inseparable(_Declared):
    """A parameter that the spheres do not determine."""

    name: str
    reason: str


class CalibrationDocument(_Declared):
    """``spheremark calibrate --json``: a calibrated rig."""

    rig: dict[str, Any]
    rig_digest: str
    start_rig_digest: str
    parameters: list[Parameter]
    covariance: Matrix
    not_separable: list[Inseparable]
    stops: list[str]
    n_spheres: int
    n_two_faced: int
    n_returns: int
    dof: int
    sigma0: float
    residual_rms_before_m: float
    residual_rms_after_m: float


class NetworkStation(_Ellipse):
    """A station of a network."""

    name: str
    position_m: Vector
    rotation: Matrix
    yaw_deg: float
    sigma_yaw_deg: float
    covariance: Matrix
    position_covariance_m2: Matrix
    sigma_3d_m: float
    n_observations: int


class NetworkMark(_Ellipse):
    """A mark of a network."""

    name: str
    is_control: bool
    status: Literal["ok", "weak"]
    reason: str
    position_m: Vector
    covariance_m2: Matrix
    sigma_3d_m: float
    n_observations: int


class _Tested(_Declared):
    """An observation of a network with its test."""

    used: bool
    redundancy: float | None
    w: float | None


class Sighting(_Tested):
    """An observed centre."""

    station: str
    marker: str
    mark: str
    residual_m: Vector
    minimal_detectable_bias_m: float | None
    external_reliability_station_m: float | None
    external_reliability_mark_m: float | None


class Gravity(_Tested):
    """The levelling of a station."""

    station: str
    residual_rad: Vector
    minimal_detectable_bias_rad: float | None


class ControlMark(_Tested):
    """A control mark, also as all else predicts it."""

    mark: str
    residual_m: Vector
    minimal_detectable_bias_m: float | None
    predicted_minus_given_m: Vector | None
    sigma_predicted_minus_given_m: Vector | None


class Datum(_Declared):
    """Place and heading of a network."""

    kind: Literal["free", "control"]
    defect: int
    text: str
    control_marks: list[str]


class StationEvidence(_Declared):
    """The evidence of one station on a mark."""

    station: str
    marker: str
    finding: Literal["marker", "possible", "refused", "nothing", "hidden"]
    range_m: float
    log_odds: float
    reason: str


class MarkEvidence(_Declared):
    """The evidence of all stations on a mark, or on what may be one."""

    mark: str
    is_used: bool
    decision: Literal["confirmed", "doubtful", "refused"]
    probability: float
    decoy: str
    hypothesis: str
    log_odds_prior: float
    log_odds_radius: float
    log_odds: float
    position_m: Vector
    stations: list[StationEvidence]


class Repeat(_Declared):
    """Two stations at one place."""

    stations: list[str]
    apart_m: Vector
    apart_3d_m: float
    n_marks: int
    difference_rms_m: float
    predicted_rms_m: float


class SharedUnknown(_Declared):
    """An unknown that all stations share."""

    name: str
    value: float
    sigma: float
    redundancy: float


class Excluded(_Declared):
    """An observation that a network does not use."""

    kind: str
    station: str | None
    marker: str | None
    mark: str | None
    reason: str


class Refused(_Declared):
    """A station that is not in a network."""

    station: str
    code: str
    reason: str


class GlobalTest(_Declared):
    """The global test of a network."""

    vtpv: float
    limit: float
    level: float


class VarianceFactors(_Declared):
    """Variance factors by kind of observation."""

    centres: float | None
    gravity: float | None
    control: float | None


class RangeBias(_Declared):
    """The common bias of all ranges."""

    value_m: float
    sigma_m: float
    sigma_a_priori_m: float
    redundancy: float


class StationHeight(RangeBias):
    """What all centres of a station are too high in the mean."""

    station: str


class NetworkDocument(_Declared):
    """``spheremark adjust --json``: an adjusted network; ``errors`` with a truth only."""

    status: Literal["ok", "weak"]
    warnings: list[str]
    datum: Datum
    method: str
    config: dict[str, Any]
    stations: list[NetworkStation]
    marks: list[NetworkMark]
    observations: list[Sighting]
    gravity: list[Gravity]
    control: list[ControlMark]
    evidence: list[MarkEvidence] = []
    repeated_stops: list[Repeat]
    calibration: CalibrationDocument | None
    shared_unknowns: list[SharedUnknown]
    station_heights: list[StationHeight] = []
    marks_covariance_m2: Matrix | None
    excluded: list[Excluded]
    refused: list[Refused]
    n_observations: int
    n_unknowns: int
    dof: int
    sigma0_a_priori: float
    sigma0: float | None
    passes_global_test: bool
    global_test: GlobalTest
    variance_factors: VarianceFactors
    critical_w: float
    range_bias: RangeBias | None
    errors: dict[str, Any] | None = None
