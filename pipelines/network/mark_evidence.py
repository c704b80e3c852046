"""What all stations of a survey together say of each mark: their evidence adds up.

Each station that is near enough says one of five things of a place: a marker, a possible one,
another object, nothing, or that something hides it. Likelihoods of the hypotheses of ``detection``,
and of an object that moves, are multiplied over the stations.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from spheremark.pipelines.config import ResectionConfig
from spheremark.pipelines.detection.decision import judgement_of, shares_of
from spheremark.pipelines.detection.hypotheses import ABUNDANCE
from spheremark.pipelines.detection.shapes import NAMES
from spheremark.pipelines.geometry import transform
from spheremark.pipelines.model import Array, Column, MarkerFit, MarkerFits, Rejection, Status
from spheremark.pipelines.model.network import Decision, Finding, MarkEvidence, StationEvidence

if TYPE_CHECKING:
    from spheremark.pipelines.network.assembly import _Map

_HYPOTHESES = (*NAMES, "object that moves", "sphere of nearly that radius")
_NEARLY = -1  # place of the last, which scans do not tell from a marker: their radii together do
_ERROR = 0.01  # share of the stations whose evidence is worth nothing: ``extraction.false_rate``
_MISSED = 0.03  # of the markers that a station sees well: 97 % of those with 8 returns are found
_HIDDEN = 0.2  # of the markers near enough, where nothing shows what hides them
_UNGROUPED = 0.5  # of the other objects, which detection need not list
_MOVES = 0.1  # share of the places of objects that move
_ALIKE = 0.002  # of other balls within a span of radii about the marker's, as in ``detection``,
_SPAN = 0.3  # which is this, of its radius
_THERE = 0.1  # share of the stations at which these are at one place
_AT_CONTROL = 0.99  # prior probability of a marker at a control mark
_TWICE = np.sqrt(0.5)  # of a distance, from where twice as many beams meet a marker
_CONE = np.cos(np.radians(1.0))  # directions about a place that show what hides it
_N_CONE = 5  # returns there that show it
_BEFORE, _PAST = 0.25, 0.5  # shares of these that hide it, and that show that nothing is there
_DEPTH = 0.4  # [m] about a place within which a return belongs to an object there
_N_HOLD = 3  # marks that a station keeps, refused ones included
_SIGMA_RADIUS = 0.002  # [m] of the mean radius, by optics that all scans share: 6 mm at most
_OTHER_RADIUS = NAMES.index("sphere of another radius")
_NO_EVIDENCE = np.zeros(len(_HYPOTHESES))

Scan = tuple[str, MarkerFits]
Labels = Mapping[tuple[int, int], int]


class Weighed(NamedTuple):
    """What the evidence makes of the marks of a map.

    Attributes
    ----------
    evidence : tuple of MarkEvidence
        Of all marks that a station shows, in the order of the map.
    suspicions : dict of int to str
        Why a mark that stays may be false.
    dropped : dict of (int, int) to (int, str)
        The mark of a fit of a station that is refused, and why.
    confirmed : dict of (int, int) to int
        Mark of each possible fit of a station that enters the network.
    """

    evidence: tuple[MarkEvidence, ...]
    suspicions: dict[int, str]
    dropped: dict[tuple[int, int], tuple[int, str]]
    confirmed: dict[tuple[int, int], int]


class _Shown(NamedTuple):
    """What a station shows at a place: log likelihoods of all hypotheses, and a fit or words."""

    finding: Finding
    log_likelihoods: Array
    fit: MarkerFit | None = None
    reason: str = ""


def weigh_marks(
    scans: Sequence[Scan],
    found: _Map,
    used: dict[int, list[tuple[int, int]]],
    config: ResectionConfig,
) -> Weighed:
    """Return the evidence on all marks of a map, and what it makes of them.

    Possible markers that are no marks yet enter the map. A refused mark leaves the network unless a
    station would keep too few others.
    """
    possible = _place_possible(scans, found, config.match_tolerance)
    sure = {(i, f): m for i, marks in found.marks_of.items() for f, m in enumerate(marks) if m >= 0}
    shown, ranges = _shown(scans, found, sure, possible, config)
    anywhere = _log_priors(scans)
    n_marks = {i: len(pairs) for i, pairs in used.items()}
    out, evidence = Weighed((), {}, {}, {}), []
    for mark in sorted({*sure.values(), *possible.values()}):
        is_control = mark < found.n_control
        prior = _at_control(anywhere) if is_control else anywhere
        one = _evidence(scans, found, mark, (prior, shown[mark], ranges[mark]), config.false_rate)
        evidence.append(one)
        own = [(i, f) for (i, f), m in sure.items() if m == mark and i in used]
        stations = [i for i, f in own if (f, mark) in used[i]]
        reason = _reason(one, shown[mark])
        if one.decision is Decision.CONFIRMED:
            out.confirmed.update({key: m for key, m in possible.items() if m == mark})
        elif (
            one.decision is Decision.REFUSED
            and not is_control
            and all(n_marks[i] > _N_HOLD for i in stations)
        ):
            out.dropped.update(dict.fromkeys(own, (mark, reason)))
            for i in stations:
                n_marks[i] -= 1
        elif one.decision is Decision.REFUSED or not is_control:
            out.suspicions[mark] = reason
    return out._replace(evidence=tuple(evidence))


def _place_possible(scans: Sequence[Scan], found: _Map, near: float) -> dict[tuple[int, int], int]:
    """Return the mark of each possible marker; those that are near none become marks."""
    marks: dict[tuple[int, int], int] = {}
    for i, T in found.poses.items():
        taken = set(found.marks_of[i])
        for k, fit in enumerate(scans[i][1].possible_fits):
            p = transform(T, fit.p_base)
            off = np.linalg.norm(np.array(found.p_site) - p, axis=1)
            mark = int(off.argmin())
            if off[mark] > near:
                mark = found.add_mark(p, T[:3, :3] @ fit.cov_p_base @ T[:3, :3].T)
            if mark not in taken:
                taken.add(mark)
                marks[i, k] = mark
    return marks


def _log_priors(scans: Sequence[Scan]) -> Array:
    """Return the logarithms of the shares of all hypotheses among the groups of all stations."""
    logs = [
        logs
        for _, fits in scans
        for logs in (
            *(fit.log_likelihoods for fit in (*fits.fits, *fits.possible_fits)),
            *(one.log_likelihoods for one in fits.rejected),
        )
        if len(logs)
    ]
    shares, _ = shares_of(np.array(logs).reshape(-1, len(NAMES)))
    usual = (1.0 - _MOVES) * shares
    return np.asarray(np.log([*usual, _MOVES, _ALIKE * usual[_OTHER_RADIUS]]))


def _at_control(log_priors: Array) -> Array:
    """Return the priors at a control mark, from those at any place."""
    others = np.log(1.0 - _AT_CONTROL) - np.logaddexp.reduce(log_priors[1:])
    return np.append(np.log(_AT_CONTROL), log_priors[1:] + others)


def _shown(
    scans: Sequence[Scan], found: _Map, sure: Labels, possible: Labels, config: ResectionConfig
) -> tuple[dict[int, dict[int, _Shown]], Array]:
    """Return what each station shows of each mark near it, by mark, and their distances [m]."""
    p_site = np.array(found.p_site)
    seen = {(i, m): scans[i][1].fits[f] for (i, f), m in sure.items()}
    may_be = {(i, m): scans[i][1].possible_fits[k] for (i, k), m in possible.items()}
    ranges = np.full((len(p_site), len(scans)), np.inf)
    for i, T in found.poses.items():
        ranges[:, i] = np.linalg.norm(p_site - T[:3, 3], axis=1)
    reach = np.zeros(len(p_site))
    for i, mark in (*seen, *may_be):
        reach[mark] = max(reach[mark], ranges[mark, i])
    shown: dict[int, dict[int, _Shown]] = {mark: {} for mark in range(len(p_site))}
    for i, T in found.poses.items():
        fits, sample = scans[i][1], scans[i][1].sample_base
        usual = float(np.median([np.linalg.norm(fit.p_base) for fit in fits.fits]))
        near = np.flatnonzero(ranges[:, i] < np.maximum(reach + 0.1, usual * bool(len(sample))))
        p_base = (p_site[near] - T[:3, 3]) @ T[:3, :3]
        groups, beams = _Groups.of(fits), _Beams.of(sample)
        for mark, p in zip(near.tolist(), p_base, strict=True):
            if (i, mark) in seen:
                shown[mark][i] = _of_fit(seen[i, mark], Finding.MARKER)
            elif (i, mark) in may_be:
                shown[mark][i] = _of_fit(may_be[i, mark], Finding.POSSIBLE)
            elif group := groups.at(p, config.match_tolerance + fits.fits[0].radius):
                shown[mark][i] = _of_group(group)
            else:
                is_clear = ranges[mark, i] < max(_TWICE * reach[mark], usual)
                shown[mark][i] = _of_beams(beams, p, is_clear=is_clear)
    return shown, ranges


class _Beams(NamedTuple):
    """Beams of a station: unit vectors, (n, 3), where they end [m], and the greatest sine of all.

    A gimbal turns the beams through all azimuths: elevations of returns show where pulses go.
    """

    towards: Column
    ranges: Column
    highest: float

    @property
    def n_usual(self) -> float:
        """Number of beams about a direction, in the mean."""
        return float(0.5 * (1.0 - _CONE) * len(self.ranges))

    @classmethod
    def of(cls, sample_base: Column) -> _Beams:
        """Return those of a sample of returns."""
        ranges = np.linalg.norm(sample_base, axis=1)
        towards = sample_base / ranges[:, None]
        return cls(towards, ranges, float(towards[:, 2].max(initial=-1.0)))


class _Groups(NamedTuple):
    """The groups of a station that are no markers, and where they are, (n, 3)."""

    groups: tuple[Rejection, ...]
    p_base: Array

    @classmethod
    def of(cls, fits: MarkerFits) -> _Groups:
        """Return those of a station."""
        groups = (*fits.possible, *fits.rejected)
        return cls(groups, np.array([one.p_base for one in groups]).reshape(-1, 3))

    def at(self, p_base: Array, near: float) -> Rejection | None:
        """Return the group nearest to a place; one that was compared comes first."""
        off = np.linalg.norm(self.p_base - p_base, axis=1)
        is_bare = np.array([not len(one.log_likelihoods) for one in self.groups], dtype=np.bool_)
        ordered = np.lexsort((off, is_bare[: len(off)]))
        return next((self.groups[k] for k in ordered if off[k] < near), None)


def _of_fit(fit: MarkerFit, finding: Finding) -> _Shown:
    """Return what a marker, or a possible one, says of its place."""
    logs = fit.log_likelihoods
    if not len(logs):  # centres of others: whether it is a marker was decided by their status
        logs = np.full(len(NAMES), -np.inf if fit.status is Status.OK else 0.0)
        logs[0] = 0.0
    return _Shown(finding, _of_all(logs), fit, fit.hypothesis)


def _of_group(group: Rejection) -> _Shown:
    """Return what a group says that is no marker; one that was not compared is another object."""
    if len(group.log_likelihoods):
        return _Shown(Finding.REFUSED, _of_all(group.log_likelihoods), None, group.reason)
    return _Shown(Finding.REFUSED, _not_found(_MISSED, 1.0, _THERE), None, group.reason)


def _of_beams(beams: _Beams, p_base: Array, *, is_clear: bool) -> _Shown:
    """Return what the beams towards a place say where no group is.

    ``is_clear``: from there a marker has returns enough to be found.
    """
    distance = float(np.linalg.norm(p_base))
    if not len(beams.ranges):
        return _Shown(Finding.NOTHING, _unknown())
    ranges = beams.ranges[beams.towards @ (p_base / distance).astype(np.float32) > _CONE]
    n, n_before = len(ranges), int(np.sum(ranges < distance - _DEPTH))
    n_past = int(np.sum(ranges > distance + _DEPTH))
    if n < _N_CONE and (beams.n_usual < _N_CONE or p_base[2] > beams.highest * distance):
        text = "It is above all beams that return, or these are few."
        return _Shown(Finding.HIDDEN, _NO_EVIDENCE, None, text)
    if n_before > _BEFORE * n:
        text = f"{n_before} of {n} beams towards it end before it."
        return _Shown(Finding.HIDDEN, _NO_EVIDENCE, None, text)
    if not is_clear:
        return _Shown(Finding.NOTHING, _unknown(), None, "It is too far for many returns.")
    if n < _N_CONE or n_past > _PAST * n:
        text = f"{n_past} of {n} beams towards it go past it."
        text = text if n >= _N_CONE else "The beams towards it meet nothing: they do not return."
        return _Shown(Finding.NOTHING, _not_found(_MISSED, _MISSED, 1.0 - _THERE), None, text)
    text = "The returns at its distance form no group that is like a sphere."
    return _Shown(Finding.REFUSED, _not_found(_MISSED, 1.0, _THERE), None, text)


def _unknown() -> Array:
    """Return log likelihoods of no group where a marker may be hidden."""
    return _not_found(_HIDDEN, _HIDDEN + (1.0 - _HIDDEN) * _UNGROUPED, 1.0 - _THERE)


def _not_found(marker: float, other: float, moving: float) -> Array:
    """Return log likelihoods, from the probabilities that no marker is found."""
    return np.log([marker, *(other,) * (len(NAMES) - 1), moving, marker])


def _of_all(logs: Array) -> Array:
    """Return log likelihoods of all hypotheses, from those of ``detection``.

    A share of all groups is worth nothing: no station decides alone.
    """
    own = np.log((1.0 - _ERROR) * np.exp(logs - logs.max()) + _ERROR)
    anything = np.logaddexp.reduce(own + np.log(np.array(ABUNDANCE) / sum(ABUNDANCE)))
    return np.array([*own, np.log(_THERE) + anything, own[0]])


def _evidence(
    scans: Sequence[Scan],
    found: _Map,
    mark: int,
    known: tuple[Array, Mapping[int, _Shown], Array],
    false_rate: float,
) -> MarkEvidence:
    """Return the evidence on a mark: of its prior, what stations show, and their distances."""
    prior, shown, ranges = known
    by_radius = _log_odds_of(_radius(shown.values()))
    total = prior + np.sum([one.log_likelihoods for one in shown.values()], axis=0)
    total[_NEARLY] -= by_radius
    logs = total - np.logaddexp.reduce(total)
    decision = Decision.DOUBTFUL
    if np.exp(logs[1:]).sum() <= false_rate:
        decision, logs = Decision.CONFIRMED, logs[:_NEARLY]  # of the decoys that scans can tell
    elif logs[0] < np.log(0.5):
        decision = Decision.REFUSED
    judgement, decoy = judgement_of(logs, _HYPOTHESES), 1 + int(np.argmax(logs[1:]))
    return MarkEvidence(
        mark=found.names[mark],
        p_site=np.array(found.p_site[mark]),
        decision=decision,
        probability=judgement.probability,
        decoy=judgement.other,
        hypothesis=judgement.hypothesis,
        log_odds_prior=float(prior[0] - prior[decoy]),
        log_odds_radius=by_radius if decoy == len(_HYPOTHESES) + _NEARLY else 0.0,
        log_odds=float(total[0] - total[decoy]),
        stations=tuple(
            StationEvidence(
                station=scans[i][0],
                marker="" if one.fit is None else one.fit.name,
                finding=one.finding,
                range=float(ranges[i]),
                log_odds=float(one.log_likelihoods[0] - one.log_likelihoods[decoy]),
                reason=one.reason,
            )
            for i, one in sorted(shown.items())
        ),
    )


def _reason(one: MarkEvidence, shown: Mapping[int, _Shown]) -> str:
    """Return why a mark may be false."""
    findings = [station.finding for station in one.stations]
    n, n_near = findings.count(Finding.MARKER), len(findings) - findings.count(Finding.HIDDEN)
    parts = [
        f"{one.hypothesis[:1].upper()}{one.hypothesis[1:]} than a marker, whose probability is "
        f"{one.probability:.2g}."
    ]
    if n < n_near:
        parts.insert(0, f"Only {n} of the {n_near} stations that stand near enough see it.")
    fits = [one.fit for one in shown.values() if one.finding is Finding.MARKER and one.fit]
    if fits and all(fit.status is Status.WEAK for fit in fits):
        parts.append(f"All {len(fits)} of its markers are weak: {fits[0].reason.rstrip('.')}.")
    radius = _radius(shown.values())
    if radius is not None and one.decoy == _HYPOTHESES[_NEARLY]:
        sizes = f"{1e3 * radius.mean:.0f} mm, sigma {1e3 * radius.sigma:.0f} mm"
        parts.append(f"Its own radius is {sizes}.")
    return " ".join(parts)


class _Radius(NamedTuple):
    """The mean of the own radii of the fits of a mark, its sigma, and the assumed one [m]."""

    mean: float
    sigma: float
    assumed: float


def _radius(shown: Iterable[_Shown]) -> _Radius | None:
    """Return the radius that the fits of a mark agree on; None where none determines it."""
    fits = [one.fit for one in shown if one.fit is not None]
    known = [fit for fit in fits if np.isfinite(fit.radius_free) and fit.sigma_radius_free > 0.0]
    if not known:
        return None
    weights = np.array([fit.sigma_radius_free**-2.0 for fit in known])
    mean = float(np.average([fit.radius_free for fit in known], weights=weights))
    return _Radius(mean, float(weights.sum() ** -0.5), known[0].radius)


def _log_odds_of(radius: _Radius | None) -> float:
    """Return how much likelier a marker makes its mean radius than a ball of nearly its radius."""
    if radius is None:
        return 0.0
    sigma = float(np.hypot(radius.sigma, _SIGMA_RADIUS))
    off, span = (radius.mean - radius.assumed) / sigma, _SPAN * radius.assumed
    return float(np.log(span / sigma / np.sqrt(2.0 * np.pi)) - 0.5 * off * off)
