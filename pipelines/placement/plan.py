"""The types of a plan: site, stops, marks, requirement, and the evaluation.

Lengths are in the site frame, z up.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from spheremark.pipelines.config import ResectionConfig
from spheremark.pipelines.errors import ConfigError, InputError
from spheremark.pipelines.model import Array, Index, Mask, same_length, seal
from spheremark.pipelines.simulation.scene import Mesh

PLAN_METHODS = ("free_station", "paper")
"""Positioning methods whose accuracy can be predicted."""

_LIMITS: dict[str, tuple[float, float]] = {
    "tolerance": (1e-5, 10.0),
    "sigma_marks": (0.0, 1.0),
    "sigma_levelling": (1e-6, 0.5),
    "n_points_min": (1.0, 10_000.0),
    "share_min": (0.0, 1.0),
    "occlusion": (0.0, 0.9),
}


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Site:
    """The ground on which a survey takes place, and what stands on it.

    Attributes
    ----------
    name : str
        Origin, for people.
    xs, ys : (n,), (m,)
        Lines of an even grid, ascending [m].
    ground : (m, n)
        Height of the ground, rows along y; NaN where it is not known [m].
    surface : (m, n)
        Height of the highest thing that hides what is behind it, rocks and walls included; at least
        that of the ground [m].
    keep_out : tuple of (k, 2)
        Corners of polygons where no mark may stand [m].
    pole_heights : tuple of float
        Least and greatest height of a sphere's centre above the ground [m].
    marker_radius : float
        Radius of the spheres [m].
    pole_radius : float
        Radius of the poles that carry them [m].
    mast : float
        Height of the LiDAR above the ground, unless a stop has its own [m].
    bodies : Mesh, optional
        Surfaces of everything that hides, if known better than on the grid.
    """

    name: str
    xs: Array
    ys: Array
    ground: Array
    surface: Array
    keep_out: tuple[Array, ...] = ()
    pole_heights: tuple[float, float] = (0.6, 1.5)
    marker_radius: float = 0.100
    pole_radius: float = 0.015
    mast: float = 1.05
    bodies: Mesh | None = None

    def __post_init__(self) -> None:
        shape = (len(self.ys), len(self.xs))
        seal(self, xs=(None,), ys=(None,), ground=shape, surface=shape)
        for polygon in self.keep_out:
            polygon.flags.writeable = False
        if min(shape) < 2:
            raise InputError(f"The terrain has {shape[1]} x {shape[0]} nodes; 2 x 2 are needed.")
        low, high = self.pole_heights
        if not 0.0 < low <= high <= 20.0:
            raise ConfigError(
                f"Poles of {low:g} to {high:g} m: the least height of a centre must be above 0 and "
                "not above the greatest, and that not above 20 m."
            )

    @property
    def cell(self) -> float:
        """Spacing of the grid [m]."""
        return float(self.xs[1] - self.xs[0])

    def ground_at(self, p_site: Array) -> Array:
        """Return the height of the ground under points, bilinear; NaN where it is not known [m]."""
        return bilinear(self, self.ground, p_site)


def bilinear(site: Site, grid: Array, p_site: Array) -> Array:
    """Return the values of one of a site's grids at points."""
    u = (p_site[..., 0] - site.xs[0]) / (site.xs[1] - site.xs[0])
    v = (p_site[..., 1] - site.ys[0]) / (site.ys[1] - site.ys[0])
    n_y, n_x = grid.shape
    slack = 1e-9 * max(n_x, n_y)  # a node on the edge lies on the grid
    is_off = (u < -slack) | (v < -slack) | (u > n_x - 1 + slack) | (v > n_y - 1 + slack)
    is_off = is_off | ~np.isfinite(u + v)
    u, v = (np.where(is_off, 0.0, w) for w in (u, v))
    i = np.clip(np.floor(u).astype(np.intp), 0, n_x - 2)
    j = np.clip(np.floor(v).astype(np.intp), 0, n_y - 2)
    u, v = np.clip(u - i, 0.0, 1.0), np.clip(v - j, 0.0, 1.0)
    low = (1 - u) * grid[j, i] + u * grid[j, i + 1]
    high = (1 - u) * grid[j + 1, i] + u * grid[j + 1, i + 1]
    return np.asarray(np.where(is_off, np.nan, (1 - v) * low + v * high))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Stops:
    """Stops: positions of the LiDAR."""

    names: tuple[str, ...]  # unique
    p_site: Array  # (s, 3) origins of the base: on the gimbal's axis at the height of the LiDAR [m]
    # (s,) azimuths of base [rad]: where a sweep of less than a full turn begins; by default along x
    headings: Array | None = None

    def __post_init__(self) -> None:
        seal(self, p_site=(None, 3))
        same_length(self, "names", "p_site")
        if self.headings is not None:
            seal(self, headings=(len(self.names),))
        _refuse_doubles("stops", self.names)

    def rows(self, keep: Index | Mask) -> Self:
        """Return some of the stops, by index or mask."""
        places = np.arange(len(self.names))[keep]
        return replace(
            self,
            names=tuple(self.names[k] for k in places),
            p_site=self.p_site[places].copy(),
            headings=None if self.headings is None else self.headings[places].copy(),
        )


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Arrangement:
    """Marks that stand, or might stand, on a site."""

    names: tuple[str, ...]  # unique
    p_site: Array  # (n, 3) centres of the spheres [m]

    def __post_init__(self) -> None:
        seal(self, p_site=(None, 3))
        same_length(self, "names", "p_site")
        _refuse_doubles("marks", self.names)

    @classmethod
    def numbered(cls, p_site: Array) -> Self:
        """Return marks named P01, P02 and so on."""
        names = tuple(f"P{k + 1:02d}" for k in range(len(p_site)))
        return cls(names=names, p_site=np.array(p_site, dtype=np.float64))

    def rows(self, keep: Index | Mask) -> Self:
        """Return some of the marks, by index or mask."""
        places = np.arange(len(self.names))[keep]
        return replace(
            self, names=tuple(self.names[k] for k in places), p_site=self.p_site[places].copy()
        )


def _refuse_doubles(what: str, names: tuple[str, ...]) -> None:
    """Raise InputError if a name occurs twice."""
    name, n = Counter(names).most_common(1)[0] if names else ("", 0)
    if n > 1:
        raise InputError(f"Two {what} are called {name!r}; each needs a name of its own.")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Requirement:
    """Required accuracy of positions, and how they will be determined.

    Attributes
    ----------
    tolerance : float
        3-D error that is accepted [m].
    method : str
        One of ``PLAN_METHODS``.
    sigma_marks : float
        Standard deviation per axis with which the marks themselves are known [m].
    sigma_levelling : float
        Standard deviation of roll and of pitch [rad].
    n_points_min : float
        Returns that a sphere needs to be found. 20: with fewer detection begins to miss some.
    share_min : float
        Share of a sphere that must be seen for it to be found. 0.5: with less detection finds
        every second one.
    occlusion : float
        Probability that people or vehicles that pass hide a mark from a stop during its scan.
    resection : ResectionConfig
        Levels of the tests, and what every centre has beyond its own covariance.
    """

    tolerance: float = 0.03
    method: str = "free_station"
    sigma_marks: float = 0.0
    sigma_levelling: float = float(np.radians(0.2))
    n_points_min: float = 20.0
    share_min: float = 0.5
    occlusion: float = 0.0
    resection: ResectionConfig = field(default_factory=ResectionConfig)

    def __post_init__(self) -> None:
        for name, (low, high) in _LIMITS.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise ConfigError(f"{name} is {value!r}; it must be a number from {low} to {high}.")
        if self.method not in PLAN_METHODS:
            raise ConfigError(
                f"The accuracy of {self.method!r} cannot be predicted; known are "
                f"{', '.join(PLAN_METHODS)}."
            )


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Visibility:
    """Visible part of each mark from each station."""

    # (s, n, c) float32 for each upright strip of the sphere's disc, from left to right, the height
    # above the centre above which it is visible, in units of half the disc's height: -1 all of it,
    # 1 nothing
    lowest: np.ndarray
    # (s, n) float32 from the centre on to the surface behind it, or down to ground that it touches;
    # infinite where none is near [m]
    gaps: np.ndarray

    def __post_init__(self) -> None:
        seal(self, lowest=(None, None, None), gaps=self.lowest.shape[:2])

    @classmethod
    def open(cls, n_stations: int, n_marks: int, n_strips: int) -> Self:
        """Return the visibility of marks with nothing before or behind them."""
        return cls(
            lowest=np.full((n_stations, n_marks, n_strips), -1.0, np.float32),
            gaps=np.full((n_stations, n_marks), np.inf, np.float32),
        )

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Return the visibility of the marks of several parts, from the same stations."""
        return cls(
            lowest=np.concatenate([one.lowest for one in parts], axis=1),
            gaps=np.concatenate([one.gaps for one in parts], axis=1),
        )

    def rows(self, keep: Index | Mask) -> Self:
        """Return the visibility of some of the marks, by index or mask."""
        return replace(self, lowest=self.lowest[:, keep].copy(), gaps=self.gaps[:, keep].copy())


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Evaluation:
    """Predicted accuracy of an arrangement at each stop.

    Attributes
    ----------
    stops : Stops
        The stops.
    marks : Arrangement
        The marks.
    requirement : Requirement
        The requirement.
    version, source : str
        Which model of centres was used: its digest, and ``sensor`` or ``fitted``.
    is_seen : (s, n)
        Whether a mark is visible and near enough to be found from a stop.
    found : (s, n)
        Probability that it is found: detected, and not hidden by what passes.
    shares : (s, n)
        Share of a sphere's disc that nothing hides, 0 to 1.
    gaps : (s, n)
        From centres on to the surface behind them, or down to ground that they touch; infinite
        where none is near [m].
    ranges : (s, n)
        Distances from stops to centres [m].
    n_points : (s, n)
        Expected returns.
    cov_p_site : (s, 3, 3)
        Covariance of each position; infinite on the diagonal where there is none [m^2].
    cov_motion : (s, 6, 6)
        Covariance of a small motion of the station about its own place, rotation [rad] and
        translation [m], in the axes of the site; infinite on the diagonal where there is none.
    sigma_3d : (s,)
        Square root of the trace of ``cov_p_site``; infinite where there is no position [m].
    rms_3d : (s,)
        RMS of the 3-D error over which marks are found, by three or more where so many are seen;
        ``sigma_3d`` is by the mean information, which is less with few marks [m].
    probability : (s,)
        Probability that the 3-D error is within the tolerance; 0 where there is no position.
    angles : (s, 2)
        Least and greatest included angle between two used marks; 0 with fewer than two [rad].
    dop : (s,)
        Dilution of precision: 3-D sigma of the position of a levelled station for centres that have
        a standard deviation of 1 on each axis; infinite where there is none.
    n_used : (s,)
        Marks that carry the position: all that are found, or the three whose circles cut best.
    dof : (s,)
        Observations minus unknowns; 0 also where there are too few.
    redundancies : (s, n)
        Redundancy of each mark's coordinates together, 0 to 3; 0 for a mark that is not used.
    detectable_biases : (s, n)
        Minimal detectable bias along each mark's weakest axis; infinite where none is [m].
    external_reliabilities : (s, n)
        Largest shift of the position by a bias of that size; infinite where none is found [m].
    reasons : tuple of str
        Why a stop has no position, or a weak one; empty otherwise.
    """

    stops: Stops
    marks: Arrangement
    requirement: Requirement
    version: str
    source: str
    is_seen: Mask
    found: Array
    shares: Array
    gaps: Array
    ranges: Array
    n_points: Array
    cov_p_site: Array
    cov_motion: Array
    sigma_3d: Array
    rms_3d: Array
    probability: Array
    angles: Array
    dop: Array
    n_used: Index
    dof: Index
    redundancies: Array
    detectable_biases: Array
    external_reliabilities: Array
    reasons: tuple[str, ...]

    def __post_init__(self) -> None:
        s, n = len(self.stops.names), len(self.marks.names)
        seal(
            self,
            **dict.fromkeys(("is_seen", "found", "shares", "gaps", "ranges", "n_points"), (s, n)),
        )
        pairs = ("redundancies", "detectable_biases", "external_reliabilities")
        seal(self, **dict.fromkeys(pairs, (s, n)))
        seal(self, **dict.fromkeys(("sigma_3d", "rms_3d", "probability"), (s,)))
        seal(self, **dict.fromkeys(("dop", "n_used", "dof"), (s,)))
        seal(self, cov_p_site=(s, 3, 3), cov_motion=(s, 6, 6), angles=(s, 2))

    @property
    def worst_sigma_3d(self) -> float:
        """Largest 3-D sigma over all stops [m]."""
        return float(self.sigma_3d.max())

    @property
    def worst_probability(self) -> float:
        """Smallest probability over all stops."""
        return float(self.probability.min())


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class FieldMap:
    """Predicted accuracy of an arrangement on a grid of places."""

    xs: Array  # (n,), (m,) lines of the grid [m]
    ys: Array
    # (m, n) 3-D sigma of a position there, rows along y; NaN where there is none [m]
    sigma_3d: Array
    # (m, n) probability that its 3-D error is within the tolerance; NaN where there is no position
    probability: Array
    n_seen: Index  # (m, n) marks that will be found from there; 0 where the ground is not known
    is_seen: Mask  # (m, n, k) which these are

    def __post_init__(self) -> None:
        shape = (len(self.ys), len(self.xs))
        seal(self, xs=(None,), ys=(None,), sigma_3d=shape, probability=shape, n_seen=shape)
        seal(self, is_seen=(*shape, None))
