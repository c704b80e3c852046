"""Robust estimation: weights, scale, and covariances that do not assume the noise.

A scaled residual is one in units of its standard deviation.
"""

from __future__ import annotations

import numpy as np

from spheremark.pipelines.model import Array, Index

HUBER = 1.345
"""Scaled residual beyond which Huber's weight falls: 95 % efficient for normal noise."""

NORMAL = 1.4826
"""Standard deviation of normal residuals over the median of their absolute values."""


def tukey_weights(scaled: Array, limit: float) -> Array:
    """Return Tukey's biweight.

    Parameters
    ----------
    scaled : (...)
        Scaled residuals.
    limit : float
        Scaled residual from which on the weight is 0.

    Returns
    -------
    (...)
        Weights, 0 to 1.
    """
    return np.asarray(np.maximum(1.0 - (scaled / limit) ** 2, 0.0) ** 2)


def tukey_loss(scaled: Array, limit: float) -> float:
    """Return the loss that Tukey's biweight minimises.

    Parameters
    ----------
    scaled : (n,)
        Scaled residuals.
    limit : float
        As for ``tukey_weights``.

    Returns
    -------
    float
        Sum over the residuals: half the square of a small one, ``limit^2 / 6`` of a large one.
    """
    kept = np.maximum(1.0 - (scaled / limit) ** 2, 0.0)
    return float(np.sum(limit**2 / 6.0 * (1.0 - kept**3)))


def huber_weights(scaled: Array) -> Array:
    """Return Huber's weights.

    Parameters
    ----------
    scaled : (...)
        Scaled residuals.

    Returns
    -------
    (...)
        Weights: 1 up to ``HUBER``, then falling with the residual.
    """
    return np.asarray(1.0 / np.maximum(np.abs(scaled) / HUBER, 1.0))


def robust_sigma(residuals: Array) -> float:
    """Return the standard deviation of residuals about zero from their median absolute value.

    Parameters
    ----------
    residuals : (n,)
        Residuals of which up to half may be outliers.

    Returns
    -------
    float
        Standard deviation if the others are normal.
    """
    return NORMAL * float(np.median(np.abs(residuals)))


def sandwich_covariance(bread: Array, scores: Array, clusters: Index, prior: Array) -> Array:
    """Return the covariance of a robust estimate whose rows correlate within clusters.

    Parameters
    ----------
    bread : (k, k)
        Inverse of the derivative of the estimating equations.
    scores : (n, k)
        What each row adds to these equations.
    clusters : (n,)
        The cluster of each row, from 0 on.
    prior : (k, k)
        Normal matrix of the prior.

    Returns
    -------
    (k, k)
        Covariance.

    Notes
    -----
    Huber, Robust Statistics (1981), section 7.6, with the clusters of Liang and Zeger (1986).
    """
    sums = np.zeros((int(clusters.max()) + 1, scores.shape[1]))
    np.add.at(sums, clusters, scores)
    n = len(sums)
    return np.asarray(bread @ (sums.T @ sums * n / (n - 1) + prior) @ bread)
