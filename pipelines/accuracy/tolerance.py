"""Up to which distance errors keep a tolerance, from counts in bins of distance, with confidence.

No model of the errors: each bin of distance has a share of errors within the tolerance, and the
errors of one scan are taken as dependent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spheremark.pipelines.model import Array, same_length, seal

SHARE = 0.95  # of the errors must be within the tolerance: its 95th percentile is
CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class DistanceBins:
    """Errors within a tolerance in bins of distance, nearest first.

    Attributes
    ----------
    farthest : (b,)
        Greatest distance in each bin [m].
    n, n_within : (b,)
        Errors, and those within the tolerance.
    n_scans : (b,)
        Scans with an error in the bin.
    kk, kn, nn : (b,)
        Sums over the scans of the squares and the product of their numbers: k within, n in all.
    """

    farthest: Array
    n: Array
    n_within: Array
    n_scans: Array
    kk: Array
    kn: Array
    nn: Array

    def __post_init__(self) -> None:
        names = ("farthest", "n", "n_within", "n_scans", "kk", "kn", "nn")
        seal(self, **dict.fromkeys(names, (None,)))
        same_length(self, *names)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ToleranceReach:
    """How far a tolerance is kept.

    Attributes
    ----------
    estimate : float
        End of the last bin up to which each share is at least 95 %; 0 where the nearest is not [m].
    confident : float
        The same for the lower bounds of the shares; 0 where the nearest is not [m].
    shares, lower : (b,)
        Share within the tolerance in each bin, and its lower bound.
    scans_needed : int
        Scans that a bin needs at least, all of their errors within the tolerance.
    """

    estimate: float
    confident: float
    shares: Array
    lower: Array
    scans_needed: int


def tolerance_reach(bins: DistanceBins) -> ToleranceReach:
    """Return how far 95 % of the errors are within a tolerance, with 95 % confidence.

    Parameters
    ----------
    bins : DistanceBins
        Counts of one method, at least one bin.

    Returns
    -------
    ToleranceReach
        Distance by the shares themselves, and by their lower bounds.

    Notes
    -----
    One-sided bounds of Korn and Graubard (1998): those of Clopper and Pearson with the sample size
    divided by the design effect of the clusters (scans). Where all errors are within, each scan
    counts once: the data do not show how dependent its errors are. The bins are tested from the
    nearest outwards up to the first that fails, which keeps the error rate of a single test.
    """
    shares = bins.n_within / bins.n
    lower = _lower_bounds(bins, shares)
    return ToleranceReach(
        estimate=_reach(bins, shares),
        confident=_reach(bins, lower),
        shares=shares,
        lower=lower,
        scans_needed=int(np.ceil(np.log(1.0 - CONFIDENCE) / np.log(SHARE))),
    )


def _reach(bins: DistanceBins, shares: Array) -> float:
    """Return the end of the unbroken run of sufficient shares from the nearest bin."""
    n_kept = int(np.argmin(np.append(shares >= SHARE, False)))
    return float(bins.farthest[n_kept - 1]) if n_kept else 0.0


def _lower_bounds(bins: DistanceBins, shares: Array) -> Array:
    """Return the lower confidence bounds of clustered shares."""
    from scipy.stats import beta, t  # slow to import

    m = bins.n_scans
    squares = bins.kk - 2.0 * shares * bins.kn + shares**2 * bins.nn
    variances = squares / bins.n**2 * m / np.maximum(m - 1.0, 1.0)
    spread = shares * (1.0 - shares)
    known = (variances > 0) & (m > 1)
    sizes = np.where(known, spread / np.where(known, variances, 1.0), m)
    ratio = t.ppf(CONFIDENCE, np.maximum(bins.n - 1.0, 1.0)) / t.ppf(
        CONFIDENCE, np.maximum(m - 1.0, 1.0)
    )
    sizes = np.minimum(np.where(known, sizes * ratio**2, m), bins.n)
    inside = shares * sizes
    found = beta.ppf(1.0 - CONFIDENCE, np.maximum(inside, 1e-9), sizes - inside + 1.0)
    return np.asarray(np.where(inside > 0, found, 0.0))
