"""How long each step takes, as a multiple of one read of the file with a checksum in the same run.

The yardstick makes machines comparable: it is what any program must pay that looks at each byte.
Beside each step stands what the usual libraries need for it (``service.peers``), beside the
centres what theirs are worth. Memory is that of a fresh process that runs one scan.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from isal.isal_zlib import crc32
from numpy.typing import NDArray

from pipelines.config import FittingConfig, SurveyConfig
from pipelines.geometry import inverse, transform
from pipelines.simulation import SimulatedStop, SimulationConfig, scenario, simulate_stop
from pipelines.survey import Progress, process
from pipelines.values import Array, ControlMarks, ScanLog, StopResult
from service.provenance import forget_peak_memory, peak_memory
from storage.catalogue import Catalogue
from storage.recordings import inspect_log, read_log, write_log
from storage.results import RunInfo, tables

_BLOCK = 4 << 20  # [bytes] read at once
_STOP = "lane3-stop4"  # the centre of the field
_TURN = 21.0  # [s]: three million returns
_NEAR = 0.1  # [m] from a true centre: farther is a false marker
_METHOD = "along_beam"
_CONFIG = SurveyConfig(fitting=FittingConfig(methods=(_METHOD,)))
_CHAIN = "log to rows committed"
_OURS = {"fitting": f"fitting.{_METHOD}"}  # where a peer's step is called otherwise here
_SIZES = (1, 3, 10, 30)  # [millions of returns] of the long runs
Timings = dict[str, float]
Plain = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Wish:
    """What to measure: the best of how many runs, without slow peers, with long logs."""

    repeats: int = 5
    is_quick: bool = False
    is_long: bool = False


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class _Scan:
    """A log on disk with what is known of it; marks and true centres when it was simulated."""

    log: Path
    marks: ControlMarks | None = None
    true_base: Array | None = None


def run(log: Path | None, wish: Wish, progress: Progress) -> Plain:
    """Measure the chain on a log, or on a simulated stop; the best of each step counts."""
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        variants: dict[str, Path] = {}
        if log:
            scan = _Scan(log=log)
        else:
            progress(0.0, "Simulating a stop of three million returns")
            field = scenario("paper-field", 0)
            stop = simulate_stop(field, _STOP, SimulationConfig(turn=_TURN))
            scan, variants = _written(stop, field.marks, folder)
        times, result, n_returns = _measured(scan, folder, wish, progress)
        report = _report(scan.log, n_returns, times, wish)
        report["memory"] = _memory(scan, folder)
        report["variants"] = [
            _variant(name, replace(scan, log=path), folder, wish, progress)
            for name, path in variants.items()
        ]
        if not wish.is_quick:
            progress(0.7, "The usual libraries")
            report |= _compared(scan, result, report)
        if wish.is_long:
            report["linearity"] = [_long(scan, n, folder, progress) for n in _SIZES]
        return report


def _written(
    stop: SimulatedStop, marks: ControlMarks, folder: Path
) -> tuple[_Scan, dict[str, Path]]:
    """Write a stop as points, and its variants; return the scan and the variants' paths."""
    variants = {name: folder / f"{name}.mcap" for name in ("points zstd", "packets")}
    write_log(stop.log, folder / f"{_STOP}.mcap")
    write_log(stop.log, variants["points zstd"], compression="zstd")
    write_log(stop.log, variants["packets"], firings=stop.firings)
    return _Scan(
        log=folder / f"{_STOP}.mcap",
        marks=marks,
        true_base=transform(inverse(stop.truth.T_site_base), marks.p_site),
    ), variants


def _measured(
    scan: _Scan, folder: Path, wish: Wish, progress: Progress
) -> tuple[Timings, StopResult, int]:
    """Run the chain a few times; return the best times, the first stop and the number of returns.

    The first run compiles kernels and fills the cache of the file; it does not count.
    """
    _chain(scan, folder / f"{scan.log.stem} warm")
    found = []
    for i in range(wish.repeats):
        progress(i / wish.repeats, f"{scan.log.stem}: run {i + 1} of {wish.repeats}")
        found.append(_chain(scan, folder / f"{scan.log.stem} {i}"))
    best = {step: min(times[step] for times, _, _ in found) for step in found[0][0]}
    return best, found[0][1], found[0][2]


def _chain(scan: _Scan, folder: Path) -> tuple[Timings, StopResult, int]:
    """Run everything once; return the time of each step [s], the first stop and its returns."""
    times: Timings = {}
    with _timed(times, "read+CRC"):
        _checksum(scan.log)
    with _timed(times, "preflight"):
        inspect_log(scan.log)
    stops, n_returns = _committed(scan, folder, times)
    return _in_order(times, stops), stops[0], n_returns


def _committed(scan: _Scan, folder: Path, times: Timings) -> tuple[tuple[StopResult, ...], int]:
    """Bring a log into a database of its own; return its stops and the number of returns."""
    with Catalogue(folder / "bench.duckdb", snapshots=folder / "snapshots") as catalogue:
        job = _job(catalogue, scan.log)
        with _timed(times, _CHAIN):
            with _timed(times, "read log"):
                log = read_log(scan.log, digest="0" * 64)  # the service has it from the upload
            stops = process(log, config=_CONFIG, marks=scan.marks)
            with _timed(times, "rows"):
                rows = tables(_run(catalogue, job), stops, marks=scan.marks)
            with _timed(times, "commit"):
                catalogue.finish_job(job, rows)
    return stops, len(log.p_lidar)


def _checksum(log: Path) -> int:
    """Read a file once, with a CRC-32."""
    crc = 0
    with log.open("rb") as file:
        while block := file.read(_BLOCK):
            crc = crc32(block, crc)
    return crc


def _job(catalogue: Catalogue, log: Path) -> str:
    """Enter what the rows of a run refer to; return the id of a job that runs."""
    catalogue.create_survey("bench")
    recording = catalogue.add_recording(
        "0" * 64, name=log.stem, size_bytes=0, url=str(log), preflight={"verdict": "ok"}
    )
    job = catalogue.create_job(
        "process", survey="bench", recording_id=recording.recording_id, config={}
    )
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


def _in_order(times: Timings, stops: Sequence[StopResult]) -> Timings:
    """Put the times of the chain's own steps, summed over stops, between reading and rows."""
    steps: Timings = {}
    for stop in stops:
        for step, seconds in stop.timings.items():
            steps[step] = steps.get(step, 0.0) + seconds
    first = {name: times[name] for name in ("read+CRC", "preflight", "read log")}
    last = {name: times[name] for name in ("rows", "commit", _CHAIN)}
    return first | steps | last


def _report(log: Path, n_returns: int, best: Timings, wish: Wish) -> Plain:
    """Return the best time of each step, and its ratio to the yardstick."""
    return {
        "log": {"name": log.name, "size_bytes": log.stat().st_size, "n_returns": n_returns},
        "repeats": wish.repeats,
        "yardstick": "one read of the file in blocks of 4 MiB with isal's CRC-32, cache warm",
        "steps": [
            {"step": step, "seconds": seconds, "ratio": seconds / best["read+CRC"]}
            for step, seconds in best.items()
        ],
    }


def _variant(name: str, scan: _Scan, folder: Path, wish: Wish, progress: Progress) -> Plain:
    """Return what the chain costs on the same scan in another dress."""
    best, _, _ = _measured(scan, folder, wish, progress)
    return {
        "name": name,
        "size_bytes": scan.log.stat().st_size,
        "read_log_seconds": best["read log"],
        "chain_seconds": best[_CHAIN],
        "ratio": best[_CHAIN] / best["read+CRC"],
    }


def _compared(scan: _Scan, result: StopResult, report: Plain) -> Plain:
    """Return what the usual libraries need for each step, and what their centres are worth."""
    from service.peers import run_peers

    radius = _CONFIG.marker_radius
    peer = min(
        (run_peers(scan.log, result.cloud.rig, radius) for _ in range(2)),
        key=lambda one: sum(one.seconds.values()),
    )
    ours = {step["step"]: step["seconds"] for step in report["steps"]}
    ours["rows and commit"] = ours["rows"] + ours["commit"]
    steps = [
        {
            "step": step,
            "ours_seconds": (mine := ours[_OURS.get(step, step)]),
            "peer_seconds": seconds,
            "factor": seconds / mine,
        }
        for step, seconds in (*peer.seconds.items(), (_CHAIN, sum(peer.seconds.values())))
    ]
    fits = result.fits[_METHOD].fits
    found = {"spheremark, along_beam": np.array([fit.p_base for fit in fits])}
    found["Open3D: plane, DBSCAN, ICP"] = peer.centres
    found |= _centres_of_peers(result, radius)
    return {"peers": steps, "accuracy": _accuracy(found, scan.true_base)}


def _centres_of_peers(result: StopResult, radius: float) -> dict[str, Array]:
    """Return what other libraries make of the very returns that our centres rest on."""
    from service.peers import ransac_centre, registered_centre

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


def _memory(scan: _Scan, folder: Path) -> Plain:
    """Run one scan in a fresh process; return its resident memory before and at the most."""
    command = [sys.executable, "-m", "service.bench", str(scan.log), str(folder / "fresh")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found: Plain = json.loads(done.stdout)
    return found


def _fresh(log: Path, folder: Path) -> Plain:
    """Run one scan in this process, which has done nothing but import before."""
    before = _resident()
    forget_peak_memory()
    _committed(_Scan(log=log), folder, {})
    peak = peak_memory()
    return {"before_bytes": before, "peak_bytes": peak, "scan_bytes": peak - before}


def _resident() -> int:
    """Return the resident size of this process [bytes]."""
    forget_peak_memory()
    return peak_memory()


def _long(scan: _Scan, millions: int, folder: Path, progress: Progress) -> Plain:
    """Return what the chain costs on a log of so many million returns."""
    progress(0.9, f"A log of {millions} million returns")
    path = folder / f"{millions}M.mcap"
    write_log(_stretched(read_log(scan.log, digest="0" * 64), millions * 1_000_000), path)
    times, _, n_returns = _measured(
        replace(scan, log=path), folder, Wish(repeats=2), lambda _share, _what: None
    )
    path.unlink()
    return {
        "n_returns": n_returns,
        "seconds": times[_CHAIN],
        "ratio": times[_CHAIN] / times["read+CRC"],
        "ns_per_return": 1e9 * times[_CHAIN] / n_returns,
    }


def _stretched(log: ScanLog, n: int) -> ScanLog:
    """Return a log of n returns: the beginning of one, or one turned again and again."""
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


@contextmanager
def _timed(times: Timings, step: str) -> Iterator[None]:
    """Record how long a step takes [s]."""
    start = perf_counter()
    yield
    times[step] = perf_counter() - start


if __name__ == "__main__":
    sys.stdout.write(json.dumps(_fresh(Path(sys.argv[1]), Path(sys.argv[2]))))
