"""``spheremark bench --networks``: whole simulated surveys, adjusted and compared with the truth.

Every survey has a field, a rig and sensors of its own, and no control: place and attitude are taken
out before anything is compared. Then one observation gets a gross error, which must be found.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from time import process_time
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from spheremark.pipelines.calibration import Calibration, calibrate
from spheremark.pipelines.calibration.gimbal import GIMBAL, moved
from spheremark.pipelines.config import FittingConfig, SurveyConfig
from spheremark.pipelines.model import MarkerFits, Rig, Truth
from spheremark.pipelines.network import AdjustedNetwork, Network, adjust_network, assemble, compare
from spheremark.pipelines.simulation import (
    Field,
    SimulatedStop,
    SimulationConfig,
    scenario,
    simulate_stop,
)
from spheremark.pipelines.survey import Progress, process
from spheremark.pipelines.threads import in_processes

Plain = dict[str, Any]

BARS = {"rms_marks_m": 0.0007, "rms_stations_m": 0.0015}
"""What the mean error over surveys of all stops may be [m]."""

BARS_NEES = (0.85, 1.2)
"""Between which the mean of squared errors in units of their covariance is to lie."""

_METHOD = "along_beam"
_CONFIG = SurveyConfig(fitting=FittingConfig(methods=(_METHOD,)))
_SIGMA_RANGE = 0.020  # [m]
_GROSS = 0.05  # [m]
_WRONG = {"axis_offset_x": 0.010, "axis_offset_y": 0.008, "spin_zero": np.radians(0.2)}
_WRONG_LASER = 0.005  # [m]
_MEASURES = (*BARS, "nees_marks", "nees_stations")


@dataclass(frozen=True, slots=True, kw_only=True)
class Wish:
    """How many surveys of how many stops, and whether the rigs are wrong and calibrated."""

    n_surveys: int
    n_stops: int = 35
    is_rig_wrong: bool = False
    seed: int = 0


def run(wish: Wish, progress: Progress, n_processes: int | None = None) -> Plain:
    """Simulate and adjust surveys; return each one's errors, and their means."""
    seeds = range(wish.seed, wish.seed + wish.n_surveys)
    work = partial(survey, n_stops=wish.n_stops, is_rig_wrong=wish.is_rig_wrong)
    rows = in_processes(work, seeds, n_processes=n_processes, progress=progress)
    return {
        "n_surveys": wish.n_surveys,
        "n_stops": wish.n_stops,
        "is_rig_wrong": wish.is_rig_wrong,
        "seed": wish.seed,
        "sigma_range_m": _SIGMA_RANGE,
        "gross_error_m": _GROSS,
        "bars": BARS,
        "bars_nees": BARS_NEES,
        "summary": {name: _summary([row[name] for row in rows]) for name in _MEASURES},
        "n_false_marks": sum(row["n_false_marks"] for row in rows),
        "n_left_out": sum(row["n_left_out"] for row in rows),
        "n_observations": sum(row["n_observations"] for row in rows),
        "n_gross_found": sum(row["is_gross_found"] for row in rows),
        "adjustment_cpu_seconds": float(np.mean([row["adjustment_cpu_seconds"] for row in rows])),
        "surveys": rows,
    }


def _summary(values: list[float]) -> Plain:
    """Return the mean with its standard error, and the extremes."""
    n = len(values)
    return {
        "mean": float(np.mean(values)),
        "sigma_mean": float(np.std(values, ddof=1) / np.sqrt(n)) if n > 1 else None,
        "least": float(np.min(values)),
        "greatest": float(np.max(values)),
    }


def survey(seed: int, *, n_stops: int, is_rig_wrong: bool) -> Plain:
    """Simulate one survey, adjust it, and compare it with its truth."""
    field, rng = scenario("paper-field", seed), np.random.default_rng([seed, 1])
    simulation = SimulationConfig(only_near_spheres=True, sigma_range=_SIGMA_RANGE)
    names = [stop.name for stop in field.stops[:: len(field.stops) // n_stops][:n_stops]]
    stops = [simulate_stop(field, name, simulation) for name in names]
    scans, rig = _scans(stops, wrong_rig(stops[0].log.rig, rng) if is_rig_wrong else None)
    start = process_time()
    network = assemble(scans, None, _CONFIG.resection, rig)
    result = adjust_network(network, _CONFIG.resection)
    return _row(field, stops, result) | {
        "seed": seed,
        "adjustment_cpu_seconds": process_time() - start,
        "is_gross_found": is_gross_found(network, rng),
    }


def _scans(
    stops: list[SimulatedStop], wrong: Rig | None
) -> tuple[list[tuple[str, MarkerFits]], Calibration | None]:
    """Return the centres of all stops, and what their calibration tells if the rig is wrong."""
    found = [
        (stop.truth.name, process(stop.log, config=_CONFIG, rig=wrong)[0].fits[_METHOD])
        for stop in stops
    ]
    if wrong is None:
        return found, None
    return found, calibrate([stop.log for stop in stops], config=_CONFIG, rig=wrong)


def wrong_rig(rig: Rig | None, rng: np.random.Generator) -> Rig:
    """Return a rig that is wrong by 10 mm, 8 mm, 0.2 degrees and 5 mm of each laser."""
    if rig is None:
        raise TypeError("A simulated log describes its rig.")
    off = [_WRONG.get(one.name, 0.0) * rng.choice([-1.0, 1.0]) for one in GIMBAL]
    return moved(rig, np.array(off), rng.normal(0.0, _WRONG_LASER, len(rig.laser_range_biases)))


def _row(field: Field, stops: list[SimulatedStop], result: AdjustedNetwork) -> Plain:
    """Return the errors of a network."""
    truth = Truth(marks=field.marks, stops=tuple(stop.truth for stop in stops), rig=None)
    errors = compare(result, truth)
    return {
        "n_stations": len(result.network.stations),
        "n_marks": len(result.network.marks),
        "n_false_marks": int(np.sum(errors.marks < 0)),
        "n_observations": len(result.network.sightings),
        "n_left_out": int(np.sum(~result.used)),
        "rms_marks_m": errors.rms_marks,
        "rms_stations_m": errors.rms_stations,
        "nees_marks": errors.nees_marks,
        "nees_stations": errors.nees_stations,
        "sigma0": result.sigma0,
    }


def is_gross_found(network: Network, rng: np.random.Generator) -> bool:
    """Whether an observation that is wrong by 5 cm is named as the first to leave out."""
    place = int(rng.integers(len(network.sightings)))
    away, p_base = rng.normal(size=3), network.p_base.copy()
    p_base[place] += _GROSS * away / np.linalg.norm(away)
    result = adjust_network(replace(network, p_base=p_base), _CONFIG.resection)
    station, mark = network.sightings[place]
    worst = next(
        (one for one in result.left_out[len(network.left_out) :] if one.kind == "centre"), None
    )
    return worst is not None and (worst.station, worst.mark) == (
        network.stations[station],
        network.marks[mark],
    )


_SAID = {
    "rms_marks_m": ("marks, 3-D error RMS [mm]", 1e3),
    "rms_stations_m": ("stations, 3-D error RMS [mm]", 1e3),
    "nees_marks": ("marks, NEES per degree of freedom", 1.0),
    "nees_stations": ("stations, NEES per degree of freedom", 1.0),
}


def print_report(out: Console, report: Plain) -> None:
    """Print the means over surveys beside what is asked of them."""
    rigs = (
        "wrong rigs, calibrated in the same adjustment" if report["is_rig_wrong"] else "as set up"
    )
    out.print(
        f"{report['n_surveys']} surveys of {report['n_stops']} stops, ranges with sigma "
        f"{1e3 * report['sigma_range_m']:.0f} mm, {rigs}; free networks, datum taken out."
    )
    table = Table("")
    for name in ("mean", "+-", "least", "greatest", "bar"):
        table.add_column(name, justify="right")
    for name, (said, factor) in _SAID.items():
        one = report["summary"][name]
        cells = [one["mean"], one["sigma_mean"], one["least"], one["greatest"]]
        low, high = report["bars_nees"]
        bar = f"{factor * report['bars'][name]:.1f}" if factor != 1.0 else f"{low} to {high}"
        table.add_row(said, *("-" if c is None else f"{factor * c:.2f}" for c in cells), bar)
    out.print(table)
    out.print(
        f"A gross error of {100 * report['gross_error_m']:.0f} cm was found and named in "
        f"{report['n_gross_found']} of {report['n_surveys']} surveys. Left out without one: "
        f"{report['n_left_out']} of {report['n_observations']:,} centres, gravity included; false "
        f"marks: {report['n_false_marks']}. Assembly and adjustment: "
        f"{report['adjustment_cpu_seconds']:.2f} s of CPU each."
    )
