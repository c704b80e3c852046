"""Configuration of the simulated rig and sensor: unit, default and reason of each field."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, ClassVar, Self

from spheremark.pipelines.errors import ConfigError
from spheremark.pipelines.model import ImuMount
from spheremark.pipelines.scan.rigs import AZIMUTH_STEP, RANGE_STEP

_LONGEST = 3600.0  # [s] of a scan, as of an even turn


class Profile(StrEnum):
    """How a pulse spreads its energy over the footprint."""

    EVEN = "even"
    GAUSSIAN = "gaussian"
    TWO_LOBES = "two lobes"


class Pick(StrEnum):
    """Which echo of a pulse is recorded."""

    STRONGEST = "strongest"
    FIRST = "first"
    LAST = "last"


@dataclass(frozen=True, slots=True, kw_only=True)
class Optics:
    """What a pulse lights, which of its echoes is recorded, and how well.

    Attributes
    ----------
    profile : Profile
        Energy over the footprint. A Gaussian one falls to 1/e^2 at the edge of the divergence and
        has the second moments of an even one of that width.
    divergence_scale : float
        True divergence over the nominal one; 0 for beams without divergence.
    roundness : float
        What the divergence along the spin axis is multiplied by besides; with the nominal beam,
        twice as wide across that axis as along it, 2 is a round one.
    window : (2,) of float
        Full width of the beam where it leaves, across and along the spin axis [m].
    incidence : float
        Exponent of the cosine of incidence in an echo's energy: 0 without it, 1 for a matt surface.
    pick : Pick
        Which of several echoes of a pulse is recorded.
    gate : float
        Surfaces of a pulse that lie nearer than this behind one another are one echo at their
        energy-weighted mean [m]. 0.8: half a pulse of some 5 ns. With 0.05 an echo is one surface.
    range_half : float
        Distance at which a surface of reflectivity 0.1 is detected by even chance [m].
    softness : float
        Spread of the detection threshold, in the logarithm of the energy.
    sigma_weak : float
        Noise that the range of an echo at the threshold has besides that of a strong one; it
        falls with the energy of the echo [m].
    range_scale : float
        Relative error of all ranges.
    range_bias : float
        Error of all ranges, part of the true rig's range biases [m].
    dust : float
        Rate of echoes from dust along a beam [1/m].
    strays : float
        Share of pulses with a range that means nothing.
    """

    profile: Profile = Profile.EVEN
    divergence_scale: float = 1.0
    roundness: float = 1.0
    window: tuple[float, float] = (0.0, 0.0)
    incidence: float = 0.0
    pick: Pick = Pick.STRONGEST
    gate: float = 0.8
    range_half: float = 50.0
    softness: float = 0.15
    sigma_weak: float = 0.0
    range_scale: float = 0.0
    range_bias: float = 0.0
    dust: float = 0.0
    strays: float = 0.0

    @property
    def energy_half(self) -> float:
        """Reflectivity over squared range at an even chance of detection [1/m^2]."""
        return 0.10 / self.range_half**2


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulationConfig:
    """How the simulated rig moves and how well its sensors measure.

    Attributes
    ----------
    spin_rpm : float
        Revolutions of the LiDAR per minute. 600: the VLP-16's usual setting.
    turn : float
        Time in which the gimbal turns through 360 degrees [s]. 13.2: incommensurate with the 2
        degree pitch of the channels, so that scan lines do not fall on scan lines.
    sweep : float
        Angle that the gimbal turns through; half a turn shows one face of every object [rad].
    ripples : tuple of (float, float)
        Amplitude [rad] and periods in a turn of sines in the gimbal's angle.
    step : float
        Angle between the rests of a gimbal that steps instead of turning evenly; 0 turns evenly
        [rad]. The published scans are taken as having steps of 5 degrees. ``turn`` is
        then unused.
    rest_revolutions : int
        Revolutions of the LiDAR during each rest. 3: so that at least one whole message without
        pulse times lies well inside.
    move : float
        Time of the movement from one rest to the next [s]; the LiDAR runs on.
    shot_times : bool
        Whether each point carries its time; if not, all points of a revolution have its start.
    has_rings : bool
        Whether each point carries its laser.
    optics : Optics
        Footprint and echoes.
    sigma_range : float or None
        Noise of every range [m]; None stands for the noise by reflectivity that was measured on
        real packets of a VLP-16.
    sigma_laser_bias : float
        Spread of the lasers' own range biases, drawn once per rig [m]. 3 mm: after the maker's
        calibration; 10 mm have been seen.
    drop_out : float
        Probability that a return is lost for no reason. 0.005: seen in real packets.
    divergence : (2,) of float
        Full width of the evenly lit footprint across and along the spin axis [rad]. The maker's
        values for this family of sensors.
    range_step : float
        Quantisation of ranges [m]; 0 for none.
    azimuth_step : float
        Quantisation of azimuths [rad]; 0 for none.
    encoder_step : float
        Quantisation of the joint angle [rad]; 0 for none. A 16-bit encoder.
    sigma_encoder : float
        Jitter of the joint angle [rad].
    sigma_joint_stamp : float
        Jitter of the instants of joint samples, which the log does not show [s].
    joint_rate : float
        Joint samples and orientations in a second [Hz].
    sigma_eccentricity : float
        Spread of the two amplitudes of the encoder's eccentricity, unknown to the log [rad].
    sigma_ahrs_bias : float
        Error of roll and pitch that stays during a stop [rad]. 0.2 deg: data sheet of the
        MTi-G-710 for static use.
    sigma_ahrs_drift : float
        Spread of the rates at which roll, pitch and heading drift [rad/s].
    sigma_ahrs : float
        White noise of roll, pitch and heading [rad].
    sigma_tilt : float
        Spread of the rover's roll and pitch on the ground, cut at three times this [rad].
    sigma_misalignment : float
        Spread of the three small rotations of the LiDAR's mounting, unknown to the log [rad].
    axis_offset : (2,) of float
        Nominal place of the LiDAR's origin in the head frame, x and y [m]. Centimetres, as
        published.
    sigma_axis_offset : float
        Spread of the error of that place, unknown to the log [m].
    gimbal_clock_offset : float
        Added to a gimbal stamp to get the LiDAR's clock [s].
    imu_mount : ImuMount
        The part that carries the AHRS.
    only_near_spheres : bool
        Trace only beams that pass close by a sphere: quick, and sufficient for centres.
    """

    spin_rpm: float = 600.0
    turn: float = 13.2
    sweep: float = 2.0 * math.pi
    ripples: tuple[tuple[float, float], ...] = ()
    step: float = 0.0
    rest_revolutions: int = 3
    move: float = 0.1
    shot_times: bool = True
    has_rings: bool = True
    optics: Optics = Optics()
    sigma_range: float | None = None
    sigma_laser_bias: float = 0.003
    drop_out: float = 0.005
    divergence: tuple[float, float] = (3.0e-3, 1.5e-3)
    range_step: float = RANGE_STEP
    azimuth_step: float = float(AZIMUTH_STEP)
    encoder_step: float = 2.0 * math.pi / 65536
    sigma_encoder: float = math.radians(0.005)
    sigma_joint_stamp: float = 0.0
    joint_rate: float = 100.0
    sigma_eccentricity: float = math.radians(0.01)
    sigma_ahrs_bias: float = math.radians(0.2)
    sigma_ahrs_drift: float = 0.0
    sigma_ahrs: float = math.radians(0.05)
    sigma_tilt: float = math.radians(1.5)
    sigma_misalignment: float = math.radians(0.02)
    axis_offset: tuple[float, float] = (0.030, 0.020)
    sigma_axis_offset: float = 0.0005
    gimbal_clock_offset: float = 0.0
    imu_mount: ImuMount = ImuMount.BASE
    only_near_spheres: bool = False

    _BOUNDS: ClassVar[dict[str, tuple[float, float]]] = {
        "spin_rpm": (300.0, 1200.0),
        "turn": (0.5, 3600.0),
        "sweep": (0.1, 2.0 * math.pi),
        "step": (0.0, math.pi / 2),
        "rest_revolutions": (1, 1000),
        "move": (0.01, 10.0),
        "sigma_range": (0.0, 0.5),
        "sigma_laser_bias": (0.0, 0.1),
        "drop_out": (0.0, 0.95),
        "divergence": (0.0, 0.02),
        "range_step": (0.0, 0.1),
        "azimuth_step": (0.0, 0.02),
        "encoder_step": (0.0, 0.02),
        "sigma_encoder": (0.0, 0.02),
        "sigma_joint_stamp": (0.0, 0.1),
        "joint_rate": (1.0, 1000.0),
        "sigma_eccentricity": (0.0, 0.02),
        "sigma_ahrs_bias": (0.0, 0.2),
        "sigma_ahrs_drift": (0.0, 0.1),
        "sigma_ahrs": (0.0, 0.2),
        "sigma_tilt": (0.0, 0.2),
        "sigma_misalignment": (0.0, 0.05),
        "axis_offset": (-0.5, 0.5),
        "sigma_axis_offset": (0.0, 0.05),
        "gimbal_clock_offset": (-1.0, 1.0),
    }

    def __post_init__(self) -> None:
        for name, bounds in self._BOUNDS.items():
            value = getattr(self, name)
            is_pair = name in ("divergence", "axis_offset")
            if name == "sigma_range" and value is None:
                continue
            if is_pair and not (isinstance(value, tuple) and len(value) == 2):
                raise ConfigError(f"simulation.{name} is {value!r}; it must be two numbers.")
            for number in value if is_pair else (value,):
                _check(name, number, *bounds)
        if self.step and self.stepped_time > _LONGEST:
            raise ConfigError(
                f"Steps of {math.degrees(self.step):.3g} deg with {self.rest_revolutions} "
                f"revolutions at each rest take {self.stepped_time / 3600:,.1f} hours; "
                f"{_LONGEST / 3600:g} is the most. Take longer steps or fewer revolutions."
            )
        if self.imu_mount not in tuple(ImuMount):
            raise ConfigError(
                f"simulation.imu_mount is {self.imu_mount!r}; it must be one of "
                f"{[str(mount) for mount in ImuMount]}."
            )

    @property
    def stepped_time(self) -> float:
        """Return how long a turn with rests takes."""
        rest = self.rest_revolutions * 60.0 / self.spin_rpm
        return 2.0 * math.pi / self.step * (rest + self.move)

    @classmethod
    def perfect(cls, **changes: Any) -> Self:
        """Return a rig and sensor without any error, except for the named changes.

        Parameters
        ----------
        **changes : any
            Fields with other values.

        Returns
        -------
        SimulationConfig
            No noise, bias, drop-out or misalignment, thin beams and no quantisation.
        """
        zeros: dict[str, Any] = {
            field.name: 0.0
            for field in dataclasses.fields(cls)
            if field.name.startswith("sigma_") or field.name.endswith("_step")
        }
        return cls(**{**zeros, "drop_out": 0.0, "divergence": (0.0, 0.0), **changes})

    def to_mapping(self) -> dict[str, Any]:
        """Return the configuration as plain values.

        Returns
        -------
        dict
            By field.
        """
        return {**dataclasses.asdict(self), "imu_mount": str(self.imu_mount)}


def _check(name: str, value: object, low: float, high: float) -> None:
    """Raise ConfigError unless ``low <= value <= high``."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise ConfigError(
            f"simulation.{name} is {value!r}; it must be a number from {low:g} to {high:g}."
        )
