"""The types that flow through a survey: frozen, checked, sealed.

Frames are suffixes (``lidar``, ``head``, ``base``, ``station``, ``site``; see CONVENTIONS.md),
units are SI. Arrays are handed over when a value is built: they become read-only. A value compares
by identity, because ``==`` on arrays has no single answer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.errors import InputError

Array = NDArray[np.float64]
Column = NDArray[np.float32]
Index = NDArray[np.intp]
Nanos = NDArray[np.int64]
Mask = NDArray[np.bool_]
Rings = NDArray[np.uint8]
Shape = tuple[int | None, ...]

RING_UNKNOWN = 255  # the ring of a return whose recording does not tell


def _seal(value: object, **shapes: Shape) -> None:
    """Check the shape of each named array and make it read-only; ``None`` is any length."""
    for name, shape in shapes.items():
        array = getattr(value, name)
        agrees = array.ndim == len(shape) and all(
            expected is None or expected == found
            for expected, found in zip(shape, array.shape, strict=True)
        )
        if not agrees:
            kind = type(value).__name__
            expected_text = str(tuple("n" if n is None else n for n in shape)).replace("'", "")
            raise InputError(f"{kind}.{name} has shape {array.shape}, not {expected_text}.")
        array.flags.writeable = False


def _same_length(value: object, *names: str) -> None:
    """Check that the named columns are equally long."""
    lengths = {name: len(getattr(value, name)) for name in names}
    if len(set(lengths.values())) > 1:
        raise InputError(f"{type(value).__name__} has columns of different lengths: {lengths}.")


class Status(StrEnum):
    """How far a result can be relied on."""

    OK = "ok"
    WEAK = "weak"


class ImuMount(StrEnum):
    """Which part of the gimbal carries the AHRS."""

    BASE = "base"
    HEAD = "head"


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Origin:
    """Where a recording came from.

    Attributes
    ----------
    name : str
        Stem of the log's file name.
    digest : str
        SHA-256 of the file's bytes, in hexadecimal; empty when the log never was a file.
    """

    name: str
    digest: str


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Rig:
    """How the LiDAR sits on the gimbal, and what its beams look like.

    Attributes
    ----------
    name : str
        What results call this rig.
    T_head_lidar : (4, 4)
        Mounting of the LiDAR on the turning head: tilt and axis offset [m]. Its vertical
        translation is zero by the definition of the base frame.
    R_mount_imu : (3, 3)
        Mounting of the AHRS on the part that carries it.
    imu_mount : ImuMount
        The part that carries the AHRS: the fixed base or the turning head.
    laser_elevations : (k,)
        Elevation of each laser, lowest first [rad].
    laser_heights : (k,)
        Where each beam leaves the spin axis, along it [m].
    laser_range_biases : (k,)
        What each laser measures too long [m]; subtracted when stitching.
    cloud_carries_heights : bool
        Whether recorded coordinates already include ``laser_heights``.
    divergence : (2,)
        Full width of the evenly lit elliptic footprint across and along the spin axis [rad].
    encoder_eccentricity : (2,)
        Cosine and sine amplitude that are added to the recorded joint angle [rad].
    gimbal_clock_offset : float
        What is added to a gimbal stamp to get the LiDAR's clock [s].
    sigma_heading : float
        Standard deviation of the angle about the gimbal axis that mounting and encoder leave
        unknown: it turns all centres of a stop together [rad].
    """

    name: str
    T_head_lidar: Array
    R_mount_imu: Array
    imu_mount: ImuMount
    laser_elevations: Array
    laser_heights: Array
    laser_range_biases: Array
    cloud_carries_heights: bool
    divergence: Array
    encoder_eccentricity: Array
    gimbal_clock_offset: float
    sigma_heading: float

    def __post_init__(self) -> None:
        _seal(
            self,
            T_head_lidar=(4, 4),
            R_mount_imu=(3, 3),
            laser_elevations=(None,),
            laser_heights=(None,),
            laser_range_biases=(None,),
            divergence=(2,),
            encoder_eccentricity=(2,),
        )
        _same_length(self, "laser_elevations", "laser_heights", "laser_range_biases")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ScanLog:
    """What was recorded, each sensor on its own clock.

    Attributes
    ----------
    p_lidar : (n, 3) float32
        Returns as recorded, without those that are not finite or at the origin [m].
    intensities : (n,) float32
        Calibrated reflectivity as recorded, 0-255.
    rings : (n,) uint8
        Laser of each return, 0 the lowest; ``RING_UNKNOWN`` throughout when not recorded.
    stamps_lidar_ns : (n,)
        Instant of each shot; that of its message when the points carry no time.
    has_shot_times : bool
        Whether the points carry a time of their own.
    gimbal_angles : (m,)
        Joint angle, unwrapped, positive counter-clockwise seen from above [rad].
    stamps_gimbal_ns : (m,)
        Instant of each joint sample, strictly increasing.
    quaternions_imu : (k, 4)
        Orientation of the AHRS in the world, x y z w; no rows when there is none.
    stamps_imu_ns : (k,)
        Instant of each orientation.
    rig : Rig or None
        The rig that the recording describes; none when it does not.
    origin : Origin
        Name and digest of the recording.
    notes : tuple of str
        What the recording cannot give, as sentences for people.
    has_heights : bool or None
        Whether the coordinates include the heights of the lasers; none where only a rig can tell.
    """

    p_lidar: Column
    intensities: Column
    rings: Rings
    stamps_lidar_ns: Nanos
    has_shot_times: bool
    gimbal_angles: Array
    stamps_gimbal_ns: Nanos
    quaternions_imu: Array
    stamps_imu_ns: Nanos
    rig: Rig | None
    origin: Origin
    notes: tuple[str, ...] = ()
    has_heights: bool | None = None

    def __post_init__(self) -> None:
        _seal(
            self,
            p_lidar=(None, 3),
            intensities=(None,),
            rings=(None,),
            stamps_lidar_ns=(None,),
            gimbal_angles=(None,),
            stamps_gimbal_ns=(None,),
            quaternions_imu=(None, 4),
            stamps_imu_ns=(None,),
        )
        _same_length(self, "p_lidar", "intensities", "rings", "stamps_lidar_ns")
        _same_length(self, "gimbal_angles", "stamps_gimbal_ns")
        _same_length(self, "quaternions_imu", "stamps_imu_ns")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Firings:
    """All shots of a VLP-16 as its packets hold them, with and without a return.

    Attributes
    ----------
    azimuths : (n,) uint16
        Azimuth of the first shot of each block of two firings, in hundredths of a degree,
        clockwise from x seen from +z.
    distances : (n, 32) uint16
        Distance of each shot in units of 2 mm, in the order of firing; 0 without a return.
    reflectivities : (n, 32) uint8
        Calibrated reflectivity of each shot; 0 without a return.
    start_ns : int
        Instant of the first shot; blocks follow each other without a pause.
    """

    azimuths: NDArray[np.uint16]
    distances: NDArray[np.uint16]
    reflectivities: NDArray[np.uint8]
    start_ns: int

    def __post_init__(self) -> None:
        n = len(self.azimuths)
        _seal(self, azimuths=(n,), distances=(n, 32), reflectivities=(n, 32))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Levelling:
    """How the base leans, as the AHRS tells, and what all centres of a stop have in common.

    Attributes
    ----------
    roll, pitch : float
        Angles of ``R_station_base = Ry(pitch) Rx(roll)`` [rad].
    sigma : float
        Standard deviation of each of the two angles [rad].
    is_measured : bool
        False when no AHRS was recorded and the base is only assumed to be about level.
    sigma_heading : float
        Standard deviation of the heading that mounting and encoder leave unknown [rad].
    """

    roll: float
    pitch: float
    sigma: float
    is_measured: bool
    sigma_heading: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Timed:
    """A column that changes evenly between samples: found for the rows that are asked for.

    Attributes
    ----------
    stamps_ns : (n,)
        Instant of each row.
    samples_ns : (m,)
        Instants of the samples, increasing; what is asked for is not before the first.
    values : (m,)
        What was sampled.
    rates : (m,)
        Change from each sample on [1/ns].
    is_angle : bool
        Whether to reduce to [-pi, pi) [rad].

    Notes
    -----
    Of millions of shots a few thousand are asked for; ``column[:]`` gives all of them.
    """

    stamps_ns: Nanos
    samples_ns: Nanos
    values: Array
    rates: Array
    is_angle: bool = False

    def __post_init__(self) -> None:
        _seal(self, stamps_ns=(None,), samples_ns=(None,), values=(None,), rates=(None,))
        _same_length(self, "samples_ns", "values", "rates")

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.stamps_ns)

    def __getitem__(self, rows: slice | Index | Mask) -> Column:
        """Return some rows, float32."""
        stamps_ns = self.stamps_ns[rows]
        sample: Any = 0  # where there is but one, millions of rows need not be told theirs
        if len(self.samples_ns) > 1:
            sample = np.searchsorted(self.samples_ns, stamps_ns, side="right") - 1
        found = self.values[sample] + self.rates[sample] * (stamps_ns - self.samples_ns[sample])
        if self.is_angle:
            turns = found * (0.5 / np.pi)
            found = 2.0 * np.pi * (turns - np.floor(turns + 0.5))
        column = np.asarray(found, np.float32)
        column.flags.writeable = False  # like an array's own: compiled loops tell the two apart
        return column

    def __array__(self, dtype: Any = None, copy: object = None) -> NDArray[Any]:
        """Return all rows, for NumPy's own functions; they are always new."""
        return np.asarray(self[:], dtype)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class StitchedCloud:
    """One stop's returns as points in the base frame, with what is needed to rebuild their beams.

    Attributes
    ----------
    p_base : (n, 3) float32
        Returns [m].
    gimbal_angles : (n,) float32
        Gimbal angle at each shot, eccentricity applied, reduced to [-pi, pi) [rad]. Like the times,
        an array, or what finds the rows that are asked for.
    intensities : (n,) float32
        Calibrated reflectivity, 0-255.
    rings : (n,) uint8
        Laser of each return; ``RING_UNKNOWN`` when neither recorded nor told by the elevations.
    times : (n,) float32
        Instant of each shot since the first one of the stop [s].
    levelling : Levelling
        How the base leans.
    rig : Rig
        The rig that was used.
    coverage : float
        Angle that the gimbal turned through, at most a full turn [rad].
    duration : float
        Time from the first shot to the last [s].
    name : str
        Name of the stop.
    notes : tuple of str
        What weakens the result, as sentences for people.
    """

    p_base: Column
    gimbal_angles: Column | Timed
    intensities: Column
    rings: Rings
    times: Column | Timed
    levelling: Levelling
    rig: Rig
    coverage: float
    duration: float
    name: str
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        columns = ("gimbal_angles", "intensities", "rings", "times")
        arrays = (name for name in columns if not isinstance(getattr(self, name), Timed))
        _seal(self, p_base=(None, 3), **dict.fromkeys(arrays, (None,)))
        _same_length(self, "p_base", *columns)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Beams:
    """Some shots of a stitched cloud as lines in the base frame.

    Attributes
    ----------
    origins_base : (n, 3)
        Where each beam leaves the spin axis of the LiDAR [m].
    directions_base : (n, 3)
        Unit vectors from origin to return.
    ranges : (n,)
        Distance from origin to return [m].
    across_base : (n, 3)
        Unit vectors across the beam, along the sweep of the LiDAR: the footprint's first axis.
    rings : (n,) uint8
        Laser of each shot.
    intensities : (n,)
        Calibrated reflectivity, 0-255.
    times : (n,)
        Instant of each shot since the first one of the stop [s].
    divergence : (2,)
        Full width of the footprint along ``across_base`` and square to it [rad].
    """

    origins_base: Array
    directions_base: Array
    ranges: Array
    across_base: Array
    rings: Rings
    intensities: Array
    times: Array
    divergence: Array

    def __post_init__(self) -> None:
        vectors: dict[str, Shape] = dict.fromkeys(
            ("origins_base", "directions_base", "across_base"), (None, 3)
        )
        columns: dict[str, Shape] = dict.fromkeys(
            ("ranges", "rings", "intensities", "times"), (None,)
        )
        _seal(self, **vectors, **columns, divergence=(2,))
        _same_length(self, *vectors, *columns)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MarkerCandidate:
    """A group of returns that may be a marker.

    Attributes
    ----------
    name : str
        What its marker is called at this stop, whatever method fits it.
    members : (n,)
        Rows of the stitched cloud, ascending: the sphere, and what of its pole touches it.
    p_base_rough : (3,)
        Rough centre, good to a few centimetres [m].
    score : float
        0 (hardly a sphere) to 1 (all tests passed with ease).
    """

    name: str
    members: Index
    p_base_rough: Array
    score: float

    def __post_init__(self) -> None:
        _seal(self, members=(None,), p_base_rough=(3,))


def marker_name(place: int) -> str:
    """Return what the marker at a place among those of a stop is called: M01, M02, ...

    Parameters
    ----------
    place : int
        From 0.

    Returns
    -------
    str
        Its name within one stop.
    """
    return f"M{place + 1:02d}"


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Rejection:
    """A group of returns that was looked at and is not used as a marker.

    Attributes
    ----------
    p_base : (3,)
        Where it is [m].
    n_points : int
        Number of its returns.
    reason : str
        Why it was refused, as a sentence for people.
    """

    p_base: Array
    n_points: int
    reason: str

    def __post_init__(self) -> None:
        _seal(self, p_base=(3,))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MarkerCandidates:
    """What one stitched cloud shows that may be, or looked like, a marker.

    Attributes
    ----------
    candidates : tuple of MarkerCandidate
        Groups that may be markers.
    rejected : tuple of Rejection
        Groups that looked like one at first, with the reason against.
    ground_height_max : float
        Height of the highest ground point near the station in the levelled frame, the level of the
        study's cut [m]; minus infinity when no ground was seen.
    """

    candidates: tuple[MarkerCandidate, ...]
    rejected: tuple[Rejection, ...]
    ground_height_max: float


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MarkerFit:
    """A marker centre with covariance.

    Attributes
    ----------
    name : str
        What the marker is called at this stop: that of its candidate.
    p_base : (3,)
        Centre [m].
    cov_p_base : (3, 3)
        Covariance of the centre, without levelling and heading [m^2].
    method : str
        Name of the fitting method.
    status : Status
        Whether the fit can be relied on.
    reason : str
        Why it is weak; empty when it is not.
    radius : float
        Radius that was assumed [m].
    radius_free : float
        Radius when estimated together with the centre; NaN when the points do not tell [m].
    sigma_radius_free : float
        Standard deviation of ``radius_free``; NaN likewise [m].
    mean_range : float
        Distance from the mean beam origin to the centre [m].
    mean_intensity : float
        Mean reflectivity of the used returns, 0-255.
    used : (n,)
        Rows of the stitched cloud that carry the estimate.
    rejected : (m,)
        Rows of the candidate that were set aside.
    residuals : (n,)
        Observed minus computed, along the beam, of the used returns [m].
    sigma0 : float
        Square root of the a-posteriori variance factor; 1 means noise as assumed.
    n_rings : int
        Number of different lasers among the used returns; 0 when rings are not recorded.
    coverage : float
        Share of the visible half of the sphere that has returns, 0 to 1.
    incidence : float
        Mean angle between the used beams and the sphere's normals; NaN when not told [rad].
    variant : str
        Which form of its method ran, where it has several; else empty.
    sigma_range_shared : float
        How much of its error along the line of sight all centres of the stop have in common, as its
        covariance has it; NaN when not told [m].
    """

    name: str
    p_base: Array
    cov_p_base: Array
    method: str
    status: Status
    reason: str
    radius: float
    radius_free: float
    sigma_radius_free: float
    mean_range: float
    mean_intensity: float
    used: Index
    rejected: Index
    residuals: Array
    sigma0: float
    n_rings: int
    coverage: float
    incidence: float = np.nan
    variant: str = ""
    sigma_range_shared: float = np.nan

    def __post_init__(self) -> None:
        _seal(
            self,
            p_base=(3,),
            cov_p_base=(3, 3),
            used=(None,),
            rejected=(None,),
            residuals=(None,),
        )
        _same_length(self, "used", "residuals")

    @property
    def n_points(self) -> int:
        """Number of returns that carry the estimate."""
        return len(self.used)

    @property
    def rms(self) -> float:
        """Root mean square of the residuals [m]."""
        if not self.n_points:
            return np.nan
        return float(np.sqrt(self.residuals @ self.residuals / self.n_points))

    def cov_with_heading(self, sigma_heading: float) -> Array:
        """Return ``cov_p_base`` with what an unknown heading [rad] of the stop adds to it [m^2]."""
        sideways = np.array([-self.p_base[1], self.p_base[0], 0.0])
        return self.cov_p_base + sigma_heading**2 * np.outer(sideways, sideways)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MarkerFits:
    """All markers of one stop, fitted by one method.

    Attributes
    ----------
    method : str
        Name of the fitting method.
    fits : tuple of MarkerFit
        Markers in the order of their azimuth in the base frame, from -pi.
    rejected : tuple of Rejection
        Candidates that this method or the extraction refused.
    levelling : Levelling
        How the base leans.
    """

    method: str
    fits: tuple[MarkerFit, ...]
    rejected: tuple[Rejection, ...]
    levelling: Levelling


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ControlMarks:
    """Marks at known places.

    Attributes
    ----------
    names : tuple of str
        What the surveyor calls them, all different.
    p_site : (n, 3)
        Centres of the spheres [m].
    cov_p_site : (n, 3, 3)
        Their covariances; zero where the coordinates are taken as exact [m^2].
    """

    names: tuple[str, ...]
    p_site: Array
    cov_p_site: Array

    def __post_init__(self) -> None:
        _seal(self, p_site=(len(self.names), 3), cov_p_site=(len(self.names), 3, 3))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Exclusion:
    """A marker that a fix left out.

    Attributes
    ----------
    fit : int
        Its place among the fits.
    reason : str
        Why, as a sentence for people.
    """

    fit: int
    reason: str


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
        left to tell it from [m^2].
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
        _seal(
            self,
            T_site_station=(4, 4),
            cov_T_site_station=(6, 6),
            cov_p_site=(3, 3),
            matches=(None, 2),
            residuals_site=(len(self.matches), 3),
            included_angles=(2,),
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


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SubsetFixes:
    """The station positioned from every k of its marks alone, one row per subset.

    Attributes
    ----------
    method : str
        Name of the resection method.
    marks : (n, k)
        Places of the marks among the control marks; k is 2 for pairs, 3 for triples.
    included_angles : (n, 2)
        Smallest and largest 3-D angle at the station between two of the centres; equal for pairs
        [rad].
    included_angles_horizontal : (n, 2)
        The same in the levelled plane [rad].
    p_site : (n, 3)
        Position of the station [m].
    sigma_horizontal : (n,)
        Square root of the trace of the covariance of x and y [m].
    sigma_3d : (n,)
        Square root of the trace of the position's covariance [m].
    """

    method: str
    marks: Index
    included_angles: Array
    included_angles_horizontal: Array
    p_site: Array
    sigma_horizontal: Array
    sigma_3d: Array

    def __post_init__(self) -> None:
        angles: dict[str, Shape] = dict.fromkeys(
            ("included_angles", "included_angles_horizontal"), (None, 2)
        )
        sigmas: dict[str, Shape] = dict.fromkeys(("sigma_horizontal", "sigma_3d"), (None,))
        _seal(self, marks=(None, None), p_site=(None, 3), **angles, **sigmas)
        _same_length(self, "marks", "p_site", *angles, *sigmas)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class NoFix:
    """A station that could not be positioned by one method.

    Attributes
    ----------
    method : str
        Name of the resection method.
    code : str
        Stable code of the error.
    reason : str
        Why, as a sentence for people.
    """

    method: str
    code: str
    reason: str


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class StopResult:
    """All that one stop gave.

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
    timings : mapping of str to float
        Time that each step took [s].
    """

    name: str
    cloud: StitchedCloud
    fits: Mapping[str, MarkerFits]
    fixes: Mapping[tuple[str, str], StationFix | NoFix]
    subsets: Mapping[tuple[str, str], tuple[SubsetFixes, ...]]
    timings: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class StopTruth:
    """What a simulated stop really was: for comparison only, never an input of the pipeline.

    Attributes
    ----------
    name : str
        Name of the stop.
    T_site_base : (4, 4)
        True pose of the base frame [m].
    """

    name: str
    T_site_base: Array

    def __post_init__(self) -> None:
        _seal(self, T_site_base=(4, 4))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Truth:
    """The truth of a survey: for comparison only, never an input of the pipeline.

    Attributes
    ----------
    marks : ControlMarks
        True centres, with zero covariance.
    stops : tuple of StopTruth
        True poses.
    rig : Rig or None
        True rig, when known.
    about : mapping
        Seed, scenario and the like, for people.
    """

    marks: ControlMarks
    stops: tuple[StopTruth, ...]
    rig: Rig | None
    about: Mapping[str, Any] = field(default_factory=dict)
