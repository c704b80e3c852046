"""Settings of all tests, and what the end of a run names besides pytest's own summary."""

from hypothesis import settings

from tests.real_scans import ABSENT

settings.register_profile("spheremark", deadline=None)  # a first call imports or compiles
settings.load_profile("spheremark")


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
