"""The yardstick of the benchmark: one read of a file with a checksum, in a process of its own.

It is what any program must pay that looks at each byte. In a process that has done much before,
the same loop costs anything between this and a third of it, as memory happens to be at hand: so
it is run as ``python -m service.yardstick FILE``, which does nothing else.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from time import perf_counter

from isal.isal_zlib import crc32

WHAT = (
    "one read of the points in blocks of 4 MiB with isal's CRC-32, in a fresh process, cache warm"
)
_BLOCK = 4 << 20  # [bytes] read at once
_READS = 3  # of which the quickest counts


def read_seconds(log: Path) -> float:
    """Return how long one read takes in a fresh process [s]."""
    command = [sys.executable, "-m", "service.yardstick", str(log)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return float(done.stdout)


def _timed(log: Path) -> float:
    """Read a file once; return how long it took [s]."""
    start, crc = perf_counter(), 0
    with log.open("rb") as file:
        while block := file.read(_BLOCK):
            crc = crc32(block, crc)
    return perf_counter() - start


if __name__ == "__main__":
    sys.stdout.write(str(min(_timed(Path(sys.argv[1])) for _ in range(_READS))))
