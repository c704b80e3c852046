"""Normal equations of the centres of a stop and of the unknowns that all centres share.

Shared are the range biases of the lasers, the optics with the limb and the clock of the gimbal, and
the errors of the mounting. Each centre is eliminated first (Schur complement), so that the cost is
linear in the markers.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.estimation.linear_algebra import Reduced, eliminate
from spheremark.pipelines.model import Array, Index
from spheremark.pipelines.sphere.returns import Returns


class Normals(NamedTuple):
    """Normal equations, with the blocks of the centres marker by marker.

    Attributes
    ----------
    centres : (m, 3, 3 + k + q + 1)
        Rows of the centres. Columns are the centre, the k laser biases, the q unknowns of optics,
        limb and clock, and the right-hand side.
    by_face : (m, 3, 3 + k + q + 1)
        The same with returns of the downward sweep counted negative: the mounting moves the two
        faces of a sphere against each other.
    of_faces : (m, 3, 3)
        Normal matrices of moves of the two faces against each other.
    shared : (k + q, k + q + 1)
        Rows of the laser biases and of optics, limb and clock, last the right-hand side.
    """

    centres: Array
    by_face: Array
    of_faces: Array
    shared: Array


def sums_of_products(starts: Index, left: Array, right: Array) -> Array:
    """Return the sum of ``left right^T`` over the returns of each marker, (m, p, q)."""
    sums = np.empty((len(starts) - 1, len(left), len(right)))
    for m, (a, b) in enumerate(pairwise(starts)):
        np.matmul(left[:, a:b], right[:, a:b].T, out=sums[m])
    return sums


def normals_of(
    returns: Returns, J: tuple[Array, Array], residuals: Array, weights: Array, n_lasers: int
) -> Normals:
    """Sum the normal equations.

    ``J`` are the derivatives of ranges by the centre, (3, n), and by the optics, (q, n);
    ``weights`` are inverse variances [1/m^2].
    """
    m, lasers, by_optics = len(returns.starts) - 1, returns.lasers, J[1]
    cells = n_lasers * returns.markers + lasers
    columns, weighted = np.vstack([*J, residuals]), weights * J[0]
    both = np.vstack([weighted, returns.vertical[0] * weighted])  # all alike, and by face
    own = sums_of_products(returns.starts, both, columns)
    mixed = np.array([np.bincount(cells, row, m * n_lasers) for row in both])
    mixed = mixed.reshape(6, m, n_lasers).transpose(1, 0, 2)
    rows = np.concatenate([own[:, :, :3], mixed, own[:, :, 3:]], axis=2)

    others = weights * np.vstack([by_optics, residuals])
    crossed = np.array([np.bincount(lasers, row, n_lasers) for row in others])  # (q + 1, k)
    q = len(by_optics)
    shared = np.zeros((n_lasers + q, n_lasers + q + 1))
    shared[:n_lasers, :n_lasers] = np.diag(np.bincount(lasers, weights, n_lasers))
    shared[:n_lasers, n_lasers:], shared[n_lasers:, :n_lasers] = crossed.T, crossed[:q]
    shared[n_lasers:, n_lasers:] = others[:q] @ np.vstack([by_optics, residuals]).T
    return Normals(rows[:, :3], rows[:, 3:], own[:, :3, :3].copy(), shared)


def reduce(N: Normals, effects: Array, precisions: Array, rhs_prior: Array) -> Reduced:
    """Return the normal equations of the shared unknowns, those of the centres eliminated.

    Notes
    -----
    Shared are the laser biases, the optics and the mounting, in this order. ``effects`` are the
    derivatives of the faces by the mounting, (m, 3, 6); ``precisions`` and ``rhs_prior`` are the
    prior of the shared unknowns. A prior of 1 m on each centre keeps the equations solvable and is
    otherwise without effect.
    """
    own, by_face, turned = N.centres[:, :, :3], N.by_face[:, :, :3], effects.transpose(0, 2, 1)
    others, n = slice(0, len(N.shared)), len(precisions)
    mounting = slice(len(N.shared), n)
    shared = np.zeros((n, n + 1))  # last the right-hand side
    shared[others, others], shared[others, -1] = N.shared[:, :-1], N.shared[:, -1]
    between = np.sum(turned @ N.by_face[:, :, 3:], axis=0)
    shared[mounting, others], shared[mounting, -1] = between[:, :-1], between[:, -1]
    shared[others, mounting] = between[:, :-1].T
    shared[mounting, mounting] = np.sum(turned @ N.of_faces @ effects, axis=0)
    shared[:, :-1] += np.diag(precisions)
    shared[:, -1] += rhs_prior

    mixed = np.concatenate([N.centres[:, :, 3:-1], by_face @ effects], axis=2)
    return eliminate(own + np.eye(3), mixed, N.centres[:, :, -1], shared[:, :-1], shared[:, -1])
