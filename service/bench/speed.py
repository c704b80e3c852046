"""How long each step takes, as a multiple of one read of the file with a checksum in the same run.

The yardstick (``yardstick``) makes machines comparable. One scan is measured in three
dresses: as points, as raw packets, and as points in zstd, all against one read of the plain points.
Beside each step stands what the usual libraries need for it (``peers``), beside the
centres what theirs are worth. Memory is that of a fresh process that runs one scan; how cost grows
is told by ``growth``.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np

from spheremark.pipelines.config import FittingConfig, SurveyConfig
from spheremark.pipelines.geometry import inverse, transform
from spheremark.pipelines.model import Array, ControlMarks, ScanLog, StopResult
from spheremark.pipelines.simulation import SimulationConfig, scenario, simulate_stop
from spheremark.pipelines.survey import Progress, process
from spheremark.service.bench.yardstick import WHAT, Cost, least, read_cost
from spheremark.service.jobs.memory import keep_memory
from spheremark.service.provenance import forget_peak_memory, peak_memory
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.catalogue.results import RunInfo, tables
from spheremark.storage.recordings import inspect_log, read_log, require_file, write_log

_STOP = "lane3-stop4"  # the centre of the field
_TURN = 20.7  # [s]: three million returns
_NEAR = 0.1  # [m] from a true centre: farther is a false marker
_METHOD = "along_beam"
_DIGEST = "0" * 64  # that the upload would have told
_CONFIG = SurveyConfig(fitting=FittingConfig(methods=(_METHOD,)))
_CHAIN = "log to rows committed"
_OURS = {"fitting": f"fitting.{_METHOD}"}  # where a peer's step is called otherwise here
_POINTS, _PACKETS, _ZSTD = "points", "packets", "points in zstd"
_BARS = {_POINTS: 8.0, _PACKETS: 8.0, _ZSTD: 20.0}  # x read+CRC that the chain may cost
_BAR_PEERS = 15.0  # times quicker than the usual libraries
_BAR_MEMORY = 500e6  # [bytes] of one scan
Timings = dict[str, float]
Costs = dict[str, Cost]
Plain = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Wish:
    """What to measure: the best of how many runs, without slow peers, and how cost grows.

    The turn of the gimbal at the simulated stop [s] says how many returns there are.
    """

    repeats: int = 15
    is_quick: bool = False
    is_long: bool = False
    turn: float = _TURN


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Scan:
    """A log on disk with what is known of it; marks and true centres when it was simulated."""

    log: Path
    marks: ControlMarks | None = None
    true_base: Array | None = None


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Measured:
    """The least cost of each step, the result of a run, and the number of its returns."""

    costs: Costs
    result: StopResult
    n_returns: int


def run(log: Path | None, wish: Wish, progress: Progress) -> Plain:
    """Measure the chain on a log, or on a simulated stop in three dresses, as a worker does it."""
    keep_memory()
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        progress(0.0, "Reading" if log else "Simulating a stop of three million returns")
        scans = _given(log) if log else _simulated(folder, wish.turn)
        plain = next(iter(scans.values()))
        read, measured = measure(scans, folder, wish.repeats, progress)
        first = next(iter(measured.values()))
        report = _report(plain.log, first, read, wish)
        report["variants"] = [
            _variant(name, scan.log, measured[name], read) for name, scan in scans.items()
        ]
        report["memory"] = _memory(plain, folder)
        if not wish.is_quick:
            progress(0.6, "The usual libraries")
            report |= _compared(scans, first.result, report)
        if wish.is_long:
            from spheremark.service.bench.growth import grown

            report |= grown(plain, folder, progress)
        return report


def _given(log: Path) -> dict[str, Scan]:
    """Return a log of somebody's own, under a name that means the same to other processes."""
    require_file(log)
    return {log.name: Scan(log=log.resolve())}


def _simulated(folder: Path, turn: float) -> dict[str, Scan]:
    """Write one stop in three dresses."""
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


def measure(
    scans: Mapping[str, Scan], folder: Path, repeats: int, progress: Progress
) -> tuple[Cost, dict[str, Measured]]:
    """Run the chain on scans in turn, a few times; return the yardstick and the least costs.

    The first round compiles kernels and fills the cache of the files; it does not count. Yardstick
    and scans take turns, so that what else the machine does befalls all of them. The database is
    open all the time, as that of the service is.
    """
    plain = next(iter(scans.values()))
    reads: list[Cost] = []
    found: dict[str, Measured] = {}
    with _catalogue(folder) as catalogue:
        for i in range(repeats + 1):
            progress(0.6 * i / (repeats + 1), f"Run {i} of {repeats}" if i else "A first run")
            reads.append(read_cost(plain.log))
            for name, scan in scans.items():
                one = _chain(scan, catalogue)
                found[name] = _better(found[name], one) if i > 1 else one
    return least(reads), found


def _better(known: Measured, other: Measured) -> Measured:
    """Return the least cost of each step; the clouds of all runs would fill the memory."""
    costs = {step: least((cost, other.costs[step])) for step, cost in known.costs.items()}
    return replace(known, costs=costs)


def _chain(scan: Scan, catalogue: Catalogue) -> Measured:
    """Run everything once."""
    costs: Costs = {}
    with _timed(costs, "preflight"):
        preflight = inspect_log(scan.log)
    stops = _committed(scan, catalogue, costs)
    return Measured(costs=_in_order(costs, stops), result=stops[0], n_returns=preflight.n_returns)


def _committed(scan: Scan, catalogue: Catalogue, costs: Costs) -> tuple[StopResult, ...]:
    """Bring a log into a database; return its stops."""
    job = _job(catalogue)
    run = _run(catalogue, job)
    with _timed(costs, _CHAIN):
        stops = process(_read(scan.log, costs), config=_CONFIG, marks=scan.marks)
        with _timed(costs, "rows"):
            rows = tables(run, stops, marks=scan.marks)
        with _timed(costs, "commit"):
            catalogue.finish_job(job, rows)
    return stops


def _read(log: Path, costs: Costs) -> ScanLog:
    """Read a log as the service does: nobody keeps it, and the upload has told its digest."""
    with _timed(costs, "read log"):
        return read_log(log, digest=_DIGEST)


@contextmanager
def _catalogue(folder: Path) -> Iterator[Catalogue]:
    """Open a new database that knows what the rows of a run refer to."""
    place = Path(tempfile.mkdtemp(dir=folder))
    with Catalogue(place / "bench.duckdb", snapshots=place / "snapshots") as catalogue:
        catalogue.create_survey("bench")
        catalogue.add_recording(
            _DIGEST, name="bench", size_bytes=0, url="", preflight={"verdict": "ok"}
        )
        yield catalogue


def _job(catalogue: Catalogue) -> str:
    """Return the id of a new job that runs."""
    job = catalogue.create_job("process", survey="bench", recording_id=_DIGEST, config={})
    return catalogue.start_job(job.job_id).job_id


def _run(catalogue: Catalogue, job_id: str) -> RunInfo:
    """Return what names the rows of a run."""
    job = catalogue.get_job(job_id)
    return RunInfo(
        run_id=job_id,
        job_id=job_id,
        survey_id=job.survey_id,
        recording_id=job.recording_id or "",
        config=_CONFIG,
        code_version="bench",
        finished_at=datetime.now(UTC),
        duration=0.0,
    )


def _in_order(costs: Costs, stops: Sequence[StopResult]) -> Costs:
    """Put the times of the chain's own steps, summed over stops, between reading and rows.

    What these took of processors is not known.
    """
    steps: Timings = {}
    for stop in stops:
        for step, seconds in stop.timings.items():
            steps[step] = steps.get(step, 0.0) + seconds
    first = {name: costs[name] for name in ("preflight", "read log")}
    middle = {name: Cost(seconds, float("nan")) for name, seconds in steps.items()}
    last = {name: costs[name] for name in ("rows", "commit", _CHAIN)}
    return first | middle | last


def _report(log: Path, measured: Measured, read: Cost, wish: Wish) -> Plain:
    """Return the least time of each step, and its ratio to the yardstick."""
    return {
        "log": {
            "name": log.name,
            "size_bytes": log.stat().st_size,
            "n_returns": measured.n_returns,
        },
        "repeats": wish.repeats,
        "yardstick": WHAT,
        "yardstick_seconds": read.seconds,
        "yardstick_cpu_seconds": read.cpu_seconds,
        "steps": [
            {"step": step, "seconds": cost.seconds, "ratio": cost.seconds / read.seconds}
            for step, cost in measured.costs.items()
        ],
    }


def _variant(name: str, log: Path, measured: Measured, read: Cost) -> Plain:
    """Return what the chain costs on a scan in one dress, against a read of the plain points."""
    chain, ours = measured.costs[_CHAIN], measured.costs["read log"]
    return {
        "name": name,
        "size_bytes": log.stat().st_size,
        "read_log_seconds": ours.seconds,
        "read_log_ratio": ours.seconds / read.seconds,
        "read_log_cpu_ratio": ours.cpu_seconds / read.cpu_seconds,
        "chain_seconds": chain.seconds,
        "ratio": chain.seconds / read.seconds,
        "chain_cpu_seconds": chain.cpu_seconds,
        "cpu_ratio": chain.cpu_seconds / read.cpu_seconds,
        "bar_ratio": _BARS.get(name),
    }


def _compared(scans: Mapping[str, Scan], result: StopResult, report: Plain) -> Plain:
    """Return what the usual libraries need for each step, and what their centres are worth."""
    from spheremark.service.bench.peers import pcl_seconds, run_peers

    radius, plain = _CONFIG.marker_radius, next(iter(scans.values()))
    peers = {name: run_peers(scan.log, result.cloud.rig, radius) for name, scan in scans.items()}
    variants = []
    for one in report["variants"]:
        seconds = sum(peers[one["name"]].seconds.values())
        factor = seconds / one["chain_seconds"]
        variants.append({**one, "peer_seconds": seconds, "factor": factor})
    peer = next(iter(peers.values()))
    fits = result.fits[_METHOD].fits
    found = {"spheremark, along_beam": np.array([fit.p_base for fit in fits])}
    found["Open3D: plane, DBSCAN, ICP"] = peer.centres
    found |= _centres_of_peers(result, radius)
    return {
        "variants": variants,
        "bar_factor": _BAR_PEERS,
        "peers": _steps_of_peers(report["steps"], peer.seconds),
        "pcl": pcl_seconds(result.cloud.p_base),
        "accuracy": _accuracy(found, plain.true_base),
    }


def _steps_of_peers(steps: Sequence[Plain], seconds: Timings) -> list[Plain]:
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
        for step, theirs in (*seconds.items(), (_CHAIN, sum(seconds.values())))
    ]


def _centres_of_peers(result: StopResult, radius: float) -> dict[str, Array]:
    """Return what other libraries make of the very returns that our centres rest on."""
    from spheremark.service.bench.peers import ransac_centre, registered_centre

    groups = [result.cloud.p_base[fit.used].astype(float) for fit in result.fits[_METHOD].fits]
    ransac = [centre for points in groups if (centre := ransac_centre(points)) is not None]
    found = {"Open3D ICP on our returns": [registered_centre(p, radius) for p in groups]}
    if ransac:
        found["pyransac3d on our returns"] = ransac
    return {name: np.array(centres).reshape(-1, 3) for name, centres in found.items()}


def _accuracy(found: dict[str, Array], true_base: Array | None) -> list[Plain]:
    """Return for each way how many true and false markers it gave, and their RMS error."""
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


def _memory(scan: Scan, folder: Path) -> Plain:
    """Run one scan in a fresh process; return its resident memory before and at the most."""
    command = [sys.executable, "-m", "spheremark.service.bench.speed", str(scan.log), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found: Plain = json.loads(done.stdout)
    return found | {"bar_bytes": _BAR_MEMORY}


def _fresh(log: Path, folder: Path) -> Plain:
    """Run one scan in this process, which has done nothing but import before."""
    keep_memory()
    before = _resident()
    forget_peak_memory()
    with _catalogue(folder) as catalogue:
        _committed(Scan(log=log), catalogue, {})
    peak = peak_memory()
    return {"before_bytes": before, "peak_bytes": peak, "scan_bytes": peak - before}


def _resident() -> int:
    """Return the resident size of this process [bytes]."""
    forget_peak_memory()
    return peak_memory()


@contextmanager
def _timed(costs: Costs, step: str) -> Iterator[None]:
    """Record what a step costs."""
    start, cpu = perf_counter(), process_time()
    yield
    costs[step] = Cost(perf_counter() - start, process_time() - cpu)


if __name__ == "__main__":
    sys.stdout.write(json.dumps(_fresh(Path(sys.argv[1]), Path(sys.argv[2]))))
