"""The decision which groups are markers, which are possible ones, and why others are refused."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from spheremark.pipelines.config import ExtractionConfig
from spheremark.pipelines.detection.evidence import Evidence
from spheremark.pipelines.detection.features import N_RESOLVED, NOISE_MIN, RESOLUTION, Features
from spheremark.pipelines.detection.hypotheses import ABUNDANCE, ABUNDANCE_HELD, STONES, Physics
from spheremark.pipelines.detection.seeds import thinned
from spheremark.pipelines.detection.target import Target
from spheremark.pipelines.model import Array
from spheremark.pipelines.scan.rigs import BEAM_WINDOW

_OFF = 0.2  # returns off a sphere, at most, per return on it
_EXTENT_MIN = 0.4  # radii: one line of a scan shows no ball
_HALF_SEEN = 0.8  # radii: the returns of half a ball are as wide, but for those at its edges
_HIDDEN = 2.0  # as many returns before a ball as on it: two thirds of it are hidden
_SHADE = 0.4  # standard deviation, as a share, of one return's reflectivity: partly lit beams
_PAINT, _PAINTS = 0.1, 0.7  # the same of markers, by range and incidence; and of all things
_SHOWS_POLE, _NO_POLE = 0.9, 0.5  # markers that show poles; weight, at most, of what does not then
_N_PAINTS = 1.0  # things that the usual spread of paints counts for in a scan
_FINE = 0.25  # of the spread of markers: steps of the paint that is summed over
_TAIL = 3.0  # degrees of freedom of markers: some are dirty or in shade, or are none
_TAIL_OF_OTHERS = 6.0  # of the paint of other things: one or two in a hundred are unlike the rest
_THING = 2.0  # m: of one thing, at most, are groups no farther apart
_BESIDE = 3.0  # radii: two groups that are nearer share returns
_UNLIKE = -2.0  # logarithm of odds by paint from which a reason states it
_FLAT = 0.236  # of the radius: standard deviation of the depths of a sphere about their mean
_N_LARGE, _N_KNOWN = 30, 3  # returns that show the noise of a scan, and groups that agree
_FEW_OFF = 0.05  # share of these that may lie beside such a group
_N_LEAST, _N_MOST = 6.0, 2500.0  # returns of the farthest and of the nearest markers
_SCATTERED = 0.5  # share of other objects that lie anywhere, and not where markers are put
_N_PRIOR = 5.0  # places that the usual abundance of a hypothesis counts for in a scan
_VARIES = (0.13, 0.15, 0.15, 0.1, 0.2, 0.04, 0.02)  # of what markers share, within a scan
_WINDOWS = (0.5, 1.0)  # of a VLP-16's width at its window, out or in: the first echo or the last
_N_OF_STONE = 6.0  # parameters of a stone's ellipsoid that returns show
_LEAST_INFORMATION = 1e-6  # of a group that shows nothing: next to none, but it can be inverted
UNDECIDED = 12.0
"""Logarithm of odds against a marker up to which it is compared again with better optics."""
_N_ROUNDS = 10
_MOST = 1e6  # times likelier: more says nothing


class Judgement(NamedTuple):
    """What a group is.

    Attributes
    ----------
    probability : float
        Posterior probability of a marker.
    other : str
        The most likely other hypothesis.
    ratio : float
        How many times likelier that is than a marker.
    """

    probability: float
    other: str
    ratio: float

    @property
    def hypothesis(self) -> str:
        """Return the other hypothesis with its odds, as words."""
        if self.ratio > 1.0:
            return f"{self.other}: {_times(self.ratio)} likelier"
        return f"{self.other}: {_times(1.0 / max(self.ratio, 1.0 / _MOST))} less likely"

    @property
    def reason(self) -> str:
        """Return why it is no marker, as a sentence."""
        text = f"{self.hypothesis[:1].upper()}{self.hypothesis[1:]} than a marker"
        return f"{text}, whose probability is {self.probability:.2g}."


def _times(ratio: float) -> str:
    """Return a ratio as words."""
    if ratio >= _MOST:
        return f"more than {_MOST:,.0f} times"
    return f"{ratio:.1f} times" if ratio < 10.0 else f"{ratio:,.0f} times"


def distinct(groups: list[Features], config: ExtractionConfig, radius: float) -> list[Features]:
    """Return the groups that pass the first test, each once, the best first."""
    worthy = [features for features in groups if _passes_first_gate(features, config, radius)]
    worthy.sort(key=lambda features: (-_support(features), features.x, features.y))
    places = np.array([features[:3] for features in worthy]).reshape(-1, 3)
    return [worthy[i] for i in thinned(places, 1.5 * radius)]


def _support(features: Features) -> float:
    """Return the support for a sphere: many returns that lie close to it."""
    return features.n_points / max(features.scatter, NOISE_MIN)


def _passes_first_gate(features: Features, config: ExtractionConfig, radius: float) -> bool:
    """Return whether a group has enough returns and about the size of the sphere."""
    return (
        features.n_points >= config.n_points_min
        and features.scatter > 0.0
        and max(features.width, features.height) > 0.8 * radius
    )


def reason_by_features(features: Features, radius: float) -> str:
    """Return why a group is examined no further; an empty string where it is."""
    if features.height < _EXTENT_MIN * radius:
        return (
            f"Its returns lie on one line, {1e3 * features.height:.0f} mm high: nothing shows "
            "whether it is round."
        )
    most = 2.0 + _OFF * features.n_points
    if features.n_off > most and not is_resolved(features, radius):
        return (
            f"It does not stand free: {features.n_off} returns at about its distance lie "
            f"neither on it nor below it, where {features.n_points} lie on it."
        )
    return ""


def reason_by_evidence(features: Features, evidence: Evidence, target: Target) -> str:
    """Return why a group is not compared; an empty string where it is."""
    if evidence.n_before > 2.0 + _HIDDEN * evidence.n_on:
        return (
            f"Most of it is hidden: {evidence.n_before} returns inside its outline lie before it, "
            f"where {evidence.n_on} lie on it."
        )
    is_strip = features.width < _HALF_SEEN * target.radius
    if evidence.silent is None and is_strip and not evidence.shows_beside(target.radius):
        return (
            f"Its returns lie on a strip {1e3 * features.width:.0f} mm wide, and the scan does not "
            "show whether it looked beside it: nothing shows whether it is round."
        )
    return ""


def paint_of(
    groups: Sequence[Evidence], places: Array, probabilities: Sequence[float], radius: float
) -> tuple[Array, list[str]]:
    """Return how much likelier the reflectivity of each group is if it is a marker.

    All markers have the same paint, other things have any. What it is, the other groups show: each
    is painted as markers are with its probability, or is anything. How unlike the paints of other
    things are, they show too: where all look alike, paint says nothing. A few are darker or
    brighter than all the rest. Neither does paint say anything where groups near by are painted
    alike, for they may be parts of one thing. Some markers are dirty or in shade: but what nothing
    shows a pole of must be painted as they are, and says little of how where others show theirs.
    Without a return on it a group shows no paint.

    Parameters
    ----------
    groups : sequence of Evidence
        Groups of a scan.
    places : (n, 3)
        Where they are [m].
    probabilities : sequence of float
        That each is a marker, by shape and surroundings.
    radius : float
        Of the markers [m].

    Returns
    -------
    (n,), list of str
        Logarithms of the ratios; and where one is much against a marker, that as a sentence.
    """
    ratios, texts = np.zeros(len(groups)), [""] * len(groups)
    seen = [i for i, evidence in enumerate(groups) if evidence.n_on > 0]
    if not seen:
        return ratios, texts
    shown = [groups[i] for i in seen]
    ratios[seen], means = _log_ratios(shown, places[seen], np.asarray(probabilities)[seen], radius)
    for i, mean in zip(seen, means, strict=True):
        if ratios[i] < _UNLIKE:
            own, usual = groups[i].brightness, np.exp(mean)
            texts[i] = f" Its reflectivity is {own:.0f}, that of the markers {usual:.0f}."
    return ratios, texts


def _log_ratios(
    groups: Sequence[Evidence], places: Array, probabilities: Array, radius: float
) -> tuple[Array, Array]:
    """Return what ``paint_of`` does, of groups with returns; and logarithms of markers' paint."""
    logs = np.log([max(evidence.brightness, 1.0) for evidence in groups])[:, None]
    n_distinct = np.array([evidence.n_distinct for evidence in groups])[:, None]
    has_pole = np.array([evidence.shows_below for evidence in groups])[:, None]
    variances, middle = _PAINT**2 + _SHADE**2 / n_distinct, float(np.median(logs))
    shares = np.minimum(probabilities, 1.0 - 1.0 / _MOST)[:, None]
    if np.sum(shares[has_pole]) > _SHOWS_POLE:
        shares = np.where(has_pole, shares, np.minimum(shares, _NO_POLE))
    wide = variances + _PAINTS**2 * _spread(logs - middle, 1.0 - shares)
    reach = 3.0 * _PAINTS  # beyond which no paint of markers is expected
    paints = np.arange(logs.min() - reach, logs.max() + reach, _FINE * _PAINT)
    squares = (logs - paints) ** 2 / variances
    ratios = _log_density(np.where(has_pole, _tailed(squares, _TAIL), squares), variances)
    alone = _log_density(_tailed((logs - middle) ** 2 / wide, _TAIL_OF_OTHERS), wide)
    ratios -= _log_beside((logs, variances), alone, places, 1.0 - shares, radius)
    own = np.log1p(shares * np.expm1(ratios))
    known = own.sum(axis=0) - own - 0.5 * ((paints - middle) / _PAINTS) ** 2
    known -= np.logaddexp.reduce(known, axis=1, keepdims=True)
    return np.logaddexp.reduce(known + ratios, axis=1), np.exp(known) @ paints


def _log_beside(
    paints: tuple[Array, Array], alone: Array, places: Array, weights: Array, radius: float
) -> Array:
    """Return the logarithms of densities of paint, (n, 1), if each may be a part of what is near.

    It is a part of one of m things near by with a probability of m/(m + 1), as in Pólya's urn.
    """
    logs, variances = paints
    pairs = KDTree(places).query_pairs(_THING, output_type="ndarray")
    apart = np.linalg.norm(places[pairs[:, 0]] - places[pairs[:, 1]], axis=1)
    i, j = pairs[apart > _BESIDE * radius].T
    i, j = np.append(i, j), np.append(j, i)
    both = variances[i] + variances[j]
    like = np.exp(_log_density((logs[i] - logs[j]) ** 2 / both, both))
    n = len(logs)
    total = np.bincount(i, (weights[j] * like)[:, 0], n)[:, None]
    n_near = np.bincount(i, weights[j, 0], n)[:, None]
    return np.log(np.exp(alone) + total) - np.log1p(n_near)


def _spread(off: Array, weights: Array) -> float:
    """Return the variance of the paint of all things in a scan, as a share of the usual one."""
    shown = np.sum(weights * (off / _PAINTS) ** 2)
    return float((_N_PAINTS + shown) / (_N_PAINTS + np.sum(weights)))


def _tailed(squares: Array, freedom: float) -> Array:
    """Return squares by which a normal density becomes Student's, but for a constant near one."""
    return np.asarray((freedom + 1.0) * np.log1p(squares / freedom))


def _log_density(squares: Array, variances: Array | float) -> Array:
    """Return the logarithms of densities, but for a constant, given squares over the variances."""
    return np.asarray(-0.5 * squares - 0.5 * np.log(variances))


def noise_of(groups: list[Features], radius: float) -> float:
    """Return the noise of ranges that groups with many returns agree on; NaN if these are few.

    Those that a plane fits as well are no spheres, and show none. Where too few stand free, those
    with a few returns beside them count, as of a panel behind.
    """
    for off_max in (0.0, _FEW_OFF):
        known = [
            max(features.scatter, NOISE_MIN)
            for features in groups
            if features.n_points >= _N_LARGE
            and features.n_off <= off_max * features.n_points
            and features.scatter < _FLAT * radius
        ]
        if len(known) >= _N_KNOWN:
            return median(known)
    return float("nan")


def shared_of(
    shown: tuple[Array, Array],
    probabilities: Sequence[float],
    physics: Sequence[Physics],
    half_widths: Array,
) -> tuple[Array, Array]:
    """Return what the markers of a scan have in common, for each group as all others show it.

    Parameters
    ----------
    shown : (n, 7), (n, 7, 7)
        What each shows as a sphere, as in ``Physics``, and the covariances.
    probabilities : sequence of float
        That each is a marker: by as much it counts.
    physics : sequence of Physics
        With which these were computed.
    half_widths : (n,)
        Half the width of a beam at each [m].

    Returns
    -------
    (n, 7), (n, 7)
        Means, and standard deviations that contain how far markers of a scan differ.

    Notes
    -----
    Some of them are no markers: each counts by Student's distribution about the others, too.
    How wide beams are where they leave the sensor moves both edges the more the nearer a marker is.
    """
    (values, covs), n, varies = shown, len(_VARIES), np.diag(np.array(_VARIES) ** 2)
    means = np.array([one.shared for one in physics])
    priors = np.array([np.diag(one.sigmas**-2.0) for one in physics])
    own = np.linalg.inv(covs) - priors  # information of the beams alone, and what they show
    own += _LEAST_INFORMATION * np.eye(n)
    alone = np.linalg.solve(
        own, np.linalg.inv(covs) @ values[:, :, None] - priors @ means[:, :, None]
    )
    spreads = np.linalg.inv(own) + varies
    every = np.linalg.inv(spreads)
    shares = np.asarray(probabilities, np.float64)
    by = _by_windows(half_widths)
    sigmas = np.hstack([[one.sigmas for one in physics], np.tile(_WINDOWS, (len(means), 1))])
    first = sigmas[:, :, None] ** -2.0 * np.eye(n + 2)
    begun = first[:, :, :n] @ means[:, :, None]
    counts, found, known = shares, means, np.linalg.inv(priors)
    for _ in range(_N_ROUNDS):
        weights = by.transpose(0, 2, 1) @ (counts[:, None, None] * every)
        pulls, weights = weights @ alone, weights @ by
        cov = np.linalg.inv(first + weights.sum(axis=0) - weights)
        found = (by @ cov @ (begun + pulls.sum(axis=0) - pulls))[:, :, 0]
        known = by @ cov @ by.transpose(0, 2, 1)
        off = alone[:, :, 0] - found
        squares = np.einsum("ni,nij,nj->n", off, np.linalg.inv(spreads + known), off)
        counts = shares * (_TAIL + n) / (_TAIL + squares)
    return found, np.sqrt(np.diagonal(known + varies, axis1=1, axis2=2))


def stones_of(
    scatters: Array,
    n_returns: Sequence[int],
    shares: Array,
    physics: Sequence[Physics],
    usual: Array,
) -> tuple[Array, Array]:
    """Return how rough the stones of a scan are, for each group as all others show it.

    Parameters
    ----------
    scatters : (n,)
        Logarithm of how far the surface of each lies about the best ellipsoid [radii], noise and
        all; NaN where no stone was sought.
    n_returns : sequence of int
        Of each.
    shares : (n,)
        Probabilities that each is a stone: by as much it counts.
    physics : sequence of Physics
        With which these were computed.
    usual : (n,)
        The same logarithm as it is expected of each before any stone is seen.

    Returns
    -------
    (n,), (n,)
        Means of the logarithms, and standard deviations that contain how far stones differ.

    Notes
    -----
    The logarithm of the scatter of n returns about p parameters has a variance of 1/(2 (n - p)).
    What each shows alone is its best scatter without the prior that it was fitted with.
    """
    within, between = STONES
    fitted = 0.5 / np.maximum(np.asarray(n_returns, np.float64) - _N_OF_STONE, 1.0)
    begun, sigmas = np.array([one.stones for one in physics]).T
    alone = np.nan_to_num(scatters + (scatters - begun) * fitted / sigmas**2)
    weights = np.where(np.isfinite(scatters), shares, 0.0) / (within**2 + fitted)
    pulls = weights * alone
    total = between**-2 + weights.sum() - weights
    return (usual / between**2 + pulls.sum() - pulls) / total, np.hypot(within, total**-0.5)


def gates_of(by_gate: Array, probabilities: Sequence[float]) -> Array:
    """Return how probable each of ``GATES`` is in a scan, (9,).

    Parameters
    ----------
    by_gate : (n, 9)
        Logarithms of the likelihoods of some groups as spheres.
    probabilities : sequence of float
        That each is a marker: by as much it counts.

    Notes
    -----
    Half of the prior is for none: then no echo lies between two surfaces. A shape before nothing
    shows nothing of a gate.
    """
    prior = np.full(by_gate.shape[1], 0.5 / (by_gate.shape[1] - 1))
    prior[0] = 0.5
    logs = np.asarray(probabilities) @ by_gate + np.log(prior)
    shares = np.exp(logs - logs.max())
    return np.asarray(shares / shares.sum())


def _by_windows(half_widths: Array) -> Array:
    """Return what each group shows by what all share and by two widths at the window, (n, 7, 9)."""
    n = len(_VARIES)
    by = np.zeros((len(half_widths), n, n + 2))
    by[:, :, :n] = np.eye(n)
    is_wide = half_widths > 0.0  # rays have no edges that a window moves
    by[is_wide, 1, n] = 0.5 * BEAM_WINDOW.mean() / half_widths[is_wide]
    by[:, 2, n + 1] = by[:, 1, n]
    return by


def posteriors_of(
    log_likelihoods: Array, n_returns: Sequence[int], is_free: Sequence[bool]
) -> Array:
    """Return the logarithms of the probabilities of all hypotheses, of each group, (n, k).

    How often a scan shows each hypothesis is estimated from all its groups (empirical Bayes): among
    trees, a group that might be leaves is rather leaves. Those that stand free, as on poles, say
    nothing of those that do not. With the distance the ground grows that may hold other objects,
    while markers are put at all distances alike, in the logarithm.
    """
    n = np.maximum(np.asarray(n_returns, np.float64), _N_LEAST)  # densities: 1 / n^2 and 1 / n
    odds = _SCATTERED * _N_LEAST * np.log(_N_MOST / _N_LEAST) / n + 1.0 - _SCATTERED
    posteriors = log_likelihoods.copy()
    posteriors[:, 1:] += np.log(odds)[:, None]
    free = np.asarray(is_free, np.bool_)
    for own, abundance in ((free, ABUNDANCE), (~free, ABUNDANCE_HELD)):
        posteriors[own] = shares_of(posteriors[own], abundance)[1]
    return posteriors


def judgement_of(posteriors: Array, names: Sequence[str]) -> Judgement:
    """Return what a group is.

    Parameters
    ----------
    posteriors : (k,)
        Logarithms of the probabilities of all hypotheses, the marker first.
    names : sequence of str
        What each is called.

    Returns
    -------
    Judgement
        The probability of a marker, and the best other hypothesis.
    """
    other = 1 + int(np.argmax(posteriors[1:]))
    ratio = np.exp(np.clip(posteriors[other] - posteriors[0], -30, 30))
    return Judgement(float(np.exp(posteriors[0])), names[other], float(ratio))


def shares_of(log_likelihoods: Array, abundance: Sequence[int] = ABUNDANCE) -> tuple[Array, Array]:
    """Return how often each hypothesis is met among groups, and the log posteriors of each group.

    Parameters
    ----------
    log_likelihoods : (n, k)
        Of each group by each hypothesis.
    abundance : sequence of int
        How often each is usually met.

    Returns
    -------
    (k,), (n, k)
        Shares, by expectation maximisation from the usual abundance; logarithms of probabilities.
    """
    usual = _N_PRIOR * np.array(abundance) / sum(abundance)
    shares, posteriors = usual / _N_PRIOR, log_likelihoods
    for _ in range(_N_ROUNDS):
        posteriors = log_likelihoods + np.log(shares)
        posteriors -= np.logaddexp.reduce(posteriors, axis=1, keepdims=True)
        shares = usual + np.exp(posteriors).sum(axis=0)
        shares /= shares.sum()
    return shares, posteriors


def sure_ones(probabilities: Sequence[float], false_rate: float) -> list[bool]:
    """Return which groups are markers: as many as hold no more false ones than that, on average.

    The expected number of false ones is the sum of the probabilities that each is false.
    """
    risks = 1.0 - np.asarray(probabilities, np.float64)
    order = np.argsort(risks, kind="stable")
    is_sure = np.zeros(len(risks), np.bool_)
    is_sure[order] = np.cumsum(risks[order]) <= false_rate
    return list(is_sure.tolist())


def is_resolved(features: Features, radius: float) -> bool:
    """Return whether the shape is so clear that the sphere need not stand free to be accepted."""
    return features.n_points >= N_RESOLVED and features.scatter < RESOLUTION * radius
