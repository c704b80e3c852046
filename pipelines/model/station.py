"""Stations and the marks that they are positioned from, and the truth to compare with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

from spheremark.pipelines.model.arrays import Array, Index, Mask, Shape, same_length, seal
from spheremark.pipelines.model.ellipse import ErrorEllipse
from spheremark.pipelines.model.marker import MarkerFits, Status
from spheremark.pipelines.model.scan import Rig, StitchedCloud


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ControlMarks:
    """Marks at known places.

    Attributes
    ----------
    names : tuple of str
        Unique names.
    p_site : (n, 3)
        Centres of the spheres [m].
    cov_p_site : (n, 3, 3)
        Their covariances; zero where the coordinates are taken as exact [m^2].
    """

    names: tuple[str, ...]
    p_site: Array
    cov_p_site: Array

    def __post_init__(self) -> None:
        seal(self, p_site=(len(self.names), 3), cov_p_site=(len(self.names), 3, 3))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Exclusion:
    """A marker that a fix left out."""

    fit: int  # its place among the fits
    reason: str  # why, as a sentence for people


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class StationFix:
    """The pose of a station in the site frame, with its uncertainty.

    Attributes
    ----------
    method : str
        Name of the resection method.
    T_site_station : (4, 4)
        Maps station coordinates to site coordinates [m].
    cov_T_site_station : (6, 6)
        Covariance of a small motion (rotation [rad], translation [m]) applied on the left:
        ``T_true = Exp(xi) T_site_station``, expressed in the site frame.
    cov_p_site : (3, 3)
        Covariance of the position: far from the site's origin that of the motion has no digits
        left for it [m^2].
    matches : (n, 2)
        Pairs of (place among the fits, place among the control marks), the used ones.
    residuals_site : (n, 3)
        Observed minus computed mark positions, in the order of ``matches`` [m].
    redundancies : (n,)
        Redundancy of each marker's three coordinates together, 0 (none) to 3.
    w_statistics : (n,)
        Largest w-statistic among each marker's three coordinates; NaN where not testable.
    detectable_biases : (n,)
        Minimal detectable bias along the weakest axis of each marker; infinite if none is [m].
    external_reliabilities : (n,)
        Largest shift of the station that a bias of each marker would cause unseen; infinite
        likewise [m].
    dof : int
        Degrees of freedom: observations, gravity included, minus unknowns.
    sigma0 : float
        Square root of the a-posteriori variance factor; NaN without redundancy.
    passes_global_test : bool
        Whether the variance factor agrees with 1 at the level of the configuration; true without
        redundancy, when nothing can be tested.
    included_angles : (2,)
        Smallest and largest 3-D angle at the station between two used marks [rad].
    status : Status
        Whether the fix can be relied on.
    reason : str
        Why it is weak; empty when it is not.
    excluded : tuple of Exclusion
        Markers that were left out.
    sigma_heading : float
        The part of ``sigma_yaw`` that mounting, encoder and clocks leave unknown. Whatever the scan
        holds is turned by the same error, so that its points do not have it in the site [rad].
    axis_station : (3,)
        The axis about which that turns the station: that of the gimbal, plumb where only distances
        position it.
    """

    method: str
    T_site_station: Array
    cov_T_site_station: Array
    cov_p_site: Array
    matches: Index
    residuals_site: Array
    redundancies: Array
    w_statistics: Array
    detectable_biases: Array
    external_reliabilities: Array
    dof: int
    sigma0: float
    passes_global_test: bool
    included_angles: Array
    status: Status
    reason: str
    excluded: tuple[Exclusion, ...] = ()
    sigma_heading: float = 0.0
    axis_station: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))

    def __post_init__(self) -> None:
        columns: dict[str, Shape] = {
            name: (len(self.matches),)
            for name in (
                "redundancies",
                "w_statistics",
                "detectable_biases",
                "external_reliabilities",
            )
        }
        seal(
            self,
            T_site_station=(4, 4),
            cov_T_site_station=(6, 6),
            cov_p_site=(3, 3),
            matches=(None, 2),
            residuals_site=(len(self.matches), 3),
            included_angles=(2,),
            axis_station=(3,),
            **columns,
        )

    @property
    def p_site(self) -> Array:
        """Position of the station, the origin of the station frame, in the site frame [m]."""
        return self.T_site_station[:3, 3]

    @property
    def yaw(self) -> float:
        """Heading of the station's x axis in the site frame, counter-clockwise from x [rad]."""
        return float(np.arctan2(self.T_site_station[1, 0], self.T_site_station[0, 0]))

    @property
    def sigma_yaw(self) -> float:
        """Standard deviation of ``yaw`` [rad]."""
        return float(np.sqrt(self.cov_T_site_station[2, 2]))

    @property
    def sigma_3d(self) -> float:
        """Square root of the trace of the position's covariance [m]."""
        return float(np.sqrt(np.trace(self.cov_p_site)))

    @property
    def ellipse(self) -> ErrorEllipse:
        """Error ellipse of the horizontal position."""
        return ErrorEllipse.of(self.cov_p_site)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SubsetFixes:
    """The station positioned from every k of its marks alone, one row per subset."""

    method: str  # name of the resection method
    # (n, k) places of the marks among the control marks; k is 2 for pairs, 3 for triples
    marks: Index
    # (n, 2) smallest and largest 3-D angle at the station between two centres [rad]
    included_angles: Array
    included_angles_horizontal: Array  # (n, 2) the same in the levelled plane [rad]
    p_site: Array  # (n, 3) position of the station [m]
    sigma_horizontal: Array  # (n,) square root of the trace of the covariance of x and y [m]
    sigma_3d: Array  # (n,) square root of the trace of the position's covariance [m]

    def __post_init__(self) -> None:
        angles: dict[str, Shape] = dict.fromkeys(
            ("included_angles", "included_angles_horizontal"), (None, 2)
        )
        sigmas: dict[str, Shape] = dict.fromkeys(("sigma_horizontal", "sigma_3d"), (None,))
        seal(self, marks=(None, None), p_site=(None, 3), **angles, **sigmas)
        same_length(self, "marks", "p_site", *angles, *sigmas)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class NoFix:
    """A station that could not be positioned by one method."""

    method: str  # name of the resection method
    code: str  # stable code of the error
    reason: str  # why, as a sentence for people


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class DistanceChecks:
    """Distances between the marks of one scan, as measured against as given, one row per pair."""

    fits: Index  # (n, 2) places of the two among the fits
    marks: Index  # (n, 2) places of the two among the control marks
    measured: Array  # (n,) distance between the centres, and between the control marks [m]
    given: Array
    sigmas: Array  # (n,) standard deviation of their difference [m]
    # (n,) bool whether they differ by more than the tolerance, or by more than 3.29 sigma
    is_off: Mask
    # places among the control marks of those without which no distance would be off, or that most
    # of the distances that are off share
    suspects: tuple[int, ...]
    reason: str = ""  # why nothing could be compared; empty when it was

    def __post_init__(self) -> None:
        n = len(self.fits)
        columns: dict[str, Shape] = dict.fromkeys(("measured", "given", "sigmas", "is_off"), (n,))
        seal(self, fits=(n, 2), marks=(n, 2), **columns)

    @classmethod
    def none(cls, reason: str) -> Self:
        """Return no comparison, with the reason."""
        pairs, values = np.zeros((0, 2), dtype=np.intp), np.zeros(0)
        return cls(
            fits=pairs,
            marks=pairs,
            measured=values,
            given=values,
            sigmas=values,
            is_off=np.zeros(0, dtype=np.bool_),
            suspects=(),
            reason=reason,
        )


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Omissions:
    """A station without each of its markers, one row per match."""

    # (n, 3) position of the station without the marker, minus its position with all; NaN, as all
    # else of the row, where the other marks stand on one plumb line and determine no heading, or
    # contradict each other and determine no position [m]
    shifts_site: Array
    # (n, 3) where the scan puts the mark when the others alone position the station, minus where it
    # is given [m]
    predictions_site: Array
    cov_predictions_site: Array  # (n, 3, 3) covariances of these differences [m^2]

    def __post_init__(self) -> None:
        n = len(self.shifts_site)
        seal(self, shifts_site=(n, 3), predictions_site=(n, 3), cov_predictions_site=(n, 3, 3))

    @classmethod
    def none(cls) -> Self:
        """Return no rows."""
        none = np.zeros((0, 3))
        return cls(
            shifts_site=none, predictions_site=none, cov_predictions_site=np.zeros((0, 3, 3))
        )

    @property
    def sigma_predictions_site(self) -> Array:
        """Standard deviations of ``predictions_site``, (n, 3) [m]."""
        return np.asarray(np.sqrt(np.diagonal(self.cov_predictions_site, axis1=1, axis2=2)))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class StationQuality:
    """Quality of a station from scan and control, without truth.

    Attributes
    ----------
    dilution_of_precision : float
        3-D sigma of the position where each observation has a sigma of 1; infinite where these
        leave it open.
    without_each : Omissions
        The station without each of its markers; no rows where the method is not ``free_station`` or
        fewer than three markers were used.
    """

    dilution_of_precision: float
    without_each: Omissions


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class StopResult:
    """The results of one stop.

    Attributes
    ----------
    name : str
        Name of the stop.
    cloud : StitchedCloud
        Its returns in the base frame.
    fits : mapping of str to MarkerFits
        By fitting method.
    fixes : mapping of (str, str) to StationFix or NoFix
        By fitting and resection method; empty when there are no control marks.
    subsets : mapping of (str, str) to tuple of SubsetFixes
        The station from each pair and each triple of its marks, by fitting and resection method.
    quality : mapping of (str, str) to StationQuality
        Of each ``StationFix`` in ``fixes``.
    distances : DistanceChecks or None
        Distances between markers of the first fitting method against the control; None without
        control marks, or with fewer than two of either.
    timings : mapping of str to float
        Time that each step took [s].
    """

    name: str
    cloud: StitchedCloud
    fits: Mapping[str, MarkerFits]
    fixes: Mapping[tuple[str, str], StationFix | NoFix]
    subsets: Mapping[tuple[str, str], tuple[SubsetFixes, ...]]
    quality: Mapping[tuple[str, str], StationQuality]
    distances: DistanceChecks | None = None
    timings: Mapping[str, float] = field(default_factory=dict)

    @property
    def sigma_heading(self) -> float:
        """Standard deviation of the heading of base [rad], by the first fitting method."""
        levellings = [found.levelling for found in self.fits.values()] or [self.cloud.levelling]
        return levellings[0].sigma_heading


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class StopTruth:
    """What a simulated stop really was: for comparison only, never an input of the pipeline."""

    name: str  # name of the stop
    T_site_base: Array  # (4, 4) true pose of the base frame [m]

    def __post_init__(self) -> None:
        seal(self, T_site_base=(4, 4))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Truth:
    """The truth of a survey: for comparison only, never an input of the pipeline."""

    marks: ControlMarks  # true centres, with zero covariance
    stops: tuple[StopTruth, ...]  # true poses
    rig: Rig | None  # true rig, when known
    # seed, scenario and the like, for people
    about: Mapping[str, Any] = field(default_factory=dict)
