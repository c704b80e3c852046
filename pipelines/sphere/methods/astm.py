"""Centres as surveyors' standard ASTM E3125-17 has them: cone, cylinder, 3 sigma, known radius.

The standard is written for spheres with hundreds of returns; with fewer a small-sample variant of
its choice of returns applies.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spheremark.pipelines.config import FittingConfig
from spheremark.pipelines.model import (
    Array,
    Beams,
    Index,
    MarkerCandidate,
    MarkerCandidates,
    MarkerFit,
    Mask,
    Rejection,
    StitchedCloud,
)
from spheremark.pipelines.scan.stitching import beams
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

NAME = "astm_e3125"
STANDARD = "ASTM E3125-17"
SMALL_SAMPLE = "ASTM E3125-17, small sample"

_N_DENSE = 300  # returns from which the standard's own constants are taken
_CONE = np.cos(np.radians(60.0))
_CYLINDER = np.sin(np.radians(60.0))  # radii
_N_PASSES = 6
_SIGMAS = 3.0
_N_KEPT = 12  # returns that the small-sample variant does not thin out further by 3 sigma
_NEAREST = 0.25  # share of the returns that starts the small-sample variant
_N_MIN = 4  # returns: one more than unknowns
_STEP_MAX = 0.25  # radii
_STRAY = 1.0  # radii by which a centre may leave its rough place


class _Chosen(NamedTuple):
    """The returns that are used, and the centre [m]."""

    is_used: Mask
    p: Array


def fit(
    cloud: StitchedCloud, found: MarkerCandidates, config: FittingConfig, radius: float
) -> Fits:
    """Fit the candidates of a stop as ASTM E3125-17 derives a sphere's centre.

    Notes
    -----
    The start is one radius behind the closest return. Six passes keep the returns within 60 degrees
    of the line from the centre to the LiDAR, as seen from the centre, and within ``R sin 60`` of
    that line, fit the centre by least squares of the distances from a surface of known radius, and
    drop what is off by more than 3 sigma. The LiDAR moves as the gimbal turns: each return has the
    origin of its own beam.

    With fewer than 300 returns the small-sample variant runs: the start is one radius behind the
    mean of the nearest quarter, because the closest of noisy returns is too close; sigma has the
    degrees of freedom of the fit; and 3 sigma drops nothing once 12 returns are left.
    """
    del config
    return each(found.candidates, lambda one: _fit_one(cloud, one, radius))


def _fit_one(
    cloud: StitchedCloud, candidate: MarkerCandidate, radius: float
) -> MarkerFit | Rejection:
    """Fit one candidate."""
    rows = on_sphere(cloud, candidate, radius)
    if len(rows) < _N_MIN:
        return refused(
            candidate, f"Only {len(rows)} returns lie near the sphere; a centre needs {_N_MIN}."
        )
    returns, points = beams(cloud, rows), cloud.p_base[rows].astype(np.float64)
    chosen = _passes(returns, points, radius)
    n = int(chosen.is_used.sum())
    if n < _N_MIN or np.linalg.norm(chosen.p - candidate.p_base_rough) > _STRAY * radius:
        return refused(
            candidate,
            f"Cone, cylinder and 3 sigma leave {n} of {len(rows)} returns about a centre that "
            f"needs {_N_MIN}.",
        )
    used: Index = rows[chosen.is_used]
    normals, residuals = surface(points[chosen.is_used], chosen.p, radius)
    if is_undetermined(normals.T @ normals, n):
        return refused(candidate, "Its returns leave the centre undetermined: they lie on a line.")
    cov = spread_of(normals.T @ normals, residuals, 3)
    variant = STANDARD if len(rows) >= _N_DENSE else SMALL_SAMPLE
    return described(
        cloud, candidate, used, chosen.p, cov, method=NAME, radius=radius, variant=variant
    )


def _passes(returns: Beams, points: Array, radius: float) -> _Chosen:
    """Choose returns and fit the centre, in turn."""
    is_small = len(points) < _N_DENSE
    order = np.argsort(returns.ranges)
    nearest = order[: max(int(_NEAREST * len(points)), 3) if is_small else 1]
    outward = returns.directions_base[nearest].mean(axis=0)
    p = points[nearest].mean(axis=0) + radius * outward / np.linalg.norm(outward)
    is_used = np.zeros(len(points), dtype=bool)
    for _ in range(_N_PASSES):
        is_used = _in_view(returns, points, p, radius)
        if is_used.sum() < _N_MIN:
            break
        p = _centre(points[is_used], p, radius)
        residuals = surface(points[is_used], p, radius)[1]
        n = len(residuals)
        sigma = float(np.sqrt(residuals @ residuals / (max(n - 3, 1) if is_small else n)))
        is_off = np.abs(residuals) > _SIGMAS * sigma
        if is_off.any() and not (is_small and n - is_off.sum() < _N_KEPT):
            is_used[np.flatnonzero(is_used)[is_off]] = False
            p = _centre(points[is_used], p, radius)
    return _Chosen(is_used, p)


def _in_view(returns: Beams, points: Array, p: Array, radius: float) -> Mask:
    """Tell which returns lie in the cone about the line to the LiDAR, and in the cylinder."""
    axis = returns.origins_base - p
    axis = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    v = points - p
    along, away = np.einsum("ij,ij->i", v, axis), np.linalg.norm(v, axis=1)
    beside = np.sqrt(np.maximum(away**2 - along**2, 0.0))
    return np.asarray((along > _CONE * away) & (beside < _CYLINDER * radius))


def _centre(points: Array, p: Array, radius: float) -> Array:
    """Return the centre of a sphere of known radius by least squares of the distances from it."""
    return iterated(lambda p: surface(points, p, radius), p, _STEP_MAX * radius)
