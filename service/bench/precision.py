"""Precision of sphere centres against distance, beside the bound that no estimate undercuts.

Simulated stops of the range lane with a rig that is perfect but for the noise of its ranges and its
steps; every fitting method sees the same returns.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from spheremark.pipelines.accuracy import UNMATCHED, marker_errors
from spheremark.pipelines.config import FITTING_METHODS, SurveyConfig
from spheremark.pipelines.detection import extract
from spheremark.pipelines.errors import DegenerateGeometryError
from spheremark.pipelines.geometry import inverse, transform
from spheremark.pipelines.model import Array, MarkerFits, StitchedCloud
from spheremark.pipelines.scan.stitching import beams, stitch
from spheremark.pipelines.simulation import SimulationConfig, simulate_stop
from spheremark.pipelines.simulation.lane import range_lane
from spheremark.pipelines.sphere import fit_markers
from spheremark.pipelines.sphere.bound import cramer_rao, hits
from spheremark.pipelines.survey import Progress

_SEGMENT = 1.5  # radii from a true centre within which returns may be of its sphere
_TOLERANCE = 0.03  # [m] and four sigmas by which the range of a hit may be off
_SHARE = 0.02  # of a footprint: a beam that touches with less has a derivative without limit
_DISTANCES = (5.0, 10.0, 15.0, 20.0, 25.0, 30.0)  # [m]
_PER_DISTANCE = 20
_TURN = SimulationConfig().turn
_LONG_TURN = 20.7  # [s] as incommensurate with the channels as the usual one
Plain = dict[str, Any]


class Case(NamedTuple):
    """Noise of the ranges [m] and time of the turn [s]."""

    sigma: float
    turn: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Wish:
    """How many stops of 20 markers at each of six distances, in which cases, by which methods."""

    n_stops: int = 3
    cases: tuple[Case, ...] = (Case(0.01, _TURN), Case(0.02, _TURN))
    methods: tuple[str, ...] = FITTING_METHODS
    seed: int = 0


def full_wish(seed: int) -> Wish:
    """Return the wish for a thousand fits and more at each distance, by the methods that count."""
    cases = (*Wish().cases, Case(0.02, _LONG_TURN))
    return Wish(n_stops=64, cases=cases, methods=("along_beam", "silhouette"), seed=seed)


class Bounds(NamedTuple):
    """Least mean square error by every beam that hit, by those that hit clearly, and how many."""

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
    bounds: Bounds
    is_weak: bool


def accuracy_table(wish: Wish, progress: Progress) -> list[Plain]:
    """Fit simulated markers by every method; return one row per noise, distance and method."""
    config, rows = SurveyConfig(), []
    n = len(wish.cases) * wish.n_stops
    for i in range(n):
        case, k = wish.cases[i // wish.n_stops], i % wish.n_stops
        progress(i / n, f"Stop {k + 1} at sigma {1e3 * case.sigma:.0f} mm, turn {case.turn:.1f} s")
        rows += _stop(case, wish.seed + k, wish.methods, config)
    found: dict[tuple[Case, float, int], list[_Row]] = {}
    for row in rows:
        found.setdefault((row.case, row.distance, wish.methods.index(row.method)), []).append(row)
    return [_summary(found[key]) for key in sorted(found)]


def _stop(case: Case, seed: int, methods: tuple[str, ...], config: SurveyConfig) -> list[_Row]:
    """Simulate one stop and compare every method with the truth."""
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
        errors = marker_errors(fits, stop.truth, field.marks)
        rows += _rows(case, fits, true, bounds, errors.marks.tolist())
    return rows


def _bounds(cloud: StitchedCloud, p: Array, radius: float, sigma: float) -> Bounds | None:
    """Return the bounds by beams that hit; none where too few hit clearly to tell a centre."""
    is_near = np.linalg.norm(cloud.p_base - p.astype(np.float32), axis=1) < _SEGMENT * radius
    near, tolerance = np.flatnonzero(is_near), _TOLERANCE + 4.0 * sigma
    shots = beams(cloud, near)
    every, clear = (near[hits(shots, p, radius, tolerance, share)] for share in (0.0, _SHARE))
    try:
        least = (cramer_rao(beams(cloud, some), p, radius, sigma) for some in (every, clear))
        of_every, of_clear = (float(np.trace(cov)) for cov in least)
    except DegenerateGeometryError:
        return None
    return Bounds(of_every, of_clear, len(every))


def _rows(
    case: Case, fits: MarkerFits, true: Array, bounds: list[Bounds | None], marks: list[int]
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


def _summary(rows: list[_Row]) -> Plain:
    """Return what the fits of one method at one distance are worth."""
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


def run(wish: Wish, progress: Progress) -> Plain:
    """Return the table with what it was made from."""
    return {
        "stops": wish.n_stops,
        "per_distance": _PER_DISTANCE,
        "seed": wish.seed,
        "rows": accuracy_table(wish, progress),
    }


def print_report(out: Console, report: Plain) -> None:
    """Print the table: millimetres, and the share of the bound that is reached."""
    out.print(
        f"{report['stops']} stops of {report['per_distance']} markers at each distance. The bound "
        "is Cramer and Rao's, of ranges alone, for the very beams that hit; clear: for those of "
        "which a fiftieth or more hit, without the grazing ones whose derivative has no limit. "
        "along_beam also knows that what returned has met the sphere, and silhouette what passed "
        "by: both may go below it."
    )
    table = Table("sigma", r"turn \[s]", r"distance \[m]", "method")
    names = ("n", "hits", "bound", "RMS", "bound/RMS", "clear/RMS", "median", "p95", "radial")
    for name in (*names, "NEES"):
        table.add_column(name, justify="right")
    for row in report["rows"]:
        lengths = (row[k] * 1e3 for k in ("median_m", "p95_m", "radial_bias_m"))
        table.add_row(
            f"{row['sigma_m'] * 1e3:.0f}",
            f"{row['turn_s']:.1f}",
            f"{row['distance_m']:.0f}",
            row["method"],
            str(row["n"]),
            f"{row['mean_hits']:.0f}",
            f"{row['bound_m'] * 1e3:.2f}",
            f"{row['rms_m'] * 1e3:.2f}",
            f"{row['bound_over_rms']:.2f}",
            f"{row['bound_clear_over_rms']:.2f}",
            *(f"{length:.1f}" for length in lengths),
            f"{row['mean_nees']:.1f}",
        )
    out.print(table)
