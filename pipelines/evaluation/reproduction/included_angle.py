"""The study's experiment with the station: errors granted to marks, by included angle (Table 3).

Two marks stand 7.5 m away at the included angle, a third beside them, and each axis of each centre
is off by 17 mm. The circles' radii come from the known position, as in the study; how its open
points are read is that of ``placement.errors_by_angle``. The free station gets the same centres
with the same errors.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from spheremark.pipelines.evaluation.experiment import Plain
from spheremark.pipelines.model import Array, seal
from spheremark.pipelines.placement import errors_by_angle, marks_at_angle, three_circle_errors
from spheremark.pipelines.positioning.matching import Scene, solve_poses
from spheremark.pipelines.positioning.subsets import angles_that_keep
from spheremark.pipelines.published import GRANTED_DISTANCE, GRANTED_ERROR, TABLE_3

CIRCLES, PAIR, TRIPLE = "three circles", "two centres", "three centres"
"""Methods of positioning the station from the same marks."""

_SIGMA_UP = np.radians(0.2)  # of the AHRS; matters for heights alone here
_SHOWN = 2  # row of Table 3 whose circles are drawn
_SIGMAS = np.array([0.002, 0.005, 0.010, 0.015, 0.017, 0.020, 0.025, 0.028])  # [m]
_N_DRAWS = 4000  # RMS good to a hundredth


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Arcs:
    """The three circles of one pattern of errors (the study's Figure 4); the true station is zero.

    ``marks_site`` are true, ``shifted_site`` have the granted errors, ``p_site`` is where the
    circles of ``radii`` about these meet best [m].
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
    """Table 3, Figures 4 and 10, and what limits the angle.

    Attributes
    ----------
    tolerance : float
        Error that is accepted [m].
    rows : list of dict
        Table 3: published and simulated errors at the study's angles.
    angles : (n,)
        Included angles of the curves [rad].
    curves : mapping of str to (n,)
        Median errors by ``CIRCLES``, ``PAIR`` and ``TRIPLE`` [m].
    limits : list of dict
        Angles that keep the tolerance, by sigma of the centres.
    arcs : Arcs
        Circles of one pattern of errors.
    """

    tolerance: float
    rows: list[Plain]
    angles: Array
    curves: dict[str, Array]
    limits: list[Plain]
    arcs: Arcs

    @property
    def rms_from_published(self) -> float:
        """RMS of the differences between circles and the study's printed errors [m]."""
        differences = [row["three_circles_minus_study_m"] for row in self.rows]
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
        Table 3 with its figures, and the limits of the included angle.
    """
    angles = np.radians(np.arange(6.0, 178.0, 2.0))
    return AngleExperiment(
        tolerance=tolerance,
        rows=_table_3(),
        angles=angles,
        curves=_medians(angles),
        limits=[_limit(float(sigma), tolerance, rng) for sigma in _SIGMAS],
        arcs=_arcs(float(TABLE_3.included_angles[_SHOWN])),
    )


def _table_3() -> list[Plain]:
    """Return the study's Table 3 beside the errors of each method."""
    found = _medians(TABLE_3.included_angles)
    return [
        {
            "included_angle_deg": round(float(np.degrees(angle)), 2),
            "study_error_m": float(published),
            **{f"{name.replace(' ', '_')}_error_m": float(e[i]) for name, e in found.items()},
            "three_circles_minus_study_m": float(found[CIRCLES][i] - published),
        }
        for i, (angle, published) in enumerate(
            zip(TABLE_3.included_angles, TABLE_3.errors, strict=True)
        )
    ]


def _medians(angles: Array) -> dict[str, Array]:
    """Return median errors over all signs by each method, with the granted error of height."""
    off = _granted()
    marks = [marks_at_angle(float(angle), GRANTED_DISTANCE) for angle in angles]
    pairs = [_by_centres(m[:2] + off[:, :2], m[:2]) for m in marks]
    triples = [_by_centres(m + off, m) for m in marks]
    return {
        CIRCLES: errors_by_angle(angles, GRANTED_ERROR, GRANTED_DISTANCE),
        PAIR: np.array([_median(p) for p in pairs]),
        TRIPLE: np.array([_median(p) for p in triples]),
    }


def _median(p: Array) -> float:
    """Return the median length of errors in the plane with the granted error of height."""
    return float(np.median(np.hypot(np.linalg.norm(p[:, :2], axis=1), GRANTED_ERROR)))


def _granted() -> Array:
    """Return every pattern of signs of the errors in the plane, (64, 3, 3) [m]."""
    signs = np.array(list(product((-1.0, 1.0), repeat=6))).reshape(-1, 3, 2)
    return GRANTED_ERROR * np.concatenate([signs, np.zeros((len(signs), 3, 1))], axis=2)


def _by_centres(centres: Array, marks: Array, sigma: float = GRANTED_ERROR) -> Array:
    """Return the free stations, (s, 3), from centres, (s, k, 3), of marks, (k, 3)."""
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
        shared_base=np.zeros((n, 3, 0)),
        included_base=np.zeros((n, 3, 0)),
    )
    pairs = np.stack([np.arange(n).reshape(s, k), np.tile(np.arange(k), (s, 1))], axis=2)
    return solve_poses(scene, pairs, np.eye(4)).estimates[:, :3, 3]


def _limit(sigma: float, tolerance: float, rng: np.random.Generator) -> Plain:
    """Return the angles that keep the tolerance for one sigma, and the free station's RMS there."""
    least, _ = angles_that_keep("free_station", sigma, tolerance)
    circles = angles_that_keep("paper", sigma, tolerance)
    rms = np.nan
    if np.isfinite(least):
        marks = marks_at_angle(least, GRANTED_DISTANCE)[:2]
        p = _by_centres(marks + rng.normal(0.0, sigma, (_N_DRAWS, 2, 3)), marks, sigma)
        rms = float(np.sqrt(np.mean(np.sum(p[:, :2] ** 2, axis=1))))
    return {
        "sigma_axis_m": sigma,
        "two_centres_from_deg": float(np.degrees(least)),
        "two_circles_from_deg": float(np.degrees(circles[0])),
        "two_circles_to_deg": float(np.degrees(circles[1])),
        "two_centres_error_horizontal_rms_m": rms,
    }


def _arcs(angle: float) -> Arcs:
    """Return the pattern of signs whose error is the median, with its circles."""
    marks, off = marks_at_angle(angle, GRANTED_DISTANCE), _granted()
    p = three_circle_errors(marks, off)
    middle = int(np.argsort(np.linalg.norm(p[:, :2], axis=1))[len(p) // 2])
    return Arcs(
        included_angle=angle,
        marks_site=marks[:, :2].copy(),
        shifted_site=(marks + off[middle])[:, :2].copy(),
        radii=np.full(3, GRANTED_DISTANCE),
        p_site=p[middle, :2].copy(),
    )
