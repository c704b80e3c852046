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

# Places among the unknowns
_COMMON = [parameter.name for parameter in GIMBAL].index("common_range_bias")
_OPTICS = slice(len(GIMBAL), len(GIMBAL) + N_ESTIMATED)


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
        Covariance of the free parameters, then of the biases of those lasers; the bias that all
        have in common, which is held, counts with its prior.
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
    """Rig, optics, centres [m] and errors of lines [rad], with the pulses linearised there.

    ``residuals`` are what those errors leave [m].
    """

    rig: Rig
    optics: Array
    centres: Array
    errors: Array
    lin: Linearised
    residuals: Array


class _Lines(NamedTuple):
    """Normal equations of the angles of scan lines, each line an unknown with its prior.

    ``rows``, (l, 3 + p), are those between the angles and the centre and parameters, and
    ``precisions`` and ``rhs``, (l,), those of the angles themselves.
    """

    rows: Array
    precisions: Array
    rhs: Array

    def solved(self, by_centre: Array, steps: Array) -> Array:
        """Return the steps of the angles for those of centres, (l, 3), and parameters, (p,)."""
        by_others = np.sum(self.rows[:, :3] * by_centre, axis=1) + self.rows[:, 3:] @ steps
        return np.asarray((self.rhs - by_others) / self.precisions)


class _Problem(NamedTuple):
    """What stays the same from step to step; ``basis``, (256, k - 1), spans the laser biases.

    ``spheres`` and ``sigmas_lines``, (l,), are the sphere of each scan line and the standard
    deviation of the gimbal's angle during it [rad].
    """

    seen: Pulses
    covs: Array
    radius: float
    config: FittingConfig
    sigmas_optics: Array
    basis: Array
    spheres: Index
    sigmas_lines: Array

    def at(self, rig: Rig, optics: Array, centres: Array, errors: Array) -> _State:
        """Return the state at a rig, optics, centres and errors of lines."""
        lin = linearise(self.seen, rig, optics, (centres, self.covs), self.radius)
        residuals = lin.residuals - lin.J_angle * errors[self.seen.lines]
        return _State(rig, optics, centres, errors, lin, residuals)

    def loss(self, state: _State, sigmas: Array) -> float:
        """Return the loss of a state, with that of its optics and its lines by their priors."""
        prior = np.sum((state.optics / self.sigmas_optics) ** 2)
        prior += np.sum((state.errors / self.sigmas_lines) ** 2)
        return 0.5 * float(prior) + tukey_loss(state.residuals / sigmas, _TUKEY)

    def extra(self, state: _State) -> Array:
        """Return the noise that directions and linearisation add to each range [m]."""
        return np.asarray(
            np.hypot(self.config.sigma_direction * state.lin.slopes, state.lin.sigmas_nonlinear)
        )

    def sigmas(self, state: _State, noises: Array) -> Array:
        """Return the standard deviation of each range, given its noise [m]."""
        return np.asarray(np.hypot(noises, self.extra(state)))

    def noises(self, state: _State, before: Array) -> Array:
        """Return the noise of each return [m]: of its reflectivity, times that of its sphere."""
        which, shades, m = self.seen.which, self.seen.shades, len(state.centres)
        sigmas = self.sigmas(state, before)
        scaled = state.residuals / sigmas
        weights = tukey_weights(scaled, _TUKEY)
        unknowns = 3.0 + self.unknown_lines(state, weights / sigmas**2)
        squares = weights * (scaled * before) ** 2 / _EXPECTED_SQUARE
        counts = np.bincount(shades, weights > 0.0, N_CLASSES)
        share = max(1.0 - float(unknowns.sum()) / max(float(counts.sum()), 1.0), 0.01)
        of_all = float(squares.sum()) / max(share * float(counts.sum()), 1.0)
        by_shade = (np.bincount(shades, squares, N_CLASSES) + _DOF_NOISE * of_all) / (
            share * counts + _DOF_NOISE
        )
        dofs = np.maximum(np.bincount(which, weights > 0.0, m) - unknowns, 0.0)
        ratios = np.bincount(which, squares / by_shade[shades], m) + _DOF_NOISE
        own = by_shade[shades] * (ratios / (dofs + _DOF_NOISE))[which]
        return np.asarray(np.maximum(np.sqrt(own), _NOISE_MIN))

    def weights(self, state: _State, sigmas: Array) -> Array:
        """Return the weight of each return [1/m^2]."""
        return np.asarray(tukey_weights(state.residuals / sigmas, _TUKEY) / sigmas**2)

    def derivatives(self, state: _State) -> Array:
        """Return the derivatives of ranges by all parameters, optics and biases, (n, p)."""
        lin = state.lin
        return np.column_stack([lin.J_rig, lin.J_optics, self.basis[self.seen.rings]])

    def unknown_lines(self, state: _State, weights: Array) -> Array:
        """Return for how many unknowns the lines of each sphere count beside their prior, (m,)."""
        found = np.bincount(self.seen.lines, weights * state.lin.J_angle**2, len(self.spheres))
        shares = found / (found + self.sigmas_lines**-2.0)
        return np.asarray(np.bincount(self.spheres, shares, len(state.centres)))

    def lines(self, state: _State, J: Array, weights: Array) -> _Lines:
        """Return the normal equations of the angles of lines."""
        lines, n = self.seen.lines, len(self.spheres)
        weighted = weights * state.lin.J_angle
        columns = np.column_stack([state.lin.J_centres, J]).T
        rows = np.array([np.bincount(lines, weighted * column, n) for column in columns])
        return _Lines(
            rows.T,
            self.sigmas_lines**-2.0 + np.bincount(lines, weighted * state.lin.J_angle, n),
            np.bincount(lines, weighted * state.residuals, n) - state.errors / self.sigmas_lines**2,
        )

    def equations(self, state: _State, sigmas: Array) -> Reduced:
        """Return the normal equations of all parameters, optics and biases, in this order."""
        lin, J = state.lin, self.derivatives(state)
        weights = self.weights(state, sigmas)
        lines = self.lines(state, J, weights)
        taken = np.column_stack([lines.rows, lines.rhs]) / np.sqrt(lines.precisions)[:, None]
        equations = reduced(
            np.append(self.seen.which, self.spheres),
            np.concatenate([lin.J_centres, taken[:, :3]]),
            np.concatenate([J, taken[:, 3:-1]]),
            np.append(state.residuals, taken[:, -1]),
            np.append(weights, np.full(len(taken), -1.0)),  # what elimination takes away
        )
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
        lines = self.lines(state, self.derivatives(state), self.weights(state, sigmas))
        by_line = lines.solved(by_centre[self.spheres], steps)
        loss, trial = self.loss(state, sigmas), state
        for share in _SHARES:
            rig = moved(state.rig, share * by_rig, share * biases)
            optics, centres = state.optics + share * by_optics, state.centres + share * by_centre
            trial = self.at(rig, optics, centres, state.errors + share * by_line)
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
    the limb, which determine a centre across the line of sight, return weakly and are noisy. Errors
    of the gimbal's angle, which all pulses of a scan line share, are unknowns with the scatter of
    its samples as prior, eliminated line by line.
    """
    lasers, basis = _contrasts(seen.rings)
    sigmas_optics = np.maximum(prior_sigmas(config, rig)[:N_ESTIMATED], _SIGMA_MIN)
    firsts = np.unique(seen.lines, return_index=True)[1]
    problem = _Problem(
        *(seen, covs, radius, config, sigmas_optics, basis),
        spheres=seen.which[firsts],
        sigmas_lines=np.maximum(seen.sigmas_angle[firsts], _SIGMA_MIN),
    )
    state = problem.at(rig, np.zeros(N_ESTIMATED), centres, np.zeros(len(firsts)))
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
    cov = _EFFICIENCY * inverse(equations.N[np.ix_(adjusted, adjusted)])
    sigma_common = prior_sigmas(problem.config, state.rig)[N_ESTIMATED]
    cov = _with_common_bias(cov, equations.N[adjusted, _COMMON], sigma_common)
    of_rig = np.searchsorted(adjusted, chosen)
    J = np.zeros((n_free + len(lasers), n_free + k))
    J[:n_free, :n_free] = np.eye(n_free)
    J[n_free:, n_free:] = problem.basis[lasers]
    is_used = tukey_weights(state.residuals / sigmas, _TUKEY) > 0.0
    return Estimate(
        rig=state.rig,
        optics=state.optics,
        centres=state.centres,
        is_free=is_free,
        held=held,
        lasers=lasers,
        cov=J @ cov[np.ix_(of_rig, of_rig)] @ J.T,
        is_used=is_used,
        dof=int(is_used.sum()) - 3 * len(state.centres) - len(adjusted),
        basis=J,
        weights=_without_others(equations.N, chosen) / _EFFICIENCY,
        effects=equations.gains[:, :, chosen],
        cov_centres=_EFFICIENCY * equations.own,
    )


def _with_common_bias(cov: Array, across: Array, sigma: float) -> Array:
    """Return a covariance with what the common range bias, which is held, adds to it (Schmidt).

    ``across`` is the normal matrix between it and the unknowns, ``sigma`` its prior [m].
    """
    moved = sigma / _EFFICIENCY * (cov @ across)
    return np.asarray(cov + np.outer(moved, moved))


def _without_others(N: Array, chosen: Index) -> Array:
    """Return the normal matrix of some unknowns, optics and the common range bias eliminated.

    The apparent size of near spheres would determine that bias too, but depends on the profile of
    the beams.
    """
    others = np.append(np.arange(len(GIMBAL) + N_ESTIMATED)[_OPTICS], _COMMON)
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
