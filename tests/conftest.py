"""Settings of all tests, and what the end of a run names besides pytest's own summary."""

import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import settings

from tests.real_scans import ABSENT

settings.register_profile("spheremark", deadline=None)  # a first call imports or compiles
settings.load_profile("spheremark")


@pytest.fixture(scope="session")
def scheduler():
    """Return the address of a scheduler with one worker, which services of tests share."""
    with subprocess.Popen(
        [sys.executable, "-m", "tests.scheduler"],
        cwd=Path(__file__).parents[1],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        yield process.stdout.readline().strip()
        process.stdin.close()
        process.wait(60)


def pytest_terminal_summary(terminalreporter):
    """Name how many tests did not run for want of recordings, also where -ra is overridden."""
    skipped = terminalreporter.stats.get("skipped", [])
    n_absent = sum(ABSENT in str(report.longrepr) for report in skipped)
    if n_absent:
        terminalreporter.write_line(
            f"{n_absent} tests on recordings of others did not run: ../shared/real is incomplete.",
            red=True,
            bold=True,
        )
