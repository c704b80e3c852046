"""Where the spheres of a stop are, all of them together: hides the steps of the estimate.

The spheres of a stop share what one of them alone cannot tell: the noise of this sensor today, what
each laser measures too long, what is wrong in the mounting, and how sharply returns end at the
outline.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.model import Array, Mask
from spheremark.pipelines.sphere.faces import N_MOUNTING, effects_on
from spheremark.pipelines.sphere.limb import Outline, outline_before, outline_normals, outline_of
from spheremark.pipelines.sphere.linearisation import Linear, linearise
from spheremark.pipelines.sphere.noise import START, Noise, Weighed, weigh
from spheremark.pipelines.sphere.normal_equations import Normals, normals_of, solve
from spheremark.pipelines.sphere.radius import Weighing, free_radii
from spheremark.pipelines.sphere.returns import Rows, in_play, moved_faces

_EFFICIENCY = 0.9753  # variance of the estimate over the inverse normal matrix
_SPREAD_MIN = 1e-5  # [m] of the laser biases: keeps their prior invertible
_MOUNTING_MIN = 1e-9  # of what is known of the mounting: likewise
_N_STEPS = 8
_N_STEPS_GATED = 5  # after these the choice of returns by their place stays as it is
_N_STEPS_RANGES = 3  # without the outline
_N_STEPS_SOFT = 6  # before it is known how returns end there
_ROUGH = 0.1  # radii by which a rough centre may be off per axis
_STEP_MAX = 0.25  # radii per step
_GAP_SIGMAS = 3.0  # of its centre by which a return may pass a sphere by and still be its own
_GAP_MIN, _GAP_MAX = 0.02, 0.3  # radii: least and most of that
_DOF_BIAS = 2.0  # lasers that the prior of the biases is worth when their spread is estimated

Told = Callable[[Array, Array], tuple[Array, Array]]
"""What else is told of centres, (m, 3) [m] with covariances (m, 3, 3) [m^2]: what it adds to their
normal equations, (m, 3, 3) [1/m^2], and to the right-hand sides, (m, 3) [1/m]."""


class Known(NamedTuple):
    """What is known before the returns are seen.

    Attributes
    ----------
    radius : float
        Radius of the spheres [m].
    sigma_biases : (k,)
        Standard deviation of what each laser that occurs measures too long [m].
    sigma_mounting : (6,)
        That of the unknowns of the mounting.
    """

    radius: float
    sigma_biases: Array
    sigma_mounting: Array


class State(NamedTuple):
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
        Standard deviations of the biases, as estimated [m].
    has_biases : bool
        Whether biases are estimated already.
    noise : Noise
        That of the stop.
    cov_noise, cov_biases : (m, 3, 3)
        Covariances of the centres by noise and by biases [m^2].
    by_shared : (m, 3, k + 6)
        How far a unit of each bias, or of the mounting, moves each centre, with the sign turned.
    cov_shared : (k + 6, k + 6)
        Covariance of the biases [m^2] and of the mounting.
    """

    centres: Array
    biases: Array
    mounting: Array
    spread: Array
    has_biases: bool
    noise: Noise
    cov_noise: Array
    cov_biases: Array
    by_shared: Array
    cov_shared: Array


class Estimate(NamedTuple):
    """A state with what each return says of it: prediction, residuals [m], sigmas [m], weights."""

    state: State
    linear: Linear
    weighed: Weighed


class _Bounds(NamedTuple):
    """How returns end at the outline, as far as it is known; what each says of it, (n, 2)."""

    outline: Outline
    sites: Array


def estimate(
    rows: Rows, rough: Array, known: Known, told: Told | None, *, asks_outline: bool
) -> Estimate:
    """Return the estimate of all centres, biases and the mounting."""
    state, radius = _start(rough, known), known.radius
    is_in = np.ones(len(rows.ranges), dtype=bool)
    bounds = _Bounds(outline_before(radius), sites=np.zeros((len(rows.ranges), 2)))
    for step in range(_N_STEPS):
        linear = _linear(rows, state, is_in, radius)
        if step < _N_STEPS_GATED:
            is_in = in_play(rows, linear.offsets, _margins(state, radius), radius)
        now = _weighed(rows, state, linear, is_in)
        state = now.state._replace(has_biases=step >= _N_STEPS_GATED)
        N = _normals(rows, now)
        if asks_outline and step == _N_STEPS_SOFT:
            outline = outline_of(rows, linear, now.weighed.weights, radius)
            bounds = bounds._replace(outline=outline)
        if asks_outline and step >= _N_STEPS_RANGES:
            N, bounds = _bounded(rows, now, N, bounds)
        if told is not None and step >= _N_STEPS_RANGES:
            N = _with_told(N, state, told)
        state = _stepped(state, N, known)
    return _weighed(rows, state, _linear(rows, state, is_in, radius), is_in)


def _start(rough: Array, known: Known) -> State:
    """Return where the estimate begins."""
    nothing, sigmas = np.zeros((len(rough), 3, 3)), known.sigma_biases
    return State(
        centres=rough,
        biases=np.zeros(len(sigmas)),
        mounting=np.zeros(N_MOUNTING),
        spread=sigmas,
        has_biases=False,
        noise=START,
        cov_noise=nothing + (_ROUGH * known.radius) ** 2 * np.eye(3),
        cov_biases=nothing,
        by_shared=np.zeros((len(rough), 3, len(sigmas) + N_MOUNTING)),
        cov_shared=np.diag(np.concatenate([sigmas, known.sigma_mounting]) ** 2),
    )


def _placed(rows: Rows, state: State) -> Rows:
    """Return the returns with their beams where the mounting, as it is known, has them."""
    if not state.mounting.any():
        return rows
    return moved_faces(rows, effects_on(state.centres) @ state.mounting)


def _spheres(state: State, radius: float) -> tuple[Array, Array]:
    """Return spheres, (m, 4), of a known radius, and their covariances, (m, 4, 4)."""
    spheres, covs = np.full((len(state.centres), 4), radius), np.zeros((len(state.centres), 4, 4))
    spheres[:, :3] = state.centres
    covs[:, :3, :3] = state.cov_noise + state.cov_biases
    return spheres, covs


def _linear(rows: Rows, state: State, is_in: Mask, radius: float) -> Linear:
    """Return what the beams should measure, linearised over what is not known of the centres."""
    linear: Linear = linearise(_placed(rows, state), *_spheres(state, radius), is_in)
    return linear


def _margins(state: State, radius: float) -> Array:
    """Return by how much a footprint may pass each sphere by and still be its own [m]."""
    sigma = np.sqrt(np.trace(state.cov_noise, axis1=1, axis2=2))
    return np.asarray(np.clip(_GAP_SIGMAS * sigma, _GAP_MIN * radius, _GAP_MAX * radius))


def _weighed(rows: Rows, state: State, linear: Linear, is_in: Mask) -> Estimate:
    """Return a state with the noise that its residuals show, and these."""
    weighed = weigh(rows, linear, state.biases, state.noise, is_in)
    return Estimate(state._replace(noise=weighed.noise), linear, weighed)


def _normals(rows: Rows, now: Estimate) -> Normals:
    """Sum the normal equations of centres and biases."""
    residuals, sigmas, weights, _ = now.weighed
    return normals_of(rows, now.linear, residuals, weights / sigmas**2, len(now.state.biases))


def _bounded(rows: Rows, now: Estimate, N: Normals, known: _Bounds) -> tuple[Normals, _Bounds]:
    """Return normal equations with what the outline adds, and what each return says of it."""
    covs = now.state.cov_noise + now.state.cov_biases
    centres, pull_centres, faces, pull_faces, sites = outline_normals(
        rows, now.linear, now.weighed.weights, covs, *known
    )
    added = N._replace(
        centres=N.centres + centres,
        pull_centres=N.pull_centres + pull_centres,
        faces=N.faces + faces,
        pull_faces=N.pull_faces + pull_faces,
    )
    return added, known._replace(sites=sites)


def _with_told(N: Normals, state: State, told: Told) -> Normals:
    """Return normal equations with what else is told of the centres."""
    centres, pull_centres = told(state.centres, state.cov_noise + state.cov_biases)
    return N._replace(centres=N.centres + centres, pull_centres=N.pull_centres + pull_centres)


def _stepped(state: State, N: Normals, known: Known) -> State:
    """Return the state after one Gauss-Newton step of centres, biases and mounting together."""
    n, prior2 = len(state.biases), float(np.mean(known.sigma_biases**2))
    sigmas = np.maximum(np.concatenate([state.spread, known.sigma_mounting]), _MOUNTING_MIN)
    sigmas[:n] = np.maximum(sigmas[:n], _SPREAD_MIN)
    shared = np.concatenate([state.biases, state.mounting])
    solved = solve(N, effects_on(state.centres), sigmas**-2.0, -shared / sigmas**2)
    step = solved.step_shared * state.has_biases
    biases = state.biases + step[:n]
    known2 = (biases**2 + np.diag(solved.cov_shared)[:n]).sum() + _DOF_BIAS * prior2
    spread = known.sigma_biases * np.sqrt(known2 / (_DOF_BIAS + n) / prior2)
    return state._replace(
        centres=state.centres + _shortened(solved.steps - solved.by_shared @ step, known.radius),
        biases=biases,
        mounting=state.mounting + step[n:],
        spread=spread if state.has_biases else known.sigma_biases,
        cov_noise=_EFFICIENCY * solved.inverses,
        cov_biases=solved.covs_by_shared,
        by_shared=solved.by_shared,
        cov_shared=solved.cov_shared,
    )


def _shortened(steps: Array, radius: float) -> Array:
    """Return steps of centres, (m, 3), none longer than a quarter of the radius [m]."""
    lengths = np.linalg.norm(steps, axis=1, keepdims=True)
    return np.asarray(steps * np.minimum(1.0, _STEP_MAX * radius / np.maximum(lengths, 1e-12)))


def radii_shown(rows: Rows, found: Estimate, radius: float) -> tuple[Array, Array]:
    """Return radii estimated together with the centres, and their standard deviations."""
    state, (residuals, sigmas, weights, _) = found.state, found.weighed
    weighing = Weighing(
        ranges=rows.ranges - state.biases[rows.lasers],
        variances=np.maximum(sigmas**2 - found.linear.bends**2, 1e-12),
        weights=weights,
    )
    return free_radii(_placed(rows, state), weighing, *_spheres(state, radius), residuals)


def sigmas_shared(state: State) -> Array:
    """Return how much of each centre's error along its line of sight all have in common."""
    lines = state.centres / np.linalg.norm(state.centres, axis=1, keepdims=True)
    pulls = np.einsum("mi,mik->mk", lines, state.by_shared)
    cov = pulls @ state.cov_shared @ pulls.T
    own = np.diag(cov)
    together = (cov.sum(axis=1) - own) / (len(cov) - 1) if len(cov) > 1 else own
    return np.asarray(np.sqrt(np.maximum(together, 0.0)))
