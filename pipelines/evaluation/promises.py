"""Stations of random worlds against what a plan of their own marks promises."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.errors import SpheremarkError
from spheremark.pipelines.evaluation.data_sheets import data_sheet
from spheremark.pipelines.evaluation.ellipse_coverage import pose_errors
from spheremark.pipelines.evaluation.experiment import Column, Experiment, Plain, Table
from spheremark.pipelines.model import Array
from spheremark.pipelines.placement import (
    Evaluation,
    Requirement,
    Sensor,
    evaluate,
    marks_of_field,
    sensor_model,
    site_of_field,
    stops_of_field,
)
from spheremark.pipelines.placement.station_covariance import LOOSE2
from spheremark.pipelines.positioning.resection import resect
from spheremark.pipelines.simulation import (
    RandomWorld,
    draw_world,
    simulate_stop,
)
from spheremark.pipelines.survey import process

N_STOPS = 3
"""Stops of each world."""

FOREIGN = ("optics", "rig", "one face", "clock", "dust", "all at once")
"""Families whose physics a plan does not assume: wide priors, or half a turn."""

_METHOD = "along_beam"
_CLASSES = (20.0, 50.0, 100.0, 500.0, np.inf)  # of expected returns
_N_RESAMPLES = 2000


class _Matched(NamedTuple):
    """What a survey of a stop made of its marks."""

    error: float
    status: str
    matched: list[int]


def promises(n_worlds: int, first_seed: int) -> Experiment[int, list[Plain], Plain]:
    """Return the experiment that compares stations of random worlds with their plans.

    Parameters
    ----------
    n_worlds : int
        Number of worlds.
    first_seed : int
        Seed of the first world; every other one follows.

    Returns
    -------
    Experiment
        Its report has errors over promised sigmas, with intervals from resampled worlds, and the
        marks that were found beside those that were expected.

    Notes
    -----
    A plan and its survey know the marks, the ground, how LiDAR and gimbal turn, and the data sheets
    of LiDAR, rig and AHRS: the sigmas of the errors, not the errors. Every stop counts to which the
    plan promises a position. It has none where the survey states a 3-D sigma of more than 1 m, as
    two marks leave that stand for each other: plans call such positions undetermined too.
    """
    return Experiment(
        worlds=range(first_seed, first_seed + 2 * n_worlds, 2),
        run_world=_world,
        pool=partial(_report, first_seed=first_seed, n_worlds=n_worlds),
        tables=_tables,
    )


def _world(seed: int) -> list[Plain]:
    """Return the stations of one world, and what their plan promises."""
    world = draw_world(seed)
    if len(world.field.marks.names) < 2:
        return []
    stops = stops_of_field(world.field).rows(np.arange(N_STOPS))
    site, marks = site_of_field(world.field), marks_of_field(world.field)
    config = data_sheet(world)
    model = sensor_model(_sensor(world, config), world.field.marker_radius)
    requirement = Requirement(
        sigma_levelling=config.stitching.sigma_levelling, resection=config.resection
    )
    plan = evaluate(site, stops, marks, model, requirement)
    return [
        _row(world, config, plan, e)
        for e in range(len(stops.names))
        if np.isfinite(plan.sigma_3d[e])
    ]


def _sensor(world: RandomWorld, survey: SurveyConfig) -> Sensor:
    """Return the sensor as its data sheets describe it: motion, noise, rig and encoder."""
    config, fitting = world.config, survey.fitting
    rate = 0.0 if config.step else 2.0 * np.pi / config.turn
    jitter = np.array([config.sigma_encoder, config.sigma_joint_stamp * rate])
    steps = np.array([config.encoder_step, config.range_step]) / np.sqrt(12.0)
    ripples = tuple(
        (
            amplitude
            * float(
                np.hypot(
                    config.gimbal_clock_offset * periods * rate,
                    1.0 - np.sinc(periods / (config.turn * config.joint_rate)) ** 2,
                )
            ),
            periods,
        )
        for amplitude, periods in config.ripples
    )
    shade = _reflectivity(world)
    return Sensor(
        turn=config.turn,
        sweep=config.sweep,
        spin_rpm=config.spin_rpm,
        step=config.step,
        rest_revolutions=config.rest_revolutions,
        move=config.move,
        noise=float(
            np.hypot(config.sigma_range or Sensor(reflectivity=shade).sigma_range, steps[1])
        ),
        sigma_weak=config.optics.sigma_weak,
        reach=config.optics.range_half * float(np.sqrt(shade / 10.0)),
        drop_out=config.drop_out,
        sigma_range_bias=fitting.sigma_range_bias,
        sigma_range_common=fitting.sigma_range_common,
        sigma_mounting=fitting.sigma_mounting,
        sigma_offset=fitting.sigma_offset,
        sigma_encoder=float(np.hypot(np.linalg.norm(jitter), steps[0])),
        ripples=ripples,
        joint_rate=config.joint_rate,
    )


def _reflectivity(world: RandomWorld) -> float:
    """Return the calibrated reflectivity of the markers, 0 to 255."""
    return 100.0 * float(
        world.field.scene.spheres.reflectivities[: len(world.field.marks.names)].mean()
    )


def _row(world: RandomWorld, config: SurveyConfig, plan: Evaluation, stop: int) -> Plain:
    """Return a station beside its promise."""
    found = _surveyed(world, config, plan.stops.names[stop])
    marks = np.flatnonzero(plan.is_seen[stop])
    places = np.searchsorted(_CLASSES, plan.n_points[stop, marks], side="right") - 1
    return {
        "seed": world.field.seed,
        "family": world.field.family,
        "sigma_3d_m": float(plan.sigma_3d[stop]),
        "promised_rms_3d_m": float(plan.rms_3d[stop]),
        "error_3d_m": found.error,
        "status": found.status,
        "marks": [
            {
                "class": int(place),
                "expected": float(plan.found[stop, mark]),
                "is_matched": bool(mark in found.matched),
            }
            for mark, place in zip(marks, places, strict=True)
        ],
    }


def _surveyed(world: RandomWorld, config: SurveyConfig, name: str) -> _Matched:
    """Return the error of a station by the whole chain, and the marks that carry it."""
    field = world.field
    stop = simulate_stop(field, name, world.config)
    try:
        (result,) = process(stop.log, config=config)
        fits = result.fits[_METHOD]
        fix = resect("free_station", fits, field.marks, config.resection)
    except SpheremarkError as reason:
        return _Matched(np.nan, reason.code, [])
    error, sigma, _ = pose_errors(
        (fix.T_site_station, fix.cov_T_site_station), stop.truth, fits.levelling
    )
    if sigma**2 > LOOSE2:
        return _Matched(np.nan, "undetermined", [])
    return _Matched(float(np.linalg.norm(error)), fix.status.value, fix.matches[:, 1].tolist())


def _report(parts: Sequence[Sequence[Plain]], *, first_seed: int, n_worlds: int) -> Plain:
    """Pool the stations of all worlds."""
    rows = [row for part in parts for row in part]
    usual = [row for row in rows if row["family"] not in FOREIGN]
    families = dict.fromkeys(row["family"] for row in rows)
    groups = {name: [row for row in rows if row["family"] == name] for name in families}
    marks = [mark for row in usual for mark in row["marks"]]
    return {
        "n_worlds": n_worlds,
        "first_seed": first_seed,
        "groups": [
            _group(name, own)
            for name, own in {**groups, "usual physics": usual, "all": rows}.items()
        ],
        "marks": [
            {
                "returns": f"{low:.0f} to {high:.0f}" if np.isfinite(high) else f"over {low:.0f}",
                "n": sum(mark["class"] == i for mark in marks),
                "n_expected": sum(mark["expected"] for mark in marks if mark["class"] == i),
                "n_matched": sum(mark["is_matched"] for mark in marks if mark["class"] == i),
            }
            for i, (low, high) in enumerate(pairwise(_CLASSES))
        ],
        "stations": rows,
    }


def _group(name: str, rows: Sequence[Plain]) -> Plain:
    """Return errors over promises of some stations, weak ones included."""
    fixed = [row for row in rows if np.isfinite(row["error_3d_m"])]
    squares = np.array([(row["error_3d_m"] / row["promised_rms_3d_m"]) ** 2 for row in fixed])
    low, high = _interval(np.array([row["seed"] for row in fixed]), squares)
    marks = [mark for row in rows for mark in row["marks"]]
    errors, promised = (
        np.array([row[key] for row in fixed]) for key in ("error_3d_m", "promised_rms_3d_m")
    )
    return {
        "family": name,
        "n_stations": len(rows),
        "n_weak": sum(row["status"] == "weak" for row in rows),
        "n_none": len(rows) - len(fixed),
        "n_expected": sum(mark["expected"] for mark in marks),
        "n_matched": sum(mark["is_matched"] for mark in marks),
        "rms_error_m": float(np.sqrt(np.mean(errors**2))) if fixed else np.nan,
        "rms_sigma_m": float(np.sqrt(np.mean(promised**2))) if fixed else np.nan,
        "ratio": float(np.sqrt(squares.mean())) if fixed else np.nan,
        "ratio_low": low,
        "ratio_high": high,
        "ratio_ok": _ratio(fixed, squares),
        "median_ratio": float(np.sqrt(np.median(squares))) if fixed else np.nan,
    }


def _ratio(rows: Sequence[Plain], squares: Array) -> float:
    """Return the root of the mean square of the stations that their survey calls ok."""
    sure = squares[[row["status"] == "ok" for row in rows]] if rows else squares
    return float(np.sqrt(sure.mean())) if len(sure) else np.nan


def _interval(seeds: Array, squares: Array) -> tuple[float, float]:
    """Return the 95 % interval of the root of a mean, from resampled worlds."""
    own = [squares[seeds == seed] for seed in np.unique(seeds)]
    if len(own) < 2:
        return np.nan, np.nan
    sums, counts = (np.array([f(one) for one in own], dtype=np.float64) for f in (np.sum, len))
    some = np.random.default_rng(0).integers(0, len(own), (_N_RESAMPLES, len(own)))
    means = np.sqrt(sums[some].sum(axis=1) / counts[some].sum(axis=1))
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)


def _tables(report: Plain) -> list[Table]:
    """Return errors over promises by family, and marks by expected returns."""
    title = (
        f"Stations of {report['n_worlds']} random worlds, every other seed from "
        f"{report['first_seed']}, over what plans promise"
    )
    note = (
        "Errors over promised RMS: root of the mean square with its 95 % interval from "
        f"resampled worlds, weak stations included; usual physics is without {', '.join(FOREIGN)}."
    )
    columns = (
        Column("family", "family"),
        Column("n_stations", "stations", "", "d"),
        Column("n_weak", "weak", "", "d"),
        Column("n_none", "without a position", "", "d"),
        Column("n_expected", "marks expected", "", ".1f"),
        Column("n_matched", "marks found", "", "d"),
        Column.mm("rms_error_m", "RMS"),
        Column.mm("rms_sigma_m", "promised"),
        Column("ratio", "ratio", "", ".2f"),
        Column("ratio_low", "from", "", ".2f"),
        Column("ratio_high", "to", "", ".2f"),
        Column("ratio_ok", "ratio, ok", "", ".2f"),
        Column("median_ratio", "median", "", ".2f"),
    )
    by_returns = (
        Column("returns", "expected returns"),
        Column("n", "marks", "", "d"),
        Column("n_expected", "expected", "", ".1f"),
        Column("n_matched", "found", "", "d"),
    )
    return [
        Table(title=title, columns=columns, rows=report["groups"], notes=[note]),
        Table(title="Marks by returns, usual physics", columns=by_returns, rows=report["marks"]),
    ]
