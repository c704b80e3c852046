"""The radius that a sphere's returns show by themselves: a test of the assumed one.

The radius is estimated along the beams together with the centre. The scatter of residuals does not
reveal a sphere of another size that is seen at a wrong range; this does.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spheremark.pipelines.estimation.linear_algebra import invert_each
from spheremark.pipelines.estimation.robust import robust_sigma
from spheremark.pipelines.model import Array, Beams, Mask
from spheremark.pipelines.sphere.linearisation import Linear, linearise
from spheremark.pipelines.sphere.normal_equations import sums_of_products
from spheremark.pipelines.sphere.returns import Returns, may_be_sphere, of_markers, returns_of

_ITERATED = 2.0  # standard deviations of one step, beyond which the steps are iterated
_MISFIT = 4.0  # standard deviations of a sum of squares, likewise
_BETTER, _BETTER_OWN = 9.0, 14.0  # chi-square in favour of another radius; noise unknown
_CLIP = 9.0  # squared standard deviations beyond which a residual is an outlier
_WEAK_PRIOR = 5.0  # radii: sigma of a prior that only keeps equations solvable
_N_STEPS = 8
_SETTLED = 1e-4  # [m] of a step: radii are compared to millimetres
_STEP_MAX = 0.25  # radii per step
_PRIOR = 0.5  # radii: prior standard deviation of centre and radius
_MARGIN = 0.1  # radii by which a footprint may lie outside a sphere and still be its own
_START = 0.1  # radii: standard deviation per axis of the first centre
_SIGMA_MAX, _RADIUS_MAX = 0.4, 5.0  # radii: a larger sigma or radius is no answer
_N_ROUNDS = 3
_SPAN_MIN = 0.001  # [m] least radius that returns span
_OUTERMOST = 1.2  # radii over the ninth tenth of the returns' distances from the middle
_SCATTER_MIN = 0.001  # [m] 2 mm quantisation alone gives as much
_OUTLIER_SIGMAS = 4.0
_LIMB = 0.15  # half widths of a beam by which what no model says of its profile moves the limb
_SIGMAS = 3.0  # by which a free radius may be off, and
_SLACK = 0.006  # [m] by which it may whatever its sigma


class Ranges(NamedTuple):
    """Ranges of some returns with their noise.

    Attributes
    ----------
    ranges : (n,)
        Measured ranges, corrected for the laser biases [m].
    variances : (n,)
        Of their noise [m^2].
    weights : (n,)
        Robust weights, 0 to 1.
    """

    ranges: Array
    variances: Array
    weights: Array


class BeamErrors(NamedTuple):
    """What is not known of the beams.

    Attributes
    ----------
    by_optics : (k, n)
        Derivatives of ranges by unknowns of the optics.
    cov : (k, k)
        Covariance of these.
    """

    by_optics: Array
    cov: Array


def free_radii(
    returns: Returns,
    observed: Ranges,
    spheres: Array,
    covs: Array,
    residuals: Array,
    errors: BeamErrors,
) -> tuple[Array, Array]:
    """Estimate radii together with the centres; return them with their standard deviations.

    NaN where the returns do not determine a radius.

    Notes
    -----
    One Gauss-Newton step from the assumed radius (Rao's score): linear in the noise, so that it is
    unbiased and its sigma holds if the assumption is true, however few returns there are. The
    maximum-likelihood radius is not: small spheres look precise. The sigma is that of the step by
    the noise alone (sandwich form). Where the likelihood of another radius is so much greater that
    the assumption must be wrong, the maximum-likelihood radius is returned; it is looked for where
    the step is long or residuals are greater than the noise. Unknown optics move the limb, as
    another radius does: their part of the variance comes last, with what no model says of them.
    """
    assumed = spheres[:, 3]
    steps, prior_covs, sigmas, by_optics = _score_steps(
        returns, observed, spheres, covs, residuals, errors.by_optics
    )
    radii = assumed + steps[:, 3]
    misfits, n = _misfits(returns, observed, residuals), np.diff(returns.starts)
    is_misfit = misfits > n + _MISFIT * np.sqrt(2.0 * n)
    doubtful = np.flatnonzero((np.abs(steps[:, 3]) > _ITERATED * sigmas) | is_misfit)
    if len(doubtful):
        some, rows = of_markers(returns, doubtful)
        ranges = Ranges(*(column[rows] for column in observed))
        limits = _STEP_MAX * assumed[doubtful, None]
        started = spheres[doubtful] + np.clip(steps[doubtful], -limits, limits)
        found, found_covs = _iterated(some, ranges, started, prior_covs[doubtful])
        linear = linearise(some, found, covs[doubtful], ranges.weights > 0.0)
        gains = misfits[doubtful] - _misfits(some, ranges, ranges.ranges - linear.ranges)
        better = gains > _BETTER
        radii[doubtful[better]] = found[better, 3]
        sigmas[doubtful[better]] = np.sqrt(found_covs[better, 3, 3])
    variances = np.einsum("mk,kl,ml->m", by_optics, errors.cov, by_optics)
    halves = np.bincount(returns.markers, returns.half_widths.mean(axis=0), len(n))
    variances += (_LIMB * halves / np.maximum(n, 1)) ** 2
    return _determined(radii, np.sqrt(sigmas**2 + variances), assumed)


def _determined(radii: Array, sigmas: Array, assumed: Array) -> tuple[Array, Array]:
    """Return radii and sigmas, NaN where the returns do not determine them."""
    has_sigma = (sigmas > 0.0) & (sigmas < _SIGMA_MAX * assumed)
    is_determined = has_sigma & (radii > 0.0) & (radii < _RADIUS_MAX * assumed)
    return np.where(is_determined, radii, np.nan), np.where(is_determined, sigmas, np.nan)


def _prior(radii: Array, sigma: float) -> Array:
    """Return the normal matrices, (m, 4, 4), of a prior with a sigma in radii."""
    return np.eye(4) / (sigma * radii[:, None, None]) ** 2


def _with_radius(covs: Array, variances: Array | float) -> Array:
    """Return covariances of spheres, (m, 4, 4), from those of centres and variances of radii."""
    wide = np.zeros((len(covs), 4, 4))
    wide[:, :3, :3] = covs[:, :3, :3]
    wide[:, 3, 3] = variances
    return wide


def _score_steps(
    returns: Returns,
    observed: Ranges,
    spheres: Array,
    covs: Array,
    residuals: Array,
    by_optics: Array,
) -> tuple[Array, Array, Array, Array]:
    """Return steps of centre and radius, (m, 4), and their covariances.

    Then the sigmas of the radii by the noise, and derivatives of the radii by the optics, (m, k).
    """
    is_used, radii = observed.weights > 0.0, spheres[:, 3]
    wide = _with_radius(covs, np.trace(covs[:, :3, :3], axis1=1, axis2=2))
    linear = linearise(returns, spheres, wide, is_used)
    N = _normals(returns, linear, residuals, _weights(observed, linear))
    covs_free = invert_each(N[:, :, :4] + _prior(radii, _PRIOR))[0]
    linear = linearise(returns, spheres, covs_free, is_used)
    weights = _weights(observed, linear)
    N = _normals(returns, linear, residuals, weights)
    by_rhs = invert_each(N[:, :, :4] + _prior(radii, _WEAK_PRIOR))[0]
    of_noise = _normals(returns, linear, residuals, weights**2 * observed.variances)
    row = by_rhs[:, 3]
    variances = np.einsum("mi,mij,mj->m", row, of_noise[:, :, :4], row)
    steps = np.einsum("mij,mj->mi", by_rhs, N[:, :, 4])
    mixed = sums_of_products(returns.starts, weights * linear.J, by_optics)
    moved = np.einsum("mi,mik->mk", row, mixed)
    return steps, covs_free, np.sqrt(np.maximum(variances, 0.0)), moved


def _weights(observed: Ranges, linear: Linear) -> Array:
    """Return weights over variances, those of the linearisation included [1/m^2]."""
    return observed.weights / (observed.variances + linear.sigmas_nonlinear**2)


def _normals(returns: Returns, linear: Linear, residuals: Array, weights: Array) -> Array:
    """Return normal equations of centre and radius, (m, 4, 5), last the right-hand sides."""
    columns = np.vstack([linear.J, residuals])
    return sums_of_products(returns.starts, weights * linear.J, columns)


def _misfits(returns: Returns, observed: Ranges, residuals: Array) -> Array:
    """Return the sums of squared residuals in units of the noise, outliers clipped, (m,)."""
    squares = observed.weights * np.minimum(residuals**2 / observed.variances, _CLIP)
    return np.asarray(np.bincount(returns.markers, squares, len(returns.starts) - 1), np.float64)


def _iterated(
    returns: Returns, observed: Ranges, spheres: Array, covs: Array
) -> tuple[Array, Array]:
    """Return centres with radii, (m, 4), where Gauss-Newton steps settle, and covariances."""
    spheres, covs = spheres.copy(), covs.copy()
    prior, limits = _prior(spheres[:, 3], _PRIOR), _STEP_MAX * spheres[:, 3, None]
    active = np.ones(len(spheres), dtype=np.bool_)
    for _ in range(_N_STEPS):
        is_used = (observed.weights > 0.0) & active[returns.markers]
        linear = linearise(returns, spheres, covs, is_used)
        residuals = observed.ranges - linear.ranges
        N = _normals(returns, linear, residuals, _weights(observed, linear))[active]
        covs[active] = invert_each(N[:, :, :4] + prior[active])[0]
        steps = np.einsum("mij,mj->mi", covs[active], N[:, :, 4])
        steps = np.clip(steps, -limits[active], limits[active])
        spheres[active] += steps
        active[active] = np.abs(steps).max(axis=1) >= _SETTLED
        if not active.any():
            break
    return spheres, covs


def own_radius(pulses: Beams, radius: float, up: Array) -> tuple[float, float]:
    """Return the radius that one sphere's returns show, all with the same noise, and its sigma.

    Notes
    -----
    The centre is fitted with the assumed radius, then one step is made from it. Where that suggests
    another radius, the fit starts again with the sphere that the returns span: from a smaller one
    the beams at the limb would be taken for ones that miss. Noise and outliers are found from the
    residuals, again in each round.
    """
    n = len(pulses.ranges)
    nothing = np.zeros(n, dtype=np.intp)
    returns = returns_of(pulses, np.array([0, n]), up, nothing, (nothing, np.ones(n), 0.0))
    spanned = _spanned(pulses)
    observed, residuals, sphere, cov = _with_assumed(returns, spanned, radius)
    steps, _, sigmas, _ = _score_steps(returns, observed, sphere, cov, residuals, np.empty((0, n)))
    found = radius + steps[:, 3]
    if abs(steps[0, 3]) > _ITERATED * sigmas[0]:
        own, known, gain = _most_likely(returns, spanned, sphere)
        if gain > _BETTER_OWN:
            found, sigmas = own[:, 3], np.sqrt(known[:, 3, 3])
    radii, sigmas = _determined(found, sigmas, sphere[:, 3])
    return float(radii[0]), float(sigmas[0])


def _with_assumed(
    returns: Returns, spanned: Array, radius: float
) -> tuple[Ranges, Array, Array, Array]:
    """Return ranges, residuals, the best sphere of the assumed radius, and its covariance."""
    axis = returns.directions.mean(axis=1)
    shift = 2.0 / 3.0 * (radius - spanned[3]) / float(np.linalg.norm(axis))
    sphere = np.array([[*(spanned[:3] + shift * axis), radius]])
    cov = _with_radius((_START * radius) ** 2 * np.eye(3)[None], 0.0)
    limit = _STEP_MAX * radius
    for _ in range(_N_STEPS):
        linear = linearise(returns, sphere, cov)
        observed, residuals = _gated(returns, linear, radius)
        N = _normals(returns, linear, residuals, _weights(observed, linear))[0, :3]
        known = invert_each(N[:, :3] + np.eye(3) / (_PRIOR * radius) ** 2)[0]
        sphere[0, :3] += np.clip(known @ N[:, 4], -limit, limit)
        cov = _with_radius(known[None], 0.0)
    return *_gated(returns, linearise(returns, sphere, cov), radius), sphere, cov


def _gated(returns: Returns, linear: Linear, radius: float) -> tuple[Ranges, Array]:
    """Return ranges weighted 1 on a sphere and 0 off it or on its pole, and residuals."""
    residuals = returns.ranges - linear.ranges
    is_in = may_be_sphere(returns, linear.offsets, np.array([_MARGIN * radius]), radius)
    sigma = _scatter(residuals[is_in])
    is_in &= np.abs(residuals) < _OUTLIER_SIGMAS * sigma
    n = int(is_in.sum())
    variance = sigma**2 * max(n, 1) / max(n - 4, 1)
    variances, weights = np.full(len(is_in), variance), is_in.astype(np.float64)
    return Ranges(returns.ranges, variances, weights), residuals


def _most_likely(returns: Returns, spanned: Array, assumed: Array) -> tuple[Array, Array, float]:
    """Return the maximum-likelihood sphere, its covariance, and its gain over the assumed one.

    The gain is a chi-square for an unknown noise.
    """
    own, known = spanned[None], (_START * spanned[3]) ** 2 * np.eye(4)[None]
    for _ in range(_N_ROUNDS):
        observed = _gated(returns, linearise(returns, own, known), float(own[0, 3]))[0]
        own, known = _iterated(returns, observed, own, known)
        own[0, 3] = np.clip(own[0, 3], _SPAN_MIN, 2.0 * _RADIUS_MAX * assumed[0, 3])
    observed, residuals = _gated(returns, linearise(returns, own, known), float(own[0, 3]))
    same = linearise(returns, assumed, _with_radius(known, 0.0))
    is_in, limits = observed.weights > 0.0, _OUTLIER_SIGMAS**2 * observed.variances
    worse = _sum_clipped(returns.ranges - same.ranges, limits, is_in)
    better = _sum_clipped(residuals, limits, is_in)
    return own, known, max(int(is_in.sum()) - 4, 0) * float(np.log(worse / better))


def _sum_clipped(residuals: Array, limits: Array, is_in: Mask) -> float:
    """Return the sum of squares up to limits; at least that of the least scatter."""
    least = max(int(is_in.sum()), 1) * _SCATTER_MIN**2
    return max(float(np.minimum(residuals**2, limits)[is_in].sum()), least)


def _spanned(pulses: Beams) -> Array:
    """Return the centre and radius, (4,), of a sphere that spans returns across the beam."""
    axis = pulses.directions_base.mean(axis=0)
    axis /= np.linalg.norm(axis)
    p = pulses.origins_base + pulses.ranges[:, None] * pulses.directions_base
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
    return max(robust_sigma(residuals), _SCATTER_MIN)


def other_radius(radius: float, radius_free: float, sigma: float) -> list[str]:
    """Return the reason, if any, to call a fit weak: its returns show another radius."""
    if abs(radius_free - radius) > max(_SIGMAS * sigma, _SLACK):
        return [f"its own radius is {1e3 * radius_free:.0f} mm"]
    return []
