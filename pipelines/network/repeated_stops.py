"""Stops that were made twice: two scans of one place, compared."""

from __future__ import annotations

import numpy as np

from spheremark.pipelines.geometry import skew
from spheremark.pipelines.model import Array, Index
from spheremark.pipelines.model.network import AdjustedNetwork, Repeat

_NEAR = 0.5  # [m] within which two stations stand at the same stop
_N_MARKS = 3  # that both must see


def repeated_stops(result: AdjustedNetwork) -> tuple[Repeat, ...]:
    """Compare the stations of a network that stand within half a metre of each other.

    Parameters
    ----------
    result : AdjustedNetwork
        The network.

    Returns
    -------
    tuple of Repeat
        One for each two stations that share at least three marks.
    """
    p = result.T_site_station[:, :3, 3]
    found = []
    for first in range(len(p)):
        near = np.linalg.norm(p[first + 1 :] - p[first], axis=1) < _NEAR
        for second in first + 1 + np.flatnonzero(near):
            repeat = _compared(result, first, int(second))
            if repeat is not None:
                found.append(repeat)
    return tuple(found)


def _compared(result: AdjustedNetwork, first: int, second: int) -> Repeat | None:
    """Compare two stations, if they share marks enough."""
    rows = [_rows(result, station) for station in (first, second)]
    marks = [result.network.sightings[one, 1] for one in rows]
    both, *places = np.intersect1d(*marks, return_indices=True)
    if len(both) < _N_MARKS:
        return None
    (p, cov_p), (q, cov_q) = (
        _in_site(result, station, one[place])
        for station, one, place in zip((first, second), rows, places, strict=True)
    )
    gaps, cov = (q - p).ravel(), cov_p + cov_q
    motions = np.concatenate(
        [-skew(p - p.mean(axis=0)), np.tile(np.eye(3), (len(p), 1, 1))], axis=2
    )
    basis = np.linalg.qr(motions.reshape(len(gaps), 6)).Q
    left = gaps - basis @ (basis.T @ gaps)
    whole = np.zeros((len(p), 3, len(p), 3))
    whole[np.arange(len(p)), :, np.arange(len(p)), :] = cov
    variance = np.trace(cov.sum(axis=0)) - np.trace(basis.T @ whole.reshape(len(gaps), -1) @ basis)
    return Repeat(
        stations=(first, second),
        apart=result.T_site_station[second, :3, 3] - result.T_site_station[first, :3, 3],
        n_marks=len(both),
        rms=float(np.sqrt(left @ left / len(p))),
        predicted_rms=float(np.sqrt(variance / len(p))),
    )


def _rows(result: AdjustedNetwork, station: int) -> Index:
    """Return the centres of a station that are used."""
    n = len(result.network.sightings)
    return np.flatnonzero((result.network.sightings[:, 0] == station) & result.used[:n])


def _in_site(result: AdjustedNetwork, station: int, rows: Index) -> tuple[Array, Array]:
    """Return some centres of a station with covariances, in the site frame."""
    T = result.T_site_station[station]
    R = T[:3, :3] @ result.network.R_station_base[station]
    return (
        np.asarray(result.p_base[rows] @ R.T + T[:3, 3]),
        np.asarray(R @ result.network.cov_p_base[rows] @ R.T),
    )
