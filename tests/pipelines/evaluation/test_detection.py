"""Precision and recall of extraction from scores of scans; the worlds are simulated elsewhere."""

import numpy as np
import pytest

from spheremark.pipelines.evaluation.detection import _Score, _Thing, extraction

HERE = np.zeros(3)


def scan(n_found, n_missed, n_false):
    found = [_Thing("near", True, True, HERE)] * n_found
    missed = [_Thing("near", True, False, HERE, "It is … mm wide")] * n_missed
    rocks = [_Thing("rock", False, True, HERE)] * n_false
    rocks += [_Thing("rock", False, False, HERE, "It does not stand free")]
    return _Score("field", found + missed + rocks, n_false)


def test_precision_and_recall_are_those_of_all_scans_together():
    experiment = extraction({"field": ("a", "b")}, (7, 8))
    assert list(experiment.worlds) == [
        ("field", seed, stop) for seed in (7, 8) for stop in ("a", "b")
    ]
    report = experiment.pool([scan(5, 1, 0), scan(4, 0, 3)])
    one = report["scenarios"]["field"]
    assert (one["n_scans"], one["n_false"], one["n_false_worst_scan"]) == (2, 3, 3)
    assert one["precision"] == pytest.approx(9 / 12)
    assert one["markers"] == [
        {"kind": "near", "n": 10, "n_found": 9, "reasons": {"It is … mm wide": 1}}
    ]
    assert one["decoys"] == [
        {"kind": "rock", "n": 5, "n_found": 3, "reasons": {"It does not stand free": 2}}
    ]
    (table,) = experiment.tables(report)
    assert "precision 0.7500" in table.title
    cells = [[column.cell(row) for column in table.columns] for row in table.rows]
    assert cells[0] == ["near", "10", "9", "0.900", "It is … mm wide (1)"]


def test_a_scenario_without_candidates_has_no_precision():
    experiment = extraction({"field": ("a",)}, (7,))
    report = experiment.pool([scan(0, 2, 0)])
    assert report["scenarios"]["field"]["precision"] is None
    assert "none found" in experiment.tables(report)[0].title
