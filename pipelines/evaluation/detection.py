"""Precision and recall of extraction against the truth, by class of marker and kind of decoy."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.config import ExtractionConfig, StitchingConfig
from spheremark.pipelines.detection import extract
from spheremark.pipelines.evaluation.experiment import Column, Experiment, Plain, Table
from spheremark.pipelines.geometry import inverse, transform
from spheremark.pipelines.model import Array, MarkerCandidates
from spheremark.pipelines.scan.stitching import stitch
from spheremark.pipelines.simulation import SimulationConfig, scenario, simulate_stop
from spheremark.pipelines.simulation.rig import nominal_rig
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

CLASSES = (
    f"at least {N_MANY} returns, half visible",
    f"{N_FEW} to {N_MANY - 1} returns, half visible",
    "fewer returns, or mostly hidden",
)
"""Classes of markers by returns and visible share."""

_NEAR_DECOY = 0.3  # [m] from a decoy within which a rejection is about it
_MEASURED = re.compile(r"\d+(\.\d+)?")  # figures, in which equal reasons differ
_N_REASONS = 3  # the most frequent reasons that a table shows


class _Thing(NamedTuple):
    """A marker or a decoy in one scan, and why it was not taken for a marker."""

    kind: str
    is_marker: bool
    is_found: bool
    p_base: Array
    reason: str = ""


class _Score(NamedTuple):
    """One scan against the truth."""

    scenario: str
    things: list[_Thing]
    n_false: int


def extraction(
    plan: Mapping[str, Sequence[str]],
    seeds: Sequence[int],
    config: SimulationConfig | None = None,
) -> Experiment[tuple[str, int, str], _Score, Plain]:
    """Return the experiment that measures extraction in worlds of known truth.

    Parameters
    ----------
    plan : mapping of str to sequence of str
        Scenarios, and the stops of each, as ``DETECTION_PLAN``.
    seeds : sequence of int
        A world of each scenario is made for each.
    config : SimulationConfig, optional
        How the rig moves and measures.

    Returns
    -------
    Experiment
        Its report has precision, false candidates, and rows of markers and decoys by scenario.

    Notes
    -----
    A marker counts as found if a candidate's rough centre lies within its radius. Candidates near
    no marker are false; each is charged to the nearest decoy. Truth is used for the score alone.
    """
    return Experiment(
        worlds=[(name, seed, stop) for name in plan for seed in seeds for stop in plan[name]],
        run_world=partial(_score, config=config or SimulationConfig()),
        pool=lambda scores: {
            "seeds": list(seeds),
            "scenarios": {name: _summary(name, scores) for name in plan},
        },
        tables=_tables,
    )


def _tables(report: Plain) -> list[Table]:
    """Return a table of markers and decoys for each scenario."""
    columns = (
        Column("kind", "what"),
        Column.whole("n", "in scans"),
        Column.whole("n_found", "taken for a marker"),
        Column(lambda row: f"{row['n_found'] / row['n']:.3f}", "share", "", ">"),
        Column(main_reasons, "why not"),
    )
    tables = []
    for name, one in report["scenarios"].items():
        precision = "none found" if one["precision"] is None else f"{one['precision']:.4f}"
        title = (
            f"{name}: {one['n_scans']} scans, precision {precision}, {one['n_false']} false, "
            f"at most {one['n_false_worst_scan']} in one scan"
        )
        rows = one["markers"] + one["decoys"]
        tables.append(Table(title=title, columns=columns, rows=rows))
    return tables


def main_reasons(row: Plain) -> str:
    """Return the most frequent reasons of a row with their counts."""
    return "; ".join(f"{why} ({n})" for why, n in list(row["reasons"].items())[:_N_REASONS])


def _score(world: tuple[str, int, str], *, config: SimulationConfig) -> _Score:
    """Simulate one stop and compare the candidates with the truth."""
    name, seed, stop = world
    field = scenario(name, seed)
    simulated = simulate_stop(field, stop, config)
    cloud = stitch(simulated.log, nominal_rig(config), StitchingConfig())
    found = extract(cloud, ExtractionConfig(), field.marker_radius)
    T_base_site = inverse(simulated.truth.T_site_base)
    marks = transform(T_base_site, field.marks.p_site)
    decoys = transform(T_base_site, np.array([d.p_site for d in field.decoys]).reshape(-1, 3))
    origin = simulated.truth.T_site_base[:3, 3]
    shares = visible_shares(field.scene, field.marks.p_site, field.marker_radius, origin)
    rough = np.array([c.p_base_rough for c in found.candidates]).reshape(-1, 3)
    is_near = np.linalg.norm(rough[:, None] - marks[None], axis=2) < field.marker_radius
    is_false = ~is_near.any(axis=1)
    charged = _nearest(decoys, rough[is_false])
    markers = [
        _Thing(_class_of(n, share), True, bool(hit), p)
        for p, (n, _), share, hit in zip(
            marks, simulated.counts, shares, is_near.any(axis=0), strict=True
        )
    ]
    others = [
        _Thing(decoy.kind, False, i in charged, decoys[i]) for i, decoy in enumerate(field.decoys)
    ]
    things = [
        one._replace(reason="" if one.is_found else reason_near(found, one.p_base))
        for one in markers + others
    ]
    return _Score(field.scenario, things, int(is_false.sum()))


def _nearest(decoys: Array, places: Array) -> set[int]:
    """Return the decoys that false candidates are charged to."""
    if not len(decoys):
        return set()
    return {int(np.argmin(np.linalg.norm(decoys - place, axis=1))) for place in places}


def _class_of(n: int, share: float) -> str:
    """Return the class of a marker by its returns and its visible share."""
    if share < HALF or n < N_FEW:
        return CLASSES[2]
    return CLASSES[0] if n >= N_MANY else CLASSES[1]


def reason_near(found: MarkerCandidates, place: Array) -> str:
    """Return the beginning of the reason for a rejection near a place, without figures."""
    gaps = [float(np.linalg.norm(r.p_base - place)) for r in found.rejected]
    if not gaps or min(gaps) > _NEAR_DECOY:
        return "Never looked like a marker"
    clause = re.split("[:,(]", found.rejected[int(np.argmin(gaps))].reason)[0].rstrip(". ")
    return _MEASURED.sub("…", clause)


def _summary(name: str, scores: Sequence[_Score]) -> Plain:
    """Return precision and counts of one scenario."""
    own = [score for score in scores if score.scenario == name]
    things = [thing for score in own for thing in score.things]
    false = [score.n_false for score in own]
    n_true = sum(thing.is_found for thing in things if thing.is_marker)
    n_all = n_true + sum(false)
    return {
        "n_scans": len(own),
        "precision": n_true / n_all if n_all else None,
        "n_false": sum(false),
        "n_false_worst_scan": max(false, default=0),
        "markers": _counts([thing for thing in things if thing.is_marker]),
        "decoys": _counts([thing for thing in things if not thing.is_marker]),
    }


def _counts(things: Sequence[_Thing]) -> list[Plain]:
    """Return how many things of each kind there were, were found, and why not."""
    rows = []
    for kind in sorted({thing.kind for thing in things}):
        own = [thing for thing in things if thing.kind == kind]
        rows.append(
            {
                "kind": kind,
                "n": len(own),
                "n_found": sum(thing.is_found for thing in own),
                "reasons": dict(Counter(one.reason for one in own if one.reason).most_common()),
            }
        )
    return rows
