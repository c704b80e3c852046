"""The radius that a sphere's returns show by themselves: the test of the one that is assumed.

Hides its estimate along the beams together with the centre. The scatter of residuals passes a ball
of another size that is seen at the wrong range; this does not.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.estimation.linear_algebra import inverse
from spheremark.pipelines.model import Array, Beams
from spheremark.pipelines.sphere.linearisation import Linear, linearise
from spheremark.pipelines.sphere.normal_equations import normals_of_spheres
from spheremark.pipelines.sphere.returns import Rows, in_play, rows_of, rows_of_one
from spheremark.pipelines.threads import side_by_side

_ASKED = 1.0  # standard deviations of one step, beyond which the greatest likelihood is sought
_BETTER, _BETTER_OWN = 9.0, 14.0  # by which it must be greater, as a chi-square; noise unknown
_CLIP = 9.0  # squared standard deviations beyond which a residual is a stray
_WEAK_PRIOR = 5.0  # radii: the same as the prior where it only keeps equations solvable
_N_WORTH = 6  # spheres for which a second thread gains
_N_STEPS = 8
_SETTLED = 1e-4  # [m] of a step: what is asked is millimetres
_STEP_MAX = 0.25  # radii per step
_PRIOR = 0.5  # radii: standard deviation of centre and radius that no return tells
_MARGIN = 0.1  # radii by which a footprint may pass a sphere by and still be its own
_START = 0.1  # radii by which a centre may be off per axis
_SIGMA_MAX, _RADIUS_MAX = 0.4, 5.0  # radii: what is worse or larger is no answer
_N_ROUNDS = 3
_SPAN_MIN = 0.001  # [m] returns that lie in one place have no span
_OUTERMOST = 1.2  # radii over the ninth tenth of the returns' distances from the middle
_NORMAL = 1.4826  # standard deviation of a normal spread over its median of absolute values
_SCATTER_MIN = 0.001  # [m] 2 mm quantisation alone gives as much
_STRAY_SIGMAS = 4.0
_SIGMAS = 3.0  # by which a free radius may be off, and
_SLACK = 0.006  # [m] by which it may whatever its sigma


class Weighing(NamedTuple):
    """What is known of the ranges of some returns.

    Attributes
    ----------
    ranges : (n,)
        Measured ranges without the biases of their lasers [m].
    variances : (n,)
        Of their noise [m^2].
    weights : (n,)
        Robust weights, 0 to 1.
    """

    ranges: Array
    variances: Array
    weights: Array


def free_radii(
    rows: Rows, weighing: Weighing, spheres: Array, covs: Array, residuals: Array
) -> tuple[Array, Array]:
    """Return radii estimated together with the centres, and their standard deviations.

    Notes
    -----
    One step of Gauss and Newton from the assumed radius (Rao's score): linear in the noise, so that
    it is unbiased and its sigma holds if the assumption is true, however few returns there are.
    The radius of greatest likelihood is not: small spheres look precise. The sigma is that of the
    step by the noise alone (a sandwich). Where the greatest likelihood is so much greater that the
    assumption must be wrong, its radius is the answer.
    """
    radii, sigmas = np.empty(len(spheres)), np.empty(len(spheres))

    def part(first: int, end: int) -> None:
        _shown(rows, weighing, spheres, covs, residuals, (radii, sigmas, first, end))

    side_by_side(part, len(spheres), worth=_N_WORTH)
    return radii, sigmas


@compiled
def _shown(
    rows: Rows,
    weighing: Weighing,
    spheres: Array,
    covs: Array,
    residuals: Array,
    out: tuple[Array, Array, int, int],
) -> None:
    """Fill in radii and sigmas from one place among spheres to another."""
    radii, sigmas, first, end = out
    for m in range(first, end):
        own = slice(rows.firsts[m], rows.firsts[m + 1])
        told = Weighing(weighing.ranges[own], weighing.variances[own], weighing.weights[own])
        radius, sigma = _shown_by_one(
            rows_of_one(rows, m), told, spheres[m], covs[m], residuals[own]
        )
        radii[m], sigmas[m] = _known(radius, sigma, spheres[m, 3])


@compiled
def _shown_by_one(
    rows: Rows, weighing: Weighing, sphere: Array, cov: Array, residuals: Array
) -> tuple[float, float]:
    """Return radius and sigma of one sphere."""
    step, known, sigma = _stepped(rows, weighing, sphere, cov, residuals)
    radius = sphere[3] + step[3]
    if abs(step[3]) > _ASKED * sigma:
        limit = _STEP_MAX * sphere[3]
        found, known = _free(rows, weighing, sphere + np.clip(step, -limit, limit), known)
        linear = linearise(rows, found.reshape(1, 4), cov.reshape(1, 4, 4), weighing.weights > 0.0)
        better = weighing.ranges - linear.ranges
        if _misfit(weighing, residuals) - _misfit(weighing, better) > _BETTER:
            radius, sigma = found[3], np.sqrt(known[3, 3])
    return radius, sigma


@compiled
def _known(radius: float, sigma: float, assumed: float) -> tuple[float, float]:
    """Return a radius with its sigma, NaN where these say that nothing is known."""
    if sigma < _SIGMA_MAX * assumed and 0.0 < radius < _RADIUS_MAX * assumed:
        return radius, sigma
    return np.nan, np.nan


@compiled
def _with_radius(cov: Array, variance: float) -> Array:
    """Return the covariance of a centre as such of a sphere, with a variance of the radius."""
    wide = np.zeros((4, 4))
    wide[:3, :3] = cov[:3, :3]
    wide[3, 3] = variance
    return wide


@compiled
def _stepped(
    rows: Rows, weighing: Weighing, sphere: Array, cov: Array, residuals: Array
) -> tuple[Array, Array, float]:
    """Return a step of centre and radius, (4,), what is known of these, and sigma of the radius."""
    weak = np.eye(4) / (_WEAK_PRIOR * sphere[3]) ** 2
    known = _with_radius(cov, cov[0, 0] + cov[1, 1] + cov[2, 2])
    N, _, _, _ = _summed(rows, weighing, sphere, known, residuals)
    known = inverse(N + np.eye(4) / (_PRIOR * sphere[3]) ** 2)
    N, pull, linear, per_square = _summed(rows, weighing, sphere, known, residuals)
    by_pull = inverse(N + weak)
    of_noise = per_square**2 * weighing.variances
    spread = normals_of_spheres(rows, linear, residuals, of_noise, 4)[0][0]
    variance = np.sum(by_pull[3] * np.sum(spread * by_pull[3], axis=1))
    return np.sum(by_pull * pull, axis=1), known, np.sqrt(variance)


@compiled
def _summed(
    rows: Rows, weighing: Weighing, sphere: Array, cov: Array, residuals: Array
) -> tuple[Array, Array, Linear, Array]:
    """Return normal equations of a sphere whose radius is free, and what they are summed from."""
    is_in = weighing.weights > 0.0
    linear = linearise(rows, sphere.reshape(1, 4), cov.reshape(1, 4, 4), is_in)
    per_square = weighing.weights / (weighing.variances + linear.bends**2)
    N, pull = normals_of_spheres(rows, linear, residuals, per_square, 4)
    return N[0], pull[0], linear, per_square


@compiled
def _misfit(weighing: Weighing, residuals: Array) -> float:
    """Return the sum of squared residuals in units of the noise, strays counting as such."""
    total = 0.0
    for i in range(len(residuals)):
        square = residuals[i] ** 2 / weighing.variances[i]
        total += weighing.weights[i] * min(square, _CLIP)
    return total


@compiled
def _free(rows: Rows, weighing: Weighing, sphere: Array, cov: Array) -> tuple[Array, Array]:
    """Return the centre with radius, (4,), where steps settle, and the covariance of these."""
    prior, limit = np.eye(4) / (_PRIOR * sphere[3]) ** 2, _STEP_MAX * sphere[3]
    is_in = weighing.weights > 0.0
    for _ in range(_N_STEPS):
        linear = linearise(rows, sphere.reshape(1, 4), cov.reshape(1, 4, 4), is_in)
        per_square = weighing.weights / (weighing.variances + linear.bends**2)
        N, pull = normals_of_spheres(rows, linear, weighing.ranges - linear.ranges, per_square, 4)
        cov = inverse(N[0] + prior)
        step = np.clip(np.sum(cov * pull[0], axis=1), -limit, limit)
        sphere = sphere + step
        if np.abs(step).max() < _SETTLED:
            break
    return sphere, cov


def own_radius(shots: Beams, radius: float, up: Array) -> tuple[float, float]:
    """Return the radius that one sphere's returns show, all with the same noise, and its sigma.

    Notes
    -----
    A centre is fitted with the radius that is assumed, then one step is made from it. Where that
    says that another radius is true, it starts again with the sphere that the returns span: from a
    smaller one the beams at the outline would be taken for such that pass by. The noise is that of
    the residuals, and what is off by more than some sigmas has no weight: both are found again each
    round.
    """
    n = len(shots.ranges)
    nothing = np.zeros(n, dtype=np.intp)
    rows = rows_of(shots, np.array([0, n]), up, nothing, (nothing, np.ones(n), 0.0))
    spanned = _spanned(shots)
    weighing, residuals, sphere, cov = _fitted(rows, spanned, radius)
    step, _, sigma = _stepped(rows, weighing, sphere, cov, residuals)
    radius_free = radius + step[3]
    if abs(step[3]) > _ASKED * sigma:
        own, known, gain = _own_spanned(rows, spanned, sphere)
        if gain > _BETTER_OWN:
            radius_free, sigma = own[3], np.sqrt(known[3, 3])
    found: tuple[float, float] = _known(radius_free, sigma, radius)
    return found


def _fitted(rows: Rows, spanned: Array, radius: float) -> tuple[Weighing, Array, Array, Array]:
    """Return weights, residuals, the best sphere of a known radius, and its covariance."""
    axis = rows.directions.mean(axis=1)
    shift = 2.0 / 3.0 * (radius - spanned[3]) / float(np.linalg.norm(axis))
    sphere = np.array([*(spanned[:3] + shift * axis), radius])
    cov = _with_radius((_START * radius) ** 2 * np.eye(3), 0.0)
    for _ in range(_N_STEPS):
        linear = linearise(rows, sphere[None], cov[None])
        weighing, residuals = _gated(rows, linear, radius)
        per_square = weighing.weights / (weighing.variances + linear.bends**2)
        N, pull = normals_of_spheres(rows, linear, residuals, per_square, 3)
        known = inverse(N[0] + np.eye(3) / (_PRIOR * radius) ** 2)
        limit = _STEP_MAX * radius
        sphere[:3] += np.clip(known @ pull[0], -limit, limit)
        cov = _with_radius(known, 0.0)
    return *_gated(rows, linearise(rows, sphere[None], cov[None]), radius), sphere, cov


def _gated(rows: Rows, linear: Linear, radius: float) -> tuple[Weighing, Array]:
    """Return the weights of what lies on a sphere and not on its pole, and residuals."""
    residuals = rows.ranges - linear.ranges
    is_in = in_play(rows, linear.offsets, np.array([_MARGIN * radius]), radius)
    sigma = _scatter(residuals[is_in])
    is_in &= np.abs(residuals) < _STRAY_SIGMAS * sigma
    variance = sigma**2 * is_in.sum() / max(is_in.sum() - 4.0, 1.0)
    variances, weights = np.full(len(is_in), variance), is_in.astype(np.float64)
    return Weighing(rows.ranges.copy(), variances, weights), residuals


def _own_spanned(rows: Rows, own: Array, assumed: Array) -> tuple[Array, Array, float]:
    """Return the sphere of greatest likelihood and its covariance, from that which returns span.

    And by how much it explains them better than one of the assumed radius, as a chi-square: the
    noise is not known.
    """
    known = (_START * own[3]) ** 2 * np.eye(4)
    for _ in range(_N_ROUNDS):
        weighing = _gated(rows, linearise(rows, own[None], known[None]), float(own[3]))[0]
        own, known = _free(rows, weighing, own, known)
        own[3] = np.clip(own[3], _SPAN_MIN, 2.0 * _RADIUS_MAX * assumed[3])
    linear = linearise(rows, own[None], known[None])
    weighing, residuals = _gated(rows, linear, float(own[3]))
    same = linearise(rows, assumed[None], _with_radius(known, 0.0)[None])
    others = rows.ranges - same.ranges
    is_in, limit = weighing.weights > 0.0, _STRAY_SIGMAS**2 * weighing.variances
    least = max(int(is_in.sum()), 1) * _SCATTER_MIN**2
    worse, better = (
        max(float(np.minimum(off**2, limit)[is_in].sum()), least) for off in (others, residuals)
    )
    return own, known, max(int(is_in.sum()) - 4, 0) * float(np.log(worse / better))


def _spanned(shots: Beams) -> Array:
    """Return the centre and radius, (4,), of a sphere that spans returns across the beam."""
    axis = shots.directions_base.mean(axis=0)
    axis /= np.linalg.norm(axis)
    p = shots.origins_base + shots.ranges[:, None] * shots.directions_base
    middle = np.median(p, axis=0)
    v = p - middle
    beside = np.linalg.norm(v - (v @ axis)[:, None] * axis, axis=1)
    radius = max(_OUTERMOST * float(np.quantile(beside, 0.9)), _SPAN_MIN)
    # seen evenly, the half of a sphere is two thirds of its radius deep
    return np.array([*(middle + 2.0 / 3.0 * radius * axis), radius])


def _scatter(residuals: Array) -> float:
    """Return the robust standard deviation of residuals [m]; the least if there are none."""
    if not len(residuals):
        return _SCATTER_MIN
    return max(_NORMAL * float(np.median(np.abs(residuals))), _SCATTER_MIN)


def other_radius(radius: float, radius_free: float, sigma: float) -> list[str]:
    """Say whether returns show a sphere of another radius."""
    if abs(radius_free - radius) > max(_SIGMAS * sigma, _SLACK):
        return [f"its own radius is {1e3 * radius_free:.0f} mm"]
    return []
