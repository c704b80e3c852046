"""The radius that a sphere's returns show by themselves: the test of the one that is assumed.

Hides its estimate along the beams together with the centre. The scatter of residuals passes a ball
of another size that is seen at the wrong range; this does not.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipelines.fitting.equations import normals_of_spheres
from pipelines.fitting.linearising import Linear, linearise
from pipelines.fitting.rows import Rows, in_play, rows_of
from pipelines.values import Array, Beams, Mask

_ASKED = 1.0  # standard deviations of one step, beyond which the greatest likelihood is sought
_BETTER, _BETTER_OWN = 9.0, 14.0  # by which it must be greater, as a chi-square; noise unknown
_CLIP = 9.0  # squared standard deviations beyond which a residual is a stray
_WEAK_PRIOR = 5.0  # radii: the same as the prior where it only keeps equations solvable
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

    Parameters
    ----------
    rows : Rows
        Returns of all spheres.
    weighing : Weighing
        What is known of their ranges.
    spheres : (m, 4)
        Centres fitted with radii that are assumed, and these [m].
    covs : (m, 4, 4)
        How well the centres are known; zero of the radii [m^2].
    residuals : (n,)
        What the ranges leave after those of ``linearise`` at these [m].

    Returns
    -------
    radii, sigmas : (m,)
        Both NaN where the returns do not tell [m].

    Notes
    -----
    One step of Gauss and Newton from the assumed radius (Rao's score): linear in the noise, so that
    it is unbiased and its sigma holds if the assumption is true, however few returns there are.
    The radius of greatest likelihood is not: small spheres look precise. The sigma is that of the
    step by the noise alone (a sandwich). Where the greatest likelihood is so much greater that the
    assumption must be wrong, its radius is the answer.
    """
    steps, known, sigmas = _stepped(rows, weighing, spheres, covs, residuals)
    radius, radii = spheres[:, 3], spheres[:, 3] + steps[:, 3]
    is_asked = np.abs(steps[:, 3]) > _ASKED * sigmas
    if is_asked.any():
        limit = _STEP_MAX * radius[:, None]
        start = spheres + np.clip(steps, -limit, limit)
        found, known = _free(rows, weighing, start, known, is_asked)
        is_in = (weighing.weights > 0.0) & np.repeat(is_asked, np.diff(rows.firsts))
        better = weighing.ranges - linearise(rows, found, covs, is_in).ranges
        gains = _misfits(rows, weighing, residuals) - _misfits(rows, weighing, better)
        is_far = is_asked & (gains > _BETTER)
        radii = np.where(is_far, found[:, 3], radii)
        sigmas = np.where(is_far, np.sqrt(known[:, 3, 3]), sigmas)
    return _known(radii, sigmas, radius)


def _known(radii: Array, sigmas: Array, radius: Array) -> tuple[Array, Array]:
    """Return radii with sigmas, NaN where these say that nothing is known."""
    is_known = (sigmas < _SIGMA_MAX * radius) & (radii < _RADIUS_MAX * radius) & (radii > 0.0)
    return np.where(is_known, radii, np.nan), np.where(is_known, sigmas, np.nan)


def _with_radius(covs: Array, variances: Array | float) -> Array:
    """Return covariances of centres as such of spheres, with a variance of the radius."""
    wide = np.zeros((len(covs), 4, 4))
    wide[:, :3, :3] = covs[:, :3, :3]
    wide[:, 3, 3] = variances
    return wide


def _stepped(
    rows: Rows, weighing: Weighing, spheres: Array, covs: Array, residuals: Array
) -> tuple[Array, Array, Array]:
    """Return a step of centres and radii, (m, 4), what is known of these, and sigmas of radii."""
    is_in, square = weighing.weights > 0.0, spheres[:, 3, None, None] ** -2.0 * np.eye(4)

    def summed(wide: Array) -> tuple[Linear, Array, Array, Array]:
        linear = linearise(rows, spheres, wide, is_in)
        per_square = weighing.weights / (weighing.variances + linear.bends**2)
        return linear, per_square, *normals_of_spheres(rows, linear, residuals, per_square, 4)

    rough = _with_radius(covs, np.trace(covs[:, :3, :3], axis1=1, axis2=2))
    cov: Array = np.asarray(np.linalg.inv(summed(rough)[2] + square / _PRIOR**2))
    linear, per_square, N, pull = summed(cov)
    by_pull = np.linalg.inv(N + square / _WEAK_PRIOR**2)
    of_noise = per_square**2 * weighing.variances
    spread = by_pull @ normals_of_spheres(rows, linear, residuals, of_noise, 4)[0] @ by_pull
    return (by_pull @ pull[..., None])[..., 0], cov, np.sqrt(spread[:, 3, 3])


def _misfits(rows: Rows, weighing: Weighing, residuals: Array) -> Array:
    """Return the sums of squared residuals in units of the noise, strays counting as such."""
    square = residuals**2 / weighing.variances
    sums = np.cumsum(np.r_[0.0, weighing.weights * np.minimum(square, _CLIP)])
    return np.asarray(np.diff(sums[rows.firsts]))


def _free(
    rows: Rows, weighing: Weighing, spheres: Array, covs: Array, moves: Mask
) -> tuple[Array, Array]:
    """Return centres with radii, (m, 4), and their covariances; some move until they settle."""
    radius, counts, moves = spheres[:, 3], np.diff(rows.firsts), moves.copy()
    for _ in range(_N_STEPS):
        is_in = (weighing.weights > 0.0) & np.repeat(moves, counts)
        linear = linearise(rows, spheres, covs, is_in)
        per_square = is_in * weighing.weights / (weighing.variances + linear.bends**2)
        residuals = weighing.ranges - linear.ranges
        N, pull = normals_of_spheres(rows, linear, residuals, per_square, 4)
        inverse = np.linalg.inv(N + np.eye(4) / (_PRIOR * radius[:, None, None]) ** 2)
        covs = np.where(moves[:, None, None], inverse, covs)
        limit = _STEP_MAX * radius[:, None]
        step = np.clip(np.einsum("mij,mj->mi", inverse, pull), -limit, limit)
        spheres = np.where(moves[:, None], spheres + step, spheres)
        moves &= np.abs(step).max(axis=1) >= _SETTLED
        if not moves.any():
            break
    return spheres, covs


def own_radius(shots: Beams, radius: float, up: Array) -> tuple[float, float]:
    """Return the radius that one sphere's returns show, all with the same noise, and its sigma.

    Parameters
    ----------
    shots : Beams
        Returns from the sphere, and perhaps some of its pole.
    radius : float
        The radius that is assumed: nothing larger than five of it is an answer [m].
    up : (3,)
        Upward unit vector.

    Returns
    -------
    radius_free, sigma_radius_free : float
        Both NaN where the returns do not tell [m].

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
    steps, _, sigmas = _stepped(rows, weighing, sphere, cov, residuals)
    radii = radius + steps[:, 3]
    if np.abs(steps[0, 3]) > _ASKED * sigmas[0]:
        own, known, gain = _own_spanned(rows, spanned, sphere)
        if gain > _BETTER_OWN:
            radii, sigmas = own[:, 3], np.sqrt(known[:, 3, 3])
    radii, sigmas = _known(radii, sigmas, np.array([radius]))
    return float(radii[0]), float(sigmas[0])


def _fitted(rows: Rows, spanned: Array, radius: float) -> tuple[Weighing, Array, Array, Array]:
    """Return weights, residuals, the best sphere of a known radius, and its covariance."""
    axis = rows.directions.mean(axis=1)
    shift = 2.0 / 3.0 * (radius - spanned[0, 3]) / float(np.linalg.norm(axis))
    sphere = np.array([[*(spanned[0, :3] + shift * axis), radius]])
    cov = _with_radius((_START * radius) ** 2 * np.eye(3)[None], 0.0)
    for _ in range(_N_STEPS):
        linear = linearise(rows, sphere, cov)
        weighing, residuals = _gated(rows, linear, radius)
        per_square = weighing.weights / (weighing.variances + linear.bends**2)
        N, pull = normals_of_spheres(rows, linear, residuals, per_square, 3)
        inverse: Array = np.asarray(np.linalg.inv(N + np.eye(3) / (_PRIOR * radius) ** 2))
        limit = _STEP_MAX * radius
        sphere[0, :3] += np.clip(inverse[0] @ pull[0], -limit, limit)
        cov = _with_radius(inverse, 0.0)
    return *_gated(rows, linearise(rows, sphere, cov), radius), sphere, cov


def _gated(rows: Rows, linear: Linear, radius: float) -> tuple[Weighing, Array]:
    """Return the weights of what lies on a sphere and not on its pole, and residuals."""
    residuals = rows.ranges - linear.ranges
    is_in = in_play(rows, linear.offsets, np.array([_MARGIN * radius]), radius)
    sigma = _scatter(residuals[is_in])
    is_in &= np.abs(residuals) < _STRAY_SIGMAS * sigma
    variance = sigma**2 * is_in.sum() / max(is_in.sum() - 4.0, 1.0)
    variances, weights = np.full(len(is_in), variance), is_in.astype(np.float64)
    return Weighing(rows.ranges, variances, weights), residuals


def _own_spanned(rows: Rows, own: Array, assumed: Array) -> tuple[Array, Array, float]:
    """Return the sphere of greatest likelihood and its covariance, from that which returns span.

    And by how much it explains them better than one of the assumed radius, as a chi-square: the
    noise is not known.
    """
    known, moves = (_START * own[0, 3]) ** 2 * np.eye(4)[None], np.ones(1, dtype=bool)
    for _ in range(_N_ROUNDS):
        weighing = _gated(rows, linearise(rows, own, known), float(own[0, 3]))[0]
        own, known = _free(rows, weighing, own, known, moves)
        own[0, 3] = np.clip(own[0, 3], _SPAN_MIN, 2.0 * _RADIUS_MAX * assumed[0, 3])
    linear = linearise(rows, own, known)
    weighing, residuals = _gated(rows, linear, float(own[0, 3]))
    others = rows.ranges - linearise(rows, assumed, _with_radius(known, 0.0)).ranges
    is_in, limit = weighing.weights > 0.0, _STRAY_SIGMAS**2 * weighing.variances
    least = max(int(is_in.sum()), 1) * _SCATTER_MIN**2
    worse, better = (
        max(float(np.minimum(off**2, limit)[is_in].sum()), least) for off in (others, residuals)
    )
    return own, known, max(int(is_in.sum()) - 4, 0) * float(np.log(worse / better))


def _spanned(shots: Beams) -> Array:
    """Return the centre and radius, (1, 4), of a sphere that spans returns across the beam."""
    axis = shots.directions_base.mean(axis=0)
    axis /= np.linalg.norm(axis)
    p = shots.origins_base + shots.ranges[:, None] * shots.directions_base
    middle = np.median(p, axis=0)
    v = p - middle
    beside = np.linalg.norm(v - (v @ axis)[:, None] * axis, axis=1)
    radius = max(_OUTERMOST * float(np.quantile(beside, 0.9)), _SPAN_MIN)
    # seen evenly, the half of a sphere is two thirds of its radius deep
    return np.array([[*(middle + 2.0 / 3.0 * radius * axis), radius]])


def _scatter(residuals: Array) -> float:
    """Return the robust standard deviation of residuals [m]; the least if there are none."""
    if not len(residuals):
        return _SCATTER_MIN
    return max(_NORMAL * float(np.median(np.abs(residuals))), _SCATTER_MIN)


def other_radius(radius: float, radius_free: float, sigma: float) -> list[str]:
    """Say whether returns show a sphere of another radius.

    Parameters
    ----------
    radius : float
        The radius that is assumed [m].
    radius_free, sigma : float
        The one that returns have by themselves, and its standard deviation; NaN when they do not
        tell [m].

    Returns
    -------
    list of str
        The reason without capital and full stop, or none.
    """
    if abs(radius_free - radius) > max(_SIGMAS * sigma, _SLACK):
        return [f"its own radius is {1e3 * radius_free:.0f} mm"]
    return []
