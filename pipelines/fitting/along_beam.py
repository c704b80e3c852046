"""Centres by maximum likelihood along the beams, all markers of a stop together.

Hides noise, outliers and laser biases. The markers of a stop share what one marker alone cannot
tell: the noise of this sensor today, what each laser measures too long, and how sharply returns end
at the outline.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pipelines.config import FittingConfig
from pipelines.fitting.description import (
    WITHOUT_RINGS,
    Fits,
    incidence,
    left_out,
    refused,
    sentence,
    weaknesses,
)
from pipelines.fitting.faces import N_MOUNTING, effects_on, sigmas_of
from pipelines.fitting.footprint import share_of_outline
from pipelines.fitting.outline import Outline, outline_normals, outline_of
from pipelines.fitting.passes import (
    Linear,
    Normals,
    Rows,
    in_play,
    linearise,
    noise_of,
    normals_of,
    rows_of,
)
from pipelines.fitting.radius import Weighing, free_radii, other_radius
from pipelines.geometry import levelling_rotation
from pipelines.stitching import beams
from pipelines.values import (
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

NAME = "along_beam"

# Range noise of a VLP-16 by reflectivity, from recorded packets [m]: a prior, for the ratio between
# dark and bright; its size is estimated from the stop.
_REFLECTIVITIES = np.array([5.0, 15.0, 40.0, 100.0])  # limits between the classes
_SIGMAS = np.array([0.0137, 0.0107, 0.0089, 0.0067, 0.0064])
_FACTOR_MIN = 0.08  # of the prior noise: 2 mm quantisation alone gives as much
_FACTOR_START = 3.0  # the largest noise that a VLP-16 shows, 25 mm

_TUKEY = 8.0  # sigmas at which a return has no weight; 99 % efficient on clean data
_EXPECTED_SQUARE = 0.9099  # mean of weight times square of normal residuals
_EFFICIENCY = 0.9753  # variance of the estimate over the inverse normal matrix
_SPREAD_MIN = 1e-5  # [m] of the laser biases: keeps their prior invertible
_N_STEPS = 8
_N_STEPS_GATED = 5  # after these the choice of returns by their place stays as it is
_N_STEPS_RANGES = 3  # without the outline
_ROUGH = 0.1  # radii by which a rough centre may be off per axis
_STEP_MAX = 0.25  # radii per step
_STRAY = 0.6  # radii that a centre may move from its rough place
_N_MIN = 4  # returns: one more than unknowns
_GAP_SIGMAS = 3.0  # of its centre by which a return may pass a sphere by and still be its own
_GAP_MIN, _GAP_MAX = 0.02, 0.3  # radii: least and most of that
_DOF_STOP = 100.0  # returns that the stop's noise is worth when a marker's own is judged
_DOF_CLASS = 30.0  # returns that the common noise is worth when that of a class is estimated
_DOF_BIAS = 2.0  # lasers that the prior of the biases is worth when their spread is estimated

_FEW_INFLATION = 0.45  # what few returns add to the variance of a centre: 1 + this exp(-n /
_FEW_RETURNS = 30.0  # this), by Monte Carlo

_NOISE_FACTOR = 1.6  # of the stop's noise, above which a marker is called weak


Told = Callable[[Array, Array], tuple[Array, Array]]
"""What else is told of centres, (m, 3) [m] with covariances (m, 3, 3) [m^2]: what it adds to their
normal equations, (m, 3, 3) [1/m^2], and to the right-hand sides, (m, 3) [1/m]."""


class _Shots(NamedTuple):
    """The returns of all candidates in one table.

    Attributes
    ----------
    beams : Beams
        Their beams.
    members : (n,)
        Rows of the cloud.
    rows : Rows
        The same as the passes need them.
    sigma_biases : (k,)
        Prior standard deviation of what each laser that occurs measures too long [m].
    sigma_mounting : (6,)
        That of the unknowns of the mounting.
    """

    beams: Beams
    members: Index
    rows: Rows
    sigma_biases: Array
    sigma_mounting: Array


class _State(NamedTuple):
    """Where the estimate stands.

    Attributes
    ----------
    centres : (m, 3)
        Centres [m].
    biases : (k,)
        What each laser measures too long [m].
    mounting : (6,)
        What is wrong in the mounting, as ``faces.effects_on`` has it.
    spread : (k,)
        Their standard deviations, as estimated [m].
    has_biases : bool
        Whether biases are estimated already.
    factor : float
        Noise in units of the prior.
    factors : (c,)
        The same by class of reflectivity.
    cov_noise, cov_biases : (m, 3, 3)
        Covariances of the centres by noise and by biases [m^2].
    by_bias : (m, 3, k + 6)
        How far a unit of each bias, or of the mounting, moves each centre, with the sign turned.
    cov_lasers : (k + 6, k + 6)
        Covariance of the biases [m^2] and of the mounting.
    """

    centres: Array
    biases: Array
    mounting: Array
    spread: Array
    has_biases: bool
    factor: float
    factors: Array
    cov_noise: Array
    cov_biases: Array
    by_bias: Array
    cov_lasers: Array


class _Bounds(NamedTuple):
    """How returns end at the outline, once that is known; what each says of it, (n, 2)."""

    outline: Outline | None
    sites: Array


class _Estimate(NamedTuple):
    """A state with what each return says of it: prediction, residuals [m], sigmas [m], weights."""

    state: _State
    linear: Linear
    residuals: Array
    sigmas: Array
    weights: Array


def fit(
    cloud: StitchedCloud, found: MarkerCandidates, config: FittingConfig, radius: float
) -> Fits:
    """Fit all candidates of a stop along their beams, with known radius.

    Parameters
    ----------
    cloud : StitchedCloud
        The stop.
    found : MarkerCandidates
        Groups of returns with rough centres good to a few centimetres.
    config : FittingConfig
        Prior noise of direction and laser bias.
    radius : float
        Radius of the spheres [m].

    Returns
    -------
    fits : tuple of MarkerFit
        Centres with covariances and diagnostics.
    rejected : tuple of Rejection
        Candidates that no sphere of this radius explains, with the reason.

    Notes
    -----
    Along the beam the residual of a known radius has one minimum (Franaszek, Cheok, Saidi,
    Witzgall, 2009), save for what the limb adds: there ranges bend so fast that they are linearised
    over the width of the centre's own uncertainty (``passes.linearise``). A range of a sphere has
    a likelihood only where the footprint meets the sphere: that bounds the centre from all sides
    (``outline``). Iteratively reweighted least squares with Tukey's weight; the noise is pooled
    over the stop, by reflectivity where returns are many, and laser biases are random effects of
    all markers together, whose spread is estimated by expectation maximisation. Each step costs one
    pass over the returns.
    """
    return _fit(cloud, found, config, radius, asks_outline=True)


def fit_ranges(
    cloud: StitchedCloud,
    found: MarkerCandidates,
    config: FittingConfig,
    radius: float,
    told: Told | None = None,
) -> Fits:
    """Fit all candidates of a stop by their ranges, wherever their beams meet the spheres.

    Parameters
    ----------
    cloud : StitchedCloud
        The stop.
    found : MarkerCandidates
        Groups of returns with rough centres good to a few centimetres.
    config : FittingConfig
        Prior noise of direction and laser bias.
    radius : float
        Radius of the spheres [m].
    told : callable
        Is asked in each late step for what else is known of the centres, with where they stand and
        how well that is known; nothing, if missing.

    Returns
    -------
    fits : tuple of MarkerFit
        As of ``fit``, for who asks by himself which beams hit. What is told narrows the places over
        which ranges are linearised, so that they tell more themselves.
    rejected : tuple of Rejection
        Candidates that no sphere of this radius explains, with the reason.
    """
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
    shots = _gather(cloud, found.candidates, config)
    rough = np.array([c.p_base_rough for c in found.candidates])
    estimate = _estimate(shots, rough, radius, told, asks_outline=asks_outline)
    known = [*_free_radii(shots, estimate, radius), _sigmas_shared(estimate.state)]
    rows = np.column_stack(known).tolist()
    results = [
        _judged(shots, estimate, k, candidate, tuple(rows[k]), radius)
        for k, candidate in enumerate(found.candidates)
    ]
    fits = tuple(r for r in results if isinstance(r, MarkerFit))
    return fits, tuple(r for r in results if isinstance(r, Rejection))


def _gather(
    cloud: StitchedCloud, candidates: tuple[MarkerCandidate, ...], config: FittingConfig
) -> _Shots:
    """Return the members of all candidates as one table of shots."""
    members = np.concatenate([c.members for c in candidates])
    is_finite = np.isfinite(cloud.p_base[members]).all(axis=1)
    ends = np.cumsum([len(c.members) for c in candidates])
    together, firsts = members[is_finite], np.cumsum(np.r_[0, is_finite])[np.r_[0, ends]]
    table = beams(cloud, together)
    lasers, places = np.unique(table.rings, return_inverse=True)
    # returns of unknown lasers come from all sixteen: their common part is what is left of a bias
    sigma = np.where(lasers == RING_UNKNOWN, config.sigma_range_bias / 4.0, config.sigma_range_bias)
    classes = np.digitize(table.intensities, _REFLECTIVITIES)
    rows = rows_of(
        table,
        firsts,
        levelling_rotation(cloud.levelling)[2],
        places.astype(np.intp),
        (classes, _SIGMAS[classes], config.sigma_direction),
    )
    return _Shots(
        beams=table,
        members=together,
        rows=rows,
        sigma_biases=sigma,
        sigma_mounting=sigmas_of(config.sigma_mounting, config.sigma_offset),
    )


def _placed(shots: _Shots, state: _State) -> Rows:
    """Return the returns with their beams where the mounting, as it is known, has them."""
    if not state.mounting.any():
        return shots.rows
    moves = effects_on(state.centres) @ state.mounting
    each = np.repeat(moves, np.diff(shots.rows.firsts), axis=0)
    return shots.rows._replace(origins=shots.rows.origins - shots.rows.up[:, :1] * each)


def _margins(state: _State, radius: float) -> Array:
    """Return by how much a footprint may pass each sphere by and still be its own [m]."""
    sigma = np.sqrt(np.trace(state.cov_noise, axis1=1, axis2=2))
    return np.asarray(np.clip(_GAP_SIGMAS * sigma, _GAP_MIN * radius, _GAP_MAX * radius))


def _tukey(scaled: Array) -> Array:
    """Return Tukey's weights of residuals in units of their sigma."""
    return np.where(np.abs(scaled) < _TUKEY, (1.0 - (scaled / _TUKEY) ** 2) ** 2, 0.0)


def _factors(shots: _Shots, state: _State, scaled: Array, weights: Array) -> tuple[float, Array]:
    """Return the noise in units of the prior: of all returns, and by class of reflectivity.

    A class is believed to have the factor of all until it has returns enough to speak for itself.
    """
    squares = state.factors[shots.rows.classes] ** 2 * weights * scaled**2 / _EXPECTED_SQUARE
    by_class = np.bincount(shots.rows.classes, squares, len(_SIGMAS))
    counts = np.bincount(shots.rows.classes, weights > 0.0, len(_SIGMAS))
    n = max(float(counts.sum()), 1.0)
    dof = max(n - 3.0 * len(state.centres), 0.0)
    factor2 = (by_class.sum() + 1.0) / (dof + 1.0)
    own = (by_class + _DOF_CLASS * factor2) / (counts * dof / n + _DOF_CLASS)
    return max(float(np.sqrt(factor2)), _FACTOR_MIN), np.maximum(np.sqrt(own), _FACTOR_MIN)


def _normals(shots: _Shots, estimate: _Estimate) -> Normals:
    """Sum the normal equations of centres and biases."""
    per_square = estimate.weights / estimate.sigmas**2
    sizes = (3, len(shots.sigma_biases))
    return Normals(*normals_of(shots.rows, estimate.linear, estimate.residuals, per_square, sizes))


def _bounded(
    shots: _Shots, estimate: _Estimate, radius: float, N: Normals, known: _Bounds
) -> tuple[Normals, _Bounds]:
    """Return normal equations with what the outline adds, and what was learnt of it."""
    state = estimate.state
    met = (shots.rows, estimate.linear, estimate.weights, state.cov_noise + state.cov_biases)
    outline = known.outline or outline_of(*met, radius)
    centres, pull_centres, faces, pull_faces, sites = outline_normals(*met, outline, known.sites)
    added = N._replace(
        centres=N.centres + centres,
        pull_centres=N.pull_centres + pull_centres,
        faces=N.faces + faces,
        pull_faces=N.pull_faces + pull_faces,
    )
    return added, _Bounds(outline, sites)


def _with_told(N: Normals, state: _State, told: Told) -> Normals:
    """Return normal equations with what else is told of the centres."""
    centres, pull_centres = told(state.centres, state.cov_noise + state.cov_biases)
    return N._replace(centres=N.centres + centres, pull_centres=N.pull_centres + pull_centres)


def _stepped(state: _State, N: Normals, shots: _Shots, radius: float) -> _State:
    """Return the state after one Gauss-Newton step of centres, biases and mounting together.

    The centres are eliminated first (Schur's complement), so that the cost is linear in markers. A
    prior of a metre on each centre keeps the equations solvable and is not felt otherwise.
    """
    inverse, prior = np.linalg.inv(N.centres + np.eye(3)), shots.sigma_biases
    spread2 = np.maximum(state.spread, _SPREAD_MIN) ** 2
    mixed, reduced, pull = _shared(state, N, spread2, shots.sigma_mounting)
    by_bias = inverse @ mixed
    cov_shared = np.linalg.inv(reduced - np.einsum("mik,mij->kj", mixed, by_bias))
    pull -= np.einsum("mik,mi->k", by_bias, N.pull_centres)
    d_shared = cov_shared @ pull * state.has_biases
    d_centres = np.einsum("mij,mj->mi", inverse, N.pull_centres - mixed @ d_shared)
    n = len(prior)
    biases = state.biases + d_shared[:n]
    known2 = (biases**2 + np.diag(cov_shared)[:n]).sum() + _DOF_BIAS * np.mean(prior**2)
    spread = prior * np.sqrt(known2 / (_DOF_BIAS + n) / np.mean(prior**2))
    return state._replace(
        centres=state.centres + _shortened(d_centres, radius),
        biases=biases,
        mounting=state.mounting + d_shared[n:],
        spread=spread if state.has_biases else prior,
        cov_noise=np.asarray(_EFFICIENCY * inverse, dtype=np.float64),
        cov_biases=by_bias @ cov_shared @ by_bias.transpose(0, 2, 1),
        by_bias=by_bias,
        cov_lasers=cov_shared,
    )


def _shared(
    state: _State, N: Normals, spread2: Array, sigma_mounting: Array
) -> tuple[Array, Array, Array]:
    """Return normal equations of what all centres share, with the priors: mixed, own, pull."""
    effects = effects_on(state.centres)
    between = np.einsum("mik,mip->kp", N.mixed_faces, effects)
    own = np.einsum("mip,mij,mjq->pq", effects, N.centres, effects)
    known = np.diag(1.0 / np.maximum(sigma_mounting, 1e-9) ** 2)
    reduced = np.block([[np.diag(N.biases + 1.0 / spread2), between], [between.T, own + known]])
    pull_mounting = np.einsum("mip,mi->p", effects, N.pull_faces) - known @ state.mounting
    pull = np.concatenate([N.pull_biases - state.biases / spread2, pull_mounting])
    return np.concatenate([N.mixed, N.faces @ effects], axis=2), reduced, pull


def _sigmas_shared(state: _State) -> Array:
    """Return how much of each centre's error along its line of sight all have in common [m].

    That is what biases of lasers make it agree with the other centres in: the mean covariance.
    """
    lines = state.centres / np.linalg.norm(state.centres, axis=1, keepdims=True)
    pulls = np.einsum("mi,mik->mk", lines, state.by_bias)
    cov = pulls @ state.cov_lasers @ pulls.T
    own = np.diag(cov)
    together = (cov.sum(axis=1) - own) / (len(cov) - 1) if len(cov) > 1 else own
    return np.asarray(np.sqrt(np.maximum(together, 0.0)))


def _shortened(steps: Array, radius: float) -> Array:
    """Return steps of centres, (m, 3), none longer than a quarter of the radius [m]."""
    lengths = np.linalg.norm(steps, axis=1, keepdims=True)
    return np.asarray(steps * np.minimum(1.0, _STEP_MAX * radius / np.maximum(lengths, 1e-12)))


def _estimate(
    shots: _Shots, rough: Array, radius: float, told: Told | None, *, asks_outline: bool
) -> _Estimate:
    """Return the estimate of all centres and biases from rough centres."""
    nothing = np.zeros((len(rough), 3, 3))
    state = _State(
        centres=rough,
        biases=np.zeros(len(shots.sigma_biases)),
        mounting=np.zeros(N_MOUNTING),
        spread=shots.sigma_biases,
        has_biases=False,
        factor=_FACTOR_START,
        factors=np.full(len(_SIGMAS), _FACTOR_START),
        cov_noise=nothing + (_ROUGH * radius) ** 2 * np.eye(3),
        cov_biases=nothing,
        by_bias=np.zeros((len(rough), 3, len(shots.sigma_biases) + N_MOUNTING)),
        cov_lasers=np.diag(np.concatenate([shots.sigma_biases, shots.sigma_mounting]) ** 2),
    )
    is_in = np.ones(len(shots.members), dtype=bool)
    bounds = _Bounds(outline=None, sites=np.zeros((len(shots.members), 2)))
    for step in range(_N_STEPS):
        linear = _linear(shots, state, is_in, radius)
        if step < _N_STEPS_GATED:
            is_in = in_play(shots.rows, linear.offsets, _margins(state, radius), radius)
        estimate = _weighed(shots, state, linear, is_in)
        state = estimate.state._replace(has_biases=step >= _N_STEPS_GATED)
        N = _normals(shots, estimate)
        if asks_outline and step >= _N_STEPS_RANGES:
            N, bounds = _bounded(shots, estimate, radius, N, bounds)
        if told is not None and step >= _N_STEPS_RANGES:
            N = _with_told(N, estimate.state, told)
        state = _stepped(state, N, shots, radius)
    return _weighed(shots, state, _linear(shots, state, is_in, radius), is_in)


def _linear(shots: _Shots, state: _State, is_in: Mask, radius: float) -> Linear:
    """Return what the beams should measure, linearised over what is not known of the centres."""
    spheres = np.column_stack([state.centres, np.full(len(state.centres), radius)])
    covs: Array = np.zeros((len(spheres), 4, 4))
    covs[:, :3, :3] = state.cov_noise + state.cov_biases
    return linearise(_placed(shots, state), spheres, covs, is_in)


def _weighed(shots: _Shots, state: _State, linear: Linear, is_in: Mask) -> _Estimate:
    """Return residuals, their weights and the stop's noise at a state."""
    residuals = shots.beams.ranges - linear.ranges - state.biases[shots.rows.lasers]
    scaled = residuals / noise_of(shots.rows, linear, state.factors)
    factor, factors = _factors(shots, state, scaled, is_in * _tukey(scaled))
    sigmas = noise_of(shots.rows, linear, factors)
    return _Estimate(
        state=state._replace(factor=factor, factors=factors),
        linear=linear,
        residuals=residuals,
        sigmas=sigmas,
        weights=is_in * _tukey(residuals / sigmas),
    )


def _free_radii(shots: _Shots, estimate: _Estimate, radius: float) -> tuple[Array, Array]:
    """Return radii estimated together with the centres, and their sigmas; NaN if undetermined."""
    n, state = len(estimate.state.centres), estimate.state
    covs: Array = np.zeros((n, 4, 4))
    covs[:, :3, :3] = state.cov_noise + state.cov_biases
    covs[:, 3, 3] = np.trace(covs, axis1=1, axis2=2)
    weighing = Weighing(
        ranges=shots.beams.ranges - state.biases[shots.rows.lasers],
        variances=np.maximum(estimate.sigmas**2 - estimate.linear.bends**2, 1e-12),
        weights=estimate.weights,
    )
    spheres = np.column_stack([state.centres, np.full(n, radius)])
    return free_radii(_placed(shots, state), weighing, spheres, covs, len(shots.sigma_biases))


def _own_factor(estimate: _Estimate, mine: slice) -> float:
    """Return one marker's noise in units of the prior, from its returns alone."""
    scaled, weights = estimate.residuals[mine] / estimate.sigmas[mine], estimate.weights[mine]
    dof = max(float(np.sum(weights > 0.0)) - 3.0, 1.0)
    ratio2 = float(np.sum(weights * scaled**2)) / _EXPECTED_SQUARE / dof
    return max(estimate.state.factor * float(np.sqrt(ratio2)), _FACTOR_MIN)


def inflation(n_used: int) -> float:
    """Return by how much a few returns know less than the noise alone would have it.

    Parameters
    ----------
    n_used : int
        Returns of a marker.

    Returns
    -------
    float
        Factor of the variances of its centre.
    """
    return 1.0 + _FEW_INFLATION * float(np.exp(-n_used / _FEW_RETURNS))


def _covariance(estimate: _Estimate, k: int, own: float, n_used: int) -> Array:
    """Return a centre's covariance: noise as the stop and the marker show it, and biases.

    The noise is that of the stop until a marker has returns enough to speak for itself: a handful
    of returns that agree by chance must not look precise.
    """
    state = estimate.state
    ratio2 = (own / state.factor) ** 2
    variance = (_DOF_STOP + n_used * ratio2) / (_DOF_STOP + n_used)
    few = inflation(n_used)
    return np.asarray(few * (variance * state.cov_noise[k] + state.cov_biases[k]))


def _weakness(fit: MarkerFit, factor: float) -> str:
    """Return why a centre should be used with care; empty if there is no reason."""
    reasons = weaknesses(fit.n_points, fit.n_rings, fit.coverage)
    reasons += other_radius(fit.radius, fit.radius_free, fit.sigma_radius_free)
    if fit.sigma0 > _NOISE_FACTOR * factor:
        reasons.append(f"its residuals are {fit.sigma0 / factor:.1f} times those of the stop")
    return sentence(reasons)


def _refusal(estimate: _Estimate, k: int, n_used: int, moved: float, radius: float) -> str:
    """Return why a candidate has no centre; empty if it has one."""
    if n_used < _N_MIN:
        return (
            f"Only {n_used} returns lie on a sphere of radius {1e3 * radius:.0f} mm; a centre "
            f"needs at least {_N_MIN}."
        )
    worst = float(np.sqrt(np.linalg.eigvalsh(estimate.state.cov_noise[k])[-1]))
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


def _judged(
    shots: _Shots,
    estimate: _Estimate,
    k: int,
    candidate: MarkerCandidate,
    told: tuple[float, float, float],
    radius: float,
) -> MarkerFit | Rejection:
    """Return one candidate's fit with its diagnostics, or the reason why there is none.

    ``told`` are its free radius, the sigma of that, and the error of range that all share [m].
    """
    mine = slice(*shots.rows.firsts[k : k + 2])
    used = np.arange(mine.start, mine.stop)[estimate.weights[mine] > 0.0]
    p, n_used = estimate.state.centres[k], len(used)
    moved = float(np.linalg.norm(p - candidate.p_base_rough))
    reason = _refusal(estimate, k, n_used, moved, radius)
    if reason:
        return refused(candidate, reason)
    own = _own_factor(estimate, mine)
    table, offsets = shots.beams, estimate.linear.offsets[used]
    n_rings = len(set(table.rings[used].tolist()) - {RING_UNKNOWN})
    fit = MarkerFit(
        name=candidate.name,
        p_base=p.copy(),
        cov_p_base=_covariance(estimate, k, own, n_used),
        method=NAME,
        status=Status.OK,
        reason="",
        radius=radius,
        radius_free=told[0],
        sigma_radius_free=told[1],
        mean_range=float(np.linalg.norm(table.origins_base[used].mean(axis=0) - p)),
        mean_intensity=float(table.intensities[used].mean()),
        used=shots.members[used],
        rejected=left_out(candidate.members, shots.members[used]),
        residuals=estimate.residuals[used],
        sigma0=own,
        n_rings=n_rings,
        coverage=share_of_outline(
            table.directions_base[used], table.across_base[used], offsets, radius
        ),
        incidence=incidence(offsets, radius),
        variant="" if n_rings else WITHOUT_RINGS,
        sigma_range_shared=told[2],
    )
    weakness = _weakness(fit, estimate.state.factor)
    return replace(fit, status=Status.WEAK, reason=weakness) if weakness else fit
