"""What a command imports, what compilation reports, and what the wheel holds."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SERVICE = {"dask", "distributed", "duckdb", "fastapi", "plotly", "pyarrow", "rasterio", "laspy"}
HEAVY = SERVICE | {"open3d", "scipy.stats", "scipy.optimize", "scipy.ndimage", "shapely"}


def python(code, **environment):
    run = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True, text=True, check=False, env=os.environ | environment,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    return run


def imported_by(code):
    return set(python(f"import sys\n{code}\nprint(*sys.modules)").stdout.split())


def test_the_help_of_the_command_needs_no_library_of_numbers():
    found = imported_by("import spheremark.service.cli.main")
    assert not found & (HEAVY | {"numba", "numpy", "scipy", "pydantic_settings"})


@pytest.mark.parametrize("module", ["pipelines.survey", "storage.recordings"])
def test_a_scan_is_read_and_processed_without_what_only_the_service_needs(module):
    assert not imported_by(f"import spheremark.{module}") & HEAVY


def test_a_service_starts_without_the_statistics_that_few_pages_need():
    assert "scipy.stats" not in imported_by("import spheremark.service.http.app")


def test_compilation_is_reported_and_leaves_the_level_of_optimisation_as_it_was(tmp_path):
    code = """
import numba, numpy as np
from spheremark.pipelines.compilation import watch_compilation
from spheremark.pipelines.estimation.linear_algebra import inverse
level, reports = numba.config.OPT, []
watch_compilation(reports.append)
inverse(4.0 * np.eye(3))
inverse(2.0 * np.eye(3))
assert numba.config.OPT == level
print(reports)
"""
    assert python(code, NUMBA_CACHE_DIR=str(tmp_path)).stdout == "[0]\n"
    assert python(code, NUMBA_CACHE_DIR=str(tmp_path)).stdout == "[]\n"  # kept by the first


def test_the_wheel_holds_the_package_alone(tmp_path):
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "-d", tmp_path],
        cwd=ROOT, check=True, capture_output=True,
    )  # fmt: skip
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.partition("/")[0].partition("-")[0] for name in names} == {"spheremark"}
    modules = {f"spheremark/{path.relative_to(ROOT)}" for path in modules_of_the_checkout()}
    assert modules <= set(names)
    assert not [n for n in names if "__pycache__" in n or "/tests/" in n or n.endswith(".nbi")]


def modules_of_the_checkout():
    for top in ("pipelines", "service", "storage", "web"):
        yield from (ROOT / top).rglob("*.py")
