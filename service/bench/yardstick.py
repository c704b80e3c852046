"""The yardstick of the benchmark: one read of a file with a checksum, in a process of its own.

Any program that looks at each byte pays it. In a process with a long history the same loop costs
anything between this and a third of it, depending on the state of its memory: so it runs as
``python -m spheremark.service.bench.yardstick FILE``, which does nothing else.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from time import perf_counter, process_time
from typing import NamedTuple

from isal.isal_zlib import crc32

WHAT = (
    "one read of the points in blocks of 4 MiB with isal's CRC-32, in a fresh process, cache warm"
)
_BLOCK = 4 << 20  # [bytes] read at once
_READS = 3  # of which the quickest counts


class Cost(NamedTuple):
    """Time, and time of processors, which a busy machine changes less [s]."""

    seconds: float
    cpu_seconds: float


def read_cost(log: Path) -> Cost:
    """Return the cost of one read in a fresh process."""
    command = [sys.executable, "-m", "spheremark.service.bench.yardstick", str(log)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return Cost(*json.loads(done.stdout))


def least(costs: Iterable[Cost]) -> Cost:
    """Return the least of each."""
    return Cost(*(min(column) for column in zip(*costs, strict=True)))


def _cost(log: Path) -> Cost:
    """Read a file once; return its cost."""
    start, cpu, crc = perf_counter(), process_time(), 0
    with log.open("rb") as file:
        while block := file.read(_BLOCK):
            crc = crc32(block, crc)
    return Cost(perf_counter() - start, process_time() - cpu)


if __name__ == "__main__":
    sys.stdout.write(json.dumps(least(_cost(Path(sys.argv[1])) for _ in range(_READS))))
