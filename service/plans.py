"""Plans for pages and programs: what is asked, put together from what is kept.

Hides what makes a map follow a mark that is dragged: worlds are made once, and what can be seen of
a mark is looked up again only for the mark that moved.
"""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from pipelines.errors import InputError, NotFoundError
from pipelines.placement import (
    Arrangement,
    Sights,
    Site,
    Stops,
    look,
    marks_of_field,
    site_of_field,
    stops_of_field,
)
from pipelines.simulation import scenario
from pipelines.values import Array

SCENARIOS = {
    "paper-field": "the study's field (simulated)",
    "rock-field": "field of rocks (simulated)",
    "clutter-field": "field with clutter (simulated)",
}
"""Simulated fields that can be planned on, as their key and what people call them."""

TERRAIN = "terrain:"  # before the id of an uploaded one
_GROUNDS_KEPT = 6
_SIGHTS_KEPT = 400  # marks; of a map of 64 x 64 places each takes 130 kB
_STOPS_ACROSS = 3  # of a terrain for which nobody has said where the rover stops


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """A field to plan on, with the stops and the marks that one may begin with."""

    key: str
    site: Site
    stops: Stops
    marks: Arrangement


def simulated_ground(key: str) -> Ground:
    """Return a simulated field by its key: its name, or its name and a seed (``paper-field@3``)."""
    name, _, seed = key.partition("@")
    if name not in SCENARIOS or not (seed or "0").isdecimal():
        raise NotFoundError(
            f"There is no field {key!r}; known are {', '.join(SCENARIOS)}, each also with a seed "
            "(paper-field@3), and terrains that were uploaded."
        )
    return _simulated(name, int(seed or 0))


@lru_cache(maxsize=_GROUNDS_KEPT)
def _simulated(name: str, seed: int) -> Ground:
    """Make a simulated field."""
    world = scenario(name, seed)
    return Ground(
        f"{name}@{seed}" if seed else name,
        site_of_field(world),
        stops_of_field(world),
        marks_of_field(world),
    )


@lru_cache(maxsize=_GROUNDS_KEPT)
def terrain_ground(key: str, name: str, path: Path) -> Ground:
    """Return an uploaded terrain, with stops spread over its middle and no mark yet."""
    from storage.terrain_files import read_terrain

    site = read_terrain(path, name=name)
    return Ground(key, site, _spread_stops(site), Arrangement.numbered(np.empty((0, 3))))


def _spread_stops(site: Site) -> Stops:
    """Return stops on an even grid over the known part of a terrain."""
    shares = (np.arange(_STOPS_ACROSS) + 0.5) / _STOPS_ACROSS
    xs, ys = (lines[0] + shares * (lines[-1] - lines[0]) for lines in (site.xs, site.ys))
    places = [(x, y) for y in ys for x in xs if np.isfinite(site.ground_at(np.array([x, y])))]
    if not places:
        rows, columns = np.nonzero(np.isfinite(site.ground))
        middle = len(rows) // 2
        places = [(site.xs[columns[middle]], site.ys[rows[middle]])]
    return stops_at(site, [(f"S{i + 1:02d}", *place) for i, place in enumerate(places)])


def stops_at(site: Site, places: Sequence[tuple[str, float, float]]) -> Stops:
    """Return stops with the LiDAR at its usual height above the ground."""
    xy = np.array([place[1:] for place in places], dtype=np.float64).reshape(-1, 2)
    z = site.ground_at(xy) + site.mast
    for (name, x, y), height in zip(places, z, strict=True):
        if not np.isfinite(height):
            raise InputError(
                f"Stop {name} at {x:.2f}, {y:.2f} m is off the terrain, or where its height is not "
                f"known; {_extent_text(site)}."
            )
    return Stops(names=tuple(place[0] for place in places), p_site=np.column_stack([xy, z]))


def marks_at(site: Site, places: Sequence[tuple[str, float, float, float]]) -> Arrangement:
    """Return marks on poles of given heights [m] above the ground."""
    array = np.array([place[1:] for place in places], dtype=np.float64).reshape(-1, 3)
    z = site.ground_at(array) + array[:, 2]
    for (name, x, y, _), height in zip(places, z, strict=True):
        if not np.isfinite(height):
            raise InputError(
                f"Mark {name} at {x:.2f}, {y:.2f} m is off the terrain, or where its height is not "
                f"known; {_extent_text(site)}."
            )
    return Arrangement(
        names=tuple(place[0] for place in places), p_site=np.column_stack([array[:, :2], z])
    )


def _extent_text(site: Site) -> str:
    """Say how far a terrain reaches."""
    return (
        f"it reaches from {site.xs[0]:g} to {site.xs[-1]:g} m in x and from {site.ys[0]:g} to "
        f"{site.ys[-1]:g} m in y"
    )


class Lookout:
    """What can be seen of marks, each looked for once while it stands where it stands."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._known: OrderedDict[tuple[str, bytes, bytes], Sights] = OrderedDict()

    def look(self, ground: Ground, eyes_site: Array, marks: Arrangement) -> Sights:
        """Return what ``pipelines.placement.look`` does."""
        eyes = hashlib.sha256(np.ascontiguousarray(eyes_site)).digest()
        keys = [(ground.key, eyes, p.tobytes()) for p in marks.p_site]
        with self._lock:
            known = {key: self._known[key] for key in keys if key in self._known}
        new = [k for k, key in enumerate(keys) if key not in known]
        if new or not keys:
            fresh = look(ground.site, eyes_site, marks.rows(np.array(new, dtype=np.intp)))
            if not keys:
                return fresh
            known |= {keys[k]: fresh.rows(np.array([i])) for i, k in enumerate(new)}
            self._remember({keys[k]: known[keys[k]] for k in new})
        return Sights(lowest=np.concatenate([known[key].lowest for key in keys], axis=1))

    def _remember(self, fresh: dict[tuple[str, bytes, bytes], Sights]) -> None:
        """Keep what is new, and forget what is oldest."""
        with self._lock:
            self._known.update(fresh)
            while len(self._known) > _SIGHTS_KEPT:
                self._known.popitem(last=False)
