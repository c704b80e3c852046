"""Covariances of positions from those of centres, without any observation.

Hides the normal equations of the resection methods at places where nobody has stood yet. Rotations
are about the station itself, so that the translation block is the covariance of the position.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.estimation.linear_algebra import invert, invert_each
from spheremark.pipelines.estimation.statistical_tests import block_statistics, noncentrality
from spheremark.pipelines.geometry import by_motion
from spheremark.pipelines.model import Array, Index, Mask
from spheremark.pipelines.placement.plan import Requirement
from spheremark.pipelines.positioning.trilateration import best_three, circles
from spheremark.pipelines.scan.rigs import N_LASERS

_BIAS_LEFT = 0.22  # of the spread of laser biases: what a survey leaves to each centre, simulated
_SIGMA_AIM = 1.5e-5  # [rad] of each direction, by mounting and encoder, after both faces; simulated
LOOSE2 = 1.0
"""Variance of a position above which it is none [m^2]."""

_PARALLEL = 1e6  # cofactor of a position from circles that touch


Group = tuple[Any, ...]
"""Arrays and numbers that go together into a kernel."""

Vector = tuple[float, float, float]
"""Coordinates that go together into a kernel."""


class Positions(NamedTuple):
    """What centres make of positions.

    Attributes
    ----------
    cov_motion : (e, 6, 6)
        Of a small motion about the station, rotation [rad] and translation [m]; infinite on the
        diagonal where there is no position.
    cofactor : (e, 6, 6)
        The same as the adjustment of the survey will claim it.
    used : (e, n)
        Marks that carry each position.
    """

    cov_motion: Array
    cofactor: Array
    used: Mask


class Sighting(NamedTuple):
    """Marks as seen from eyes.

    Attributes
    ----------
    eyes_site : (e, 3)
        Places of the LiDAR [m].
    marks_site : (n, 3)
        Marks [m].
    cov_centres : (e, n, 3, 3)
        Covariances of their centres by noise, in the axes of the site [m^2].
    sigma_laser_bias : float
        Spread of what each laser measures too long [m].
    is_seen : (e, n)
        Which are found.
    """

    eyes_site: Array
    marks_site: Array
    cov_centres: Array
    sigma_laser_bias: float
    is_seen: Mask


def predict_positions(sighting: Sighting, wish: Requirement) -> Positions:
    """Predict the covariances of positions.

    Notes
    -----
    ``free_station``: weights are those of the adjustment, ``Q = (sum J' P J + G)^-1`` with
    ``J = [-[v]x, 1]`` of each mark and the AHRS's information ``G`` on roll and pitch; a survey
    takes what lasers and gimbal leave as different at every mark. The covariance of what comes out
    has them as they are: noise of each mark, what is left of its direction, and an excess of all
    ranges together, which hardly moves a station that marks stand round: ``Q J' P C P J Q``. What
    all centres are too high, a station is too low.
    ``paper``: horizontal distances and heights of the three marks whose circles cut best, and the
    lean carried through them as ``ranging`` does; its heading is that of the three directions.
    """
    eyes, marks = _places(sighting)
    covs = sighting.cov_centres + wish.sigma_marks**2 * np.eye(3)
    extra = _extra(sighting, wish)
    shape = (len(eyes), 6, 6)
    cofactor, moved, out = np.zeros(shape), np.zeros(shape[:2]), np.zeros(shape)
    used = np.array(sighting.is_seen)
    if wish.method == "paper":
        used[:] = False
        seen = (eyes, marks, covs, sighting.is_seen)
        _by_circles(seen, extra, wish.sigma_levelling**2, used, (out, cofactor, moved))
    else:
        _by_motion(
            (eyes, marks, covs, used), extra, wish.sigma_levelling**-2, (out, cofactor, moved)
        )
    out += shared_variance(sighting.sigma_laser_bias) * moved[:, :, None] * moved[:, None, :]
    out[:, 5, 5] += wish.resection.sigma_height**2
    return Positions(cov_motion=out, cofactor=cofactor, used=used)


def claimed_bias_variance(sigma_laser_bias: float) -> float:
    """Return the variance that a survey leaves to each centre's distance for the lasers' biases."""
    return (_BIAS_LEFT * sigma_laser_bias) ** 2


def shared_variance(sigma_laser_bias: float) -> float:
    """Return the variance of what all ranges of a survey are too long: the lasers' mean."""
    return sigma_laser_bias**2 / N_LASERS


@compiled
def _claimed(cov: Array, v: Vector, extra: Group, known: Array, true: Array) -> None:
    """Fill in a centre's covariance as a survey takes it, and as it is, shared excess apart."""
    bias2, common2, aim2 = extra
    d2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    for i in range(3):
        for j in range(3):
            along = v[i] * v[j]
            known[i, j] = cov[i, j] + bias2 * along / d2
            true[i, j] = cov[i, j] - aim2 * along
        known[i, i] += common2
        true[i, i] += aim2 * d2


@compiled
def _inform(cov: Array, v: Vector, extra: Group, out: Group) -> bool:
    """Fill in what one mark adds to normal matrix, spread and pull; false if it adds nothing."""
    N, spread, pull = out
    weight, J = np.empty((3, 3)), np.zeros((3, 6))
    weighted, spread_by = np.empty((3, 6)), np.empty((3, 6))
    known, true = np.empty((3, 3)), np.empty((3, 3))
    x, y, z = v
    _claimed(cov, v, extra, known, true)
    if not invert(known, weight):
        return False
    J[0, 1], J[0, 2], J[1, 0], J[1, 2], J[2, 0], J[2, 1] = z, -y, -z, x, y, -x
    J[0, 3] = J[1, 4] = J[2, 5] = 1.0
    d = np.sqrt(x * x + y * y + z * z)
    _product(weight, J, weighted)
    _product(true, weighted, spread_by)
    for i in range(6):
        pull[i] = (weighted[0, i] * x + weighted[1, i] * y + weighted[2, i] * z) / d
        for j in range(6):
            N[i, j] = J[0, i] * weighted[0, j] + J[1, i] * weighted[1, j] + J[2, i] * weighted[2, j]
            spread[i, j] = (
                weighted[0, i] * spread_by[0, j]
                + weighted[1, i] * spread_by[1, j]
                + weighted[2, i] * spread_by[2, j]
            )
    return True


@compiled
def _by_motion(
    seen: tuple[Array, Array, Array, Mask], extra: Group, gravity: float, out: Group
) -> None:
    """Fill in the covariances of free stations, and how a common excess of ranges moves them."""
    eyes, marks, covs, is_seen = seen
    cov_motion, cofactor, moved = out
    N, spread, pull = np.empty((6, 6)), np.empty((6, 6)), np.empty(6)
    one = (np.empty((6, 6)), np.empty((6, 6)), np.empty(6))
    for e in range(len(eyes)):
        N[:], pull[:] = 0.0, 0.0
        N[0, 0] = N[1, 1] = gravity
        spread[:] = N
        for m in range(len(marks)):
            if not is_seen[e, m]:
                continue
            v = (marks[m, 0] - eyes[e, 0], marks[m, 1] - eyes[e, 1], marks[m, 2] - eyes[e, 2])
            if _inform(covs[e, m], v, extra, one):
                N += one[0]
                spread += one[1]
                pull += one[2]
        inverse = cofactor[e]
        ok = invert(N, inverse)
        if not ok or inverse[3, 3] + inverse[4, 4] + inverse[5, 5] > LOOSE2:
            inverse[:] = np.diag(np.full(6, np.inf))
            cov_motion[e] = inverse
            continue
        cov_motion[e] = inverse @ spread @ inverse
        moved[e] = inverse @ pull


class Information(NamedTuple):
    """What each mark adds to what a free station knows; sums over marks are what it knows.

    Attributes
    ----------
    normal : (e, n, 6, 6)
        To the normal matrix by the weights of a survey.
    spread : (e, n, 6, 6)
        To the spread of its right-hand side.
    pull : (e, n, 6)
        To what a common excess of ranges does to that [1/m].
    """

    normal: Array
    spread: Array
    pull: Array


def information(sighting: Sighting, wish: Requirement) -> Information:
    """Return what each mark adds to what a free station knows."""
    shape = sighting.is_seen.shape
    out = Information(np.zeros((*shape, 6, 6)), np.zeros((*shape, 6, 6)), np.zeros((*shape, 6)))
    covs = sighting.cov_centres + wish.sigma_marks**2 * np.eye(3)
    eyes, marks = _places(sighting)
    _informed((eyes, marks, covs, sighting.is_seen), _extra(sighting, wish), tuple(out))
    return out


def independent_information(sighting: Sighting, wish: Requirement) -> Array:
    """Return what each mark tells of a station's position if its rotation were known."""
    v = sighting.marks_site[None] - sighting.eyes_site[:, None]
    across = np.sum(v**2, axis=2)[..., None, None] * np.eye(3) - v[..., :, None] * v[..., None, :]
    covs = sighting.cov_centres + wish.sigma_marks**2 * np.eye(3) + _SIGMA_AIM**2 * across
    is_seen = sighting.is_seen[..., None, None]
    return np.where(is_seen, np.linalg.inv(np.where(is_seen, covs, np.eye(3))), 0.0)


def _places(sighting: Sighting) -> tuple[Array, Array]:
    """Return eyes and marks as the kernels want them."""
    return np.ascontiguousarray(sighting.eyes_site), np.ascontiguousarray(sighting.marks_site)


def _extra(sighting: Sighting, wish: Requirement) -> tuple[float, float, float]:
    """Return the variances of what lasers and gimbal leave, as a survey takes it and as it is."""
    bias2 = claimed_bias_variance(sighting.sigma_laser_bias)
    return bias2, wish.resection.sigma_common**2, _SIGMA_AIM**2


@compiled
def _informed(seen: tuple[Array, Array, Array, Mask], extra: Group, out: Group) -> None:
    """Fill in what each seen mark adds."""
    eyes, marks, covs, is_seen = seen
    for e in range(len(eyes)):
        for m in range(len(marks)):
            if is_seen[e, m]:
                v = (marks[m, 0] - eyes[e, 0], marks[m, 1] - eyes[e, 1], marks[m, 2] - eyes[e, 2])
                _inform(covs[e, m], v, extra, (out[0][e, m], out[1][e, m], out[2][e, m]))


@compiled
def _product(design: Array, circle: Array, out: Array) -> None:
    """Fill in the product of a (3, 3) and a (3, 6) matrix."""
    for i in range(3):
        for j in range(6):
            out[i, j] = (
                design[i, 0] * circle[0, j]
                + design[i, 1] * circle[1, j]
                + design[i, 2] * circle[2, j]
            )


@compiled
def _best_of(eye: Array, marks: Array, is_seen: Mask, lines: Array, three: Index) -> bool:
    """Find the three seen marks whose circles cut best; false if no three cut at all."""
    seen = np.flatnonzero(is_seen)
    for k in range(len(seen)):
        x, y = marks[seen[k], 0] - eye[0], marks[seen[k], 1] - eye[1]
        flat = max(np.hypot(x, y), 1e-9)
        lines[k, 0], lines[k, 1] = x / flat, y / flat
    spread, _ = best_three(lines[: len(seen)], -1.0, 1.0, three)
    if not spread < _PARALLEL:
        return False
    three[:] = seen[three]
    return True


@compiled
def _circle(cov: Array, v: Vector, rules: tuple[Group, float], row: int, out: Group) -> float:
    """Fill in one mark's circle and height: two rows of all; return the variance of its azimuth.

    Filled in are derivative, covariance of errors, weights, effect of the lean, and that of a
    common excess of ranges.
    """
    extra, level2 = rules
    design, errors, weights, lean, excess = out
    known, true, circle = np.empty((3, 3)), np.empty((3, 3)), np.zeros((2, 3))
    x, y, z = v
    _claimed(cov, v, extra, known, true)
    flat = max(np.hypot(x, y), 1e-9)
    ux, uy = x / flat, y / flat
    circle[0, 0], circle[0, 1], circle[1, 2] = ux, uy, 1.0
    s = slice(row, row + 2)
    design[s] = circle
    lean[row, 0], lean[row, 1] = -z * uy, z * ux  # the first two columns of -[v]x
    lean[row + 1, 0], lean[row + 1, 1] = y, -x
    errors[s, s] = circle @ true @ circle.T
    weights[s, s] = np.linalg.inv(circle @ known @ circle.T + level2 * lean[s] @ lean[s].T)
    d = np.sqrt(flat * flat + z * z)
    excess[row], excess[row + 1] = flat / d, z / d
    side2 = uy * uy * true[0, 0] - 2.0 * ux * uy * true[0, 1] + ux * ux * true[1, 1]
    return float(side2 / (flat * flat))


@compiled
def _by_circles(seen: Group, extra: Group, level2: float, used: Mask, out: Group) -> None:
    """Fill in the covariances of positions by three circles, and how a common excess moves them."""
    eyes, marks, covs, is_seen = seen
    cov_motion, cofactor, moved = out
    lines, three = np.empty((len(marks), 2)), np.empty(3, np.intp)
    design, lean, excess = np.zeros((6, 3)), np.zeros((6, 2)), np.empty(6)
    errors, weights, inverse = np.zeros((6, 6)), np.zeros((6, 6)), np.empty((3, 3))
    for e in range(len(eyes)):
        cov_motion[e] = np.diag(np.full(6, np.inf))
        cofactor[e] = cov_motion[e]
        if not _best_of(eyes[e], marks, is_seen[e], lines, three):
            continue
        yaw2 = 0.0
        for r in range(3):
            m = three[r]
            v = (marks[m, 0] - eyes[e, 0], marks[m, 1] - eyes[e, 1], marks[m, 2] - eyes[e, 2])
            rows = (design, errors, weights, lean, excess)
            yaw2 += _circle(covs[e, m], v, (extra, level2), 2 * r, rows) / 9.0
        if not invert(design.T @ weights @ design, inverse):
            continue
        gain = inverse @ design.T @ weights
        tilt = gain @ lean
        position = gain @ errors @ gain.T + level2 * tilt @ tilt.T
        if np.trace(position) > LOOSE2:
            continue
        for m in three:
            used[e, m] = True
        cov_motion[e] = 0.0
        cov_motion[e, 3:, 3:] = position
        cov_motion[e, 0, 0] = cov_motion[e, 1, 1] = level2
        cov_motion[e, 2, 2] = yaw2
        cov_motion[e, 3:, :2] = -level2 * tilt
        cov_motion[e, :2, 3:] = -level2 * tilt.T
        cofactor[e] = cov_motion[e]
        cofactor[e, 3:, 3:] = inverse
        moved[e, 3:] = gain @ excess


class Reliability(NamedTuple):
    """What would show of an error in one mark, and what would not.

    Attributes
    ----------
    redundancies : (e, n)
        Redundancy of each mark's observations together; 0 where it is not used.
    detectable_biases : (e, n)
        Minimal detectable bias along the weakest axis [m].
    external : (e, n)
        Largest shift of the position by a bias of that size [m].
    """

    redundancies: Array
    detectable_biases: Array
    external: Array


def reliability(sighting: Sighting, found: Positions, wish: Requirement) -> Reliability:
    """Say how large an error in one mark must be to be found, and what a smaller one does."""
    v = sighting.marks_site[None] - sighting.eyes_site[:, None]
    d2 = np.maximum(np.sum(v**2, axis=2), 1e-9)[..., None, None]
    known = sighting.cov_centres + (wish.sigma_marks**2 + wish.resection.sigma_common**2) * np.eye(
        3
    )
    bias2 = claimed_bias_variance(sighting.sigma_laser_bias)
    known = known + bias2 * v[..., :, None] * v[..., None, :] / d2
    covs = np.where(found.used[..., None, None], known, np.eye(3))
    is_fixed: Mask = np.asarray(np.isfinite(found.cov_motion).all(axis=(1, 2)))
    used = np.asarray(found.used & is_fixed[:, None])
    inverse = np.where(is_fixed[:, None, None], found.cofactor, 0.0)
    if wish.method == "paper":
        J, covs = _circle_equations(v, covs, wish)
        inverse = inverse[:, 3:, 3:]
        to_position = np.eye(3)
    else:
        J = by_motion(v)
        to_position = np.eye(6)[3:]
    weights = invert_each(covs)[0]
    weighted = np.swapaxes(weights @ J, -1, -2)
    tests = block_statistics(
        np.zeros(J.shape[:-1]), weights, J @ inverse[:, None] @ np.swapaxes(J, -1, -2)
    )
    shift = noncentrality(wish.resection.test_level, wish.resection.test_power)
    effects = to_position @ inverse[:, None] @ weighted
    return Reliability(
        redundancies=np.where(used, tests.redundancies, 0.0),
        detectable_biases=np.where(used, tests.detectable_biases(shift), np.inf),
        external=np.where(used, tests.external_reliabilities(effects, shift), np.inf),
    )


def _circle_equations(v: Array, covs: Array, wish: Requirement) -> tuple[Array, Array]:
    """Return derivatives, (e, n, 2, 3), and covariances of horizontal distances and heights."""
    circle = circles(v)[1]
    lean = circle @ by_motion(v)[..., :2]
    cov = circle @ covs @ np.swapaxes(circle, -1, -2)
    return circle, cov + wish.sigma_levelling**2 * lean @ np.swapaxes(lean, -1, -2)
