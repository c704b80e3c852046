"""Normal equations of the centres of a stop and of the unknowns that all centres share.

Shared are the range biases of the lasers and the errors of the mounting. Each centre is eliminated
first (Schur complement), so that the cost is linear in the markers.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.estimation.linear_algebra import eliminate, inverse
from spheremark.pipelines.model import Array, Index
from spheremark.pipelines.sphere.linearisation import Linear
from spheremark.pipelines.sphere.returns import Returns


class Normals(NamedTuple):
    """Normal equations, marker by marker.

    Rows and columns are the centre (3), the laser biases (k), and last the right-hand side.

    Attributes
    ----------
    products : (m, 3 + k + 1, 3 + k + 1)
        Weighted sums of the products of derivatives and residuals.
    by_face : (m, 3, 3 + k + 1)
        The first three rows, with returns of the downward sweep counted negative: the mounting
        moves the two faces of a sphere against each other.
    """

    products: Array
    by_face: Array


class Solution(NamedTuple):
    """A step of all unknowns, with covariances.

    Attributes
    ----------
    steps : (m, 3)
        Steps of the centres for fixed shared unknowns [m].
    step_shared : (k + 6,)
        Step of the shared unknowns.
    covs : (m, 3, 3)
        Covariances of the centres for known shared unknowns [m^2].
    cov_shared : (k + 6, k + 6)
        Covariance of the shared unknowns.
    by_shared : (m, 3, k + 6)
        Derivatives of the centres by the shared unknowns, with the sign turned.
    covs_by_shared : (m, 3, 3)
        What the shared unknowns add to the covariances of the centres [m^2].
    """

    steps: Array
    step_shared: Array
    covs: Array
    cov_shared: Array
    by_shared: Array
    covs_by_shared: Array


def sums_of_products(starts: Index, left: Array, right: Array) -> Array:
    """Return the sum of ``left right^T`` over the returns of each marker, (m, p, q)."""
    sums = np.empty((len(starts) - 1, len(left), len(right)))
    for m, (a, b) in enumerate(pairwise(starts)):
        np.matmul(left[:, a:b], right[:, a:b].T, out=sums[m])
    return sums


def normals_of(
    returns: Returns, linear: Linear, residuals: Array, weights: Array, n_lasers: int
) -> Normals:
    """Sum the normal equations; ``weights`` are inverse variances [1/m^2]."""
    n = len(residuals)
    columns = np.zeros((3 + n_lasers + 1, n))
    columns[:3], columns[-1] = linear.J[:3], residuals
    columns[3 + returns.lasers, np.arange(n)] = 1.0
    weighted = weights * columns
    signed = returns.vertical[0] * weighted[:3]
    return Normals(
        products=sums_of_products(returns.starts, weighted, columns),
        by_face=sums_of_products(returns.starts, signed, columns),
    )


def solve(N: Normals, effects: Array, precisions: Array, rhs_prior: Array) -> Solution:
    """Solve for all centres together with the shared unknowns.

    Notes
    -----
    ``effects`` are the derivatives of the faces by the mounting, (m, 3, 6); ``precisions`` and
    ``rhs_prior``, (k + 6,), are the prior of the shared unknowns. A prior of 1 m on each centre
    keeps the equations solvable and is otherwise without effect.
    """
    n_shared = len(precisions)
    lasers, mounting = slice(n_shared - effects.shape[2]), slice(n_shared - effects.shape[2], -1)
    centre, laser, rhs = slice(3), slice(3, -1), -1
    turned = effects.transpose(0, 2, 1)
    own = N.products[:, centre, centre]
    shared = np.zeros((n_shared, n_shared + 1))  # last the right-hand side
    shared[lasers, lasers] = N.products[:, laser, laser].sum(axis=0)
    shared[lasers, -1] = N.products[:, laser, rhs].sum(axis=0)
    shared[lasers, mounting] = np.sum(N.by_face[:, :, laser].transpose(0, 2, 1) @ effects, axis=0)
    shared[mounting.start :, lasers] = shared[lasers, mounting].T
    shared[mounting.start :, mounting] = np.sum(turned @ own @ effects, axis=0)
    shared[mounting.start :, -1] = np.sum(turned @ N.by_face[:, :, rhs, None], axis=0)[:, 0]
    shared[:, :-1] += np.diag(precisions)
    shared[:, -1] += rhs_prior

    mixed = np.concatenate([N.products[:, centre, laser], N.by_face[:, :, :3] @ effects], axis=2)
    reduced = eliminate(
        own + np.eye(3), mixed, N.products[:, centre, rhs], shared[:, :-1], shared[:, -1]
    )
    cov_shared = inverse(reduced.N)
    return Solution(
        steps=reduced.steps,
        step_shared=cov_shared @ reduced.rhs,
        covs=reduced.own,
        cov_shared=cov_shared,
        by_shared=reduced.gains,
        covs_by_shared=reduced.gains @ cov_shared @ reduced.gains.transpose(0, 2, 1),
    )
