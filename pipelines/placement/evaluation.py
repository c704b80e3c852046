"""Predicted accuracy of an arrangement of marks: at stops, and on a grid over the field."""

from __future__ import annotations

import numpy as np

from spheremark.pipelines.accuracy.probability import probability_within
from spheremark.pipelines.errors import InputError
from spheremark.pipelines.model import Array, Index, Mask
from spheremark.pipelines.placement.centre_model import (
    CentreModel,
    Centres,
    detection,
    expect_centres,
    is_found,
)
from spheremark.pipelines.placement.plan import (
    Arrangement,
    Evaluation,
    FieldMap,
    Requirement,
    Site,
    Stops,
    Visibility,
)
from spheremark.pipelines.placement.station_covariance import (
    Observables,
    Positions,
    predict_positions,
    reliability,
    sigmas_with_misses,
)
from spheremark.pipelines.placement.visibility import find_visibility, with_occlusion
from spheremark.pipelines.sphere.mounting import effects_on, sigmas_of

MARKS_MAX, STOPS_MAX, PLACES_MAX = 500, 5_000, 250_000
"""Limits of one evaluation."""


def evaluate(
    site: Site,
    stops: Stops,
    marks: Arrangement,
    model: CentreModel,
    requirement: Requirement,
    *,
    visibility: Visibility | None = None,
) -> Evaluation:
    """Predict the accuracy of an arrangement at every stop.

    Parameters
    ----------
    site : Site
        Ground and what hides marks.
    stops : Stops
        Positions of the LiDAR.
    marks : Arrangement
        The marks.
    model : CentreModel
        Accuracy of centres.
    requirement : Requirement
        Tolerance and method.
    visibility : Visibility, optional
        Result of ``find_visibility`` for these stops and marks; found if not given.

    Returns
    -------
    Evaluation
        Covariances, angles, reliability and probability, with a reason for each weak stop.

    Raises
    ------
    InputError
        If there are no stops, or too many stops or marks.

    Notes
    -----
    Analytic: no scan is simulated. With the visibility given the cost is that of a few matrices for
    each pair of stop and mark.
    """
    check_sizes(len(stops.names), len(marks.names))
    stations = stops.p_site
    alone = find_visibility(site, stations, marks) if visibility is None else visibility
    visibility = with_occlusion(site, stations, marks, alone)
    centres, observables = predict_observables(stations, marks, model, requirement, visibility)
    observables = _on_one_face(observables, model, stops.headings)
    positions = predict_positions(observables, requirement)
    seen = observables.is_seen
    covs = positions.cov_motion[:, 3:, 3:].copy()
    sigmas = np.sqrt(np.trace(covs, axis1=1, axis2=2))
    tested = reliability(observables, positions, requirement)
    n_used = positions.used.sum(axis=1).astype(np.intp)
    return Evaluation(
        stops=stops,
        marks=marks,
        requirement=requirement,
        version=model.version,
        source=model.provenance.source,
        is_seen=seen,
        found=observables.found * seen,
        shares=centres.shares,
        gaps=visibility.gaps.astype(np.float64),
        ranges=np.linalg.norm(observables.vectors, axis=2),
        n_points=centres.n_points,
        cov_p_site=covs,
        cov_motion=positions.cov_motion,
        sigma_3d=sigmas,
        rms_3d=_with_misses(observables, sigmas, requirement),
        probability=probability_within(covs, requirement.tolerance),
        angles=_angles(observables.vectors, positions.used),
        dop=_dilution(observables.vectors, positions),
        n_used=n_used,
        dof=np.maximum(2 * n_used - 3 if requirement.method == "paper" else 3 * n_used - 4, 0),
        redundancies=tested.redundancies,
        detectable_biases=tested.detectable_biases,
        external_reliabilities=tested.external,
        reasons=_reasons(seen, centres, positions, requirement),
    )


def worst_after_loss(
    site: Site, found: Evaluation, model: CentreModel, *, visibility: Visibility | None = None
) -> float:
    """Return the largest 3-D sigma over all stops after the loss of any one mark [m].

    Parameters
    ----------
    site : Site
        Ground and what hides marks.
    found : Evaluation
        The arrangement with all its marks.
    model : CentreModel
        Accuracy of centres.
    visibility : Visibility, optional
        See ``evaluate``.

    Returns
    -------
    float
        Infinite where a stop has no position then, or with fewer than three marks.
    """
    stops, marks, n = found.stops, found.marks, len(found.marks.names)
    if n < 3:
        return np.inf
    alone = find_visibility(site, stops.p_site, marks) if visibility is None else visibility
    worst = 0.0
    for i in range(n):
        keep = np.delete(np.arange(n), i)
        some, left = marks.rows(keep), alone.rows(keep)
        seen = with_occlusion(site, stops.p_site, some, left)
        requirement = found.requirement
        _, observables = predict_observables(stops.p_site, some, model, requirement, seen)
        observables = _on_one_face(observables, model, stops.headings)
        covs = predict_positions(observables, requirement).cov_motion[:, 3:, 3:]
        worst = max(worst, float(np.sqrt(np.trace(covs, axis1=1, axis2=2)).max()))
    return worst


def field_map(  # noqa: PLR0913  all that a map is made of
    site: Site,
    xs: Array,
    ys: Array,
    marks: Arrangement,
    model: CentreModel,
    requirement: Requirement,
    *,
    visibility: Visibility | None = None,
) -> FieldMap:
    """Predict the accuracy of an arrangement on a grid of places.

    Parameters
    ----------
    site : Site
        Ground and what hides marks; the LiDAR stands ``site.mast`` above the ground.
    xs, ys : (n,), (m,)
        Lines of the grid [m].
    marks, model, requirement
        See ``evaluate``.
    visibility : Visibility, optional
        Result of ``find_visibility`` for ``map_stations`` and these marks; found if not given.

    Returns
    -------
    FieldMap
        Sigmas and probabilities.

    Raises
    ------
    InputError
        If there are too many places or marks.
    """
    check_sizes(1, len(marks.names))
    stations, is_known = map_stations(site, xs, ys)
    alone = find_visibility(site, stations, marks) if visibility is None else visibility
    visibility = with_occlusion(site, stations, marks, alone)
    _, observables = predict_observables(stations, marks, model, requirement, visibility)
    positions = predict_positions(_on_one_face(observables, model, None), requirement)
    covs = positions.cov_motion[:, 3:, 3:]
    sigmas = np.sqrt(np.trace(covs, axis1=1, axis2=2))
    is_open = ~np.isfinite(sigmas) | ~is_known
    probability = probability_within(np.ascontiguousarray(covs), requirement.tolerance)
    shape = (len(ys), len(xs))
    return FieldMap(
        xs=np.array(xs, dtype=np.float64),
        ys=np.array(ys, dtype=np.float64),
        sigma_3d=np.where(is_open, np.nan, sigmas).reshape(shape),
        probability=np.where(is_open, np.nan, probability).reshape(shape),
        n_seen=(observables.is_seen.sum(axis=1) * is_known).astype(np.intp).reshape(shape),
        is_seen=(observables.is_seen & is_known[:, None]).reshape(*shape, -1),
    )


def map_stations(site: Site, xs: Array, ys: Array) -> tuple[Array, Mask]:
    """Return the positions of the LiDAR on a grid of places.

    Parameters
    ----------
    site : Site
        The ground, and the height of the LiDAR above it.
    xs, ys : (n,), (m,)
        Lines of the grid [m].

    Returns
    -------
    stations_site : (m n, 3)
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
            f"A map of {len(xs)} x {len(ys)} places is too large; {PLACES_MAX:,} are the most. "
            "Take a coarser grid or a smaller part."
        )
    x, y = np.meshgrid(xs, ys)
    stations = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    heights = site.ground_at(stations) + site.mast
    is_known = np.isfinite(heights)
    stations[:, 2] = np.where(is_known, heights, 0.0)
    return stations, is_known


def check_sizes(n_stops: int, n_marks: int) -> None:
    """Refuse plans that are too large.

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


def predict_observables(
    stations: Array,
    marks: Arrangement,
    model: CentreModel,
    requirement: Requirement,
    visibility: Visibility,
) -> tuple[Centres, Observables]:
    """Predict the centres, and which marks are found."""
    centres = expect_centres(model, stations, marks, visibility)
    found = detection(centres) * (1.0 - requirement.occlusion)
    observables = Observables(
        stations_site=stations,
        marks_site=marks.p_site,
        cov_centres=centres.cov_site,
        sigma_laser_bias=model.sensor.sigma_range_bias,
        sigma_range_common=model.sensor.sigma_range_common,
        sigma_aim=centres.sigma_aim,
        is_seen=is_found(centres, requirement.n_points_min, requirement.share_min),
        found=found,
        by_mounting=np.zeros((*found.shape, 3, 0)),
        imbalance=np.zeros(found.shape),
    )
    return centres, observables


def _on_one_face(
    observables: Observables, model: CentreModel, headings: Array | None
) -> Observables:
    """Return observables with the errors of the mounting that marks share in part of a turn."""
    imbalance, v = model.returns.imbalance, observables.vectors
    if not len(imbalance):
        return observables
    azimuths = np.degrees(np.arctan2(v[..., 1], v[..., 0]))
    if headings is not None:
        azimuths = azimuths - np.degrees(headings)[:, None]
    sigmas = sigmas_of(model.sensor.sigma_mounting, model.sensor.sigma_offset)
    effects = effects_on(v.reshape(-1, 3)).reshape(*v.shape, -1)
    return observables._replace(
        by_mounting=effects * sigmas, imbalance=imbalance[(azimuths % 360.0).astype(np.intp) % 360]
    )


def _with_misses(observables: Observables, sigmas: Array, requirement: Requirement) -> Array:
    """Return the RMS 3-D errors over which marks are found; of three circles the sigmas."""
    if requirement.method == "paper":
        return sigmas
    return np.where(np.isfinite(sigmas), sigmas_with_misses(observables, requirement), np.inf)


def _angles(v: Array, used: Mask) -> Array:
    """Return the least and the greatest included angle between used marks; 0 with fewer than 2."""
    out = np.zeros((len(v), 2))
    for e in np.flatnonzero(used.sum(axis=1) > 1):
        units = v[e, used[e]] / np.linalg.norm(v[e, used[e]], axis=1, keepdims=True)
        cosines = (units @ units.T)[np.triu_indices(len(units), 1)]
        out[e] = np.arccos(np.clip([cosines.max(), cosines.min()], -1.0, 1.0))
    return out


def _dilution(v: Array, positions: Positions) -> Array:
    """Return the dilution of precision of levelled stations, (s,)."""
    w = positions.used.astype(np.float64)
    N = np.zeros((len(v), 4, 4))
    N[:, 0, 0] = np.sum(w * (v[..., 0] ** 2 + v[..., 1] ** 2), axis=1)
    N[:, 0, 1] = N[:, 1, 0] = -np.sum(w * v[..., 1], axis=1)
    N[:, 0, 2] = N[:, 2, 0] = np.sum(w * v[..., 0], axis=1)
    N[:, 1, 1] = N[:, 2, 2] = N[:, 3, 3] = w.sum(axis=1)
    is_fixed = np.isfinite(positions.cov_motion[:, 0, 0]) & (w.sum(axis=1) >= 2)
    inverse = np.linalg.inv(np.where(is_fixed[:, None, None], N, np.eye(4)))
    return np.where(is_fixed, np.sqrt(np.trace(inverse[:, 1:, 1:], axis1=1, axis2=2)), np.inf)


def _reasons(
    seen: Mask, centres: Centres, positions: Positions, requirement: Requirement
) -> tuple[str, ...]:
    """Return why stops have no position, or a weak one."""
    needed: Index = np.full(len(seen), 3 if requirement.method == "paper" else 2)
    n_seen = seen.sum(axis=1)
    is_fixed = np.isfinite(positions.cov_motion[:, 0, 0])
    hidden = (centres.shares < requirement.share_min).sum(axis=1)
    return tuple(
        _reason(int(n_seen[e]), int(needed[e]), bool(is_fixed[e]), int(hidden[e]), seen.shape[1])
        for e in range(len(seen))
    )


def _reason(n_seen: int, needed: int, is_fixed: bool, n_hidden: int, n: int) -> str:  # noqa: FBT001
    """Return why one stop has no position, or a weak one; empty if it has a good one."""
    if not n:
        return f"no mark stands; a position needs {needed}"
    if n_seen < needed:
        seen = f"{n_seen} of {n} marks" if n_seen else f"none of {n} marks"
        return (
            f"sees {seen} well enough ({n_hidden} less than half visible, the others too far, "
            "between the lines of the scan, on the ground or close before a wall); a position "
            f"needs {needed}"
        )
    if not is_fixed:
        return "the marks stand too nearly in one line with the stop: the position is undetermined"
    if n_seen == 2:
        return "two marks: an error in one of them would not show"
    return ""
