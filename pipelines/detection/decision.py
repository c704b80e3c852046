"""Why a group of returns is no marker: the limits of every test, and their sentences."""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot, inf, sqrt
from statistics import median
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.config import ExtractionConfig
from spheremark.pipelines.detection.evidence import Sight
from spheremark.pipelines.detection.features import N_RESOLVED, NOISE_MIN, RESOLUTION, Look
from spheremark.pipelines.detection.hypotheses import Rivals
from spheremark.pipelines.detection.seeds import thinned
from spheremark.pipelines.detection.target import Ball

_TOUCHING = 0.10  # share of a ball's returns that may lie as far away beside it: mixed pixels
_STRANGE = 0.3  # share of the returns inside the outline that may be off the ball
_SIGMAS = 3.5  # standard deviations at which a shape is refused
_RADIUS_FAR = 0.6  # of the radius: beams that are wide and few never err by as much
_RADIUS_SLACK = 0.12  # of the radius: less is no reason to refuse, the fit judges it
_N_SHAPELY = 12  # returns that show the width of what they lie on
_WIDTH_MIN = 0.5  # radii: what is less wide is none
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
_STRANGE_RESOLVED = 0.05  # share of the returns inside its outline that may be off it
_N_KNOWN = 3  # markers that are open below, to compare others with
_SHADE = 0.25  # share by which one return's reflectivity may be off: its beam is lit in part
_UNLIKE = 0.25  # share by which the reflectivity of a marker may differ from that of the others
_NOISIER = 1.5  # factor by which the scatter of a marker may exceed that of the others
_N_TELLING = 30  # returns that show the noise of a scan
_SIGMAS_UNLIKE = 3.0  # standard deviations at which a shape is refused where the noise is known
_FLAT_UNLIKE = 0.25  # of the curvature: what may be missing where the noise is known from others
_WIDE = 0.2  # half widths of a beam: what taking it for a ray adds to the noise
_BETTER_POST = 1.5  # logarithm of the likelihood ratio from which a post is believed
_BETTER_SMALL = 4.0  # the same of a smaller ball: these are much rarer than markers
_HIDDEN = 2.0  # as many returns before a ball as on it: two thirds of it are hidden


def distinct(looks: list[Look], config: ExtractionConfig, radius: float) -> list[Look]:
    """Return the groups that pass the first gate, each once, those with best first."""
    worthy = [look for look in looks if _passes_first_gate(look, config, radius)]
    worthy.sort(key=lambda look: (-_evidence(look), look.x, look.y))
    places = np.array([(*look[:3], i) for i, look in enumerate(worthy)]).reshape(-1, 4)
    return [worthy[int(i)] for i in thinned(places, 1.5 * radius)[:, 3]]


def _evidence(look: Look) -> float:
    """Return how much speaks for a ball: many returns that lie close to it."""
    return look.n_points / max(look.scatter, NOISE_MIN)


def _passes_first_gate(look: Look, config: ExtractionConfig, radius: float) -> bool:
    """Tell whether a group is worth a verdict: enough returns, about as large as a ball."""
    return (
        look.n_points >= config.n_points_min
        and look.scatter > 0.0
        and max(look.width, look.height) > 0.8 * radius
        and look.n_strange <= look.n_points
    )


def verdict(look: Look, config: ExtractionConfig, ball: Ball) -> str:
    """Return why a group is not a free ball of the known radius."""
    return _not_free(look, ball) or _not_round(look, config, ball) or _not_curved(look)


def _not_free(look: Look, ball: Ball) -> str:
    """Return why a group does not stand free, or is not one surface."""
    few = inf if is_resolved(look, ball) else 1.0 + _TOUCHING * look.n_points
    if look.n_beside > few:
        return (
            f"It does not stand free: {look.n_beside} returns beside or above its outline lie "
            f"as far away, where {look.n_points} lie on it."
        )
    if look.n_below > few:
        return (
            f"It does not stand on a pole: {look.n_below} returns below its outline and beside "
            "a pole's place lie as far away, as under a rock or a head."
        )
    if look.n_strange > _STRANGE * (look.n_points + look.n_strange):
        return (
            f"It is not one surface: {look.n_strange} returns inside its outline are off the "
            f"sphere that {look.n_points} lie on."
        )
    return ""


def _not_round(look: Look, config: ExtractionConfig, ball: Ball) -> str:
    """Return why the shape of a group is not that of the ball."""
    radius = ball.radius
    off = look.radius_free - radius
    if look.scatter > config.scatter_max:
        return (
            f"Its returns scatter by {1e3 * look.scatter:.0f} mm about a sphere of the known "
            f"radius; at most {1e3 * config.scatter_max:.0f} mm are taken for noise."
        )
    if look.width < _WIDTH_MIN * radius:
        return _slim(look, ball)
    if look.height < _HEIGHT_MIN * radius:
        return (
            f"Its returns lie on one line, {1e3 * look.height:.0f} mm high: nothing shows whether "
            "it is round."
        )
    is_clear = look.gain_free > _SIGMAS**2 or abs(off) > _RADIUS_FAR * radius
    if is_clear and abs(off) > _radius_slack(look, ball):
        return (
            f"Its own radius is {1e3 * look.radius_free:.0f} mm (standard deviation "
            f"{1e3 * look.sigma_radius:.0f} mm), not {1e3 * radius:.0f} mm."
        )
    return ""


def _not_curved(look: Look) -> str:
    """Return why a group is not curved both ways, or does not show it."""
    if min(look.sigma_across, look.sigma_along) > _FLAT_UNKNOWN:
        return (
            f"Its {look.n_points} returns do not show whether it is curved at all: they lie on a "
            "line or two."
        )
    if look.flat_along > max(_SIGMAS * look.sigma_along, 0.5):
        return "It is not curved from top to bottom: a post or a panel."
    if look.flat_across > max(_SIGMAS * look.sigma_across, 0.5):
        return "It is not curved from side to side: a panel or a rail."
    return ""


def _radius_slack(look: Look, ball: Ball) -> float:
    """Return by how much the free radius may be off: wide beams are taken for rays."""
    return max(_SIGMAS * look.sigma_radius, _RADIUS_SLACK * ball.radius + look.blur)


def _slim(look: Look, ball: Ball) -> str:
    """Return that a group is not wide enough."""
    return (
        f"It is {1e3 * look.width:.0f} mm wide, too slim for a sphere of diameter "
        f"{2e3 * ball.radius:.0f} mm: a pole."
    )


def verdict_on_sight(look: Look, sight: Sight, ball: Ball) -> str:
    """Return why the beams about a group say that it is no free ball on a pole."""
    return _not_seen_as_ball(look, sight, ball) or _not_on_pole(look, sight, ball)


def _not_seen_as_ball(look: Look, sight: Sight, ball: Ball) -> str:
    """Return why the beams towards a group do not end as on a ball."""
    expected = spread_expected(look, ball)
    slack = max(_SPREAD_SIGMAS / sqrt(12.0 * max(sight.n_on, 1)), _SPREAD_SLACK)
    shows_width = look.n_points >= _N_SHAPELY and sight.n_before < _SCREENED * sight.n_on
    if sight.n_through > 1.0 + _TOUCHING * min(sight.n_aimed, 2 * sight.n_on):
        return (
            f"It lets beams through: {sight.n_through} returns inside its outline lie behind it, "
            f"where {sight.n_on} lie on it."
        )
    if sight.n_before > 2.0 + _HIDDEN * sight.n_on:
        return (
            f"Most of it is hidden: {sight.n_before} returns inside its outline lie before it, "
            f"where {sight.n_on} lie on it."
        )
    if shows_width and look.width < _WIDTH_SHOWN * ball.radius:
        return _slim(look, ball)
    if sight.spread < expected - slack:
        seems_like = ball.radius * sqrt(sight.spread / expected)
        return (
            f"It is too small: its returns lie within {1e3 * seems_like:.0f} mm of its middle, not "
            f"{1e3 * ball.radius:.0f} mm."
        )
    return ""


def _not_on_pole(look: Look, sight: Sight, ball: Ball) -> str:
    """Return why the beams below a group do not go past a pole."""
    few = inf if is_resolved(look, ball) else 1.0 + _TOUCHING * _n_comparable(sight)
    if sight.n_held > max(few - 1.0, 1.0):
        return (
            f"It does not stand on a pole: {sight.n_held} returns below it and beside a pole's "
            "place lie about as far away, as on shoulders, a larger stone or the ground."
        )
    if not (sight.is_open_below or _may_be_hidden(look, ball) or few == inf):
        n_below = sight.n_held + sight.n_past + sight.n_short
        return (
            f"It rests on the ground: of {n_below} beams that pass below it beside a pole's "
            f"place, {sight.n_held + sight.n_short} end at its distance or nearer."
        )
    return ""


def verdict_on_rivals(rivals: Rivals) -> str:
    """Return why a group is rather something else than a ball of the known radius."""
    if rivals.post > _BETTER_POST:
        return (
            f"It goes on below as it is: a post, {2e3 * rivals.half_width_post:.0f} mm wide, "
            f"explains its returns exp({rivals.post:.1f}) times better than a sphere."
        )
    if rivals.small > _BETTER_SMALL:
        return (
            f"It is too small: a ball of radius {1e3 * rivals.radius_small:.0f} mm explains its "
            f"returns exp({rivals.small:.1f}) times better."
        )
    return ""


def _n_comparable(sight: Sight) -> float:
    """Return how many returns on a ball those below it are to be compared with.

    As many as the ball would have if as much of it were seen as of what is below it: something
    nearer may hide more of the one or of the other.
    """
    n_seen = sight.n_held + sight.n_past
    return sight.n_aimed * n_seen / max(n_seen + sight.n_short, 1)


class Peers(NamedTuple):
    """What the groups of a scan that may be markers share; NaN where too few of them tell.

    Attributes
    ----------
    noise : float
        Standard deviation of ranges, as the surer groups show it [m].
    scatter_free : float
        What is left of it about balls of free radius [m].
    brightness, scatter : float
        Reflectivity, 0-255, and scatter [m] of those that are open below.
    """

    noise: float
    scatter_free: float
    brightness: float
    scatter: float


def peers_among(groups: Sequence[tuple[Look, Sight]]) -> Peers:
    """Return what the groups of a scan that may be markers share."""
    telling = [look for look, _ in groups if look.n_points >= _N_TELLING]
    known = [(look, sight) for look, sight in groups if sight.shows_below]
    return Peers(
        _shared([max(look.scatter, NOISE_MIN) for look in telling]),
        _shared([look.scatter_free for look in telling]),
        _shared([sight.brightness for _, sight in known]),
        _shared([max(look.scatter, NOISE_MIN) for look, _ in known]),
    )


def _shared(values: Sequence[float]) -> float:
    """Return the median of what some groups show; NaN if they are too few to tell."""
    return median(values) if len(values) >= _N_KNOWN else float("nan")


def among_peers(look: Look, peers: Peers) -> Look:
    """Return a group that scatters no less than the others of the scan: less would be chance."""
    if look.scatter_free < peers.scatter_free:
        return look._replace(scatter_free=peers.scatter_free)
    return look


def verdict_among_peers(look: Look, sight: Sight, peers: Peers) -> str:
    """Return why a group differs from the other markers of the scan.

    Notes
    -----
    The markers of a survey share their paint, and with it reflectivity and noise. What scatters
    clearly more may lack the curvature of a ball, by the noise of the others; what is missing
    across and along is tested together. A stone behind a crest and a marker behind a crest look
    alike, and so does a crest that ends against the sky: where no beams show the pole, reflectivity
    must be as that of the others, and where it is hidden, scatter too.
    """
    return _unlike_in_shape(look, peers) or _unlike_in_paint(look, sight, peers)


def _unlike_in_shape(look: Look, peers: Peers) -> str:
    """Return why a group is not curved as a ball, by the noise of the others."""
    noise = hypot(peers.noise, _WIDE * look.blur)
    share = min(noise / max(look.scatter, NOISE_MIN), 1.0)
    flats = (look.flat_across, look.flat_along)
    sigmas = (share * look.sigma_across, share * look.sigma_along)
    off = hypot(*(max(flat / sigma, 0.0) for flat, sigma in zip(flats, sigmas, strict=True)))
    is_flat = off > _SIGMAS_UNLIKE and max(flats) > _FLAT_UNLIKE
    if look.n_points < _N_SURE or not is_flat or look.scatter <= _NOISIER * noise:
        return ""
    return (
        f"It is not curved as a sphere: {100 * max(flats):.0f} % of the curvature are missing, and "
        f"its returns scatter by {1e3 * look.scatter:.0f} mm, where the noise of the markers is "
        f"{1e3 * noise:.0f} mm."
    )


def _unlike_in_paint(look: Look, sight: Sight, peers: Peers) -> str:
    """Return why a group of which nothing shows the pole differs from markers that are open below.

    Reflectivity is as sure as there are places at which beams meet the group.
    """
    if sight.shows_below:
        return ""
    unlike = max(_SIGMAS * _SHADE / sqrt(max(sight.n_distinct, 1)), _UNLIKE)
    if abs(sight.brightness - peers.brightness) > unlike * peers.brightness:
        return (
            f"What it stands on is not seen, and its reflectivity is {sight.brightness:.0f}, that "
            f"of the markers {peers.brightness:.0f}."
        )
    if not sight.is_open_below and look.scatter > _NOISIER * peers.scatter:
        return (
            f"What it stands on is hidden, and its returns scatter by "
            f"{1e3 * look.scatter:.0f} mm, those of the markers by {1e3 * peers.scatter:.0f} mm."
        )
    return ""


def spread_expected(look: Look, ball: Ball) -> float:
    """Return the spread of returns on the ball: wide beams make its disc somewhat larger."""
    return 0.5 * (1.0 + 0.3 * look.blur / ball.radius) ** 2


def is_resolved(look: Look, ball: Ball) -> bool:
    """Tell whether the shape is seen so closely that a ball need not stand free to be believed."""
    return (
        look.n_points >= N_RESOLVED
        and look.scatter_free < RESOLUTION * ball.radius
        and look.sigma_radius < _RADIUS_RESOLVED * ball.radius
        and abs(look.radius_free - ball.radius) < _RADIUS_SLACK * ball.radius
        and max(abs(look.flat_across), abs(look.flat_along)) < _FLAT_RESOLVED
        and look.n_strange <= _STRANGE_RESOLVED * look.n_points
    )


def _may_be_hidden(look: Look, ball: Ball) -> bool:
    """Tell whether the shape is so clear that the lower half may be behind something nearer."""
    return look.n_points >= _N_SURE and look.sigma_radius < _SHAPE_SURE * ball.radius


def score(look: Look, config: ExtractionConfig, ball: Ball) -> float:
    """Return how easily the tests were passed."""
    few = np.inf if is_resolved(look, ball) else 1.0 + _TOUCHING * look.n_points
    used = (
        look.n_beside / few,
        look.n_below / few,
        look.n_strange / (_STRANGE * (look.n_points + look.n_strange)),
        look.scatter / config.scatter_max,
        abs(look.radius_free - ball.radius) / _radius_slack(look, ball),
    )
    return max(1.0 - sum(share**2 for share in used) / len(used), 0.0)
