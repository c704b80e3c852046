"""The frame of experiments: worlds in processes, pooled in their order; tables with units."""

import math
from functools import partial
from operator import pow as power

import pytest

from spheremark.pipelines.evaluation.experiment import Column, Experiment, Table, to_json


@pytest.mark.parametrize("n_processes", [1, 2])
def test_worlds_are_pooled_in_their_order_whatever_the_number_of_processes(n_processes):
    shares = []
    experiment = Experiment(
        worlds=[3, 1, 2],
        run_world=partial(power, 2),
        pool=lambda found: {"powers": found},
        tables=lambda report: [Table(rows=[{"n": len(report["powers"])}])],
    )
    report = experiment.run(lambda share, _what: shares.append(share), n_processes=n_processes)
    assert report == {"powers": [8, 2, 4]}
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    (table,) = experiment.tables(report)
    assert table.rows == [{"n": 3}]


def test_cells_are_in_the_unit_of_the_heading():
    column = Column("error_3d_m", "error", "mm", ".1f")
    assert column.heading == "error [mm]"
    assert column.cell({"error_3d_m": 0.0123}) == "12.3"
    assert Column("range_m", "distance", "m", ".2f").cell({"range_m": 7.5}) == "7.50"
    assert Column("share", "share", "%", ".0f").cell({"share": 0.5}) == "50"
    assert Column("n", "returns", "", ",d").cell({"n": 1200}) == "1,200"


def test_cells_without_a_value_are_marked_and_texts_stand_as_they_are():
    assert Column("rms_m", "RMS", "mm", ".1f").cell({"rms_m": None}) == "-"
    assert Column("peer_seconds", "peer", "ms", ".1f").cell({}) == "-"
    assert Column("stop", "stop").cell({"stop": "lane2-stop1"}) == "lane2-stop1"
    assert Column(lambda row: f"{row['n']} of 14", "found", "", ">").cell({"n": 3}) == "3 of 14"


def test_json_has_null_for_numbers_that_are_not_finite():
    found = to_json({"rows": ({"a": math.nan, "b": math.inf, "c": 1.5, "d": "x"},), "n": 2})
    assert found == {"rows": [{"a": None, "b": None, "c": 1.5, "d": "x"}], "n": 2}
