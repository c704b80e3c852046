"""Joint least-squares estimate of the spheres of a stop.

The spheres share what one of them cannot determine: the noise of the sensor, the range bias of each
laser, the errors of the mounting, and how sharply returns end at the limb.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.estimation.linear_algebra import inverse
from spheremark.pipelines.model import Array, Mask
from spheremark.pipelines.sphere.limb import Edge, edge_before, edge_of, limb_normals
from spheremark.pipelines.sphere.linearisation import Linear, linearise
from spheremark.pipelines.sphere.mounting import N_MOUNTING, effects_on
from spheremark.pipelines.sphere.noise import START, Noise, Weighed, weigh
from spheremark.pipelines.sphere.normal_equations import Normals, normals_of, reduce
from spheremark.pipelines.sphere.radius import Ranges, free_radii
from spheremark.pipelines.sphere.returns import Returns, may_be_sphere, moved_faces

_EFFICIENCY = 0.9753  # variance of the estimate over the inverse normal matrix
_SIGMA_BIAS_MIN = 1e-5  # [m] of the laser biases: keeps their prior invertible
_MOUNTING_MIN = 1e-9  # of the unknowns of the mounting: likewise
_N_STEPS = 8
_N_STEPS_GATED = 5  # after these the choice of returns by their place is fixed
_N_STEPS_RANGES = 3  # without the limb
_N_STEPS_SOFT = 6  # before the edge at the limb is estimated
_ROUGH = 0.1  # radii: standard deviation per axis of a rough centre
_STEP_MAX = 0.25  # radii per step
_GAP_SIGMAS = 3.0  # of its centre by which a return may lie outside a sphere and still be its own
_GAP_MIN, _GAP_MAX = 0.02, 0.3  # radii: least and most of that
_DOF_BIAS = 2.0  # lasers that the prior counts for in the estimate of the biases' spread

Observe = Callable[[Array, Array], tuple[Array, Array]]
"""Further observations of the centres. Called with centres, (m, 3), and their covariances; returns
the normal matrices, (m, 3, 3) [1/m^2], and right-hand sides, (m, 3) [1/m], that they add."""


class Prior(NamedTuple):
    """What is known before the scan.

    Attributes
    ----------
    radius : float
        Radius of the spheres [m].
    sigma_biases : (k,)
        Standard deviations of the range biases of the lasers that occur [m].
    sigma_mounting : (6,)
        Standard deviations of the unknowns of the mounting.
    """

    radius: float
    sigma_biases: Array
    sigma_mounting: Array


class State(NamedTuple):
    """Unknowns with their covariances after some steps.

    Attributes
    ----------
    centres : (m, 3)
        Centres [m].
    biases : (k,)
        Range biases of the lasers [m].
    mounting : (6,)
        Errors of the mounting, in the order of ``mounting.effects_on``.
    sigma_biases : (k,)
        Standard deviations of the biases, as estimated [m].
    has_biases : bool
        Whether the shared unknowns are estimated already.
    noise : Noise
        That of the stop.
    cov_noise, cov_shared_part : (m, 3, 3)
        Covariances of the centres by the noise, and by the shared unknowns [m^2].
    by_shared : (m, 3, k + 6)
        Derivatives of the centres by the shared unknowns, with the sign turned.
    cov_shared : (k + 6, k + 6)
        Covariance of the biases and of the mounting.
    """

    centres: Array
    biases: Array
    mounting: Array
    sigma_biases: Array
    has_biases: bool
    noise: Noise
    cov_noise: Array
    cov_shared_part: Array
    by_shared: Array
    cov_shared: Array

    @property
    def covs(self) -> Array:
        """Covariances of the centres, (m, 3, 3) [m^2]."""
        return np.asarray(self.cov_noise + self.cov_shared_part)


class Estimate(NamedTuple):
    """A state with the predictions, residuals and weights of all returns."""

    state: State
    linear: Linear
    weighed: Weighed


def estimate(
    returns: Returns, rough: Array, prior: Prior, observe: Observe | None, *, uses_limb: bool
) -> Estimate:
    """Estimate all centres, the laser biases and the mounting, from rough centres, (m, 3)."""
    state, radius = _start(rough, prior), prior.radius
    is_used = np.ones(len(returns.ranges), dtype=bool)
    edge, sites = edge_before(radius), np.zeros((len(returns.ranges), 2))
    for step in range(_N_STEPS):
        linear = _linear(returns, state, is_used, radius)
        if step < _N_STEPS_GATED:
            is_used = may_be_sphere(returns, linear.offsets, _margins(state, radius), radius)
        now = _weighed(returns, state, linear, is_used)
        state = now.state._replace(has_biases=step >= _N_STEPS_GATED)
        residuals, sigmas, weights, _ = now.weighed
        N = normals_of(returns, linear, residuals, weights / sigmas**2, len(state.biases))
        if uses_limb and step == _N_STEPS_SOFT:
            edge = edge_of(returns, linear, weights, radius)
        if uses_limb and step >= _N_STEPS_RANGES:
            sites = _add_limb(N, returns, now, edge, sites)
        if observe is not None and step >= _N_STEPS_RANGES:
            centres, rhs = observe(state.centres, state.covs)
            N.centres[:, :, :3] += centres
            N.centres[:, :, -1] += rhs
        state = _stepped(state, N, prior)
    return _weighed(returns, state, _linear(returns, state, is_used, radius), is_used)


def _start(rough: Array, prior: Prior) -> State:
    """Return the state before the first step."""
    nothing, sigmas = np.zeros((len(rough), 3, 3)), prior.sigma_biases
    return State(
        centres=rough,
        biases=np.zeros(len(sigmas)),
        mounting=np.zeros(N_MOUNTING),
        sigma_biases=sigmas,
        has_biases=False,
        noise=START,
        cov_noise=nothing + (_ROUGH * prior.radius) ** 2 * np.eye(3),
        cov_shared_part=nothing,
        by_shared=np.zeros((len(rough), 3, len(sigmas) + N_MOUNTING)),
        cov_shared=np.diag(np.concatenate([sigmas, prior.sigma_mounting]) ** 2),
    )


def _corrected(returns: Returns, state: State) -> Returns:
    """Return the returns with their beams corrected for the errors of the mounting."""
    if not state.mounting.any():
        return returns
    return moved_faces(returns, effects_on(state.centres) @ state.mounting)


def _spheres(state: State, radius: float) -> tuple[Array, Array]:
    """Return spheres, (m, 4), of a known radius, and their covariances, (m, 4, 4)."""
    spheres, covs = np.full((len(state.centres), 4), radius), np.zeros((len(state.centres), 4, 4))
    spheres[:, :3], covs[:, :3, :3] = state.centres, state.covs
    return spheres, covs


def _linear(returns: Returns, state: State, is_used: Mask, radius: float) -> Linear:
    """Return predicted ranges, linearised over the uncertainty of the centres."""
    return linearise(_corrected(returns, state), *_spheres(state, radius), is_used)


def _margins(state: State, radius: float) -> Array:
    """Return how far a footprint may lie outside each sphere and still be its own [m]."""
    sigma = np.sqrt(np.trace(state.cov_noise, axis1=1, axis2=2))
    return np.asarray(np.clip(_GAP_SIGMAS * sigma, _GAP_MIN * radius, _GAP_MAX * radius))


def _weighed(returns: Returns, state: State, linear: Linear, is_used: Mask) -> Estimate:
    """Return a state with its residuals, and the noise that they show."""
    weighed = weigh(returns, linear, state.biases, state.noise, is_used)
    return Estimate(state._replace(noise=weighed.noise), linear, weighed)


def _add_limb(N: Normals, returns: Returns, now: Estimate, edge: Edge, sites: Array) -> Array:
    """Add the observations of the limb to normal equations; return the sites of the returns."""
    limb = limb_normals(returns, now.linear, now.weighed.weights, now.state.covs, edge, sites)
    N.centres[:, :, :3] += limb.centres
    N.centres[:, :, -1] += limb.rhs
    N.by_face[:, :, :3] += limb.faces
    N.by_face[:, :, -1] += limb.rhs_faces
    return limb.sites


def _stepped(state: State, N: Normals, prior: Prior) -> State:
    """Return the state after one Gauss-Newton step of centres, biases and mounting together."""
    n, prior2 = len(state.biases), float(np.mean(prior.sigma_biases**2))
    sigmas = np.maximum(np.concatenate([state.sigma_biases, prior.sigma_mounting]), _MOUNTING_MIN)
    sigmas[:n] = np.maximum(sigmas[:n], _SIGMA_BIAS_MIN)
    shared = np.concatenate([state.biases, state.mounting])
    reduced = reduce(N, effects_on(state.centres), sigmas**-2.0, -shared / sigmas**2)
    cov_shared: Array = inverse(reduced.N)
    step = state.has_biases * (cov_shared @ reduced.rhs)
    biases = state.biases + step[:n]
    # spread of the biases by expectation maximisation
    squares = (biases**2 + np.diag(cov_shared)[:n]).sum() + _DOF_BIAS * prior2
    spread = prior.sigma_biases * np.sqrt(squares / (_DOF_BIAS + n) / prior2)
    return state._replace(
        centres=state.centres + _shortened(reduced.local_steps(step), prior.radius),
        biases=biases,
        mounting=state.mounting + step[n:],
        sigma_biases=spread if state.has_biases else prior.sigma_biases,
        cov_noise=_EFFICIENCY * reduced.own,
        cov_shared_part=reduced.gains @ cov_shared @ reduced.gains.transpose(0, 2, 1),
        by_shared=reduced.gains,
        cov_shared=cov_shared,
    )


def _shortened(steps: Array, radius: float) -> Array:
    """Return steps of centres, (m, 3), none longer than a quarter of the radius [m]."""
    lengths = np.linalg.norm(steps, axis=1, keepdims=True)
    return np.asarray(steps * np.minimum(1.0, _STEP_MAX * radius / np.maximum(lengths, 1e-12)))


def estimate_radii(returns: Returns, found: Estimate, radius: float) -> tuple[Array, Array]:
    """Estimate radii together with the centres; return them with their standard deviations."""
    state, (residuals, sigmas, weights, _) = found.state, found.weighed
    observed = Ranges(
        ranges=returns.ranges - state.biases[returns.lasers],
        variances=np.maximum(sigmas**2 - found.linear.bends**2, 1e-12),
        weights=weights,
    )
    return free_radii(_corrected(returns, state), observed, *_spheres(state, radius), residuals)


def shared_range_sigmas(state: State) -> Array:
    """Return the part of each centre's sigma along its line of sight that all have in common."""
    lines = state.centres / np.linalg.norm(state.centres, axis=1, keepdims=True)
    by_shared = np.einsum("mi,mik->mk", lines, state.by_shared)
    cov = by_shared @ state.cov_shared @ by_shared.T
    own = np.diag(cov)
    common = (cov.sum(axis=1) - own) / (len(cov) - 1) if len(cov) > 1 else own
    return np.asarray(np.sqrt(np.maximum(common, 0.0)))
