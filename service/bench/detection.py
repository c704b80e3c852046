"""Precision and recall of extraction in simulated worlds, as plain values and as tables."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.table import Table

from spheremark.pipelines.evaluation.detection import DETECTION_PLAN, detection
from spheremark.pipelines.simulation import SimulationConfig
from spheremark.pipelines.survey import Progress

_N_REASONS = 3  # the most frequent reasons that a table shows


def run(n_worlds: int, seed: int, progress: Progress) -> dict[str, Any]:
    """Return precision and recall over so many worlds of each scenario."""
    seeds = range(seed, seed + n_worlds)
    found = detection(DETECTION_PLAN, seeds, SimulationConfig(), progress)
    return {"seeds": list(seeds), "scenarios": found.to_mapping()}


def print_report(out: Console, report: dict[str, Any]) -> None:
    """Print a table of markers and decoys for each scenario."""
    for name, one in report["scenarios"].items():
        precision = "none found" if one["precision"] is None else f"{one['precision']:.4f}"
        table = Table(
            title=f"{name}: {one['n_scans']} scans, precision {precision}, {one['n_false']} false, "
            f"at most {one['n_false_worst_scan']} in one scan",
            title_justify="left",
        )
        for heading in ("what", "in scans", "taken for a marker", "share", "why not"):
            table.add_column(heading, justify="left" if heading in ("what", "why not") else "right")
        for row in one["markers"] + one["decoys"]:
            table.add_row(*_cells(row))
        out.print(table)


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    """Return the cells of a row."""
    reasons = list(row["reasons"].items())[:_N_REASONS]
    return (
        row["kind"],
        f"{row['n']:,}",
        f"{row['n_found']:,}",
        f"{row['n_found'] / row['n']:.3f}",
        "; ".join(f"{reason} ({n})" for reason, n in reasons),
    )
