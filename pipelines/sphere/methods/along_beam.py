"""Centres by maximum likelihood along the beams, all markers of a stop together.

``estimation`` finds the centres; this module decides which candidates have one, and sets the final
covariance and status.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from spheremark.pipelines.config import FittingConfig
from spheremark.pipelines.geometry import levelling_rotation
from spheremark.pipelines.model import (
    RING_UNKNOWN,
    Array,
    Beams,
    Index,
    MarkerCandidate,
    MarkerCandidates,
    MarkerFit,
    Mask,
    Rejection,
    Status,
    StitchedCloud,
)
from spheremark.pipelines.scan.interpolation import (
    errors_of_interpolation,
    scatter_of_angles,
    speeds_of,
)
from spheremark.pipelines.scan.stitching import beams
from spheremark.pipelines.sphere.description import (
    WITHOUT_RINGS,
    Fits,
    incidence,
    left_out,
    limb_coverage,
    refused,
    sentence,
    weaknesses,
)
from spheremark.pipelines.sphere.estimation import (
    Estimate,
    Observe,
    Prior,
    estimate,
    estimate_radii,
    mounting_factor,
    optics_of,
    shared_factors,
    shared_height_sigmas,
    shared_range_sigmas,
)
from spheremark.pipelines.sphere.mounting import sigmas_of
from spheremark.pipelines.sphere.noise import EXPECTED_SQUARE, FACTOR_MIN, classes_of
from spheremark.pipelines.sphere.occlusion import others_towards
from spheremark.pipelines.sphere.optics import prior_sigmas
from spheremark.pipelines.sphere.radius import other_radius
from spheremark.pipelines.sphere.returns import (
    BENT,
    Returns,
    n_lines,
    returns_of,
)

NAME = "along_beam"

_STRAY = 0.6  # radii that a centre may move from its rough place, beside the moves of its faces
_N_MIN = 4  # returns: one more than unknowns
_BENT_SHARE = 0.5  # of a candidate's returns that may be left out for that reason
_DOF_STOP = 100.0  # returns that the stop's noise counts for in the noise of a marker
_FEW_INFLATION = 0.45  # variance of a centre of n returns: times 1 + this exp(-n /
_FEW_RETURNS = 30.0  # this), by Monte Carlo
_NOISE_FACTOR = 1.6  # of the stop's noise, above which a marker is called weak


class _Stop(NamedTuple):
    """The finite returns of all candidates: beams, rows of the cloud, and columns.

    ``sigma_line`` is the standard deviation that the direction of a whole scan line has [rad].
    """

    beams: Beams
    members: Index
    returns: Returns
    sigma_line: float


def fit(
    cloud: StitchedCloud, found: MarkerCandidates, config: FittingConfig, radius: float
) -> Fits:
    """Fit all candidates of a stop along their beams, with known radius.

    Notes
    -----
    Along the beam the residual of a known radius has one minimum (Franaszek, Cheok, Saidi,
    Witzgall, 2009), except for the effect of the limb: there ranges bend so fast that they are
    linearised over the width of the centre's own uncertainty (``linearisation``). The range of a
    return has a likelihood only where the footprint meets the sphere, which bounds the centre from
    all sides (``limb``). Iteratively reweighted least squares with Tukey's weight; the noise is
    pooled over the stop, by reflectivity where returns are many, and laser biases are random
    effects of all markers together, whose spread is estimated by expectation maximisation. Each
    step costs one pass over the returns.
    """
    return _fit(cloud, found, config, radius, uses_limb=True)


def fit_ranges(
    cloud: StitchedCloud,
    found: MarkerCandidates,
    config: FittingConfig,
    radius: float,
    observe: Observe | None = None,
) -> Fits:
    """Fit all candidates by their ranges and further observations, without the limb of returns."""
    return _fit(cloud, found, config, radius, uses_limb=False, observe=observe)


def _fit(
    cloud: StitchedCloud,
    found: MarkerCandidates,
    config: FittingConfig,
    radius: float,
    *,
    uses_limb: bool,
    observe: Observe | None = None,
) -> Fits:
    """Return the fits of all candidates, and the refused ones."""
    if not found.candidates:
        return Fits((), ())
    stop, sigma_biases = _gather(cloud, found.candidates, config)
    prior = Prior(
        radius,
        sigma_biases,
        prior_sigmas(config, cloud.rig),
        config.sigma_gimbal_clock,
        sigmas_of(config.sigma_mounting, config.sigma_offset),
    )
    rough = np.array([c.p_base_rough for c in found.candidates])
    others = others_towards(cloud, found.candidates, radius) if uses_limb else None
    best = estimate(stop.returns, rough, prior, observe, others)
    radii, sigmas = estimate_radii(stop.returns, best, radius, prior)
    shared, factors = shared_range_sigmas(best.state), shared_factors(best.state)
    heights = shared_height_sigmas(best.state)
    optics, by_optics = optics_of(best.state, prior)
    results = [
        _result(
            stop,
            best,
            k,
            candidate,
            radius=radius,
            radius_free=float(radii[k]),
            sigma_radius_free=float(sigmas[k]),
            sigma_range_shared=float(shared[k]),
            sigma_height_shared=float(heights[k]),
            shared_base=factors[k].copy(),
            optics=optics,
            range_by_optics=by_optics[k].copy(),
        )
        for k, candidate in enumerate(found.candidates)
    ]
    fits = tuple(r for r in results if isinstance(r, MarkerFit))
    rejected = tuple(r for r in results if isinstance(r, Rejection))
    return Fits(fits, rejected, mounting_factor(best.state, prior))


def _gather(
    cloud: StitchedCloud, candidates: tuple[MarkerCandidate, ...], config: FittingConfig
) -> tuple[_Stop, Array]:
    """Return the members of all candidates as one table, and the prior sigmas of laser biases."""
    members = np.concatenate([c.members for c in candidates])
    ends = np.cumsum([0, *(len(c.members) for c in candidates)])
    is_kept = np.isfinite(cloud.p_base[members]).all(axis=1)
    bent = errors_of_interpolation(cloud.gimbal_angles, members)
    is_kept &= ~_too_bent(bent > BENT * config.sigma_direction, ends)
    together, starts = members[is_kept], np.concatenate([[0], np.cumsum(is_kept)])[ends]
    table = beams(cloud, together)
    of_angles = scatter_of_angles(cloud.gimbal_angles, config.sigma_direction)
    lasers = np.flatnonzero(np.bincount(table.rings))
    # returns of unknown lasers come from all sixteen: their common bias is the mean of as many
    sigma_biases = np.where(
        lasers != RING_UNKNOWN, config.sigma_range_bias, config.sigma_range_bias / 4.0
    )
    returns = returns_of(
        table,
        starts,
        levelling_rotation(cloud.levelling)[2],
        np.searchsorted(lasers, table.rings),
        (*classes_of(table.intensities), _sigmas_direction(of_angles, table.times, starts, config)),
        speeds_of(cloud.gimbal_angles, together),
    )
    return _Stop(table, together, returns, min(of_angles, config.sigma_direction)), sigma_biases


def _too_bent(is_bent: Mask, ends: Index) -> Mask:
    """Tell which returns to leave out of candidates, (n,), because their gimbal angle is unknown.

    Such errors are no noise: all returns between two samples are off to one side. A candidate of
    which most returns are of this kind keeps them.
    """
    shares = [is_bent[a:b].mean() if b > a else 0.0 for a, b in pairwise(ends)]
    return is_bent & np.repeat(np.array(shares) <= _BENT_SHARE, np.diff(ends))


def _sigmas_direction(
    of_angles: float, times: Array, starts: Index, config: FittingConfig
) -> Array:
    """Return the standard deviation of the direction of each return [rad].

    Where the gimbal's angles scatter by more than is usual, the returns of a scan line share that
    error: each counts for its part of the line.
    """
    excess2 = max(of_angles**2 - config.sigma_direction**2, 0.0)
    of_line = [(b - a) / n_lines(times[a:b]) for a, b in pairwise(starts)]
    variances = config.sigma_direction**2 + excess2 * np.array(of_line)
    return np.repeat(np.sqrt(variances), np.diff(starts))


def _result(
    stop: _Stop, best: Estimate, k: int, candidate: MarkerCandidate, **known: Any
) -> MarkerFit | Rejection:
    """Return one candidate's fit, or why it has none; ``known`` are fields of the fit."""
    (start, end), radius = stop.returns.starts[k : k + 2], known["radius"]
    weights = best.weighed.weights[start:end]
    used = start + np.flatnonzero(weights > 0.0)
    state, residuals, n = best.state, best.weighed.residuals[used], len(used)
    moved = float(np.linalg.norm(state.centres[k] - candidate.p_base_rough))
    worst = float(np.sqrt(np.linalg.eigvalsh(state.cov_noise[k])[-1]))
    moved -= float(np.linalg.norm(state.face_moves[k]))  # the rough place may be one face's
    reason = _refusal(n, worst, moved, radius)
    if reason:
        return refused(candidate, reason)
    square = float(np.sum(weights[used - start] * (residuals / best.weighed.sigmas[used]) ** 2))
    ratio = math.sqrt(square / EXPECTED_SQUARE / max(n - 3, 1))
    factor = best.weighed.noise.factor
    sigma0 = max(factor * ratio, FACTOR_MIN)
    rings, offsets = stop.beams.rings[used], best.linear.offsets[:, used].T
    n_rings = len(np.unique(rings[rings != RING_UNKNOWN]))
    x, y = offsets.T
    passed = x * stop.returns.first_axes[:, used] + y * stop.returns.second_axes[:, used]
    coverage = limb_coverage(stop.returns.directions[:, used], passed, radius)
    reasons = weaknesses(n, n_rings, coverage)
    reasons += other_radius(radius, known["radius_free"], known["sigma_radius_free"])
    ratio = sigma0 / factor
    if ratio > _NOISE_FACTOR:
        reasons.append(f"its residuals are {ratio:.1f} times those of the stop")
    members = stop.members[used]
    return MarkerFit(
        name=candidate.name,
        p_base=state.centres[k].copy(),
        cov_p_base=_covariance(best, k, n, ratio)
        + _by_lines(state.centres[k], stop.beams.times[used], stop.sigma_line),
        method=NAME,
        status=Status.WEAK if reasons else Status.OK,
        reason=sentence(reasons),
        sigma0=sigma0,
        mean_range=float(
            np.linalg.norm(stop.beams.origins_base[used].mean(axis=0) - state.centres[k])
        ),
        mean_intensity=float(stop.beams.intensities[used].mean(dtype=np.float64)),
        used=members,
        rejected=left_out(candidate.members, members),
        residuals=residuals,
        n_rings=n_rings,
        coverage=coverage,
        incidence=incidence(offsets, radius),
        variant="" if n_rings else WITHOUT_RINGS,
        **known,
    )


def _refusal(n_used: int, worst: float, moved: float, radius: float) -> str:
    """Return why a candidate has no centre; empty if it has one."""
    if n_used < _N_MIN:
        return (
            f"Only {n_used} returns lie on a sphere of radius {1e3 * radius:.0f} mm; a centre "
            f"needs at least {_N_MIN}."
        )
    if worst > radius:
        return (
            "Its returns leave the centre undetermined: they lie on one line, or on no sphere of "
            f"radius {1e3 * radius:.0f} mm."
        )
    if moved > _STRAY * radius:
        return (
            f"The fit left the place where it was found by {1e3 * moved:.0f} mm: no sphere of "
            f"radius {1e3 * radius:.0f} mm is there."
        )
    return ""


def inflation(n_used: int) -> float:
    """Return the factor by which the variance of few returns exceeds that by the noise alone."""
    return 1.0 + _FEW_INFLATION * math.exp(-n_used / _FEW_RETURNS)


def _covariance(best: Estimate, k: int, n_used: int, ratio: float) -> Array:
    """Return a centre's covariance; ``ratio`` is the noise of its residuals over the stop's.

    The stop's noise counts for many returns: a few that agree by chance must not look precise.
    """
    variance = (_DOF_STOP + n_used * ratio**2) / (_DOF_STOP + n_used)
    by_noise = variance * best.state.cov_noise[k]
    return np.asarray(inflation(n_used) * (by_noise + best.state.cov_shared_part[k]))


def _by_lines(centre: Array, times: Array, sigma_line: float) -> Array:
    """Return the covariance by the angle of the gimbal, an error that each scan line has once."""
    sideways = np.array([-centre[1], centre[0], 0.0])
    return np.asarray(sigma_line**2 / n_lines(times) * np.outer(sideways, sideways))
