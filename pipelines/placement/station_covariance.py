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
_SIGMA_AIM = 1.5e-5  # [rad] of each direction, by mounting and encoder, after both faces; simulated
_TRACE_MOST = 1e6  # of the horizontal cofactor matrix of three circles that cut at all
_ANY = 2.0  # beyond the cosine of any angle


class Observables(NamedTuple):
    """Marks as they can be observed from stations."""

    stations_site: Array  # (s, 3) positions of the LiDAR [m]
    marks_site: Array  # (n, 3) marks [m]
    # (s, n, 3, 3) covariances of their centres by noise, in the axes of the site [m^2]
    cov_centres: Array
    sigma_laser_bias: float  # standard deviation of the range bias of a laser [m]
    is_seen: Mask  # (s, n) which are found

    @property
    def vectors(self) -> Array:
        """Vectors from stations to marks, (s, n, 3) [m]."""
        return np.asarray(self.marks_site[None] - self.stations_site[:, None])


class Positions(NamedTuple):
    """Predicted positions."""

    # (s, 6, 6) of a small motion about the station, rotation [rad] and translation [m]; infinite on
    # the diagonal where there is no position
    cov_motion: Array
    cofactor: Array  # (s, 6, 6) the same as the adjustment of the survey will state it
    used: Mask  # (s, n) marks that carry each position


class Information(NamedTuple):
    """Contributions of marks to the normal equations of a free station; they add up."""

    normal: Array  # (s, n, 6, 6) to the normal matrix by the weights of a survey
    cov_rhs: Array  # (s, n, 6, 6) to the covariance of the right-hand side
    bias_rhs: Array  # (s, n, 6) to the right-hand side by a common error of all ranges of 1 m [1/m]


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
    has them as they are: noise of each mark, the remaining error of its direction, and a common
    error of all ranges, which hardly moves a station with marks all round: ``Q J' P C P J Q``. A
    common error of the centres' heights goes to the height of the station.
    ``paper``: horizontal distances and heights of the three marks whose circles cut best, and the
    levelling error carried through them as in ``trilateration``; the heading is the mean of the
    three directions.
    """
    if requirement.method == "paper":
        found, moved = _three_circles(observables, requirement)
    else:
        found, moved = _free_stations(observables, requirement)
    shared2 = shared_variance(observables.sigma_laser_bias)
    found.cov_motion[:] += shared2 * moved[:, :, None] * moved[:, None, :]
    found.cov_motion[:, 5, 5] += requirement.resection.sigma_height**2
    return found


def claimed_bias_variance(sigma_laser_bias: float) -> float:
    """Return the variance that a survey leaves to each centre's distance for the lasers' biases."""
    return (_BIAS_LEFT * sigma_laser_bias) ** 2


def shared_variance(sigma_laser_bias: float) -> float:
    """Return the variance of the common error of all ranges of a survey: the lasers' mean bias."""
    return sigma_laser_bias**2 / N_LASERS


def information(
    observables: Observables, requirement: Requirement, *, is_summed: bool = False
) -> Information:
    """Return the contributions of marks, or (``is_summed``) their sum over the marks seen."""
    n_stations, n_marks = observables.is_seen.shape
    shape = (n_stations, 1 if is_summed else n_marks)
    out = Information(np.zeros((*shape, 6, 6)), np.zeros((*shape, 6, 6)), np.zeros((*shape, 6)))
    if n_marks:
        v, covs, is_seen = observables.vectors, observables.cov_centres, observables.is_seen
        sigma_bias = observables.sigma_laser_bias
        _add_contributions(v, *_covariances(v, covs, sigma_bias, requirement), is_seen, tuple(out))
    return out


def independent_information(observables: Observables, requirement: Requirement) -> Array:
    """Return the information of each mark about a station's position for a known rotation."""
    v = observables.vectors
    across = np.sum(v**2, axis=2)[..., None, None] * np.eye(3) - v[..., :, None] * v[..., None, :]
    noise = observables.cov_centres + requirement.sigma_marks**2 * np.eye(3)
    is_seen = observables.is_seen[..., None, None]
    covs = np.where(is_seen, noise + _SIGMA_AIM**2 * across, np.eye(3))
    return np.where(is_seen, np.linalg.inv(covs), 0.0)


def reliability(
    observables: Observables, found: Positions, requirement: Requirement
) -> Reliability:
    """Return the size of errors in a mark that tests find, and the effect of smaller ones."""
    v = observables.vectors
    sigma_bias = observables.sigma_laser_bias
    stated, _ = _covariances(v, observables.cov_centres, sigma_bias, requirement)
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


def _covariances(
    v: Array, cov_centres: Array, sigma_laser_bias: float, requirement: Requirement
) -> tuple[Array, Array]:
    """Return the centres' covariances as a survey states them, and the true ones.

    A survey takes the remaining laser biases as independent, along the ranges; true are noise and
    the error of aiming across them, beside a range error that all centres share.
    """
    d2 = np.maximum(np.sum(v**2, axis=-1), 1e-9)[..., None, None]
    along = v[..., :, None] * v[..., None, :]
    noise = cov_centres + requirement.sigma_marks**2 * np.eye(3)
    bias2 = claimed_bias_variance(sigma_laser_bias)
    stated = noise + requirement.resection.sigma_common**2 * np.eye(3) + bias2 / d2 * along
    return stated, noise + _SIGMA_AIM**2 * (d2 * np.eye(3) - along)


def _free_stations(observables: Observables, requirement: Requirement) -> tuple[Positions, Array]:
    """Return the positions of free stations, and their motion by a common range error of 1 m."""
    parts = information(observables, requirement, is_summed=True)
    normal, cov_rhs, bias_rhs = (part[:, 0] for part in parts)
    for matrix in (normal, cov_rhs):
        matrix[:, [0, 1], [0, 1]] += requirement.sigma_levelling**-2
    cofactor, is_fixed = invert_each(normal)
    is_fixed &= np.trace(cofactor[:, 3:, 3:], axis1=1, axis2=2) <= LOOSE2
    cofactor[~is_fixed] = 0.0
    cov, moved = cofactor @ cov_rhs @ cofactor, (cofactor @ bias_rhs[..., None])[..., 0]
    cov[~is_fixed] = cofactor[~is_fixed] = np.diag(np.full(6, np.inf))
    return Positions(cov, cofactor, np.array(observables.is_seen)), moved


def _three_circles(observables: Observables, requirement: Requirement) -> tuple[Positions, Array]:
    """Return positions by three circles, and their motion by a common range error of 1 m."""
    level2 = requirement.sigma_levelling**2
    is_cut, three = _choose_three(observables)
    cov = np.tile(np.diag(np.full(6, np.inf)), (len(is_cut), 1, 1))
    cofactor, moved = cov.copy(), np.zeros(cov.shape[:2])
    used = np.zeros(observables.is_seen.shape, dtype=np.bool_)
    rows = np.flatnonzero(is_cut)
    pairs = rows[:, None], three[rows]
    v = observables.vectors[pairs]
    sigma_bias = observables.sigma_laser_bias
    stated, true = _covariances(v, observables.cov_centres[pairs], sigma_bias, requirement)
    J, lean = _circle_equations(v)
    weights = np.linalg.inv(_on_circles(J, stated) + level2 * lean @ _transposed(lean))
    weighted = _transposed(J) @ weights
    inverse = np.linalg.inv((weighted @ J).sum(axis=1))
    gain = inverse[:, None] @ weighted
    tilt = (gain @ lean).sum(axis=1)
    position = (gain @ _on_circles(J, true) @ _transposed(gain)).sum(axis=1)
    position = position + level2 * tilt @ _transposed(tilt)
    flat2 = np.sum(v[..., :2] ** 2, axis=2)
    left = np.stack([-v[..., 1], v[..., 0], np.zeros(v.shape[:-1])], axis=-1) / flat2[..., None]
    is_fixed = np.trace(position, axis1=1, axis2=2) <= LOOSE2
    rows, (inverse, gain, tilt, position, left, true, v) = (
        rows[is_fixed],
        (part[is_fixed] for part in (inverse, gain, tilt, position, left, true, v)),
    )
    used[rows[:, None], three[rows]] = True
    cov[rows] = 0.0
    cov[rows, 0, 0] = cov[rows, 1, 1] = level2
    cov[rows, 2, 2] = np.einsum("eki,ekij,ekj->e", left, true, left) / 9.0
    cov[rows, 3:, :2] = -level2 * tilt
    cov[rows, :2, 3:] = -level2 * _transposed(tilt)
    cov[rows, 3:, 3:] = position
    cofactor[rows] = cov[rows]
    cofactor[rows, 3:, 3:] = inverse
    towards = v / np.linalg.norm(v, axis=2, keepdims=True)
    moved[rows, 3:] = np.einsum("ekij,ekjl,ekl->ei", gain, J[is_fixed], towards)
    return Positions(cov, cofactor, used), moved


def _choose_three(observables: Observables) -> tuple[Mask, Index]:
    """Return at which stations three circles cut, and the three marks whose circles cut best."""
    v = observables.vectors[..., :2]
    lines = v / np.maximum(np.linalg.norm(v, axis=2, keepdims=True), 1e-9)
    is_cut, three = np.zeros(len(v), dtype=np.bool_), np.zeros((len(v), 3), dtype=np.intp)
    _choose_each(lines, observables.is_seen, is_cut, three)
    return is_cut, three


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
def _choose_each(lines: Array, is_seen: Mask, is_cut: Mask, three: Index) -> None:
    """Choose three marks for each station."""
    places, seen = np.empty(lines.shape[1], np.intp), np.empty((lines.shape[1], 2))
    for e in range(len(lines)):
        n = 0
        for m in range(lines.shape[1]):
            if is_seen[e, m]:
                places[n], seen[n, 0], seen[n, 1] = m, lines[e, m, 0], lines[e, m, 1]
                n += 1
        trace, _ = best_three(seen[:n], -_ANY, _ANY, three[e])
        is_cut[e] = trace < _TRACE_MOST
        if is_cut[e]:
            for k in range(3):
                three[e, k] = places[three[e, k]]


@compiled
def _add_contributions(
    vectors: Array, stated: Array, true: Array, is_seen: Mask, out: tuple[Array, Array, Array]
) -> None:
    """Add the contribution of each mark to its own row of the output, or all to the only one."""
    normal, cov_rhs, bias_rhs = out
    weight, J = np.empty((3, 3)), np.zeros((3, 6))
    weighted, propagated = np.empty((3, 6)), np.empty((3, 6))
    J[0, 3] = J[1, 4] = J[2, 5] = 1.0
    for e in range(len(vectors)):
        for m in range(vectors.shape[1]):
            if not is_seen[e, m] or not invert(stated[e, m], weight):
                continue
            k = min(m, normal.shape[1] - 1)
            x, y, z = vectors[e, m, 0], vectors[e, m, 1], vectors[e, m, 2]
            d = np.sqrt(x * x + y * y + z * z)
            J[0, 1], J[0, 2], J[1, 0], J[1, 2], J[2, 0], J[2, 1] = z, -y, -z, x, y, -x
            _multiply(weight, J, weighted)
            _multiply(true[e, m], weighted, propagated)
            for i in range(6):
                along = weighted[0, i] * x + weighted[1, i] * y + weighted[2, i] * z
                bias_rhs[e, k, i] += along / d
                for j in range(6):
                    for a in range(3):
                        normal[e, k, i, j] += J[a, i] * weighted[a, j]
                        cov_rhs[e, k, i, j] += weighted[a, i] * propagated[a, j]


@compiled
def _multiply(left: Array, right: Array, out: Array) -> None:
    """Write the product of a (3, 3) and a (3, 6) matrix."""
    for i in range(3):
        for j in range(6):
            out[i, j] = (
                left[i, 0] * right[0, j] + left[i, 1] * right[1, j] + left[i, 2] * right[2, j]
            )
