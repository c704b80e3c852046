"""The decision whether a group is a marker: limits of every test, and the reasons as sentences.

A ``reason_...`` function returns why a group is rejected; an empty string if it passes.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot, inf, sqrt
from statistics import median
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.config import ExtractionConfig
from spheremark.pipelines.detection.evidence import Evidence
from spheremark.pipelines.detection.features import N_RESOLVED, NOISE_MIN, RESOLUTION, Features
from spheremark.pipelines.detection.hypotheses import LikelihoodRatios
from spheremark.pipelines.detection.seeds import thinned
from spheremark.pipelines.detection.target import Target

_TOUCHING = 0.10  # share of a ball's returns that may lie as far away beside it: mixed pixels
_UNEXPLAINED = 0.3  # share of the returns inside the outline that may be off the ball
_SIGMAS = 3.5  # standard deviations at which a shape is rejected
_RADIUS_FAR = 0.6  # of the radius: beams that are wide and few never err by as much
_RADIUS_SLACK = 0.12  # of the radius: less is no reason to refuse, the fit judges it
_N_SHAPELY = 12  # returns that show the width of a surface
_WIDTH_MIN = 0.5  # radii: least width
_WIDTH_SHOWN = 0.7  # radii: the same where enough returns show its whole width
_SCREENED = 0.5  # as many returns before a ball as on it: a third of it is hidden
_HEIGHT_MIN = 0.4  # radii: one line of a scan shows no ball
_FLAT_UNKNOWN = 1.5  # of the curvature: known no better, it may be a ball, a plane or a hollow
_SPREAD_SIGMAS = 4.0  # standard deviations of a spread: centres are estimated, lines not random
_SPREAD_SLACK = 0.17  # of a spread: half way to that of a ball of 60 mm, whose returns end nearer
_N_SURE = 20  # returns that show a shape well enough to say that something hides the rest
_SHAPE_SURE = 0.05  # of the radius: the same, of the standard deviation of the free radius
_RADIUS_RESOLVED = 0.015  # of the radius: standard deviation of the free radius of a resolved ball
_FLAT_RESOLVED = 0.25  # of the curvature: what may be missing of that of a resolved ball
_UNEXPLAINED_RESOLVED = 0.05  # share of the returns inside its outline that may be off it
_N_KNOWN = 3  # markers that are open below, to compare others with
_SHADE = 0.25  # standard deviation, as a share, of one return's reflectivity: partly lit beams
_DIFFERENT = 0.25  # share by which the reflectivity of a marker may differ from that of the others
_NOISIER = 1.5  # factor by which the scatter of a marker may exceed that of the others
_N_LARGE = 30  # returns that show the noise of a scan
_SIGMAS_DIFFERENT = 3.0  # standard deviations at which a shape is rejected where noise is known
_FLAT_DIFFERENT = 0.25  # of the curvature: what may be missing where the noise is known from others
_WIDE = 0.2  # half widths of a beam: noise that treating the beam as a ray adds
_BETTER_POST = 1.5  # logarithm of the likelihood ratio from which a post is accepted
_BETTER_SMALL = 4.0  # the same of a smaller sphere: these are much rarer than markers
_HIDDEN = 2.0  # as many returns before a ball as on it: two thirds of it are hidden


def distinct(groups: list[Features], config: ExtractionConfig, radius: float) -> list[Features]:
    """Return the groups that pass the first test, each once, the best first."""
    worthy = [features for features in groups if _passes_first_gate(features, config, radius)]
    worthy.sort(key=lambda features: (-_support(features), features.x, features.y))
    places = np.array([(*features[:3], i) for i, features in enumerate(worthy)]).reshape(-1, 4)
    return [worthy[int(i)] for i in thinned(places, 1.5 * radius)[:, 3]]


def _support(features: Features) -> float:
    """Return the support for a sphere: many returns that lie close to it."""
    return features.n_points / max(features.scatter, NOISE_MIN)


def _passes_first_gate(features: Features, config: ExtractionConfig, radius: float) -> bool:
    """Return whether a group has enough returns and about the size of the sphere."""
    return (
        features.n_points >= config.n_points_min
        and features.scatter > 0.0
        and max(features.width, features.height) > 0.8 * radius
        and features.n_unexplained <= features.n_points
    )


def reason_by_features(features: Features, config: ExtractionConfig, target: Target) -> str:
    """Return why a group is not a free sphere of the known radius."""
    return (
        _not_free(features, target) or _not_round(features, config, target) or _not_curved(features)
    )


def _not_free(features: Features, target: Target) -> str:
    """Return why a group does not stand free, or is not one surface."""
    few = inf if is_resolved(features, target) else 1.0 + _TOUCHING * features.n_points
    if features.n_beside > few:
        return (
            f"It does not stand free: {features.n_beside} returns beside or above its outline lie "
            f"as far away, where {features.n_points} lie on it."
        )
    if features.n_below > few:
        return (
            f"It does not stand on a pole: {features.n_below} returns below its outline and beside "
            "a pole's place lie as far away, as under a rock or a head."
        )
    if features.n_unexplained > _UNEXPLAINED * (features.n_points + features.n_unexplained):
        return (
            f"It is not one surface: {features.n_unexplained} returns inside its outline are off "
            f"the sphere that {features.n_points} lie on."
        )
    return ""


def _not_round(features: Features, config: ExtractionConfig, target: Target) -> str:
    """Return why the shape of a group is not that of the sphere."""
    radius = target.radius
    off = features.radius_free - radius
    if features.scatter > config.scatter_max:
        return (
            f"Its returns scatter by {1e3 * features.scatter:.0f} mm about a sphere of the known "
            f"radius; at most {1e3 * config.scatter_max:.0f} mm are taken for noise."
        )
    if features.height < _HEIGHT_MIN * radius:
        return (
            f"Its returns lie on one line, {1e3 * features.height:.0f} mm high: nothing shows "
            "whether it is round."
        )
    is_clear = features.gain_free > _SIGMAS**2 or abs(off) > _RADIUS_FAR * radius
    if is_clear and abs(off) > _radius_slack(features, target):
        return (
            f"Its own radius is {1e3 * features.radius_free:.0f} mm (standard deviation "
            f"{1e3 * features.sigma_radius:.0f} mm), not {1e3 * radius:.0f} mm."
        )
    return ""


def _not_curved(features: Features) -> str:
    """Return why a group is not curved both ways, or does not show it."""
    if min(features.sigma_across, features.sigma_along) > _FLAT_UNKNOWN:
        return (
            f"Its {features.n_points} returns do not show whether it is curved at all: they lie on "
            "a line or two."
        )
    if features.flat_along > max(_SIGMAS * features.sigma_along, 0.5):
        return "It is not curved from top to bottom: a post or a panel."
    if features.flat_across > max(_SIGMAS * features.sigma_across, 0.5):
        return "It is not curved from side to side: a panel or a rail."
    return ""


def _radius_slack(features: Features, target: Target) -> float:
    """Return by how much the free radius may be off: wide beams are taken for rays."""
    return max(_SIGMAS * features.sigma_radius, _RADIUS_SLACK * target.radius + features.blur)


def _too_slim(features: Features, target: Target) -> str:
    """Return the reason that a group is not wide enough."""
    return (
        f"It is {1e3 * features.width:.0f} mm wide, too slim for a sphere of diameter "
        f"{2e3 * target.radius:.0f} mm: a pole."
    )


def reason_by_evidence(features: Features, evidence: Evidence, target: Target) -> str:
    """Return why the beams about a group contradict a free sphere on a pole."""
    return _not_seen_as_ball(features, evidence, target) or _not_on_pole(features, evidence, target)


def _not_seen_as_ball(features: Features, evidence: Evidence, target: Target) -> str:
    """Return why the beams towards a group do not end as on a sphere."""
    expected = spread_expected(features, target)
    slack = max(_SPREAD_SIGMAS / sqrt(12.0 * max(evidence.n_on, 1)), _SPREAD_SLACK)
    shows_width = features.n_points >= _N_SHAPELY and evidence.n_before < _SCREENED * evidence.n_on
    n_through = evidence.n_through + evidence.n_open
    if n_through > 1.0 + _TOUCHING * min(evidence.n_aimed, 2 * evidence.n_on):
        return (
            f"It lets beams through: {n_through} pulses inside its outline end behind it or have "
            f"no return, where {evidence.n_on} lie on it."
        )
    if evidence.n_before > 2.0 + _HIDDEN * evidence.n_on:
        return (
            f"Most of it is hidden: {evidence.n_before} returns inside its outline lie before it, "
            f"where {evidence.n_on} lie on it."
        )
    width_min = (_WIDTH_SHOWN if shows_width else _WIDTH_MIN) * target.radius
    if features.width < width_min and not evidence.is_gapless:
        return _too_slim(features, target)
    if evidence.spread < expected - slack:
        seems_like = target.radius * sqrt(evidence.spread / expected)
        return (
            f"It is too small: its returns lie within {1e3 * seems_like:.0f} mm of its middle, not "
            f"{1e3 * target.radius:.0f} mm."
        )
    return ""


def _not_on_pole(features: Features, evidence: Evidence, target: Target) -> str:
    """Return why the beams below a group do not go past a pole."""
    few = inf if is_resolved(features, target) else 1.0 + _TOUCHING * _n_comparable(evidence)
    if evidence.n_held > max(few - 1.0, 1.0):
        return (
            f"It does not stand on a pole: {evidence.n_held} returns below it and beside a pole's "
            "place lie about as far away, as on shoulders, a larger stone or the ground."
        )
    if not (evidence.is_open_below or _may_be_hidden(features, target) or few == inf):
        n_below = evidence.n_held + evidence.n_past + evidence.n_short
        return (
            f"It rests on the ground: of {n_below} beams that pass below it beside a pole's "
            f"place, {evidence.n_held + evidence.n_short} end at its distance or nearer."
        )
    return ""


def reason_by_hypotheses(ratios: LikelihoodRatios) -> str:
    """Return why another shape is more likely than a sphere of the known radius."""
    if ratios.post > _BETTER_POST:
        return (
            f"It continues below: a post, {2e3 * ratios.half_width_post:.0f} mm wide, explains its "
            f"returns exp({ratios.post:.1f}) times better than a sphere."
        )
    if ratios.small > _BETTER_SMALL:
        return (
            f"It is too small: a ball of radius {1e3 * ratios.radius_small:.0f} mm explains its "
            f"returns exp({ratios.small:.1f}) times better."
        )
    return ""


def _n_comparable(evidence: Evidence) -> float:
    """Return the returns on the sphere, scaled to the share of beams below it that are seen.

    Nearer objects may hide more of the sphere or more of the place below it.
    """
    n_seen = evidence.n_held + evidence.n_past
    return evidence.n_aimed * n_seen / max(n_seen + evidence.n_short, 1)


class Reference(NamedTuple):
    """Common values of the groups of a scan that may be markers; NaN where these are too few.

    Attributes
    ----------
    noise : float
        Standard deviation of ranges, from the groups with many returns [m].
    scatter_free : float
        The same about spheres of free radius [m].
    brightness, scatter : float
        Reflectivity, 0-255, and scatter [m] of those that are open below.
    """

    noise: float
    scatter_free: float
    brightness: float
    scatter: float


def reference_of(groups: Sequence[tuple[Features, Evidence]]) -> Reference:
    """Return the common values of the groups of a scan that may be markers."""
    large = [features for features, _ in groups if features.n_points >= _N_LARGE]
    known = [(features, evidence) for features, evidence in groups if evidence.shows_below]
    return Reference(
        _median_of([max(features.scatter, NOISE_MIN) for features in large]),
        _median_of([features.scatter_free for features in large]),
        _median_of([evidence.brightness for _, evidence in known]),
        _median_of([max(features.scatter, NOISE_MIN) for features, _ in known]),
    )


def _median_of(values: Sequence[float]) -> float:
    """Return the median of some values; NaN if they are too few."""
    return median(values) if len(values) >= _N_KNOWN else float("nan")


def with_reference_scatter(features: Features, reference: Reference) -> Features:
    """Return a group with at least the scatter of the others of the scan: less is chance."""
    if features.scatter_free < reference.scatter_free:
        return features._replace(scatter_free=reference.scatter_free)
    return features


def reason_among_markers(features: Features, evidence: Evidence, reference: Reference) -> str:
    """Return why a group differs from the other markers of the scan.

    Notes
    -----
    The markers of a survey share their paint, and with it reflectivity and noise. The curvature of
    a group that scatters clearly more is tested with the noise of the others, across and along
    together. A stone behind a crest resembles a marker behind a crest: where no beams show the
    pole, reflectivity must be that of the others, and where it is hidden, scatter too.
    """
    return _differs_in_curvature(features, reference) or _differs_in_reflectivity(
        features, evidence, reference
    )


def _differs_in_curvature(features: Features, reference: Reference) -> str:
    """Return why a group is not curved as a sphere, given the noise of the others."""
    noise = hypot(reference.noise, _WIDE * features.blur)
    share = min(noise / max(features.scatter, NOISE_MIN), 1.0)
    flats = (features.flat_across, features.flat_along)
    sigmas = (share * features.sigma_across, share * features.sigma_along)
    off = hypot(*(max(flat / sigma, 0.0) for flat, sigma in zip(flats, sigmas, strict=True)))
    is_flat = off > _SIGMAS_DIFFERENT and max(flats) > _FLAT_DIFFERENT
    if features.n_points < _N_SURE or not is_flat or features.scatter <= _NOISIER * noise:
        return ""
    return (
        f"It is not curved as a sphere: {100 * max(flats):.0f} % of the curvature are missing, and "
        f"its returns scatter by {1e3 * features.scatter:.0f} mm, where the noise of the markers "
        f"is {1e3 * noise:.0f} mm."
    )


def _differs_in_reflectivity(features: Features, evidence: Evidence, reference: Reference) -> str:
    """Return why a group whose pole is not seen differs from the markers that are open below."""
    if evidence.shows_below:
        return ""
    tolerance = max(_SIGMAS * _SHADE / sqrt(max(evidence.n_distinct, 1)), _DIFFERENT)
    if abs(evidence.brightness - reference.brightness) > tolerance * reference.brightness:
        return (
            f"What it stands on is not seen, and its reflectivity is {evidence.brightness:.0f}, "
            f"that of the markers {reference.brightness:.0f}."
        )
    if not evidence.is_open_below and features.scatter > _NOISIER * reference.scatter:
        return (
            f"What it stands on is hidden, and its returns scatter by "
            f"{1e3 * features.scatter:.0f} mm, those of the markers "
            f"by {1e3 * reference.scatter:.0f} mm."
        )
    return ""


def spread_expected(features: Features, target: Target) -> float:
    """Return the expected spread of returns on the sphere, whose disc wide beams enlarge."""
    return 0.5 * (1.0 + 0.3 * features.blur / target.radius) ** 2


def is_resolved(features: Features, target: Target) -> bool:
    """Return whether the shape is so clear that the sphere need not stand free to be accepted."""
    return (
        features.n_points >= N_RESOLVED
        and features.scatter_free < RESOLUTION * target.radius
        and features.sigma_radius < _RADIUS_RESOLVED * target.radius
        and abs(features.radius_free - target.radius) < _RADIUS_SLACK * target.radius
        and max(abs(features.flat_across), abs(features.flat_along)) < _FLAT_RESOLVED
        and features.n_unexplained <= _UNEXPLAINED_RESOLVED * features.n_points
    )


def _may_be_hidden(features: Features, target: Target) -> bool:
    """Return whether the shape is so clear that the lower half may be hidden."""
    return features.n_points >= _N_SURE and features.sigma_radius < _SHAPE_SURE * target.radius
