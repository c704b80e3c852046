"""Centres by maximum likelihood along the beams, all markers of a stop together.

Hides noise, outliers and laser biases. The markers of a stop share what one marker alone cannot
tell: the noise of this sensor today, and what each laser measures too long.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import NamedTuple

import numpy as np

from pipelines.config import FittingConfig
from pipelines.fitting.description import Fits, incidence, refused, sentence, weaknesses
from pipelines.fitting.footprint import Linear, linearise, share_of_outline
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
WITHOUT_RINGS = "rings unknown: laser heights and biases not applied"

# Range noise of a VLP-16 by reflectivity, from recorded packets [m]: a prior, for the ratio between
# dark and bright; its size is estimated from the stop.
_REFLECTIVITIES = np.array([5.0, 15.0, 40.0, 100.0])  # limits between the classes
_SIGMAS = np.array([0.0137, 0.0107, 0.0089, 0.0067, 0.0064])
_FACTOR_MIN = 0.08  # of the prior noise: 2 mm quantisation alone gives as much
_FACTOR_START = 3.0  # the largest noise that a VLP-16 shows, 25 mm

_TUKEY = 8.0  # sigmas at which a return has no weight; 99 % efficient on clean data
_EXPECTED_SQUARE = 0.9099  # mean of weight times square of normal residuals
_EFFICIENCY = 0.9753  # variance of the estimate over the inverse normal matrix
_POLE_BEGINS = 1.0  # radii below the centre: a footprint that begins lower is on the pole
_POLE_HALF = 0.25  # radii from the vertical through the centre within which the pole is
_SPREAD_MIN = 1e-5  # [m] of the laser biases: keeps their prior invertible
_N_STEPS_FREE = 3
_N_STEPS = 8
_N_STEPS_GATED = 5  # after these the choice of returns by their place stays as it is
_ROUGH = 0.1  # radii by which a rough centre may be off per axis
_STEP_MAX = 0.25  # radii per step
_STRAY = 0.6  # radii that a centre may move from its rough place
_N_MIN = 4  # returns: one more than unknowns
_GAP_SIGMAS = 3.0  # of its centre by which a return may pass a sphere by and still be its own
_GAP_MIN, _GAP_MAX = 0.02, 0.3  # radii: least and most of that
_DOF_STOP = 100.0  # returns that the stop's noise is worth when a marker's own is judged
_DOF_CLASS = 30.0  # returns that the common noise is worth when that of a class is estimated
_DOF_BIAS = 2.0  # lasers that the prior of the biases is worth when their spread is estimated

_RADIUS_SIGMAS = 3.5
_RADIUS_INFLATION = 1.5  # what few returns add to the variance of a free radius: 1 + this exp(-n /
_RADIUS_RETURNS = 100.0  # this), by Monte Carlo
_RADIUS_SLACK = 0.006  # [m] by which a free radius may be off whatever its sigma
_NOISE_FACTOR = 1.6  # of the stop's noise, above which a marker is called weak


class _Shots(NamedTuple):
    """The returns of all candidates in one table.

    Attributes
    ----------
    beams : Beams
        Their beams.
    rows : (n,)
        Rows of the cloud.
    which : (n,)
        The candidate of each.
    sigmas : (n,)
        Prior noise [m].
    classes : (n,)
        Class of reflectivity, darkest first.
    lasers : (n,)
        Place of each return's laser among those that occur.
    sigma_biases : (k,)
        Prior standard deviation of what each of those measures too long [m].
    up : (3,)
        Upward unit vector.
    """

    beams: Beams
    rows: Index
    which: Index
    sigmas: Array
    classes: Index
    lasers: Index
    sigma_biases: Array
    up: Array


class _State(NamedTuple):
    """Where the estimate stands.

    Attributes
    ----------
    centres : (m, 3)
        Centres [m].
    biases : (k,)
        What each laser measures too long [m].
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
    """

    centres: Array
    biases: Array
    spread: Array
    has_biases: bool
    factor: float
    factors: Array
    cov_noise: Array
    cov_biases: Array


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
    over the width of the centre's own uncertainty (``footprint.linearise``). Iteratively reweighted
    least squares with Tukey's weight; the noise is pooled over the stop, by reflectivity where
    returns are many, and laser biases are random effects of all markers together, whose spread is
    estimated by expectation maximisation. Each step costs one pass over the returns.
    """
    if not found.candidates:
        return (), ()
    shots = _gather(cloud, found.candidates, config)
    rough = np.array([c.p_base_rough for c in found.candidates])
    estimate = _estimate(shots, rough, config, radius)
    free = np.column_stack(_free_radii(shots, estimate, radius)).tolist()
    results = [
        _judged(shots, estimate, k, candidate, tuple(free[k]), radius)
        for k, candidate in enumerate(found.candidates)
    ]
    fits = tuple(r for r in results if isinstance(r, MarkerFit))
    return fits, tuple(r for r in results if isinstance(r, Rejection))


def _gather(
    cloud: StitchedCloud, candidates: tuple[MarkerCandidate, ...], config: FittingConfig
) -> _Shots:
    """Return the members of all candidates as one table of shots."""
    rows = np.concatenate([c.members for c in candidates])
    which = np.repeat(np.arange(len(candidates)), [len(c.members) for c in candidates])
    is_finite = np.isfinite(cloud.p_base[rows]).all(axis=1)
    rows, which = rows[is_finite], which[is_finite]
    table = beams(cloud, rows)
    lasers, places = np.unique(table.rings, return_inverse=True)
    # returns of unknown lasers come from all sixteen: their common part is what is left of a bias
    sigma = np.where(lasers == RING_UNKNOWN, config.sigma_range_bias / 4.0, config.sigma_range_bias)
    classes = np.digitize(table.intensities, _REFLECTIVITIES)
    return _Shots(
        beams=table,
        rows=rows,
        which=which,
        sigmas=_SIGMAS[classes],
        classes=classes,
        lasers=places.astype(np.intp),
        sigma_biases=sigma,
        up=levelling_rotation(cloud.levelling)[2],
    )


def _summed(values: Array, place: Index, n_places: int) -> Array:
    """Return the sums of rows, (n, ...), that share a place."""
    flat = values.reshape(len(values), -1)
    sums = [np.bincount(place, column, n_places) for column in flat.T]
    return np.asarray(np.stack(sums, axis=1).reshape(n_places, *values.shape[1:]))


def _in_play(shots: _Shots, state: _State, linear: Linear, radius: float) -> Mask:
    """Tell which returns may be the sphere by their place: on its outline, and not on its pole.

    What passes by no farther than the centre may be off is kept: to leave out returns of the limb
    wherever the present centre misses them would make every centre right in its own eyes.
    """
    beams = shots.beams
    u, a = beams.directions_base, beams.across_base
    b = np.cross(u, a)
    v_up = shots.up - (u @ shots.up)[:, None] * u
    v_up /= np.linalg.norm(v_up, axis=1, keepdims=True)
    axes = np.stack([np.einsum("ij,ij->i", a, v_up), np.einsum("ij,ij->i", b, v_up)], axis=1)
    half_widths = 0.5 * beams.ranges[:, None] * beams.divergence
    blur = np.linalg.norm(half_widths * axes, axis=1)
    blur_across = np.linalg.norm(half_widths * axes[:, ::-1], axis=1)
    along = np.einsum("ij,ij->i", linear.offsets, axes)
    across = linear.offsets[:, 0] * axes[:, 1] - linear.offsets[:, 1] * axes[:, 0]
    is_pole = (along + blur < -_POLE_BEGINS * radius) & (
        np.abs(across) < _POLE_HALF * radius + blur_across
    )
    off = np.linalg.norm(linear.offsets, axis=1)
    inward = linear.offsets / np.maximum(off, 1e-9)[:, None]
    gap = off - radius - np.linalg.norm(half_widths * inward, axis=1)
    sigma = np.sqrt(np.trace(state.cov_noise, axis1=1, axis2=2))
    margin = np.clip(_GAP_SIGMAS * sigma, _GAP_MIN * radius, _GAP_MAX * radius)
    return np.asarray((gap < margin[shots.which]) & ~is_pole)


def _sigmas(shots: _Shots, linear: Linear, factors: Array, config: FittingConfig) -> Array:
    """Return the noise of each range: its own, that of the direction on a slope, the bend [m]."""
    J = linear.J[:, :3]
    along = np.einsum("ij,ij->i", J, shots.beams.directions_base)
    slopes2 = np.maximum(np.einsum("ij,ij->i", J, J) - along**2, 0.0)
    lateral = config.sigma_direction * shots.beams.ranges
    own = factors[shots.classes] * shots.sigmas
    return np.asarray(np.sqrt(own**2 + lateral**2 * slopes2 + linear.bends**2))


def _tukey(scaled: Array) -> Array:
    """Return Tukey's weights of residuals in units of their sigma."""
    return np.where(np.abs(scaled) < _TUKEY, (1.0 - (scaled / _TUKEY) ** 2) ** 2, 0.0)


def _factors(shots: _Shots, state: _State, scaled: Array, weights: Array) -> tuple[float, Array]:
    """Return the noise in units of the prior: of all returns, and by class of reflectivity.

    A class is believed to have the factor of all until it has returns enough to speak for itself.
    """
    squares = state.factors[shots.classes] ** 2 * weights * scaled**2 / _EXPECTED_SQUARE
    by_class = np.bincount(shots.classes, squares, len(_SIGMAS))
    counts = np.bincount(shots.classes, weights > 0.0, len(_SIGMAS))
    n = max(float(counts.sum()), 1.0)
    dof = max(n - 3.0 * len(state.centres), 0.0)
    factor2 = (by_class.sum() + 1.0) / (dof + 1.0)
    own = (by_class + _DOF_CLASS * factor2) / (counts * dof / n + _DOF_CLASS)
    return max(float(np.sqrt(factor2)), _FACTOR_MIN), np.maximum(np.sqrt(own), _FACTOR_MIN)


class _Normals(NamedTuple):
    """Normal equations, in units of the prior noise.

    Attributes
    ----------
    centres : (m, 3, 3)
        Of each centre.
    mixed : (m, 3, k)
        Between each centre and each laser's bias.
    biases : (k,)
        Of the biases, which are diagonal.
    pull_centres : (m, 3)
        Right-hand sides of the centres.
    pull_biases : (k,)
        Right-hand sides of the biases.
    """

    centres: Array
    mixed: Array
    biases: Array
    pull_centres: Array
    pull_biases: Array


def _normals(shots: _Shots, estimate: _Estimate) -> _Normals:
    """Sum the normal equations of centres and biases."""
    m, k = len(estimate.state.centres), len(shots.sigma_biases)
    J, residuals = estimate.linear.J[:, :3], estimate.residuals
    weights = estimate.weights / estimate.sigmas**2
    mixed = _summed(weights[:, None] * J, shots.which * k + shots.lasers, m * k)
    return _Normals(
        centres=_summed(weights[:, None, None] * J[:, :, None] * J[:, None, :], shots.which, m),
        mixed=mixed.reshape(m, k, 3).transpose(0, 2, 1),
        biases=_summed(weights, shots.lasers, k),
        pull_centres=_summed((weights * residuals)[:, None] * J, shots.which, m),
        pull_biases=_summed(weights * residuals, shots.lasers, k),
    )


def _stepped(state: _State, N: _Normals, prior: Array, radius: float) -> _State:
    """Return the state after one Gauss-Newton step of all centres and biases together.

    The centres are eliminated first (Schur's complement), so that the cost is linear in markers. A
    prior of a metre on each centre keeps the equations solvable and is not felt otherwise.
    """
    inverse = np.linalg.inv(N.centres + np.eye(3))
    spread2 = np.maximum(state.spread, _SPREAD_MIN) ** 2
    by_bias = inverse @ N.mixed
    reduced = np.diag(N.biases + 1.0 / spread2)
    cov_biases = np.linalg.inv(reduced - np.einsum("mik,mij->kj", N.mixed, by_bias))
    pull = N.pull_biases - np.einsum("mik,mi->k", by_bias, N.pull_centres)
    d_biases = cov_biases @ (pull - state.biases / spread2) * state.has_biases
    d_centres = np.einsum("mij,mj->mi", inverse, N.pull_centres - N.mixed @ d_biases)
    biases = state.biases + d_biases
    known2 = (biases**2 + np.diag(cov_biases)).sum() + _DOF_BIAS * np.mean(prior**2)
    spread = prior * np.sqrt(known2 / (_DOF_BIAS + len(prior)) / np.mean(prior**2))
    return state._replace(
        centres=state.centres + _shortened(d_centres, radius),
        biases=biases,
        spread=spread if state.has_biases else prior,
        cov_noise=np.asarray(_EFFICIENCY * inverse, dtype=np.float64),
        cov_biases=by_bias @ cov_biases @ by_bias.transpose(0, 2, 1),
    )


def _shortened(steps: Array, radius: float) -> Array:
    """Return steps of centres, (m, 3), none longer than a quarter of the radius [m]."""
    lengths = np.linalg.norm(steps, axis=1, keepdims=True)
    return np.asarray(steps * np.minimum(1.0, _STEP_MAX * radius / np.maximum(lengths, 1e-12)))


def _estimate(shots: _Shots, rough: Array, config: FittingConfig, radius: float) -> _Estimate:
    """Return the estimate of all centres and biases from rough centres."""
    nothing = np.zeros((len(rough), 3, 3))
    state = _State(
        centres=rough,
        biases=np.zeros(len(shots.sigma_biases)),
        spread=shots.sigma_biases,
        has_biases=False,
        factor=_FACTOR_START,
        factors=np.full(len(_SIGMAS), _FACTOR_START),
        cov_noise=nothing + (_ROUGH * radius) ** 2 * np.eye(3),
        cov_biases=nothing,
    )
    is_in = np.ones(len(shots.rows), dtype=bool)
    for step in range(_N_STEPS):
        linear = _linear(shots, state, radius)
        if step < _N_STEPS_GATED:
            is_in = _in_play(shots, state, linear, radius)
        estimate = _weighed(shots, state, linear, is_in, config)
        state = estimate.state._replace(has_biases=step >= _N_STEPS_GATED)
        state = _stepped(state, _normals(shots, estimate), shots.sigma_biases, radius)
    return _weighed(shots, state, _linear(shots, state, radius), is_in, config)


def _linear(shots: _Shots, state: _State, radius: float) -> Linear:
    """Return what the beams should measure, linearised over what is not known of the centres."""
    spheres = np.column_stack([state.centres, np.full(len(state.centres), radius)])
    return linearise(shots.beams, spheres, state.cov_noise + state.cov_biases, shots.which)


def _weighed(
    shots: _Shots, state: _State, linear: Linear, is_in: Mask, config: FittingConfig
) -> _Estimate:
    """Return residuals, their weights and the stop's noise at a state."""
    residuals = shots.beams.ranges - linear.ranges - state.biases[shots.lasers]
    scaled = residuals / _sigmas(shots, linear, state.factors, config)
    factor, factors = _factors(shots, state, scaled, is_in * _tukey(scaled))
    sigmas = _sigmas(shots, linear, factors, config)
    return _Estimate(
        state=state._replace(factor=factor, factors=factors),
        linear=linear,
        residuals=residuals,
        sigmas=sigmas,
        weights=is_in * _tukey(residuals / sigmas),
    )


def _free_radii(shots: _Shots, estimate: _Estimate, radius: float) -> tuple[Array, Array]:
    """Return radii estimated together with the centres, and their sigmas; NaN if undetermined."""
    n = len(estimate.state.centres)
    spheres = np.column_stack([estimate.state.centres, np.full(n, radius)])
    covs: Array = np.zeros((n, 4, 4))
    covs[:, :3, :3] = estimate.state.cov_noise + estimate.state.cov_biases
    covs[:, 3, 3] = np.trace(covs, axis1=1, axis2=2)
    ranges = shots.beams.ranges - estimate.state.biases[shots.lasers]
    own2 = np.maximum(estimate.sigmas**2 - estimate.linear.bends**2, 1e-12)
    for _ in range(_N_STEPS_FREE):
        linear = linearise(shots.beams, spheres, covs, shots.which)
        weights = estimate.weights / (own2 + linear.bends**2)
        J, residuals = linear.J, ranges - linear.ranges
        N = _summed(weights[:, None, None] * J[:, :, None] * J[:, None, :], shots.which, n)
        pull = _summed((weights * residuals)[:, None] * J, shots.which, n)
        covs = np.asarray(np.linalg.inv(N + np.eye(4) / (0.5 * radius) ** 2))
        step = np.einsum("mij,mj->mi", covs, pull)
        spheres = spheres + np.clip(step, -_STEP_MAX * radius, _STEP_MAX * radius)
    counts = np.bincount(shots.which, estimate.weights > 0.0, n)
    inflation = 1.0 + _RADIUS_INFLATION * np.exp(-counts / _RADIUS_RETURNS)
    radii, sigmas = spheres[:, 3], np.sqrt(_EFFICIENCY * inflation * covs[:, 3, 3])
    is_known = (sigmas < 0.4 * radius) & (radii < 5.0 * radius)
    return np.where(is_known, radii, np.nan), np.where(is_known, sigmas, np.nan)


def _own_factor(estimate: _Estimate, mine: Mask) -> float:
    """Return one marker's noise in units of the prior, from its returns alone."""
    scaled, weights = (estimate.residuals / estimate.sigmas)[mine], estimate.weights[mine]
    dof = max(float(np.sum(weights > 0.0)) - 3.0, 1.0)
    ratio2 = float(np.sum(weights * scaled**2)) / _EXPECTED_SQUARE / dof
    return max(estimate.state.factor * float(np.sqrt(ratio2)), _FACTOR_MIN)


def _covariance(estimate: _Estimate, k: int, own: float, n_used: int) -> Array:
    """Return a centre's covariance: noise as the stop and the marker show it, and biases.

    The noise is that of the stop until a marker has returns enough to speak for itself: a handful
    of returns that agree by chance must not look precise.
    """
    state = estimate.state
    ratio2 = (own / state.factor) ** 2
    variance = (_DOF_STOP + n_used * ratio2) / (_DOF_STOP + n_used)
    return np.asarray(variance * state.cov_noise[k] + state.cov_biases[k])


def _weakness(fit: MarkerFit, factor: float) -> str:
    """Return why a centre should be used with care; empty if there is no reason."""
    reasons = weaknesses(fit.n_points, fit.n_rings, fit.coverage)
    off = abs(fit.radius_free - fit.radius)
    if off > max(_RADIUS_SIGMAS * fit.sigma_radius_free, _RADIUS_SLACK):
        reasons.append(f"its own radius is {1e3 * fit.radius_free:.0f} mm")
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
        return "Its returns leave the centre undetermined: they lie on one line."
    if moved > _STRAY * radius:
        return (
            f"The fit left the place where it was found by {1e3 * moved:.0f} mm: no sphere of "
            f"radius {1e3 * radius:.0f} mm is there."
        )
    return ""


def _some(beams: Beams, chosen: Mask) -> Beams:
    """Return some of the beams."""
    columns = (f.name for f in fields(beams) if f.name != "divergence")
    return replace(beams, **{name: getattr(beams, name)[chosen] for name in columns})


def _judged(
    shots: _Shots,
    estimate: _Estimate,
    k: int,
    candidate: MarkerCandidate,
    free: tuple[float, float],
    radius: float,
) -> MarkerFit | Rejection:
    """Return one candidate's fit with its diagnostics, or the reason why there is none."""
    mine = shots.which == k
    used = mine & (estimate.weights > 0.0)
    p, n_used = estimate.state.centres[k], int(used.sum())
    moved = float(np.linalg.norm(p - candidate.p_base_rough))
    reason = _refusal(estimate, k, n_used, moved, radius)
    if reason:
        return refused(candidate, reason)
    own = _own_factor(estimate, mine)
    lit = _some(shots.beams, used)
    fit = MarkerFit(
        p_base=p.copy(),
        cov_p_base=_covariance(estimate, k, own, n_used),
        method=NAME,
        status=Status.OK,
        reason="",
        radius=radius,
        radius_free=free[0],
        sigma_radius_free=free[1],
        mean_range=float(np.linalg.norm(lit.origins_base.mean(axis=0) - p)),
        mean_intensity=float(lit.intensities.mean()),
        used=shots.rows[used],
        rejected=np.setdiff1d(candidate.members, shots.rows[used]),
        residuals=estimate.residuals[used],
        sigma0=own,
        n_rings=len(np.unique(lit.rings[lit.rings != RING_UNKNOWN])),
        coverage=share_of_outline(lit, estimate.linear.offsets[used], radius),
        incidence=incidence(estimate.linear.offsets[used], radius),
        variant=WITHOUT_RINGS if np.all(lit.rings == RING_UNKNOWN) else "",
    )
    weakness = _weakness(fit, estimate.state.factor)
    return replace(fit, status=Status.WEAK, reason=weakness) if weakness else fit
