"""Every scientific knob: unit, default and reason; canonical text and digest.

A configuration is part of a result: two runs with the same recording, configuration and code give
the same numbers. Unknown keys and values out of range are refused.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self, TypeVar, get_type_hints

from spheremark.pipelines.errors import ConfigError

FITTING_METHODS = (
    "along_beam",
    "silhouette",
    "astm_e3125",
    "free_radius",
    "algebraic",
    "paper",
)
PAPER_MODELS = ("hemisphere", "sphere")
PAPER_CUTS = ("equator", "ground")
RESECTION_METHODS = ("free_station", "ranges", "paper")

_T = TypeVar("_T")


def _check(name: str, value: object, low: float, high: float) -> None:
    """Raise ConfigError unless ``low <= value <= high``."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise ConfigError(f"{name} is {value!r}; it must be a number from {low} to {high}.")


def _check_choice(name: str, value: object, known: tuple[str, ...]) -> None:
    """Raise ConfigError unless the value is one of the known ones."""
    if value not in known:
        raise ConfigError(f"{name} is {value!r}; it must be one of {list(known)}.")


def _check_methods(name: str, methods: tuple[str, ...], known: tuple[str, ...]) -> None:
    """Raise ConfigError unless the methods are known, different and at least one."""
    unknown = [method for method in methods if method not in known]
    if unknown or not methods or len(set(methods)) < len(methods):
        raise ConfigError(
            f"{name} is {list(methods)!r}; it must name one or more of {list(known)}, each once."
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class StitchingConfig:
    """How a log becomes points in the base frame.

    Attributes
    ----------
    range_min : float
        Returns nearer than this are the rover itself [m]: they are left out, and do not show what
        is behind them. 0.9: the VLP-16's own minimum.
    range_max : float
        Returns farther than this are not used [m]. 100: the VLP-16's own maximum.
    sigma_levelling : float
        Standard deviation of the AHRS's roll and pitch [rad]. 0.2 deg: data sheet of the
        MTi-G-710 for static use.
    sigma_clock : float
        Standard deviation of the gimbal's stamps on the LiDAR's clock, which the heading of a
        station carries: at an even speed an offset turns all centres alike, and nothing shows it
        [s]. 0.03: a stamp anywhere in a revolution of 0.1 s. Sensors that share a clock have less.
    rest : float
        A rest of the gimbal, or a gap, longer than this ends a stop once the gimbal has turned by
        half a turn [s]. 3: longer than any step of a step-and-shoot scan.
    """

    range_min: float = 0.9
    range_max: float = 100.0
    sigma_levelling: float = math.radians(0.2)
    sigma_clock: float = 0.03
    rest: float = 3.0

    def __post_init__(self) -> None:
        _check("stitching.range_min", self.range_min, 0.0, 10.0)
        _check("stitching.range_max", self.range_max, 1.0, 300.0)
        _check("stitching.sigma_levelling", self.sigma_levelling, 1e-6, 0.5)
        _check("stitching.sigma_clock", self.sigma_clock, 0.0, 1.0)
        _check("stitching.rest", self.rest, 0.1, 600.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class ExtractionConfig:
    """How markers are distinguished from ground, poles and rocks.

    Attributes
    ----------
    ground_cell : float
        Edge of a cell of the ground grid [m]. 0.25: wider than a ball, so that a cell of the open
        field holds ground.
    ground_clearance : float
        Returns less than this above the local ground start no marker [m]. Where the radius of the
        markers is smaller, it takes the place of this, but at least half of this does. 0.20: most
        rocks are lower, and the balls of a survey stand higher, or show their upper half.
    scatter_max : float
        The first guess of the noise of ranges is at most this [m]. 0.035: the maker's 0.03 and its
        uncertainty.
    n_points_min : int
        A group with fewer returns is not looked at. 6: twice the unknowns of a centre.
    false_rate : float
        Accepted mean number of false markers in a scan. Groups are markers, the surest first, while
        their probabilities of being none add up to at most this. Others whose probability is 0.9 or
        more are possible markers. 0.01: one false marker in a hundred scans if the
        probabilities hold; the page of methods says how many more there were among many decoys.
    range_max : float
        Markers are not searched for beyond this distance [m]. 100: as far as the sensor measures;
        ``n_points_min`` limits smaller spheres to less, those of 0.1 m to 35 m in a usual turn.
    """

    ground_cell: float = 0.25
    ground_clearance: float = 0.20
    scatter_max: float = 0.035
    n_points_min: int = 6
    false_rate: float = 0.01
    range_max: float = 100.0

    def __post_init__(self) -> None:
        _check("extraction.ground_cell", self.ground_cell, 0.05, 2.0)
        _check("extraction.ground_clearance", self.ground_clearance, 0.02, 2.0)
        _check("extraction.scatter_max", self.scatter_max, 0.001, 0.1)
        _check("extraction.n_points_min", self.n_points_min, 4, 1000)
        _check("extraction.false_rate", self.false_rate, 1e-9, 0.5)
        _check("extraction.range_max", self.range_max, 1.0, 300.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class FittingConfig:
    """How a candidate becomes a centre.

    Attributes
    ----------
    methods : tuple of str
        Fitting methods to run, of ``FITTING_METHODS``; the first is the one that counts. Ours and
        the study's: the others cost time and are asked for by name.
    sigma_range_bias : float
        Standard deviation of what each laser measures too long, before the scan is seen [m].
        0.003: what remains of the maker's bound of 0.03 after its own calibration.
    sigma_direction : float
        Standard deviation of a beam's direction per axis [rad]. 1e-4: azimuth in steps of 0.01 deg,
        encoder and timing.
    sigma_mounting : float
        Standard deviation of the directions in which LiDAR and gimbal sit, per axis [rad]. 3.5e-4:
        0.02 deg, good workmanship. It parts the two faces of the scan.
    sigma_offset : float
        Standard deviation of where the LiDAR sits on the gimbal, per axis [m].
    sigma_gimbal_clock : float
        Standard deviation of the offset of the gimbal's clock [s]. 0.003: what encoders and their
        drivers are late. It moves what is seen while the gimbal turns against what is seen while it
        rests, or turns faster or slower.
    sigma_beam_width : float
        Standard deviation of the beam's divergence, relative to the rig's. 0.35: sources for one
        sensor differ by a factor of two; makers give contours of different energy.
    sigma_beam_window : float
        Standard deviation of the beam's width at the window, relative to the 12.7 x 9.5 mm of a
        VLP-16; the rig assumes none.
    sigma_echo_cosine : float
        Standard deviation of the power of the cosine of incidence with which a part of the
        footprint weighs in the range of its echo. 0 is even; 1 is the energy of a matt surface.
    sigma_range_common : float
        Standard deviation of what all lasers measure too long in common [m]. 0.0034: what the
        maker's 0.03, as three sigma, leaves beside noise of 0.0089 and ``sigma_range_bias``; where
        the lasers of a scan differ by more than that it grows with them.
    sigma_range_scale : float
        Standard deviation of the scale of all ranges, relative. 1e-4: the maker's 0.03 m at 100 m,
        as three sigma.
    paper_model : str
        What ``paper`` registers to the returns, of ``PAPER_MODELS``. hemisphere: as the study does;
        its Figure 3 shows the whole sphere instead.
    paper_cut : str
        What ``paper`` cuts away, of ``PAPER_CUTS``. equator: the lower half of each sphere, so that
        the hemisphere is left that the study shows before its fit; its errors are then those of its
        Table 2. ground: what lies below the highest ground point of this scan, as the study says
        in words; how much of a sphere that costs depends on the ground, and its errors are about
        half of those that it publishes.
    """

    methods: tuple[str, ...] = ("along_beam", "paper")
    sigma_range_bias: float = 0.003
    sigma_direction: float = 1e-4
    sigma_mounting: float = 3.5e-4
    sigma_offset: float = 5e-4
    sigma_gimbal_clock: float = 0.003
    sigma_beam_width: float = 0.35
    sigma_beam_window: float = 0.5
    sigma_echo_cosine: float = 0.7
    sigma_range_common: float = 0.0034
    sigma_range_scale: float = 1e-4
    paper_model: str = "hemisphere"
    paper_cut: str = "equator"

    def __post_init__(self) -> None:
        _check_methods("fitting.methods", self.methods, FITTING_METHODS)
        _check("fitting.sigma_range_bias", self.sigma_range_bias, 1e-6, 0.05)
        _check("fitting.sigma_direction", self.sigma_direction, 0.0, 0.01)
        _check("fitting.sigma_mounting", self.sigma_mounting, 0.0, 0.1)
        _check("fitting.sigma_offset", self.sigma_offset, 0.0, 0.1)
        _check("fitting.sigma_gimbal_clock", self.sigma_gimbal_clock, 0.0, 0.1)
        _check("fitting.sigma_beam_width", self.sigma_beam_width, 0.0, 1.0)
        _check("fitting.sigma_beam_window", self.sigma_beam_window, 0.0, 2.0)
        _check("fitting.sigma_echo_cosine", self.sigma_echo_cosine, 0.0, 2.0)
        _check("fitting.sigma_range_common", self.sigma_range_common, 0.0, 0.1)
        _check("fitting.sigma_range_scale", self.sigma_range_scale, 0.0, 0.01)
        _check_choice("fitting.paper_model", self.paper_model, PAPER_MODELS)
        _check_choice("fitting.paper_cut", self.paper_cut, PAPER_CUTS)


@dataclass(frozen=True, slots=True, kw_only=True)
class ResectionConfig:
    """How markers and control marks become a position.

    Attributes
    ----------
    methods : tuple of str
        Resection methods to run, of ``RESECTION_METHODS``; the first is the one that counts.
        free_station: it uses all three coordinates of each centre.
    subset_methods : tuple of str
        Methods by which the station is positioned from each pair and each triple of its markers
        too, to show what the included angle does. Ours and the study's.
    match_tolerance : float
        A marker farther than this from every control mark is a false one [m].
    test_level : float
        Probability with which the global test and the w-tests reject good data.
    test_power : float
        Probability with which a bias of the minimal detectable size is found.
    sigma_common : float
        Standard deviation per axis that every centre has beyond its own covariance: what changes
        from one direction to the next and both faces share, as the jitter of the encoder [m].
    sigma_range : float
        Standard deviation of the common range bias, an unknown of a network [m]; 0 leaves it out.
        3.5 mm: ``fitting.sigma_range_common``, and the mean of 16 lasers of 3 mm each.
    sigma_range_scale : float
        Standard deviation of the scale of all ranges, an unknown of a network; 0 leaves it out.
        1e-4, as in ``fitting``.
    sigma_range_shared : float
        Part of ``sigma_range`` that the covariance of each centre already contains, for fits that
        do not report it (``along_beam`` does, from the biases that it estimates) [m]. 0.9 mm: the
        mean of the 16 lasers that see a sphere, of 3 mm each, by simulation. At most about half of
        a centre's variance along its line of sight counts as shared.
    sigma_height : float
        Standard deviation of what all centres of a survey are too high, as the foot of their poles
        and the tilt of the spin axis leave [m]; 0 leaves it out. 0.2 mm, by simulation of beams
        of several profiles: what stands behind the lower half of spheres moves its limb.
    false_rate : float
        Wanted share of false ones among the marks of a network. 0.01: a mark is confirmed where the
        probability that it is none, by all stations that should see it, is at most this.
    """

    methods: tuple[str, ...] = ("free_station",)
    subset_methods: tuple[str, ...] = ("free_station", "paper")
    match_tolerance: float = 0.15
    test_level: float = 0.001
    test_power: float = 0.80
    sigma_common: float = 0.00005
    sigma_range: float = 0.0035
    sigma_range_scale: float = 1e-4
    sigma_range_shared: float = 0.0009
    sigma_height: float = 0.0002
    false_rate: float = 0.01

    def __post_init__(self) -> None:
        _check_methods("resection.methods", self.methods, RESECTION_METHODS)
        _check_methods("resection.subset_methods", self.subset_methods, RESECTION_METHODS)
        _check("resection.match_tolerance", self.match_tolerance, 0.01, 2.0)
        _check("resection.test_level", self.test_level, 1e-6, 0.2)
        _check("resection.test_power", self.test_power, 0.5, 0.999)
        _check("resection.sigma_common", self.sigma_common, 0.0, 0.1)
        _check("resection.sigma_range", self.sigma_range, 0.0, 0.1)
        _check("resection.sigma_range_scale", self.sigma_range_scale, 0.0, 0.01)
        _check("resection.sigma_range_shared", self.sigma_range_shared, 0.0, 0.1)
        _check("resection.sigma_height", self.sigma_height, 0.0, 0.1)
        _check("resection.false_rate", self.false_rate, 1e-9, 0.5)


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyConfig:
    """All of it.

    Attributes
    ----------
    marker_radius : float
        Radius of the spheres [m].
    tolerance : float
        Error that a user accepts [m]. 0.03: the study's requirement.
    stitching : StitchingConfig
        How a log becomes points.
    extraction : ExtractionConfig
        How markers are found.
    fitting : FittingConfig
        How centres are estimated.
    resection : ResectionConfig
        How the station is positioned.
    """

    marker_radius: float = 0.100
    tolerance: float = 0.03
    stitching: StitchingConfig = field(default_factory=StitchingConfig)
    extraction: ExtractionConfig = field(default_factory=ExtractionConfig)
    fitting: FittingConfig = field(default_factory=FittingConfig)
    resection: ResectionConfig = field(default_factory=ResectionConfig)

    def __post_init__(self) -> None:
        _check("marker_radius", self.marker_radius, 0.01, 3.0)
        _check("tolerance", self.tolerance, 1e-4, 1.0)

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> Self:
        """Build a configuration from nested mappings, with defaults for what is not named.

        Parameters
        ----------
        values : mapping
            Nested as in ``to_mapping``; any key may be missing.

        Returns
        -------
        SurveyConfig
            The configuration.

        Raises
        ------
        ConfigError
            If a key is unknown or a value is out of range.
        """
        return _build(cls, values, "")

    def to_mapping(self) -> dict[str, Any]:
        """Return the configuration as nested dictionaries of plain values."""
        return dataclasses.asdict(self)

    @property
    def text(self) -> str:
        """Canonical text: JSON with sorted keys."""
        return json.dumps(self, default=_values_of, sort_keys=True, separators=(",", ":"))

    @property
    def digest(self) -> str:
        """First 16 hexadecimal digits of the SHA-256 of the canonical text."""
        return digest_of(self.text)


def _values_of(section: Any) -> dict[str, Any]:
    """Return the values of a section by name, not copied as ``dataclasses.asdict`` does."""
    return {one.name: getattr(section, one.name) for one in dataclasses.fields(section)}


def digest_of(text: str) -> str:
    """Return what names a canonical text: 16 hexadecimal digits.

    Parameters
    ----------
    text : str
        The text.

    Returns
    -------
    str
        Start of its SHA-256.
    """
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _build(kind: type[_T], values: object, path: str) -> _T:
    """Build one configuration dataclass from a mapping, recursively."""
    if not isinstance(values, Mapping):
        raise ConfigError(f"{path or 'The configuration'} is {values!r}; it must be an object.")
    prefix = f"{path}." if path else ""
    types = get_type_hints(kind)
    unknown = [key for key in values if key not in types]
    if unknown:
        raise ConfigError(f"{prefix}{unknown[0]} is unknown; known here: {', '.join(types)}.")
    arguments = {key: _plain(types[key], value, f"{prefix}{key}") for key, value in values.items()}
    return kind(**arguments)


def _plain(expected: Any, value: object, path: str) -> object:
    """Bring one value of a mapping to the type that the field declares."""
    if dataclasses.is_dataclass(expected) and isinstance(expected, type):
        return _build(expected, value, path)
    if expected == tuple[str, ...]:
        if isinstance(value, str) or not isinstance(value, Sequence):
            raise ConfigError(f"{path} is {value!r}; it must be a list of names.")
        return tuple(value)
    if expected is int and not isinstance(value, int):
        raise ConfigError(f"{path} is {value!r}; it must be a whole number.")
    if expected is float and isinstance(value, int):
        try:
            return float(value)
        except OverflowError as error:
            raise ConfigError(
                f"{path} is a whole number beyond 1.8e308; it is too large."
            ) from error
    return value
