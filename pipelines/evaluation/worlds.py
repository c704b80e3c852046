"""Random worlds against their truth: detection, centres and stations, by family of world.

Each world is scanned once and processed with the rig that its log describes and with the default
settings. What was found is fitted again as a user would who knows the data sheets of the
instruments (``data_sheets``): where that alone mends a promise, the default does not describe the
instrument. Markers count by their true returns, so that a mark out of sight is not a missed one.
Other methods of detection can be run on the same scans.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from time import perf_counter
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.detection import extract
from spheremark.pipelines.errors import DegenerateGeometryError, SolveError, SpheremarkError
from spheremark.pipelines.evaluation.data_sheets import data_sheet, with_sheet
from spheremark.pipelines.evaluation.detection import (
    N_MANY,
    main_reasons,
    reason_near,
)
from spheremark.pipelines.evaluation.ellipse_coverage import LEVELS, pose_errors
from spheremark.pipelines.evaluation.experiment import Column, Experiment, Plain, Table
from spheremark.pipelines.geometry import inverse, rot_z, transform
from spheremark.pipelines.model import (
    Array,
    Index,
    MarkerCandidates,
    MarkerFits,
    Rig,
    StitchedCloud,
)
from spheremark.pipelines.positioning.resection import resect
from spheremark.pipelines.scan.stitching import beams, choose_rig, stitch
from spheremark.pipelines.simulation import random_world
from spheremark.pipelines.simulation.stands import GROUND, POLE
from spheremark.pipelines.simulation.worlds import PRIORS, Scan
from spheremark.pipelines.sphere import fit_markers
from spheremark.pipelines.sphere.bound import cramer_rao


class Peers(NamedTuple):
    """Other methods: their names, and a function of a module that runs them.

    It goes from points, (n, 3), and the radius [m] to centres, (k, 3), by name.
    """

    names: tuple[str, ...]
    find: Callable[[Array, float], Mapping[str, Array]]


N_FEW, N_LINES, HALF = 8, 2, 0.5
"""Returns and scan lines from which a marker should be found, and how much must be visible."""

CLASSES = (
    f"on a pole, {N_MANY} returns or more",
    f"{N_FEW} to {N_MANY - 1} returns, half visible",
    f"{N_FEW} returns or more, on one scan line",
    "fewer returns, or mostly hidden",
    f"on the ground, {N_FEW} returns or more",
    f"on something wide, {N_MANY} returns or more",
)
"""Classes of markers by returns, visible share and what they stand on. All but the third and the
fourth lie on two scan lines or more and are half visible; the second stand on anything."""

PROBABILITIES = (0.01, 0.1, 0.5, 0.9, 0.99, 0.999, 0.9999, 1.0)
"""Edges of the classes of probability for which its calibration is shown."""

RETURNS = (6, 8, 20, 50, 200)
"""Numbers of returns from which classes of groups begin."""

RATES = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0)
"""False markers in a scan for which the curve gives precision and recall."""

_OURS = ("ok", "weak", "possible")
_COMPARED = (*_OURS, "refused")
_METHOD, _RESECTION = "along_beam", "free_station"
_MEAN_DEPTH = 2.0 / 3.0  # of a sphere's radius: mean height of its surface over its disc
_NEAREST_MATCH = 0.06  # [m] at the least, within which a candidate is at a marker
_DECOY_REACH = 0.1  # [m] beyond a decoy and a marker's radius, within which a false one is at it
_NOWHERE = "ground, scattered rocks"


class Centre(NamedTuple):
    """A fitted marker: squared error [m^2], its bound [m^2], and that error over its covariance.

    ``square_anew`` is the latter in the mean over all biases that ranges may have in common.
    """

    status: str
    error2: float
    bound2: float
    square: float
    square_anew: float


class Common(NamedTuple):
    """Bias [m] and scale that all ranges of a LiDAR have, and their standard deviations."""

    bias: float
    scale: float
    sigma_bias: float
    sigma_scale: float


class Seen(NamedTuple):
    """A true marker in a scan: class, who found it, why it was missed, its centre, its returns."""

    kind: str
    found: tuple[str, ...]
    reason: str
    centre: Centre | None
    n_returns: int = 0


class Call(NamedTuple):
    """What was taken for a marker: by whom, how surely, which one or where, and its returns."""

    by: str
    score: float
    mark: int
    decoy: str
    n_returns: int = 0


class Station(NamedTuple):
    """A station: squared error of its position [m^2]; of pose and position over covariance."""

    status: str
    error2: float
    square: float
    square_position: float


class Sheet(NamedTuple):
    """What the settings of the data sheets make of the markers that were found in a scan."""

    centres: tuple[Centre, ...]
    station: Station | None


class Score(NamedTuple):
    """One scan against its truth, with default settings and with those of the data sheets."""

    seed: int
    family: str
    seen: list[Seen]
    calls: list[Call]
    decoys: list[str]
    station: Station | None
    failure: str
    seconds: float
    sheet: Sheet = Sheet((), None)


def worlds(
    n_worlds: int, first_seed: int = 0, peers: Peers | None = None
) -> Experiment[int, Score, Plain]:
    """Return the experiment that measures the whole chain in random worlds.

    Parameters
    ----------
    n_worlds : int
        Number of worlds, one scan of each.
    first_seed : int
        Seed of the first; every other one follows, so that even and odd ones are apart.
    peers : Peers, optional
        Other methods to run on the same scans.

    Returns
    -------
    Experiment
        Its report has recall by class of marker, false markers by kind of decoy, the curve of
        precision and recall, and errors over bound and covariance by family of world.
    """
    return Experiment(
        worlds=range(first_seed, first_seed + 2 * n_worlds, 2),
        run_world=partial(_score, peers=peers),
        pool=lambda scores: report_of(scores, first_seed, peers.names if peers else ()),
        tables=tables,
    )


def _score(seed: int, *, peers: Peers | None) -> Score:
    """Simulate one world, process its scan, and compare with the truth."""
    scan = random_world(seed)
    field, config = scan.world.field, SurveyConfig()
    decoys = [decoy.kind for decoy in field.decoys]
    try:
        rig = choose_rig(scan.log, None)
        cloud, rows = _tagged(scan, rig, config)
        start = perf_counter()
        found = extract(cloud, config.extraction, field.marker_radius)
        fits = fit_markers(_METHOD, cloud, found, config.fitting, field.marker_radius)
        seconds = perf_counter() - start
    except SpheremarkError as error:
        n_marks = len(field.marks.names)
        seen = [
            Seen(_class_of(scan, i), (), error.code, None, scan.stop.counts[i][0])
            for i in range(n_marks)
        ]
        return Score(seed, field.family, seen, [], decoys, None, str(error), 0.0)
    places = _places(scan, cloud, rows)
    calls, matched = _calls(scan, fits, places)
    if peers:
        by_name = peers.find(cloud.p_base.astype(np.float64), field.marker_radius)
        for name, centres in by_name.items():
            calls += _matched(scan, places, [(name, 1.0, p, 0) for p in centres])
    bounds = _bounds(scan)
    centres_of = _centres(scan, fits, matched, bounds)
    seen = [
        Seen(
            kind=_class_of(scan, i),
            found=tuple(sorted({call.by for call in calls if call.mark == i})),
            reason="" if i in centres_of else reason_near(found, places[i]),
            centre=centres_of.get(i),
            n_returns=scan.stop.counts[i][0],
        )
        for i in range(len(places))
    ]
    station = _station(scan, fits, config)
    sheet = _by_sheet(scan, rig, found, (places, bounds))
    return Score(seed, field.family, seen, calls, decoys, station, "", seconds, sheet)


def _by_sheet(
    scan: Scan, rig: Rig, found: MarkerCandidates, known: tuple[Array, Mapping[int, float]]
) -> Sheet:
    """Return centres and station with the settings of the data sheets, of the same candidates.

    ``known`` are the places of the marks in the scan, and the bounds of their centres.
    """
    places, bounds = known
    config, radius = data_sheet(scan.world), scan.world.field.marker_radius
    cloud, _ = _tagged(scan, with_sheet(rig, scan.world), config)
    fits = fit_markers(_METHOD, cloud, found, config.fitting, radius)
    _, matched = _calls(scan, fits, places)
    centres = tuple(_centres(scan, fits, matched, bounds).values())
    return Sheet(centres, _station(scan, fits, config))


def _tagged(scan: Scan, rig: Rig, config: SurveyConfig) -> tuple[StitchedCloud, Index]:
    """Return the stitched cloud, and the row of the log that each of its returns is."""
    tagged = replace(scan.log, intensities=_tags(len(scan.log.rings)))
    cloud = stitch(tagged, rig, config.stitching)
    rows = _rows(cloud.intensities)
    return replace(cloud, intensities=scan.log.intensities[rows]), rows


def _tags(n: int) -> NDArray[np.float32]:
    """Return numbers of rows as the bits of reflectivities, which are only carried along."""
    return np.arange(n, dtype=np.int32).view(np.float32)


def _rows(tags: NDArray[np.float32]) -> Index:
    """Return the numbers of rows that some tags are."""
    return tags.view(np.int32).astype(np.intp)


def _class_of(scan: Scan, mark: int) -> str:
    """Return the class of a marker by its true returns, lines, visible share and stance."""
    n, n_lines = scan.stop.counts[mark]
    about, name = scan.truth.about, scan.world.field.marks.names[mark]
    if about["visible_shares"][scan.stop.truth.name][name] < HALF or n < N_FEW:
        return CLASSES[3]
    if n_lines < N_LINES:
        return CLASSES[2]
    stand = scan.world.field.stands[mark]
    if stand == GROUND:
        return CLASSES[4]
    if n < N_MANY:
        return CLASSES[1]
    return CLASSES[0] if stand == POLE else CLASSES[5]


def _places(scan: Scan, cloud: StitchedCloud, rows: Index) -> Array:
    """Return where the scan shows each marker: its true returns say it, whatever the rig does."""
    field = scan.world.field
    places = transform(inverse(scan.stop.truth.T_site_base), field.marks.p_site)
    labels = scan.stop.marks[rows]
    for mark in range(len(places)):
        own = cloud.p_base[labels == mark].astype(np.float64)
        if len(own):
            middle = own.mean(axis=0)
            reach = float(np.linalg.norm(middle))
            places[mark] = middle * (1.0 + _MEAN_DEPTH * field.marker_radius / reach)
    return places


def _matched(
    scan: Scan, places: Array, found: Sequence[tuple[str, float, Array, int]]
) -> list[Call]:
    """Return what was taken for markers with the markers they are, each at most once."""
    field, taken = scan.world.field, set[int]()
    reach = max(field.marker_radius, _NEAREST_MATCH)
    T_base_site = inverse(scan.stop.truth.T_site_base)
    decoys = transform(T_base_site, np.array([d.p_site for d in field.decoys]).reshape(-1, 3))
    reaches = np.array([decoy.reach for decoy in field.decoys]) + field.marker_radius + _DECOY_REACH
    calls = []
    for by, score, p, n in found:
        gaps = np.linalg.norm(places - p, axis=1)
        mark = int(np.argmin(gaps)) if len(gaps) else -1
        if mark < 0 or gaps[mark] > reach or mark in taken:
            beyond = np.linalg.norm(decoys - p, axis=1) - reaches
            is_near = beyond.min(initial=np.inf) <= 0.0
            at = field.decoys[int(beyond.argmin())].kind if is_near else _NOWHERE
            if mark >= 0 and gaps[mark] <= 2.0 * reach:
                at = "a marker again"
            calls.append(Call(by, score, -1, at, n))
        else:
            taken.add(mark)
            calls.append(Call(by, score, mark, "", n))
    return calls


def _calls(scan: Scan, fits: MarkerFits, places: Array) -> tuple[list[Call], list[int]]:
    """Return our markers and other groups, sure ones first, and the mark of each fit."""
    fitted = [(fit.status.value, fit.probability, fit.p_base, len(fit.used)) for fit in fits.fits]
    order = sorted(range(len(fitted)), key=lambda i: (fitted[i][0], -fitted[i][1]))
    ours = [fitted[i] for i in order]
    for by, groups in (("possible", fits.possible), ("refused", fits.rejected)):
        others = [one for one in groups if one.probability >= PROBABILITIES[0]]
        others.sort(key=lambda one: -one.probability)
        ours += [(by, one.probability, one.p_base, one.n_points) for one in others]
    calls = _matched(scan, places, ours)
    marks = [-1] * len(fits.fits)
    for i, call in zip(order, calls, strict=False):
        marks[i] = call.mark
    return calls, marks


def _centres(
    scan: Scan, fits: MarkerFits, marks: Sequence[int], bounds: Mapping[int, float]
) -> dict[int, Centre]:
    """Return the errors of fitted centres by mark.

    The heading of a stop is not a centre's own: errors are without the one that all centres show,
    and squares without that which the other centres show.
    """
    true = transform(inverse(scan.stop.truth.T_site_base), scan.world.field.marks.p_site)
    matched = [(fit, mark) for fit, mark in zip(fits.fits, marks, strict=True) if mark >= 0]
    if not matched:
        return {}
    found, p = np.array([fit.p_base for fit, _ in matched]), true[[mark for _, mark in matched]]
    covs = np.array([fit.cov_p_base for fit, _ in matched])
    turn = _turn(found, p, covs) if len(matched) > 1 else 0.0
    errors = found @ rot_z(turn) - p  # exactly: clocks may turn a scan by degrees
    left, covs = _without_heading(errors, turn, p, (covs, fits.levelling.sigma_heading_station))
    squares, anew = _squares(left, covs), _anew(left, covs, p, _common(scan))
    return {
        mark: Centre(
            status=fit.status.value,
            error2=float(error @ error),
            bound2=bounds.get(mark, np.nan),
            square=float(square),
            square_anew=float(other),
        )
        for (fit, mark), error, square, other in zip(matched, errors, squares, anew, strict=True)
    }


def _turn(found: Array, p: Array, covs: Array) -> float:
    """Return by how much centres are turned about the vertical, by their weighted mean [rad]."""
    sideways, weights = _sideways(p), 1.0 / np.trace(covs, axis1=1, axis2=2)
    moved = np.sum(sideways * (found - p), axis=1)
    return float(np.arcsin(weights @ moved / (weights @ np.sum(sideways**2, axis=1))))


def _sideways(p: Array) -> Array:
    """Return how a heading moves centres, (n, 3) [m]."""
    return np.column_stack([-p[:, 1], p[:, 0], np.zeros(len(p))])


def _without_heading(
    errors: Array, turn: float, p: Array, known: tuple[Array, float]
) -> tuple[Array, Array]:
    """Return errors less the heading that prior and other centres show, and their covariances.

    ``errors`` are those of centres that were turned back; ``known`` are their covariances and the
    sigma of the heading [rad].
    """
    (covs, sigma), sideways = known, _sideways(p)
    weighted = np.linalg.solve(covs, sideways[:, :, None])[:, :, 0]
    own, shown = np.sum(weighted * sideways, axis=1), np.sum(weighted * errors, axis=1)
    variances = 1.0 / (sigma**-2.0 + own.sum() - own)
    headings = variances * (shown.sum() - shown - turn / sigma**2)
    added = variances[:, None, None] * sideways[:, :, None] * sideways[:, None, :]
    return errors - headings[:, None] * sideways, covs + added


def _squares(errors: Array, covs: Array) -> Array:
    """Return squared errors over covariances."""
    solved = np.linalg.solve(covs, errors[:, :, None])[:, :, 0]
    return np.asarray(np.sum(errors * solved, axis=1))


def _common(scan: Scan) -> Common:
    """Return what all ranges of a world have in common, and how worlds of its family differ."""
    optics, family = scan.world.config.optics, scan.world.field.family
    sigmas = (PRIORS[name].rms(family) for name in ("range_bias", "range_scale"))
    return Common(optics.range_bias, optics.range_scale, *sigmas)


def _anew(errors: Array, covs: Array, p: Array, common: Common) -> Array:
    """Return squares in the mean over LiDARs whose ranges err in common as their priors say.

    Bias and scale of all ranges are one number each for all centres of a world, and move a centre
    along its line of sight by as much. Their squares are replaced by those expected.
    """
    distances = np.linalg.norm(p, axis=1)
    sights = p / distances[:, None]
    drawn = common.bias + common.scale * distances
    expected = common.sigma_bias**2 + (common.sigma_scale * distances) ** 2
    rest = errors - drawn[:, None] * sights
    return np.asarray(_squares(rest, covs) + expected * _squares(sights, covs))


def _bounds(scan: Scan) -> dict[int, float]:
    """Return the least mean squared error of each marker that ranges allow [m^2].

    A bias that all ranges have in common is drawn anew for each world, as its prior says.
    """
    cloud, rows = _tagged(scan, scan.stop.rig, SurveyConfig())
    labels, config, field = scan.stop.marks[rows], scan.world.config, scan.world.field
    true = transform(inverse(scan.stop.truth.T_site_base), field.marks.p_site)
    sigmas = np.hypot(scan.stop.sigmas[rows], config.range_step / np.sqrt(12.0))
    common = PRIORS["range_bias"].rms(field.family)
    bounds = {}
    for mark in range(len(true)):
        own = np.flatnonzero(labels == mark)
        try:
            cov = cramer_rao(
                beams(cloud, own), true[mark], field.marker_radius, sigmas[own], common
            )
        except DegenerateGeometryError:
            continue
        bounds[mark] = float(np.trace(cov))
    return bounds


def _station(scan: Scan, fits: MarkerFits, config: SurveyConfig) -> Station | None:
    """Return the errors of the station on the true marks; None without one."""
    try:
        fix = resect(_RESECTION, fits, scan.world.field.marks, config.resection)
    except SolveError:
        return None
    pose = (fix.T_site_station, fix.cov_T_site_station)
    error, _, squares = pose_errors(pose, scan.stop.truth, fits.levelling)
    return Station(fix.status.value, float(error @ error), squares["pose"], squares["position"])


def report_of(scores: Sequence[Score], first_seed: int, peers: Sequence[str]) -> Plain:
    """Pool the scores of all scans.

    Parameters
    ----------
    scores : sequence of Score
        One for each world.
    first_seed : int
        Seed of the first.
    peers : sequence of str
        Names of other methods.

    Returns
    -------
    dict
        Rows of ``markers``, ``methods``, ``decoys``, ``curve``, ``calibration``, ``returns``,
        ``families`` and ``failures``.
    """
    seen = [one for score in scores for one in score.seen]
    calls = [call for score in scores for call in score.calls]
    present = Counter(kind for score in scores for kind in score.decoys)
    methods = (*_OURS, *peers)
    families = dict.fromkeys(score.family for score in scores)
    return {
        "n_worlds": len(scores),
        "first_seed": first_seed,
        "seconds": float(np.mean([score.seconds for score in scores])) if scores else None,
        "markers": [_recall([s for s in seen if s.kind == kind], kind, peers) for kind in CLASSES],
        "methods": [_precision(scores, name) for name in methods],
        "decoys": [_decoy(calls, kind, present[kind], methods) for kind in _kinds(calls, present)],
        "curve": [_at_rate(scores, rate) for rate in RATES],
        "calibration": [_calibration(calls, bounds) for bounds in pairwise(PROBABILITIES)],
        "returns": [_by_returns(seen, calls, bounds) for bounds in pairwise((*RETURNS, np.inf))],
        "families": [
            _family(name, [score for score in scores if score.family == name]) for name in families
        ]
        + ([_family("all", scores)] if len(families) > 1 else []),
        "failures": [
            {"seed": one.seed, "family": one.family, "reason": one.failure}
            for one in scores
            if one.failure
        ],
    }


def _recall(seen: Sequence[Seen], kind: str, peers: Sequence[str]) -> Plain:
    """Return how many markers of a class were found, by whom, and why not."""
    n = {name: sum(name in one.found for one in seen) for name in (*_OURS, *peers)}
    reasons = Counter(one.reason for one in seen if not one.found and one.reason)
    return {
        "class": kind,
        "n": len(seen),
        "n_ok": n["ok"],
        "n_weak": n["weak"],
        "n_possible": n["possible"],
        "share": _share(n["ok"] + n["weak"], len(seen)),
        **{f"share_{name}": _share(n[name], len(seen)) for name in peers},
        "reasons": dict(reasons.most_common()),
    }


def _share(n: int, of: int) -> float | None:
    """Return a share; None of nothing."""
    return n / of if of else None


def _precision(scores: Sequence[Score], name: str) -> Plain:
    """Return how many markers a method gave, and how many were false."""
    calls = [[call for call in score.calls if call.by == name] for score in scores]
    n = sum(len(own) for own in calls)
    false = [sum(call.mark < 0 for call in own) for own in calls]
    return {
        "method": name,
        "n": n,
        "n_false": sum(false),
        "precision": _share(n - sum(false), n),
        "false_per_scan": sum(false) / len(scores) if scores else None,
        "n_scans_with_false": sum(one > 0 for one in false),
    }


def _kinds(calls: Sequence[Call], present: Mapping[str, int]) -> list[str]:
    """Return the kinds of decoys, and where else there were false markers."""
    elsewhere = {call.decoy for call in calls if call.mark < 0} - set(present)
    return sorted(present) + sorted(elsewhere)


def _decoy(calls: Sequence[Call], kind: str, n: int, methods: Sequence[str]) -> Plain:
    """Return how often a kind of decoy was there, and was taken for a marker by each method."""
    own = Counter(call.by for call in calls if call.mark < 0 and call.decoy == kind)
    return {"decoy": kind, "n": n or None, **{f"n_{name}": own[name] for name in methods}}


def _at_rate(scores: Sequence[Score], rate: float) -> Plain:
    """Return precision and recall at the level that gives a rate of false markers in a scan."""
    calls = [call for score in scores for call in score.calls if call.by in _COMPARED]
    false = np.sort([call.score for call in calls if call.mark < 0])[::-1]
    n_allowed = int(rate * len(scores))
    level = float(false[n_allowed]) if n_allowed < len(false) else -np.inf
    n_true, of = Counter[str](), Counter(one.kind for score in scores for one in score.seen)
    for score in scores:
        for call in score.calls:
            if call.by in _COMPARED and call.mark >= 0 and call.score > level:
                n_true[score.seen[call.mark].kind] += 1
    n_false = int(np.sum(false > level))
    n = sum(n_true.values())
    return {
        "rate": rate,
        "level": level if np.isfinite(level) else None,
        "precision": _share(n, n + n_false),
        **{f"recall_{i}": _share(n_true[kind], of[kind]) for i, kind in enumerate(CLASSES)},
    }


def _calibration(calls: Sequence[Call], bounds: tuple[float, float]) -> Plain:
    """Return how many groups of some probability are markers."""
    low, high = bounds
    own = [
        call
        for call in calls
        if call.by in _COMPARED and low <= call.score and (call.score < high or high == 1.0)
    ]
    return {
        "probability": f"{low:g} to {high:g}",
        "n": len(own),
        "mean": _mean([call.score for call in own]),
        "share": _share(sum(call.mark >= 0 for call in own), len(own)),
    }


def _by_returns(seen: Sequence[Seen], calls: Sequence[Call], bounds: tuple[float, float]) -> Plain:
    """Return how many markers of so many true returns were found, and false ones of so many."""
    low, high = bounds
    marks = [one for one in seen if low <= one.n_returns < high]
    false = Counter(call.by for call in calls if call.mark < 0 and low <= call.n_returns < high)
    return {
        "returns": f"{low:g} or more" if high == np.inf else f"{low:g} to {high - 1:g}",
        "n": len(marks),
        **{f"n_{by}": sum(by in one.found for one in marks) for by in _OURS},
        **{f"false_{by}": false[by] for by in _OURS},
    }


def _family(name: str, scores: Sequence[Score]) -> Plain:
    """Return detection and errors in the worlds of one family."""
    seen = [one for score in scores for one in score.seen]
    many = [one for one in seen if one.kind == CLASSES[0]]
    n_false = Counter(call.by for score in scores for call in score.calls if call.mark < 0)
    centres = [_sure(one.centre for one in score.seen) for score in scores]
    stations = [_sure([score.station]) for score in scores]
    of_sheets = [_sure(score.sheet.centres) for score in scores]
    stations_of_sheets = [_sure([score.sheet.station]) for score in scores]
    together, placed = [c for own in centres for c in own], [s for own in stations for s in own]
    ratios = np.array([one.error2 / one.bound2 for one in together])
    squares = np.array([one.square for one in together])
    return {
        "family": name,
        "n_scans": len(scores),
        "recall": _share(sum("ok" in s.found or "weak" in s.found for s in many), len(many)),
        **{f"false_{by}": n_false[by] / len(scores) if scores else None for by in _OURS},
        "n_centres": len(together),
        "rms_m": _root([one.error2 for one in together]),
        "rms_over_bound": _root(ratios[np.isfinite(ratios)]),
        **_promise("", [[one.square / 3.0 for one in own] for own in centres]),
        **_promise("anew_", [[one.square_anew / 3.0 for one in own] for own in centres]),
        **{
            f"within_{round(100 * level)}": _mean(squares <= chi2.ppf(level, 3)) for level in LEVELS
        },
        **_promise("sheet_", [[one.square / 3.0 for one in own] for own in of_sheets]),
        **_promise("sheet_anew_", [[one.square_anew / 3.0 for one in own] for own in of_sheets]),
        "n_stations": len(placed),
        "station_rms_m": _root([one.error2 for one in placed]),
        **_promises_of_stations("", stations),
        **_promises_of_stations("sheet_", stations_of_sheets),
    }


def _promises_of_stations(prefix: str, stations: Sequence[Sequence[Station]]) -> Plain:
    """Return the means of squares over promise of the stations of worlds."""
    poses = [[one.square / 6.0 for one in own] for own in stations]
    positions = [[one.square_position / 3.0 for one in own] for own in stations]
    return {
        **_promise(f"station_{prefix}", poses),
        **_promise(f"position_{prefix}", positions),
    }


_Result = TypeVar("_Result", Centre, Station)


def _sure(results: Iterable[_Result | None]) -> list[_Result]:
    """Return the results that are ok."""
    return [one for one in results if one is not None and one.status == "ok"]


def _promise(prefix: str, squares: Sequence[Sequence[float]]) -> Plain:
    """Return the mean of squares over promise, world by world, with its standard error."""
    mean, error = _of_worlds(squares)
    return {f"{prefix}nees": mean, f"{prefix}nees_se": error}


def _of_worlds(groups: Sequence[Sequence[float]]) -> tuple[float | None, float | None]:
    """Return the mean of all values, and its standard error by leaving each world out in turn.

    All results of a world share its errors: worlds are independent, results are not. One world
    alone has no standard error.
    """
    sums, counts = (np.array([f(own) for own in groups if own], float) for f in (sum, len))
    n = len(counts)
    if n < 2:
        return _mean([value for own in groups for value in own]), None
    left = (sums.sum() - sums) / (counts.sum() - counts)
    error = np.sqrt((n - 1) / n * np.sum((left - left.mean()) ** 2))
    return float(sums.sum() / counts.sum()), float(error)


def _mean(values: Any) -> float | None:
    """Return the mean; None of nothing."""
    return float(np.mean(values)) if len(values) else None


def _root(squares: Any) -> float | None:
    """Return the root of the mean of squares; None of nothing."""
    return float(np.sqrt(np.mean(squares))) if len(squares) else None


def tables(report: Plain) -> list[Table]:
    """Lay the report out in tables.

    Parameters
    ----------
    report : mapping
        What ``report_of`` gives.

    Returns
    -------
    list of Table
        Recall, precision, decoys, the curve, calibration, numbers of returns, families, and their
        promises.
    """
    names = [one["method"] for one in report["methods"]]
    peers = names[len(_OURS) :]
    title = (
        f"{report['n_worlds']} random worlds, every other seed from {report['first_seed']}; "
        f"detection and fitting take {report['seconds']:.2f} s a scan"
    )
    return [
        Table(title=title, columns=_recall_columns(peers), rows=report["markers"]),
        Table(title="Taken for markers", columns=_PRECISION, rows=report["methods"]),
        Table(title="At decoys", columns=_decoy_columns(names), rows=report["decoys"]),
        Table(title="By the level of decision", columns=_CURVE, rows=report["curve"]),
        Table(title="Probability against truth", columns=_CALIBRATION, rows=report["calibration"]),
        Table(title="By returns, of any visible share", columns=_RETURNS, rows=report["returns"]),
        Table(
            title="By family of world; centres and stations that are ok",
            columns=_FAMILY,
            rows=report["families"],
            notes=[
                f"Seed {one['seed']} ({one['family']}): {one['reason']}"
                for one in report["failures"]
            ],
        ),
        Table(
            title="Squared errors over promised ones, per degree of freedom",
            columns=_PROMISES,
            rows=report["families"],
            notes=_ABOUT_PROMISES,
        ),
    ]


def _recall_columns(peers: Sequence[str]) -> tuple[Column, ...]:
    """Return the columns of the table of recall."""
    return (
        Column("class", "markers"),
        Column.whole("n", "n"),
        *(Column(f"n_{name}", name, "", ",d") for name in _OURS),
        Column("share", "ok or weak", "%", ".1f"),
        *(Column(f"share_{name}", name, "%", ".1f") for name in peers),
        Column(main_reasons, "why not"),
    )


def _decoy_columns(methods: Sequence[str]) -> tuple[Column, ...]:
    """Return the columns of the table of decoys."""
    counts = (Column(f"n_{name}", name, "", ",d") for name in methods)
    return (Column("decoy", "decoy"), Column.whole("n", "in scans"), *counts)


def _promised(prefix: str, title: str) -> tuple[Column, Column]:
    """Return the columns of a mean square over promise, and of its standard error."""
    return (
        Column(f"{prefix}nees", title, "", ".2f"),
        Column(f"{prefix}nees_se", "+-", "", ".2f"),
    )


_PRECISION = (
    Column("method", "by"),
    Column.whole("n", "n"),
    Column.whole("n_false", "false"),
    Column("precision", "precision", "%", ".2f"),
    Column("false_per_scan", "false in a scan", "", ".3f"),
    Column.whole("n_scans_with_false", "scans with one"),
)
_CURVE = (
    Column("rate", "false in a scan", "", ".3f"),
    Column("level", "level", "", ".4f"),
    Column("precision", "precision", "%", ".2f"),
    *(Column(f"recall_{i}", kind, "%", ".1f") for i, kind in enumerate(CLASSES)),
)
_CALIBRATION = (
    Column("probability", "probability"),
    Column.whole("n", "groups"),
    Column("mean", "mean", "%", ".2f"),
    Column("share", "markers", "%", ".2f"),
)
_RETURNS = (
    Column("returns", "returns"),
    Column.whole("n", "markers"),
    *(Column(f"n_{name}", name, "", ",d") for name in _OURS),
    *(Column(f"false_{name}", f"false {name}", "", ",d") for name in _OURS),
)
_FAMILY = (
    Column("family", "family"),
    Column("n_scans", "scans", "", "d"),
    Column("recall", f"found, {N_MANY} returns", "%", ".1f"),
    *(Column(f"false_{name}", f"false {name}", "1/scan", ".2f") for name in _OURS),
    Column("n_centres", "centres", "", "d"),
    Column.mm("rms_m", "RMS"),
    Column("rms_over_bound", "RMS/bound", "", ".2f"),
    *(Column(f"within_{round(100 * p)}", f"in {round(100 * p)} %", "%", ".0f") for p in LEVELS),
    Column("n_stations", "stations", "", "d"),
    Column.mm("station_rms_m", "RMS"),
)
_PROMISES = (
    Column("family", "family"),
    Column("n_scans", "scans", "", "d"),
    *_promised("", "centres"),
    *_promised("anew_", "biases anew"),
    *_promised("sheet_", "by data sheets"),
    *_promised("sheet_anew_", "biases anew"),
    *_promised("position_", "stations' positions"),
    *_promised("position_sheet_", "by data sheets"),
    *_promised("station_", "with tilt and heading"),
    *_promised("station_sheet_", "by data sheets"),
)
_ABOUT_PROMISES = (
    "1 where promises hold. +-: standard error, by leaving out each world in turn.",
    "Biases anew: all ranges of a world err in common by one bias and one scale; with the squares "
    "that these are expected to have, not those drawn, a few worlds say more.",
    "By data sheets: what was found is fitted again with settings that know the sigmas of LiDAR, "
    "rig, AHRS and clocks. Where that alone mends a promise, the default settings describe another "
    "instrument.",
)
