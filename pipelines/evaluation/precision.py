"""Precision of sphere centres against distance, beside the bound of Cramer and Rao.

Simulated stops of the range lane with a rig that is perfect but for the noise of its ranges and its
steps; every fitting method sees the same returns.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.accuracy.truth import UNMATCHED, marker_errors
from spheremark.pipelines.config import FITTING_METHODS, SurveyConfig
from spheremark.pipelines.detection import extract
from spheremark.pipelines.errors import DegenerateGeometryError
from spheremark.pipelines.evaluation.experiment import Column, Experiment, Plain, Table
from spheremark.pipelines.geometry import inverse, transform
from spheremark.pipelines.model import Array, MarkerFits, StitchedCloud
from spheremark.pipelines.scan.stitching import beams, stitch
from spheremark.pipelines.simulation import SimulationConfig, simulate_stop
from spheremark.pipelines.simulation.lane import range_lane
from spheremark.pipelines.sphere import fit_markers
from spheremark.pipelines.sphere.bound import cramer_rao, hits

_SEGMENT = 1.5  # radii from a true centre within which returns may be of its sphere
_TOLERANCE = 0.03  # [m] and four sigmas by which the range of a hit may be off
_SHARE = 0.02  # of a footprint: a beam that touches with less has a derivative without limit
_DISTANCES = (5.0, 10.0, 15.0, 20.0, 25.0, 30.0)  # [m]
_PER_DISTANCE = 20
_TURN = SimulationConfig().turn
_LONG_TURN = 20.7  # [s] as incommensurate with the channels as the usual one
# Ranges have no bias here: expected by fits, it would hide in covariances what noise and beams do
_UNBIASED = {"sigma_range_common": 0.0, "sigma_range_scale": 0.0}
_N_STOPS_FULL = 64  # 1280 markers at each distance


class Case(NamedTuple):
    """Noise of the ranges [m] and time of the turn [s]."""

    sigma: float
    turn: float


CASES = (Case(0.01, _TURN), Case(0.02, _TURN))
"""The usual cases."""


class _Bounds(NamedTuple):
    """Least mean square error by all beams that hit, by those that hit clearly, and how many."""

    every: float
    clear: float
    n_hits: int


class _Row(NamedTuple):
    """One fit against truth."""

    case: Case
    distance: float
    method: str
    error: float
    radial: float
    nees: float
    bounds: _Bounds
    is_weak: bool


def precision(
    n_stops: int,
    seed: int,
    *,
    cases: Sequence[Case] = CASES,
    methods: Sequence[str] = FITTING_METHODS,
) -> Experiment[tuple[Case, int], list[_Row], Plain]:
    """Return the experiment that compares fitted centres with the truth and with the bound.

    Parameters
    ----------
    n_stops : int
        Stops of 20 markers at each of six distances, in each case.
    seed : int
        Seed of the first stop of each case; the others follow.
    cases : sequence of Case
        Noise of the ranges and time of the turn.
    methods : sequence of str
        Fitting methods.

    Returns
    -------
    Experiment
        Its report has one row for each case, distance and method.
    """
    return Experiment(
        worlds=[(case, seed + k) for case in cases for k in range(n_stops)],
        run_world=partial(_stop, methods=tuple(methods)),
        pool=lambda stops: {
            "stops": n_stops,
            "per_distance": _PER_DISTANCE,
            "seed": seed,
            "rows": _pooled([row for rows in stops for row in rows], methods),
        },
        tables=_tables,
    )


def full_precision(seed: int) -> Experiment[tuple[Case, int], list[_Row], Plain]:
    """Return ``precision`` with over a thousand fits at each distance, a long turn, two methods.

    Parameters
    ----------
    seed : int
        Seed of the first stop of each case; the others follow.

    Returns
    -------
    Experiment
        As of ``precision``.
    """
    cases = (*CASES, Case(0.02, _LONG_TURN))
    return precision(_N_STOPS_FULL, seed, cases=cases, methods=("along_beam", "silhouette"))


_COLUMNS = (
    Column("method", "method"),
    Column("sigma_m", "sigma", "mm", ".0f"),
    Column("turn_s", "turn", "s", ".1f"),
    Column("distance_m", "distance", "m", ".0f"),
    Column("n", "n", "", "d"),
    Column("mean_hits", "hits", "", ".0f"),
    Column("bound_m", "bound", "mm", ".2f"),
    Column("rms_m", "RMS", "mm", ".2f"),
    Column("bound_over_rms", "bound/RMS", "", ".2f"),
    Column("bound_clear_over_rms", "clear/RMS", "", ".2f"),
    Column.mm("median_m", "median"),
    Column.mm("p95_m", "p95"),
    Column.mm("radial_bias_m", "radial"),
    Column("mean_nees", "NEES", "", ".1f"),
)
_NOTE = (
    "The bound is that of Cramer and Rao for ranges alone, over the beams that hit; clear: without "
    "the beams of which less than a fiftieth hit, whose derivative has no limit. along_beam also "
    "uses that what returned has met the sphere, and silhouette which beams passed by: both may go "
    "below the bound."
)


def _tables(report: Plain) -> list[Table]:
    """Return the rows as a table: millimetres, and the share of the bound that is reached."""
    title = f"{report['stops']} stops of {report['per_distance']} markers at each distance"
    return [Table(title=title, columns=_COLUMNS, rows=report["rows"], notes=[_NOTE])]


def _stop(world: tuple[Case, int], *, methods: Sequence[str]) -> list[_Row]:
    """Simulate one stop and compare every method with the truth."""
    (case, seed), config = world, SurveyConfig.from_mapping({"fitting": _UNBIASED})
    field = range_lane(seed, np.array(_DISTANCES), _PER_DISTANCE)
    usual = SimulationConfig()
    rig = SimulationConfig.perfect(
        sigma_range=case.sigma,
        divergence=usual.divergence,
        range_step=usual.range_step,
        azimuth_step=usual.azimuth_step,
        encoder_step=usual.encoder_step,
        turn=case.turn,
        only_near_spheres=True,
    )
    stop = simulate_stop(field, field.stops[0].name, rig)
    cloud = stitch(stop.log, stop.rig, config.stitching)
    true = transform(inverse(stop.truth.T_site_base), field.marks.p_site)
    found = extract(cloud, config.extraction, field.marker_radius)
    bounds = [_bounds(cloud, p, field.marker_radius, case.sigma) for p in true]
    rows = []
    for method in methods:
        fits = fit_markers(method, cloud, found, config.fitting, field.marker_radius)
        marks = marker_errors(fits, stop.truth, field.marks).marks
        rows += _rows(case, fits, true, bounds, marks.tolist())
    return rows


def _bounds(cloud: StitchedCloud, p: Array, radius: float, sigma: float) -> _Bounds | None:
    """Return the bounds by beams that hit; none where too few hit clearly for a centre."""
    is_near = np.linalg.norm(cloud.p_base - p.astype(np.float32), axis=1) < _SEGMENT * radius
    near, tolerance = np.flatnonzero(is_near), _TOLERANCE + 4.0 * sigma
    pulses = beams(cloud, near)
    every, clear = (near[hits(pulses, p, radius, tolerance, share)] for share in (0.0, _SHARE))
    try:
        least = (cramer_rao(beams(cloud, some), p, radius, sigma) for some in (every, clear))
        of_every, of_clear = (float(np.trace(cov)) for cov in least)
    except DegenerateGeometryError:
        return None
    return _Bounds(of_every, of_clear, len(every))


def _rows(
    case: Case, fits: MarkerFits, true: Array, bounds: list[_Bounds | None], marks: list[int]
) -> list[_Row]:
    """Return one row per fit of a true marker."""
    rows = []
    for fit, mark in zip(fits.fits, marks, strict=True):
        bound = bounds[mark]
        if mark == UNMATCHED or bound is None:
            continue
        p, error = true[mark], fit.p_base - true[mark]
        away = float(np.linalg.norm(p))
        rows.append(
            _Row(
                case=case,
                distance=min(_DISTANCES, key=lambda d: abs(d - away)),
                method=fits.method,
                error=float(np.linalg.norm(error)),
                radial=float(error @ p) / away,
                nees=float(error @ np.linalg.solve(fit.cov_p_base, error)),
                bounds=bound,
                is_weak=bool(fit.reason),
            )
        )
    return rows


def _pooled(rows: Sequence[_Row], methods: Sequence[str]) -> list[Plain]:
    """Return one row per case, distance and method, in this order."""
    found: dict[tuple[Case, float, int], list[_Row]] = {}
    for row in rows:
        found.setdefault((row.case, row.distance, methods.index(row.method)), []).append(row)
    return [_summary(found[key]) for key in sorted(found)]


def _summary(rows: list[_Row]) -> Plain:
    """Return the statistics of one method at one distance."""
    first, errors = rows[0], np.array([r.error for r in rows])
    rms = float(np.sqrt(np.mean(errors**2)))
    every2, clear2, n_hits = np.mean([r.bounds for r in rows], axis=0).tolist()
    return {
        "sigma_m": first.case.sigma,
        "turn_s": first.case.turn,
        "distance_m": first.distance,
        "method": first.method,
        "n": len(rows),
        "mean_hits": n_hits,
        "bound_m": every2**0.5,
        "bound_clear_m": clear2**0.5,
        "rms_m": rms,
        "bound_over_rms": every2**0.5 / rms,
        "bound_clear_over_rms": clear2**0.5 / rms,
        "median_m": float(np.median(errors)),
        "p95_m": float(np.quantile(errors, 0.95)),
        "radial_bias_m": float(np.mean([r.radial for r in rows])),
        "mean_nees": float(np.mean([r.nees for r in rows])),
        "share_weak": float(np.mean([r.is_weak for r in rows])),
    }
