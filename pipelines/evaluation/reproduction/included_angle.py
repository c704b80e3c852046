"""The study's experiment with the station again: errors granted to marks, by included angle.

Two marks stand 7.5 m away at the included angle, a third beside them, and each axis of each centre
is off by 17 mm. How the signs are chosen and where the third mark stands the study does not say.
This reading was found by comparing with its Table 3: signs at random, the median over all of them,
the first mark at a heading of 105 degrees, the third 10 degrees beside it, and 17 mm of height in
the norm. Many readings were tried: it is plausible, not proven.

The circles' radii come from the known position, as in the study. The same centres, with the same
errors, are then given to the free station, whose code is that of every survey.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from spheremark.pipelines.model import Array, seal
from spheremark.pipelines.positioning.matching import Scene, solve_poses
from spheremark.pipelines.positioning.subsets import angles_that_keep
from spheremark.pipelines.positioning.trilateration import meet
from spheremark.pipelines.published import GRANTED_DISTANCE, GRANTED_ERROR, TABLE_3

CIRCLES, PAIR, TRIPLE = "three circles", "two centres", "three centres"
"""Ways to position the station from the same marks."""

_FIRST, _BESIDE = np.radians([105.0, 10.0])  # heading of the first mark, and of the third from it
_SIGMA_UP = np.radians(0.2)  # of the AHRS; matters for heights alone here
_SHOWN = 3  # place in Table 3 whose circles are drawn
_SIGMAS = np.array([0.002, 0.005, 0.010, 0.015, 0.017, 0.020, 0.025, 0.028])  # [m]
_N_DRAWS = 4000  # RMS good to a hundredth


@dataclass(frozen=True, slots=True, kw_only=True)
class Table3Row:
    """Error of the station at one of the study's angles.

    Attributes
    ----------
    included_angle : float
        Between the two marks [rad].
    published : float
        Error that the study prints [m].
    errors : mapping of str to float
        Median over the signs by ``CIRCLES``, ``PAIR`` and ``TRIPLE`` [m].
    """

    included_angle: float
    published: float
    errors: dict[str, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class AngleLimit:
    """From which included angle on two marks keep the tolerance.

    Attributes
    ----------
    sigma : float
        Standard deviation of a centre per axis [m].
    least : float
        By theory of 3-D centres; the largest is 180 degrees [rad].
    least_circles, widest_circles : float
        By theory of two circles; NaN where none keeps it [rad].
    rms : float
        Horizontal error that the free station's code has at ``least``, over random errors [m].
    """

    sigma: float
    least: float
    least_circles: float
    widest_circles: float
    rms: float


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Arcs:
    """The three circles of one pattern of signs (the study's Figure 4); the true station is zero.

    Attributes
    ----------
    included_angle : float
        Between the first two marks [rad].
    marks_site, shifted_site : (3, 2)
        True places of the marks, and with the errors that were granted [m].
    radii : (3,)
        Of the circles about the shifted marks [m].
    p_site : (2,)
        Where they meet best [m].
    """

    included_angle: float
    marks_site: Array
    shifted_site: Array
    radii: Array
    p_site: Array

    def __post_init__(self) -> None:
        seal(self, marks_site=(3, 2), shifted_site=(3, 2), radii=(3,), p_site=(2,))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class AngleExperiment:
    """The controlled experiment: Table 3, Figures 4 and 10, and what limits the angle.

    Attributes
    ----------
    tolerance : float
        Error that is accepted [m].
    rows : tuple of Table3Row
        At the study's angles.
    angles : (n,)
        Included angles of the curves [rad].
    curves : mapping of str to (n,)
        Median errors by ``CIRCLES``, ``PAIR`` and ``TRIPLE`` [m].
    limits : tuple of AngleLimit
        By sigma of the centres.
    arcs : Arcs
        One of the problems that the circles solve.
    """

    tolerance: float
    rows: tuple[Table3Row, ...]
    angles: Array
    curves: dict[str, Array]
    limits: tuple[AngleLimit, ...]
    arcs: Arcs

    def __post_init__(self) -> None:
        seal(self, angles=(None,))
        for curve in self.curves.values():
            assert curve.shape == self.angles.shape

    @property
    def rms_from_published(self) -> float:
        """Root mean square of what the circles differ from the study's printed errors [m]."""
        differences = [row.errors[CIRCLES] - row.published for row in self.rows]
        return float(np.sqrt(np.mean(np.square(differences))))


def angle_experiment(tolerance: float, rng: np.random.Generator) -> AngleExperiment:
    """Grant the study's errors to its marks and position the station by each method.

    Parameters
    ----------
    tolerance : float
        Error that is accepted [m].
    rng : numpy.random.Generator
        Draws the errors behind the limits; the table needs no chance.

    Returns
    -------
    AngleExperiment
        Everything that the page shows of it.
    """
    angles = np.radians(np.arange(6.0, 178.0, 2.0))
    at_rows = [_medians(angle) for angle in TABLE_3.included_angles]
    at_curve = [_medians(angle) for angle in angles]
    return AngleExperiment(
        tolerance=tolerance,
        rows=tuple(
            Table3Row(included_angle=float(angle), published=float(published), errors=errors)
            for angle, published, errors in zip(
                TABLE_3.included_angles, TABLE_3.errors, at_rows, strict=True
            )
        ),
        angles=angles,
        curves={name: np.array([one[name] for one in at_curve]) for name in at_curve[0]},
        limits=tuple(_limit(float(sigma), tolerance, rng) for sigma in _SIGMAS),
        arcs=_arcs(float(TABLE_3.included_angles[_SHOWN - 1])),
    )


def _marks(angle: float) -> Array:
    """Return the three marks about the station, (3, 3) [m]."""
    headings = _FIRST + np.array([0.0, angle, _BESIDE])
    flat = [np.cos(headings), np.sin(headings), np.zeros(3)]
    return np.asarray(GRANTED_DISTANCE * np.stack(flat, axis=1))


def _granted() -> Array:
    """Return every pattern of signs of the errors in the plane, (64, 3, 3) [m]."""
    signs = np.array(list(product((-1.0, 1.0), repeat=6))).reshape(-1, 3, 2)
    return GRANTED_ERROR * np.concatenate([signs, np.zeros((len(signs), 3, 1))], axis=2)


def _medians(angle: float) -> dict[str, float]:
    """Return the median error over all signs by each way, with the granted error of height."""
    marks, off = _marks(angle), _granted()
    found = {
        CIRCLES: _by_circles(marks + off),
        PAIR: _by_centres(marks[:2] + off[:, :2], marks[:2]),
        TRIPLE: _by_centres(marks + off, marks),
    }
    return {
        name: float(np.median(np.hypot(np.linalg.norm(p[:, :2], axis=1), GRANTED_ERROR)))
        for name, p in found.items()
    }


def _by_circles(marks: Array) -> Array:
    """Return where circles of the true radii about marks, (s, 3, 3), meet best, (s, 3)."""
    chosen = np.arange(marks[..., 0].size).reshape(marks.shape[:2])
    measured = np.tile([GRANTED_DISTANCE, 0.0], (chosen.size, 1))
    weights = np.tile(np.eye(2), (chosen.size, 1, 1))
    return meet(chosen, marks.reshape(-1, 3), measured, weights, np.zeros(3)).p


def _by_centres(centres: Array, marks: Array, sigma: float = GRANTED_ERROR) -> Array:
    """Return where the free station stands whose centres, (s, k, 3), are those of marks, (k, 3)."""
    (s, k, _), n = centres.shape, centres[..., 0].size
    scene = Scene(
        names=(),
        centres_base=centres.reshape(-1, 3),
        cov_centres=np.tile(sigma**2 * np.eye(3), (n, 1, 1)),
        marks_site=marks,
        cov_marks=np.zeros((k, 3, 3)),
        middle=np.zeros(3),
        R_station_base=np.eye(3),
        J_up=np.array([[0.0, -1.0], [1.0, 0.0], [0.0, 0.0]]),
        sigma_level=_SIGMA_UP,
        is_levelled=True,
        sigma_heading=0.0,
        sigma_range=0.0,
        shared=np.zeros(n),
        sigma_height=0.0,
    )
    pairs = np.stack([np.arange(n).reshape(s, k), np.tile(np.arange(k), (s, 1))], axis=2)
    return solve_poses(scene, pairs, np.eye(4)).estimates[:, :3, 3]


def _limit(sigma: float, tolerance: float, rng: np.random.Generator) -> AngleLimit:
    """Return what limits the angle for one sigma, and try the free station there."""
    least, _ = angles_that_keep("free_station", sigma, tolerance)
    least_circles, widest_circles = angles_that_keep("paper", sigma, tolerance)
    rms = np.nan
    if np.isfinite(least):
        marks = _marks(least)[:2]
        p = _by_centres(marks + rng.normal(0.0, sigma, (_N_DRAWS, 2, 3)), marks, sigma)
        rms = float(np.sqrt(np.mean(np.sum(p[:, :2] ** 2, axis=1))))
    return AngleLimit(
        sigma=sigma,
        least=least,
        least_circles=least_circles,
        widest_circles=widest_circles,
        rms=rms,
    )


def _arcs(angle: float) -> Arcs:
    """Return the pattern of signs whose error is the median, with its circles."""
    marks, off = _marks(angle), _granted()
    p = _by_circles(marks + off)
    middle = int(np.argsort(np.linalg.norm(p[:, :2], axis=1))[len(p) // 2])
    return Arcs(
        included_angle=angle,
        marks_site=marks[:, :2].copy(),
        shifted_site=(marks + off[middle])[:, :2].copy(),
        radii=np.full(3, GRANTED_DISTANCE),
        p_site=p[middle, :2].copy(),
    )
