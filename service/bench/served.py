"""A service under load: clients beside uploads and a queue of jobs, and one large upload.

The service runs in a process of its own, as ``spheremark serve`` does, on a folder that is removed
at the end. Clients pause between requests as readers of a page do; a response of 429 with a
Retry-After is no error, and is counted apart.
"""

from __future__ import annotations

import asyncio
import hashlib
import http.client
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter, sleep
from urllib.parse import urlsplit

import httpx
import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.errors import SpheremarkError
from spheremark.pipelines.evaluation.experiment import Column, Plain, Progress, Table
from spheremark.pipelines.simulation import SimulationConfig, scenario, simulate_stop
from spheremark.storage.recordings import write_log

_SURVEY = "load"
_PAGES = ("/", "/surveys/load", "/accuracy", "/jobs", "/sql")
_API = ("surveys", "recordings?limit=20", "jobs?limit=20", "station-fixes?limit=100",
        "figures/distance.json", "tables/stops.json", "accuracy/limits")  # fmt: skip
_SQL = "SELECT stop, count(*) AS n, max(sigma_3d_m) FROM station_fixes GROUP BY stop"
_N_CLIENTS, _N_UPLOADS = 50, 4
_PAUSE = (0.5, 1.5)  # [s] between two requests of a client
_PAUSE_UPLOAD = 5.0  # [s] between two uploads of one sender
_WARM = 0.25  # share of the time after which memory is first read
_TIMEOUT = 60.0  # [s] of a request
_BAR_P99, _BAR_UPLOAD = 1.0, 64_000_000  # [s] of pages on quiet cores, [bytes] above idle
_SETTLED = 5.0  # [s] until workers have started, and take no processor from the upload
_BLOCK = 1 << 20  # [bytes] of the large upload that are sent at once
_MIB = 1 << 20
_STEAL = 7  # place of the stolen time among the times of a processor
_LOGS = "/api/v1/recordings?name=large"
_MCAP = {"Content-Type": "application/vnd.mcap"}


@dataclass(slots=True, eq=False)
class _Found:
    """Durations by kind of request [s], refusals with a Retry-After, and errors."""

    seconds: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    busy: Counter[str] = field(default_factory=Counter)
    errors: Counter[str] = field(default_factory=Counter)


def load(minutes: float, progress: Progress) -> Plain:
    """Return times, errors and memory of a service with 50 clients, 4 uploads and a queue."""
    with tempfile.TemporaryDirectory() as text, _served(Path(text) / "data") as (address, pid):
        progress(0.0, "Simulating a log")
        field_ = scenario("paper-field", 0)
        stop = simulate_stop(field_, "lane3-stop4", SimulationConfig(only_near_spheres=True))
        log = Path(text) / "stop.mcap"
        write_log(stop.log, log)
        return asyncio.run(_loaded(address, pid, log.read_bytes(), 60.0 * minutes, progress))


async def _loaded(address: str, pid: int, log: bytes, seconds: float, progress: Progress) -> Plain:
    """Send requests for so long; return what was found."""
    found, end = _Found(), perf_counter() + seconds
    before = _processor_times()
    limits = httpx.Limits(max_connections=None)
    async with httpx.AsyncClient(base_url=address, timeout=_TIMEOUT, limits=limits) as client:
        (await client.post("/api/v1/surveys", json={"name": _SURVEY})).raise_for_status()
        senders = [_upload(client, log, number, found, end) for number in range(_N_UPLOADS)]
        users = [_use(client, random.Random(seed), found, end) for seed in range(_N_CLIENTS)]
        tasks = [asyncio.create_task(one) for one in (*senders, *users)]
        memory = []
        while (left := end - perf_counter()) > 0:
            if left < (1.0 - _WARM) * seconds:
                memory.append(_memory(pid, "VmRSS"))
            progress(1.0 - left / seconds, "Clients, uploads and jobs")
            await asyncio.sleep(min(left, 2.0))
        await asyncio.gather(*tasks)
        memory.append(_memory(pid, "VmRSS"))
        jobs = (await client.get("/api/v1/jobs", params={"limit": 1000})).json()["items"]
    jobs_by_status = Counter(job["status"] for job in jobs)
    return _report(found, memory, jobs_by_status, seconds) | {"stolen": _stolen(before)}


def _stolen(before: NDArray[np.int64]) -> float:
    """Return the share of this machine's time that other virtual machines have had."""
    used = _processor_times() - before
    return float(used[_STEAL] / used.sum())


def _processor_times() -> NDArray[np.int64]:
    """Return the times of all processors by use, as Linux counts them."""
    line = Path("/proc/stat").read_text(encoding="ascii").splitlines()[0]
    return np.array(line.split()[1 : _STEAL + 2], np.int64)


async def _use(client: httpx.AsyncClient, chance: random.Random, found: _Found, end: float) -> None:
    """Open pages, lists and figures, and send queries, one after the other."""
    html = {"accept": "text/html"}
    while perf_counter() < end:
        kind = chance.choice(("pages", "pages", "API", "SQL"))
        if kind == "pages":
            request = client.build_request("GET", chance.choice(_PAGES), headers=html)
        elif kind == "API":
            request = client.build_request("GET", f"/api/v1/{chance.choice(_API)}")
        else:
            request = client.build_request("POST", "/api/v1/sql", json={"sql": _SQL})
        await _timed(client, kind, request, found)
        await asyncio.sleep(chance.uniform(*_PAUSE))


async def _upload(
    client: httpx.AsyncClient, log: bytes, sender: int, found: _Found, end: float
) -> None:
    """Send logs that differ in their last bytes, each with a job."""
    number = 0
    while perf_counter() < end:
        number += 1
        request = client.build_request(
            "POST",
            "/api/v1/recordings",
            params={"name": f"s{sender}-{number}", "survey": _SURVEY, "process": "true"},
            content=log + f"{sender:03d}{number:06d}".encode(),
            headers=_MCAP,
        )
        await _timed(client, "uploads", request, found)
        await asyncio.sleep(_PAUSE_UPLOAD)


async def _timed(
    client: httpx.AsyncClient, kind: str, request: httpx.Request, found: _Found
) -> None:
    """Send a request; keep how long it took, or why it failed."""
    begin, path = perf_counter(), request.url.path
    try:
        response = await client.send(request, follow_redirects=True)
    except httpx.HTTPError as error:
        found.errors[f"{path}: {type(error).__name__}"] += 1
        return
    if response.status_code == httpx.codes.TOO_MANY_REQUESTS and "retry-after" in response.headers:
        found.busy[kind] += 1
    elif response.is_success:
        found.seconds[kind].append(perf_counter() - begin)
    else:
        found.errors[f"{path}: {response.status_code}"] += 1


def _report(found: _Found, memory: list[int], jobs: Counter[str], seconds: float) -> Plain:
    """Return the report of a load."""
    kinds = [
        {
            "kind": kind,
            "n": len(times),
            "busy": found.busy[kind],
            "p50_s": float(np.quantile(times, 0.5)),
            "p99_s": float(np.quantile(times, 0.99)),
        }
        for kind, times in sorted(found.seconds.items())
    ]
    return {
        "seconds": seconds,
        "clients": _N_CLIENTS,
        "uploads": _N_UPLOADS,
        "kinds": kinds,
        "errors": dict(found.errors),
        "jobs": dict(jobs),
        "memory_bytes": {"begin": memory[0], "end": memory[-1], "most": max(memory)},
        "bar_p99_s": _BAR_P99,
        "load_average": os.getloadavg()[0],
    }


def load_tables(report: Plain) -> list[Table]:
    """Return the report of a load as a table."""
    memory, errors = report["memory_bytes"], report["errors"]
    begin, end, most = (f"{memory[key] / _MIB:.0f}" for key in ("begin", "end", "most"))
    return [
        Table(
            columns=(
                Column("kind", "requests"),
                Column.whole("n", "successful"),
                Column.whole("busy", "refused as busy"),
                Column("p50_s", "median", "s", ".3f"),
                Column("p99_s", "99th percentile", "s", ".3f"),
            ),
            rows=report["kinds"],
            notes=[
                f"{report['clients']} clients and {report['uploads']} uploads for "
                f"{report['seconds']:.0f} s; load average {report['load_average']:.1f} at the end, "
                f"{100.0 * report['stolen']:.0f} % of the time taken by other machines.",
                f"Errors: {', '.join(f'{k} ({n})' for k, n in errors.items()) or 'none'}.",
                f"Jobs: {', '.join(f'{n} {k}' for k, n in report['jobs'].items())}.",
                f"Memory of the service: {begin} MiB at a quarter of the time, {end} at the end, "
                f"{most} at most.",
            ],
        )
    ]


def upload(n_bytes: int, progress: Progress) -> Plain:
    """Return the memory and time of a service that receives a file of random bytes."""
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        progress(0.0, "Writing a file")
        source = folder / "source"
        with source.open("wb") as file:
            for _ in range(-(-n_bytes // _BLOCK)):
                file.write(os.urandom(_BLOCK))
        begin = perf_counter()
        shutil.copyfile(source, folder / "copy")
        with (folder / "copy").open("rb+") as file:
            os.fsync(file.fileno())  # as the service does before it accepts a log
        with source.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        plain = perf_counter() - begin
        (folder / "copy").unlink()
        with _served(folder / "data") as (address, pid):
            progress(0.3, "Sending it")
            with httpx.Client(base_url=address, timeout=None) as client:
                client.post(_LOGS, content=b"first", headers=_MCAP)  # loads modules
                sleep(_SETTLED)
                idle = _memory(pid, "VmRSS")
                Path(f"/proc/{pid}/clear_refs").write_text("5", encoding="ascii")
                begin = perf_counter()
                response = _sent(address, source)
                seconds, most = perf_counter() - begin, _memory(pid, "VmHWM")
            size = source.stat().st_size
            if not (folder / "data" / "recordings" / f"{digest}.mcap").exists():
                raise SpheremarkError(f"The file was not kept: {response}")
    return {
        "n_bytes": size,
        "idle_bytes": idle,
        "above_idle_bytes": most - idle,
        "bar_bytes": _BAR_UPLOAD,
        "seconds": seconds,
        "copy_and_hash_seconds": plain,
    }


def upload_tables(report: Plain) -> list[Table]:
    """Return the report of a large upload as a table."""
    columns = (
        Column("n_bytes", "file", "MB", ",.0f"),
        Column("above_idle_bytes", "above idle", "MB", ".1f"),
        Column("bar_bytes", "bar", "MB", ".1f"),
        Column("seconds", "sent in", "s", ".2f"),
        Column("copy_and_hash_seconds", "copy, sync and SHA-256", "s", ".2f"),
    )
    return [Table(columns=columns, rows=[report])]


def _sent(address: str, path: Path) -> str:
    """Send a file at little cost to the sender, which shares the processors; return the answer."""
    connection = http.client.HTTPConnection(urlsplit(address).netloc, blocksize=_BLOCK)
    with closing(connection), path.open("rb") as file:
        length = {"Content-Length": str(path.stat().st_size)}
        connection.request("POST", _LOGS, body=file, headers=_MCAP | length)
        return connection.getresponse().read().decode()


@contextmanager
def _served(data: Path) -> Iterator[tuple[str, int]]:
    """Serve a new data folder; yield the address and the id of the process."""
    log = data.with_name("service.log")
    with log.open("w") as file:
        process = subprocess.Popen(
            [sys.executable, "-m", "spheremark.service.cli", "serve"],
            env={**os.environ, "SPHEREMARK_DATA": str(data), "SPHEREMARK_PORT": "0"},
            stdout=file,
            stderr=file,
        )
    try:
        while not (found := re.search(r"http://[\w.:\[\]]+\d", log.read_text())):
            if process.poll() is not None:
                raise SpheremarkError(f"The service did not start: {log.read_text()}")
            sleep(0.1)
        yield found[0], process.pid
    finally:
        process.terminate()
        process.wait()


def _memory(pid: int, name: str) -> int:
    """Return a size of a process by its name in the status of Linux [bytes]."""
    lines = Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines()
    line = next(line for line in lines if line.startswith(f"{name}:"))
    return int(line.split()[1]) * 1024
