"""Limits of statistical tests, each passed by chance alone about once in 10,000 samples."""

import numpy as np
from scipy.stats import binom, chi2, t

RATE = 1e-4  # of both sides together


def of_share(probability, n):
    """Return the least and greatest share of n independent events of one probability."""
    return binom.ppf([RATE / 2, 1 - RATE / 2], n, probability) / n


def of_mean_square(dof):
    """Return the least and greatest mean of so many independent squares of standard normals."""
    return chi2.ppf([RATE / 2, 1 - RATE / 2], dof) / dof


def of_mean(samples):
    """Return by how much the mean of independent samples, along the first axis, may be off."""
    n = len(samples)
    return t.ppf(1 - RATE / 2, n - 1) * np.std(samples, axis=0, ddof=1) / np.sqrt(n)


def of_eigenvalues(n, size):
    """Return the least and greatest eigenvalue of the covariance of n white vectors.

    Of 200,000 Wishart matrices by Bartlett's decomposition.
    """
    rng, n_draws = np.random.default_rng(0), 200_000
    roots = np.zeros((n_draws, size, size))
    for i in range(size):
        roots[:, i, i] = np.sqrt(rng.chisquare(n - i, n_draws))
        roots[:, i, :i] = rng.standard_normal((n_draws, i))
    found = np.linalg.eigvalsh(roots @ np.swapaxes(roots, 1, 2) / n)
    return np.quantile(found[:, 0], RATE / 2), np.quantile(found[:, -1], 1 - RATE / 2)
