"""What stands beside a number: the version of the code that made it, and what memory it took."""

from __future__ import annotations

import resource
import subprocess
from contextlib import suppress
from datetime import UTC, datetime
from functools import lru_cache
from importlib import metadata
from pathlib import Path


def forget_peak_memory() -> None:
    """Let the kernel count this process's peak memory from here, where it can (Linux)."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_memory() -> int:
    """Return the largest resident size of this process since it was last forgotten [bytes]."""
    with suppress(OSError, StopIteration):
        lines = Path("/proc/self/status").read_text().splitlines()
        line = next(line for line in lines if line.startswith("VmHWM:"))
        return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


@lru_cache
def code_version() -> str:
    """Return the version that made a number: the release, and the commit in a checkout."""
    release = metadata.version("spheremark")
    root = Path(__file__).parent.parent
    if not (root / ".git").exists():
        return release
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--exclude=*"]
    with suppress(OSError):  # without git, the release has to do
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode == 0:
            return f"{release}+g{done.stdout.strip().replace('-', '.')}"
    return release


def made_now() -> dict[str, str]:
    """Return the time and the version of the code, for a report that is made now."""
    now = datetime.now(UTC).isoformat(timespec="seconds")
    return {"made_at": now, "code_version": code_version()}
