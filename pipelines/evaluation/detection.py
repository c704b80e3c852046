"""How surely markers are found, and nothing else is: precision and recall against the truth.

The only room that may compare extraction with what was hidden: worlds by seed, several stops of
each, every marker by its returns and how much of it can be seen, every decoy by its kind.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from spheremark.pipelines.config import ExtractionConfig, StitchingConfig
from spheremark.pipelines.detection import extract
from spheremark.pipelines.geometry import inverse, transform
from spheremark.pipelines.model import Array, MarkerCandidates, StitchedCloud
from spheremark.pipelines.scan.stitching import stitch
from spheremark.pipelines.simulation.field import Field
from spheremark.pipelines.simulation.options import SimulationConfig
from spheremark.pipelines.simulation.rig import nominal_rig
from spheremark.pipelines.simulation.scenarios import scenario
from spheremark.pipelines.simulation.stop import Progress, simulate_stop
from spheremark.pipelines.simulation.visibility import visible_shares

_FIELD_STOPS = ("lane3-stop4", "lane1-stop1", "lane5-stop6")
DETECTION_PLAN: Mapping[str, Sequence[str]] = {
    "clutter-field": _FIELD_STOPS,
    "rock-field": _FIELD_STOPS,
    "range-lane": ("centre",),
}
"""Scenarios of the benchmark, and the stops of each: the centre, a corner and a side."""

N_MANY, N_FEW, HALF = 20, 6, 0.5
"""Returns from which a marker must be found, from which it may be, and how much must be visible."""

_ON = 0.07  # [m] of depth: within this of a marker's surface a return is one of its own
_MEASURED = re.compile(r"\d+(\.\d+)?")  # what differs between reasons that are the same
_NEAR_DECOY = 0.3  # [m] from a decoy within which a refusal is about it
_CLASSES = (
    f"at least {N_MANY} returns, half visible",
    f"{N_FEW} to {N_MANY - 1} returns, half visible",
    "fewer returns, or mostly hidden",
)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Tally:
    """How many things of one kind a scenario held, and what became of them.

    Attributes
    ----------
    scenario : str
        The world.
    kind : str
        Class of marker, or kind of decoy.
    is_marker : bool
        Whether finding it is right.
    n : int
        How often it stood in a scan.
    n_found : int
        How often it was taken for a marker.
    reasons : mapping of str to int
        Beginning of each reason for which it was refused, and how often.
    """

    scenario: str
    kind: str
    is_marker: bool
    n: int
    n_found: int
    reasons: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Detection:
    """Precision and recall of extraction over many scans.

    Attributes
    ----------
    tallies : tuple of Tally
        By scenario and kind.
    n_scans : mapping of str to int
        Scans of each scenario.
    n_false : mapping of str to int
        Candidates of each scenario that are no marker.
    worst : mapping of str to int
        The most of them in one scan.
    """

    tallies: tuple[Tally, ...]
    n_scans: Mapping[str, int]
    n_false: Mapping[str, int]
    worst: Mapping[str, int]

    def recall(self, name: str, place: int) -> float:
        """Return the share of the markers of a class that was found."""
        mine = [t for t in self.tallies if t.scenario == name and t.kind == _CLASSES[place]]
        return mine[0].n_found / mine[0].n if mine else float("nan")

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        return {name: self._scenario(name) for name in self.n_scans}

    def _scenario(self, name: str) -> dict[str, Any]:
        """Return the plain values of one scenario."""
        mine = [t for t in self.tallies if t.scenario == name]
        n_true = sum(t.n_found for t in mine if t.is_marker)
        n_all = n_true + self.n_false[name]
        rows = [
            {"kind": t.kind, "n": t.n, "n_found": t.n_found, "reasons": dict(t.reasons)}
            for t in mine
        ]
        return {
            "n_scans": self.n_scans[name],
            "precision": n_true / n_all if n_all else None,
            "n_false": self.n_false[name],
            "n_false_worst_scan": self.worst[name],
            "markers": [r for r, t in zip(rows, mine, strict=True) if t.is_marker],
            "decoys": [r for r, t in zip(rows, mine, strict=True) if not t.is_marker],
        }


def detection(
    plan: Mapping[str, Sequence[str]],
    seeds: Sequence[int],
    config: SimulationConfig,
    progress: Progress | None = None,
) -> Detection:
    """Measure how surely extraction finds markers in worlds of known truth.

    Parameters
    ----------
    plan : mapping of str to sequence of str
        Scenarios, and the stops of each, as ``DETECTION_PLAN``.
    seeds : sequence of int
        A world of each scenario is made for each.
    config : SimulationConfig
        How the rig moves and measures.
    progress : callable
        Is told the fraction done, 0 to 1, and what is being done; may raise to cancel.

    Returns
    -------
    Detection
        Counts by scenario and kind.

    Notes
    -----
    A marker counts as found if a candidate's rough centre lies within its radius. Candidates near
    no marker are false; each is charged to the nearest decoy. Truth is used for the score alone.
    """
    scans = [(name, seed, stop) for name in plan for seed in seeds for stop in plan[name]]
    scores = []
    for i, (name, seed, stop) in enumerate(scans):
        if progress:
            progress(i / len(scans), f"{name} {seed}, {stop}")
        scores.append(_score(scenario(name, seed), stop, config))
    return _summed(tuple(plan), scores)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class _Score:
    """One scan: each thing's kind, whether it is a marker and was found, and why it was not."""

    scenario: str
    things: tuple[tuple[str, bool, bool, str], ...]
    n_false: int


def _score(world: Field, stop: str, config: SimulationConfig) -> _Score:
    """Simulate one stop and compare what is found there with the truth."""
    simulated = simulate_stop(world, stop, config)
    cloud = stitch(simulated.log, nominal_rig(config), StitchingConfig())
    found = extract(cloud, ExtractionConfig(), world.marker_radius)
    T_base_site = inverse(simulated.truth.T_site_base)
    marks = transform(T_base_site, world.marks.p_site)
    decoys = transform(T_base_site, np.array([d.p_site for d in world.decoys]).reshape(-1, 3))
    eye = simulated.truth.T_site_base[:3, 3]
    shares = visible_shares(world.scene, world.marks.p_site, world.marker_radius, eye)
    rough = np.array([c.p_base_rough for c in found.candidates]).reshape(-1, 3)
    gaps = np.linalg.norm(rough[:, None] - marks[None], axis=2)
    is_true = (gaps < world.marker_radius).any(axis=1)
    is_found = (gaps < world.marker_radius).any(axis=0)
    things = [
        (
            _class_of(_n_on(cloud, p, world.marker_radius), share),
            True,
            bool(hit),
            "" if hit else _reason_near(found, p),
        )
        for p, share, hit in zip(marks, shares, is_found, strict=True)
    ]
    taken = _nearest(decoys, rough[~is_true])
    for i, decoy in enumerate(world.decoys):
        reason = "" if i in taken else _reason_near(found, decoys[i])
        things.append((decoy.kind, False, i in taken, reason))
    return _Score(scenario=world.scenario, things=tuple(things), n_false=int((~is_true).sum()))


def _nearest(decoys: Array, places: Array) -> set[int]:
    """Return the decoys that false candidates are charged to."""
    if not len(decoys):
        return set()
    return {int(np.argmin(np.linalg.norm(decoys - place, axis=1))) for place in places}


def _n_on(cloud: StitchedCloud, centre: Array, radius: float) -> int:
    """Return how many returns lie on a marker."""
    near = np.linalg.norm(cloud.p_base - centre, axis=1) < 2.0 * radius
    points = cloud.p_base[near].astype(np.float64)
    ranges = np.linalg.norm(points, axis=1)
    along = points @ centre / ranges
    inside2 = radius**2 - (centre @ centre - along**2)
    expected = along - np.sqrt(np.maximum(inside2, 0.0))
    return int(np.sum((inside2 > 0.0) & (np.abs(ranges - expected) < _ON)))


def _class_of(n_on: int, share: float) -> str:
    """Return the class of a marker by its returns and its visible share."""
    if share < HALF or n_on < N_FEW:
        return _CLASSES[2]
    return _CLASSES[0] if n_on >= N_MANY else _CLASSES[1]


def _reason_near(found: MarkerCandidates, place: Array) -> str:
    """Return how the reason begins for which something at a place was refused, less its figures."""
    gaps = [float(np.linalg.norm(r.p_base - place)) for r in found.rejected]
    if not gaps or min(gaps) > _NEAR_DECOY:
        return "Never looked like a marker"
    clause = re.split("[:,(]", found.rejected[int(np.argmin(gaps))].reason)[0].rstrip(". ")
    return _MEASURED.sub("…", clause)


def _summed(names: Sequence[str], scores: Sequence[_Score]) -> Detection:
    """Return the counts over all scans."""
    tallies = []
    for name in names:
        things = [thing for score in scores if score.scenario == name for thing in score.things]
        kinds = sorted({(not is_marker, kind) for kind, is_marker, _, _ in things})
        for is_decoy, kind in kinds:
            mine = [t for t in things if t[0] == kind and t[1] is not is_decoy]
            tallies.append(
                Tally(
                    scenario=name,
                    kind=kind,
                    is_marker=not is_decoy,
                    n=len(mine),
                    n_found=sum(hit for _, _, hit, _ in mine),
                    reasons=dict(Counter(reason for *_, reason in mine if reason).most_common()),
                )
            )
    false = {name: [s.n_false for s in scores if s.scenario == name] for name in names}
    return Detection(
        tallies=tuple(tallies),
        n_scans={name: len(counts) for name, counts in false.items()},
        n_false={name: sum(counts) for name, counts in false.items()},
        worst={name: max(counts, default=0) for name, counts in false.items()},
    )
