"""Layers, names, documents and lock file agree with each other."""

import dataclasses
import importlib
import inspect
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import duckdb
import numpy as np
import pytest
from numpydoc.docscrape import FunctionDoc

from spheremark.pipelines import config, errors, model
from spheremark.storage.catalogue.migrations import migrate, released
from tests.conftest import LONGEST
from tests.documented import called_from_outside, modules_below

ROOT = Path(__file__).parent.parent
FRAMES = ("lidar", "head", "base", "station", "site")
FRAMELESS = {  # counts, clocks, scalars per row, and tables of the sensor: no coordinates in them
    "stamps_lidar_ns", "stamps_gimbal_ns", "stamps_imu_ns", "quaternions_imu", "R_mount_imu",
    "intensities", "rings", "gimbal_angles", "times", "ranges", "members", "used", "rejected",
    "near_rings", "near_times", "residuals", "matches", "redundancies", "w_statistics",
    "detectable_biases", "marks",
    "external_reliabilities", "included_angles", "included_angles_horizontal", "sigma_3d",
    "sigma_horizontal", "range_by_optics", "estimates", "weights", "sigmas_prior",
    "sigmas_profile", "log_likelihoods",
    "divergence", "laser_elevations", "laser_heights", "laser_range_biases",
    "fits", "measured", "given", "sigmas", "is_off",
    "encoder_eccentricity", "stamps_ns", "samples_ns", "values", "rates",
}  # fmt: skip


def all_errors(root=errors.SpheremarkError):
    import spheremark.service.errors
    import spheremark.storage.catalogue.sandbox  # noqa: F401

    found = [root]
    for leaf in root.__subclasses__():
        found += all_errors(leaf)
    return found


def dataclasses_of(module):
    members = inspect.getmembers(module, inspect.isclass)
    return [
        c for _, c in members if dataclasses.is_dataclass(c) and c.__module__ == module.__name__
    ]


def dataclasses_of_package(package):
    names = [f"{package.__name__}.{m}" for m in ("scan", "marker", "station")]
    return [c for name in names for c in dataclasses_of(importlib.import_module(name))]


def tables():
    connection = duckdb.connect()
    migrate(connection, released())
    return connection


def test_the_import_contracts_hold():
    run = subprocess.run(
        [Path(sys.executable).parent / "lint-imports", "--no-cache"],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stdout[-2000:]


@pytest.mark.parametrize("kind", dataclasses_of(config), ids=lambda kind: kind.__name__)
def test_every_field_of_a_configuration_is_documented(kind):
    for field in dataclasses.fields(kind):
        assert re.search(rf"^\s*{field.name} : ", kind.__doc__, re.MULTILINE), field.name


def test_an_unknown_key_of_a_configuration_is_refused_with_its_path():
    with pytest.raises(errors.ConfigError, match=r"extraction\.cell is unknown"):
        config.SurveyConfig.from_mapping({"extraction": {"cell": 1}})


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"fitting": 5}, "fitting is 5; it must be an object"),
        (5, "The configuration is 5; it must be an object"),
        (
            {"extraction": {"ground_cell": 10**400}},
            "extraction.ground_cell is a whole number beyond",
        ),
        ({"tolerance": -(10**400)}, "tolerance is a whole number beyond"),
    ],
)
def test_values_that_no_configuration_can_hold_are_refused_with_their_path(values, message):
    with pytest.raises(errors.ConfigError, match=re.escape(message)):
        config.SurveyConfig.from_mapping(values)


def test_a_configuration_survives_its_own_text():
    first = config.SurveyConfig.from_mapping({"tolerance": 0.02, "fitting": {"methods": ["paper"]}})
    again = config.SurveyConfig.from_mapping(first.to_mapping())
    assert again.digest == first.digest != config.SurveyConfig().digest


@pytest.mark.parametrize("kind", dataclasses_of_package(model), ids=lambda kind: kind.__name__)
def test_every_array_tells_its_frame_or_has_none(kind):
    arrays = {"Array", "Column", "Index", "Nanos", "Rings", "Mask"}
    for field in dataclasses.fields(kind):
        if field.type in arrays and field.name not in FRAMELESS:
            assert any(frame in field.name for frame in FRAMES), field.name


def test_every_array_of_a_value_is_sealed():
    marks = model.ControlMarks(
        names=("A",), p_site=np.zeros((1, 3)), cov_p_site=np.zeros((1, 3, 3))
    )
    with pytest.raises(ValueError, match="read-only"):
        marks.p_site[0, 0] = 1.0


def test_a_wrong_shape_is_refused_with_what_was_found_and_expected():
    with pytest.raises(errors.InputError, match=r"p_site has shape \(2, 3\), not \(1, 3\)"):
        model.ControlMarks(names=("A",), p_site=np.zeros((2, 3)), cov_p_site=np.zeros((1, 3, 3)))


def test_every_error_has_a_code_of_its_own_and_a_sentence():
    kinds = [k for k in all_errors() if k.__module__.partition(".")[0] != "tests"]
    codes = [kind.code for kind in kinds]
    assert len(set(codes)) == len(codes), sorted(codes)
    for kind in kinds:
        assert kind.__doc__, kind
        assert kind.__doc__.strip().splitlines()[0].endswith("."), kind


@pytest.fixture(scope="module")
def called():
    names = called_from_outside(modules_below(ROOT))
    assert len(names) > 100  # else the search has lost its way
    return [getattr(importlib.import_module(name.rpartition(".")[0]), name.rpartition(".")[2])
            for name in sorted(names)]  # fmt: skip


def test_what_other_packages_call_documents_its_parameters(called):
    for function in called:
        function = inspect.unwrap(getattr(function, "py_func", function))
        documented = {
            name.strip().lstrip("*")
            for parameter in FunctionDoc(function)["Parameters"]
            for name in parameter.name.split(",")
        }
        assert documented == set(inspect.signature(function).parameters), function.__qualname__


def test_what_other_packages_call_documents_what_it_returns(called):
    for function in called:
        function = inspect.unwrap(getattr(function, "py_func", function))
        text = FunctionDoc(function)
        gives = inspect.signature(function).return_annotation
        is_documented = bool(text["Returns"] or text["Yields"])
        assert is_documented or gives in (None, "None", "NoReturn"), function.__qualname__


def test_every_table_and_view_is_documented():
    query = """SELECT table_name, comment FROM duckdb_tables() WHERE NOT internal
        UNION ALL SELECT view_name, comment FROM duckdb_views() WHERE NOT internal"""
    without = [name for name, comment in tables().execute(query).fetchall() if not comment]
    assert not without


def test_every_number_of_the_database_carries_its_unit():
    units = ("_m", "_m2", "_deg", "_s", "_percent", "_bytes", "_rad", "_db")
    unitless = re.compile(
        r"^(n_|share_|dof$|dop$|sigma0$|redundancy$|w$|coverage$|attempts$"
        r"|mean_(n_points|intensity|redundancy)$"
        r"|number$|place$|probability|log_(odds|likelihoods)|cov_motion$|optics$|rotation$|n_points_(from|to)$"
        r"|(vtpv|vtpv_limit|w_limit|test_level)$|variance_factor_"
        r"|(start_value|estimate|sigma)$)"  # calibrated_parameters: the unit stands in the row
    )
    query = """SELECT table_name, column_name FROM duckdb_columns() WHERE NOT internal
        AND (data_type LIKE 'DOUBLE%' OR data_type LIKE '%INT%')"""
    for table, column in tables().execute(query).fetchall():
        assert column.endswith(units) or unitless.match(column), f"{table}.{column}"


def test_the_reference_page_is_that_of_the_commands_and_settings():
    from spheremark.service.cli.reference import reference

    assert (ROOT / "REFERENCE.md").read_text() == reference(), "Run `make reference`."


@pytest.mark.parametrize("name", ["requirements.lock", "requirements-dev.lock"])
def test_a_lock_file_names_no_place_of_a_package(name):
    lock = (ROOT / name).read_text()
    assert not re.search(
        r"^[^#]*(https?:|file:)|--index-url|--find-links|--extra-index-url", lock, re.M
    )


@pytest.mark.parametrize("name", ["requirements.lock", "requirements-dev.lock"])
def test_every_locked_package_has_the_digests_of_its_files(name):
    packages = re.split(r"^(?=[a-z0-9-]+==)", (ROOT / name).read_text(), flags=re.M)[1:]
    assert len(packages) > 100
    assert all("--hash=sha256:" in package for package in packages)


def locked(name):
    return dict(re.findall(r"^([a-z0-9-]+)==(\S+)", (ROOT / name).read_text(), re.M))


def test_every_dependency_is_locked_and_has_a_lower_bound():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    run, dev = project["dependencies"], project["optional-dependencies"]["dev"]
    for requirement in (*run, *dev):
        assert ">=" in requirement, requirement
    needed = {re.match(r"[a-z0-9-]+", one).group() for one in run}
    assert needed <= locked("requirements.lock").keys()
    extra = {re.match(r"[a-z0-9-]+", one).group() for one in dev}
    assert extra <= locked("requirements-dev.lock").keys()


def test_tests_run_with_the_versions_that_the_service_runs_with():
    run, dev = locked("requirements.lock"), locked("requirements-dev.lock")
    assert run.items() <= dev.items()


@pytest.mark.parametrize("name", LONGEST)
def test_a_file_of_tests_that_is_begun_first_is_there(name):
    assert (ROOT / "tests" / name).is_file()
