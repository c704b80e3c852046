"""Information of free stations by its lower triangles: packed, summed and inverted."""

from __future__ import annotations

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.model import Array

N_UNKNOWNS = 7
"""Rotation, the error of range that all centres share, and the position."""

ROWS, COLUMNS = np.tril_indices(N_UNKNOWNS)
"""Of the elements of a packed matrix."""

N_PACKED = len(ROWS)
"""Elements of a packed matrix."""

_N_POSE = N_UNKNOWNS - 3  # unknowns before the position
_LEAST = 1e-13  # of a diagonal element that remains when the unknowns before it are eliminated


def packed(matrices: Array) -> Array:
    """Return the lower triangles, (..., 28), of matrices, (..., 7, 7)."""
    return np.asarray(matrices[..., ROWS, COLUMNS])


def unpacked(rows: Array) -> Array:
    """Return symmetric matrices, (..., 7, 7), from their lower triangles, (..., 28)."""
    out = np.empty((*rows.shape[:-1], N_UNKNOWNS, N_UNKNOWNS))
    out[..., ROWS, COLUMNS] = out[..., COLUMNS, ROWS] = rows
    return out


@compiled
def variance_of(N: Array) -> float:
    """Return the trace of the covariance of a position; infinite where it is undetermined.

    The packed normal matrix is replaced by its Cholesky factor.
    """
    for i in range(N_UNKNOWNS):
        a = i * (i + 1) // 2
        for j in range(i + 1):
            b = j * (j + 1) // 2
            whole = total = N[a + j]
            for k in range(j):
                total -= N[a + k] * N[b + k]
            if i > j:
                N[a + j] = total / N[b + j]
            elif total > _LEAST * whole:
                N[a + i] = np.sqrt(total)
            else:
                return np.inf
    a, b, c = 1.0 / N[14], 1.0 / N[20], 1.0 / N[27]  # of the factor's last three rows
    d, f = N[19] * a * b, N[26] * b * c
    e = (N[19] * N[26] - N[25] * N[20]) * a * b * c
    return float(a * a + b * b + c * c + d * d + e * e + f * f)


@compiled
def squares_of(N: Array, out: Array) -> float:
    """Write ``Y Y'`` of the position's columns ``Y`` of an inverse; return their trace.

    Packed; elements off the diagonal count twice. The normal matrix is replaced by its factor.
    """
    if not variance_of(N) < np.inf:
        return np.inf
    columns, trace = np.zeros((3, N_UNKNOWNS)), 0.0
    for c in range(3):
        y = columns[c]
        for i in range(_N_POSE + c, N_UNKNOWNS):
            total = 1.0 if i == _N_POSE + c else 0.0
            for k in range(_N_POSE + c, i):
                total -= N[i * (i + 1) // 2 + k] * y[k]
            y[i] = total / N[i * (i + 1) // 2 + i]
        for i in range(N_UNKNOWNS - 1, -1, -1):
            total = y[i]
            for k in range(i + 1, N_UNKNOWNS):
                total -= N[k * (k + 1) // 2 + i] * y[k]
            y[i] = total / N[i * (i + 1) // 2 + i]
        trace += y[_N_POSE + c]
    for i in range(N_UNKNOWNS):
        for j in range(i + 1):
            total = 0.0
            for c in range(3):
                total += columns[c, i] * columns[c, j]
            out[i * (i + 1) // 2 + j] = total if i == j else 2.0 * total
    return float(trace)
