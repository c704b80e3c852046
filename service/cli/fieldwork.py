"""Simulated surveys as files: logs as a recorder would write them, with the truth beside them.

Hides how stops are named on the command line and how simulation and storage fit together.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from spheremark.pipelines.errors import ConfigError
from spheremark.pipelines.progress import Progress, part_of
from spheremark.pipelines.simulation import (
    Field,
    SimulationConfig,
    scenario,
    simulate_stop,
    survey_truth,
)
from spheremark.storage.imports.survey_files import format_control, format_truth
from spheremark.storage.recordings import write_log

RANDOM = "random"
"""Scenario whose physics are drawn too."""

_LANE = "lane3"  # the middle one


@dataclass(frozen=True, slots=True, kw_only=True)
class Assignment:
    """What to simulate, and how to write it: as points or as raw packets.

    Without stops: the middle lane of a field with lanes, the first stop of a random world, and all
    stops of any other.
    """

    scenario: str
    stops: str
    seed: int
    config: SimulationConfig
    compression: str
    packets: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class WrittenStop:
    """One simulated stop on disk."""

    name: str
    log: Path
    truth: Path


def chosen_stops(field: Field, text: str) -> tuple[str, ...]:
    """Return the names of the stops of a text.

    It is ``all`` or a list with commas of names, lanes (``lane3``), numbers from 1 and ranges of
    them (``1-7``), in the order of driving.
    """
    names = [stop.name for stop in field.stops]
    found: list[str] = []
    for part in text.replace(" ", "").split(","):
        found += _named(part, names)
    return tuple(dict.fromkeys(found))


def _named(part: str, names: Sequence[str]) -> Sequence[str]:
    """Return the stops that one part of a list names."""
    if part == "all":
        return names
    if part in names:
        return [part]
    if lane := [name for name in names if name.startswith(f"{part}-") and part]:
        return lane
    numbers = re.fullmatch(r"(\d+)(?:-(\d+))?", part)
    first, last = (int(n or numbers[1]) for n in numbers.groups()) if numbers else (0, 0)
    if not 1 <= first <= last <= len(names):
        raise ConfigError(
            f"There is no stop {part!r}; name stops ({names[0]} ... {names[-1]}), lanes (lane1), "
            f"numbers or ranges from 1 to {len(names)}, or all."
        )
    return names[first - 1 : last]


def survey(
    folder: Path, assignment: Assignment, *, progress: Progress = lambda _share, _what: None
) -> Iterator[WrittenStop]:
    """Simulate stop after stop into a folder; yield each one when its files are complete."""
    field, usual = scenario(assignment.scenario, assignment.seed), _LANE
    if assignment.scenario == RANDOM:
        usual = field.stops[0].name
    elif not any(stop.name.startswith(_LANE) for stop in field.stops):
        usual = "all"
    names = chosen_stops(field, assignment.stops or usual)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "control.csv").write_text(format_control(field.marks), encoding="utf-8")
    for i, name in enumerate(names):
        yield _write(
            folder, field, name, assignment, part_of(progress, i / len(names), (i + 1) / len(names))
        )


def _write(
    folder: Path, field: Field, name: str, assignment: Assignment, progress: Progress
) -> WrittenStop:
    """Simulate one stop and write its log and, into a file of its own, its truth."""
    made = WrittenStop(name=name, log=folder / f"{name}.mcap", truth=folder / f"{name}.truth.json")
    stop = simulate_stop(field, name, assignment.config, progress=progress)
    part = made.log.with_suffix(".part")
    write_log(
        stop.log,
        part,
        revolution=60.0 / assignment.config.spin_rpm,
        compression=assignment.compression,
        firings=stop.firings if assignment.packets else None,
    )
    truth = survey_truth(field, [stop], assignment.config, field.seed)
    made.truth.write_text(format_truth(truth), encoding="utf-8")
    part.replace(made.log)
    return made
