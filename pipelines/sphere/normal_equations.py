"""Normal equations of centres and of what they share: hides how they are summed and solved.

Centres share the biases of lasers and what is wrong in the mounting. Each centre is eliminated
first (Schur's complement), so that the cost is linear in markers.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spheremark.pipelines.compilation import FUSED, REASSOCIATED, compiled, compiled_with
from spheremark.pipelines.estimation.linear_algebra import inverse
from spheremark.pipelines.model import Array, Index
from spheremark.pipelines.sphere.linearisation import Linear
from spheremark.pipelines.sphere.returns import Rows


class Normals(NamedTuple):
    """Normal equations.

    Attributes
    ----------
    centres : (m, 3, 3)
        Of each centre.
    mixed : (m, 3, l)
        Between each centre and each laser's bias.
    biases : (l,)
        Of the biases, which are diagonal.
    pull_centres : (m, 3)
        Right-hand sides of the centres.
    pull_biases : (l,)
        Right-hand sides of the biases.
    faces : (m, 3, 3)
        As ``centres``, with what is swept downwards counted negative: how much more one face of the
        scan tells of each centre than the other.
    mixed_faces : (m, 3, l)
        As ``mixed``, counted likewise.
    pull_faces : (m, 3)
        As ``pull_centres``, counted likewise.
    """

    centres: Array
    mixed: Array
    biases: Array
    pull_centres: Array
    pull_biases: Array
    faces: Array
    mixed_faces: Array
    pull_faces: Array


class Solved(NamedTuple):
    """A step from normal equations, and how well what it leads to is known.

    Attributes
    ----------
    steps : (m, 3)
        Of the centres if what they share were known [m].
    step_shared : (k,)
        Of what they share.
    inverses : (m, 3, 3)
        Covariances of the centres if what they share were known [m^2].
    cov_shared : (k, k)
        Covariance of what they share.
    by_shared : (m, 3, k)
        How far a unit of each of that moves each centre, with the sign turned.
    covs_by_shared : (m, 3, 3)
        What is not known of it adds to the covariances of the centres [m^2].
    """

    steps: Array
    step_shared: Array
    inverses: Array
    cov_shared: Array
    by_shared: Array
    covs_by_shared: Array


def normals_of(
    rows: Rows, linear: Linear, residuals: Array, per_square: Array, n_lasers: int
) -> Normals:
    """Sum the normal equations of centres and biases."""
    m = len(rows.firsts) - 1
    N = Normals(
        centres=np.zeros((m, 3, 3)),
        mixed=np.zeros((m, 3, n_lasers)),
        biases=np.zeros(n_lasers),
        pull_centres=np.zeros((m, 3)),
        pull_biases=np.zeros(n_lasers),
        faces=np.zeros((m, 3, 3)),
        mixed_faces=np.zeros((m, 3, n_lasers)),
        pull_faces=np.zeros((m, 3)),
    )
    _sum_up(rows, linear.J, residuals, per_square, N)
    return N


@compiled
def normals_of_spheres(
    rows: Rows, linear: Linear, residuals: Array, per_square: Array, n_unknowns: int
) -> tuple[Array, Array]:
    """Sum the normal equations of spheres that share nothing."""
    m = len(rows.firsts) - 1
    N, pull = np.zeros((m, n_unknowns, n_unknowns)), np.zeros((m, n_unknowns))
    _sum_spheres(rows.firsts, linear.J, residuals, per_square, (N, pull))
    return N, pull


@compiled
def _sum_up(rows: Rows, J: Array, residuals: Array, per_square: Array, N: Normals) -> None:
    """Fill in the sums of ``Normals``, which are zero."""
    signed = rows.up[0] * per_square
    _sum_spheres(rows.firsts, J, residuals, per_square, (N.centres, N.pull_centres))
    _sum_spheres(rows.firsts, J, residuals, signed, (N.faces, N.pull_faces))
    for s in range(len(N.centres)):
        for i in range(rows.firsts[s], rows.firsts[s + 1]):
            w, laser = per_square[i], rows.lasers[i]
            N.biases[laser] += w
            N.pull_biases[laser] += w * residuals[i]
            for p in range(3):
                N.mixed[s, p, laser] += w * J[p, i]
                N.mixed_faces[s, p, laser] += signed[i] * J[p, i]


@compiled
def _sum_spheres(
    firsts: Index, J: Array, residuals: Array, weights: Array, out: tuple[Array, Array]
) -> None:
    """Fill in the products of derivatives with each other and with residuals, sphere by sphere."""
    N, pull = out
    k = N.shape[1]
    for s in range(len(N)):
        sums = _products(firsts[s], firsts[s + 1], J, residuals, weights)
        for p in range(k):
            pull[s, p] = sums[10 + p]
            for q in range(p + 1):
                N[s, p, q] = N[s, q, p] = sums[p * (p + 1) // 2 + q]


@compiled_with(fastmath=REASSOCIATED)
def _products(first, behind, J, residuals, weights):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Return sums of the ten products of derivatives, by rows, and of those with residuals."""
    xx = yx = yy = zx = zy = zz = rx = ry = rz = rr = x_pull = y_pull = z_pull = r_pull = 0.0
    for i in range(first, behind):
        x, y, z, r, v = J[0, i], J[1, i], J[2, i], J[3, i], residuals[i]
        wx, wy, wz, wr = weights[i] * x, weights[i] * y, weights[i] * z, weights[i] * r
        xx, yx, yy = xx + wx * x, yx + wy * x, yy + wy * y
        zx, zy, zz = zx + wz * x, zy + wz * y, zz + wz * z
        rx, ry, rz, rr = rx + wr * x, ry + wr * y, rz + wr * z, rr + wr * r
        x_pull, y_pull = x_pull + wx * v, y_pull + wy * v
        z_pull, r_pull = z_pull + wz * v, r_pull + wr * v
    return xx, yx, yy, zx, zy, zz, rx, ry, rz, rr, x_pull, y_pull, z_pull, r_pull


@compiled
def solve(N: Normals, effects: Array, known: Array, pull_known: Array) -> Solved:
    """Solve the equations of all centres together with what they share.

    Notes
    -----
    A prior of a metre on each centre keeps the equations solvable and is not felt otherwise.
    """
    m, _, n_lasers = N.mixed.shape
    n, eye = len(known), np.eye(3)
    inverses = np.empty((m, 3, 3))
    mixed, given = np.empty((m, 3, n + 1)), np.empty((m, 3, n + 1))  # last the right-hand sides
    reduced = _shared(N, effects, known, pull_known)
    for s in range(m):
        inverses[s] = inverse(N.centres[s] + eye)
        mixed[s, :, :n_lasers] = N.mixed[s]
        mixed[s, :, n_lasers:n] = np.dot(N.faces[s], effects[s])
        mixed[s, :, n] = N.pull_centres[s]
        given[s] = np.dot(inverses[s], mixed[s])
        _add_product(-1.0, mixed[s], given[s], reduced)
    cov_shared = inverse(reduced[:n, :n].copy())
    by_shared = given[:, :, :n].copy()
    covs = np.empty((m, 3, 3))
    for s in range(m):
        covs[s] = np.dot(np.dot(by_shared[s], cov_shared), by_shared[s].T)
    step_shared = np.dot(cov_shared, reduced[:n, n].copy())
    return Solved(given[:, :, n].copy(), step_shared, inverses, cov_shared, by_shared, covs)


@compiled
def _shared(N: Normals, effects: Array, known: Array, pull_known: Array) -> Array:
    """Return the equations, (k + 1, k + 1), of what centres share, last the right-hand side."""
    n_lasers, n = len(N.biases), len(known)
    reduced, between = np.zeros((n + 1, n + 1)), np.zeros((n_lasers, n - n_lasers))
    own, pull = np.zeros((n - n_lasers, n - n_lasers)), np.zeros((n - n_lasers, 1))
    for s in range(len(effects)):
        _add_product(1.0, N.mixed_faces[s], effects[s], between)
        _add_product(1.0, effects[s], np.dot(N.centres[s], effects[s]), own)
        _add_product(1.0, effects[s], N.pull_faces[s].reshape(3, 1), pull)
    for k in range(n):
        reduced[k, k], reduced[k, n] = known[k], pull_known[k]
    for k in range(n_lasers):
        reduced[k, k] += N.biases[k]
        reduced[k, n] += N.pull_biases[k]
    reduced[:n_lasers, n_lasers:n] += between
    reduced[n_lasers:n, :n_lasers] += between.T
    reduced[n_lasers:n, n_lasers:n] += own
    reduced[n_lasers:n, n] += pull[:, 0]
    return reduced


@compiled_with(fastmath=FUSED)
def _add_product(sign: float, a: Array, b: Array, out: Array) -> None:
    """Add ``a' b`` with a sign."""
    for k in range(len(a)):
        for p in range(a.shape[1]):
            for q in range(b.shape[1]):
                out[p, q] += sign * a[k, p] * b[k, q]
