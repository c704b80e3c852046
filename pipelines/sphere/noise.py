"""Range noise of a stop, estimated from the residuals of all its spheres, and robust weights.

Of the noise by reflectivity only the ratios are known beforehand; its size is estimated, and how it
grows as echoes weaken with distance and incidence.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from spheremark.pipelines.estimation.robust import robust_sigma, tukey_weights
from spheremark.pipelines.model import Array, Index, Mask
from spheremark.pipelines.sphere.linearisation import Linear
from spheremark.pipelines.sphere.returns import Returns

# Range noise of a VLP-16 by reflectivity, from recorded packets [m]: a prior, for the ratio between
# dark and bright; its size is estimated from the stop.
_REFLECTIVITIES = np.array([5.0, 15.0, 40.0, 100.0])  # limits between the classes
_SIGMAS = np.array([0.0137, 0.0107, 0.0089, 0.0067, 0.0064])

N_CLASSES = len(_SIGMAS)
"""Classes of reflectivity."""

FACTOR_MIN = 0.08
"""Least noise in units of the prior: 2 mm quantisation alone gives as much."""

EXPECTED_SQUARE = 0.9099
"""Mean of weight times square of normal residuals in units of their sigma."""

_TUKEY = 8.0  # sigmas at which a return has no weight; 99 % efficient on clean data
_DOF_CLASS = 30.0  # returns that the pooled noise counts for in the estimate of a class
_SIGMA_GROWTH = 0.25  # prior of the growth; 0.5 is the noise of counted photons
_AT = 10.0  # [m]
_MIXED = (0.1, 1.9)  # returns at a limb, mixed and not, that its prior counts for
_BEHIND = 1.6  # radii behind the limb within which the range of a mixed echo is expected
_ALONE_MIN = 0.05  # probability of being the sphere's alone below which a return is not used
_DENSITY, _TINY = 1.0 / np.sqrt(2.0 * np.pi), 1e-300
_COSINE_MIN = 0.1  # of incidence: the limb cuts footprints there, and their echo does not fade


class Noise(NamedTuple):
    """The noise of a stop.

    Attributes
    ----------
    factor : float
        Noise in units of the prior, of all returns.
    factors : (c,)
        The same by class of reflectivity.
    growth : float
        Power of the inverse strength of the echo, relative to the mean, with which it grows.
    mixed : (m,)
        Share of the returns at the limb of each sphere that are echoes of what is behind it, too.
    """

    factor: float
    factors: Array
    growth: float
    mixed: Array


class Weighed(NamedTuple):
    """Residuals of the returns with their weights.

    Attributes
    ----------
    residuals : (n,)
        Observed minus computed, corrected for the shared unknowns [m].
    sigmas : (n,)
        Their standard deviations [m].
    weights : (n,)
        Robust weights, 0 to 1.
    noise : Noise
        Estimated from these residuals.
    """

    residuals: Array
    sigmas: Array
    weights: Array
    noise: Noise


def classes_of(intensities: Array) -> tuple[Index, Array]:
    """Return classes of reflectivity and prior noise of ranges.

    Parameters
    ----------
    intensities : (n,)
        Calibrated reflectivity, 0-255.

    Returns
    -------
    classes : (n,)
        Class of each return.
    sigmas : (n,)
        Standard deviation of its range before any estimate [m].
    """
    classes = np.searchsorted(_REFLECTIVITIES, intensities, side="right")
    return classes, _SIGMAS[classes]


def weigh(
    returns: Returns, linear: Linear, radius: float, noise: Noise | None, is_used: Mask
) -> Weighed:
    """Weigh returns, and estimate the noise of their stop; first without one that is known.

    Notes
    -----
    The variance of a residual is that of the range, that of the direction on a sloping surface, and
    that of the linearisation. The noise of a reflectivity class is shrunk towards that of all
    returns (``_pooled``); its growth is a step of Fisher's scoring. Weights are Tukey's biweight.
    Before the noise is known it is the median deviation, which stray returns do not raise.

    Where a surface stands close behind a sphere, the echoes of a beam at the limb are one, whose
    range is longer than the sphere's. Tukey's limit grows with the noise, and the noise with what
    the limit admits, so that such echoes would admit each other: each return at a limb counts with
    the probability that its echo is the sphere's alone, by a mixture whose share each sphere has
    for itself (a step of expectation maximisation). A sphere that stands free loses nothing.
    """
    residuals = returns.ranges - linear.ranges
    if noise is None:
        factor = max(robust_sigma((residuals / returns.sigmas)[is_used]), FACTOR_MIN)
        mixed = np.full(len(returns.starts) - 1, _MIXED[0] / sum(_MIXED))
        noise = Noise(factor, np.full(N_CLASSES, factor), 0.0, mixed)
    gradient = linear.J[:3]
    along = np.sum(gradient * returns.directions, axis=0)
    slope2 = np.maximum(np.sum(gradient * gradient, axis=0) - along * along, 0.0)
    others = returns.sigmas_lateral**2 * slope2 + linear.sigmas_nonlinear**2
    faded = _faded(returns, linear.offsets, radius)
    away = np.sqrt(np.sum(linear.offsets**2, axis=0))
    at_limb = np.flatnonzero(is_used & (away + returns.half_widths.max(axis=0) > radius))
    spheres, n_spheres = returns.markers[at_limb], len(returns.starts) - 1

    def weighed(noise: Noise) -> tuple[Array, Array, Array, Array]:
        """Return variances of ranges, sigmas and weights of residuals, and what is not mixed."""
        own = (noise.factors[returns.classes] * returns.sigmas) ** 2
        own = own * np.exp(2.0 * noise.growth * faded) if noise.growth else own
        sigmas, alone = np.sqrt(own + others), np.ones(len(own))
        shares, depth = noise.mixed[spheres], _BEHIND * radius
        alone[at_limb] = _unmixed(residuals[at_limb], sigmas[at_limb], shares, depth)
        return own, sigmas, alone * tukey_weights(residuals / sigmas, _TUKEY), alone

    own, sigmas, weights, alone = weighed(noise)
    classes = returns.classes
    counted = is_used * (weights > 0.0) * alone
    squares = is_used * weights * (residuals / sigmas) ** 2 / EXPECTED_SQUARE
    found = _pooled(
        np.asarray(np.bincount(classes, squares * noise.factors[classes] ** 2, N_CLASSES), float),
        np.asarray(np.bincount(classes, counted, N_CLASSES), float),
        3.0 * n_spheres,
    )
    n = max(float(counted.sum()), 1.0)
    slopes = counted * (faded - counted @ faded / n) * own / sigmas**2
    excess = squares * (noise.factor / found.factor) ** 2 - counted
    gain = np.sum(slopes * excess) - noise.growth / _SIGMA_GROWTH**2
    growth = noise.growth + gain / (2.0 * np.sum(slopes**2) + _SIGMA_GROWTH**-2.0)
    mixed = np.bincount(spheres, 1.0 - alone[at_limb], n_spheres) + _MIXED[0]
    mixed = np.asarray(mixed / (np.bincount(spheres, minlength=n_spheres) + sum(_MIXED)), float)
    found = found._replace(growth=float(np.clip(growth, 0.0, 1.0)), mixed=mixed)
    _, sigmas, weights, _ = weighed(found)
    return Weighed(residuals, sigmas, weights * is_used, found)


def _faded(returns: Returns, offsets: Array, radius: float) -> Array:
    """Return the logarithm by which each echo is weaker than that of a face at 10 m, squarely."""
    x, y = offsets / radius
    cosines2 = np.maximum(1.0 - x * x - y * y, _COSINE_MIN**2)
    return np.asarray(2.0 * np.log(returns.ranges / _AT) - 0.5 * np.log(cosines2))


def _unmixed(residuals: Array, sigmas: Array, shares: Array, depth: float) -> Array:
    """Return the probability of each return at a limb that its echo is the sphere's alone.

    The range of a mixed one is longer by up to ``depth``, evenly.
    """
    scaled = residuals / sigmas
    alone = (1.0 - shares) * _DENSITY * np.exp(-0.5 * scaled**2) / sigmas
    mixed = shares * ndtr(scaled) / depth
    found = alone / np.maximum(alone + mixed, _TINY)
    return np.where(found > _ALONE_MIN, found, 0.0)


def _pooled(squares: Array, counts: Array, n_unknowns: float) -> Noise:
    """Return the noise from sums of squares and numbers of returns by class."""
    n = max(float(counts.sum()), 1.0)
    dof = max(n - n_unknowns, 0.0)
    factor2 = (float(squares.sum()) + 1.0) / (dof + 1.0)
    by_class = (squares + _DOF_CLASS * factor2) / (counts * dof / n + _DOF_CLASS)
    return Noise(
        max(float(np.sqrt(factor2)), FACTOR_MIN),
        np.maximum(np.sqrt(by_class), FACTOR_MIN),
        0.0,
        np.zeros(0),
    )
