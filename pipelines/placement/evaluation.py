"""What an arrangement of marks promises: at stops, and on a grid over the field."""

from __future__ import annotations

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.errors import InputError
from spheremark.pipelines.model import Array, Index, Mask
from spheremark.pipelines.placement.centre_model import (
    CentreModel,
    Centres,
    expect_centres,
    is_found,
)
from spheremark.pipelines.placement.plan import (
    Arrangement,
    Evaluation,
    FieldMap,
    Requirement,
    Sights,
    Site,
    Stops,
)
from spheremark.pipelines.placement.probability import probability_within
from spheremark.pipelines.placement.station_covariance import (
    Positions,
    Sighting,
    predict_positions,
    reliability,
)
from spheremark.pipelines.placement.visibility import behind_others, look

MARKS_MAX, STOPS_MAX, PLACES_MAX = 500, 5_000, 250_000
"""What one evaluation takes at most."""


def evaluate(
    site: Site,
    stops: Stops,
    marks: Arrangement,
    model: CentreModel,
    wish: Requirement,
    *,
    sights: Sights | None = None,
) -> Evaluation:
    """Say what an arrangement promises at every stop.

    Parameters
    ----------
    site : Site
        Ground and what hides marks.
    stops : Stops
        Places of the LiDAR.
    marks : Arrangement
        The marks.
    model : CentreModel
        How well centres will be known.
    wish : Requirement
        Tolerance and method.
    sights : Sights, optional
        What ``look`` gave for these stops and marks; looked for if not given.

    Returns
    -------
    Evaluation
        Covariances, angles, reliability and probability, with a reason for each weak stop.

    Raises
    ------
    InputError
        If there are no stops, or more stops or marks than can be meant.

    Notes
    -----
    Analytic: no scan is simulated. With sights given the cost is that of a few matrices for each
    pair of stop and mark.
    """
    check_sizes(len(stops.names), len(marks.names))
    eyes = stops.p_site
    alone = look(site, eyes, marks) if sights is None else sights
    sights = behind_others(site, eyes, marks, alone)
    centres, sighting = sighting_of(eyes, marks, model, wish, sights)
    positions = predict_positions(sighting, wish)
    seen = sighting.is_seen
    covs = positions.cov_motion[:, 3:, 3:].copy()
    tested = reliability(sighting, positions, wish)
    n_used = positions.used.sum(axis=1).astype(np.intp)
    return Evaluation(
        stops=stops,
        marks=marks,
        requirement=wish,
        version=model.version,
        source=model.provenance.source,
        is_seen=seen,
        shares=centres.shares,
        gaps=sights.gaps.astype(np.float64),
        ranges=np.linalg.norm(marks.p_site[None] - eyes[:, None], axis=2),
        n_points=centres.n_points,
        cov_p_site=covs,
        cov_motion=positions.cov_motion,
        sigma_3d=np.sqrt(np.trace(covs, axis1=1, axis2=2)),
        probability=probability_within(covs, wish.tolerance),
        angles=_angles(eyes, marks.p_site, positions.used),
        dop=_dilution(eyes, marks.p_site, positions),
        n_used=n_used,
        dof=np.maximum(2 * n_used - 3 if wish.method == "paper" else 3 * n_used - 4, 0),
        redundancies=tested.redundancies,
        detectable_biases=tested.detectable_biases,
        external_reliabilities=tested.external,
        reasons=_reasons(seen, centres, positions, wish),
    )


def field_map(  # noqa: PLR0913  all that a map is made of
    site: Site,
    xs: Array,
    ys: Array,
    marks: Arrangement,
    model: CentreModel,
    wish: Requirement,
    *,
    sights: Sights | None = None,
) -> FieldMap:
    """Say what an arrangement promises on a grid of places.

    Parameters
    ----------
    site : Site
        Ground and what hides marks; the LiDAR stands ``site.mast`` above the ground.
    xs, ys : (n,), (m,)
        Lines of the grid [m].
    marks : Arrangement
        The marks.
    model : CentreModel
        How well centres will be known.
    wish : Requirement
        Tolerance and method.
    sights : Sights, optional
        What ``look`` gave for ``field_eyes`` and these marks; looked for if not given.

    Returns
    -------
    FieldMap
        Sigmas and probabilities.

    Raises
    ------
    InputError
        If there are more places or marks than can be meant.
    """
    check_sizes(1, len(marks.names))
    eyes, is_known = field_eyes(site, xs, ys)
    alone = look(site, eyes, marks) if sights is None else sights
    sights = behind_others(site, eyes, marks, alone)
    _, sighting = sighting_of(eyes, marks, model, wish, sights)
    positions = predict_positions(sighting, wish)
    covs = positions.cov_motion[:, 3:, 3:]
    sigmas = np.sqrt(np.trace(covs, axis1=1, axis2=2))
    is_open = ~np.isfinite(sigmas) | ~is_known
    probability = probability_within(np.ascontiguousarray(covs), wish.tolerance)
    shape = (len(ys), len(xs))
    return FieldMap(
        xs=np.array(xs, dtype=np.float64),
        ys=np.array(ys, dtype=np.float64),
        sigma_3d=np.where(is_open, np.nan, sigmas).reshape(shape),
        probability=np.where(is_open, np.nan, probability).reshape(shape),
        n_seen=(sighting.is_seen.sum(axis=1) * is_known).astype(np.intp).reshape(shape),
    )


def field_eyes(site: Site, xs: Array, ys: Array) -> tuple[Array, Mask]:
    """Return where the LiDAR would be on a grid of places.

    Parameters
    ----------
    site : Site
        The ground, and the height of the LiDAR above it.
    xs, ys : (n,), (m,)
        Lines of the grid [m].

    Returns
    -------
    eyes_site : (m n, 3)
        Places, x fastest; at height zero where the ground is not known [m].
    is_known : (m n,)
        Whether it is.

    Raises
    ------
    InputError
        If there are too many places.
    """
    if len(xs) * len(ys) > PLACES_MAX:
        raise InputError(
            f"A map of {len(xs)} x {len(ys)} places was asked for; {PLACES_MAX:,} are the most. "
            "Take a coarser grid or a smaller part."
        )
    x, y = np.meshgrid(xs, ys)
    eyes = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    heights = site.ground_at(eyes) + site.mast
    is_known = np.isfinite(heights)
    eyes[:, 2] = np.where(is_known, heights, 0.0)
    return eyes, is_known


def check_sizes(n_stops: int, n_marks: int) -> None:
    """Refuse what cannot be meant.

    Parameters
    ----------
    n_stops, n_marks : int
        How many there are.

    Raises
    ------
    InputError
        If there is no stop, or there are too many of either.
    """
    if not n_stops:
        raise InputError("There is no stop; a plan needs one place where the LiDAR scans.")
    for n, most, what in ((n_stops, STOPS_MAX, "stops"), (n_marks, MARKS_MAX, "marks")):
        if n > most:
            raise InputError(f"{n:,} {what} were given; a plan takes {most:,} at most.")


def sighting_of(
    eyes: Array, marks: Arrangement, model: CentreModel, wish: Requirement, sights: Sights
) -> tuple[Centres, Sighting]:
    """Return what is to be expected of centres, and which marks are found."""
    centres = expect_centres(model, eyes, marks, sights)
    sighting = Sighting(
        eyes_site=eyes,
        marks_site=marks.p_site,
        cov_centres=centres.cov_site,
        sigma_laser_bias=model.sensor.sigma_range_bias,
        is_seen=is_found(centres, wish.n_points_min, wish.share_min),
    )
    return centres, sighting


@compiled
def _angles(eyes: Array, marks: Array, used: Mask) -> Array:
    """Return the least and the greatest included angle between used marks; 0 with fewer than 2."""
    out = np.zeros((len(eyes), 2))
    v = np.empty((len(marks), 3))
    for e in range(len(eyes)):
        low, high, n = 1.0, -1.0, 0
        for m in range(len(marks)):
            if used[e, m]:
                v[n] = marks[m] - eyes[e]
                v[n] /= max(np.sqrt((v[n] ** 2).sum()), 1e-9)
                for k in range(n):
                    cosine = v[k, 0] * v[n, 0] + v[k, 1] * v[n, 1] + v[k, 2] * v[n, 2]
                    low, high = min(low, cosine), max(high, cosine)
                n += 1
        if n > 1:
            out[e, 0] = np.arccos(min(max(high, -1.0), 1.0))
            out[e, 1] = np.arccos(min(max(low, -1.0), 1.0))
    return out


def _dilution(eyes: Array, marks: Array, positions: Positions) -> Array:
    """Return the dilution of precision of levelled stations, (e,)."""
    v = marks[None] - eyes[:, None]
    w = positions.used.astype(np.float64)
    N = np.zeros((len(eyes), 4, 4))
    N[:, 0, 0] = np.sum(w * (v[..., 0] ** 2 + v[..., 1] ** 2), axis=1)
    N[:, 0, 1] = N[:, 1, 0] = -np.sum(w * v[..., 1], axis=1)
    N[:, 0, 2] = N[:, 2, 0] = np.sum(w * v[..., 0], axis=1)
    N[:, 1, 1] = N[:, 2, 2] = N[:, 3, 3] = w.sum(axis=1)
    is_fixed = np.isfinite(positions.cov_motion[:, 0, 0]) & (w.sum(axis=1) >= 2)
    inverse = np.linalg.inv(np.where(is_fixed[:, None, None], N, np.eye(4)))
    return np.where(is_fixed, np.sqrt(np.trace(inverse[:, 1:, 1:], axis1=1, axis2=2)), np.inf)


def _reasons(
    seen: Mask, centres: Centres, positions: Positions, wish: Requirement
) -> tuple[str, ...]:
    """Say why stops have no position, or a weak one."""
    needed: Index = np.full(len(seen), 3 if wish.method == "paper" else 2)
    n_seen = seen.sum(axis=1)
    is_fixed = np.isfinite(positions.cov_motion[:, 0, 0])
    hidden = (centres.shares < wish.share_min).sum(axis=1)
    return tuple(
        _reason(int(n_seen[e]), int(needed[e]), bool(is_fixed[e]), int(hidden[e]), seen.shape[1])
        for e in range(len(seen))
    )


def _reason(n_seen: int, needed: int, is_fixed: bool, n_hidden: int, n: int) -> str:  # noqa: FBT001
    """Say why one stop has no position, or a weak one; empty where all is well."""
    if not n:
        return f"no mark stands; a position needs {needed}"
    if n_seen < needed:
        seen = f"{n_seen} of {n} marks" if n_seen else f"none of {n} marks"
        return (
            f"sees {seen} well enough ({n_hidden} less than half visible, the others too far, "
            f"between the lines of the scan or close before a wall); a position needs {needed}"
        )
    if not is_fixed:
        return "the marks stand so much in one line with the stop that the position stays open"
    if n_seen == 2:
        return "two marks: an error in one of them would not show"
    return ""
