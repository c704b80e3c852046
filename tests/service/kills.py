"""Kills a service at random moments of its work, then compares its files with its rows.

``python -m tests.service.kills --rounds 50`` is the long form of the test of the same name.
"""

import argparse
import contextlib
import hashlib
import json
import os
import random
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import httpx
import psutil

MCAP = {"Content-Type": "application/vnd.mcap"}
TUS = {"Tus-Resumable": "1.0.0"}
PART = {**TUS, "Content-Type": "application/offset+octet-stream"}
PATIENCE = 300.0  # [s]
COMMAND = (sys.executable, "-m", "spheremark.service.cli")


class Victim:
    """A service in a process of its own, on one data folder, started again after each kill."""

    def __init__(self, folder, log, control):
        self.folder, self.log, self.control = folder, log, control
        self.acknowledged = set()  # digests of logs, whatever comes
        self.jobs = set()
        self.number = 0

    def start(self):
        """Start it; return a client."""
        settings = {
            "SPHEREMARK_DATA": str(self.folder),
            "SPHEREMARK_PORT": "0",
            "SPHEREMARK_WORKERS": "1",
            "SPHEREMARK_JOB_ATTEMPTS": "10",
        }
        self.process = subprocess.Popen(
            [*COMMAND, "serve"],
            env={**os.environ, **settings},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for line in self.process.stdout:
            if "http://" in line:
                address = line[line.index("http://") :].split()[0].rstrip(".,;")
                threading.Thread(target=self.process.stdout.read, daemon=True).start()
                return httpx.Client(base_url=address, timeout=60.0)
        raise RuntimeError("the service did not start")

    def kill(self, *, workers):
        """Kill the service, or one of its workers."""
        if workers:
            found = psutil.Process(self.process.pid).children(recursive=True)
            own = [one for one in found if "spawn_main" in " ".join(one.cmdline())]
            if own:
                random.choice(own).kill()
            return
        self.process.kill()
        self.process.wait(60)

    def work(self, client):
        """Upload whole and in parts, start jobs, export and adjust, until the service is gone."""
        with contextlib.suppress(httpx.HTTPError):
            client.put("/api/v1/surveys/field/control", content=self.control,
                       headers={"Content-Type": "text/csv"}).raise_for_status()  # fmt: skip
            while True:
                self.number += 1
                self.upload(client, self.log + f"{self.number:09d}".encode())
                client.get("/api/v1/export/results.duckdb")
                answer = client.post("/api/v1/jobs", json={"kind": "adjust", "survey": "field"})
                if answer.status_code == 202:
                    self.jobs.add(answer.json()["job_id"])

    def upload(self, client, log):
        """Send a log, every second one in two parts, and start its job."""
        if self.number % 2:
            query = {"name": f"l{self.number}", "survey": "field", "process": "true"}
            answer = client.post("/api/v1/recordings", params=query, content=log, headers=MCAP)
            made = answer.json()
            if "recording_id" in made:
                self.acknowledged.add(made["recording_id"])
            if made.get("job"):
                self.jobs.add(made["job"]["job_id"])
            return
        begin = client.post("/api/v1/uploads", headers={**TUS, "Upload-Length": str(len(log))})
        url, half = begin.headers["location"], len(log) // 2
        for start, part in ((0, log[:half]), (half, log[half:])):
            place = {**PART, "Upload-Offset": str(start)}
            answer = client.patch(url, content=part, headers=place)
        if "content-location" in answer.headers:
            self.acknowledged.add(hashlib.sha256(log).hexdigest())

    def audit(self, client):
        """Return what was lost and what is there twice; nothing of either should be."""
        deadline = time.monotonic() + PATIENCE
        while any(one["status"] in ("accepted", "running") for one in everything(client, "jobs")):
            if time.monotonic() > deadline:
                raise TimeoutError("jobs did not end")
            time.sleep(0.5)
        jobs = {one["job_id"]: one for one in everything(client, "jobs")}
        rows = [one["recording_id"] for one in everything(client, "recordings")]
        files = {one.stem for one in (self.folder / "recordings").glob("*.mcap")}
        runs = [one["job_id"] for one in everything(client, "runs")]
        fixes = [
            (one["run_id"], one["stop"], one["fit_method"], one["resection_method"])
            for one in everything(client, "station-fixes")
        ]
        found = {
            "logs lost": sorted(self.acknowledged - set(rows)),
            "logs twice": sorted({one for one in rows if rows.count(one) > 1}),
            "files without rows": sorted(files - set(rows)),
            "rows without files": sorted(set(rows) - files),
            "jobs lost": sorted(self.jobs - jobs.keys()),
            "runs twice": sorted({one for one in runs if runs.count(one) > 1 and one}),
            "fixes twice": sorted({str(one) for one in fixes if fixes.count(one) > 1}),
            "too many attempts": [key for key, one in jobs.items() if one["attempts"] > 10],
            "internal errors": [
                key for key, one in jobs.items() if one["error_code"] == "internal"
            ],
        }
        about = {"logs": len(rows), "jobs": len(jobs), "runs": len(runs), "fixes": len(fixes)}
        return {key: value for key, value in found.items() if value}, about


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


def run(folder, log, control, *, rounds, seed):
    """Kill so many times; return what the audit found, and how much there was."""
    chance = random.Random(seed)
    victim = Victim(folder, log, control)
    client = victim.start()
    try:
        for number in range(rounds):
            worker = threading.Thread(target=victim.work, args=(client,), daemon=True)
            worker.start()
            before, deadline = len(victim.acknowledged), time.monotonic() + PATIENCE
            while len(victim.acknowledged) == before and time.monotonic() < deadline:
                time.sleep(0.05)  # a service that has just begun loads its readers first
            time.sleep(chance.uniform(0.0, 5.0))
            workers = number % 5 == 4
            victim.kill(workers=workers)
            if workers:
                time.sleep(chance.uniform(0.2, 2.0))
                victim.kill(workers=False)
            worker.join(60)
            client.close()
            client = victim.start()
        return victim.audit(client)
    finally:
        client.close()
        victim.process.terminate()
        victim.process.wait(60)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("log", type=Path)
    parser.add_argument("control", type=Path)
    parser.add_argument("--rounds", type=int, default=50)
    parser.add_argument("--seed", type=int, default=2)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        content = given.log.read_bytes(), given.control.read_text()
        begin = time.monotonic()
        faults, about = run(Path(place), *content, rounds=given.rounds, seed=given.seed)
        seconds = round(time.monotonic() - begin)
        sys.stdout.write(json.dumps({"faults": faults, **about, "seconds": seconds}) + "\n")
