"""Fits of many stations -> Network: which marker is which mark, and approximate values.

Markers carry no labels. A map of marks grows from the control marks, or from one station: each
station is matched to the map as it is, and its markers that are not in the map yet enlarge it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.distance import pdist

from spheremark.pipelines.calibration import Calibration
from spheremark.pipelines.config import ResectionConfig
from spheremark.pipelines.errors import (
    AmbiguousMatchError,
    DegenerateGeometryError,
    InputError,
    NoMatchError,
    SolveError,
)
from spheremark.pipelines.geometry import levelling_rotation, rigid, transform, unit, up_by_lean
from spheremark.pipelines.model import OPTICS, Array, ControlMarks, MarkerFit, MarkerFits, Mask
from spheremark.pipelines.model.network import LeftOut, Network, Refusal, Shared
from spheremark.pipelines.network.mark_evidence import Weighed, weigh_marks
from spheremark.pipelines.positioning.hypotheses import Spans, spans_between
from spheremark.pipelines.positioning.matching import (
    gather,
    match_marks,
    own_covariances,
    shared_variances,
)

_EXACT = 1e-5  # [m] sigma of control marks that are given as exact: far below any survey's
# In place of a mark: none is near; the one that is near is false; of a possible marker none
_NO_MARK, _SUSPECT, _UNUSED = -1, -2, -3
_SHARED_HEIGHT = 0.98  # most of a centre's variance of height that may be an error that all share
_STEEP = 1e-3  # of a line of sight that is nearly the gimbal axis: across is no direction there
_NEAR_CONTROL = 1.0  # [m] how far a mark can be from a control mark and still be worth a remark

Scan = tuple[str, MarkerFits]


@dataclass(slots=True)
class _Map:
    """Marks found so far, and which marker of which placed station is which of them."""

    names: list[str] = field(default_factory=list)
    p_site: list[Array] = field(default_factory=list)
    cov_p_site: list[Array] = field(default_factory=list)
    poses: dict[int, Array] = field(default_factory=dict)
    marks_of: dict[int, list[int]] = field(default_factory=dict)
    n_control: int = 0
    longest: float = 0.0
    drawn: tuple[ControlMarks, Spans] | None = None

    def as_control(self) -> tuple[ControlMarks, Spans]:
        """Return the marks as if they were control, and how far they are apart."""
        if self.drawn is None:
            marks = ControlMarks(
                names=tuple(self.names),
                p_site=np.array(self.p_site),
                cov_p_site=np.array(self.cov_p_site),
            )
            spans = spans_between(marks.p_site - marks.p_site.mean(axis=0), self.longest)
            self.drawn = (marks, spans)
        return self.drawn

    def add_mark(self, p_site: Array, cov_p_site: Array) -> int:
        """Enlarge the map by a mark; return its place."""
        letter = "N" if self.n_control else "M"
        number = len(self.names) - self.n_control + 1
        while (name := f"{letter}{number:02d}") in self.names:
            number += 1
        self.names.append(name)
        self.p_site.append(p_site)
        self.cov_p_site.append(cov_p_site)
        self.drawn = None
        return len(self.names) - 1

    def place(
        self, scan: int, fits: MarkerFits, T: Array, marks: Sequence[int], near: float
    ) -> None:
        """Enter a station; markers that are far from all marks become new ones."""
        known = np.array(self.p_site)
        labels = []
        for fit, mark in zip(fits.fits, marks, strict=True):
            p = transform(T, fit.p_base)
            if mark < 0 and (not len(known) or np.linalg.norm(known - p, axis=1).min() > near):
                mark = self.add_mark(p, T[:3, :3] @ fit.cov_p_base @ T[:3, :3].T)
            labels.append(int(mark))
        self.poses[scan] = T
        self.marks_of[scan] = labels


def assemble(
    scans: Sequence[Scan],
    control: ControlMarks | None,
    config: ResectionConfig,
    calibration: Calibration | None = None,
) -> Network:
    """Match the markers of all stations, and find approximate values.

    Parameters
    ----------
    scans : sequence of (str, MarkerFits)
        Name of each station and its centres.
    control : ControlMarks, optional
        Marks at known places; without any the network is free, in the levelled frame of the first
        station that is in it.
    config : ResectionConfig
        Tolerance of matching.
    calibration : Calibration, optional
        The rig as estimated from both faces of the spheres: its parameters become unknowns of the
        network. Centres that it adjusted take the place of those of ``scans``.

    Returns
    -------
    Network
        Marks that two stations or more see, and control marks; stations that share two or more of
        them with others. The rest is refused or left out with a reason.

    Raises
    ------
    InputError
        If two stations have the same name.
    DegenerateGeometryError
        If no two stations share enough marks, or fewer than two control marks were seen.

    Notes
    -----
    Control marks without a covariance count as known to 0.01 mm, so that they can be tested. Of
    several groups of stations that share no marks the largest is taken. Cost grows with the
    stations, and with their square where many cannot be matched.
    """
    names = [name for name, _ in scans]
    if twice := sorted(name for name, n in Counter(names).items() if n > 1):
        raise InputError(
            f"Two logs are called {twice[0]!r}; stations are identified by name. Rename one."
        )
    if calibration is not None:
        scans = [
            (name, replace(calibration.adjusted(name, fits), possible_fits=()))
            for name, fits in scans
        ]
    found, reasons = _grow(scans, control, config)
    weighed = weigh_marks(scans, found, _shared(found)[0], config)
    for i, fit in weighed.dropped:
        found.marks_of[i][fit] = _SUSPECT
    scans = _with_confirmed(scans, found, weighed)
    used, unshared = _shared(found)
    refused = tuple(
        Refusal(station=names[i], code=DegenerateGeometryError.code, reason=reason)
        if isinstance(reason, str)
        else Refusal(station=names[i], code=reason.code, reason=_why(scans[i][1], found, reason))
        for i, reason in _refused(len(scans), used, reasons)
    )
    _refuse_nothing(used, found, control, _foremost(refused, [names[i] for i in reasons]))
    network = _network(scans, found, used, weighed.suspicions)
    cov_p_base = network.cov_p_base + config.sigma_common**2 * np.eye(3)
    fits_of = {name: found_there.fits for name, found_there in scans}
    rows = zip(network.sightings[:, 0], network.fits, strict=True)
    seen = [fits_of[network.stations[i]][fit] for i, fit in rows]
    if calibration is None:
        sigmas = np.array([fit.sigma_range_shared for fit in seen])
        variances = shared_variances(network.p_base, cov_p_base, sigmas, config)
        cov_p_base = own_covariances(network.p_base, cov_p_base, variances)
    network = replace(network, cov_p_base=cov_p_base, refused=refused)
    network = _with_heights(network, seen) if calibration is None else network
    network = _in_common(network, seen, config, calibration)
    left_out = _unseen(scans, found, used, unshared, weighed.dropped)
    return replace(network, left_out=left_out, evidence=weighed.evidence)


def _with_confirmed(scans: Sequence[Scan], found: _Map, weighed: Weighed) -> list[Scan]:
    """Return the stations with possible markers behind the others; enter those confirmed."""
    out = []
    for i, (name, fits) in enumerate(scans):
        if i in found.poses:
            marks = [weighed.confirmed.get((i, k), _UNUSED) for k in range(len(fits.possible_fits))]
            found.marks_of[i] = [*found.marks_of[i], *marks]
            fits = replace(fits, fits=fits.fits + fits.possible_fits, possible_fits=())
        out.append((name, fits))
    return out


def _grow(
    scans: Sequence[Scan], control: ControlMarks | None, config: ResectionConfig
) -> tuple[_Map, dict[int, SolveError]]:
    """Return the largest map that stations can be matched to, and why others cannot."""
    longest = max((_extent(fits) for _, fits in scans), default=0.0) + 2.0 * config.match_tolerance
    if control is not None:
        found = _Map(
            names=list(control.names),
            p_site=list(control.p_site),
            cov_p_site=list(control.cov_p_site),
            n_control=len(control.names),
            longest=longest,
        )
        return found, _chain(scans, found, list(range(len(scans))), config)
    best, reasons = _Map(), dict[int, SolveError]()
    left = list(range(len(scans)))
    while len(left) > len(best.poses):
        seed = left[0]
        fits, found = scans[seed][1], _Map(longest=longest)
        T = rigid(levelling_rotation(fits.levelling), np.zeros(3))
        found.place(seed, fits, T, [-1] * len(fits.fits), 0.0)
        others = [i for i in range(len(scans)) if i != seed]
        failed = _chain(scans, found, others, config)
        if len(found.poses) > len(best.poses):
            best, reasons = found, failed
        left = [i for i in left if i not in found.poses]
    return best, reasons


def _extent(fits: MarkerFits) -> float:
    """Return how far the two outermost markers of a station are apart [m]."""
    if len(fits.fits) < 2:
        return 0.0
    return float(pdist(np.stack([fit.p_base for fit in fits.fits])).max())


def _chain(
    scans: Sequence[Scan], found: _Map, left: list[int], config: ResectionConfig
) -> dict[int, SolveError]:
    """Match stations to a growing map until none is added; return why the others are not."""
    failed: dict[int, SolveError] = {}
    while left:
        failed = {}
        for i in left:
            fits = scans[i][1]
            try:
                if len(fits.fits) < 2 or not found.names:
                    raise DegenerateGeometryError("Too few markers.")
                marks, spans = found.as_control()
                scene = gather(fits, marks, config)
                match = match_marks(scene, config, spans)
                if len(match.alternatives):
                    raise AmbiguousMatchError("Two markers fit the map in several ways.")
            except SolveError as error:
                failed[i] = error
                continue
            T = np.array(match.T_site_base)
            T[:3, 3] += scene.middle
            found.place(i, fits, T, match.marks.tolist(), config.match_tolerance)
        if len(failed) == len(left):
            break
        left = list(failed)
    return failed


def _shared(found: _Map) -> tuple[dict[int, list[tuple[int, int]]], dict[int, list[int]]]:
    """Return, per station, (fit, mark) that tie it to others, and fits that no other station sees.

    A station that two such marks do not hold goes, and what only it shared with one other with it.
    """
    stations = set(found.poses)
    while True:
        seen = [m for i in stations for m in found.marks_of[i] if m >= 0]
        counts = np.bincount(np.array(seen, dtype=np.intp), minlength=len(found.names))
        counts[: found.n_control] += 1
        used = {
            i: [(f, m) for f, m in enumerate(found.marks_of[i]) if m >= 0 and counts[m] > 1]
            for i in sorted(stations)
        }
        weak = {i for i, pairs in used.items() if len(pairs) < 2}
        if not weak:
            break
        stations -= weak
    unshared = {
        i: [
            f
            for f, mark in enumerate(found.marks_of[i])
            if mark != _UNUSED and f not in {fit for fit, _ in pairs}
        ]
        for i, pairs in used.items()
    }
    return used, unshared


def _refused(
    n: int, used: dict[int, list[tuple[int, int]]], reasons: dict[int, SolveError]
) -> list[tuple[int, SolveError | str]]:
    """Return the stations that are not used, with the error or the reason."""
    alone = "It shares fewer than two marks with the other stations; two, better three, tie it."
    return [(i, reasons.get(i, alone)) for i in range(n) if i not in used]


def _why(fits: MarkerFits, found: _Map, error: SolveError) -> str:
    """Return why a station could not be matched to the network."""
    n, m = len(fits.fits), len(found.names)
    if n < 2:
        seen = "One marker was" if n else "No marker was"
        return f"{seen} found in it; two, better three, that other stations see too tie a station."
    if isinstance(error, AmbiguousMatchError):
        return (
            f"Its {n} markers fit the {m} marks of the network in more than one way equally well: "
            "distances repeat (a symmetric field, or too few marks). Another mark, where no "
            "distance repeats, resolves that."
        )
    if isinstance(error, NoMatchError):
        return (
            f"Its {n} markers do not fit the {m} marks of the network better than chance: it "
            "shares too few marks with the other stations (two, better three or more, tie it), or "
            "it stands in another field."
        )
    return f"It cannot be tied to the network: {error}"


def _foremost(refused: tuple[Refusal, ...], unmatched: list[str]) -> Refusal | None:
    """Return the most informative refusal: that of a station which could not be matched."""
    return next((one for one in refused if one.station in unmatched), next(iter(refused), None))


def _refuse_nothing(
    used: dict[int, list[tuple[int, int]]],
    found: _Map,
    control: ControlMarks | None,
    refused: Refusal | None,
) -> None:
    """Raise where no network is left, with the reason of a refused station."""
    first = f" {refused.station}: {refused.reason}" if refused else ""
    if not used or (control is None and len(used) < 2):
        ties = "no two stations share two marks; give more scans, or control marks"
        if control is not None:
            ties = "no station could be tied to two of the control marks; without them it is free"
            if refused is not None and refused.code == NoMatchError.code:
                ties += (
                    ". Control of another field, in other units or in other axes looks like this"
                )
        raise DegenerateGeometryError(f"There is no network: {ties}.{first}")
    if control is not None:
        seen = sorted({m for pairs in used.values() for _, m in pairs if m < found.n_control})
        p = np.array(found.p_site)[seen]
        if len(seen) < 2 or np.linalg.norm(np.ptp(p[:, :2], axis=0)) < 1e-2:
            raise DegenerateGeometryError(
                f"{len(seen)} control mark(s) were seen; two that do not stand on one plumb line "
                "are needed for place and heading. Without --control the network is free."
            )


def _unseen(
    scans: Sequence[Scan],
    found: _Map,
    used: dict[int, list[tuple[int, int]]],
    unshared: dict[int, list[int]],
    dropped: dict[tuple[int, int], tuple[int, str]],
) -> tuple[LeftOut, ...]:
    """Return which centres are no marks of the network, and which control marks were not seen."""
    out = []
    for i, fits in unshared.items():
        for fit in fits:
            reason = "No other station sees it: it ties nothing, and may be false."
            if found.marks_of[i][fit] == _NO_MARK:
                reason = "Another marker is nearer to the mark beside it: a false marker."
            refused, reason = dropped.get((i, fit), (None, reason))
            mark_name = "" if refused is None else found.names[refused]
            station, name = scans[i][0], scans[i][1].fits[fit].name
            out.append(
                LeftOut(kind="centre", station=station, marker=name, mark=mark_name, reason=reason)
            )
    seen = {mark for pairs in used.values() for _, mark in pairs}
    for mark in range(found.n_control):
        if mark not in seen:
            reason = "No station sees it." + _beside(found, mark, seen)
            name = found.names[mark]
            out.append(LeftOut(kind="control", station="", marker="", mark=name, reason=reason))
    return tuple(out)


def _beside(found: _Map, mark: int, seen: set[int]) -> str:
    """Return the seen mark that stands beside a control mark which was not seen."""
    new = [other for other in seen if other >= found.n_control]
    if not new:
        return ""
    off = [float(np.linalg.norm(found.p_site[other] - found.p_site[mark])) for other in new]
    nearest = int(np.argmin(off))
    if off[nearest] > _NEAR_CONTROL:
        return ""
    return (
        f" But {found.names[new[nearest]]} stands {off[nearest]:.2f} m from it: its coordinates "
        "contradict the other control marks, or it was moved."
    )


def _network(
    scans: Sequence[Scan],
    found: _Map,
    used: dict[int, list[tuple[int, int]]],
    suspicions: dict[int, str],
) -> Network:
    """Bring stations and marks that are used into columns."""
    places = sorted({mark for pairs in used.values() for _, mark in pairs})
    row = {mark: k for k, mark in enumerate(places)}
    sightings = [(k, row[m], f) for k, i in enumerate(used) for f, m in used[i]]
    columns = np.array(sightings, dtype=np.intp)
    fits = [scans[i][1].fits[f] for i in used for f, _ in used[i]]
    levellings = [scans[i][1].levelling for i in used]
    leans = [(one, up_by_lean(one)) for one in levellings]
    controls = [mark for mark in places if mark < found.n_control]
    given = np.array([found.cov_p_site[mark] for mark in controls]).reshape(-1, 3, 3)
    return Network(
        stations=tuple(scans[i][0] for i in used),
        marks=tuple(found.names[mark] for mark in places),
        sightings=columns[:, :2].copy(),
        fits=columns[:, 2].copy(),
        markers=tuple(fit.name for fit in fits),
        p_base=np.array([fit.p_base for fit in fits]),
        cov_p_base=_symmetric(
            np.array([fit.p_base for fit in fits]), np.array([fit.cov_p_base for fit in fits])
        ),
        R_station_base=np.array([levelling_rotation(one) for one in levellings]),
        cov_up_base=np.array([one.sigma**2 * J @ J.T for one, J in leans]),
        sigma_headings=np.array([one.sigma_heading_station for one in levellings]),
        controls=np.array([row[mark] for mark in controls], dtype=np.intp),
        p_control_site=np.array([found.p_site[mark] for mark in controls]).reshape(-1, 3),
        cov_control_site=given + _EXACT**2 * np.eye(3),
        T_site_base=np.array([found.poses[i] for i in used]),
        p_site=np.array([found.p_site[mark] for mark in places]),
        heights_base=np.zeros((len(fits), 3)),
        shared=Shared.none(len(fits)),
        suspicions=tuple(suspicions.get(mark, "") for mark in places),
    )


def _symmetric(p_base: Array, cov_p_base: Array) -> Array:
    """Return the covariances of centres without what correlates along, across and above.

    A sphere is symmetric about the line of sight. A correlation in its returns comes from where the
    centre was linearised, and as a weight would turn errors across the line of sight into errors
    along it: over many stations the ring of marks swells by 0.2 mm.
    """
    axes, is_steep = _axes(p_base)
    variances = np.einsum("nki,nij,nkj->nk", axes, cov_p_base, axes)
    alike = np.swapaxes(axes, 1, 2) @ (variances[..., None] * axes)
    return np.where(is_steep[:, None, None], cov_p_base, alike)


def _axes(p_base: Array) -> tuple[Array, Mask]:
    """Return unit vectors along, across and above lines of sight, (n, 3, 3), and the steep ones."""
    along = unit(p_base)
    across = np.column_stack([-along[:, 1], along[:, 0], np.zeros(len(along))])
    lengths = np.linalg.norm(across, axis=1, keepdims=True)
    is_steep = (lengths < _STEEP)[:, 0]
    across /= np.where(is_steep[:, None], 1.0, lengths)
    return np.stack([along, across, np.cross(along, across)], axis=1), is_steep


def _with_heights(network: Network, fits: Sequence[MarkerFit]) -> Network:
    """Return the network with the error of height that all centres of a station have in common."""
    # taken as each centre's own it would seem to cancel in the height of the station
    axes, is_steep = _axes(network.p_base)
    upward, covs = axes[:, 2], network.cov_p_base
    variances = np.array([fit.sigma_height_shared for fit in fits]) ** 2
    most = _SHARED_HEIGHT * np.einsum("ni,nij,nj->n", upward, covs, upward)
    sigmas = np.sqrt(np.where(is_steep, 0.0, np.minimum(variances, most)))
    heights = sigmas[:, None] * upward
    return replace(
        network, heights_base=heights, cov_p_base=covs - heights[:, :, None] * heights[:, None]
    )


def _in_common(
    network: Network,
    fits: Sequence[MarkerFit],
    config: ResectionConfig,
    calibration: Calibration | None,
) -> Network:
    """Return the network with what all stations share: rig, sensor, and optics of the beams."""
    ups_base = network.R_station_base[network.sightings[:, 0], 2]
    sigmas = (_sigma_range(fits, config), config.sigma_range_scale, config.sigma_height)
    shared = Shared.of_sensor(network.p_base, ups_base, sigmas)
    network, optics = _with_common_optics(network, fits)
    shared = shared.joined(optics)
    if calibration is not None:
        rows = zip(network.sightings[:, 0], network.fits, strict=True)
        of_rig = [calibration.effects(network.stations[i], int(fit)) for i, fit in rows]
        shared = Shared(
            names=calibration.unknowns,
            derivatives=np.array(of_rig),
            prior_weights=calibration.weights,
        ).joined(shared)
    return replace(network, shared=shared)


def _sigma_range(fits: Sequence[MarkerFit], config: ResectionConfig) -> float:
    """Return the prior sigma of a common range bias: more where fits show that lasers differ."""
    reported = np.array([fit.sigma_range_shared for fit in fits])
    if not config.sigma_range or not np.isfinite(reported).all():
        return config.sigma_range
    return max(config.sigma_range, float(np.median(reported)))


def _with_common_optics(network: Network, fits: Sequence[MarkerFit]) -> tuple[Network, Shared]:
    """Return centres computed with the optics that all scans together show, and those as unknowns.

    Each scan has estimated its own. What beams of an unknown profile leave open is common to all.
    """
    rows = zip(network.sightings[:, 0].tolist(), fits, strict=True)
    found = {station: fit.optics for station, fit in rows if fit.optics is not None}
    if len(found) < len(network.stations):
        return network, Shared.none(len(fits))
    first = next(iter(found.values()))
    weights = np.diag(first.sigmas_prior**-2.0) + sum(one.weights for one in found.values())
    weighted = sum(one.weights @ one.estimates for one in found.values())
    cov = np.linalg.inv(weights)
    mean = cov @ np.asarray(weighted)
    off = np.array([mean - fit.optics.estimates for fit in fits if fit.optics is not None])
    towards, by_optics = unit(network.p_base), np.array([fit.range_by_optics for fit in fits])
    shifts = np.einsum("ni,nk,nk->ni", towards, by_optics, off)
    shared = Shared(
        names=OPTICS,
        derivatives=towards[:, :, None] * by_optics[:, None],
        prior_weights=np.linalg.inv(cov + np.diag(first.sigmas_profile**2)),
    )
    return replace(network, p_base=network.p_base - shifts), shared
