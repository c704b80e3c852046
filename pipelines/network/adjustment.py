"""Network -> AdjustedNetwork: adjustment, reliability, predictions and warnings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from spheremark.pipelines.config import ResectionConfig
from spheremark.pipelines.estimation.linear_algebra import inverse
from spheremark.pipelines.estimation.statistical_tests import (
    UNTESTABLE,
    Dropped,
    critical_w,
    noncentrality,
)
from spheremark.pipelines.geometry import by_motion, skew, turn_in_place
from spheremark.pipelines.model import Array
from spheremark.pipelines.model.network import (
    AdjustedNetwork,
    BlockTests,
    LeftOut,
    Network,
    Parts,
)
from spheremark.pipelines.network.normal_equations import middle_of
from spheremark.pipelines.network.repeated_stops import repeated_stops
from spheremark.pipelines.network.snooping import Tested, own_marks, snoop_network

_FALSE_ALARM = 0.05  # probability that a network without gross errors loses an observation
_UNCHECKED = 1e-9  # redundancy below which a control mark is determined by itself alone
_N_CHECKED = 3  # marks of which a station shows an error in one
_MANY_LEFT_OUT = 1.0 / 3.0  # of the centres: not they are bad, but the sigmas; or of control


def adjust_network(network: Network, config: ResectionConfig) -> AdjustedNetwork:
    """Adjust all stations and marks of a survey together, and leave gross errors out.

    Parameters
    ----------
    network : Network
        What was observed, with approximate values.
    config : ResectionConfig
        Levels of the tests.

    Returns
    -------
    AdjustedNetwork
        Poses, marks, covariances and tests.

    Raises
    ------
    TooFewObservationsError
        If there are fewer observations than unknowns.
    DegenerateGeometryError
        If a part of the network can move on its own.
    NotConvergedError
        If the steps do not become small.

    Notes
    -----
    Observed are each centre in the base frame of its station, the up direction of each station,
    and the control marks with their covariances; what all stations share are unknowns too, with
    what is known of them as observations: a common range bias would swell the ring of marks alike
    from every station, and so would a rig that is wrong. Without control the network is free:
    stations are levelled, place and heading stay open, and the inner constraints over all marks
    (their centroid and mean heading stay those of the approximate values) give the covariances of
    least trace (Meissl 1969). Data snooping after Baarda (1968), one block at a time; the level of
    a single test is lowered with their number so that a clean network loses an observation in one
    of twenty cases. Where more than a third of the centres would go, the sigmas are to blame, and w
    is divided by sigma0 (Pope 1976). Cost grows linearly with the stations and with the third power
    of the marks.
    """
    level = min(config.test_level, _FALSE_ALARM / (3 * network.n_blocks))
    critical = critical_w(level)
    tested, dropped = snoop_network(network, critical, is_studentised=False)
    n = len(network.sightings)
    if sum(block < n for block, _ in dropped) > _MANY_LEFT_OUT * n:
        tested, dropped = snoop_network(network, critical, is_studentised=True)
    shift_w = noncentrality(level, config.test_power)
    result = _adjusted(network, tested, dropped, (critical, shift_w), config)
    return replace(result, repeats=repeated_stops(result))


def _shifts(network: Network, tested: Tested, shift_w: float) -> tuple[Array, Array]:
    """Return how far a just undetectable bias of each centre moves its station and its mark.

    A bias ``b`` moves the unknowns by ``Q_x J' P b`` (Baarda 1968).
    """
    lin, cofactors = tested.lin, tested.cofactors
    station = network.sightings[:, 0]
    own, between = cofactors.of_centres(network)
    J_turned, J_common = np.swapaxes(lin.J_centres, 1, 2), np.swapaxes(lin.J_common, 1, 2)
    J_place = by_motion(tested.state.T_site_base[station, :3, 3])
    of_motions = (cofactors.stations[station] @ J_turned + between @ J_common)[:, :6]
    by_station = J_place @ of_motions
    by_mark = np.swapaxes(between, 1, 2)[:, :3] @ J_turned + own[:, :3] @ J_common
    used, blocks = tested.used[: len(station)], tested.blocks[0]
    of_station, of_mark = (
        np.where(used, blocks.external_reliabilities(gain @ lin.P_centres, shift_w), np.nan)
        for gain in (by_station, by_mark)
    )
    return of_station, of_mark


def _adjusted(
    network: Network,
    tested: Tested,
    dropped: Dropped,
    limits: tuple[float, float],
    config: ResectionConfig,
) -> AdjustedNetwork:
    """Assemble the result, back in the unshifted site frame."""
    critical, shift_w = limits
    m, middle = len(network.marks), middle_of(network)
    shift = np.eye(6)
    shift[3:, :3] = skew(middle)
    T = np.array(tested.state.T_site_base)
    T[:, :3, 3] += middle
    T[:, :3, :3] = T[:, :3, :3] @ np.swapaxes(network.R_station_base, 1, 2)
    dof = tested.dof
    station_shifts, mark_shifts = _shifts(network, tested, shift_w)
    left_out = _left_out(network, tested, dropped, critical)
    predictions, cov_predictions = _predicted_control(network, tested)
    tests = _columns(network, tested, shift_w)
    parts, stations = tested.cofactors.parts, tested.cofactors.stations[:, :6, :6]
    J = by_motion(tested.state.T_site_base[:, :3, 3])
    return AdjustedNetwork(
        network=network,
        T_site_station=T,
        cov_T_site_station=shift @ stations @ shift.T + _cov_heading(network, T),
        station_covariances=J @ stations @ np.swapaxes(J, 1, 2),
        p_site=tested.state.p_site + middle,
        cov_p_site=tested.cofactors.common[: 3 * m, : 3 * m].copy(),
        used=tested.used,
        centres=tests["centres"],
        gravity=tests["gravity"],
        control=tests["control"],
        station_shifts=station_shifts,
        mark_shifts=mark_shifts,
        heights=tested.state.heights,
        sigma_heights=np.sqrt(tested.cofactors.stations[:, 6, 6]),
        shared=tested.state.shared,
        cov_shared=tested.cofactors.common[3 * m :, 3 * m :].copy(),
        parts=Parts(
            own=shift @ parts.own @ shift.T,
            coupling=shift @ parts.coupling,
            cov_common=parts.cov_common,
        ),
        control_predictions=predictions,
        cov_control_predictions=cov_predictions,
        mark_weaknesses=_mark_weaknesses(network, tested),
        dof=dof,
        vtpv=tested.vtpv,
        sigma0=tested.sigma0,
        passes_global_test=tested.passes(config.test_level),
        limit_vtpv=float(chdtri(dof, config.test_level)) if dof else 0.0,
        variance_factors=_variance_factors(network, tested),
        critical_w=critical,
        noncentrality=shift_w,
        left_out=(*network.left_out, *left_out),
        warnings=_warnings(network, tested, critical, left_out, config.test_level),
    )


def _predicted_control(network: Network, tested: Tested) -> tuple[Array, Array]:
    """Return the predicted minus the given position of each control mark, with covariance.

    The prediction is that of all other observations. With ``v`` and ``P`` of a block it is
    ``(P Q_v P)^-1 P v``, and the inverse its covariance (Baarda 1968): nothing is adjusted again.
    """
    first = len(network.sightings) + len(network.stations)
    own = own_marks(network, tested.cofactors)[network.controls]
    shifts, covs = -tested.lin.v_control, own + network.cov_control_site
    weights, solid = tested.lin.P_control, tested.blocks[2].testability
    for row in np.flatnonzero(tested.used[first:]):
        eigenvalues = np.linalg.eigvalsh(solid[row])
        if eigenvalues[0] <= _UNCHECKED * np.linalg.eigvalsh(weights[row])[0]:
            shifts[row], covs[row] = np.nan, np.nan
            continue
        covs[row] = inverse(solid[row])
        shifts[row] = -covs[row] @ weights[row] @ tested.lin.v_control[row]
    return shifts, covs


def _mark_weaknesses(network: Network, tested: Tested) -> tuple[str, ...]:
    """Return why each mark should be used with care."""
    n = len(network.sightings)
    counts = np.bincount(network.sightings[tested.used[:n], 1], minlength=len(network.marks))
    out = []
    for mark, suspicion in enumerate(network.suspicions):
        reasons = [suspicion] if suspicion else []
        if counts[mark] == 1 and mark not in network.controls:
            reasons.append("Seen from one station only, and so unchecked.")
        out.append(" ".join(reasons))
    return tuple(out)


def _cov_heading(network: Network, T: Array) -> Array:
    """Return the covariance of stations that turn about the axes of their gimbals, (s, 6, 6)."""
    turns = turn_in_place(T, network.R_station_base[:, :, 2])
    return np.asarray(
        network.sigma_headings[:, None, None] ** 2 * turns[:, :, None] * turns[:, None]
    )


def _columns(network: Network, tested: Tested, shift_w: float) -> dict[str, BlockTests]:
    """Return the statistics of each kind of block."""
    n, s = len(network.sightings), len(network.stations)
    lin, redundancies = tested.lin, np.split(tested.redundancies, [n, n + s])
    columns = zip(
        ("centres", "gravity", "control"),
        (lin.v_centres, lin.v_gravity, lin.v_control),
        tested.blocks,
        redundancies,
        strict=True,
    )
    return {
        kind: BlockTests(
            residuals=v,
            redundancies=r,
            w_statistics=block.w,
            detectable_biases=np.where(np.isnan(r), np.nan, block.detectable_biases(shift_w)),
        )
        for kind, v, block, r in columns
    }


def _variance_factors(network: Network, tested: Tested) -> Array:
    """Return the sum of squares over redundancy of each kind of block; NaN without redundancy."""
    n, s = len(network.sightings), len(network.stations)
    parts = np.split(np.nan_to_num(tested.redundancies), [n, n + s])
    totals = [float(part.sum()) for part in parts]
    pairs = zip(tested.squares, totals, strict=True)
    return np.array([square / r if r > UNTESTABLE else np.nan for square, r in pairs])


def _left_out(
    network: Network, tested: Tested, dropped: Dropped, critical: float
) -> tuple[LeftOut, ...]:
    """Return which blocks the tests left out, and why."""
    n, s = len(network.sightings), len(network.stations)
    out = []
    for block, w in dropped:
        worth = f"w = {w:.1f} (good data stay below {critical:.1f})"
        if block < n:
            station, mark = network.sightings[block]
            off = float(np.linalg.norm(tested.lin.v_centres[block]))
            out.append(
                LeftOut(
                    kind="centre",
                    station=network.stations[station],
                    marker=network.markers[block],
                    mark=network.marks[mark],
                    reason=f"{worth}: it is {off:.3f} m from where all others have mark "
                    f"{network.marks[mark]}.",
                )
            )
        elif block < n + s:
            station = block - n
            off = np.degrees(float(np.linalg.norm(tested.lin.v_gravity[station])))
            reason = f"{worth}: the levelling is {off:.2f} deg from what the marks say."
            name = network.stations[station]
            out.append(LeftOut(kind="gravity", station=name, marker="", mark="", reason=reason))
        else:
            control = block - n - s
            off = float(np.linalg.norm(tested.lin.v_control[control]))
            mark_name = network.marks[network.controls[control]]
            reason = f"{worth}: the given coordinates are {off:.3f} m from the adjusted ones."
            out.append(
                LeftOut(kind="control", station="", marker="", mark=mark_name, reason=reason)
            )
    return tuple(out)


def _warnings(
    network: Network,
    tested: Tested,
    critical: float,
    left_out: tuple[LeftOut, ...],
    level: float,
) -> tuple[str, ...]:
    """Return why the network is weak."""
    n, s = len(network.sightings), len(network.stations)
    warnings = []
    if not tested.passes(level):
        warnings.append(
            f"The global test fails (sigma0 = {tested.sigma0:.2f}): residuals are "
            "larger than their sigmas promise."
        )
    control_w = np.nan_to_num(tested.w[n + s :])
    bad = [
        f"{network.marks[mark]} (w = {w:.1f})"
        for mark, w in zip(network.controls, control_w, strict=True)
        if w > critical
    ]
    if bad:
        warnings.append(
            f"The control marks {', '.join(bad)} contradict each other or the scans, and too few "
            "others remain to decide which is wrong."
        )
    against = [one.mark for one in left_out if one.kind == "control"]
    if len(against) > _MANY_LEFT_OUT * len(network.controls):
        warnings.append(
            f"{len(against)} of {len(network.controls)} control marks contradict the others and "
            f"were left out ({', '.join(against)}): the scans cannot decide which of the two "
            "groups is right."
        )
    n_bad = sum(one.kind == "centre" for one in left_out)
    if n_bad and n_bad > _MANY_LEFT_OUT * n:
        warnings.append(f"{n_bad} of {n} centres had to be left out.")
    per_mark = np.bincount(network.sightings[tested.used[:n], 1], minlength=len(network.marks))
    unchecked = [
        network.marks[m] for m in np.flatnonzero(per_mark == 1) if m not in network.controls
    ]
    if unchecked:
        warnings.append(f"Seen from one station only, and so unchecked: {', '.join(unchecked)}.")
    per_station = np.bincount(network.sightings[tested.used[:n], 0], minlength=s)
    loose = [network.stations[i] for i in np.flatnonzero(per_station < _N_CHECKED)]
    if loose:
        warnings.append(
            f"Held by two marks only, where an error in one would not show: {', '.join(loose)}."
        )
    suspect = [
        name for name, suspicion in zip(network.marks, network.suspicions, strict=True) if suspicion
    ]
    if suspect:
        warnings.append(f"Marks that may be false: {', '.join(suspect)}; the reasons stand there.")
    return tuple(warnings)
