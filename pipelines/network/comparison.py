"""A network against truth, without the datum."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from spheremark.pipelines.errors import TruthError
from spheremark.pipelines.geometry import rigid, skew, transform
from spheremark.pipelines.model import Array, Index, Mask, Truth
from spheremark.pipelines.model.network import AdjustedNetwork, seal

_NEAR = 0.15  # [m] a mark of a network may be from the true mark that it is
_N_DATUM = 6  # place and attitude, which only control and levelling give
_N_MARKS = 3
SIGMA_GIVEN = 1e-4  # [m] 3-D sigma below which a mark was given, not found


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class NetworkErrors:
    """Errors of a network after the motion that lays its marks best on the true ones.

    Attributes
    ----------
    marks : (m,)
        The true mark of each mark; -1 for none, which is false.
    error_marks : (m, 3)
        Estimate minus truth in the network's own frame [m]; NaN for a false one.
    stations : (s,) bool
        Whether the truth of each station is known.
    error_stations : (s, 3)
        Estimate minus truth, moved with the marks [m]; NaN where it is unknown.
    nees_marks, nees_stations : float
        Normalised squared error per degree of freedom, all together with their joint covariance,
        place and attitude projected out; about 1 where the covariance is honest. Without the marks
        that were given as exact; NaN where too few are left.
    """

    marks: Index
    error_marks: Array
    stations: Mask
    error_stations: Array
    nees_marks: float
    nees_stations: float

    def __post_init__(self) -> None:
        m, s = len(self.marks), len(self.stations)
        shapes = {"marks": (m,), "error_marks": (m, 3), "stations": (s,), "error_stations": (s, 3)}
        seal(self, dict(shapes))

    @property
    def rms_marks(self) -> float:
        """Root mean square 3-D error of the marks [m]."""
        return float(np.sqrt(np.nanmean(np.sum(self.error_marks**2, axis=1))))

    @property
    def rms_stations(self) -> float:
        """Root mean square 3-D error of the stations [m]."""
        return float(np.sqrt(np.nanmean(np.sum(self.error_stations**2, axis=1))))


def compare(result: AdjustedNetwork, truth: Truth) -> NetworkErrors:
    """Compare a network with the truth of its survey.

    Parameters
    ----------
    result : AdjustedNetwork
        The network.
    truth : Truth
        True marks, and poses of its stations by name.

    Returns
    -------
    NetworkErrors
        Errors without the datum.

    Raises
    ------
    TruthError
        If fewer than three marks or stations are in it.
    """
    T_true = {stop.name: stop.T_site_base for stop in truth.stops}
    is_known = np.array([name in T_true for name in result.network.stations])
    marks = _true_marks(result, truth, T_true)
    found = np.flatnonzero(marks >= 0)
    if len(found) < _N_MARKS or is_known.sum() < 1:
        raise TruthError(
            f"{len(found)} marks and {int(is_known.sum())} stations of the network are in the "
            "truth; three marks and one station are needed."
        )
    p_true = truth.marks.p_site[marks[found]]
    back = _motion(p_true, result.p_site[found])
    error_marks = np.full((len(marks), 3), np.nan)
    error_marks[found] = result.p_site[found] - transform(back, p_true)
    p = result.T_site_station[:, :3, 3]
    error_stations = np.full(p.shape, np.nan)
    goals = [T_true[n][:3, 3] for n in result.network.stations if n in T_true]
    error_stations[is_known] = p[is_known] - transform(back, np.array(goals))
    joint, s = result.cov_positions, len(p)
    is_open = np.trace(result.mark_covariances[found], axis1=1, axis2=2) > SIGMA_GIVEN**2
    return NetworkErrors(
        marks=marks,
        error_marks=error_marks,
        stations=is_known,
        error_stations=error_stations,
        nees_marks=_nees(error_marks, result.p_site, joint[3 * s :, 3 * s :], found[is_open]),
        nees_stations=_nees(error_stations, p, joint, np.flatnonzero(is_known)),
    )


def _true_marks(result: AdjustedNetwork, truth: Truth, T_true: dict[str, Array]) -> Index:
    """Return which true mark each mark is, as its true stations see it."""
    votes = np.zeros((len(result.p_site), len(truth.marks.names)), dtype=np.intp)
    for (station, mark), p_base in zip(result.network.sightings, result.p_base, strict=True):
        name = result.network.stations[station]
        if name not in T_true:
            continue
        off = np.linalg.norm(truth.marks.p_site - transform(T_true[name], p_base), axis=1)
        votes[mark, off.argmin()] += off.min() < _NEAR
    return np.where(votes.any(axis=1), votes.argmax(axis=1), -1)


def _motion(p: Array, goals: Array) -> Array:
    """Return the rigid motion that lays points best on others."""
    middle, goal = p.mean(axis=0), goals.mean(axis=0)
    R = Rotation.align_vectors(goals - goal, p - middle)[0].as_matrix()
    return rigid(R, goal - R @ middle)


def _nees(errors: Array, p: Array, cov: Array, chosen: Index) -> float:
    """Return the normalised squared error of points without their motion together; NaN if none."""
    n = len(chosen)
    if 3 * n <= _N_DATUM:
        return float("nan")
    rows = (3 * chosen[:, None] + np.arange(3)).ravel()
    turns = -skew(p[chosen] - p[chosen].mean(axis=0))
    motions = np.concatenate([turns, np.tile(np.eye(3), (n, 1, 1))], axis=2).reshape(
        3 * n, _N_DATUM
    )
    left = np.linalg.qr(motions, mode="complete").Q[:, _N_DATUM:]
    e, own = left.T @ errors[chosen].ravel(), left.T @ cov[np.ix_(rows, rows)] @ left
    return float(e @ np.linalg.solve(own, e) / len(e))
