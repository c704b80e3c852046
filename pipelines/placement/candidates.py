"""Places where a mark may be set up."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.ndimage import distance_transform_edt

from spheremark.pipelines.errors import ConfigError, DegenerateGeometryError
from spheremark.pipelines.model import Array, Index, Mask, seal
from spheremark.pipelines.placement.plan import Site, Stops, bilinear

CANDIDATES_MAX = 20_000
"""Most places of one comparison."""

_SLOPE_BASE = 0.5  # [m] over which slope is measured: what a tripod or a stake stands on
_BEHIND = 0.7  # [m] nearer than this, a surface behind a sphere mixes with the returns of its limb
_DIGITS = 3  # of coordinates: millimetres, finer than staking out
_LEVELS = 3  # heights of a centre that are tried at each place


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaceRules:
    """Where marks may stand.

    Attributes
    ----------
    reach : float
        Farthest horizontal distance from the nearest stop [m].
    slope_max : float
        Steepest ground that a pole can be set up on [rad].
    clear : float
        Least distance from stops, and from the area that they enclose unless marks may stand inside
        it [m].
    is_inside_allowed : bool
        Whether marks may stand between the stops, where the rover drives.
    spacing : float
        Grid on which places are tried [m]; 0 takes one that gives some hundred.
    apart : float
        Least distance between two marks [m].
    placement : float
        How far from its planned place a mark may end up [m]; the rules hold wherever it does.
    """

    reach: float = 6.0
    slope_max: float = float(np.radians(15.0))
    clear: float = 1.0
    is_inside_allowed: bool = False
    spacing: float = 0.0
    apart: float = 1.0
    placement: float = 0.0

    def __post_init__(self) -> None:
        for name, low, high in (
            ("reach", 0.5, 100.0),
            ("slope_max", 0.0, 1.5),
            ("clear", 0.0, 50.0),
            ("spacing", 0.0, 20.0),
            ("apart", 0.0, 50.0),
            ("placement", 0.0, 5.0),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise ConfigError(f"{name} is {value!r}; it must be a number from {low} to {high}.")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Candidates:
    """Places where a mark may stand, several heights at each."""

    p_site: Array  # (c, 3) centres of spheres [m]
    ground: Array  # (c,) height of the ground below each [m]
    apart: float  # least distance between two marks [m]
    rules: PlaceRules | None = None  # that places between these keep too; none allows no others
    spacing: float = 0.0  # of the grid of places [m]

    def __post_init__(self) -> None:
        seal(self, p_site=(None, 3), ground=(len(self.p_site),))

    def rows(self, keep: Index) -> Candidates:
        """Return some of the places."""
        return replace(self, p_site=self.p_site[keep].copy(), ground=self.ground[keep].copy())


def find_candidates(site: Site, stops: Stops, rules: PlaceRules) -> Candidates:
    """Return the places of a site where a mark may stand.

    Parameters
    ----------
    site : Site
        Ground, keep-out polygons and pole heights.
    stops : Stops
        Where the LiDAR scans.
    rules : PlaceRules
        Where marks may stand.

    Returns
    -------
    Candidates
        On an even grid, at three heights each: the least and the greatest pole and one between.

    Raises
    ------
    DegenerateGeometryError
        If no place is left, with the reason why.
    ConfigError
        If there are more places than can be compared.
    """
    spacing = rules.spacing or _spacing(stops, rules)
    low, high = stops.p_site[:, :2].min(axis=0), stops.p_site[:, :2].max(axis=0)
    n = np.ceil((high - low + 2 * rules.reach) / spacing) + 1
    if float(n[0] * n[1]) > 50 * CANDIDATES_MAX:
        raise ConfigError(
            f"Places every {spacing:g} m over {high[0] - low[0] + 2 * rules.reach:.0f} x "
            f"{high[1] - low[1] + 2 * rules.reach:.0f} m are {n[0] * n[1]:,.0f}; take a wider "
            "spacing or a shorter reach."
        )
    middle = (low + high) / 2
    half = np.ceil((high - low) / 2 / spacing + rules.reach / spacing) * spacing
    lines = [np.arange(-h, h + spacing / 2, spacing) + c for h, c in zip(half, middle, strict=True)]
    x, y = (np.ravel(grid) for grid in np.meshgrid(*lines))
    place = np.round(np.column_stack([x, y]), _DIGITS)
    masks = _masks(site, stops, rules, place)
    place = place[np.logical_and.reduce(list(masks.values()))]
    if not len(place):
        left = ", ".join(f"{int(mask.sum())} {why}" for why, mask in masks.items())
        raise DegenerateGeometryError(
            f"No mark may stand anywhere: of {len(x)} places, one every {spacing:g} m, {left}."
        )
    heights = np.unique(np.linspace(*site.pole_heights, _LEVELS))
    if len(place) * len(heights) > CANDIDATES_MAX:
        raise ConfigError(
            f"{len(place)} places at {len(heights)} heights are too many to compare; "
            f"{CANDIDATES_MAX:,} are the most. Take a wider spacing than {spacing:g} m."
        )
    place = np.repeat(place, len(heights), axis=0)
    return _candidates(site, rules, place, np.tile(heights, len(place) // len(heights)), spacing)


def places_near(
    site: Site, stops: Stops, rules: PlaceRules, p_site: Array, step: float
) -> Candidates:
    """Return marks, first, and the places a step away from each on which a mark may stand too."""
    ways = np.array([way for way in product((0, -1, 1), repeat=3) if any(way)])
    moved = np.round((p_site[:, None] + step * ways).reshape(-1, 3), _DIGITS)
    place = np.concatenate([p_site, moved])
    ground = site.ground_at(place)
    heights = np.clip(place[:, 2] - ground, *site.pole_heights)
    keep = np.logical_and.reduce(list(_masks(site, stops, rules, place[:, :2]).values()))
    keep[: len(p_site)] = True
    heights[: len(p_site)] = p_site[:, 2] - ground[: len(p_site)]
    return _candidates(site, rules, place[keep, :2], heights[keep], step)


def _candidates(
    site: Site, rules: PlaceRules, place: Array, heights: Array, spacing: float
) -> Candidates:
    """Return places on poles of some heights."""
    ground = site.ground_at(place)
    p_site = np.column_stack([place, np.round(ground + heights, _DIGITS)])
    apart = max(rules.apart + 2.0 * rules.placement, 1e-6)
    return Candidates(p_site=p_site, ground=ground, apart=apart, rules=rules, spacing=spacing)


def _spacing(stops: Stops, rules: PlaceRules) -> float:
    """Return a spacing that gives some hundred places [m]."""
    extent = np.ptp(stops.p_site[:, :2], axis=0) + 2 * rules.reach
    return max(round(float(np.sqrt(extent[0] * extent[1] / 700.0)), 2), 0.25)


def _masks(site: Site, stops: Stops, rules: PlaceRules, place: Array) -> dict[str, Mask]:
    """Return which places satisfy each rule, by the text of the rule."""
    gaps = np.hypot(*(place[:, None] - stops.p_site[None, :, :2]).transpose(2, 0, 1)).min(axis=1)
    masks = {
        "within reach of a stop": gaps <= rules.reach - rules.placement,
        "clear of the stops": (gaps >= rules.clear + rules.placement)
        & ~_inside(stops, rules, place),
        "on known ground": np.isfinite(site.ground_at(place)),
        "not too steep": _slopes(site, place) <= rules.slope_max,
        "free of obstacles": _is_free(site, place),
    }
    if site.keep_out:
        masks["outside the polygons"] = ~_covered(site.keep_out, place, rules.placement)
    return masks


def _inside(stops: Stops, rules: PlaceRules, place: Array) -> Mask:
    """Return which places lie in the hull of the stops and its margin, where the rover drives."""
    from shapely import MultiPoint, contains_xy

    if rules.is_inside_allowed or len(stops.names) < 3:
        return np.zeros(len(place), dtype=np.bool_)
    hull = MultiPoint(stops.p_site[:, :2]).convex_hull.buffer(rules.clear + rules.placement)
    return np.asarray(contains_xy(hull, place[:, 0], place[:, 1]), dtype=np.bool_)


def _covered(polygons: tuple[Array, ...], place: Array, margin: float) -> Mask:
    """Return which places lie in one of some polygons or within a margin."""
    from shapely import MultiPolygon, Polygon, contains_xy, union_all

    area = union_all([Polygon(corners).buffer(margin) for corners in polygons])
    area = area if not area.is_empty else MultiPolygon()
    return np.asarray(contains_xy(area, place[:, 0], place[:, 1]), dtype=np.bool_)


def _slopes(site: Site, place: Array) -> Array:
    """Return the slope of the ground at places; infinite where it is not known [rad]."""
    step = max(_SLOPE_BASE, site.cell) / 2
    rises = []
    for axis in range(2):
        shift = np.zeros(2)
        shift[axis] = step
        rises.append(site.ground_at(place + shift) - site.ground_at(place - shift))
    slope = np.arctan(np.hypot(*rises) / (2 * step))
    return np.where(np.isfinite(slope), slope, np.inf)


def _is_free(site: Site, place: Array) -> Mask:
    """Return at which places no obstacle is under a pole or close behind a sphere."""
    rises = np.nan_to_num(site.surface - site.ground)
    above = bilinear(site, rises, place)
    is_tall = rises > site.pole_heights[0] - site.marker_radius
    if not is_tall.any():
        return np.asarray(above < site.marker_radius, dtype=np.bool_)
    gaps = bilinear(site, distance_transform_edt(~is_tall) * site.cell, place)
    return np.asarray((above < site.marker_radius) & (gaps >= _BEHIND), dtype=np.bool_)
