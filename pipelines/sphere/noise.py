"""Range noise of a stop, estimated from the residuals of all its spheres, and robust weights.

Of the noise by reflectivity only the ratios are known beforehand; its size is estimated, and how it
grows as echoes weaken with distance and incidence.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

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
    """

    factor: float
    factors: Array
    growth: float


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
    """
    residuals = returns.ranges - linear.ranges
    if noise is None:
        factor = max(robust_sigma((residuals / returns.sigmas)[is_used]), FACTOR_MIN)
        noise = Noise(factor, np.full(len(_SIGMAS), factor), 0.0)
    gradient = linear.J[:3]
    along = np.sum(gradient * returns.directions, axis=0)
    slope2 = np.maximum(np.sum(gradient * gradient, axis=0) - along * along, 0.0)
    others = returns.sigmas_lateral**2 * slope2 + linear.sigmas_nonlinear**2
    faded = _faded(returns, linear.offsets, radius)

    def weighed(noise: Noise) -> tuple[Array, Array, Array]:
        """Return variances of ranges, and sigmas and weights of residuals."""
        own = (noise.factors[returns.classes] * returns.sigmas) ** 2
        own = own * np.exp(2.0 * noise.growth * faded) if noise.growth else own
        sigmas = np.sqrt(own + others)
        return own, sigmas, tukey_weights(residuals / sigmas, _TUKEY)

    own, sigmas, weights = weighed(noise)
    classes = returns.classes
    counted = is_used & (weights > 0.0)
    squares = counted * weights * (residuals / sigmas) ** 2 / EXPECTED_SQUARE
    found = _pooled(
        np.asarray(np.bincount(classes, squares * noise.factors[classes] ** 2, N_CLASSES), float),
        np.bincount(classes[counted], minlength=N_CLASSES),
        3.0 * (len(returns.starts) - 1),
    )
    slopes = counted * (faded - faded[counted].mean()) * own / sigmas**2 if counted.any() else 0.0
    excess = squares * (noise.factor / found.factor) ** 2 - counted
    gain = np.sum(slopes * excess) - noise.growth / _SIGMA_GROWTH**2
    growth = noise.growth + gain / (2.0 * np.sum(slopes**2) + _SIGMA_GROWTH**-2.0)
    found = found._replace(growth=float(np.clip(growth, 0.0, 1.0)))
    _, sigmas, weights = weighed(found)
    return Weighed(residuals, sigmas, weights * is_used, found)


def _faded(returns: Returns, offsets: Array, radius: float) -> Array:
    """Return the logarithm by which each echo is weaker than that of a face at 10 m, squarely."""
    x, y = offsets / radius
    cosines2 = np.maximum(1.0 - x * x - y * y, _COSINE_MIN**2)
    return np.asarray(2.0 * np.log(returns.ranges / _AT) - 0.5 * np.log(cosines2))


def _pooled(squares: Array, counts: Index, n_unknowns: float) -> Noise:
    """Return the noise from sums of squares and numbers of returns by class."""
    n = max(float(counts.sum()), 1.0)
    dof = max(n - n_unknowns, 0.0)
    factor2 = (float(squares.sum()) + 1.0) / (dof + 1.0)
    by_class = (squares + _DOF_CLASS * factor2) / (counts * dof / n + _DOF_CLASS)
    return Noise(
        max(float(np.sqrt(factor2)), FACTOR_MIN), np.maximum(np.sqrt(by_class), FACTOR_MIN), 0.0
    )
