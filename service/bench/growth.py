"""How cost grows: scans of one to thirty million returns, networks of a hundred stations and more.

A straight line is fitted to times against sizes: the fixed part, the cost of each return or
station, and the greatest distance of a size from the line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.config import ResectionConfig
from spheremark.pipelines.evaluation.experiment import Column, Plain, Progress, Table
from spheremark.pipelines.geometry import inverse, rigid, rot_z, transform
from spheremark.pipelines.model import (
    Array,
    ControlMarks,
    Levelling,
    MarkerFit,
    MarkerFits,
    ScanLog,
    Status,
)
from spheremark.pipelines.network import adjust_network, assemble
from spheremark.service.bench.chain import CHAIN, Scan, measure
from spheremark.storage.recordings import read_log, write_log

_SIZES = (1, 2, 3, 6, 10, 20, 30)  # [millions of returns]
_REPEATS = 2
_STATIONS, _MARKS = (100, 200, 500, 1000), 200
_SMALL = ((35, 14), (300, 60))  # stations and marks of other networks
_AREA = 72.0  # [m^2] for each mark: 120 m by 120 m for 200 of them
_SEEN = 14  # marks that a station sees: the nearest
_SIGMA, _SIGMA_LEVEL, _SIGMA_CONTROL = 4e-3, 3e-3, 5e-3  # [m], [rad], [m]
_CONTROL = 4  # every so many marks one is control


def grown(scan: Scan, folder: Path, progress: Progress) -> Plain:
    """Return the costs of the chain on longer logs, and of adjustment on larger networks."""
    log = read_log(scan.log, digest="0" * 64)
    sizes = []
    for i, millions in enumerate(_SIZES):
        progress(0.8 + 0.15 * i / len(_SIZES), f"A log of {millions} million returns")
        sizes.append(_measured(log, millions * 1_000_000, scan, folder))
    progress(0.95, "Networks")
    small = [adjust(*size) for size in (_SMALL[0], *_SMALL)]  # the first compiles
    large = [adjust(n, _MARKS) for n in _STATIONS]
    return {
        "linearity": {
            "sizes": sizes,
            **line(sizes, "n_returns", "seconds"),
            "cpu": line(sizes, "n_returns", "cpu_seconds"),
        },
        "network": [*small[1:], *large],
        "network_linearity": {"n_marks": _MARKS}
        | {
            step: line(large, "n_stations", f"{step}_cpu_seconds")
            for step in ("assembly", "adjustment")
        },
    }


def _measured(log: ScanLog, n_returns: int, scan: Scan, folder: Path) -> Plain:
    """Return the cost of the chain on a log of so many returns."""
    path = folder / f"{n_returns}.mcap"
    write_log(_stretched(log, n_returns), path)
    read, found = measure({"": replace(scan, log=path)}, folder, _REPEATS, lambda *_: None)
    path.unlink()
    cost = found[""].costs[CHAIN]
    return {
        "n_returns": n_returns,
        "seconds": cost.seconds,
        "ratio": cost.seconds / read.seconds,
        "cpu_seconds": cost.cpu_seconds,
        "ns_per_return": 1e9 * cost.seconds / n_returns,
        "cpu_ns_per_return": 1e9 * cost.cpu_seconds / n_returns,
    }


_SIZE_COLUMNS = (
    Column.whole("n_returns", "returns"),
    Column("seconds", "log to rows", "s", ".3f"),
    Column("ns_per_return", "ns a return", "", ".0f"),
    Column("cpu_ns_per_return", "CPU [ns]", "", ".0f"),
    Column("ratio", "x read+CRC", "", ".1f"),
)


def _per_station(step: str) -> Column:
    """Return the column of the CPU time of a step for each station."""
    key = f"{step}_cpu_seconds"
    return Column(
        lambda row: f"{1e3 * row[key] / row['n_stations']:.2f}",
        f"{step} a station",
        "ms CPU",
        ">",
    )


_NETWORK_COLUMNS = (
    Column(lambda row: f"{row['n_stations']:,} x {row['n_marks']}", "stations x marks"),
    Column("assembly_seconds", "assembly", "s", ".2f"),
    Column("adjustment_seconds", "adjustment", "s", ".2f"),
    _per_station("assembly"),
    _per_station("adjustment"),
)


def growth_tables(report: Plain) -> list[Table]:
    """Return costs by returns and by stations, with the straight lines through them."""
    sizes, lines = report["linearity"], report["network_linearity"]
    return [
        Table(
            columns=_SIZE_COLUMNS,
            rows=sizes["sizes"],
            notes=[
                _line_note(what, f"{1e9 * fit['line_seconds_each']:.1f} ns a return", fit)
                for what, fit in (("Time", sizes), ("CPU", sizes["cpu"]))
            ],
        ),
        Table(
            columns=_NETWORK_COLUMNS,
            rows=report["network"],
            notes=[
                _line_note(
                    f"CPU of {step} with {lines['n_marks']} marks",
                    f"{1e3 * lines[step]['line_seconds_each']:.2f} ms a station",
                    lines[step],
                )
                for step in ("assembly", "adjustment")
            ],
        ),
    ]


def _line_note(what: str, each: str, fit: Plain) -> str:
    """Return a straight line through costs in words."""
    return (
        f"{what} in a straight line: {1e3 * fit['fixed_seconds']:.1f} ms and {each}; no size is "
        f"farther from it than {100 * fit['worst_share_off_line']:.0f} %."
    )


def line(sizes: Sequence[Plain], size: str, cost: str) -> Plain:
    """Fit a straight line to costs against sizes, with equal relative weights."""
    n, seconds = (np.array([one[key] for one in sizes]) for key in (size, cost))
    rows = np.column_stack([np.ones(len(n)), n]) / seconds[:, None]
    (fixed, each), *_ = np.linalg.lstsq(rows, np.ones(len(n)), rcond=None)
    return {
        "fixed_seconds": float(fixed),
        "line_seconds_each": float(each),
        "worst_share_off_line": float(np.abs(rows @ [fixed, each] - 1.0).max()),
    }


def _stretched(log: ScanLog, n: int) -> ScanLog:
    """Return a log of n returns: the beginning of one, or repeated turns."""
    repeats = -(-n // len(log.p_lidar))
    span = int(log.stamps_gimbal_ns[-1] - log.stamps_gimbal_ns[0])
    span += int(np.median(np.diff(log.stamps_gimbal_ns)))
    turn = 2.0 * np.pi * np.sign(log.gimbal_angles[-1] - log.gimbal_angles[0])

    def again(column: NDArray[Any], step: float) -> NDArray[Any]:
        return np.concatenate([column + column.dtype.type(k * step) for k in range(repeats)])

    return replace(
        log,
        p_lidar=np.tile(log.p_lidar, (repeats, 1))[:n],
        intensities=np.tile(log.intensities, repeats)[:n],
        rings=np.tile(log.rings, repeats)[:n],
        stamps_lidar_ns=again(log.stamps_lidar_ns, span)[:n],
        gimbal_angles=again(log.gimbal_angles, turn),
        stamps_gimbal_ns=again(log.stamps_gimbal_ns, span),
        quaternions_imu=np.tile(log.quaternions_imu, (repeats, 1)),
        stamps_imu_ns=again(log.stamps_imu_ns, span),
    )


def adjust(n_stations: int, n_marks: int) -> Plain:
    """Return the cost of assembling and adjusting a network of so many stations and marks."""
    rng = np.random.default_rng(0)
    marks, scans = _network(rng, n_stations, n_marks)
    known = np.arange(0, n_marks, _CONTROL)
    control = ControlMarks(
        names=tuple(marks.names[i] for i in known),
        p_site=marks.p_site[known],
        cov_p_site=marks.cov_p_site[known],
    )
    config = ResectionConfig()
    start, cpu_start = perf_counter(), process_time()
    network = assemble(scans, control, config)
    between, cpu_between = perf_counter(), process_time()
    found = adjust_network(network, config)
    end, cpu_end = perf_counter(), process_time()
    return {
        "n_stations": len(network.stations),
        "n_marks": len(network.marks),
        "n_sightings": len(network.sightings),
        "sigma0": found.sigma0,
        "assembly_seconds": between - start,
        "adjustment_seconds": end - between,
        "assembly_cpu_seconds": cpu_between - cpu_start,
        "adjustment_cpu_seconds": cpu_end - cpu_between,
    }


def _network(
    rng: np.random.Generator, n_stations: int, n_marks: int
) -> tuple[ControlMarks, list[tuple[str, MarkerFits]]]:
    """Return marks over a field, and the centres of the nearest ones at stations among them."""
    side = float(np.sqrt(_AREA * n_marks))
    p_site = np.column_stack([rng.uniform(0, side, (n_marks, 2)), rng.uniform(0.6, 1.5, n_marks)])
    marks = ControlMarks(
        names=tuple(f"C{i}" for i in range(n_marks)),
        p_site=p_site + rng.normal(0, _SIGMA_CONTROL, (n_marks, 3)),
        cov_p_site=np.tile(_SIGMA_CONTROL**2 * np.eye(3), (n_marks, 1, 1)),
    )
    scans = []
    for i in range(n_stations):
        here = [*rng.uniform(0, side, 2), 0.8]
        T_base_site = inverse(rigid(rot_z(rng.uniform(-np.pi, np.pi)), here))
        near = np.argsort(np.linalg.norm(p_site - here, axis=1))[:_SEEN]
        scans.append((f"stop{i}", _fits(rng, transform(T_base_site, p_site[near]))))
    return marks, scans


def _fits(rng: np.random.Generator, p_base: Array) -> MarkerFits:
    """Return centres whose errors agree with their covariances."""
    noisy = p_base + rng.normal(0, _SIGMA, p_base.shape)
    level = Levelling(roll=0.0, pitch=0.0, sigma=_SIGMA_LEVEL, is_measured=True)
    return MarkerFits(
        method="along_beam", fits=tuple(map(_fit, noisy)), rejected=(), levelling=level
    )


def _fit(p_base: Array) -> MarkerFit:
    """Return a fit to a hundred returns."""
    return MarkerFit(
        name="",
        p_base=p_base,
        cov_p_base=_SIGMA**2 * np.eye(3),
        method="along_beam",
        status=Status.OK,
        reason="",
        radius=0.1,
        radius_free=0.1,
        sigma_radius_free=2e-3,
        mean_range=float(np.linalg.norm(p_base)),
        mean_intensity=60.0,
        used=np.arange(100),
        rejected=np.zeros(0, np.intp),
        residuals=np.zeros(100),
        sigma0=1.0,
        n_rings=8,
        coverage=0.9,
    )
