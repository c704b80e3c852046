"""Covariances of positions predicted from those of centres: hides the normal equations.

Rotations are about the station itself, so that the translation block is the covariance of the
position.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.estimation.linear_algebra import invert, invert_each
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
_ANY = 2.0  # beyond the cosine of any angle


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
    cofactor: Array  # (s, 6, 6) the same as the adjustment of the survey will state it
    used: Mask  # (s, n) marks that carry each position


class Pairs(NamedTuple):
    """Stations and marks two by two: what each mark adds to the equations of each station."""

    vectors: Array  # (s, n, 3) from stations to marks [m]
    weights: Array  # (s, n, 3, 3) information about the position, as a survey weighs it [1/m^2]
    spreads: Array  # (s, n, 3, 3) true covariance of what a mark adds to the right-hand side
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
    ``free_station``: weights are those of the adjustment, ``Q = (sum J' P J + G)^-1`` with
    ``J = [-[v]x, 1]`` of each mark and the AHRS's information ``G`` on roll and pitch; a survey
    takes what lasers and gimbal leave as different at every mark. The covariance of the estimate
    has them as they are: noise of each mark, the remaining laser biases and error of direction, and
    a common error of all ranges, which hardly moves a station with marks all round:
    ``Q J' P C P J Q``. A common error of the centres' heights goes to the height of the station.
    Each mark counts with the probability that it is found.
    ``paper``: horizontal distances and heights of the three marks whose circles cut best, and the
    levelling error carried through them as in ``trilateration``; the heading is the mean of the
    three directions.
    """
    is_paper = requirement.method == "paper"
    pairs = pairs_of(observables, requirement)
    used = _choose_three(pairs) if is_paper else np.array(observables.is_seen)
    normal, spread, shared = _equations(pairs, used, requirement, observables.shared_variance)
    cofactor, is_fixed = invert_each(normal)
    is_fixed &= np.trace(cofactor[:, -3:, -3:], axis1=1, axis2=2) <= LOOSE2
    cofactor[~is_fixed], used[~is_fixed & is_paper] = 0.0, False
    moved = cofactor @ shared
    cov = cofactor @ spread @ cofactor + moved @ _transposed(moved)
    if is_paper:
        position, place = cofactor, cov
        cov = np.zeros((len(cov), 6, 6))
        level2 = requirement.sigma_levelling**2
        cov[:, 0, 0] = cov[:, 1, 1] = level2
        cov[:, 3:, :2] = -requirement.sigma_levelling * moved[:, :, 1:]
        cov[:, :2, 3:] = _transposed(cov[:, 3:, :2])
        cov[:, 2, 2] = _heading_variances(observables, used, requirement)
        cofactor, cov[:, 3:, 3:] = cov.copy(), place
        cofactor[:, 3:, 3:] = position
    cov[:, 5, 5] += requirement.resection.sigma_height**2
    if (observables.found < 1.0).any():  # a survey states what the marks that it finds give
        all_found = observables._replace(found=np.ones_like(observables.found))
        cofactor = predict_positions(all_found, requirement).cofactor
    cov[~is_fixed] = cofactor[~is_fixed] = np.diag(np.full(6, np.inf))
    return Positions(cov, cofactor, used)


def pairs_of(observables: Observables, requirement: Requirement) -> Pairs:
    """Return what each mark adds to the equations of each station.

    Notes
    -----
    By three circles, horizontal distances and heights of levelled centres alone count.
    """
    v, is_seen = observables.vectors, observables.is_seen
    stated, true = (
        np.where(is_seen[..., None, None], covs, np.eye(3))
        for covs in covariances(observables, requirement)
    )
    if requirement.method == "paper":
        J, lean = _circle_equations(v)
        levelling = requirement.sigma_levelling**2 * lean @ _transposed(lean)
        weights = _transposed(J) @ np.linalg.inv(_on_circles(J, stated) + levelling) @ J
    else:
        weights = invert_each(stated)[0]
    # by three circles the next best mark replaces one that is not found
    found = 1.0 if requirement.method == "paper" else observables.found[..., None, None]
    return Pairs(v, found * weights, found * (weights @ true @ weights), is_seen)


def start_of(requirement: Requirement) -> Array:
    """Return the normal matrix without a mark: position, or gravity, heading and position."""
    if requirement.method == "paper":
        return np.zeros((3, 3))
    return np.diag([requirement.sigma_levelling**-2.0] * 2 + [0.0] * 4)


def shared_sigmas(variance: float, requirement: Requirement) -> Array:
    """Return the sigmas of errors that marks of a station share, in the order of ``add_mark``."""
    sigmas = [np.sqrt(variance), *[requirement.sigma_levelling] * 2]
    return np.array(sigmas if requirement.method == "paper" else sigmas[:1])


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
    stated, _ = covariances(observables, requirement)
    covs = np.where(found.used[..., None, None], stated, np.eye(3))
    is_fixed: Mask = np.asarray(np.isfinite(found.cov_motion).all(axis=(1, 2)))
    used = np.asarray(found.used & is_fixed[:, None])
    inverse = np.where(is_fixed[:, None, None], found.cofactor, 0.0)
    if requirement.method == "paper":
        J, lean = _circle_equations(v)
        covs = _on_circles(J, covs) + requirement.sigma_levelling**2 * lean @ _transposed(lean)
        inverse = inverse[:, 3:, 3:]
        to_position = np.eye(3)
    else:
        J = by_motion(v)
        to_position = np.eye(6)[3:]
    weights = invert_each(covs)[0]
    tests = block_statistics(np.zeros(J.shape[:-1]), weights, J @ inverse[:, None] @ _transposed(J))
    shift = noncentrality(requirement.resection.test_level, requirement.resection.test_power)
    effects = to_position @ inverse[:, None] @ _transposed(weights @ J)
    return Reliability(
        redundancies=np.where(used, tests.redundancies, 0.0),
        detectable_biases=np.where(used, tests.detectable_biases(shift), np.inf),
        external=np.where(used, tests.external_reliabilities(effects, shift), np.inf),
    )


def covariances(observables: Observables, requirement: Requirement) -> tuple[Array, Array]:
    """Return the centres' covariances as a survey states them, and the true ones.

    A survey takes the remaining laser biases as independent, along the ranges, and adds what all
    directions leave; true are these biases, noise and the error of aiming across the ranges, beside
    a range error that all centres share.
    """
    v = observables.vectors
    d2 = np.maximum(np.sum(v**2, axis=-1), 1e-9)[..., None, None]
    along = v[..., :, None] * v[..., None, :]
    noise = observables.cov_centres + requirement.sigma_marks**2 * np.eye(3)
    bias2 = claimed_bias_variance(observables.sigma_laser_bias)
    noise = noise + bias2 / d2 * along
    stated = noise + requirement.resection.sigma_common**2 * np.eye(3)
    aim2 = observables.sigma_aim[..., None, None] ** 2
    return stated, noise + aim2 * (d2 * np.eye(3) - along)


def _equations(
    pairs: Pairs, used: Mask, requirement: Requirement, variance: float
) -> tuple[Array, Array, Array]:
    """Return normal matrices, covariances and shared errors of right-hand sides of stations."""
    start, sigmas = start_of(requirement), shared_sigmas(variance, requirement)
    normal, spread = (np.tile(start, (len(used), 1, 1)) for _ in range(2))
    shared = np.zeros((*normal.shape[:2], len(sigmas)))
    _add_marks(pairs, used, normal, spread, shared)
    normal, spread = (np.tril(one) + _transposed(np.tril(one, -1)) for one in (normal, spread))
    return normal, spread, shared * sigmas


def _heading_variances(observables: Observables, used: Mask, requirement: Requirement) -> Array:
    """Return the variances of the mean of the directions to three marks."""
    v = observables.vectors
    _, true = covariances(observables, requirement)
    flat2 = np.maximum(np.sum(v[..., :2] ** 2, axis=2), 1e-18)
    left = np.stack([-v[..., 1], v[..., 0]], axis=-1) / flat2[..., None]
    variances = np.einsum("eni,enij,enj->en", left, true[..., :2, :2], left)
    return np.asarray(np.where(used, variances, 0.0).sum(axis=1) / 9.0)


def _choose_three(pairs: Pairs) -> Mask:
    """Return the three marks of each station whose circles cut best; none where they do not cut."""
    used = np.zeros(pairs.is_seen.shape, dtype=np.bool_)
    _choose_each(pairs, used)
    return used


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
def best_circles(pairs: Pairs, e: int, marks: Index, three: Index) -> bool:
    """Find the three of some marks whose circles cut best at a station; return whether they cut."""
    n, lines, seen = 0, np.empty((len(marks), 2)), np.empty(len(marks), np.intp)
    for c in marks:
        if pairs.is_seen[e, c]:
            x, y = pairs.vectors[e, c, 0], pairs.vectors[e, c, 1]
            flat = max(np.sqrt(x * x + y * y), 1e-9)
            seen[n], lines[n, 0], lines[n, 1] = c, x / flat, y / flat
            n += 1
    trace, _ = best_three(lines[:n], -_ANY, _ANY, three)
    if trace >= _TRACE_MOST:
        return False
    for k in range(3):
        three[k] = seen[three[k]]
    return True


@compiled
def _choose_each(pairs: Pairs, used: Mask) -> None:
    """Mark the three marks that each station uses."""
    three, marks = np.empty(3, np.intp), np.arange(used.shape[1])
    for e in range(len(used)):
        if best_circles(pairs, e, marks, three):
            for c in three:
                used[e, c] = True


@compiled
def _add_marks(pairs: Pairs, used: Mask, normal: Array, spread: Array, shared: Array) -> None:
    """Add the marks that each station uses to its equations."""
    for e in range(len(used)):
        for c in range(used.shape[1]):
            if used[e, c]:
                add_mark(pairs, e, c, normal[e], spread[e], shared[e])


@compiled
def add_mark(pairs: Pairs, e: int, c: int, normal: Array, spread: Array, shared: Array) -> None:
    """Add a mark to the equations of a station: lower triangles, and shared errors.

    Shared are a range error of 1 m and, where the unknowns are the position alone, a turn of 1 rad
    of the levelled frame about x and about y.
    """
    v, weight = pairs.vectors[e, c], pairs.weights[e, c]
    _add_block(v, weight, normal)
    _add_block(v, pairs.spreads[e, c], spread)
    x, y, z = v
    d, n = np.sqrt(x * x + y * y + z * z), len(normal) - 3
    p = (weight[0, 0] * x + weight[1, 0] * y + weight[2, 0] * z) / d
    q = (weight[1, 0] * x + weight[1, 1] * y + weight[2, 1] * z) / d
    r = (weight[2, 0] * x + weight[2, 1] * y + weight[2, 2] * z) / d
    shared[n, 0] += p
    shared[n + 1, 0] += q
    shared[n + 2, 0] += r
    for k in range(1, shared.shape[1]):
        for i in range(3):
            shared[i, k] += _turned(v, weight, i, k - 1)
    if n:
        shared[0, 0] += y * r - z * q
        shared[1, 0] += z * p - x * r
        shared[2, 0] += x * q - y * p


@compiled
def _add_block(v: Array, block: Array, out: Array) -> None:
    """Add ``J' block J`` to at least the lower triangle of a matrix, ``J = [-[v]x, 1]`` or 1."""
    x, y, z = v
    n = len(out) - 3
    for j in range(3):
        for i in range(j, 3):
            out[n + i, n + j] += block[i, j]
        if n:
            p, q, r = _turned(v, block, 0, j), _turned(v, block, 1, j), _turned(v, block, 2, j)
            out[3, j] += p
            out[4, j] += q
            out[5, j] += r
            out[0, j] += y * r - z * q
            out[1, j] += z * p - x * r
            out[2, j] += x * q - y * p


@compiled
def _turned(v: Array, block: Array, i: int, j: int) -> float:
    """Return one element of ``-block [v]x``."""
    k, m = (j + 1) % 3, (j + 2) % 3
    return float(block[i, m] * v[k] - block[i, k] * v[m])


@compiled
def sigma_3d(
    normal: Array, spread: Array, shared: Array, sigmas: Array, sigma_height: float
) -> float:
    """Return the 3-D sigma of a station; infinite without a position. Inverts the normal matrix.

    The first two matrices by their lower triangles.
    """
    if not invert(normal, normal):
        return np.inf
    p, total, trace = len(normal), sigma_height**2, 0.0
    for a in range(p - 3, p):
        trace += normal[a, a]
        for i in range(p):
            total += spread[i, i] * normal[a, i] ** 2
            for j in range(i):
                total += 2.0 * spread[i, j] * normal[a, i] * normal[a, j]
        for r in range(len(sigmas)):
            moved = 0.0
            for i in range(p):
                moved += shared[i, r] * normal[a, i]
            total += (sigmas[r] * moved) ** 2
    return np.sqrt(total) if trace <= LOOSE2 else np.inf
