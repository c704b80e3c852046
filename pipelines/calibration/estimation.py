"""Adjustment of rig and centres to the ranges, with robust weights."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spheremark.pipelines.calibration.gimbal import (
    GIMBAL,
    Linearised,
    Parameter,
    Pulses,
    linearise,
    moved,
)
from spheremark.pipelines.config import FittingConfig
from spheremark.pipelines.errors import NotConvergedError
from spheremark.pipelines.estimation.linear_algebra import Reduced, eliminate, inverse
from spheremark.pipelines.estimation.robust import tukey_loss, tukey_weights
from spheremark.pipelines.model import RING_UNKNOWN, Array, Index, Mask, Rig, Rings
from spheremark.pipelines.sphere.noise import N_CLASSES
from spheremark.pipelines.sphere.optics import N_ESTIMATED, prior_sigmas

_TUKEY = 6.0  # sigmas at which a return has no weight; 98 % efficient on clean data
_EXPECTED_SQUARE = 0.8449  # mean of weight times square of normal residuals: 1 - 6/c^2 + 15/c^4
_EFFICIENCY = 0.9651  # variance over the inverse normal matrix: E[w^2 x^2] E[w] / E[.]^2
_NOISE_MIN = 0.001  # [m]; half of the resolution of a range
_NOISE_START = 0.025  # [m]; the largest that a VLP-16 shows
_DOF_NOISE = 30.0  # returns that the common noise is worth beside those of a sphere or a shade
_N_STEPS = 30
_N_STEPS_NOISE = 4  # after these the noise stays as it is
_SHARES = (1.0, 0.5, 0.25, 0.125, 0.0625)  # of a step that are tried
_SETTLED = 0.02  # of the loss: what a step must save, a fifth of a sigma of one parameter
_N_STEPS_CENTRES = 6
_N_LASER = 20  # returns below which the bias of a laser stays as it is
_SIGMA_MIN = 1e-9  # of optics that are taken as exact
_PRIOR = 1e3  # [m] of a centre: keeps the equations solvable and is not felt otherwise

_OPTICS = slice(len(GIMBAL), len(GIMBAL) + N_ESTIMATED)  # places among the unknowns


class Inseparable(NamedTuple):
    """A parameter that stays at its start value, with the reason."""

    name: str
    reason: str


def reduced(which: Index, J_centres: Array, J: Array, residuals: Array, weights: Array) -> Reduced:
    """Sum the normal equations of centres and parameters, and eliminate the centres."""
    order = np.argsort(which, kind="stable")
    J_centres, J, weights = J_centres[order], J[order], weights[order, None]
    weighted = weights * np.column_stack([J_centres, residuals[order]])
    starts = np.searchsorted(which[order], np.arange(which.max() + 1))

    def summed(products: Array) -> Array:
        return np.asarray(np.add.reduceat(products, starts, axis=0))

    return eliminate(
        summed(weighted[:, :3, None] * J_centres[:, None, :]) + np.eye(3) / _PRIOR**2,
        summed(weighted[:, :3, None] * J[:, None, :]),
        summed(weighted[:, 3:] * J_centres),
        (J * weights).T @ J,
        J.T @ weighted[:, 3],
    )


def separable(N: Array, parameters: tuple[Parameter, ...]) -> tuple[Mask, tuple[Inseparable, ...]]:
    """Return which parameters the observations determine, and why the others are held.

    Notes
    -----
    In units of ``Parameter.unknown``, an eigenvalue of the normal matrix under 1 belongs to a
    combination that is undetermined. While there is one, the parameter with the largest part in
    its eigenvector is held. Parameters with a caution are held in any case.
    """
    scales = np.array([parameter.unknown for parameter in parameters])
    scaled = N * np.outer(scales, scales)
    is_free, held = np.ones(len(N), dtype=np.bool_), []
    while is_free.any():
        places = np.flatnonzero(is_free)
        eigenvalues, vectors = np.linalg.eigh(scaled[np.ix_(places, places)])
        if eigenvalues[0] >= 1.0:
            break
        parts = np.abs(vectors[:, 0])
        worst = int(parts.argmax())
        is_free[places[worst]] = False
        partners = [parameters[places[k]].name for k in np.flatnonzero(parts > 0.3) if k != worst]
        held.append(
            Inseparable(
                parameters[places[worst]].name,
                _reason(parameters[places[worst]], float(eigenvalues[0]), partners),
            )
        )
    for place in np.flatnonzero(is_free):
        if parameters[place].caution:
            free = np.flatnonzero(is_free)
            variances = np.diag(inverse(N[np.ix_(free, free)]))
            sigma = float(np.sqrt(variances[np.searchsorted(free, place)]))
            is_free[place] = False
            held.append(_held_back(parameters[place], sigma))
    return is_free, tuple(held)


def _held_back(parameter: Parameter, sigma: float) -> Inseparable:
    """Return why a parameter is held although the observations determine it."""
    return Inseparable(
        parameter.name,
        f"These scans seem to determine it to {sigma:.2g} {parameter.unit} (1 sigma), but "
        f"{parameter.caution}.",
    )


def _reason(parameter: Parameter, eigenvalue: float, partners: list[str]) -> str:
    """Return why a parameter is held."""
    together = f" apart from {', '.join(partners)}" if partners else ""
    if eigenvalue < 1e-4:
        return f"These scans do not determine it{together}: {parameter.twin}."
    sigma = parameter.unknown / np.sqrt(eigenvalue)
    return (
        f"These scans determine it{together} only to {sigma:.2g} {parameter.unit} (1 sigma): "
        f"{parameter.twin}."
    )


class Estimate(NamedTuple):
    """A rig and centres with what they rest on.

    Attributes
    ----------
    rig : Rig
        The rig.
    optics : (3,)
        The optics of ``sphere.optics`` that scans determine.
    centres : (m, 3)
        Centres in the base of their stops [m].
    is_free : (q,)
        The parameters of ``GIMBAL`` that were estimated.
    held : tuple of Inseparable
        The others.
    lasers : (k,)
        Lasers whose biases were estimated, their mean held.
    cov : (p, p)
        Covariance of the free parameters, then of the biases of those lasers.
    is_used : (n,)
        Which returns have weight.
    dof : int
        Their number minus that of the unknowns.
    basis : (p, k)
        The parameters of ``cov`` by independent unknowns: biases have their mean held.
    weights : (k, k)
        Normal matrix of these unknowns, the common range bias eliminated.
    effects : (m, 3, k)
        Derivative of each centre by an error of these unknowns.
    cov_centres : (m, 3, 3)
        Covariances of the centres if the rig were known [m^2].
    """

    rig: Rig
    optics: Array
    centres: Array
    is_free: Mask
    held: tuple[Inseparable, ...]
    lasers: Index
    cov: Array
    is_used: Mask
    dof: int
    basis: Array
    weights: Array
    effects: Array
    cov_centres: Array


class _State(NamedTuple):
    """Rig, optics and centres [m], with the pulses linearised there."""

    rig: Rig
    optics: Array
    centres: Array
    lin: Linearised


class _Problem(NamedTuple):
    """What stays the same from step to step; ``basis``, (256, k - 1), spans the laser biases."""

    seen: Pulses
    covs: Array
    radius: float
    sigma_direction: float
    sigmas_optics: Array
    basis: Array

    def at(self, rig: Rig, optics: Array, centres: Array) -> _State:
        """Return the state at a rig, optics and centres."""
        lin = linearise(self.seen, rig, optics, (centres, self.covs), self.radius)
        return _State(rig, optics, centres, lin)

    def loss(self, state: _State, sigmas: Array) -> float:
        """Return the loss of a state, with that of its optics by their prior."""
        prior = 0.5 * float(np.sum((state.optics / self.sigmas_optics) ** 2))
        return prior + tukey_loss(state.lin.residuals / sigmas, _TUKEY)

    def extra(self, state: _State) -> Array:
        """Return the noise that directions and linearisation add to each range [m]."""
        return np.asarray(
            np.hypot(self.sigma_direction * state.lin.slopes, state.lin.sigmas_nonlinear)
        )

    def sigmas(self, state: _State, noises: Array) -> Array:
        """Return the standard deviation of each range, given its noise [m]."""
        return np.asarray(np.hypot(noises, self.extra(state)))

    def noises(self, state: _State, before: Array) -> Array:
        """Return the noise of each return [m]: of its reflectivity, times that of its sphere."""
        which, shades, m = self.seen.which, self.seen.shades, len(state.centres)
        scaled = state.lin.residuals / self.sigmas(state, before)
        weights = tukey_weights(scaled, _TUKEY)
        squares = weights * (scaled * before) ** 2 / _EXPECTED_SQUARE
        counts = np.bincount(shades, weights > 0.0, N_CLASSES)
        share = max(1.0 - 3.0 * m / max(float(counts.sum()), 1.0), 0.01)
        of_all = float(squares.sum()) / max(share * float(counts.sum()), 1.0)
        by_shade = (np.bincount(shades, squares, N_CLASSES) + _DOF_NOISE * of_all) / (
            share * counts + _DOF_NOISE
        )
        dofs = np.maximum(np.bincount(which, weights > 0.0, m) - 3.0, 0.0)
        ratios = np.bincount(which, squares / by_shade[shades], m) + _DOF_NOISE
        own = by_shade[shades] * (ratios / (dofs + _DOF_NOISE))[which]
        return np.asarray(np.maximum(np.sqrt(own), _NOISE_MIN))

    def equations(self, state: _State, sigmas: Array) -> Reduced:
        """Return the normal equations of all parameters, optics and biases, in this order."""
        lin = state.lin
        J = np.column_stack([lin.J_rig, lin.J_optics, self.basis[self.seen.rings]])
        weights = tukey_weights(lin.residuals / sigmas, _TUKEY) / sigmas**2
        equations = reduced(self.seen.which, lin.J_centres, J, lin.residuals, weights)
        equations.N[_OPTICS, _OPTICS] += np.diag(self.sigmas_optics**-2.0)
        equations.rhs[_OPTICS] -= state.optics / self.sigmas_optics**2
        return equations

    def ahead(self, state: _State, equations: Reduced, chosen: Index, sigmas: Array) -> _State:
        """Return the state after the longest share of a step that lowers the loss, or the last."""
        steps = np.zeros(len(equations.N))
        steps[chosen] = inverse(equations.N[np.ix_(chosen, chosen)]) @ equations.rhs[chosen]
        by_rig, by_optics, by_laser = np.split(steps, [_OPTICS.start, _OPTICS.stop])
        biases = (self.basis @ by_laser)[: len(state.rig.laser_range_biases)]
        by_centre = equations.local_steps(steps)
        loss, trial = self.loss(state, sigmas), state
        for share in _SHARES:
            rig = moved(state.rig, share * by_rig, share * biases)
            optics = state.optics + share * by_optics
            trial = self.at(rig, optics, state.centres + share * by_centre)
            if self.loss(trial, sigmas) < loss:
                break
        return trial


def estimate(
    seen: Pulses, rig: Rig, centres: Array, covs: Array, radius: float, config: FittingConfig
) -> Estimate:
    """Adjust the rig and all centres to the recorded ranges.

    Notes
    -----
    The optics of the beams are unknowns with their priors: a footprint that is wider than the rig
    says shifts ranges on slopes by as much as errors of the rig do.
    Gauss-Newton with Tukey's weights, each step shortened until it lowers the loss. Noise is
    estimated by reflectivity and by sphere, each shrunk towards the noise of all: beams that graze
    the limb, which determine a centre across the line of sight, return weakly and are noisy.
    """
    lasers, basis = _contrasts(seen.rings)
    sigmas_optics = np.maximum(prior_sigmas(config, rig)[:N_ESTIMATED], _SIGMA_MIN)
    problem = _Problem(seen, covs, radius, config.sigma_direction, sigmas_optics, basis)
    state = problem.at(rig, np.zeros(N_ESTIMATED), centres)
    noises = np.full(len(seen.which), _NOISE_START)
    is_free: Mask = np.ones(len(GIMBAL), dtype=np.bool_)
    held: tuple[Inseparable, ...] = ()
    for number in range(_N_STEPS):
        if number < _N_STEPS_NOISE:
            noises = problem.noises(state, noises)
        sigmas = problem.sigmas(state, noises)
        equations = problem.equations(state, sigmas)
        if number == 0:
            is_free, held = separable(equations.N[: len(GIMBAL), : len(GIMBAL)], GIMBAL)
        chosen = np.flatnonzero(
            np.pad(is_free, (0, len(equations.N) - len(GIMBAL)), constant_values=True)
        )
        better = problem.ahead(state, equations, chosen, sigmas)
        saved = problem.loss(state, sigmas) - problem.loss(better, sigmas)
        if number >= _N_STEPS_NOISE and saved < _SETTLED:
            return _estimate(problem, state, sigmas, is_free, held, lasers)
        state = better
    raise NotConvergedError(
        f"The calibration did not converge within {_N_STEPS} steps: the start rig is too far off, "
        "or the detected objects are no spheres."
    )


def _contrasts(rings: Rings) -> tuple[Index, Array]:
    """Return the lasers with returns enough, and a basis, (256, k - 1), of biases of mean zero."""
    counts = np.bincount(rings, minlength=256)
    counts[RING_UNKNOWN] = 0
    lasers = np.flatnonzero(counts >= _N_LASER)
    k = len(lasers)
    basis = np.zeros((256, max(k - 1, 0)))
    if k > 1:
        basis[lasers] = np.linalg.svd(np.eye(k) - 1.0 / k)[0][:, : k - 1]
    return lasers, basis


def _estimate(
    problem: _Problem,
    state: _State,
    sigmas: Array,
    is_free: Mask,
    held: tuple[Inseparable, ...],
    lasers: Index,
) -> Estimate:
    """Assemble the estimate."""
    n_free, k = int(is_free.sum()), problem.basis.shape[1]
    chosen = np.append(np.flatnonzero(is_free), _OPTICS.stop + np.arange(k))
    equations = problem.equations(state, sigmas)
    adjusted = np.sort(np.append(chosen, np.arange(len(GIMBAL) + N_ESTIMATED)[_OPTICS]))
    cov = inverse(equations.N[np.ix_(adjusted, adjusted)])
    of_rig = np.searchsorted(adjusted, chosen)
    J = np.zeros((n_free + len(lasers), n_free + k))
    J[:n_free, :n_free] = np.eye(n_free)
    J[n_free:, n_free:] = problem.basis[lasers]
    is_used = tukey_weights(state.lin.residuals / sigmas, _TUKEY) > 0.0
    return Estimate(
        rig=state.rig,
        optics=state.optics,
        centres=state.centres,
        is_free=is_free,
        held=held,
        lasers=lasers,
        cov=_EFFICIENCY * J @ cov[np.ix_(of_rig, of_rig)] @ J.T,
        is_used=is_used,
        dof=int(is_used.sum()) - 3 * len(state.centres) - len(adjusted),
        basis=J,
        weights=_without_others(equations.N, chosen) / _EFFICIENCY,
        effects=equations.gains[:, :, chosen],
        cov_centres=_EFFICIENCY * equations.own,
    )


def _without_others(N: Array, chosen: Index) -> Array:
    """Return the normal matrix of some unknowns, optics and the common range bias eliminated.

    The apparent size of near spheres would determine that bias too, but depends on the profile of
    the beams.
    """
    bias = [parameter.name for parameter in GIMBAL].index("common_range_bias")
    others = np.append(np.arange(len(GIMBAL) + N_ESTIMATED)[_OPTICS], bias)
    across = N[np.ix_(chosen, others)]
    reduction = across @ inverse(N[np.ix_(others, others)]) @ across.T
    return np.asarray(N[np.ix_(chosen, chosen)] - reduction)


def residual_rms(seen: Pulses, rig: Rig, found: Estimate, covs: Array, radius: float) -> float:
    """Return the root mean square residual of an estimate's returns with a rig."""
    centres, weights = found.centres, found.is_used.astype(np.float64)
    nothing = np.zeros((len(weights), 0))
    for _ in range(_N_STEPS_CENTRES):
        lin = linearise(seen, rig, found.optics, (centres, covs), radius)
        equations = reduced(seen.which, lin.J_centres, nothing, lin.residuals, weights)
        centres = centres + equations.local_steps(np.zeros(0))
    residuals = linearise(seen, rig, found.optics, (centres, covs), radius).residuals
    return float(np.sqrt(np.mean(residuals[found.is_used] ** 2)))
