"""The parts of plans: fields, places, models, and the visibility of marks.

Hides what makes a map follow a dragged mark: fields are made once, and the visibility is found
again for the moved mark only.
"""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from spheremark.pipelines.errors import InputError, NotFoundError
from spheremark.pipelines.model import Array
from spheremark.pipelines.placement import (
    Arrangement,
    CentreModel,
    Requirement,
    Sensor,
    Site,
    Stops,
    Visibility,
    find_visibility,
    marks_of_field,
    sensor_model,
    site_of_field,
    stops_of_field,
)
from spheremark.pipelines.progress import checkpoint
from spheremark.pipelines.simulation import scenario
from spheremark.service.planning.centre_models import model_of
from spheremark.storage.catalogue import plans as kept
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.imports.terrain import open_terrain

SCENARIOS = {
    "paper-field": "the study's field (simulated)",
    "rock-field": "field of rocks (simulated)",
    "clutter-field": "field with clutter (simulated)",
}
"""Keys and names of the simulated fields that can be planned on."""

AUTOMATIC, SENSOR_ALONE, _SURVEY = "auto", "sensor", "survey:"
TERRAIN = "terrain:"  # before the id of an uploaded terrain
_GROUNDS_KEPT = 6
_MODELS_KEPT = 8
_NEWEST = "SELECT max(finished_at) AS finished_at, count(*) AS n FROM runs"
_COLUMNS_KEPT = 400  # marks; of a map of 64 x 64 places each takes 130 kB
_PAIRS_AT_ONCE = 100_000  # of places and marks, between two checks whether to go on
_ROUND_IT = 3.0  # [m] shown around the outermost marks
_SEED_DIGITS = 18  # a seed of more digits is a mistake
_POLE_MOST = 100.0  # [m] above the ground, beyond which the height of a mark is a mistake
_STOPS_ACROSS = 3  # of a terrain without given stops


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """A field to plan on, with its own stops and marks."""

    key: str
    site: Site
    stops: Stops
    marks: Arrangement

    @property
    def view(self) -> tuple[float, float, float, float]:
        """The part of it that a map shows: x and y from, x and y to [m]."""
        p = np.concatenate([self.stops.p_site, self.marks.p_site])[:, :2]
        lines = (self.site.xs, self.site.ys)
        if not len(self.marks.names):
            (x0, x1), (y0, y1) = ((line[0], line[-1]) for line in lines)
        else:
            (x0, x1), (y0, y1) = (
                (max(line[0], p[:, k].min() - _ROUND_IT), min(line[-1], p[:, k].max() + _ROUND_IT))
                for k, line in enumerate(lines)
            )
        return float(x0), float(y0), float(x1), float(y1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Plan:
    """An arrangement on its field, with the model and the requirement of its evaluation."""

    ground: Ground
    stops: Stops
    marks: Arrangement
    model: CentreModel
    requirement: Requirement


class Place(NamedTuple):
    """Where a mark stands: on a pole above the ground, or with its centre at a height [m]."""

    name: str
    x: float
    y: float
    pole: float | None = None
    z: float | None = None


def simulated_ground(key: str) -> Ground:
    """Return a simulated field by its key: its name, or its name and a seed (``paper-field@3``)."""
    name, _, seed = key.partition("@")
    if name not in SCENARIOS or not (seed or "0").isdecimal() or len(seed) > _SEED_DIGITS:
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
    """Return the ground of a terrain that the service keeps."""
    return ground_on(key, open_terrain(path, name))


def ground_on(key: str, site: Site) -> Ground:
    """Return a terrain with stops spread over its middle and no mark yet."""
    return Ground(key, site, spread_stops(site), Arrangement.numbered(np.empty((0, 3))))


def spread_stops(site: Site) -> Stops:
    """Return stops on an even grid over the known part of a terrain."""
    shares = (np.arange(_STOPS_ACROSS) + 0.5) / _STOPS_ACROSS
    xs, ys = (lines[0] + shares * (lines[-1] - lines[0]) for lines in (site.xs, site.ys))
    places = [(x, y) for y in ys for x in xs if np.isfinite(site.ground_at(np.array([x, y])))]
    if not places:
        known = np.isfinite(site.ground)
        rows, columns = np.nonzero(
            known[:-1, :-1] & known[1:, :-1] & known[:-1, 1:] & known[1:, 1:]
        )
        if not len(rows):
            raise InputError(
                f"{site.name} holds no terrain to plan on: no four neighbouring cells all have a "
                "height."
            )
        middle = len(rows) // 2
        places = [
            (site.xs[i : i + 2].mean(), site.ys[j : j + 2].mean())
            for j, i in [(rows[middle], columns[middle])]
        ]
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


def marks_at(site: Site, places: Sequence[Place]) -> Arrangement:
    """Return marks at places on a site; refuse places off the terrain or at absurd heights."""
    xy = np.array([(place.x, place.y) for place in places], dtype=np.float64).reshape(-1, 2)
    ground = site.ground_at(xy)
    heights = np.empty(len(places))
    for k, place in enumerate(places):
        if not np.isfinite(ground[k]):
            raise InputError(
                f"Mark {place.name} at {place.x:.2f}, {place.y:.2f} m is off the terrain, or where "
                f"its height is not known; {_extent_text(site)}."
            )
        heights[k] = place.z if place.z is not None else ground[k] + (place.pole or 0.0)
        if not heights[k] <= ground[k] + _POLE_MOST:
            raise InputError(
                f"Mark {place.name} is {heights[k] - ground[k]:g} m above the ground; a pole has "
                f"{_POLE_MOST:g} m at most."
            )
        if heights[k] < ground[k] + site.marker_radius:
            raise InputError(
                f"Mark {place.name} is under the ground: its centre is "
                f"{heights[k] - ground[k]:.3f} m above it, and a sphere of "
                f"{site.marker_radius:g} m radius needs more than that. Give it a higher pole."
            )
    return Arrangement(
        names=tuple(place.name for place in places), p_site=np.column_stack([xy, heights])
    )


def _extent_text(site: Site) -> str:
    """Return the extent of a terrain as a part of a sentence."""
    return (
        f"it reaches from {site.xs[0]:g} to {site.xs[-1]:g} m in x and from {site.ys[0]:g} to "
        f"{site.ys[-1]:g} m in y"
    )


class VisibilityCache:
    """Visibility of marks, found once for each position of a mark."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._known: OrderedDict[tuple[str, bytes, bytes], Visibility] = OrderedDict()

    def find(self, ground: Ground, stations_site: Array, marks: Arrangement) -> Visibility:
        """Return the result of ``placement.find_visibility``."""
        stations = hashlib.sha256(np.ascontiguousarray(stations_site).tobytes()).digest()
        keys = [(ground.key, stations, p.tobytes()) for p in marks.p_site]
        with self._lock:
            known = {key: self._known[key] for key in keys if key in self._known}
        new = [k for k, key in enumerate(keys) if key not in known]
        if not keys:
            return find_visibility(ground.site, stations_site, marks)
        at_once = max(1, _PAIRS_AT_ONCE // len(stations_site))
        for first in range(0, len(new), at_once):
            checkpoint()
            some = new[first : first + at_once]
            chosen = marks.rows(np.array(some, dtype=np.intp))
            fresh = find_visibility(ground.site, stations_site, chosen)
            known |= {keys[k]: fresh.rows(np.array([i])) for i, k in enumerate(some)}
            self._remember({keys[k]: known[keys[k]] for k in some})
        return Visibility.joined([known[key] for key in keys])

    def _remember(self, fresh: dict[tuple[str, bytes, bytes], Visibility]) -> None:
        """Store new entries and drop the oldest."""
        with self._lock:
            self._known.update(fresh)
            while len(self._known) > _COLUMNS_KEPT:
                self._known.popitem(last=False)


class Planner:
    """What the plans of a service share: its fields, its models, and the visibility of marks."""

    def __init__(self, catalogue: Catalogue) -> None:
        self._catalogue = catalogue
        self.visibility = VisibilityCache()
        self._lock = threading.Lock()
        self._models: dict[tuple[Any, ...], CentreModel] = {}

    def ground(self, key: str) -> Ground:
        """Return the field of a key; raise NotFoundError if there is none."""
        if not key.startswith(TERRAIN):
            return simulated_ground(key)
        known = kept.get_terrain(self._catalogue, key.removeprefix(TERRAIN))
        return terrain_ground(key, known["name"], Path(known["url"]))

    def model(self, key: str, sensor: Sensor, radius: float) -> CentreModel:
        """Return a model of centres by its key, from the newest results."""
        if key == SENSOR_ALONE:
            return sensor_model(sensor, radius)
        survey = key.removeprefix(_SURVEY)
        if key.startswith(_SURVEY):
            survey = self._catalogue.get_survey(survey).name
        elif key != AUTOMATIC:
            raise InputError(
                f"There is no model {key!r}: known are {AUTOMATIC}, {SENSOR_ALONE} and "
                f"{_SURVEY}<name>."
            )
        else:
            survey = ""
        (newest,) = self._catalogue.rows(_NEWEST)
        version = (survey, sensor, radius, newest["finished_at"], newest["n"])
        with self._lock:
            known = self._models.get(version)
        if known is None:
            known = model_of(self.query, sensor, radius, survey)
            with self._lock:
                newest_models = dict(list(self._models.items())[-_MODELS_KEPT:])
                self._models = {**newest_models, version: known}
        return known

    def query(self, sql: str) -> dict[str, Any]:
        """Execute a SELECT on the catalogue, in the form of ``POST /api/v1/sql``."""
        table = self._catalogue.table(sql)
        rows = zip(*(column.to_pylist() for column in table.columns), strict=True)
        return {"columns": [{"name": name} for name in table.column_names], "rows": list(rows)}
