"""Kills a service at random moments of its work, then compares its files with its rows.

``python -m tests.service.kills LOG CONTROL --rounds 50`` is the long form of the test.
"""

import argparse
import contextlib
import hashlib
import json
import math
import os
import random
import re
import subprocess
import sys
import tempfile
import threading
import time
from base64 import b64encode
from collections import Counter
from pathlib import Path

import httpx
import psutil

from tests.service.conftest import is_worker

MCAP = {"Content-Type": "application/vnd.mcap"}
TUS = {"Tus-Resumable": "1.0.0"}
PART = {**TUS, "Content-Type": "application/offset+octet-stream"}
PATIENCE = 300.0  # [s]
ATTEMPTS = 10  # at a job; one that meets so many kills is given up, as is promised
COMMAND = (sys.executable, "-m", "spheremark.service.cli")


def _drain(pipe):
    """Read what a service prints to its end."""
    with pipe:
        pipe.read()


class Victim:
    """A service in a process of its own, on one data folder, started again after each kill."""

    def __init__(self, folder, log, control):
        self.folder, self.log, self.control = folder, log, control
        self.acknowledged = set()  # digests of logs, whatever comes
        self.jobs = set()
        self.kept = {}  # by digest: address of an unfinished upload, acknowledged bytes
        self.shortened = []  # uploads of which acknowledged bytes were gone
        self.refused = []
        self.number = self.round = self.n_kills = 0

    def start(self):
        """Start it; return a client."""
        settings = {
            "SPHEREMARK_DATA": str(self.folder),
            "SPHEREMARK_PORT": "0",
            "SPHEREMARK_WORKERS": "1",
            "SPHEREMARK_JOB_ATTEMPTS": str(ATTEMPTS),
        }
        self.process = subprocess.Popen(
            [*COMMAND, "serve"],
            env={**os.environ, **settings},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        lines = []
        for line in self.process.stdout:
            lines.append(line)
            if "http://" in line:
                address = line[line.index("http://") :].split()[0].rstrip(".,;")
                threading.Thread(target=_drain, args=[self.process.stdout], daemon=True).start()
                return httpx.Client(base_url=address, timeout=60.0)
        raise RuntimeError("the service did not start: " + "".join(lines))

    def kill(self, *, workers):
        """Kill the service, or one of its workers; return the processes that must end by it."""
        self.n_kills += 1
        found = psutil.Process(self.process.pid).children(recursive=True)
        if workers:
            own = [one for one in found if is_worker(one)]
            if own:
                random.choice(own).kill()
            return []
        self.process.kill()
        self.process.wait(60)
        return found

    def work(self, client):
        """Upload whole and in parts, start jobs, export and adjust, until the service is gone."""
        self.round += 1
        survey = f"field{self.round}"
        with contextlib.suppress(httpx.TransportError):
            url, kind = f"/api/v1/surveys/{survey}/control", {"Content-Type": "text/csv"}
            self.asked(client.put(url, content=self.control, headers=kind))
            for digest, (url, n_bytes) in tuple(self.kept.items()):
                self.resume(client, digest, url, n_bytes)
            while True:
                self.number += 1
                self.upload(client, self.log + f"{self.number:09d}".encode(), survey)
                self.asked(client.get("/api/v1/export/results.duckdb"))
                if self.number % 3 == 0:
                    about = {"kind": "adjust", "survey": survey}
                    answer = self.asked(client.post("/api/v1/jobs", json=about))
                    self.jobs.add(answer.json()["job_id"])

    def asked(self, answer):
        """Return an answer; keep the refused ones."""
        if not answer.is_success:
            self.refused.append(f"{answer.request.url.path}: {answer.status_code} {answer.text}")
        return answer.raise_for_status()

    def upload(self, client, log, survey):
        """Send a log and start its job, every second one in two parts."""
        name = f"l{self.number}"
        if self.number % 2:
            query = {"name": name, "survey": survey, "process": "true"}
            answer = client.post("/api/v1/recordings", params=query, content=log, headers=MCAP)
            made = self.asked(answer).json()
            self.acknowledged.add(made["recording_id"])
            self.jobs.add(made["job"]["job_id"])
            return
        about = {"filename": name, "survey": survey, "process": "true"}
        pairs = (f"{key} {b64encode(value.encode()).decode()}" for key, value in about.items())
        sizes = {"Upload-Length": str(len(log)), "Upload-Metadata": ",".join(pairs)}
        begin = self.asked(client.post("/api/v1/uploads", headers={**TUS, **sizes}))
        digest, url = hashlib.sha256(log).hexdigest(), begin.headers["location"]
        self.kept[digest] = (url, 0)
        half = len(log) // 2
        self.append(client, digest, url, 0, log[:half])
        self.append(client, digest, url, half, log[half:])

    def append(self, client, digest, url, offset, part):
        """Send a part; note what is acknowledged."""
        place = {**PART, "Upload-Offset": str(offset)}
        answer = self.asked(client.patch(url, content=part, headers=place))
        self.kept[digest] = (url, offset + len(part))
        if "content-location" in answer.headers:
            self.acknowledged.add(digest)
            self.jobs.add(re.search(r"/jobs/(\w+)", answer.headers["link"])[1])
            del self.kept[digest]

    def resume(self, client, digest, url, n_bytes):
        """Complete an upload that an earlier kill has interrupted."""
        answer = client.head(url, headers=TUS)
        if answer.status_code == 404:  # complete, but for its answer
            self.acknowledged.add(digest)
            del self.kept[digest]
            return
        offset = int(self.asked(answer).headers["upload-offset"])
        if offset < n_bytes:
            self.shortened.append(f"{url}: {offset} of {n_bytes} acknowledged bytes")
        (log,) = (
            log
            for log in (self.log + f"{one:09d}".encode() for one in range(1, self.number + 1))
            if hashlib.sha256(log).hexdigest() == digest
        )
        self.append(client, digest, url, offset, log[offset:])

    def audit(self, client):
        """Return what was lost and what is there twice; nothing of either should be."""
        deadline = time.monotonic() + PATIENCE
        while any(one["status"] in ("accepted", "running") for one in everything(client, "jobs")):
            if time.monotonic() > deadline:
                raise TimeoutError("jobs did not end")
            time.sleep(0.5)
        jobs = {one["job_id"]: one for one in everything(client, "jobs")}
        done = {
            key for key, one in jobs.items()
            if one["status"] == "successful" and one["kind"] == "process"
        }  # fmt: skip
        given_up = {
            key for key, one in jobs.items()
            if one["error_code"] == "worker_died" and one["attempts"] == ATTEMPTS <= self.n_kills
        }  # fmt: skip
        rows = [one["recording_id"] for one in everything(client, "recordings")]
        files = {one.stem: one for one in (self.folder / "recordings").glob("*.mcap")}
        runs = [one["job_id"] for one in everything(client, "runs")]
        fixes = [
            (one["run_id"], one["stop"], one["fit_method"], one["resection_method"])
            for one in everything(client, "station-fixes")
        ]
        found = {
            "logs lost": sorted(self.acknowledged - set(rows)),
            "logs twice": twice(rows),
            "files without rows": sorted(files.keys() - set(rows)),
            "rows without files": sorted(set(rows) - files.keys()),
            "files of other bytes": sorted(
                stem
                for stem, path in files.items()
                if hashlib.sha256(path.read_bytes()).hexdigest() != stem
            ),
            "uploads shortened": self.shortened,
            "requests refused": self.refused,
            "jobs lost": sorted(self.jobs - jobs.keys()),
            "jobs failed": {
                key: f"{one['kind']}, {one['attempts']} attempts, {one['error_code']}: "
                f"{one['error_reason']}"
                for key, one in jobs.items()
                if one["status"] == "failed" and key not in given_up
            },
            "jobs without run": sorted(done - set(runs)),
            "runs without job": sorted(set(runs) - jobs.keys()),
            "runs twice": twice(runs),
            "fixes twice": twice(fixes),
            "too many attempts": [key for key, one in jobs.items() if one["attempts"] > ATTEMPTS],
        }
        about = {
            "logs": len(rows),
            "jobs": len(jobs),
            "given up": len(given_up),
            "tried again": sum(one["attempts"] > 1 for one in jobs.values()),
            "runs": len(runs),
            "fixes": len(fixes),
        }
        return {key: value for key, value in found.items() if value}, about

    def stop(self):
        """End it as a supervisor does."""
        self.process.terminate()
        self.process.wait(60)

    def doctor(self):
        """Return what the command finds wrong."""
        done = subprocess.run(
            [*COMMAND, "doctor"],
            env={**os.environ, "SPHEREMARK_DATA": str(self.folder)},
            capture_output=True,
            text=True,
            check=False,
        )
        return {} if done.returncode == 0 else {"doctor": done.stdout + done.stderr}


def twice(items):
    """Return those that are in a list more than once."""
    return sorted({str(one) for one, n in Counter(items).items() if n > 1 and one})


def everything(client, what):
    """Return all items of a list."""
    items, after = [], None
    while True:
        query = {"limit": 1000, **({"after": after} if after else {})}
        page = client.get(f"/api/v1/{what}", params=query).raise_for_status().json()
        items += page["items"]
        after = page["next"]
        if after is None:
            return items


def run(folder, log, control, *, rounds, seed, until=math.inf, show=lambda _: None):
    """Kill so many times; return what the audit found, and how much there was."""
    chance = random.Random(seed)
    victim = Victim(folder, log, control)
    client = victim.start()
    left = []
    try:
        for number in range(rounds):
            if time.time() > until:
                break
            worker = threading.Thread(target=victim.work, args=(client,), daemon=True)
            worker.start()
            before, deadline = len(victim.acknowledged), time.monotonic() + PATIENCE
            while len(victim.acknowledged) == before and worker.is_alive():
                if time.monotonic() > deadline:
                    raise TimeoutError("no log was acknowledged")
                time.sleep(0.05)  # a service that has just begun loads its readers first
            time.sleep(chance.uniform(0.0, 5.0))
            workers = number % 5 == 4
            left += victim.kill(workers=workers)
            if workers:
                time.sleep(chance.uniform(0.2, 2.0))
                left += victim.kill(workers=False)
            worker.join(90)  # longer than the timeout of a request
            if worker.is_alive():
                raise TimeoutError("a request did not end with its service")
            client.close()
            client = victim.start()
            show(f"round {number + 1}: {len(victim.acknowledged)} logs, {len(victim.jobs)} jobs")
        faults, about = victim.audit(client)
    finally:
        client.close()
        victim.stop()
    victim.start().close()  # removes what killed workers have left
    victim.stop()
    if alive := [one for one in left if one.is_running()]:
        faults["processes left"] = [" ".join(one.cmdline()) for one in alive]
    return faults | victim.doctor(), {"rounds": victim.round} | about


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("log", type=Path)
    parser.add_argument("control", type=Path)
    parser.add_argument("--rounds", type=int, default=50)
    parser.add_argument("--seed", type=int, default=2)
    parser.add_argument("--minutes", type=float, default=math.inf, help="no round after")
    given = parser.parse_args()
    begin_wall = time.time()

    def show(text):
        """Print progress."""
        sys.stderr.write(text + "\n")

    with tempfile.TemporaryDirectory() as place:
        content = given.log.read_bytes(), given.control.read_text()
        begin = time.monotonic()
        until = begin_wall + given.minutes * 60.0
        faults, about = run(
            Path(place), *content, rounds=given.rounds, seed=given.seed, until=until, show=show
        )
        seconds = round(time.monotonic() - begin)
        sys.stdout.write(json.dumps({"faults": faults, **about, "seconds": seconds}) + "\n")
