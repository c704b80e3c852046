"""The noise of single ranges, estimated from any log, simulated or real."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from spheremark.pipelines.model import Array, Index, Rings, seal
from spheremark.pipelines.scan.rigs import FIRING_CYCLE

REFLECTIVITY_BINS = (1.0, 5.0, 15.0, 40.0, 100.0, 256.0)
"""Edges within which the noise of ranges is given."""

_RUN = 12  # pulses of one laser in a row
_DOF = _RUN - 3  # once the parabola is taken off
_MEDIAN = float(np.sqrt(chdtri(_DOF, 0.5) / _DOF))  # of the estimates of a sigma of 1, if normal
_N_RUNS_MIN = 30  # for an estimate of the noise
_STEP_MAX = 0.10  # [m] off the parabola: more is an edge
_SIMILAR = 0.2  # relative difference of reflectivity within one surface


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RangeNoise:
    """Noise of single ranges by reflectivity.

    Attributes
    ----------
    sigmas : (k,)
        Standard deviation in each of ``REFLECTIVITY_BINS``; NaN where too little was seen [m].
    n : (k,)
        Number of runs of pulses behind each.
    """

    sigmas: Array
    n: Index

    def __post_init__(self) -> None:
        k = len(REFLECTIVITY_BINS) - 1
        seal(self, sigmas=(k,), n=(k,))


def range_noise(
    ranges: ArrayLike, rings: Rings, offsets_ns: ArrayLike, intensities: ArrayLike
) -> RangeNoise:
    """Estimate the noise of single ranges from neighbouring pulses of each laser.

    Parameters
    ----------
    ranges : (n,)
        Measured distances [m].
    rings : (n,)
        Laser of each pulse.
    offsets_ns : (n,)
        Instants of the pulses since any start [ns].
    intensities : (n,)
        Reflectivity, 0-255.

    Returns
    -------
    RangeNoise
        By reflectivity.

    Notes
    -----
    A parabola, which holds slope and curvature, is subtracted from each run of twelve pulses of one
    laser on one surface (equal reflectivity within a fifth). The estimate is the median over runs
    of the standard deviation of the rest, over that median for normal noise of 1: with nine degrees
    of freedom 4 % less. A run is long enough for noise that is not white: ranges of a real VLP-16
    oscillate over five or six pulses.
    """
    seconds = np.asarray(offsets_ns, dtype=np.float64) * 1e-9
    order = np.lexsort((seconds, rings))
    firings, lasers = np.round(seconds[order] / FIRING_CYCLE), np.asarray(rings)[order]
    starts = np.arange(0, len(order) - _RUN, _RUN)
    ends = starts + _RUN - 1
    is_run = (firings[ends] - firings[starts] == _RUN - 1) & (lasers[ends] == lasers[starts])
    runs = order[starts[is_run][:, None] + np.arange(_RUN)]
    shades = np.asarray(intensities, dtype=np.float64)[runs]
    middle = np.median(shades, axis=1)
    rest = np.asarray(ranges, dtype=np.float64)[runs] @ _without_parabola()
    is_alike = (np.abs(shades - middle[:, None]) <= _SIMILAR * middle[:, None] + 1.0).all(axis=1)
    is_good = is_alike & (np.abs(rest).max(axis=1) < _STEP_MAX)
    places = np.digitize(middle[is_good], REFLECTIVITY_BINS) - 1
    sigmas = np.sqrt(np.sum(rest[is_good] ** 2, axis=1) / _DOF)
    samples = [sigmas[places == k] for k in range(len(REFLECTIVITY_BINS) - 1)]
    return RangeNoise(
        sigmas=np.array(
            [np.median(s) / _MEDIAN if len(s) >= _N_RUNS_MIN else np.nan for s in samples]
        ),
        n=np.array([len(s) for s in samples], dtype=np.intp),
    )


def _without_parabola() -> Array:
    """Return the projection that subtracts the best parabola from a run, (12, 12)."""
    powers = np.vander(np.linspace(-1.0, 1.0, _RUN), 3)
    return np.asarray(np.eye(_RUN) - powers @ np.linalg.pinv(powers))
