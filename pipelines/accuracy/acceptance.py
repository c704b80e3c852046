"""Whether the stated uncertainty of a survey holds, and whether the survey is accepted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from spheremark.pipelines.accuracy.probability import keeps_tolerance
from spheremark.pipelines.model import Array, Index

LEVEL = 0.95  # of the interval by chance
_GRADES = {
    "accepted": "accepted",
    "weak": "accepted with reservations",
    "refused": "not accepted",
    "none": "not accepted",
}
_DATUM = 4  # coordinates of control that position and heading of a network use up


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """Errors or residuals of one kind of result over their sigmas.

    Attributes
    ----------
    what : str
        centres, stations or control.
    measure : str
        What is compared: error against truth, residual, or difference when left out in turn.
    n : int
        Compared positions.
    ratio : float or None
        Root mean square of error over sigma in each coordinate; 1 is expected; None if unknown.
    low, high : float or None
        Interval of the ratio by chance, with a probability of 95 %, for sigmas that hold.
    rms, largest : float
        Root mean square and maximum of the lengths [m].
    where : str
        Position of the largest.
    """

    what: str
    measure: str
    n: int
    ratio: float | None
    low: float | None
    high: float | None
    rms: float
    largest: float
    where: str

    @property
    def is_within(self) -> bool | None:
        """Whether the ratio is in the interval; None if there is no ratio."""
        if self.ratio is None or self.low is None or self.high is None:
            return None
        return self.low <= self.ratio <= self.high

    @property
    def excess(self) -> str:
        """The ratio beside its upper limit by chance, where it is above that; else empty."""
        if self.ratio is None or self.high is None or self.ratio <= self.high:
            return ""
        return f"{self.ratio:.2f} times its sigma (RMS); by chance at most {self.high:.2f}"


class Compared(NamedTuple):
    """Vectors of error or residual by name, (n, 3) [m]."""

    names: Sequence[str]
    vectors: Array


class Lengths(NamedTuple):
    """Number, root mean square and maximum of lengths [m], and where the maximum is."""

    n: int
    rms: float
    largest: float
    where: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Decision:
    """The decision on a survey, with its reasons where it is not accepted."""

    status: str
    sentence: str
    reasons: tuple[str, ...] = ()

    @property
    def grade(self) -> str:
        """The decision in words."""
        return _GRADES[self.status]

    @property
    def summary(self) -> str:
        """The sentence without the decision itself."""
        return self.sentence.rpartition(": ")[0] or self.sentence


@dataclass(frozen=True, slots=True, kw_only=True)
class SolutionQuality:
    """What the decision on a survey depends on.

    Attributes
    ----------
    stations : sequence of str
        Names of the stations with coordinates.
    covariances : (n, 3, 3)
        Covariances of their positions [m^2].
    failed : sequence of str
        Stations whose global test fails; all of a network that fails.
    missing : sequence of str
        Stops without a position in the solution.
    control : Check or None
        The check of control.
    warnings : sequence of str
        Weaknesses of the solution.
    is_free : bool
        Whether the solution has no control.
    """

    stations: Sequence[str]
    covariances: Array
    failed: Sequence[str] = ()
    missing: Sequence[str] = ()
    control: Check | None = None
    warnings: Sequence[str] = field(default=())
    is_free: bool = False


def by_chance(dof: float) -> tuple[float, float]:
    """Return the interval of a root mean square of errors over sigmas by chance.

    Parameters
    ----------
    dof : float
        Number of independent coordinates.

    Returns
    -------
    tuple of float
        Its ends, with a probability of 95 % in between (chi-square).
    """
    tail = (1.0 - LEVEL) / 2.0
    low, high = (math.sqrt(chdtri(dof, share) / dof) for share in (1.0 - tail, tail))
    return low, high


def lengths_of(compared: Compared) -> Lengths:
    """Return number, root mean square and maximum of the lengths of vectors.

    Parameters
    ----------
    compared : Compared
        One vector at least.

    Returns
    -------
    Lengths
        With the name of the longest.
    """
    lengths = np.linalg.norm(compared.vectors, axis=1)
    worst = int(lengths.argmax())
    rms = float(np.sqrt(np.mean(np.square(lengths))))
    return Lengths(len(lengths), rms, float(lengths[worst]), compared.names[worst])


def check_of(what: str, measure: str, lengths: Lengths, ratio: float, dof: float) -> Check:
    """Return a check whose ratio and independent coordinates are known.

    Parameters
    ----------
    what, measure : str
        See ``Check``.
    lengths : Lengths
        Number and size of the errors or residuals.
    ratio : float
        Root mean square over sigma; NaN if unknown.
    dof : float
        Independent coordinates, or the redundancy; below 1 there is no interval.

    Returns
    -------
    Check
        With the interval by chance where there is one.
    """
    known = math.isfinite(ratio) and dof >= 1.0
    low, high = by_chance(dof) if known else (None, None)
    kept = ratio if known else None
    return Check(what=what, measure=measure, ratio=kept, low=low, high=high, **lengths._asdict())


def check_errors(what: str, compared: Compared, covariances: Array, dof: float) -> Check:
    """Return the check of errors against truth.

    Parameters
    ----------
    what : str
        See ``Check``.
    compared : Compared
        The errors.
    covariances : (n, 3, 3)
        Their covariances.
    dof : float
        Independent coordinates among them: see ``independent_coordinates``.

    Returns
    -------
    Check
        Its ratio is the root mean square per coordinate of the whitened errors.
    """
    solved = np.linalg.solve(covariances, compared.vectors[..., None])[..., 0]
    squares = np.sum(compared.vectors * solved, axis=1)
    ratio = float(np.sqrt(np.mean(squares) / 3.0))
    return check_of(what, "error against truth", lengths_of(compared), ratio, dof)


def check_control(names: Sequence[str], differences: Array, sigmas: Array) -> Check:
    """Return the check of control marks that were left out in turn.

    Parameters
    ----------
    names : sequence of str
        The marks.
    differences, sigmas : (n, 3)
        Predicted minus given, and its standard deviations along the axes [m].

    Returns
    -------
    Check
        Of its 3 n coordinates four determine position and heading.
    """
    ratio = float(np.sqrt(np.mean(np.square(differences / sigmas))))
    measure = "difference when left out in turn"
    lengths = lengths_of(Compared(names, differences))
    return check_of("control", measure, lengths, ratio, max(3 * len(names) - _DATUM, 1))


def independent_coordinates(covariances: Array, shared: Array, scans: Index) -> float:
    """Return how many independent coordinates errors with shared parts are worth.

    Parameters
    ----------
    covariances : (n, 3, 3)
        Covariances of the errors.
    shared : (n, k, 3)
        Effects of errors that all positions of a scan share, one sigma each; they are part of the
        covariances.
    scans : (n,)
        Scan of each position.

    Returns
    -------
    float
        At most 3 n.

    Notes
    -----
    The sum of squares of the whitened errors has the mean 3 n and the variance 2 (3 n + s), s being
    the squared norm of all correlations between different positions; it is that of a scaled
    chi-square distribution of (3 n)^2 / (3 n + s) degrees of freedom (Satterthwaite, 1946).
    """
    roots = np.linalg.inv(np.linalg.cholesky(covariances))
    white = np.einsum("nij,nkj->nki", roots, shared)
    products = np.einsum("nki,nli->nkl", white, white)  # |a_i a_j^T + ...|^2 factorises into these
    total = -float(np.sum(np.square(products)))
    for scan in np.unique(scans):
        total += float(np.sum(np.square(products[scans == scan].sum(axis=0))))
    n = 3.0 * len(covariances)
    return n * n / (n + total)


def decide(quality: SolutionQuality, tolerance: float) -> Decision:
    """Return whether a survey is accepted.

    Parameters
    ----------
    quality : SolutionQuality
        The stations and their tests.
    tolerance : float
        Accepted 3-D error, which 95 % of the errors must keep [m].

    Returns
    -------
    Decision
        accepted; weak where a warning or a missing stop remains; refused where a test fails, a
        station is too uncertain, or control differs by more than the tolerance.
    """
    n = len(quality.stations)
    if not n:
        return Decision(status="none", sentence="No station has a position yet")
    refused, weak = _refusals(quality, tolerance), _weaknesses(quality)
    status = "refused" if refused else "weak" if weak else "accepted"
    sigma = float(np.sqrt(np.mean(np.trace(quality.covariances, axis1=1, axis2=2))))
    size = "no valid sigma" if quality.failed else f"{1e3 * sigma:.1f} mm (3-D sigma, RMS)"
    return Decision(
        status=status,
        sentence=f"{_counted(n, 'station')}, {size}, {_control_words(quality)}: {_GRADES[status]}",
        reasons=(*refused, *weak),
    )


def rule(tolerance: float) -> str:
    """Return the rule of ``decide`` as a sentence.

    Parameters
    ----------
    tolerance : float
        Accepted 3-D error [m].

    Returns
    -------
    str
        The rule.
    """
    return (
        "Accepted where the global test passes, each station is within "
        f"{1e3 * tolerance:g} mm (3-D) with a probability of 95 % or more by its covariance, the "
        "largest difference at control is within the same, and nothing is weak or missing."
    )


def _refusals(quality: SolutionQuality, tolerance: float) -> list[str]:
    """Return why a survey cannot be accepted."""
    found = []
    if quality.failed:
        found.append(
            f"The global test fails at {_list(quality.failed)}: residuals are larger than the "
            "sigmas allow, so these sigmas are not valid."
        )
    kept = keeps_tolerance(quality.covariances, tolerance)
    wide = [name for name, is_kept in zip(quality.stations, kept, strict=True) if not is_kept]
    if wide:
        found.append(
            f"{_list(wide)}: errors are within the tolerance of {1e3 * tolerance:g} mm with a "
            "probability below 95 %."
        )
    control = quality.control
    if control is not None and control.largest > tolerance:
        found.append(
            f"Control differs by {1e3 * control.largest:.1f} mm at {control.where}, more than the "
            f"tolerance of {1e3 * tolerance:g} mm."
        )
    return found


def _weaknesses(quality: SolutionQuality) -> list[str]:
    """Return what remains to be done or known of a survey."""
    found = list(quality.warnings)
    if quality.missing:
        found.append(f"No position in this solution: {_list(quality.missing)}.")
    if quality.control is not None and quality.control.excess:
        found.append(f"Control differs by {quality.control.excess}.")
    return found


def _control_words(quality: SolutionQuality) -> str:
    """Return how control is met."""
    if quality.control is not None:
        return f"control met to {1e3 * quality.control.largest:.1f} mm (largest)"
    return "no control" if quality.is_free else "control not checked"


def _counted(n: int, what: str) -> str:
    """Return a number of things."""
    return f"{n} {what}{'' if n == 1 else 's'}"


def _list(names: Sequence[str], most: int = 5) -> str:
    """Return names as text, the first few of many."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
