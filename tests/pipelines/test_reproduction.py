import numpy as np
import pytest
from numpy.testing import assert_allclose

from pipelines.config import SurveyConfig
from pipelines.reproduction import (
    CENTRE,
    FIELD,
    FULL_SPHERE,
    LANE_2,
    LEVEL,
    OURS,
    PAPER,
    REFLECTIVITY_BINS,
    Scan,
    findings,
    models_of_icp,
    plan,
    range_noise,
    reproduce,
    table_2,
    table_4,
)
from pipelines.simulation import SimulationConfig, commensurability
from pipelines.study import TABLE_2
from tests.reproduced import reproduction

MM = 1e-3  # [m]


@pytest.fixture(scope="module")
def made():
    """Two real simulated scans of the study's field, the second with fewer returns."""
    centre = Scan(series=CENTRE, scenario="paper-field", stop="lane3-stop4", seed=3, turn=6.6)
    lane = Scan(series=LANE_2, scenario="paper-field", stop="lane2-stop1", seed=3, turn=4.2)
    return reproduce((centre, lane), SurveyConfig())


def test_no_turn_of_a_plan_puts_scan_lines_on_scan_lines():
    for turn in {scan.turn for scan in plan(0)}:
        assert commensurability(SimulationConfig(turn=turn)) == ""


def test_a_quick_plan_has_all_series_and_begins_like_the_full_one():
    quick, full = plan(7, is_quick=True), plan(7)
    assert {scan.series for scan in quick} == {scan.series for scan in full}
    assert quick[0] == full[0]
    assert sum(scan.turn for scan in quick) < sum(scan.turn for scan in full) / 4
    assert len(set(full)) == len(full)


def test_the_published_table_agrees_with_itself():
    assert_allclose(np.linalg.norm(TABLE_2.errors, axis=1), TABLE_2.errors_3d, rtol=0, atol=MM / 5)
    assert TABLE_2.errors_3d.mean() == pytest.approx(0.0292, abs=MM / 10)


def test_the_simulated_field_has_the_distances_of_the_study(made):
    keep = made.centres.of(OURS, made.series(CENTRE))
    assert keep.sum() == 14
    assert_allclose(np.sort(made.centres.ranges[keep]), TABLE_2.ranges, rtol=0, atol=2 * MM)


def test_ours_is_within_the_tolerance_where_the_paper_is_several_times_worse(made):
    ours, paper = (
        made.centres.error_3d[made.centres.of(method, made.series(CENTRE))]
        for method in (OURS, PAPER)
    )
    assert ours.max() < 0.015
    assert paper.mean() > 4 * ours.mean()


def test_the_paper_errs_towards_the_scanner_and_upward(made):
    errors = made.centres.error_station[made.centres.of(PAPER, made.series(CENTRE))]
    assert errors[:, 0].mean() < -5 * MM
    assert errors[:, 2].mean() > 2 * MM
    assert abs(errors[:, 1].mean()) < 5 * MM


def test_a_full_sphere_as_model_is_worse_than_a_hemisphere(made):
    errors = models_of_icp(made)
    assert errors[FULL_SPHERE].mean > 1.5 * errors[PAPER].mean


def test_the_cut_of_the_example_leaves_what_is_above_it(made):
    shown = made.example
    assert shown.points_station[shown.is_left, 2].min() >= shown.cut - MM
    assert 0 < shown.is_left.sum() < len(shown.is_left)
    assert -shown.radius < shown.cut < shown.radius
    assert_allclose(
        np.linalg.norm(shown.points_station[shown.is_left], axis=1), shown.radius, atol=0.06
    )


def test_the_simulated_noise_is_found_again_in_the_simulated_log(made):
    sigma = made.noise.sigmas[REFLECTIVITY_BINS.index(15.0)]
    assert sigma == pytest.approx(0.0089, rel=0.12)  # what the simulator gives to that reflectivity


def test_the_noise_of_ranges_on_a_slope_is_that_of_the_ranges():
    rng = np.random.default_rng(1)
    n, cycle = 40_000, 55.296e-6
    time = np.arange(n) * cycle
    ranges = 5.0 + 40.0 * (time % 0.01) + 300.0 * (time % 0.01) ** 2 + rng.normal(0, 0.006, n)
    found = range_noise(ranges, np.full(n, 3, np.uint8), time * 1e9, np.full(n, 50.0))
    assert found.sigmas[3] == pytest.approx(0.006, rel=0.06)
    assert np.isnan(found.sigmas[0])
    assert found.n[3] > 2000


def test_runs_of_shots_that_miss_one_or_meet_two_surfaces_tell_no_noise():
    rng = np.random.default_rng(2)
    firings = np.arange(4000)[np.arange(4000) % 12 != 5]
    rings = np.zeros(len(firings), np.uint8)
    noise = rng.normal(0, 0.006, len(firings))
    gaps = range_noise(5.0 + noise, rings, firings * 55296.0, np.full(len(firings), 50.0))
    assert gaps.n.sum() == 0
    striped = np.where(np.arange(4000) % 6 < 3, 50.0, 90.0)
    offsets = np.arange(4000) * 55296.0
    two = range_noise(np.full(4000, 5.0), np.zeros(4000, np.uint8), offsets, striped)
    assert two.n.sum() == 0


def test_table_2_puts_each_centre_to_its_distance():
    made = reproduction()
    rows = table_2(made)
    assert [row.distance for row in rows] == TABLE_2.ranges.tolist()
    centres = made.centres
    first = centres.of(PAPER, made.series(CENTRE)) & (centres.ranges == rows[0].distance)
    assert rows[0].errors[PAPER].n == first.sum() == 2
    assert rows[0].errors[PAPER].mean == pytest.approx(centres.error_3d[first].mean())
    assert rows[0].n_points[OURS] == np.ceil(6800.0 / 6.84**2)


def test_table_4_goes_along_the_lane_and_counts_what_was_found():
    rows = table_4(reproduction())
    assert [row.stop for row in rows] == [f"lane2-stop{i + 1}" for i in range(7)]
    assert all(row.n_marks == row.errors[OURS].n == 14 for row in rows)
    assert all(row.errors[PAPER].mean > 0.02 > row.errors[OURS].mean for row in rows)


def test_a_biased_method_keeps_the_tolerance_by_its_mean_and_not_by_its_percentile():
    made = reproduction()
    found = {(one.place, one.method): one for one in findings(made, np.random.default_rng(4))}
    assert set(found) == {(place, method) for place in (FIELD, LEVEL) for method in (OURS, PAPER)}
    paper, ours = found[FIELD, PAPER], found[FIELD, OURS]
    assert paper.errors.p95 > 0.03 > paper.errors.mean
    assert paper.limits["p95"].greatest_distance.low == 0.0
    assert paper.limits["mean"].greatest_distance.value > 8.0
    assert ours.limits["p95"].greatest_distance.value == np.inf
    assert ours.limits["p95"].greatest_distance.seen[1] == pytest.approx(9.34)


def test_the_same_reproduction_gives_the_same_statements():
    first, second = (findings(reproduction(), np.random.default_rng(4)) for _ in range(2))
    assert [one.limits for one in first] == [one.limits for one in second]
