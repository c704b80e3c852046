"""Small symmetric positive definite matrices in compiled loops: factor, solve, invert.

For kernels that need thousands of systems of up to a few tens of unknowns. Only the lower triangle
of an argument is read. Elsewhere ``np.linalg`` serves, on stacks of matrices too.
"""

from __future__ import annotations

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.model import Array

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
