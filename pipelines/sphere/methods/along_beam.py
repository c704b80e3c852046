"""Centres by maximum likelihood along the beams, all markers of a stop together.

Hides what is made of the estimate (``estimation``): which candidates have a centre, how well it is
known, and what weakens it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from spheremark.pipelines.compilation import compiled
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
from spheremark.pipelines.scan.stitching import beams
from spheremark.pipelines.sphere.description import (
    WITHOUT_RINGS,
    Fits,
    incidence,
    left_out,
    refused,
    sentence,
    weaknesses,
)
from spheremark.pipelines.sphere.estimation import (
    Estimate,
    Known,
    Told,
    estimate,
    radii_shown,
    sigmas_shared,
)
from spheremark.pipelines.sphere.faces import sigmas_of
from spheremark.pipelines.sphere.footprint import share_of_outline
from spheremark.pipelines.sphere.noise import EXPECTED_SQUARE, FACTOR_MIN, Weighed, classes_of
from spheremark.pipelines.sphere.radius import other_radius
from spheremark.pipelines.sphere.returns import Rows, rows_of

NAME = "along_beam"

_STRAY = 0.6  # radii that a centre may move from its rough place
_N_MIN = 4  # returns: one more than unknowns
_DOF_STOP = 100.0  # returns that the stop's noise is worth when a marker's own is judged

_FEW_INFLATION = 0.45  # what few returns add to the variance of a centre: 1 + this exp(-n /
_FEW_RETURNS = 30.0  # this), by Monte Carlo

_NOISE_FACTOR = 1.6  # of the stop's noise, above which a marker is called weak


class _Shots(NamedTuple):
    """The returns of all candidates in one table.

    Attributes
    ----------
    beams : Beams
        Their beams.
    members : (n,)
        Rows of the cloud.
    rows : Rows
        The same as the estimate needs them.
    is_told : (k,)
        Whether each laser that occurs is told from the others.
    """

    beams: Beams
    members: Index
    rows: Rows
    is_told: Mask


class _Tally(NamedTuple):
    """What the returns that carry each centre have in common; all (m,).

    Attributes
    ----------
    n_used, n_rings : ndarray of int
        Number of them, and of different lasers among them.
    mean_range, mean_intensity : ndarray
        Distance from their mean origin [m], and mean reflectivity.
    sigma0 : ndarray
        Their noise in units of the prior.
    coverage, incidence : ndarray
        Share of the outline that has returns, and their mean angle of incidence [rad].
    """

    n_used: Index
    n_rings: Index
    mean_range: Array
    mean_intensity: Array
    sigma0: Array
    coverage: Array
    incidence: Array


def fit(
    cloud: StitchedCloud, found: MarkerCandidates, config: FittingConfig, radius: float
) -> Fits:
    """Fit all candidates of a stop along their beams, with known radius.

    Notes
    -----
    Along the beam the residual of a known radius has one minimum (Franaszek, Cheok, Saidi,
    Witzgall, 2009), save for what the limb adds: there ranges bend so fast that they are linearised
    over the width of the centre's own uncertainty (``linearising.linearise``). A range of a sphere
    has a likelihood only where the footprint meets the sphere: that bounds the centre from all
    sides (``outline``). Iteratively reweighted least squares with Tukey's weight; the noise is
    pooled over the stop, by reflectivity where returns are many, and laser biases are random
    effects of all markers together, whose spread is estimated by expectation maximisation. Each
    step costs one pass over the returns.
    """
    return _fit(cloud, found, config, radius, asks_outline=True)


def fit_ranges(
    cloud: StitchedCloud,
    found: MarkerCandidates,
    config: FittingConfig,
    radius: float,
    told: Told | None = None,
) -> Fits:
    """Fit all candidates of a stop by their ranges, wherever their beams meet the spheres."""
    return _fit(cloud, found, config, radius, asks_outline=False, told=told)


def _fit(
    cloud: StitchedCloud,
    found: MarkerCandidates,
    config: FittingConfig,
    radius: float,
    *,
    asks_outline: bool,
    told: Told | None = None,
) -> Fits:
    """Return the fits of all candidates, and those that are none."""
    if not found.candidates:
        return (), ()
    shots, sigma_biases = _gather(cloud, found.candidates, config)
    sigma_mounting = sigmas_of(config.sigma_mounting, config.sigma_offset)
    known = Known(radius, sigma_biases, sigma_mounting)
    rough = np.array([c.p_base_rough for c in found.candidates])
    best = estimate(shots.rows, rough, known, told, asks_outline=asks_outline)
    results = _judged(shots, best, found.candidates, rough, radius)
    fits = tuple(r for r in results if isinstance(r, MarkerFit))
    return fits, tuple(r for r in results if isinstance(r, Rejection))


def _gather(
    cloud: StitchedCloud, candidates: tuple[MarkerCandidate, ...], config: FittingConfig
) -> tuple[_Shots, Array]:
    """Return the members of all candidates as one table of shots, and the sigmas of biases."""
    members = np.concatenate([c.members for c in candidates])
    is_finite = np.isfinite(cloud.p_base[members]).all(axis=1)
    ends = np.cumsum([0, *(len(c.members) for c in candidates)])
    together, firsts = members[is_finite], np.concatenate([[0], np.cumsum(is_finite)])[ends]
    table = beams(cloud, together)
    lasers = np.flatnonzero(np.bincount(table.rings))
    is_told = lasers != RING_UNKNOWN
    # returns of unknown lasers come from all sixteen: their common part is what is left of a bias
    sigma_biases = np.where(is_told, config.sigma_range_bias, config.sigma_range_bias / 4.0)
    rows = rows_of(
        table,
        firsts,
        levelling_rotation(cloud.levelling)[2],
        np.searchsorted(lasers, table.rings),
        (*classes_of(table.intensities), config.sigma_direction),
    )
    return _Shots(table, together, rows, is_told), sigma_biases


def _tallied(shots: _Shots, best: Estimate, radius: float) -> _Tally:
    """Sum up the returns that carry each centre."""
    table, offsets = shots.beams, best.linear.offsets
    seen = (offsets, table.intensities, shots.is_told)
    tally = _Tally(*_tally(shots.rows, best.state.centres, best.weighed, seen, radius))
    ratio2 = tally.sigma0 / EXPECTED_SQUARE / np.maximum(tally.n_used - 3.0, 1.0)
    factors = np.maximum(best.state.noise.factor * np.sqrt(ratio2), FACTOR_MIN)
    return tally._replace(sigma0=factors)


@compiled
def _tally(
    rows: Rows,
    centres: Array,
    weighed: Weighed,
    seen: tuple[Array, Array, Mask],
    radius: float,
) -> tuple[Index, Index, Array, Array, Array, Array, Array]:
    """Return ``_Tally`` with the weighted squares of residuals in units of sigma for their noise.

    ``seen`` are offsets, intensities, and which lasers are told apart.
    """
    m, (offsets, intensities, is_told) = len(centres), seen
    n_used, n_rings, squares = np.zeros(m, np.intp), np.zeros(m, np.intp), np.zeros(m)
    ranges, means, coverages, angles = np.zeros(m), np.zeros(m), np.zeros(m), np.zeros(m)
    for s in range(m):
        first = rows.firsts[s]
        used = first + np.flatnonzero(weighed.weights[first : rows.firsts[s + 1]] > 0.0)
        n_used[s] = len(used)
        if not len(used):
            continue
        middle, is_seen = np.zeros(3), np.zeros(len(is_told), np.bool_)
        for i in used:
            squares[s] += weighed.weights[i] * (weighed.residuals[i] / weighed.sigmas[i]) ** 2
            is_seen[rows.lasers[i]] = is_told[rows.lasers[i]]
            means[s] += intensities[i] / len(used)
            for j in range(3):
                middle[j] += rows.origins[j, i] / len(used)
        n_rings[s], ranges[s] = np.sum(is_seen), np.sqrt(np.sum((middle - centres[s]) ** 2))
        axes, some = (rows.directions[:, used], rows.firsts_axis[:, used]), offsets[:, used]
        coverages[s] = share_of_outline(axes[0], axes[1], some, radius)
        angles[s] = incidence(some, radius)
    return n_used, n_rings, ranges, means, squares, coverages, angles


def _refusals(best: Estimate, n_used: Index, rough: Array, radius: float) -> list[str]:
    """Return why candidates have no centre; empty for each that has one."""
    moved = np.linalg.norm(best.state.centres - rough, axis=1)
    worst = np.sqrt(np.linalg.eigvalsh(best.state.cov_noise)[:, -1])
    return [
        _refusal(n, sigma, off, radius)
        for n, sigma, off in zip(n_used.tolist(), worst.tolist(), moved.tolist(), strict=True)
    ]


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


def inflation(n_used: int | Index) -> Array:
    """Return by how much a few returns know less than the noise alone would have it."""
    return np.asarray(1.0 + _FEW_INFLATION * np.exp(-np.asarray(n_used) / _FEW_RETURNS))


def _covariances(best: Estimate, tally: _Tally) -> Array:
    """Return the centres' covariances: noise as the stop and the marker show it, and biases.

    The noise is that of the stop until a marker has returns enough to speak for itself: a handful
    of returns that agree by chance must not look precise.
    """
    n_used, ratio2 = tally.n_used, (tally.sigma0 / best.state.noise.factor) ** 2
    variances = (_DOF_STOP + n_used * ratio2) / (_DOF_STOP + n_used)
    by_noise = variances[:, None, None] * best.state.cov_noise
    return np.asarray(inflation(n_used)[:, None, None] * (by_noise + best.state.cov_biases))


def _judged(
    shots: _Shots,
    best: Estimate,
    candidates: tuple[MarkerCandidate, ...],
    rough: Array,
    radius: float,
) -> list[MarkerFit | Rejection]:
    """Return the candidates' fits with their diagnostics, or the reason why there is none."""
    tally = _tallied(shots, best, radius)
    radii, sigmas = radii_shown(shots.rows, best, radius)
    columns = tally._asdict()
    columns |= {"radius_free": radii, "sigma_radius_free": sigmas}
    columns["sigma_range_shared"] = sigmas_shared(best.state)
    n_used = columns.pop("n_used")
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    told = [{**dict(zip(columns, row, strict=True)), "radius": radius} for row in rows]
    refusals, covs = _refusals(best, n_used, rough, radius), _covariances(best, tally)
    return [
        refused(candidate, refusals[k])
        if refusals[k]
        else _described(shots, best, k, candidate, cov_p_base=covs[k].copy(), **told[k])
        for k, candidate in enumerate(candidates)
    ]


def _described(
    shots: _Shots, best: Estimate, k: int, candidate: MarkerCandidate, **known: Any
) -> MarkerFit:
    """Return one candidate's fit; ``known`` are the fields that are found of all together."""
    first, behind = shots.rows.firsts[k : k + 2]
    used = first + np.flatnonzero(best.weighed.weights[first:behind] > 0.0)
    members = shots.members[used]
    reasons = weaknesses(len(used), known["n_rings"], known["coverage"])
    reasons += other_radius(known["radius"], known["radius_free"], known["sigma_radius_free"])
    ratio = known["sigma0"] / best.state.noise.factor
    if ratio > _NOISE_FACTOR:
        reasons.append(f"its residuals are {ratio:.1f} times those of the stop")
    return MarkerFit(
        name=candidate.name,
        p_base=best.state.centres[k].copy(),
        method=NAME,
        status=Status.WEAK if reasons else Status.OK,
        reason=sentence(reasons),
        used=members,
        rejected=left_out(candidate.members, members),
        residuals=best.weighed.residuals[used],
        variant="" if known["n_rings"] else WITHOUT_RINGS,
        **known,
    )
