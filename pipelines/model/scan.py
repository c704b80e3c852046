"""The log of a LiDAR on a gimbal, and the stitched cloud."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.model.arrays import (
    Array,
    Column,
    Index,
    Mask,
    Nanos,
    Rings,
    Shape,
    same_length,
    seal,
)


class ImuMount(StrEnum):
    """Which part of the gimbal carries the AHRS."""

    BASE = "base"
    HEAD = "head"


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Origin:
    """Where a recording came from."""

    name: str  # stem of the log's file name
    digest: str  # SHA-256 of the file's bytes, in hexadecimal; empty when the log never was a file


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Rig:
    """How the LiDAR sits on the gimbal, and the shape of its beams.

    Attributes
    ----------
    name : str
        Name of the rig in results.
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
        Range bias of each laser [m]; subtracted when stitching.
    cloud_carries_heights : bool
        Whether recorded coordinates already include ``laser_heights``.
    divergence : (2,)
        Full width of the evenly lit elliptic footprint across and along the spin axis [rad].
    encoder_eccentricity : (2,)
        Cosine and sine amplitude that are added to the recorded joint angle [rad].
    gimbal_clock_offset : float
        Added to a gimbal stamp to get the LiDAR's clock [s].
    sigma_heading : float
        Standard deviation of the angle about the gimbal axis, from mounting and encoder: it turns
        all centres of a stop together [rad].
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
        seal(
            self,
            T_head_lidar=(4, 4),
            R_mount_imu=(3, 3),
            laser_elevations=(None,),
            laser_heights=(None,),
            laser_range_biases=(None,),
            divergence=(2,),
            encoder_eccentricity=(2,),
        )
        same_length(self, "laser_elevations", "laser_heights", "laser_range_biases")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ScanLog:
    """The recording of one or more stops, each sensor on its own clock.

    Attributes
    ----------
    p_lidar : (n, 3) float32
        Returns as recorded, without those that are not finite or at the origin [m].
    intensities : (n,) float32
        Calibrated reflectivity as recorded, 0-255.
    rings : (n,) uint8
        Laser of each return, 0 the lowest; ``RING_UNKNOWN`` throughout when not recorded.
    stamps_lidar_ns : (n,)
        Instant of each pulse; that of its message when the points carry no time.
    has_pulse_times : bool
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
        What the recording lacks, as sentences.
    has_heights : bool or None
        Whether the coordinates include the heights of the lasers; none where only a rig says it.
    weaknesses : tuple of str
        Why every result is weak, as sentences; they are among the notes too.
    sigma_levelling : float
        Standard deviation per axis of the sensor behind the orientations, beyond that of the
        configuration [rad].
    """

    p_lidar: Column
    intensities: Column
    rings: Rings
    stamps_lidar_ns: Nanos
    has_pulse_times: bool
    gimbal_angles: Array
    stamps_gimbal_ns: Nanos
    quaternions_imu: Array
    stamps_imu_ns: Nanos
    rig: Rig | None
    origin: Origin
    notes: tuple[str, ...] = ()
    has_heights: bool | None = None
    weaknesses: tuple[str, ...] = ()
    sigma_levelling: float = 0.0

    def __post_init__(self) -> None:
        seal(
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
        same_length(self, "p_lidar", "intensities", "rings", "stamps_lidar_ns")
        same_length(self, "gimbal_angles", "stamps_gimbal_ns")
        same_length(self, "quaternions_imu", "stamps_imu_ns")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Firings:
    """All pulses of a VLP-16 as its packets hold them, with and without a return."""

    # (n,) uint16 azimuth of the first pulse of each block of two firings, in hundredths of a
    # degree, clockwise from x seen from +z
    azimuths: NDArray[np.uint16]
    # (n, 32) uint16 distance of each pulse in units of 2 mm, in the order of firing; 0 for none
    distances: NDArray[np.uint16]
    # (n, 32) uint8 calibrated reflectivity of each pulse; 0 without a return
    reflectivities: NDArray[np.uint8]
    start_ns: int  # instant of the first pulse; blocks follow each other without a pause

    def __post_init__(self) -> None:
        n = len(self.azimuths)
        seal(self, azimuths=(n,), distances=(n, 32), reflectivities=(n, 32))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Levelling:
    """How the base leans by the AHRS, and the heading error that all centres of a stop share."""

    roll: float  # angles of ``R_station_base = Ry(pitch) Rx(roll)`` [rad]
    pitch: float
    sigma: float  # standard deviation of each of the two angles [rad]
    # false when no AHRS was recorded and the base is only assumed to be about level
    is_measured: bool
    sigma_heading: float = 0.0  # standard deviation of the heading, from mounting and encoder [rad]
    sigma_clock: float = 0.0  # the same from the clocks of gimbal and LiDAR [rad]

    @property
    def sigma_heading_station(self) -> float:
        """Standard deviation of the heading of the station [rad]."""
        return float(np.hypot(self.sigma_heading, self.sigma_clock))


@dataclass(frozen=True, slots=True, eq=False)
class Timed:
    """A column that changes evenly between samples: computed for the rows that are read.

    Notes
    -----
    Of millions of rows a few thousand are needed; ``column[:]`` gives all of them.
    """

    stamps_ns: Nanos  # (n,) instant of each row
    samples_ns: Nanos  # (m,) instants of the samples, increasing; no row is before the first
    values: Array  # (m,) values at the samples
    rates: Array  # (m,) change from each sample on [1/ns]
    is_angle: bool = False  # whether to reduce to [-pi, pi) [rad]

    def __post_init__(self) -> None:
        seal(self, stamps_ns=(None,), samples_ns=(None,), values=(None,), rates=(None,))
        same_length(self, "samples_ns", "values", "rates")

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.stamps_ns)

    def exact(self, rows: slice | Index | Mask) -> Array:
        """Return some rows, float64."""
        stamps_ns = self.stamps_ns[rows]
        sample: Any = 0  # a single sample serves all rows
        if len(self.samples_ns) > 1:
            sample = np.searchsorted(self.samples_ns, stamps_ns, side="right") - 1
        found = self.values[sample] + self.rates[sample] * (stamps_ns - self.samples_ns[sample])
        if self.is_angle:
            turns = found * (0.5 / np.pi)
            found = 2.0 * np.pi * (turns - np.floor(turns + 0.5))
        return np.asarray(found, np.float64)

    def __getitem__(self, rows: slice | Index | Mask) -> Column:
        """Return some rows, float32."""
        column = self.exact(rows).astype(np.float32)
        column.flags.writeable = False  # like a sealed array: compiled loops are specialised by it
        return column

    def __array__(self, dtype: Any = None, copy: object = None) -> NDArray[Any]:
        """Return all rows, for NumPy's own functions; they are always new."""
        return np.asarray(self[:], dtype)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class StitchedCloud:
    """One stop's returns as points in the base frame, and all that rebuilds their beams.

    Attributes
    ----------
    p_base : (n, 3) float32
        Returns [m].
    gimbal_angles : (n,) float32
        Gimbal angle at each pulse, eccentricity applied, reduced to [-pi, pi) [rad]. Like the
        times, an array or a ``Timed`` column.
    intensities : (n,) float32
        Calibrated reflectivity, 0-255.
    rings : (n,) uint8
        Laser of each return; ``RING_UNKNOWN`` when neither recorded nor inferred from elevations.
    times : (n,) float32
        Instant of each pulse since the first one of the stop; where a log has none, by the spin, or
        that of its message [s].
    levelling : Levelling
        How the base leans.
    rig : Rig
        The rig that was used.
    coverage : float
        Angle that the gimbal turned through, at most a full turn [rad].
    duration : float
        Time from the first pulse to the last [s].
    name : str
        Name of the stop.
    notes : tuple of str
        What weakens the result, as sentences.
    weaknesses : tuple of str
        Why a station of this scan is weak, among the notes too.
    near_times, near_rings : (k,), (k,) uint8
        Pulses whose return is nearer than the least range, as from a mast of the rover: instants,
        as ``times``, and lasers. They do not show what is behind it [s].
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
    weaknesses: tuple[str, ...] = ()
    near_times: Array = field(default_factory=lambda: np.zeros(0))
    near_rings: Rings = field(default_factory=lambda: np.zeros(0, np.uint8))

    def __post_init__(self) -> None:
        columns = ("gimbal_angles", "intensities", "rings", "times")
        arrays = [name for name in columns if not isinstance(getattr(self, name), Timed)]
        shapes: dict[str, Shape] = dict.fromkeys((*arrays, "near_times", "near_rings"), (None,))
        seal(self, p_base=(None, 3), **shapes)
        same_length(self, "near_times", "near_rings")
        same_length(self, "p_base", *columns)

    def seconds(self, rows: slice | Index | Mask) -> Array:
        """Return the times of some rows as exactly as they are known, float64 [s].

        After half a minute float32 has too few digits to keep the lasers of a firing apart.
        """
        if isinstance(self.times, Timed):
            return self.times.exact(rows)
        return self.times[rows].astype(np.float64)

    @property
    def start_ns(self) -> int:
        """Instant of the first pulse by the clock of the log [ns]; 0 where it is not known."""
        return int(self.times.samples_ns[0]) if isinstance(self.times, Timed) else 0


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Beams:
    """The beams of some returns of a stitched cloud, as lines in the base frame."""

    origins_base: Array  # (n, 3) where each beam leaves the spin axis of the LiDAR [m]
    directions_base: Array  # (n, 3) unit vectors from origin to return
    ranges: Array  # (n,) distance from origin to return [m]
    # (n, 3) unit vectors across the beam, along the sweep of the LiDAR: the footprint's first axis
    across_base: Array
    rings: Rings  # (n,) uint8 laser of each beam
    intensities: Array  # (n,) calibrated reflectivity, 0-255
    times: Array  # (n,) instant of each pulse since the first one of the stop [s]
    # (2,) full width of the footprint along ``across_base`` and square to it [rad]
    divergence: Array

    def __post_init__(self) -> None:
        vectors: dict[str, Shape] = dict.fromkeys(
            ("origins_base", "directions_base", "across_base"), (None, 3)
        )
        columns: dict[str, Shape] = dict.fromkeys(
            ("ranges", "rings", "intensities", "times"), (None,)
        )
        seal(self, **vectors, **columns, divergence=(2,))
        same_length(self, *vectors, *columns)
