"""The study's own procedure: random arrangements, an error on every centre, pass or fail.

Marks are drawn round a station, errors are added to their centres (of random sign and fixed size,
as in the study, or by the model of centres), and the three circles that cut best give the position.
The station is taken as level, as in the study.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.errors import ConfigError
from spheremark.pipelines.model import Array, Index, Mask, same_length, seal
from spheremark.pipelines.placement.centre_model import CentreModel, centres_ahead
from spheremark.pipelines.positioning.trilateration import best_three, meet, meet_one
from spheremark.pipelines.threads import side_by_side

ARRANGEMENTS_MAX = 5_000_000
"""Most arrangements of one run."""

BINS_DEG = (0, 10, 20, 30, 40, 50, 60)
"""Edges of the classes of worst included angle [deg]; of three directions one pair is within 60."""

_HALF_HEIGHT = 0.3  # [m] by which centres stand above or below the LiDAR at most
_TABLE = 60  # distances at which the model of centres is tabulated
_FIRST, _THIRD = np.radians(105.0), np.radians(10.0)  # headings of the study's first and third mark


@dataclass(frozen=True, slots=True, kw_only=True)
class RandomPlanSpec:
    """Distribution of random arrangements and of their errors."""

    n_arrangements: int = 100_000  # number of arrangements
    # least and greatest number of marks; all numbers are equally frequent
    n_marks: tuple[int, int] = (3, 14)
    # nearest and farthest that a mark stands [m]. 7.5: the study's greatest distance.
    distances: tuple[float, float] = (2.0, 7.5)
    # window of included angles that the marks used must keep [rad]; 0 and pi allow all
    angles: tuple[float, float] = (0.0, float(np.pi))
    # size of the error on each axis of each centre, of random sign [m]. 0.017: the study's, 0.03 in
    # space; by default normal errors of the model of centres.
    error: float | None = 0.017
    tolerance: float = 0.03  # 3-D error that passes [m]
    seed: int = 0  # of the random numbers

    def __post_init__(self) -> None:
        if not 1 <= self.n_arrangements <= ARRANGEMENTS_MAX:
            raise ConfigError(
                f"{self.n_arrangements:,} arrangements; 1 to {ARRANGEMENTS_MAX:,} are possible."
            )
        low, high = self.n_marks
        if not 3 <= low <= high <= 40:
            raise ConfigError(f"{low} to {high} marks; three circles need 3, and 40 are the most.")
        if not 0.5 <= self.distances[0] < self.distances[1] <= 45.0:
            raise ConfigError(
                f"Distances from {self.distances[0]:g} to {self.distances[1]:g} m; they must "
                "ascend within 0.5 to 45 m."
            )
        if not 0.0 <= self.angles[0] < self.angles[1] <= np.pi + 1e-9:
            raise ConfigError(
                f"Included angles from {np.degrees(self.angles[0]):g} to "
                f"{np.degrees(self.angles[1]):g} deg; they must ascend within 0 to 180."
            )
        if self.tolerance <= 0 or (self.error is not None and not 0.0 < self.error <= 1.0):
            raise ConfigError("The tolerance and the error on each axis must be above 0 m.")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RandomPlanResults:
    """Result of each arrangement."""

    spec: RandomPlanSpec  # their distribution
    n_marks: Index  # (n,) marks of each arrangement
    # (n,) of the three marks used, the included angle that is farthest from a right one, as its
    # distance from 0 or 180 degrees, whichever is nearer; at most 90 [rad]
    worst_angles: Array
    errors_3d: Array  # (n,) 3-D error of each position [m]
    is_in_window: Mask  # (n,) whether the included angles of the three keep the window

    def __post_init__(self) -> None:
        names = ("n_marks", "worst_angles", "errors_3d", "is_in_window")
        seal(self, **dict.fromkeys(names, (None,)))
        same_length(self, *names)

    @property
    def passes(self) -> Mask:
        """Whether each position is within the tolerance."""
        return np.asarray(self.errors_3d <= self.spec.tolerance)


class PassRate(NamedTuple):
    """Pass rate of a class of arrangements."""

    low: float  # edges of the class: number of marks, or worst included angle [deg]
    high: float
    n: int  # arrangements in it
    share: float  # share of them that passes; NaN for none
    median: float  # median 3-D error [m]
    p95: float  # 95th percentile of the 3-D error [m]


def simulate_random_plans(
    spec: RandomPlanSpec, model: CentreModel | None = None
) -> RandomPlanResults:
    """Draw arrangements and position a station from each.

    Parameters
    ----------
    spec : RandomPlanSpec
        Distribution of arrangements and errors.
    model : CentreModel, optional
        Accuracy of centres; needed if the distribution has no error of its own.

    Returns
    -------
    RandomPlanResults
        One row per arrangement. Where no three marks keep the window of included angles, the three
        that cut best are used, and the row is marked.

    Raises
    ------
    ConfigError
        If neither the distribution nor a model gives the size of errors.

    Notes
    -----
    Places are even over the ring between the two distances, heights even within 0.3 m of the
    LiDAR's. Three circles of true radius about the wrong centres are intersected by least squares
    (from the true place); the height is the mean of theirs. Cost grows linearly with
    arrangements, and with the third power of marks for the choice of the three.
    """
    sigmas = _sigmas(spec, model)
    low, high = spec.n_marks
    n = spec.n_arrangements
    counts = np.random.default_rng(spec.seed).integers(low, high + 1, n)
    worst, errors, inside = np.empty(n), np.empty(n), np.empty(n, dtype=np.bool_)
    window = (np.cos(spec.angles[0]), np.cos(spec.angles[1]))

    def part(first: int, last: int) -> None:
        _simulate(
            np.random.default_rng([spec.seed, first]),
            (counts[first:last], spec.distances, window, spec.error or 0.0, sigmas),
            (worst[first:last], errors[first:last], inside[first:last]),
        )

    side_by_side(part, n, threaded_from=1_000)
    return RandomPlanResults(
        spec=spec,
        n_marks=counts.astype(np.intp),
        worst_angles=worst,
        errors_3d=errors,
        is_in_window=inside,
    )


def by_number(results: RandomPlanResults) -> tuple[PassRate, ...]:
    """Return the pass rate for each number of marks, of arrangements within the window.

    Parameters
    ----------
    results : RandomPlanResults
        All arrangements; those outside the window of angles do not count.

    Returns
    -------
    tuple of PassRate
        One for each number of marks.
    """
    low, high = results.spec.n_marks
    keep = results.is_in_window
    return tuple(
        _pass_rate(results, keep & (results.n_marks == k), k, k) for k in range(low, high + 1)
    )


def by_worst_angle(results: RandomPlanResults) -> tuple[PassRate, ...]:
    """Return the pass rate for each class of ``BINS_DEG``, of all arrangements.

    Parameters
    ----------
    results : RandomPlanResults
        All arrangements; each counts, so that the window shows.

    Returns
    -------
    tuple of PassRate
        One for each class of worst included angle.
    """
    angles = np.degrees(results.worst_angles)
    return tuple(
        _pass_rate(results, (angles >= a) & (angles < b), a, b) for a, b in pairwise(BINS_DEG)
    )


def _pass_rate(results: RandomPlanResults, keep: Mask, low: float, high: float) -> PassRate:
    """Return the pass rate of some arrangements."""
    errors = results.errors_3d[keep]
    if not len(errors):
        return PassRate(float(low), float(high), 0, np.nan, np.nan, np.nan)
    return PassRate(
        float(low),
        float(high),
        len(errors),
        float(np.mean(errors <= results.spec.tolerance)),
        float(np.median(errors)),
        float(np.quantile(errors, 0.95)),
    )


def errors_by_angle(angles: Array, error: float, distance: float) -> Array:
    """Return the error of a position against the included angle of its marks, as in the study.

    Parameters
    ----------
    angles : (n,)
        Included angles between the first and the second mark [rad].
    error : float
        Size of the error on each axis of each centre [m].
    distance : float
        Distance of the marks [m].

    Returns
    -------
    (n,)
        Median 3-D error over all 512 patterns of signs [m].

    Notes
    -----
    The first mark stands at a heading of 105 degrees, the third 10 degrees further, the height is
    off by the error of one axis: of the many readings of the study's Table 3 that were tried, this
    one gives its seven values within 2 mm (root mean square); plausible, not proven.
    """
    signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * 9)).reshape(9, -1).T.reshape(-1, 3, 3)
    out = []
    for angle in angles:
        off = three_circle_errors(marks_at_angle(float(angle), distance), error * signs)
        off[:, 2] = error
        out.append(np.median(np.linalg.norm(off, axis=1)))
    return np.array(out)


def marks_at_angle(angle: float, distance: float) -> Array:
    """Return the three marks of the study's Table 3 about a station at the origin.

    Parameters
    ----------
    angle : float
        Included angle between the first and the second mark [rad].
    distance : float
        Distance of the marks [m].

    Returns
    -------
    (3, 3)
        Marks at the height of the station [m].
    """
    headings = _FIRST + np.array([0.0, angle, _THIRD])
    flat = [np.cos(headings), np.sin(headings), np.zeros(3)]
    return np.asarray(distance * np.stack(flat, axis=1))


def three_circle_errors(marks_site: Array, errors: Array) -> Array:
    """Return the errors of a level station at the origin from three circles.

    Parameters
    ----------
    marks_site : (3, 3)
        True places of the marks; the radii of the circles come from these [m].
    errors : (n, 3, 3)
        Errors of the marks in each of n cases [m].

    Returns
    -------
    (n, 3)
        Estimate minus truth of the station [m].
    """
    measured = np.column_stack([np.hypot(marks_site[:, 0], marks_site[:, 1]), marks_site[:, 2]])
    n = len(errors)
    chosen, weights = np.arange(3 * n).reshape(n, 3), np.tile(np.eye(2), (3 * n, 1, 1))
    marks = (marks_site + errors).reshape(-1, 3)
    return meet(chosen, marks, np.tile(measured, (n, 1)), weights, np.zeros(3)).p


def _sigmas(spec: RandomPlanSpec, model: CentreModel | None) -> Array:
    """Return distances with sigmas towards, left and up there, (k, 4) [m]; one row for none."""
    if spec.error is not None:
        return np.zeros((1, 4))
    if model is None:
        raise ConfigError("Neither an error on each axis nor a model of centres was given.")
    distances = np.linspace(*spec.distances, _TABLE)
    _, variances = centres_ahead(model, distances)
    worst = np.nanmax(np.where(np.isfinite(variances), variances, np.nan), axis=0)
    return np.column_stack([distances, np.sqrt(np.where(np.isfinite(variances), variances, worst))])


@compiled
def _draw_errors(
    rng: np.random.Generator, p: Array, error: float, sigmas: Array, out: Array
) -> None:
    """Write the errors of three centres."""
    for i in range(3):
        if error > 0.0:
            for axis in range(3):
                out[i, axis] = error if rng.random() < 0.5 else -error
            continue
        flat = np.hypot(p[i, 0], p[i, 1])
        place = (flat - sigmas[0, 0]) / (sigmas[1, 0] - sigmas[0, 0])
        row = min(max(int(place + 0.5), 0), len(sigmas) - 1)
        towards, left = sigmas[row, 1] * rng.normal(), sigmas[row, 2] * rng.normal()
        ux, uy = p[i, 0] / flat, p[i, 1] / flat
        out[i, 0], out[i, 1] = towards * ux - left * uy, towards * uy + left * ux
        out[i, 2] = sigmas[row, 3] * rng.normal()


@compiled
def _simulate(rng: np.random.Generator, spec: tuple[Any, ...], out: tuple[Any, ...]) -> None:
    """Write worst angle, error and window of each arrangement."""
    counts, distances, window, error, sigmas = spec
    worst, errors, inside = out
    units, p, every = np.empty((64, 2)), np.empty((64, 3)), np.arange(3)
    used, off, found = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    three, measured, weights = np.zeros(3, np.intp), np.empty((3, 2)), np.zeros((3, 2, 2))
    weights[:, 0, 0] = weights[:, 1, 1] = 1.0
    near2, far2 = distances[0] ** 2, distances[1] ** 2
    for i in range(len(counts)):
        n = counts[i]
        for m in range(n):
            bearing = 2.0 * np.pi * rng.random()
            d = np.sqrt(near2 + (far2 - near2) * rng.random())
            units[m, 0], units[m, 1] = np.cos(bearing), np.sin(bearing)
            p[m, 0], p[m, 1] = d * units[m, 0], d * units[m, 1]
            p[m, 2] = _HALF_HEIGHT * (2.0 * rng.random() - 1.0)
        _, inside[i] = best_three(units[:n], window[1], window[0], three)
        low = 1.0
        for a in range(3):
            for axis in range(3):
                used[a, axis] = p[three[a], axis]
            for b in range(a):
                u, v = units[three[a]], units[three[b]]
                low = min(low, abs(u[0] * v[1] - u[1] * v[0]))
        worst[i] = np.arcsin(min(low, 1.0))
        _draw_errors(rng, used, error, sigmas, off)
        for a in range(3):
            measured[a, 0], measured[a, 1] = np.hypot(used[a, 0], used[a, 1]), used[a, 2]
            found[a] = 0.0
        meet_one(every, used + off, measured, weights, found)
        errors[i] = np.sqrt(found[0] ** 2 + found[1] ** 2 + found[2] ** 2)
