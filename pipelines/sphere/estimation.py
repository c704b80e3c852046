"""Joint least-squares estimate of the spheres of a stop.

The spheres share what one of them cannot determine: the noise of the sensor, the range bias of each
laser, the errors of the mounting, how late the gimbal's clock is, and how sharply returns end at
the limb.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.estimation.linear_algebra import inverse
from spheremark.pipelines.model import Array, Mask, Optics
from spheremark.pipelines.sphere.limb import SIGMA_HALVES, Edge, edge_of, limb_normals
from spheremark.pipelines.sphere.linearisation import Linear, linearise
from spheremark.pipelines.sphere.mounting import N_MOUNTING, effects_on
from spheremark.pipelines.sphere.noise import Noise, Weighed, weigh
from spheremark.pipelines.sphere.normal_equations import Normals, normals_of, reduce
from spheremark.pipelines.sphere.occlusion import Others, faces_seen
from spheremark.pipelines.sphere.optics import (
    N_ESTIMATED,
    SIGMAS_PROFILE,
    UNKNOWNS,
    derivatives,
    echo_shifts,
    with_widths,
)
from spheremark.pipelines.sphere.radius import BeamErrors, Ranges, free_radii
from spheremark.pipelines.sphere.returns import Returns, may_be_sphere, moved_faces, swept
from spheremark.pipelines.sphere.strips import on_strips

_EFFICIENCY = 0.9753  # variance of the estimate over the inverse normal matrix
_SIGMA_BIAS_MIN = 1e-5  # [m] of the laser biases: keeps their prior invertible
_SIGMA_MIN = 1e-9  # of the other shared unknowns: likewise
_N_STEPS, _N_STEPS_MAX = 7, 16  # with returns chosen by their place, and until centres settle
_SETTLED = 0.2  # sigmas by which centres may still move
_N_STEPS_CENTRES = 4  # without the shared unknowns
_N_STEPS_RANGES = 3  # without the limb
_N_STEPS_ROBUST = 3  # after these the noise is that of the weighted residuals
_N_OPTICS = 4  # spheres, whose common radius is another unknown beside three of the optics
_OPTICS_MAX = math.sqrt(15.1)  # prior sigmas by which optics are off once in 100 scans
_ROUGH = 0.1  # radii: standard deviation per axis of a rough centre
_STEP_MAX = 0.25  # radii per step
_GAP_SIGMAS = 3.0  # of its centre by which a return may lie outside a sphere and still be its own
_GAP_MIN, _GAP_MAX = 0.02, 0.3  # radii: least and most of that
# Places of the shared unknowns, from the end: lasers, optics, halves of the limb, clock, mounting
_MOUNTING, _CLOCK, _HALVES = slice(-N_MOUNTING, None), -N_MOUNTING - 1, -N_MOUNTING - 2
_OPTICS = slice(_HALVES - len(UNKNOWNS), _HALVES)
_BIASES = slice(None, _OPTICS.start)
_SIGMA_CLOCK = 3e-4  # [s] by which clocks are off where lines of rests fall together, by simulation
_UNFELT = 1e-6  # [m] by all centres together: what they share less than this
_DOF_SPREAD = 2.0  # unknowns that the prior counts for in the estimate of their spread

Observe = Callable[[Array, Array], tuple[Array, Array]]
"""Further observations of the limb. Called with the middle of each limb, (m, 3), which is that of
the sphere where the limb is alike above and below, and with the covariances of these; returns the
normal matrices, (m, 3, 3) [1/m^2], and right-hand sides, (m, 3) [1/m], that they add."""


class Prior(NamedTuple):
    """What is known before the scan.

    Attributes
    ----------
    radius : float
        Radius of the spheres [m].
    sigma_biases : (k,)
        Standard deviations of the range biases of the lasers that occur [m].
    sigma_optics : (q,)
        Standard deviations of ``UNKNOWNS``; of these the first ``N_ESTIMATED`` are estimated.
    sigma_clock : float
        Standard deviation of the offset of the gimbal's clock [s].
    sigma_mounting : (6,)
        Standard deviations of the unknowns of the mounting.
    """

    radius: float
    sigma_biases: Array
    sigma_optics: Array
    sigma_clock: float
    sigma_mounting: Array

    @property
    def sigmas(self) -> Array:
        """Standard deviations of all shared unknowns, tiny for those that are not estimated."""
        held = np.zeros(len(UNKNOWNS) - N_ESTIMATED)
        optics = np.append(self.sigma_optics[:N_ESTIMATED], held)
        common = [SIGMA_HALVES, self.sigma_clock]
        parts = (self.sigma_biases, optics, common, self.sigma_mounting)
        sigmas = np.maximum(np.concatenate(parts), _SIGMA_MIN)
        sigmas[_BIASES] = np.maximum(sigmas[_BIASES], _SIGMA_BIAS_MIN)
        return np.asarray(sigmas)


class State(NamedTuple):
    """Unknowns with their covariances after some steps.

    Attributes
    ----------
    centres : (m, 3)
        Centres [m].
    shared : (k + q + 8,)
        Range biases of the lasers [m], ``UNKNOWNS``, half the difference between the edges above
        and below [half widths], offset of the gimbal's clock [s], and errors of the mounting in the
        order of ``mounting.effects_on``.
    sigmas : (k + q + 8,)
        Their prior standard deviations, those of biases and mounting scaled as estimated.
    has_shared : bool
        Whether the shared unknowns are estimated already.
    noise : Noise or None
        That of the stop; none before the first residuals.
    cov_noise, cov_shared_part : (m, 3, 3)
        Covariances of the centres by the noise, and by the shared unknowns [m^2].
    by_shared : (m, 3, k + q + 8)
        Derivatives of the centres by the shared unknowns, with the sign turned.
    cov_shared : (k + q + 8, k + q + 8)
        Covariance of the shared unknowns.
    cov_optics : (q, q)
        That of ``UNKNOWNS`` as far as they are estimated, if beams had the assumed profile.
    """

    centres: Array
    shared: Array
    sigmas: Array
    has_shared: bool
    noise: Noise | None
    cov_noise: Array
    cov_shared_part: Array
    by_shared: Array
    cov_shared: Array
    cov_optics: Array

    @property
    def biases(self) -> Array:
        """Range biases of the lasers [m]."""
        return self.shared[_BIASES]

    @property
    def optics(self) -> Array:
        """Values of ``UNKNOWNS``."""
        return self.shared[_OPTICS]

    @property
    def mounting(self) -> Array:
        """Errors of the mounting."""
        return self.shared[_MOUNTING]

    @property
    def face_moves(self) -> Array:
        """How the mounting moves the upward face of each sphere, (m, 3) [m]; the other likewise."""
        return np.asarray(effects_on(self.centres) @ self.mounting)

    @property
    def covs(self) -> Array:
        """Covariances of the centres, (m, 3, 3) [m^2]."""
        return np.asarray(self.cov_noise + self.cov_shared_part)

    @property
    def by_halves(self) -> Array:
        """How one sigma of the difference between the halves of the limb moves centres, (m, 3)."""
        column = self.cov_shared[:, _HALVES]
        return np.asarray(self.by_shared @ (column / math.sqrt(column[_HALVES])))

    @property
    def covs_of_limb(self) -> Array:
        """Covariances of the centres if the halves of the limb were known, (m, 3, 3) [m^2]."""
        moves = self.by_halves
        return np.asarray(self.covs - moves[:, :, None] * moves[:, None])

    @property
    def upward(self) -> Array:
        """Unit vectors square to the lines of sight, upward, (m, 3)."""
        x, y, z = self.centres.T
        flat = np.hypot(x, y)
        away = np.maximum(flat * np.hypot(flat, z), 1e-9)
        return np.asarray((np.stack([-x * z, -y * z, flat**2]) / away).T)


class Estimate(NamedTuple):
    """A state with the predictions, residuals and weights of all returns."""

    state: State
    linear: Linear
    weighed: Weighed


def estimate(
    returns: Returns, rough: Array, prior: Prior, observe: Observe | None, others: Others | None
) -> Estimate:
    """Estimate all centres, laser biases, optics and mounting, from rough centres, (m, 3).

    The limb of returns is used if the ``others`` towards the candidates are given; each return
    counts there if, by the ranges alone, the limb opposite it is seen.
    Returns are chosen with footprints as wide as specified, or as estimated where that is wider and
    not unlikely: those of a wide beam that reach the limb from beyond the specified width would
    else be missing there, and the limb would seem as sharp as the choice.
    """
    state, radius = _start(rough, prior), prior.radius
    is_used = np.ones(len(returns.ranges), dtype=bool)
    is_faced = is_used
    factors = np.zeros((len(returns.ranges), 2))
    for step in range(_N_STEPS_MAX):
        corrected = _corrected(returns, state)
        linear = linearise(corrected, *_spheres(state, radius), is_used)
        if step < _N_STEPS:
            widest = _widest(returns, corrected) if _optics_are_likely(state) else returns
            is_used = may_be_sphere(widest, linear.offsets, _margins(state, radius), radius)
        noise = state.noise if step >= _N_STEPS_ROBUST else None
        weighed = _weighed(corrected, state, linear, (radius, noise, is_used))
        state = state._replace(noise=weighed.noise, has_shared=step >= _N_STEPS_CENTRES)
        residuals, sigmas, weights, _ = weighed
        by_optics = derivatives(returns, corrected, linear)
        by_clock = np.sum(linear.J[:3] * swept(returns), axis=0)
        J = (linear.J[:3], np.vstack([by_optics, np.zeros(len(residuals)), by_clock]))
        N = normals_of(returns, J, residuals, weights / sigmas**2, len(state.biases))
        if others is not None and step == _N_STEPS_RANGES:
            is_faced = faces_seen(corrected, linear, state.centres, others, radius)
        if others is not None and step >= _N_STEPS_RANGES:
            edge = edge_of(corrected, linear, weights, state.covs_of_limb, radius)
            state.shared[_HALVES] = edge.halves
            faced = weighed._replace(weights=weights * is_faced)
            factors = _add_limb(N, corrected, Estimate(state, linear, faced), edge, factors)
        if observe is not None and step >= _N_STEPS_RANGES:
            _add_observed(N, corrected, state, observe)
        before, state = state, _stepped(state, N, prior)
        if step + 1 >= _N_STEPS and _moved(before, state) < _SETTLED:
            break
    found = _predicted(returns, state, radius, is_used)
    if others is None:
        return found
    moves, covs = _beside_strips(returns, found, radius)
    if not moves.any():
        return found
    centres, cov_noise = found.state.centres + moves, found.state.cov_noise + covs
    state = found.state._replace(centres=centres, cov_noise=cov_noise)
    return _predicted(returns, state, radius, is_used)


def _predicted(returns: Returns, state: State, radius: float, is_used: Mask) -> Estimate:
    """Return a state with the predictions, residuals and weights of all returns."""
    corrected = _corrected(returns, state)
    linear = linearise(corrected, *_spheres(state, radius), is_used)
    weighed = _weighed(corrected, state, linear, (radius, state.noise, is_used))
    return Estimate(state._replace(noise=weighed.noise), linear, weighed)


def _beside_strips(returns: Returns, found: Estimate, radius: float) -> tuple[Array, Array]:
    """Return moves and further covariances of the spheres that are seen on a strip."""
    (state, linear, weighed), corrected = found, _corrected(returns, found.state)
    edge = edge_of(corrected, linear, weighed.weights, state.covs_of_limb, radius)
    ranges = corrected.ranges - echo_shifts(linear, state.optics)
    measured = (ranges, weighed.sigmas, weighed.weights)
    return on_strips(corrected, linear, measured, state.centres, edge)


def _start(rough: Array, prior: Prior) -> State:
    """Return the state before the first step."""
    nothing, sigmas = np.zeros((len(rough), 3, 3)), prior.sigmas
    return State(
        centres=rough,
        shared=np.zeros(len(sigmas)),
        sigmas=sigmas,
        has_shared=False,
        noise=None,
        cov_noise=nothing + (_ROUGH * prior.radius) ** 2 * np.eye(3),
        cov_shared_part=nothing,
        by_shared=np.zeros((len(rough), 3, len(sigmas))),
        cov_shared=np.diag(sigmas**2),
        cov_optics=np.diag(prior.sigma_optics**2),
    )


def _corrected(returns: Returns, state: State) -> Returns:
    """Return the returns as mounting and optics say they are, less the biases of lasers."""
    if not state.shared.any():
        return returns
    moved = moved_faces(returns, state.face_moves)
    moved = moved._replace(origins=moved.origins - state.shared[_CLOCK] * swept(returns))
    ranges = returns.ranges - state.biases[returns.lasers]
    return with_widths(moved, state.optics)._replace(ranges=ranges)


def _spheres(state: State, radius: float) -> tuple[Array, Array]:
    """Return spheres, (m, 4), of a known radius, and their covariances, (m, 4, 4)."""
    spheres, covs = np.full((len(state.centres), 4), radius), np.zeros((len(state.centres), 4, 4))
    spheres[:, :3], covs[:, :3, :3] = state.centres, state.covs
    return spheres, covs


def _margins(state: State, radius: float) -> Array:
    """Return how far a footprint may lie outside each sphere and still be its own [m]."""
    sigma = np.sqrt(np.trace(state.cov_noise, axis1=1, axis2=2))
    return np.asarray(np.clip(_GAP_SIGMAS * sigma, _GAP_MIN * radius, _GAP_MAX * radius))


def _widest(returns: Returns, corrected: Returns) -> Returns:
    """Return returns with the wider of their two footprints."""
    names = ("half_widths", "vertical_half_widths")
    wider = {name: np.maximum(getattr(returns, name), getattr(corrected, name)) for name in names}
    return returns._replace(**wider)


def _size_of_optics(state: State, shared: Array) -> float:
    """Return the length of the optics among shared unknowns, in sigmas of their prior."""
    return float(np.linalg.norm((shared / state.sigmas)[_OPTICS]))


def _optics_are_likely(state: State) -> bool:
    """Tell whether the optics are inside the limit at which their steps end."""
    return _size_of_optics(state, state.shared) < 0.999 * _OPTICS_MAX


def _weighed(
    corrected: Returns, state: State, linear: Linear, known: tuple[float, Noise | None, Mask]
) -> Weighed:
    """Return residuals with weights, for radius, noise and used returns that are known."""
    ranges = corrected.ranges - echo_shifts(linear, state.optics)
    return weigh(corrected._replace(ranges=ranges), linear, *known)


def _add_limb(N: Normals, returns: Returns, now: Estimate, edge: Edge, factors: Array) -> Array:
    """Add the observations of the limb to normal equations; return the factors of the returns."""
    state, weights = now.state, now.weighed.weights
    limb = limb_normals(returns, now.linear, weights, state.covs_of_limb, edge, factors)
    N.centres[:, :, :3] += limb.centres
    N.centres[:, :, -3:] += np.dstack([limb.shared, limb.rhs])
    N.by_face[:, :, :3] += limb.faces
    N.of_faces[:] += limb.of_faces
    N.by_face[:, :, -3:] += np.dstack([limb.shared_faces, limb.rhs_faces])
    N.shared[-2:, -3:] += limb.of_shared
    return limb.factors


def _add_observed(N: Normals, returns: Returns, state: State, observe: Observe) -> None:
    """Add further observations of the limb, which the difference of its halves moves down."""
    counts = np.maximum(np.diff(returns.starts), 1)
    widths = np.bincount(returns.markers, returns.vertical_half_widths[0], len(counts)) / counts
    down = -widths[:, None] * state.upward
    seen, rhs = observe(state.centres + state.shared[_HALVES] * down, state.covs_of_limb)
    moved = np.einsum("mij,mj->mi", seen, down)
    N.centres[:, :, :3] += seen
    N.of_faces[:] += seen
    N.centres[:, :, [-3, -1]] += np.stack([moved, rhs], axis=-1)
    N.shared[-2, [-3, -1]] += np.sum(moved * down), np.sum(rhs * down)


def _stepped(state: State, N: Normals, prior: Prior) -> State:
    """Return the state after one Gauss-Newton step of centres and shared unknowns together."""
    reduced = reduce(
        N, effects_on(state.centres), state.sigmas**-2.0, -state.shared / state.sigmas**2
    )
    estimated: Array = inverse(reduced.N)
    step = state.has_shared * (estimated @ reduced.rhs)
    shared, sigmas = state.shared + step, prior.sigmas.copy()
    shared[_OPTICS] *= min(1.0, _OPTICS_MAX / max(_size_of_optics(state, shared), 1e-12))
    if state.has_shared:
        for part in (_BIASES, _MOUNTING):
            found = (shared[part], estimated[part, part])
            sigmas[part] *= _spread(found, sigmas[part], about_mean=part == _BIASES)
    cov_shared = _with_considered(estimated, reduced.N, prior, sigmas[0] / prior.sigmas[0])
    return state._replace(
        centres=state.centres + _shortened(reduced.local_steps(step), prior.radius),
        shared=shared,
        sigmas=sigmas,
        cov_noise=_EFFICIENCY * reduced.own,
        cov_shared_part=reduced.gains @ cov_shared @ reduced.gains.transpose(0, 2, 1),
        by_shared=reduced.gains,
        cov_shared=cov_shared,
        cov_optics=estimated[_OPTICS, _OPTICS],
    )


def _moved(before: State, state: State) -> float:
    """Return how far the centre that moved most did so, in sigmas by the noise."""
    steps = np.linalg.norm(state.centres - before.centres, axis=1)
    return float(np.max(steps / np.sqrt(np.trace(state.cov_noise, axis1=1, axis2=2))))


def _with_considered(estimated: Array, N: Array, prior: Prior, spread: float) -> Array:
    """Return the covariance of the shared unknowns with those that are not estimated (Schmidt).

    The apparent size of spheres would determine bias and scale of ranges, if the profile of the
    beams were known as well as the model of an even footprint assumes. What that profile leaves
    open of the other optics is added. Lasers whose biases spread by more than expected may have
    more in common, too.
    """
    optics = np.arange(len(estimated))[_OPTICS]
    considered = optics[N_ESTIMATED:]
    response = -estimated @ N[:, considered]
    response[considered] = np.eye(len(considered))
    sigmas = prior.sigma_optics[N_ESTIMATED:] * (max(spread, 1.0), 1.0)
    cov = estimated + (response * sigmas**2) @ response.T
    cov[optics, optics] += np.append(SIGMAS_PROFILE, np.zeros(len(considered))) ** 2
    cov[_CLOCK, _CLOCK] += min(_SIGMA_CLOCK, prior.sigma_clock) ** 2
    return np.asarray(cov)


def _spread(found: tuple[Array, Array], sigmas: Array, *, about_mean: bool) -> float:
    """Return by how much unknowns spread more than their prior, by expectation maximisation.

    ``found`` are their estimates and covariance. About their mean, what they have in common does
    not count: a prior that grows with it would no longer hold it.
    """
    (estimates, cov), n = found, len(sigmas)
    if about_mean:
        apart, n = np.eye(n) - 1.0 / n, n - 1
        estimates, cov = apart @ estimates, apart @ cov @ apart
    squares = float(np.sum((estimates**2 + np.diag(cov)) / sigmas**2))
    return math.sqrt((squares + _DOF_SPREAD) / (n + _DOF_SPREAD))


def _shortened(steps: Array, radius: float) -> Array:
    """Return steps of centres, (m, 3), none longer than a quarter of the radius [m]."""
    lengths = np.linalg.norm(steps, axis=1, keepdims=True)
    return np.asarray(steps * np.minimum(1.0, _STEP_MAX * radius / np.maximum(lengths, 1e-12)))


def estimate_radii(
    returns: Returns, found: Estimate, radius: float, prior: Prior
) -> tuple[Array, Array]:
    """Estimate radii together with the centres; return them with their standard deviations.

    With the optics as specified where spheres are few or the estimated ones unlikely: there they
    take up what another radius does.
    """
    state, (_, sigmas, weights, _) = found.state, found.weighed
    shared, cov = state.shared.copy(), state.cov_shared[_OPTICS, _OPTICS]
    if len(state.centres) < _N_OPTICS or not _optics_are_likely(state):
        shared[_OPTICS], cov = 0.0, np.diag(prior.sigma_optics**2)
    moved, spheres = _corrected(returns, state._replace(shared=shared)), _spheres(state, radius)
    observed = Ranges(
        ranges=moved.ranges,
        variances=np.maximum(sigmas**2 - found.linear.sigmas_nonlinear**2, 1e-12),
        weights=weights,
    )
    linear = linearise(moved, *spheres, weights > 0.0)
    errors = BeamErrors(
        derivatives(returns, moved, linear)[:N_ESTIMATED], cov[:N_ESTIMATED, :N_ESTIMATED]
    )
    return free_radii(moved, observed, *spheres, moved.ranges - linear.ranges, errors)


def shared_range_sigmas(state: State) -> Array:
    """Return the part of each centre's sigma along its line of sight that all have in common."""
    lines = state.centres / np.linalg.norm(state.centres, axis=1, keepdims=True)
    by_shared = np.einsum("mi,mik->mk", lines, state.by_shared)
    cov = by_shared @ state.cov_shared @ by_shared.T
    own = np.diag(cov)
    common = (cov.sum(axis=1) - own) / (len(cov) - 1) if len(cov) > 1 else own
    return np.asarray(np.sqrt(np.maximum(common, 0.0)))


def shared_height_sigmas(state: State) -> Array:
    """Return the part of each centre's sigma upward that all have in common by their limbs."""
    heights = np.sum(state.by_halves * state.upward, axis=1)
    return np.asarray(np.maximum(np.sign(heights.sum()) * heights, 0.0))


def shared_factors(state: State) -> Array:
    """Return factors, (m, 3, k), of the covariances between centres by the shared unknowns [m]."""
    values, vectors = np.linalg.eigh(state.cov_shared)
    factors = state.by_shared @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    left, sizes, _ = np.linalg.svd(factors.reshape(-1, factors.shape[2]), full_matrices=False)
    felt = sizes > _UNFELT
    return np.asarray((left * sizes)[:, felt].reshape(*factors.shape[:2], -1))


def optics_of(state: State, prior: Prior) -> tuple[Optics, Array]:
    """Return the beams' optics as estimated, and their effect on the ranges of centres, (m, 3)."""
    sigmas = np.maximum(prior.sigma_optics[:N_ESTIMATED], _SIGMA_MIN)
    cov = state.cov_optics[:N_ESTIMATED, :N_ESTIMATED]
    optics = Optics(
        estimates=state.optics[:N_ESTIMATED].copy(),
        weights=inverse(cov) - np.diag(sigmas**-2.0),
        sigmas_prior=sigmas,
        sigmas_profile=SIGMAS_PROFILE.copy(),
    )
    lines = state.centres / np.linalg.norm(state.centres, axis=1, keepdims=True)
    by_optics = state.by_shared[:, :, _OPTICS][:, :, :N_ESTIMATED]
    return optics, np.einsum("mi,mik->mk", lines, by_optics)


def mounting_factor(state: State, prior: Prior) -> float:
    """Return by how much errors of the mounting exceed their prior; 1 where they do not."""
    ratios = (state.sigmas / prior.sigmas)[_MOUNTING]
    return max(float(ratios.max()), 1.0)
