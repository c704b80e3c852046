"""Covariances of positions predicted from those of centres: hides the normal equations.

Rotations are about the station itself, so that the translation block is the covariance of the
position.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.estimation.linear_algebra import invert_each
from spheremark.pipelines.estimation.statistical_tests import block_statistics, noncentrality
from spheremark.pipelines.geometry import by_motion
from spheremark.pipelines.model import Array, Index, Mask
from spheremark.pipelines.placement.plan import Requirement
from spheremark.pipelines.positioning.trilateration import best_three, circles
from spheremark.pipelines.scan.rigs import N_LASERS

LOOSE2 = 1.0
"""Variance of a position above which it counts as undetermined [m^2]."""

_BIAS_LEFT = 0.22  # of the spread of laser biases: what a survey leaves to each centre, simulated
_TRACE_MOST = 1e6  # of the horizontal cofactor matrix of three circles that cut at all
_MARKS_LISTED = 8  # of which all sets are listed; of more as many sets are drawn
_ANY = 2.0  # beyond the cosine of any angle
_MOTION = [0, 1, 2, -3, -2, -1]  # unknowns of a free station without those that centres share


class Observables(NamedTuple):
    """Marks as they can be observed from stations."""

    stations_site: Array  # (s, 3) positions of the LiDAR [m]
    marks_site: Array  # (n, 3) marks [m]
    # (s, n, 3, 3) covariances of their centres by noise, in the axes of the site [m^2]
    cov_centres: Array
    sigma_laser_bias: float  # standard deviation of the range bias of a laser [m]
    sigma_range_common: float  # of what all lasers measure too long together [m]
    sigma_aim: Array  # (s, n) of each direction, by mounting and encoder, after both faces [rad]
    is_seen: Mask  # (s, n) which are visible and near enough to be found
    found: Array  # (s, n) probability that each is found
    # (s, n, 3, q) factors of the errors of the mounting that move the upward face of each, the
    # other the opposite way; and (s, n) the share by which that face outweighs the other [m]
    by_mounting: Array
    imbalance: Array

    @property
    def vectors(self) -> Array:
        """Vectors from stations to marks, (s, n, 3) [m]."""
        return np.asarray(self.marks_site[None] - self.stations_site[:, None])

    @property
    def shared_variance(self) -> float:
        """Variance of the common error of all ranges: bias, and the lasers' mean [m^2]."""
        return shared_variance(self.sigma_laser_bias, self.sigma_range_common)


class Positions(NamedTuple):
    """Predicted positions."""

    # (s, 6, 6) of a small motion about the station, rotation [rad] and translation [m]; infinite on
    # the diagonal where there is no position
    cov_motion: Array
    # (s, p, p) of the unknowns of the adjustment, the position last, if all marks that are seen are
    # found; infinite likewise
    cofactor: Array
    used: Mask  # (s, n) marks that carry each position


class Circles(NamedTuple):
    """Stations and marks two by two: what each mark adds to the equations of three circles."""

    towards: Array  # (s, n, 2) level unit vectors from stations to marks
    # (s, n, 3, 9) weights of the position [1/m^2], covariance of what a mark adds to the right-hand
    # side, and of that what a range error of 1 m and a turn of 1 rad about x and about y change
    parts: Array
    is_seen: Mask  # (s, n) which are visible and near enough to be found


class Reliability(NamedTuple):
    """Internal and external reliability of each mark."""

    # (s, n) redundancy of each mark's observations together; 0 where it is not used
    redundancies: Array
    detectable_biases: Array  # (s, n) minimal detectable bias along the weakest axis [m]
    external: Array  # (s, n) largest shift of the position by a bias of that size [m]


def predict_positions(observables: Observables, requirement: Requirement) -> Positions:
    """Predict the covariances of positions.

    Notes
    -----
    ``free_station``: ``(sum J' P J + G)^-1`` with ``J = [-[v]x, l, 1]`` of each mark, ``l`` the
    unit vector of its line of sight, whose unknown is the error that all ranges share, and in ``G``
    the AHRS's information on roll and pitch and the prior of that error. Where the gimbal turns by
    less than 360 degrees, the errors of the mounting are unknowns too. A common error of the
    centres' heights goes to the height of the station. Each mark counts with the probability that
    it is found.
    ``paper``: horizontal distances and heights of the three marks whose circles cut best, and the
    levelling error carried through them as in ``trilateration``; the heading is the mean of the
    three directions.
    """
    if requirement.method == "paper":
        cov, cofactor, is_fixed, used = _by_circles(observables, requirement)
    else:
        used = np.array(observables.is_seen)
        cov, is_fixed = _by_all(observables, requirement)
        every = observables._replace(found=np.ones_like(observables.found))
        cofactor, _ = _by_all(every, requirement)
        cov = cov[:, _MOTION][:, :, _MOTION]
    cov[:, 5, 5] += requirement.resection.sigma_height**2
    for one in (cov, cofactor):
        one[~is_fixed] = np.diag(np.full(one.shape[1], np.inf))
    return Positions(cov, cofactor, used)


def sigmas_with_misses(observables: Observables, requirement: Requirement) -> Array:
    """Return the RMS 3-D sigmas of free stations over which marks are found, (s,) [m].

    The mean is over the sets of marks that give a position, by their probabilities; infinite where
    none does. Sets of two marks count only where no more are seen: such positions are weak.
    """
    every = observables._replace(found=np.ones_like(observables.found))
    information, out = information_of(every, requirement), np.full(len(every.found), np.inf)
    for e, is_seen in enumerate(observables.is_seen):
        sets, shares = _sets_found(observables.found[e, is_seen])
        cov, is_fixed = _inverted(
            np.tensordot(sets, information[e, is_seen], axes=1), observables, requirement
        )
        is_fixed &= sets.sum(axis=1) >= min(3, is_seen.sum())
        if shares[is_fixed].sum() > 0.0:
            variances = np.trace(cov[is_fixed, -3:, -3:], axis1=1, axis2=2)
            out[e] = np.sqrt(np.average(variances, weights=shares[is_fixed]))
    return np.asarray(np.hypot(out, requirement.resection.sigma_height))


def information_of(observables: Observables, requirement: Requirement) -> Array:
    """Return the information of each mark about a free station, (s, n, 7 + q, 7 + q).

    The unknowns are those of ``start_information``, and q of the mounting before the position: of
    these a mark that both faces show says as much as the fainter one is worth.
    """
    is_seen = observables.is_seen[..., None, None]
    weights, _ = invert_each(np.where(is_seen, covariances(observables, requirement), np.eye(3)))
    weights = np.where(is_seen, weights, 0.0) * observables.found[..., None, None]
    J, share = by_unknowns(observables), observables.imbalance[..., None, None]
    out, e = np.asarray(_transposed(J) @ weights @ J), observables.by_mounting
    apart = _transposed(e) @ weights @ e
    out[..., 4:-3, 4:-3] += (1.0 - share**2) * apart
    return out


def by_unknowns(observables: Observables) -> Array:
    """Return the derivative of centres by rotation, common errors, and position."""
    v, share = observables.vectors, observables.imbalance[..., None, None]
    along = v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-9)
    J = by_motion(v)
    return np.concatenate(
        [J[..., :3], along[..., None], share * observables.by_mounting, J[..., 3:]], axis=-1
    )


def start_information(variance: float, requirement: Requirement) -> Array:
    """Return the information of a station without marks: gravity, and the range error's size."""
    level, shared = requirement.sigma_levelling**-2.0, 1.0 / max(variance, 1e-18)
    return np.diag([level, level, 0.0, shared, 0.0, 0.0, 0.0])


def circles_of(observables: Observables, requirement: Requirement) -> Circles:
    """Return what each mark adds to the equations of three circles.

    Horizontal distances and heights of levelled centres alone count, weighed by covariances that
    hold the common error of ranges as if it were each centre's own.
    """
    v = observables.vectors
    J, lean = _circle_equations(v)
    covs = np.where(
        observables.is_seen[..., None, None], covariances(observables, requirement), np.eye(3)
    )
    levelling = requirement.sigma_levelling**2 * lean @ _transposed(lean)
    along = v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-9)
    stated = covs + observables.shared_variance * along[..., :, None] * along[..., None, :]
    weights = _transposed(J) @ np.linalg.inv(_on_circles(J, stated) + levelling) @ J
    shared = np.concatenate([along[..., None], by_motion(v)[..., :2]], axis=-1)
    parts = np.concatenate([weights, weights @ covs @ weights, weights @ shared], axis=-1)
    flat = np.maximum(np.hypot(v[..., 0], v[..., 1]), 1e-9)
    return Circles(v[..., :2] / flat[..., None], parts, observables.is_seen)


def shared_sigmas(variance: float, requirement: Requirement) -> Array:
    """Return the sigmas of errors that the marks of three circles share, as in ``Circles``."""
    return np.array([np.sqrt(variance), *[requirement.sigma_levelling] * 2])


def claimed_bias_variance(sigma_laser_bias: float) -> float:
    """Return the variance that a survey leaves to each centre's distance for the lasers' biases."""
    return (_BIAS_LEFT * sigma_laser_bias) ** 2


def shared_variance(sigma_laser_bias: float, sigma_range_common: float) -> float:
    """Return the variance of the common error of all ranges: bias, and the lasers' mean."""
    return sigma_range_common**2 + sigma_laser_bias**2 / N_LASERS


def reliability(
    observables: Observables, found: Positions, requirement: Requirement
) -> Reliability:
    """Return the size of errors in a mark that tests find, and the effect of smaller ones."""
    v = observables.vectors
    is_fixed: Mask = np.asarray(np.isfinite(found.cov_motion).all(axis=(1, 2)))
    used = found.used & is_fixed[:, None]
    covs = np.where(found.used[..., None, None], covariances(observables, requirement), np.eye(3))
    inverse = np.where(np.isfinite(found.cofactor), found.cofactor, 0.0)
    J = by_unknowns(observables)
    if requirement.method == "paper":
        J, lean = _circle_equations(v)
        covs = _on_circles(J, covs) + requirement.sigma_levelling**2 * lean @ _transposed(lean)
    to_position = np.eye(J.shape[-1])[-3:]
    weights = invert_each(covs)[0]
    tests = block_statistics(np.zeros(J.shape[:-1]), weights, J @ inverse[:, None] @ _transposed(J))
    shift = noncentrality(requirement.resection.test_level, requirement.resection.test_power)
    effects = to_position @ inverse[:, None] @ _transposed(weights @ J)
    return Reliability(
        redundancies=np.where(used, tests.redundancies, 0.0),
        detectable_biases=np.where(used, tests.detectable_biases(shift), np.inf),
        external=np.where(used, tests.external_reliabilities(effects, shift), np.inf),
    )


def covariances(observables: Observables, requirement: Requirement) -> Array:
    """Return the covariances of the centres, without the range error that all of them share.

    Noise, along the ranges what lasers leave at each, and the error of aiming across them.
    """
    v = observables.vectors
    d2 = np.maximum(np.sum(v**2, axis=-1), 1e-9)[..., None, None]
    along = v[..., :, None] * v[..., None, :]
    bias2 = claimed_bias_variance(observables.sigma_laser_bias)
    aim2 = observables.sigma_aim[..., None, None] ** 2
    own = observables.cov_centres + requirement.sigma_marks**2 * np.eye(3)
    return np.asarray(own + bias2 / d2 * along + aim2 * (d2 * np.eye(3) - along))


def _by_all(observables: Observables, requirement: Requirement) -> tuple[Array, Mask]:
    """Return covariances of the unknowns of free stations, and which have a position."""
    sums = information_of(observables, requirement).sum(axis=1)
    return _inverted(sums, observables, requirement)


def _inverted(
    sums: Array, observables: Observables, requirement: Requirement
) -> tuple[Array, Mask]:
    """Return covariances of unknowns by the information of marks, and which have a position."""
    start, rest = np.eye(sums.shape[-1]), [*range(4), -3, -2, -1]
    start[np.ix_(rest, rest)] = start_information(observables.shared_variance, requirement)
    cov, is_fixed = invert_each(start + sums)
    return cov, is_fixed & (np.trace(cov[:, -3:, -3:], axis1=1, axis2=2) <= LOOSE2)


def _sets_found(found: Array) -> tuple[Array, Array]:
    """Return which marks may be found together, (k, n), and how probable each set is, (k,)."""
    n = len(found)
    if n <= _MARKS_LISTED:
        sets = np.arange(2**n)[:, None] >> np.arange(n) & 1
        return sets.astype(np.float64), np.prod(np.where(sets, found, 1.0 - found), axis=1)
    drawn = np.random.default_rng(0).random((2**_MARKS_LISTED, n)) < found
    return drawn.astype(np.float64), np.full(len(drawn), 1.0 / len(drawn))


def _by_circles(
    observables: Observables, requirement: Requirement
) -> tuple[Array, Array, Mask, Mask]:
    """Return covariances of motions and positions by three circles, which are fixed, and by what.

    The next best mark replaces one that is not found.
    """
    given = circles_of(observables, requirement)
    used = np.zeros(given.is_seen.shape, dtype=np.bool_)
    _choose_each(given, used)
    summed = np.where(used[..., None, None], given.parts, 0.0).sum(axis=1)
    weights, spread, shared = np.split(summed, 3, axis=2)
    cofactor, is_fixed = invert_each(weights)
    is_fixed &= np.trace(cofactor, axis1=1, axis2=2) <= LOOSE2
    cofactor[~is_fixed], used[~is_fixed] = 0.0, False
    moved = cofactor @ (shared * shared_sigmas(observables.shared_variance, requirement))
    cov = np.zeros((len(cofactor), 6, 6))
    cov[:, 0, 0] = cov[:, 1, 1] = requirement.sigma_levelling**2
    cov[:, 3:, :2] = -requirement.sigma_levelling * moved[:, :, 1:]
    cov[:, :2, 3:] = _transposed(cov[:, 3:, :2])
    cov[:, 2, 2] = _heading_variances(observables, used, requirement)
    cov[:, 3:, 3:] = cofactor @ spread @ cofactor + moved @ _transposed(moved)
    return cov, cofactor, is_fixed, used


def _heading_variances(observables: Observables, used: Mask, requirement: Requirement) -> Array:
    """Return the variances of the mean of the directions to three marks."""
    v = observables.vectors
    covs = covariances(observables, requirement)
    flat2 = np.maximum(np.sum(v[..., :2] ** 2, axis=2), 1e-18)
    left = np.stack([-v[..., 1], v[..., 0]], axis=-1) / flat2[..., None]
    variances = np.einsum("eni,enij,enj->en", left, covs[..., :2, :2], left)
    return np.asarray(np.where(used, variances, 0.0).sum(axis=1) / 9.0)


def _circle_equations(v: Array) -> tuple[Array, Array]:
    """Return derivatives of horizontal distance and height by position, and by roll and pitch."""
    J = circles(v)[1]
    return J, J @ by_motion(v)[..., :2]


def _on_circles(J: Array, covs: Array) -> Array:
    """Return covariances of horizontal distances and heights."""
    return np.asarray(J @ covs @ _transposed(J))


def _transposed(stack: Array) -> Array:
    """Return the transposes of a stack of matrices."""
    return np.swapaxes(stack, -1, -2)


@compiled
def best_circles(given: Circles, e: int, marks: Index, three: Index) -> bool:
    """Find the three of some marks whose circles cut best at a station; return whether they cut."""
    n, lines, seen = 0, np.empty((len(marks), 2)), np.empty(len(marks), np.intp)
    for c in marks:
        if given.is_seen[e, c]:
            seen[n], lines[n] = c, given.towards[e, c]
            n += 1
    trace, _ = best_three(lines[:n], -_ANY, _ANY, three)
    if trace >= _TRACE_MOST:
        return False
    for k in range(3):
        three[k] = seen[three[k]]
    return True


@compiled
def _choose_each(given: Circles, used: Mask) -> None:
    """Mark the three marks that each station uses."""
    three, marks = np.empty(3, np.intp), np.arange(used.shape[1])
    for e in range(len(used)):
        if best_circles(given, e, marks, three):
            for c in three:
                used[e, c] = True
