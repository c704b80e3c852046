"""How long each step takes, as a multiple of one read of the file with a checksum in the same run.

The yardstick (``yardstick``) makes machines comparable. One scan is measured in three formats: as
points, as raw packets, and as points in zstd, all against one read of the plain points. Beside each
step stands what the usual libraries need for it (``peers``), beside the centres the accuracy of
theirs. Memory is that of a fresh process that runs one scan; ``growth`` has larger logs and
networks.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from spheremark.pipelines.evaluation.experiment import Column, Plain, Progress, Table
from spheremark.pipelines.geometry import inverse, transform
from spheremark.pipelines.model import Array, StopResult
from spheremark.pipelines.simulation import SimulationConfig, scenario, simulate_stop
from spheremark.service.bench.chain import CHAIN, CONFIG, METHOD, Measured, Scan, measure, memory
from spheremark.service.bench.growth import grown, growth_tables
from spheremark.service.bench.yardstick import WHAT, Cost
from spheremark.service.jobs.memory import keep_memory
from spheremark.storage.recordings import require_file, write_log

_STOP = "lane3-stop4"  # the centre of the field
_TURN = 20.7  # [s]: three million returns
_NEAR = 0.1  # [m] from a true centre: farther is a false marker
_OURS = {"fitting": f"fitting.{METHOD}"}  # where a peer's step is called otherwise here
_POINTS, _PACKETS, _ZSTD = "points", "packets", "points in zstd"
_BARS = {_POINTS: 10.0, _PACKETS: 10.0, _ZSTD: 20.0}  # x read+CRC that the chain may cost
_BAR_PEERS = 20.0  # times quicker than the usual libraries
_BAR_MEMORY = 500e6  # [bytes] of one scan


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedOptions:
    """What is measured: the best of how many runs, without slow peers, and how cost grows.

    The turn of the gimbal at the simulated stop [s] sets the number of returns.
    """

    repeats: int = 15
    is_quick: bool = False
    is_long: bool = False
    turn: float = _TURN


def speed(log: Path | None, options: SpeedOptions, progress: Progress) -> Plain:
    """Measure the chain on a log, or on a simulated stop in three formats, as a worker runs it."""
    keep_memory()
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        progress(0.0, "Reading" if log else "Simulating a stop of three million returns")
        scans = _given(log) if log else _simulated(folder, options.turn)
        plain = next(iter(scans.values()))
        read, measured = measure(scans, folder, options.repeats, progress)
        first = next(iter(measured.values()))
        report = _report(plain.log, first, read, options)
        report["variants"] = [
            _variant(name, scan.log, measured[name], read) for name, scan in scans.items()
        ]
        report["memory"] = memory(plain.log, folder) | {"bar_bytes": _BAR_MEMORY}
        if not options.is_quick:
            progress(0.6, "The usual libraries")
            report |= _compared(scans, first.result, report)
        if options.is_long:
            report |= grown(plain, folder, progress)
        return report


def _given(log: Path) -> dict[str, Scan]:
    """Return a recorded log, under a path that holds in other processes too."""
    require_file(log)
    return {log.name: Scan(log=log.resolve())}


def _simulated(folder: Path, turn: float) -> dict[str, Scan]:
    """Write one stop in three formats."""
    field = scenario("paper-field", 0)
    stop = simulate_stop(field, _STOP, SimulationConfig(turn=turn))
    scan = Scan(
        log=folder / f"{_STOP}.mcap",
        marks=field.marks,
        true_base=transform(inverse(stop.truth.T_site_base), field.marks.p_site),
    )
    packets, zstd = folder / f"{_STOP} packets.mcap", folder / f"{_STOP} zstd.mcap"
    write_log(stop.log, scan.log)
    write_log(stop.log, packets, firings=stop.firings)
    write_log(stop.log, zstd, compression="zstd")
    return {
        _POINTS: scan,
        _PACKETS: replace(scan, log=packets),
        _ZSTD: replace(scan, log=zstd),
    }


def _report(log: Path, measured: Measured, read: Cost, options: SpeedOptions) -> Plain:
    """Return the least time of each step, and its ratio to the yardstick."""
    return {
        "log": {
            "name": log.name,
            "size_bytes": log.stat().st_size,
            "n_returns": measured.n_returns,
        },
        "repeats": options.repeats,
        "yardstick": WHAT,
        "yardstick_seconds": read.seconds,
        "yardstick_cpu_seconds": read.cpu_seconds,
        "steps": [
            {"step": step, "seconds": cost.seconds, "ratio": cost.seconds / read.seconds}
            for step, cost in measured.costs.items()
        ],
    }


def _variant(name: str, log: Path, measured: Measured, read: Cost) -> Plain:
    """Return the cost of the chain on a scan in one format, against a read of the plain points."""
    chain, reading = measured.costs[CHAIN], measured.costs["read log"]
    return {
        "name": name,
        "size_bytes": log.stat().st_size,
        "read_log_seconds": reading.seconds,
        "read_log_ratio": reading.seconds / read.seconds,
        "read_log_cpu_ratio": reading.cpu_seconds / read.cpu_seconds,
        "chain_seconds": chain.seconds,
        "ratio": chain.seconds / read.seconds,
        "chain_cpu_seconds": chain.cpu_seconds,
        "cpu_ratio": chain.cpu_seconds / read.cpu_seconds,
        "bar_ratio": _BARS.get(name),
    }


def _compared(scans: Mapping[str, Scan], result: StopResult, report: Plain) -> Plain:
    """Return the times of the usual libraries for each step, and the accuracy of their centres."""
    from spheremark.service.bench.peers import pcl_seconds, run_peers

    radius, plain = CONFIG.marker_radius, next(iter(scans.values()))
    peers = {name: run_peers(scan.log, result.cloud.rig, radius) for name, scan in scans.items()}
    variants = []
    for one in report["variants"]:
        seconds = sum(peers[one["name"]].seconds.values())
        factor = seconds / one["chain_seconds"]
        variants.append({**one, "peer_seconds": seconds, "factor": factor})
    peer = next(iter(peers.values()))
    centres = {
        f"spheremark, {METHOD}": np.array([fit.p_base for fit in result.fits[METHOD].fits]),
        "Open3D: plane, DBSCAN, ICP": peer.centres,
        **_centres_of_peers(result, radius),
    }
    return {
        "variants": variants,
        "bar_factor": _BAR_PEERS,
        "peers": _steps_of_peers(report["steps"], peer.seconds),
        "pcl": pcl_seconds(result.cloud.p_base),
        "accuracy": _accuracy(centres, plain.true_base),
    }


def _steps_of_peers(steps: Sequence[Plain], seconds: Mapping[str, float]) -> list[Plain]:
    """Return the times of our steps beside those of the usual libraries."""
    ours = {step["step"]: step["seconds"] for step in steps}
    ours["rows and commit"] = ours["rows"] + ours["commit"]
    return [
        {
            "step": step,
            "ours_seconds": (mine := ours[_OURS.get(step, step)]),
            "peer_seconds": theirs,
            "factor": theirs / mine,
        }
        for step, theirs in (*seconds.items(), (CHAIN, sum(seconds.values())))
    ]


def _centres_of_peers(result: StopResult, radius: float) -> dict[str, Array]:
    """Return the centres of other libraries from the very returns that our centres rest on."""
    from spheremark.service.bench.peers import ransac_centre, registered_centre

    groups = [result.cloud.p_base[fit.used].astype(float) for fit in result.fits[METHOD].fits]
    ransac = [centre for points in groups if (centre := ransac_centre(points)) is not None]
    found = {"Open3D ICP on our returns": [registered_centre(p, radius) for p in groups]}
    if ransac:
        found["pyransac3d on our returns"] = ransac
    return {name: np.array(centres).reshape(-1, 3) for name, centres in found.items()}


def _accuracy(found: Mapping[str, Array], true_base: Array | None) -> list[Plain]:
    """Return the numbers of true and false markers of each method, and their RMS error."""
    if true_base is None:
        return []
    rows = []
    for name, centres in found.items():
        gaps = np.linalg.norm(centres[:, None] - true_base[None], axis=2).min(
            axis=1, initial=np.inf
        )
        errors = gaps[gaps < _NEAR]
        rms = float(np.sqrt(np.mean(errors**2))) if len(errors) else None
        rows.append(
            {
                "method": name,
                "n_markers": len(true_base),
                "n_found": len(errors),
                "n_false": len(gaps) - len(errors),
                "error_rms_m": rms,
            }
        )
    return rows


_STEPS = (
    Column("step", "step"),
    Column("seconds", "time", "ms", ",.1f"),
    Column("ratio", "x read+CRC", "", ",.2f"),
)
_VARIANTS = (
    Column("name", "log"),
    Column("size_bytes", "size", "MB", ".1f"),
    Column("read_log_seconds", "reading", "ms", ",.1f"),
    Column("read_log_ratio", "x", "", ".2f"),
    Column("chain_seconds", "log to rows", "ms", ",.1f"),
    Column("ratio", "x", "", ".1f"),
    Column("cpu_ratio", "x CPU", "", ".1f"),
    Column("bar_ratio", "bar", "", ".0f"),
    Column("peer_seconds", "usual libraries", "ms", ",.0f"),
    Column("factor", "x ours", "", ".1f"),
)
_PEERS = (
    Column("step", "step"),
    Column("ours_seconds", "ours", "ms", ",.1f"),
    Column("peer_seconds", "usual libraries", "ms", ",.1f"),
    Column("factor", "x ours", "", ",.1f"),
)
_CENTRES = (
    Column("method", "centres"),
    Column(lambda row: f"{row['n_found']} of {row['n_markers']}", "found", "", ">"),
    Column("n_false", "false", "", "d"),
    Column.mm("error_rms_m", "RMS error"),
)


def speed_tables(report: Plain) -> list[Table]:
    """Return times as ratios to one read of the file, those of the usual libraries, and memory."""
    log, used = report["log"], report["memory"]
    tables = [
        Table(
            title=f"{log['name']}: {log['size_bytes'] / 1e6:.1f} MB, {log['n_returns']:,} returns; "
            f"best of {report['repeats']}. 1 x is {report['yardstick']}: "
            f"{1e3 * report['yardstick_seconds']:.1f} ms.",
            columns=_STEPS,
            rows=report["steps"],
        ),
        Table(columns=_VARIANTS, rows=report["variants"]),
    ]
    if "peers" in report:
        bar = f"Bar: the chain at least {report['bar_factor']:.0f} times quicker than theirs."
        pcl = ", ".join(
            f"{step} {1e3 * report['pcl'][f'{step}_seconds']:,.0f} ms"
            for step in ("plane", "clusters")
            if f"{step}_seconds" in (report["pcl"] or {})
        )
        notes = [bar, f"PCL, files not counted: {pcl}."] if pcl else [bar]
        tables.append(Table(columns=_PEERS, rows=report["peers"], notes=notes))
        tables.append(Table(columns=_CENTRES, rows=report["accuracy"]))
    if "linearity" in report:
        tables += growth_tables(report)
    text = (
        f"Memory of a fresh process: {used['before_bytes'] / 1e6:,.0f} MB resident after its "
        f"imports, at most {used['peak_bytes'] / 1e6:,.0f} MB during one scan "
        f"(bar: {used['bar_bytes'] / 1e6:,.0f} MB)."
    )
    return [*tables, Table(notes=(text,))]
