"""Diagnostics of a fitted sphere by any method: residuals, coverage, incidence, status."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from spheremark.pipelines.geometry import levelling_rotation
from spheremark.pipelines.model import (
    RING_UNKNOWN,
    Array,
    Index,
    MarkerCandidate,
    MarkerFit,
    Mask,
    Rejection,
    Status,
    StitchedCloud,
)
from spheremark.pipelines.scan.stitching import beams
from spheremark.pipelines.sphere.footprint import predict
from spheremark.pipelines.sphere.radius import other_radius, own_radius

N_GOOD = 20
"""Returns below which a centre is called weak."""

COVERAGE_GOOD = 0.6
"""Share of the limb below which a centre is called weak."""

WITHOUT_RINGS = "rings unknown: laser heights and biases not applied"
"""Variant of a fit to returns without rings."""

_SEGMENT = 1.35  # radii about the rough centre within which a return may be the sphere
_NEARBY = 1.6  # the same for the test of the radius, which may be larger
_MIDDLE = 0.3  # radii: returns nearer to the middle belong to no octant of the limb

_N_STEPS, _SETTLED = 30, 1e-7  # steps, [m]


class Fits(NamedTuple):
    """Fits and refused candidates of a stop.

    ``mounting_factor`` is by how much errors of the mounting, which move the two faces of spheres
    apart, exceed their prior; 1 where they do not.
    """

    fits: tuple[MarkerFit, ...]
    rejected: tuple[Rejection, ...]
    mounting_factor: float = 1.0


def each(
    candidates: tuple[MarkerCandidate, ...],
    fit_one: Callable[[MarkerCandidate], MarkerFit | Rejection],
) -> Fits:
    """Fit candidates one by one."""
    results = [fit_one(candidate) for candidate in candidates]
    fits = tuple(r for r in results if isinstance(r, MarkerFit))
    return Fits(fits, tuple(r for r in results if isinstance(r, Rejection)))


def on_sphere(
    cloud: StitchedCloud, candidate: MarkerCandidate, radius: float, reach: float = _SEGMENT
) -> Index:
    """Return a candidate's rows that may be its sphere by their place."""
    away = np.linalg.norm(
        cloud.p_base[candidate.members].astype(np.float64) - candidate.p_base_rough, axis=1
    )
    return np.asarray(candidate.members[away < reach * radius])


def refused(candidate: MarkerCandidate, reason: str) -> Rejection:
    """Return a candidate as a rejection."""
    return Rejection(
        p_base=candidate.p_base_rough.copy(), n_points=len(candidate.members), reason=reason
    )


def described(
    cloud: StitchedCloud,
    candidate: MarkerCandidate,
    used: Index,
    p_base: Array,
    cov_p_base: Array,
    **known: float | str,
) -> MarkerFit:
    """Return a fit with its diagnostics; ``known`` are fields that the method sets itself."""
    pulses = beams(cloud, used)
    radius = float(known["radius"])
    which = np.zeros(len(used), dtype=np.intp)
    found = predict(pulses, p_base[None], np.array([radius]), which)
    rings = pulses.rings[pulses.rings != RING_UNKNOWN]
    n_rings = len(np.unique(rings))
    u, a = pulses.directions_base, pulses.across_base
    passed = found.offsets[:, :1] * a + found.offsets[:, 1:] * np.cross(u, a)
    coverage = limb_coverage(u.T, passed.T, radius)
    residuals = pulses.ranges - found.ranges
    nearby = beams(cloud, on_sphere(cloud, candidate, radius, _NEARBY))
    own = own_radius(nearby, radius, levelling_rotation(cloud.levelling)[2])
    variants = (known.get("variant"), "" if n_rings else WITHOUT_RINGS)
    fields: dict[str, Any] = {
        "radius_free": own[0],
        "sigma_radius_free": own[1],
        "sigma0": 1.0,
        **known,
        "variant": "; ".join(str(variant) for variant in variants if variant),
    }
    reasons = weaknesses(len(used), n_rings, coverage)
    reasons += other_radius(radius, fields["radius_free"], fields["sigma_radius_free"])
    reason = sentence(reasons)
    return MarkerFit(
        name=candidate.name,
        p_base=np.array(p_base),
        cov_p_base=np.array(cov_p_base),
        status=Status.WEAK if reason else Status.OK,
        reason=reason,
        mean_range=float(np.linalg.norm(pulses.origins_base.mean(axis=0) - p_base)),
        mean_intensity=float(pulses.intensities.mean()),
        used=used,
        rejected=left_out(candidate.members, used),
        residuals=residuals,
        n_rings=n_rings,
        coverage=coverage,
        incidence=incidence(found.offsets, radius),
        **fields,
    )


def left_out(members: Index, used: Index) -> Index:
    """Return the rows of a candidate that its fit does not use."""
    is_left = np.ones(len(members), dtype=bool)
    is_left[np.searchsorted(members, used)] = False
    return np.asarray(members[is_left])


def limb_coverage(directions: Array, passed: Array, radius: float) -> float:
    """Return the share of the octants of a sphere's limb that have returns.

    ``passed``, (3, n), are the vectors from the centre to the beams [m].
    """
    x, y, z = middle = directions.mean(axis=1)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    # the footprint's axes are turned over between the two faces of the scan, these are not
    first = cross[:, np.argmin(np.abs(middle))]
    first /= np.linalg.norm(first)
    x, y = first @ passed, cross @ first @ passed
    octants = 4 * (y < 0.0) + 2 * (x < 0.0) + (np.abs(y) > np.abs(x))
    is_seen = np.zeros(8, dtype=np.bool_)
    is_seen[octants[x * x + y * y > (_MIDDLE * radius) ** 2]] = True
    return float(is_seen.mean())


def incidence(offsets: Array, radius: float) -> float:
    """Return the mean angle between beams and the normals of a sphere, from offsets (n, 2)."""
    return float(np.mean(np.arcsin(np.minimum(np.hypot(*offsets.T) / radius, 1.0))))


def weaknesses(n_points: int, n_rings: int, coverage: float) -> list[str]:
    """Return the reasons to call a centre weak that hold for every method."""
    tests = (
        (n_points < N_GOOD, f"only {n_points} returns (at least {N_GOOD} are good)"),
        (n_rings == 1, "all returns are of one laser"),
        (coverage < COVERAGE_GOOD, f"only {100 * coverage:.0f} % of it is seen"),
    )
    return [reason for is_so, reason in tests if is_so]


def sentence(reasons: list[str]) -> str:
    """Return reasons as one sentence; empty if there are none."""
    text = ", ".join(reasons)
    return text[:1].upper() + text[1:] + "." if reasons else ""


def surface(points: Array, p: Array, radius: float) -> tuple[Array, Array]:
    """Return unit vectors from a centre to points, and the points' distances from the surface."""
    v = points - p
    away = np.linalg.norm(v, axis=1)
    return v / np.maximum(away, 1e-9)[:, None], away - radius


def iterated(linearise: Callable[[Array], tuple[Array, Array]], x: Array, step_max: float) -> Array:
    """Return where Gauss-Newton steps, none longer than ``step_max`` [m], settle."""
    for _ in range(_N_STEPS):
        step = np.linalg.lstsq(*linearise(x))[0]
        step *= min(1.0, step_max / max(float(np.linalg.norm(step)), 1e-12))
        x = x + step
        if np.linalg.norm(step) < _SETTLED:
            break
    return x


def spread_of(normals: Array, residuals: Array, n_unknowns: int) -> Array:
    """Return the formal covariance of a least-squares fit with equal weights."""
    variance = float(residuals @ residuals) / max(len(residuals) - n_unknowns, 1)
    return np.asarray(variance * np.linalg.inv(normals + 1e-9 * np.eye(len(normals))))


def is_undetermined(normals: Array, n: int) -> Mask | bool:
    """Tell whether normal equations of unit rows leave an unknown undetermined."""
    if not np.all(np.isfinite(normals)):
        return True
    return bool(np.linalg.eigvalsh(normals)[0] < 1e-3 * np.sqrt(max(n, 1)))
