"""How well the angles of a gimbal are known between their samples."""

from __future__ import annotations

import numpy as np

from spheremark.pipelines.model import Array, Column, Index, Mask, Timed

_N_SAMPLES = 10  # of the gimbal's angle, from which their scatter is known
# times that scatter: changes of the slope at both samples, and at each; they scatter by 3 times it
_CORNER, _NOISE = 12.0, 3.0
_SLOW = 0.25  # share of the samples, at least, at which a gimbal that goes by steps rests
_SLOWER = 2.0  # times the greatest speed of as many: up to this it is slow
_WITHIN, _NORMAL = 0.95, 1.96  # share of normal numbers within so many standard deviations


def scatter_of_angles(angles: Timed | Column, unknown: float) -> float:
    """Return how far interpolated angles of a gimbal scatter, from samples between neighbours.

    Parameters
    ----------
    angles : Timed or (n,)
        Angles of the gimbal [rad].
    unknown : float
        What to return where there are no samples [rad].

    Returns
    -------
    float
        Standard deviation [rad].

    Notes
    -----
    By the samples where the gimbal is slow: one that goes by steps starts and stops elsewhere.
    """
    if not isinstance(angles, Timed) or len(angles.values) < _N_SAMPLES:
        return unknown
    times, values = angles.samples_ns.astype(np.float64), angles.values
    shares = (times[1:-1] - times[:-2]) / (times[2:] - times[:-2])
    off = values[1:-1] - values[:-2] - shares * (values[2:] - values[:-2])
    off = np.abs(off[_is_slow((values[2:] - values[:-2]) / (times[2:] - times[:-2]))])
    # of noise s the difference has 1.5 s^2, and an angle between two samples 2/3 s^2 in the mean
    return 2.0 / 3.0 * float(np.quantile(off, _WITHIN)) / _NORMAL


def _is_slow(speeds: Array) -> Mask:
    """Return where a gimbal rests, if it goes by steps; most of an even turn."""
    return np.asarray(np.abs(speeds) <= _SLOWER * np.nanquantile(np.abs(speeds), _SLOW))


def speeds_of(angles: Timed | Column, rows: Index) -> Array:
    """Return the angular speeds of a gimbal at some returns.

    Parameters
    ----------
    angles : Timed or (n,)
        Angles of the gimbal [rad].
    rows : (k,)
        Rows of some returns.

    Returns
    -------
    (k,)
        Between two samples of the angle [rad/s]; zero where there are no samples.
    """
    if not isinstance(angles, Timed):
        return np.zeros(len(rows))
    k = np.searchsorted(angles.samples_ns, angles.stamps_ns[rows], side="right") - 1
    return np.asarray(np.nan_to_num(angles.rates[k] * 1e9))


def errors_of_interpolation(angles: Timed | Column, rows: Index) -> Array:
    """Return by how much interpolated angles may be off where the gimbal's speed changes.

    Parameters
    ----------
    angles : Timed or (n,)
        Angles of the gimbal [rad].
    rows : (k,)
        Rows of some returns.

    Returns
    -------
    (k,)
        Largest errors [rad]; zero where samples show no change beyond their scatter.

    Notes
    -----
    Where the gimbal starts or stops between two samples, the speeds before and after them meet in a
    corner, which a straight line between them cuts off: at 1.7 rad/s and 100 samples in a second
    up to 4 mrad. With changes ``a`` and ``b`` of the speed at the two samples, the line is off by
    the smaller of ``a`` times the time since the one and ``b`` times the time to the other.
    """
    if not isinstance(angles, Timed) or len(angles.values) < _N_SAMPLES:
        return np.zeros(len(rows))
    samples, stamps = angles.samples_ns, angles.stamps_ns[rows]
    jumps = np.zeros(len(samples))
    jumps[1:-1] = np.diff(angles.rates[:-1])  # there is no speed after the last sample
    k = np.clip(np.searchsorted(samples, stamps, side="right") - 1, 0, len(samples) - 2)
    sides = np.stack([stamps - samples[k], samples[k + 1] - stamps]).astype(np.float64)
    changes = np.stack([jumps[k], jumps[k + 1]])
    bends = changes * (samples[k + 1] - samples[k])
    is_corner = np.prod(np.sign(bends), axis=0) > 0.0
    sizes, scatter = np.abs(bends), scatter_of_angles(angles, 0.0)
    is_corner &= (sizes.sum(axis=0) > _CORNER * scatter) & (sizes.min(axis=0) > _NOISE * scatter)
    return np.where(is_corner, np.min(np.abs(changes) * np.maximum(sides, 0.0), axis=0), 0.0)
