"""``spheremark bench --coverage``: whether error ellipses of stations hold what they promise.

The report is kept in the data folder, where the service's page finds it.
"""

from __future__ import annotations

import csv
import json
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.evaluation.ellipse_coverage import (
    LEVELS,
    METHODS,
    QUANTITIES,
    Draws,
    coverage,
    nees,
    simulate_surveys,
)
from spheremark.pipelines.simulation import SimulationConfig
from spheremark.pipelines.survey import Progress
from spheremark.service.provenance import code_version

Plain = dict[str, Any]

N_STOPS = 15
"""Stops of each survey."""

NAME = "coverage.json"
"""The report, in the data folder; a table beside it ends in ``.csv``."""

_CURVE = tuple(np.round(np.arange(0.05, 1.0, 0.05), 2).tolist())
_BINS = np.arange(0.0, 20.5, 0.5)


def run(n_surveys: int, seed: int, progress: Progress) -> Plain:
    """Simulate surveys and report how often their stations lie within their ellipses."""
    return report(simulate_surveys(n_surveys, N_STOPS, seed, progress=progress), seed)


def report(draws: Draws, seed: int) -> Plain:
    """Return what many surveys gave as plain values."""
    mean_squares = nees(draws)
    return {
        "made_at": datetime.now(UTC).isoformat(timespec="seconds"),
        "code_version": code_version(),
        "seed": seed,
        "n_surveys": len(np.unique(draws.surveys)),
        "n_stations": len(draws.surveys),
        "config": SurveyConfig().to_mapping()["resection"],
        "simulation": SimulationConfig(only_near_spheres=True).to_mapping(),
        "levels": [asdict(one) for one in coverage(draws, LEVELS)],
        "curve": [asdict(one) for one in coverage(draws, _CURVE)],
        "methods": [_method(draws, method) for method in METHODS],
        "nees": [
            {
                "method": method,
                "quantity": quantity,
                "dimensions": QUANTITIES[quantity],
                "per_dimension": value,
                "counts": _counts(draws.squares[method, quantity]),
            }
            for (method, quantity), value in mean_squares.items()
        ],
        "bins": _BINS.tolist(),
    }


def _method(draws: Draws, method: str) -> Plain:
    """Return how large errors and predictions of a method are."""
    errors, sigmas = draws.errors[method], draws.sigmas[method]
    return {
        "method": method,
        "n": int(np.isfinite(sigmas).sum()),
        "error_3d_rms_m": float(np.sqrt(np.nanmean(np.sum(errors**2, axis=1)))),
        "sigma_3d_rms_m": float(np.sqrt(np.nanmean(sigmas**2))),
    }


def _counts(squares: np.ndarray) -> list[int]:
    """Return how many squares lie in each bin; what is beyond the last is in the last."""
    known = np.minimum(squares[np.isfinite(squares)], _BINS[-1] - 1e-9)
    return [int(n) for n in np.histogram(known, _BINS)[0]]


def keep(made: Plain, folder: Path) -> Path:
    """Write a report and its table into a data folder."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / NAME
    path.write_text(json.dumps(made, indent=1), encoding="utf-8")
    with path.with_suffix(".csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(made["levels"][0]))
        writer.writeheader()
        writer.writerows([*made["levels"], *made["curve"]])
    return path


def kept(folder: Path) -> Plain | None:
    """Return the report of a data folder, if there is one."""
    path = folder / NAME
    return json.loads(path.read_text("utf-8")) if path.exists() else None


def print_report(out: Console, made: Plain) -> None:
    """Print how often stations lie within their ellipses."""
    table = Table(
        title=f"Share of {made['n_stations']} stations of {made['n_surveys']} simulated surveys "
        "within their ellipses (95 % interval, whole surveys drawn again)",
        title_justify="left",
    )
    table.add_column("stations by")
    table.add_column("of")
    for level in LEVELS:
        table.add_column(f"{100 * level:.0f} %", justify="right")
    table.add_column("mean square", justify="right")
    for row in made["nees"]:
        cells = [
            f"{100 * one['share']:.1f} ({100 * one['low']:.0f}-{100 * one['high']:.0f})"
            for one in made["levels"]
            if (one["method"], one["quantity"]) == (row["method"], row["quantity"])
        ]
        table.add_row(row["method"], row["quantity"], *cells, f"{row['per_dimension']:.2f}")
    out.print(table)
    for one in made["methods"]:
        out.print(
            f"{one['method']}: error {1000 * one['error_3d_rms_m']:.2f} mm, predicted "
            f"{1000 * one['sigma_3d_rms_m']:.2f} mm (3-D, RMS)"
        )
