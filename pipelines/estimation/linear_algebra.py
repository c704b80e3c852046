"""Symmetric positive definite matrices: factor, solve, invert, eliminate.

The compiled loops are for thousands of systems of up to a few tens of unknowns, inside other
kernels or as a stack; only the lower triangle of an argument is read. ``np.linalg`` serves the
single large system.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.errors import DegenerateGeometryError
from spheremark.pipelines.model import Array, Mask

SINGULAR = 1e-11
"""Pivot over diagonal below which an unknown is undetermined; rounding leaves about 1e-15."""


@compiled
def factorise(N: Array, root: Array) -> bool:
    """Write the Cholesky factor of a matrix into the lower triangle of another.

    Parameters
    ----------
    N : (n, n)
        Symmetric positive definite matrix.
    root : (n, n)
        Receives the factor; its upper triangle stays as it is. May be ``N`` itself.

    Returns
    -------
    bool
        Whether the matrix is positive definite; if not, the factor is incomplete.
    """
    for i in range(len(N)):
        diagonal = N[i, i]
        for j in range(i + 1):
            rest = N[i, j]
            for k in range(j):
                rest -= root[i, k] * root[j, k]
            if j < i:
                root[i, j] = rest / root[j, j]
            elif rest > SINGULAR * diagonal:
                root[i, i] = np.sqrt(rest)
            else:
                return False
    return True


@compiled
def solve(N: Array, b: Array) -> bool:
    """Solve a system in place.

    Parameters
    ----------
    N : (n, n)
        Symmetric positive definite matrix; its lower triangle is overwritten by the factor.
    b : (n,)
        Right-hand side; overwritten by the solution.

    Returns
    -------
    bool
        Whether the matrix is positive definite; if not, ``b`` is unchanged.
    """
    if not factorise(N, N):
        return False
    n = len(N)
    for i in range(n):
        for k in range(i):
            b[i] -= N[i, k] * b[k]
        b[i] /= N[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= N[k, i] * b[k]
        b[i] /= N[i, i]
    return True


@compiled
def invert(N: Array, out: Array) -> bool:
    """Write the inverse of a matrix into another.

    Parameters
    ----------
    N : (n, n)
        Symmetric positive definite matrix.
    out : (n, n)
        Receives the inverse, both triangles; NaN throughout if there is none. May be ``N`` itself.

    Returns
    -------
    bool
        Whether the matrix is positive definite.
    """
    if not factorise(N, out):
        out[:] = np.nan
        return False
    n = len(N)
    for i in range(n):  # the inverse of the factor
        out[i, i] = 1.0 / out[i, i]
        for j in range(i):
            total = 0.0
            for k in range(j, i):
                total -= out[i, k] * out[k, j]
            out[i, j] = total * out[i, i]
    for i in range(n):  # its product with its transpose: rows above i are not needed any more
        for j in range(i + 1):
            total = 0.0
            for k in range(i, n):
                total += out[k, i] * out[k, j]
            out[i, j] = out[j, i] = total
    return True


@compiled
def inverse(N: Array) -> Array:
    """Return the inverse of a matrix.

    Parameters
    ----------
    N : (n, n)
        Symmetric positive definite matrix.

    Returns
    -------
    (n, n)
        Its inverse; NaN throughout if it is not positive definite.
    """
    out = np.empty_like(N)
    invert(N, out)
    return out


@compiled
def _invert_each(N: Array, out: Array, is_regular: Mask) -> None:
    """Invert each matrix of a stack."""
    for s in range(len(N)):
        is_regular[s] = invert(N[s], out[s])


def invert_each(N: Array) -> tuple[Array, Mask]:
    """Invert matrices.

    Parameters
    ----------
    N : (..., n, n)
        Symmetric positive definite matrices.

    Returns
    -------
    tuple
        Inverses, (..., n, n), NaN where a matrix is not positive definite, and whether each is.
    """
    n = N.shape[-1]
    stack = np.ascontiguousarray(N).reshape(-1, n, n)
    out, is_regular = np.empty(stack.shape), np.empty(len(stack), dtype=np.bool_)
    _invert_each(stack, out, is_regular)
    return out.reshape(N.shape), is_regular.reshape(N.shape[:-2])


class Reduced(NamedTuple):
    """Normal equations of common unknowns, those of local ones eliminated."""

    N: Array  # (q, q) normal matrix of the common unknowns: the Schur complement
    rhs: Array  # (q,) right-hand side
    own: Array  # (s, a, a) covariance of each set of local unknowns if the common ones were known
    # (s, a, q) by how much a unit of each common unknown moves the local ones, with the sign turned
    gains: Array
    steps: Array  # (s, a) solution of the local unknowns if the common ones stay where they are

    def local_steps(self, common: Array) -> Array:
        """Return the solution, (s, a), of the local unknowns for one of the common ones."""
        return np.asarray(self.steps - self.gains @ common)


def eliminate(
    local: Array, mixed: Array, rhs_local: Array, common: Array, rhs_common: Array
) -> Reduced:
    """Eliminate sets of local unknowns that meet each other only through common ones.

    Parameters
    ----------
    local : (s, a, a)
        Normal matrix of each set of local unknowns.
    mixed : (s, a, q)
        Between local and common unknowns.
    rhs_local : (s, a)
        Right-hand sides of the local unknowns.
    common : (q, q)
        Normal matrix of the common unknowns if the local ones were known.
    rhs_common : (q,)
        Right-hand side of the common unknowns.

    Returns
    -------
    Reduced
        Equations of the common unknowns, and how the local ones follow from them.

    Raises
    ------
    DegenerateGeometryError
        If a set of local unknowns is undetermined though the common ones were known.

    Notes
    -----
    Schur complement (Triggs et al., Bundle Adjustment, 2000, section 6). Cost grows linearly with
    the sets and with the square of the common unknowns.
    """
    own, is_regular = invert_each(local)
    if not is_regular.all():
        raise DegenerateGeometryError(
            f"The observations leave {np.sum(~is_regular)} of {len(local)} sets of local unknowns "
            "undetermined, even with all others known."
        )
    gains, steps = own @ mixed, np.einsum("sab,sb->sa", own, rhs_local)
    n_sets, n_own, n_common = mixed.shape
    flat = mixed.reshape(n_sets * n_own, n_common)
    N = common - flat.T @ gains.reshape(flat.shape)
    return Reduced((N + N.T) / 2.0, rhs_common - flat.T @ steps.ravel(), own, gains, steps)
