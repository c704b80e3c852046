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

from pipelines.accuracy import UNMATCHED, marker_errors
from pipelines.config import FITTING_METHODS, SurveyConfig
from pipelines.extraction import extract
from pipelines.fitting import fit_markers
from pipelines.fitting.bound import cramer_rao, hits
from pipelines.geometry import inverse, transform
from pipelines.simulation import SimulationConfig, scenario, simulate_stop
from pipelines.stitching import beams, stitch
from pipelines.survey import Progress
from pipelines.values import Array, MarkerFits, StitchedCloud

_SEGMENT = 1.5  # radii from a true centre within which returns may be of its sphere
_TOLERANCE = 0.03  # [m] and four sigmas by which the range of a hit may be off
_BIN = 2.5  # [m] between the distances of the lane
Plain = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Wish:
    """How many stops of 8 markers at each distance, under what noise, in what turn, by whom."""

    n_stops: int = 6
    sigmas: tuple[float, ...] = (0.01, 0.02)
    turn: float = SimulationConfig().turn
    methods: tuple[str, ...] = FITTING_METHODS
    seed: int = 0


class _Row(NamedTuple):
    """One fit against truth."""

    sigma: float
    distance: float
    method: str
    error: float
    radial: float
    nees: float
    bound2: float
    n_hits: int
    is_weak: bool


def accuracy_table(wish: Wish, progress: Progress) -> list[Plain]:
    """Fit simulated markers by every method; return one row per noise, distance and method."""
    config, rows = SurveyConfig(), []
    n = len(wish.sigmas) * wish.n_stops
    for i in range(n):
        sigma = wish.sigmas[i // wish.n_stops]
        progress(i / n, f"Stop {i % wish.n_stops + 1} at sigma {1e3 * sigma:.0f} mm")
        rows += _stop(sigma, wish.seed + i % wish.n_stops, wish, config)
    keys = sorted({(row.sigma, row.distance) for row in rows})
    return [
        _summary([row for row in rows if (row.sigma, row.distance, row.method) == (*key, method)])
        for key in keys
        for method in wish.methods
        if any((row.sigma, row.distance, row.method) == (*key, method) for row in rows)
    ]


def _stop(sigma: float, seed: int, wish: Wish, config: SurveyConfig) -> list[_Row]:
    """Simulate one stop and compare every method with the truth."""
    field = scenario("range-lane", seed)
    usual = SimulationConfig()
    rig = SimulationConfig.perfect(
        sigma_range=sigma,
        divergence=usual.divergence,
        range_step=usual.range_step,
        azimuth_step=usual.azimuth_step,
        encoder_step=usual.encoder_step,
        turn=wish.turn,
        only_near_spheres=True,
    )
    stop = simulate_stop(field, field.stops[0].name, rig)
    cloud = stitch(stop.log, stop.rig, config.stitching)
    true = transform(inverse(stop.truth.T_site_base), field.marks.p_site)
    bounds = [_bound(cloud, p, field.marker_radius, sigma) for p in true]
    found = extract(cloud, config.extraction, field.marker_radius)
    rows = []
    for method in wish.methods:
        fits = fit_markers(method, cloud, found, config.fitting, field.marker_radius)
        errors = marker_errors(fits, stop.truth, field.marks)
        rows += _rows(sigma, fits, true, bounds, errors.marks.tolist())
    return rows


def _bound(cloud: StitchedCloud, p: Array, radius: float, sigma: float) -> tuple[float, int]:
    """Return the least mean square error [m^2] by the very beams that hit, and their number."""
    near = np.linalg.norm(cloud.p_base - p.astype(np.float32), axis=1) < _SEGMENT * radius
    table = beams(cloud, np.flatnonzero(near))
    is_hit = hits(table, p, radius, _TOLERANCE + 4.0 * sigma)
    table = beams(cloud, np.flatnonzero(near)[is_hit])
    return float(np.trace(cramer_rao(table, p, radius, sigma))), int(is_hit.sum())


def _rows(
    sigma: float,
    fits: MarkerFits,
    true: Array,
    bounds: list[tuple[float, int]],
    marks: list[int],
) -> list[_Row]:
    """Return one row per fit of a true marker."""
    rows = []
    for fit, mark in zip(fits.fits, marks, strict=True):
        if mark == UNMATCHED:
            continue
        p, (bound2, n_hits) = true[mark], bounds[mark]
        error = fit.p_base - p
        distance = float(np.linalg.norm(p))
        rows.append(
            _Row(
                sigma=sigma,
                distance=round(distance / _BIN) * _BIN,
                method=fits.method,
                error=float(np.linalg.norm(error)),
                radial=float(error @ p) / distance,
                nees=float(error @ np.linalg.solve(fit.cov_p_base, error)),
                bound2=bound2,
                n_hits=n_hits,
                is_weak=bool(fit.reason),
            )
        )
    return rows


def _summary(rows: list[_Row]) -> Plain:
    """Return what the fits of one method at one distance are worth."""
    first = rows[0]
    errors, bound2 = np.array([r.error for r in rows]), np.array([r.bound2 for r in rows])
    rms, bound = float(np.sqrt(np.mean(errors**2))), float(np.sqrt(bound2.mean()))
    return {
        "sigma_m": first.sigma,
        "distance_m": first.distance,
        "method": first.method,
        "n": len(rows),
        "mean_hits": float(np.mean([r.n_hits for r in rows])),
        "bound_m": bound,
        "rms_m": rms,
        "bound_over_rms": bound / rms,
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
        "turn_s": wish.turn,
        "seed": wish.seed,
        "rows": accuracy_table(wish, progress),
    }


def print_report(out: Console, report: Plain) -> None:
    """Print the table: millimetres, and the share of the bound that is reached."""
    out.print(
        f"{report['stops']} stops of 8 markers at each distance, turn {report['turn_s']:.1f} s. "
        "The bound is Cramer and Rao's, of ranges alone, for the very beams that hit."
    )
    table = Table("sigma", "distance [m]", "method", "n", "hits", "bound", "RMS", "bound/RMS")
    for name in ("median", "p95", "radial", "NEES"):
        table.add_column(name, justify="right")
    for row in report["rows"]:
        lengths = (row[k] * 1e3 for k in ("median_m", "p95_m", "radial_bias_m"))
        table.add_row(
            f"{row['sigma_m'] * 1e3:.0f}",
            f"{row['distance_m']:.1f}",
            row["method"],
            str(row["n"]),
            f"{row['mean_hits']:.0f}",
            f"{row['bound_m'] * 1e3:.2f}",
            f"{row['rms_m'] * 1e3:.2f}",
            f"{row['bound_over_rms']:.2f}",
            *(f"{length:.1f}" for length in lengths),
            f"{row['mean_nees']:.1f}",
        )
    out.print(table)
