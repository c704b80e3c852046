"""Range noise of a stop, estimated from the residuals of all its spheres, and robust weights.

Of the noise by reflectivity only the ratios are known beforehand; its size is estimated.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spheremark.pipelines.estimation.robust import tukey_weights
from spheremark.pipelines.model import Array, Index, Mask
from spheremark.pipelines.sphere.linearisation import Linear
from spheremark.pipelines.sphere.returns import Returns

# Range noise of a VLP-16 by reflectivity, from recorded packets [m]: a prior, for the ratio between
# dark and bright; its size is estimated from the stop.
_REFLECTIVITIES = np.array([5.0, 15.0, 40.0, 100.0])  # limits between the classes
_SIGMAS = np.array([0.0137, 0.0107, 0.0089, 0.0067, 0.0064])
_FACTOR_START = 3.0  # the largest noise that a VLP-16 shows, 25 mm

FACTOR_MIN = 0.08
"""Least noise in units of the prior: 2 mm quantisation alone gives as much."""

EXPECTED_SQUARE = 0.9099
"""Mean of weight times square of normal residuals in units of their sigma."""

_TUKEY = 8.0  # sigmas at which a return has no weight; 99 % efficient on clean data
_DOF_CLASS = 30.0  # returns that the pooled noise counts for in the estimate of a class


class Noise(NamedTuple):
    """The noise of a stop in units of the prior: of all returns, and by reflectivity class."""

    factor: float
    factors: Array


class Weighed(NamedTuple):
    """Residuals of the returns with their weights.

    Attributes
    ----------
    residuals : (n,)
        Observed minus computed, corrected for the laser biases [m].
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


START = Noise(_FACTOR_START, np.full(len(_SIGMAS), _FACTOR_START))
"""The noise before the first residuals."""


def classes_of(intensities: Array) -> tuple[Index, Array]:
    """Return classes of reflectivity and prior noise of ranges."""
    classes = np.searchsorted(_REFLECTIVITIES, intensities, side="right")
    return classes, _SIGMAS[classes]


def weigh(returns: Returns, linear: Linear, biases: Array, noise: Noise, is_used: Mask) -> Weighed:
    """Weigh returns, and estimate the noise of their stop.

    Notes
    -----
    The variance of a residual is that of the range, that of the direction on a sloping surface, and
    that of the bend. The noise of a reflectivity class is shrunk towards that of all returns
    (``_pooled``). Weights are Tukey's biweight.
    """
    residuals = returns.ranges - linear.ranges - biases[returns.lasers]
    gradient = linear.J[:3]
    along = np.sum(gradient * returns.directions, axis=0)
    slope2 = np.maximum(np.sum(gradient * gradient, axis=0) - along * along, 0.0)
    others = returns.sigmas_lateral**2 * slope2 + linear.bends**2

    def weighed(factors: Array) -> tuple[Array, Array]:
        """Return sigmas and weights for noise factors by class."""
        sigmas = np.sqrt((factors[returns.classes] * returns.sigmas) ** 2 + others)
        return sigmas, tukey_weights(residuals / sigmas, _TUKEY)

    sigmas, weights = weighed(noise.factors)
    classes, n_classes = returns.classes, len(_SIGMAS)
    counted = is_used & (weights > 0.0)
    squares = counted * weights * (noise.factors[classes] * residuals / sigmas) ** 2
    found = _pooled(
        np.bincount(classes, squares, n_classes) / EXPECTED_SQUARE,
        np.bincount(classes[counted], minlength=n_classes),
        3.0 * (len(returns.starts) - 1),
    )
    sigmas, weights = weighed(found.factors)
    return Weighed(residuals, sigmas, weights * is_used, found)


def _pooled(squares: Array, counts: Index, n_unknowns: float) -> Noise:
    """Return the noise from sums of squares and numbers of returns by class."""
    n = max(float(counts.sum()), 1.0)
    dof = max(n - n_unknowns, 0.0)
    factor2 = (float(squares.sum()) + 1.0) / (dof + 1.0)
    by_class = (squares + _DOF_CLASS * factor2) / (counts * dof / n + _DOF_CLASS)
    return Noise(
        max(float(np.sqrt(factor2)), FACTOR_MIN), np.maximum(np.sqrt(by_class), FACTOR_MIN)
    )
