"""What a calibration gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from spheremark.pipelines.calibration.estimation import Inseparable
from spheremark.pipelines.calibration.gimbal import GIMBAL, moved
from spheremark.pipelines.model import Array, MarkerFits, Rig, seal

BIAS = "laser_range_bias_"
"""How the names of laser range biases begin."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Scan:
    """The centres of one stop, adjusted together with the rig.

    Attributes
    ----------
    fits : MarkerFits
        All centres; those that were adjusted have covariances as if the rig were known.
    effects : (n, 3, k)
        How much each unknown of the rig that is wrong moves each of them.
    """

    fits: MarkerFits
    effects: Array

    def __post_init__(self) -> None:
        seal(self, effects=(len(self.fits.fits), 3, self.effects.shape[2]))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Calibration:
    """A rig estimated from scans, with its uncertainty.

    Attributes
    ----------
    rig : Rig
        The estimated rig; what was held is as in the start rig.
    start : Rig
        The rig that it began with.
    names : tuple of str
        Estimated parameters.
    units : tuple of str
        Their units.
    start_values, estimates : (p,)
        Their values in the two rigs.
    cov : (p, p)
        Covariance of the estimates; singular, because the mean of the laser biases is held.
    inseparable : tuple of Inseparable
        Parameters that the scans do not determine, with reasons.
    stops : tuple of str
        Names of the stops that were used.
    n_spheres : int
        Spheres, each counted at every stop that saw it.
    n_two_faced : int
        Those of them that were seen on both faces.
    n_returns : int
        Returns that the estimate rests on.
    dof : int
        Returns minus unknowns.
    sigma0 : float
        Square root of the a-posteriori variance factor; 1 means that ranges are as noisy as a
        VLP-16's usually are. The covariance rests on the noise as it is.
    rms_before, rms_after : float
        Root mean square residual of the same returns with the start rig and with the estimated
        one, the centres adjusted to either [m].
    basis : (p, k)
        The parameters by independent unknowns: biases of lasers have their mean held.
    weights : (k, k)
        Normal matrix of those unknowns, the common range bias eliminated.
    scans : mapping of str to Scan
        The centres of each stop, adjusted together with the rig.
    """

    rig: Rig
    start: Rig
    names: tuple[str, ...]
    units: tuple[str, ...]
    start_values: Array
    estimates: Array
    cov: Array
    inseparable: tuple[Inseparable, ...]
    stops: tuple[str, ...]
    n_spheres: int
    n_two_faced: int
    n_returns: int
    dof: int
    sigma0: float
    rms_before: float
    rms_after: float
    basis: Array
    weights: Array
    scans: Mapping[str, Scan]

    def __post_init__(self) -> None:
        p, k = self.basis.shape
        seal(self, start_values=(p,), estimates=(p,), cov=(p, p), weights=(k, k))

    @property
    def unknowns(self) -> tuple[str, ...]:
        """Names of the independent unknowns, of which the parameters are combinations."""
        n_free = sum(not name.startswith(BIAS) for name in self.names)
        contrasts = range(1, self.basis.shape[1] - n_free + 1)
        return (*self.names[:n_free], *(f"{BIAS}contrast_{k}" for k in contrasts))

    def adjusted(self, stop: str, fits: MarkerFits) -> MarkerFits:
        """Return the centres of a stop as they were adjusted together with the rig.

        Parameters
        ----------
        stop : str
            Name of the stop.
        fits : MarkerFits
            What to return where the calibration did not see the stop.

        Returns
        -------
        MarkerFits
            Centres with the covariances that they would have if the rig were known.
        """
        return self.scans[stop].fits if stop in self.scans else fits

    def effects(self, stop: str, fit: int) -> Array:
        """Return how an unknown that is wrong moves a centre.

        Parameters
        ----------
        stop : str
            Name of the stop.
        fit : int
            Place among its centres.

        Returns
        -------
        (3, k)
            Derivative of the centre; zero where the calibration did not use it.
        """
        if stop not in self.scans:
            return np.zeros((3, self.basis.shape[1]))
        return np.asarray(self.scans[stop].effects[fit])

    def corrected(self, changes: Array, cov: Array) -> Calibration:
        """Return the calibration after a correction of the rig.

        Parameters
        ----------
        changes : (k,)
            What to add to the independent unknowns.
        cov : (k, k)
            Their covariance then.

        Returns
        -------
        Calibration
            With another rig, estimates and covariance; the rest is that of the scans alone.
        """
        steps = dict(zip(self.names, self.basis @ changes, strict=True))
        biases = np.zeros_like(self.rig.laser_range_biases)
        for k in range(len(biases)):
            biases[k] = steps.get(f"{BIAS}{k}", 0.0)
        by_gimbal = np.array([steps.get(parameter.name, 0.0) for parameter in GIMBAL])
        return replace(
            self,
            rig=moved(self.rig, by_gimbal, biases),
            estimates=self.estimates + self.basis @ changes,
            cov=self.basis @ cov @ self.basis.T,
        )
