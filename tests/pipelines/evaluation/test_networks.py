"""The experiment with adjusted surveys, on very small ones."""

import json

import numpy as np
import pytest
from rich.console import Console

from spheremark.pipelines.calibration.gimbal import GIMBAL, values
from spheremark.pipelines.config import ResectionConfig
from spheremark.pipelines.evaluation.networks import (
    is_gross_found,
    networks,
    random_networks,
    wrong_rig,
)
from spheremark.pipelines.network import adjust_network, assemble
from spheremark.pipelines.simulation import SimulationConfig
from spheremark.pipelines.simulation.rig import nominal_rig
from spheremark.service.cli.render import print_tables
from tests.synthetic import field, pose, sightings

CONFIG = ResectionConfig()
EXPERIMENT = networks(2, seed=40, n_stops=3, is_rig_wrong=True)


@pytest.fixture(scope="module")
def report():
    shares = []
    found = EXPERIMENT.run(lambda share, _what: shares.append(share), n_processes=1)
    assert shares == [0.0, 0.5, 1.0]
    return found


def test_surveys_with_wrong_rigs_are_compared_with_their_truth(report):
    assert [row["seed"] for row in report["surveys"]] == [40, 41]
    for row in report["surveys"]:
        assert row["n_stations"] == 3
        assert 0.0003 < row["rms_marks_m"] < 0.006  # wrong rigs alone would give 10 mm
        assert row["sigma0"] == pytest.approx(1.0, abs=0.35)
    mean = np.mean([row["rms_stations_m"] for row in report["surveys"]])
    assert report["summary"]["rms_stations_m"]["mean"] == pytest.approx(mean)


def test_the_report_is_a_table_and_json(report):
    out = Console(record=True, width=160)
    print_tables(out, EXPERIMENT.tables(report))
    text = out.export_text()
    for word in ("wrong rigs", "marks, 3-D error RMS", "0.85 to 1.2", "found and named in"):
        assert word in text
    assert json.loads(json.dumps(report))["surveys"] == report["surveys"]


def test_a_wrong_rig_is_wrong_by_the_stated_amounts():
    rig = nominal_rig(SimulationConfig())
    wrong = wrong_rig(rig, np.random.default_rng(1))
    off = dict(zip([one.name for one in GIMBAL], np.abs(values(wrong) - values(rig)), strict=True))
    assert off["axis_offset_x"] == pytest.approx(0.010)
    assert off["axis_offset_y"] == pytest.approx(0.008)
    assert off["spin_zero"] == pytest.approx(np.radians(0.2))
    rigs = [wrong_rig(rig, np.random.default_rng(k)) for k in range(40)]
    assert np.std([one.laser_range_biases for one in rigs]) == pytest.approx(0.005, rel=0.1)


def test_a_gross_error_is_found_where_many_stations_see_the_marks_and_not_where_two_do():
    rng = np.random.default_rng(2)
    marks = field(rng)
    scans = [
        (
            f"S{i}",
            sightings(
                marks,
                pose(rng.uniform(-3, 3, 3), rng.uniform(-3, 3)),
                noise=rng.normal(0, 4e-3, (14, 3)),
            ),
        )
        for i in range(6)
    ]
    many = assemble(scans, None, CONFIG)
    assert is_gross_found(many, rng)
    few = assemble([(name, fits) for name, fits in scans[:2]], None, CONFIG)
    before = adjust_network(few, CONFIG).left_out
    found = [is_gross_found(few, np.random.default_rng(k)) for k in range(12)]
    assert before == few.left_out
    assert not all(found)


def test_surveys_of_random_worlds_are_pooled_by_family():
    rng = np.random.default_rng(2)
    rows = [
        {"seed": 2 * i, "family": "plain", "failure": "", "n_marks": 11, "n_false_marks": 1,
         "n_stations": 4, "rms_marks_m": 0.001, "rms_stations_m": 0.002,
         "nees_marks": rng.chisquare(24) / 24, "nees_stations": rng.chisquare(6) / 6}
        for i in range(2000)
    ]  # fmt: skip
    rows.append({"seed": 1, "family": "empty", "failure": "no marker"})
    experiment = random_networks(len(rows), seed=0, n_stops=4)
    assert list(experiment.worlds)[:3] == [0, 2, 4]
    report = experiment.pool(rows)
    plain, empty, both = report["families"]
    assert (plain["n_adjusted"], empty["n_adjusted"], both["n_adjusted"]) == (2000, 0, 2000)
    for level in (50, 68, 95):
        for what in ("marks", "stations"):
            assert plain[f"within_{level}_{what}"] == pytest.approx(level / 100, abs=0.04)
    assert empty["nees_marks"] is None
    (table,) = experiment.tables(report)
    assert "Seed 1 (empty): no marker" in table.notes
