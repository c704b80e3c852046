"""What the end of a test run names besides pytest's own summary."""

from tests.real_scans import ABSENT


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
