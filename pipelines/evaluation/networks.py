"""Accuracy of adjusted surveys: whole simulated surveys without control, against the truth.

Every survey has a field, a rig and sensors of its own. Place and attitude (the datum) are taken out
before anything is compared. Then one observation gets a gross error, which must be found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from time import process_time

import numpy as np
from scipy.stats import chi2

from spheremark.pipelines.calibration import Calibration, calibrate
from spheremark.pipelines.calibration.gimbal import GIMBAL, moved
from spheremark.pipelines.config import FittingConfig, SurveyConfig
from spheremark.pipelines.errors import SpheremarkError
from spheremark.pipelines.evaluation.ellipse_coverage import LEVELS
from spheremark.pipelines.evaluation.experiment import Column, Experiment, Plain, Table
from spheremark.pipelines.model import MarkerFits, Rig, Truth
from spheremark.pipelines.network import AdjustedNetwork, Network, adjust_network, assemble, compare
from spheremark.pipelines.simulation import (
    Field,
    SimulatedStop,
    SimulationConfig,
    draw_world,
    scenario,
    simulate_stop,
)
from spheremark.pipelines.survey import process

BARS = {"rms_marks_m": 0.0007, "rms_stations_m": 0.0015}
"""Greatest mean error over surveys of all stops that is accepted [m]."""

BARS_NEES = (0.85, 1.2)
"""Least and greatest mean square of errors in units of their covariance that are accepted."""

N_STOPS = 35
"""Stops of a whole survey."""

_METHOD = "along_beam"
_CONFIG = SurveyConfig(fitting=FittingConfig(methods=(_METHOD,)))
_SIGMA_RANGE = 0.020  # [m]
_GROSS = 0.05  # [m]
_WRONG = {"axis_offset_x": 0.010, "axis_offset_y": 0.008, "spin_zero": np.radians(0.2)}
_WRONG_LASER = 0.005  # [m]
_MEASURES = {
    "rms_marks_m": ("marks, 3-D error RMS [mm]", 1e3),
    "rms_stations_m": ("stations, 3-D error RMS [mm]", 1e3),
    "nees_marks": ("marks, NEES per degree of freedom", 1.0),
    "nees_stations": ("stations, NEES per degree of freedom", 1.0),
}


def networks(
    n_surveys: int, *, seed: int = 0, n_stops: int = N_STOPS, is_rig_wrong: bool = False
) -> Experiment[int, Plain, Plain]:
    """Return the experiment that adjusts whole surveys.

    Parameters
    ----------
    n_surveys : int
        Number of surveys.
    seed : int
        Seed of the first survey; the others follow.
    n_stops : int
        Stops of each.
    is_rig_wrong : bool
        Whether the rig is wrong and calibrated.

    Returns
    -------
    Experiment
        Its report has the errors of each survey and their means.
    """
    return Experiment(
        worlds=range(seed, seed + n_surveys),
        run_world=partial(_survey, n_stops=n_stops, is_rig_wrong=is_rig_wrong),
        pool=lambda rows: {
            "n_surveys": n_surveys,
            "n_stops": n_stops,
            "is_rig_wrong": is_rig_wrong,
            "seed": seed,
            **_report(rows),
        },
        tables=_tables,
    )


def random_networks(n_surveys: int, *, seed: int, n_stops: int) -> Experiment[int, Plain, Plain]:
    """Return the experiment that adjusts surveys of random worlds, each without control.

    Parameters
    ----------
    n_surveys : int
        Number of worlds.
    seed : int
        Seed of the first world; every other one follows.
    n_stops : int
        Stops of each.

    Returns
    -------
    Experiment
        Its report has the errors of each survey, and their means by family of world.
    """
    return Experiment(
        worlds=range(seed, seed + 2 * n_surveys, 2),
        run_world=partial(_random_survey, n_stops=n_stops),
        pool=lambda rows: {
            "n_surveys": n_surveys,
            "n_stops": n_stops,
            "seed": seed,
            "families": _by_family(rows),
            "surveys": rows,
        },
        tables=_random_tables,
    )


def _random_survey(seed: int, *, n_stops: int) -> Plain:
    """Simulate a survey of a random world, adjust it, and compare it with its truth."""
    world = draw_world(seed)
    field = world.field
    config = replace(_CONFIG, marker_radius=field.marker_radius)
    stops, scans = [], []
    for place in field.stops[:n_stops]:
        stop = simulate_stop(field, place.name, world.config)
        stops.append(stop)
        try:
            (result,) = process(stop.log, config=config)
        except SpheremarkError:
            continue
        scans.append((place.name, result.fits[_METHOD]))
    row: Plain = {"seed": seed, "family": field.family, "failure": ""}
    try:
        network = assemble(scans, None, config.resection)
        return row | _row(field, stops, adjust_network(network, config.resection))
    except SpheremarkError as error:
        return row | {"failure": str(error)}


def _by_family(rows: Sequence[Plain]) -> list[Plain]:
    """Return means over the surveys of each family, and over all."""
    found = []
    for family in (*dict.fromkeys(row["family"] for row in rows), ""):
        own = [row for row in rows if family in ("", row["family"])]
        adjusted = [row for row in own if not row["failure"]]
        found.append(
            {
                "family": family or "all",
                "n": len(own),
                "n_adjusted": len(adjusted),
                "n_marks": sum(row["n_marks"] for row in adjusted),
                "n_false_marks": sum(row["n_false_marks"] for row in adjusted),
                **{
                    name: float(np.nanmean([row[name] for row in adjusted])) if adjusted else None
                    for name in _MEASURES
                },
                **{
                    f"within_{round(100 * level)}_{what}": _share_within(adjusted, what, level)
                    for what in ("marks", "stations")
                    for level in LEVELS
                },
            }
        )
    return found


def _share_within(rows: Sequence[Plain], what: str, level: float) -> float | None:
    """Return the share of surveys whose marks, or stations, lie together within their ellipsoid."""
    inside = []
    for row in rows:
        n = row["n_marks"] - row["n_false_marks"] if what == "marks" else row["n_stations"]
        freedom = 3 * n - 6  # place and attitude are taken out
        if np.isfinite(row[f"nees_{what}"]) and freedom > 0:
            inside.append(row[f"nees_{what}"] * freedom <= chi2.ppf(level, freedom))
    return float(np.mean(inside)) if inside else None


def _random_tables(report: Plain) -> list[Table]:
    """Return the means by family."""
    title = (
        f"{report['n_surveys']} surveys of {report['n_stops']} stops in random worlds, every other "
        f"seed from {report['seed']}; free networks, datum taken out."
    )
    columns = (
        Column("family", "family"),
        Column("n", "surveys", "", "d"),
        Column("n_adjusted", "adjusted", "", "d"),
        Column("n_marks", "marks", "", "d"),
        Column("n_false_marks", "false", "", "d"),
        Column("rms_marks_m", "marks, RMS", "mm", ".2f"),
        Column("nees_marks", "NEES per degree", "", ".2f"),
        *(
            Column(f"within_{round(100 * p)}_marks", f"in {round(100 * p)} %", "%", ".0f")
            for p in LEVELS
        ),
        Column("rms_stations_m", "stations, RMS", "mm", ".2f"),
        Column("nees_stations", "NEES per degree", "", ".2f"),
        *(
            Column(f"within_{round(100 * p)}_stations", f"in {round(100 * p)} %", "%", ".0f")
            for p in LEVELS
        ),
    )
    notes = [
        f"Seed {row['seed']} ({row['family']}): {row['failure']}"
        for row in report["surveys"]
        if row["failure"]
    ]
    return [Table(title=title, columns=columns, rows=report["families"], notes=notes)]


def _tables(report: Plain) -> list[Table]:
    """Return the means over surveys beside the accepted ones."""
    rigs = (
        "wrong rigs, calibrated in the same adjustment" if report["is_rig_wrong"] else "as set up"
    )
    low, high = report["bars_nees"]
    rows = []
    for name, (what, factor) in _MEASURES.items():
        bar = f"{factor * report['bars'][name]:.1f}" if name in BARS else f"{low} to {high}"
        scaled = {k: v and factor * v for k, v in report["summary"][name].items()}
        rows.append(scaled | {"what": what, "bar": bar})
    title = (
        f"{report['n_surveys']} surveys of {report['n_stops']} stops, ranges with sigma "
        f"{1e3 * report['sigma_range_m']:.0f} mm, {rigs}; free networks, datum taken out."
    )
    note = (
        f"A gross error of {100 * report['gross_error_m']:.0f} cm was found and named in "
        f"{report['n_gross_found']} of {report['n_surveys']} surveys. Left out without one: "
        f"{report['n_left_out']} of {report['n_observations']:,} centres, gravity included; false "
        f"marks: {report['n_false_marks']}. Assembly and adjustment: "
        f"{report['adjustment_cpu_seconds']:.2f} s of CPU each."
    )
    numbers = {"mean": "mean", "sigma_mean": "+-", "least": "least", "greatest": "greatest"}
    columns = (
        Column("what", ""),
        *(Column(key, title, "", ".2f") for key, title in numbers.items()),
        Column("bar", "bar", "", ">"),
    )
    return [Table(title=title, columns=columns, rows=rows, notes=[note])]


def _report(rows: Sequence[Plain]) -> Plain:
    """Return the errors of all surveys, their means and sums."""
    sums = ("n_false_marks", "n_left_out", "n_observations")
    return {
        "sigma_range_m": _SIGMA_RANGE,
        "gross_error_m": _GROSS,
        "bars": BARS,
        "bars_nees": BARS_NEES,
        "summary": {name: _summary([row[name] for row in rows]) for name in _MEASURES},
        **{name: sum(row[name] for row in rows) for name in sums},
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


def _survey(seed: int, *, n_stops: int, is_rig_wrong: bool) -> Plain:
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
    """Return the centres of all stops, and the calibration of the rig if it is wrong."""
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
    """Return whether an observation that is wrong by 5 cm is the first to be left out."""
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
