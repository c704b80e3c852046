"""Spheres with an unknown radius: the geometric and the algebraic fit of the textbooks.

For comparison and as diagnostics: with as few returns as a VLP-16 gives they have heavy tails and
centimetres of bias.
"""

from __future__ import annotations

import numpy as np

from spheremark.pipelines.config import FittingConfig
from spheremark.pipelines.model import (
    Array,
    MarkerCandidate,
    MarkerCandidates,
    MarkerFit,
    Rejection,
    StitchedCloud,
)
from spheremark.pipelines.sphere.description import (
    Fits,
    described,
    each,
    is_undetermined,
    iterated,
    on_sphere,
    refused,
    spread_of,
    surface,
)

GEOMETRIC = "free_radius"
ALGEBRAIC = "algebraic"

_N_MIN = 5  # returns: one more than unknowns
_STEP_MAX = 0.5  # radii
_STRAY = 2.0  # radii by which a centre may leave its rough place


def fit_geometric(
    cloud: StitchedCloud, found: MarkerCandidates, config: FittingConfig, radius: float
) -> Fits:
    """Fit centre and radius by least squares of the distances from the surface.

    Notes
    -----
    Gauss-Newton from the rough centre, equal weights, no rejection.
    """
    del config
    return each(found.candidates, lambda one: _fit_one(cloud, one, radius, GEOMETRIC))


def fit_algebraic(
    cloud: StitchedCloud, found: MarkerCandidates, config: FittingConfig, radius: float
) -> Fits:
    """Fit centre and radius by linear least squares.

    Notes
    -----
    ``|p|^2 = 2 c p + (R^2 - |c|^2)`` is linear in ``c`` and in the bracket (Coope, Circle fitting
    by linear and nonlinear least squares, 1993).
    """
    del config
    return each(found.candidates, lambda one: _fit_one(cloud, one, radius, ALGEBRAIC))


def _fit_one(
    cloud: StitchedCloud, candidate: MarkerCandidate, radius: float, method: str
) -> MarkerFit | Rejection:
    """Fit one candidate by one of the two methods."""
    used = on_sphere(cloud, candidate, radius)
    if len(used) < _N_MIN:
        return refused(
            candidate,
            f"Only {len(used)} returns lie near the sphere; an estimate of centre and "
            f"radius needs {_N_MIN}.",
        )
    points = cloud.p_base[used].astype(np.float64) - candidate.p_base_rough
    start = np.array([0.0, 0.0, 0.0, radius])
    if method == ALGEBRAIC:
        sphere = _linear(points)
    else:
        sphere = iterated(lambda x: _distances(points, x), start, _STEP_MAX * radius)
    J, residuals = _distances(points, sphere)
    is_away = not np.linalg.norm(sphere[:3]) < _STRAY * radius
    if is_away or is_undetermined(J.T @ J, len(used)):
        return refused(candidate, "Its returns do not determine a centre and a radius.")
    cov = spread_of(J.T @ J, residuals, 4)
    return described(
        cloud,
        candidate,
        used,
        candidate.p_base_rough + sphere[:3],
        cov[:3, :3],
        method=method,
        radius=radius,
        radius_free=float(sphere[3]),
        sigma_radius_free=float(np.sqrt(cov[3, 3])),
    )


def _linear(points: Array) -> Array:
    """Return centre and radius, (4,), by linear least squares; NaN where there is no sphere."""
    J = np.column_stack([2.0 * points, np.ones(len(points))])
    x = np.linalg.lstsq(J, np.sum(points**2, axis=1))[0]
    square = x[3] + x[:3] @ x[:3]
    return np.array([*x[:3], np.sqrt(square) if square > 0.0 else np.nan])


def _distances(points: Array, sphere: Array) -> tuple[Array, Array]:
    """Return derivatives, (n, 4), and residuals of the distances from a sphere [m]."""
    normals, distances = surface(points, sphere[:3], float(sphere[3]))
    return np.column_stack([normals, np.ones(len(points))]), distances
