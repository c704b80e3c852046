"""How late the angles of a gimbal are that goes by steps, by the spheres of a scan.

A resting gimbal shows a sphere in its place; a turning one shows it displaced by its speed times
how late it is. Hides the least squares, and how a scan is corrected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from spheremark.pipelines.model import Array, Column, MarkerCandidate, StitchedCloud, Timed

_NS = 1e-9  # [s] in a nanosecond
_SIGMA = 0.01  # [s] standard deviation of how late angles are, before anything is seen
_N_ROUNDS, _FARTHEST = 10, 0.002  # of the least squares, and the longest step of one [s]
_WITHIN = 5e-4  # [s] before and after, between which the speed of the gimbal is taken
_ROBUST, _LEAST_SCATTER = 2.5, 1e-4  # scatters from which a return counts less; least one [m]
_HELD = 1e-3  # share of the information that holds a centre where no return shows it
_CERTAIN = 5.0  # standard deviations
_FAST = 0.9  # share of the returns on a sphere that are slower than its fast ones
_SEEN = 1e-3  # [rad] that the fast ones are turned by, at least: less is within a beam


def late_by(cloud: StitchedCloud, spheres: Sequence[MarkerCandidate], radius: float) -> float:
    """Return how late the angles of the gimbal are [s]; zero where the spheres do not show it.

    Parameters
    ----------
    cloud : StitchedCloud
        A scan.
    spheres : sequence of MarkerCandidate
        Spheres in it.
    radius : float
        Of these [m].

    Notes
    -----
    By least squares of the distances of the returns from the centres, which are unknown too, with
    Huber's weights. An even turn shows nothing.
    """
    angles, late, centres = cloud.gimbal_angles, 0.0, [one.p_base_rough for one in spheres]
    if not isinstance(angles, Timed) or not len(spheres):
        return late
    columns = [replace(angles, stamps_ns=angles.stamps_ns[one.members]) for one in spheres]
    points = [cloud.p_base[one.members].astype(np.float64) for one in spheres]
    information, fastest = _SIGMA**-2.0, 0.0
    for _ in range(_N_ROUNDS):
        information, pull = _SIGMA**-2.0, -late * _SIGMA**-2.0
        for i, (p, own) in enumerate(zip(points, columns, strict=True)):
            before, now, after = (_turns(own, late + by) for by in (-_WITHIN, 0.0, _WITHIN))
            speeds = (after - before) / (2.0 * _WITHIN)
            known, pulled, centres[i] = _shown(_turned(p, now), speeds, centres[i], radius)
            information, pull = information + known, pull + pulled
            fastest = max(fastest, float(np.quantile(np.abs(speeds), _FAST)))
        late += float(np.clip(pull / information, -_FARTHEST, _FARTHEST))
    is_certain = abs(late) > _CERTAIN * information**-0.5
    return late if is_certain and abs(late) * fastest > _SEEN else 0.0


def on_time(cloud: StitchedCloud, late: float) -> StitchedCloud:
    """Return a scan as with angles of the gimbal that are not late [s]."""
    angles = cloud.gimbal_angles
    if not isinstance(angles, Timed) or not late:
        return cloud
    p = _turned(cloud.p_base, _turns(angles, late)).astype(np.float32)
    return replace(cloud, p_base=p, gimbal_angles=_later(angles, late))


def _shown(p: Array, speeds: Array, centre: Array, radius: float) -> tuple[float, float, Array]:
    """Return information on how late angles are by one sphere, the pull, and its better centre."""
    off = p - centre
    gaps = np.linalg.norm(off, axis=1)
    normals, rest = off / gaps[:, None], gaps - radius
    slopes = speeds * (normals[:, 1] * p[:, 0] - normals[:, 0] * p[:, 1])
    scatter = 1.4826 * float(np.median(np.abs(rest))) + _LEAST_SCATTER
    weights = np.minimum(1.0, _ROBUST * scatter / np.maximum(np.abs(rest), scatter)) / scatter**2
    rows = np.column_stack([-normals, slopes])
    N, b = (rows.T * weights) @ rows, -(rows.T * weights) @ rest
    held = N[:3, :3] + _HELD * np.trace(N) * np.eye(3)
    by_late, moved = np.linalg.solve(held, np.column_stack([N[:3, 3], b[:3]])).T
    return float(N[3, 3] - N[3, :3] @ by_late), float(b[3] - N[3, :3] @ moved), centre + moved


def _later(angles: Timed, by: float) -> Timed:
    """Return the angles of a gimbal a time [s] after each return."""
    first, last = angles.samples_ns[[0, -1]]
    return replace(angles, stamps_ns=np.clip(angles.stamps_ns + round(by / _NS), first, last))


def _turns(angles: Timed, by: float) -> Array:
    """Return how far a gimbal turns in a time [s] after each return; zero where none knows."""
    turns = _later(angles, by).exact(slice(None)) - angles.exact(slice(None))
    return np.asarray(np.nan_to_num(turns - 2.0 * np.pi * np.round(turns / (2.0 * np.pi))))


def _turned(p: Array | Column, turns: Array) -> Array:
    """Return points turned about the axis of the gimbal."""
    (x, y, z), c, s = p.T, np.cos(turns), np.sin(turns)
    return np.column_stack([c * x - s * y, s * x + c * y, z])
