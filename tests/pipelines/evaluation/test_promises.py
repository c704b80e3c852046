"""Stations over their plans: how errors, missing positions and missed marks are pooled."""

import math

from numpy.testing import assert_allclose

from spheremark.pipelines.evaluation.promises import promises


def station(seed, family, error, matched=(True, True)):
    """Return a station that is promised 1 mm, with one mark of each class."""
    marks = [
        {"class": i, "expected": 0.9, "is_matched": is_matched}
        for i, is_matched in enumerate(matched)
    ]
    status = "none" if math.isnan(error) else "ok" if error < 9e-3 else "weak"
    return {
        "seed": seed,
        "family": family,
        "sigma_3d_m": 0.9e-3,
        "promised_rms_3d_m": 1e-3,
        "error_3d_m": error,
        "status": status,
        "marks": marks,
    }


def test_stations_without_a_position_are_counted_and_foreign_physics_stays_apart():
    experiment = promises(3, 0)
    report = experiment.pool(
        [
            [station(0, "plain", 1e-3), station(0, "plain", 2e-3, (True, False))],
            [station(2, "lattice", math.nan, (False, False))],
            [station(4, "clock", 9e-3)],
        ]
    )
    groups = {row["family"]: row for row in report["groups"]}
    usual = groups["usual physics"]
    assert (usual["n_stations"], usual["n_none"], usual["n_matched"]) == (3, 1, 3)
    assert_allclose(usual["ratio"], math.sqrt(2.5), rtol=1e-12)
    assert_allclose(usual["n_expected"], 5.4, rtol=1e-12)
    assert_allclose(groups["all"]["ratio"], math.sqrt(86.0 / 3.0), rtol=1e-12)
    assert_allclose(groups["all"]["ratio_ok"], math.sqrt(2.5), rtol=1e-12)
    assert [(row["n"], row["n_matched"]) for row in report["marks"]] == [
        (3, 2),
        (3, 1),
        (0, 0),
        (0, 0),
    ]
    assert [table.to_texts()["title"] for table in experiment.tables(report)]
