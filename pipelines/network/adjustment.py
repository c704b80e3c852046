"""Network -> AdjustedNetwork: hides reliability, predictions, and what is said of the result."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import chdtri, ndtri

from spheremark.pipelines.config import ResectionConfig
from spheremark.pipelines.geometry import skew
from spheremark.pipelines.model import Array
from spheremark.pipelines.model.network import (
    AdjustedNetwork,
    BlockTests,
    LeftOut,
    Network,
    Parts,
    position_by_motion,
)
from spheremark.pipelines.network.normal_equations import middle_of
from spheremark.pipelines.network.repeated_stops import repeated_stops
from spheremark.pipelines.network.snooping import UNTESTABLE, Dropped, Tested, snoop

_FALSE_ALARM = 0.05  # probability that a network without gross errors loses an observation
_UNTOLD = 1e-9  # the same below which nothing else tells where a control mark is
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
    critical = float(ndtri(1.0 - level / 2.0))
    tested, dropped = snoop(network, critical, is_studentised=False)
    n = len(network.sightings)
    if sum(block < n for block, _ in dropped) > _MANY_LEFT_OUT * n:
        tested, dropped = snoop(network, critical, is_studentised=True)
    noncentrality = critical + float(ndtri(config.test_power))
    result = _adjusted(network, tested, dropped, (critical, noncentrality), config)
    return replace(result, repeats=repeated_stops(result))


def _shifts(network: Network, tested: Tested, noncentrality: float) -> tuple[Array, Array]:
    """Return how far a just undetectable bias of each centre moves its station and its mark.

    A bias ``b`` moves the unknowns by ``Q_x J' P b`` and is just detectable when
    ``b' P Q_v P b = lambda0`` (Baarda 1968).
    """
    lin, cofactors = tested.lin, tested.cofactors
    station = network.sightings[:, 0]
    own, between = tested.common
    J_turned, J_common = np.swapaxes(lin.J_centres, 1, 2), np.swapaxes(lin.J_common, 1, 2)
    J_place = position_by_motion(tested.state.T_site_base)[station]
    by_station = cofactors.stations[station] @ J_turned + between @ J_common
    by_station = J_place @ by_station @ lin.P_centres
    by_mark = np.swapaxes(between, 1, 2)[:, :3] @ J_turned + own[:, :3] @ J_common
    by_mark = by_mark @ lin.P_centres
    n = len(network.sightings)
    used, is_open = tested.used[:n], tested.weakest[:n] == 0.0
    solid = np.where((used & ~is_open)[:, None, None], tested.tested[0], np.eye(3))
    out = []
    for effect in (by_station, by_mark):
        worst = np.linalg.eigvalsh(effect @ np.linalg.solve(solid, np.swapaxes(effect, 1, 2)))
        shift = noncentrality * np.sqrt(np.maximum(worst[:, -1], 0.0))
        out.append(np.where(used, np.where(is_open, np.inf, shift), np.nan))
    return out[0], out[1]


def _adjusted(
    network: Network,
    tested: Tested,
    dropped: Dropped,
    limits: tuple[float, float],
    config: ResectionConfig,
) -> AdjustedNetwork:
    """Assemble the result, back in the unshifted site frame."""
    critical, noncentrality = limits
    middle = middle_of(network)
    shift = np.eye(6)
    shift[3:, :3] = skew(middle)
    T = np.array(tested.state.T_site_base)
    T[:, :3, 3] += middle
    T[:, :3, :3] = T[:, :3, :3] @ np.swapaxes(network.R_station_base, 1, 2)
    dof = tested.dof
    station_shifts, mark_shifts = _shifts(network, tested, noncentrality)
    left_out = _left_out(network, tested, dropped, critical)
    predictions, cov_predictions = _predicted_control(network, tested)
    tests = _columns(network, tested, noncentrality)
    parts = tested.cofactors.parts
    J = position_by_motion(tested.state.T_site_base)
    return AdjustedNetwork(
        network=network,
        T_site_station=T,
        cov_T_site_station=shift @ tested.cofactors.stations @ shift.T + _cov_heading(network, T),
        station_covariances=J @ tested.cofactors.stations @ np.swapaxes(J, 1, 2),
        p_site=tested.state.p_site + middle,
        cov_p_site=tested.cofactors.marks,
        used=tested.used,
        centres=tests["centres"],
        gravity=tests["gravity"],
        control=tests["control"],
        station_shifts=station_shifts,
        mark_shifts=mark_shifts,
        shared=tested.state.shared,
        cov_shared=tested.cofactors.shared,
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
        noncentrality=noncentrality,
        left_out=(*network.left_out, *left_out),
        warnings=_warnings(network, tested, critical, left_out, config.test_level),
    )


def _predicted_control(network: Network, tested: Tested) -> tuple[Array, Array]:
    """Return where all else would put each control mark, minus where it is given, with covariance.

    With ``v`` and ``P`` of a block, ``(P Q_v P)^-1 P v`` is what the others predict for it, and the
    inverse its covariance (Baarda 1968): no adjustment has to be done again.
    """
    first = len(network.sightings) + len(network.stations)
    own = tested.own_marks[network.controls]
    shifts, covs = -tested.lin.v_control, own + network.cov_control_site
    weights, solid = tested.lin.P_control, tested.tested[2]
    for row in np.flatnonzero(tested.used[first:]):
        eigenvalues = np.linalg.eigvalsh(solid[row])
        if eigenvalues[0] <= _UNTOLD * np.linalg.eigvalsh(weights[row])[0]:
            shifts[row], covs[row] = np.nan, np.nan
            continue
        covs[row] = np.linalg.inv(solid[row])
        shifts[row] = -covs[row] @ weights[row] @ tested.lin.v_control[row]
    return shifts, covs


def _mark_weaknesses(network: Network, tested: Tested) -> tuple[str, ...]:
    """Say of each mark why it should be used with care."""
    n = len(network.sightings)
    counts = np.bincount(network.sightings[tested.used[:n], 1], minlength=len(network.marks))
    out = []
    for mark, doubt in enumerate(network.doubts):
        reasons = [doubt] if doubt else []
        if counts[mark] == 1 and mark not in network.controls:
            reasons.append("Seen from one station only, and so unchecked.")
        out.append(" ".join(reasons))
    return tuple(out)


def _cov_heading(network: Network, T: Array) -> Array:
    """Return the covariance of stations that turn about their own plumb lines, (s, 6, 6)."""
    up = T[:, :3, 2]
    turns = np.concatenate([up, np.cross(T[:, :3, 3], up)], axis=1)
    return np.asarray(
        network.sigma_headings[:, None, None] ** 2 * turns[:, :, None] * turns[:, None]
    )


def _columns(network: Network, tested: Tested, noncentrality: float) -> dict[str, BlockTests]:
    """Return the statistics of each kind of block."""
    n, s = len(network.sightings), len(network.stations)
    lin, parts = tested.lin, np.split(np.arange(network.n_blocks), [n, n + s])
    with np.errstate(divide="ignore"):
        detectable = np.where(tested.used, noncentrality / np.sqrt(tested.weakest), np.nan)
    residuals = (lin.v_centres, lin.v_gravity, lin.v_control)
    return {
        kind: BlockTests(
            residuals=v,
            redundancies=tested.redundancies[part],
            w_statistics=tested.w[part],
            detectable_biases=detectable[part],
        )
        for kind, v, part in zip(("centres", "gravity", "control"), residuals, parts, strict=True)
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
    """Say which blocks the tests left out, and why."""
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
    """Say why the network cannot be relied on."""
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
            "others stand to tell which is wrong."
        )
    against = [one.mark for one in left_out if one.kind == "control"]
    if len(against) > _MANY_LEFT_OUT * len(network.controls):
        warnings.append(
            f"{len(against)} of {len(network.controls)} control marks contradict the others and "
            f"were left out ({', '.join(against)}): the scans cannot tell which of the two groups "
            "is right."
        )
    n_bad = sum(one.kind == "centre" for one in left_out)
    if n_bad and n_bad > _MANY_LEFT_OUT * n:
        warnings.append(f"{n_bad} of {n} centres had to be left out.")
    per_mark = np.bincount(network.sightings[tested.used[:n], 1], minlength=len(network.marks))
    lonely = [network.marks[m] for m in np.flatnonzero(per_mark == 1) if m not in network.controls]
    if lonely:
        warnings.append(f"Seen from one station only, and so unchecked: {', '.join(lonely)}.")
    per_station = np.bincount(network.sightings[tested.used[:n], 0], minlength=s)
    loose = [network.stations[i] for i in np.flatnonzero(per_station < _N_CHECKED)]
    if loose:
        warnings.append(
            f"Held by two marks only, where an error in one would not show: {', '.join(loose)}."
        )
    doubtful = [name for name, doubt in zip(network.marks, network.doubts, strict=True) if doubt]
    if doubtful:
        warnings.append(f"Marks that may be false: {', '.join(doubtful)}; the reasons stand there.")
    return tuple(warnings)
