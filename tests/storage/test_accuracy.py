"""Aggregates of accuracy by the database against the same ones by NumPy."""

import numpy as np
import pytest

from spheremark.service.serialise.solution import survey_result
from spheremark.storage.catalogue import accuracy
from spheremark.storage.catalogue.accuracy import QUERIES, TABLES, Selection
from spheremark.storage.catalogue.catalogue import Catalogue
from tests.surveyed import fill


@pytest.fixture(scope="module")
def catalogue(tmp_path_factory):
    data = tmp_path_factory.mktemp("data")
    with Catalogue(data / "spheremark.duckdb", snapshots=data / "snapshots") as catalogue:
        fill(catalogue, data / "clouds", "field", n_stops=3)
        fill(catalogue, data / "clouds", "blind", n_stops=1, with_truth=False, lane="a")
        yield catalogue


def result(catalogue, name, **chosen):
    values = accuracy.parameters(catalogue, Selection(**chosen))
    if name == "within":
        values = values | {"edges_m": accuracy.edges(catalogue, values)}
    return catalogue.rows(QUERIES[name], accuracy.used_by(QUERIES[name], values))


def errors(catalogue):
    rows = catalogue.rows("SELECT * FROM latest_marker_fits WHERE error_3d_m IS NOT NULL")
    return [row for row in rows if row["fit_method"] == "paper"]


def test_bins_have_the_quantiles_of_their_rows(catalogue):
    rows = errors(catalogue)
    for row in result(catalogue, "distance", methods=("paper",)):
        own = [
            one["error_3d_m"] for one in rows if row["bin_from"] <= one["range_m"] < row["bin_to"]
        ]
        assert row["n"] == len(own)
        assert row["median_m"] == pytest.approx(np.quantile(own, 0.5))
        assert row["p975_m"] == pytest.approx(np.quantile(own, 0.975))
        assert row["worst"][0]["value_m"] == max(own)


@pytest.mark.parametrize("name", ["distance", "count"])
def test_every_row_is_in_one_bin(catalogue, name):
    assert sum(row["n"] for row in result(catalogue, name)) == 2 * len(errors(catalogue))
    for row in result(catalogue, name):
        assert row["bin_from"] <= row["mean_x"] < row["bin_to"]


def test_a_distribution_counts_what_is_within_the_tolerance(catalogue):
    (row,) = result(catalogue, "distribution", methods=("paper",), tolerance_m=0.022)
    known = [one["error_3d_m"] for one in errors(catalogue)]
    assert row["n_within"] == sum(one <= 0.022 for one in known)
    assert row["quantiles_m"][14] == pytest.approx(np.median(known))


def test_the_ratio_of_errors_to_sigmas_is_that_of_the_result(catalogue):
    (row,) = result(catalogue, "distribution", surveys=("field",), methods=("along_beam",))
    checks = {one.what: one for one in survey_result(catalogue, "field").checks}
    assert row["ratio_rms"] == pytest.approx(checks["centres"].ratio)


def test_without_truth_the_predicted_sigmas_are_aggregated(catalogue):
    values = accuracy.parameters(catalogue, Selection(surveys=("blind",)))
    assert not values["is_error"]
    assert sum(row["n"] for row in result(catalogue, "distance", surveys=("blind",))) == 28


def test_counts_by_scan_add_up_to_the_rows(catalogue):
    rows = result(catalogue, "within", methods=("paper",))
    assert sum(row["n"] for row in rows) == len(errors(catalogue))
    assert all(row["n"] <= row["nn"] and row["kk"] <= row["nn"] for row in rows)


@pytest.mark.parametrize("name", [*QUERIES, *TABLES])
def test_a_query_with_its_values_runs_alone(catalogue, name):
    chosen = Selection(surveys=("field", "o'clock"), stop="it's")
    values = accuracy.parameters(catalogue, chosen) | {"edges_m": [0.0, 5.0]}
    sql = QUERIES[name] if name in QUERIES else TABLES[name][0]
    text = accuracy.as_text(sql, values)
    assert "$" not in text
    assert catalogue.rows(text) == catalogue.rows(sql, accuracy.used_by(sql, values))
