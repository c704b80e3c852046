"""Two results beside each other: what chance explains is not significant, what it does not is."""

import numpy as np
import pytest

from spheremark.pipelines.accuracy.comparison import (
    aligned,
    compare_numbers,
    compare_pairs,
    compare_points,
    holm,
)
from spheremark.pipelines.errors import TooFewObservationsError
from spheremark.pipelines.geometry import rot_z

COV = np.diag([1e-6, 4e-6, 9e-6])


def test_noise_alone_is_called_significant_in_one_table_of_twenty():
    rng = np.random.default_rng(8)
    n_tables, n = 600, 20
    noise = rng.multivariate_normal(np.zeros(3), 2.0 * COV, (n_tables, n))
    cov = np.tile(COV, (n, 1, 1))
    wrong = [compare_points(np.zeros((n, 3)), cov, one, cov).significant.any() for one in noise]
    assert np.mean(wrong) <= 0.05 + 3.0 * np.sqrt(0.05 * 0.95 / n_tables)


def test_a_shift_of_ten_sigma_is_significant_and_the_others_are_not():
    p, cov = np.zeros((5, 3)), np.tile(COV, (5, 1, 1))
    moved = p.copy()
    moved[2, 0] = 10.0 * np.sqrt(2.0) * 1e-3
    found = compare_points(p, cov, moved, cov)
    assert found.significant.tolist() == [False, False, True, False, False]
    assert found.statistics[2] == pytest.approx(100.0)
    assert found.sigmas[0] == pytest.approx(np.sqrt(2.0 * np.trace(COV)))


def test_networks_in_different_frames_are_laid_on_each_other():
    rng = np.random.default_rng(2)
    p = rng.uniform(-10, 10, (6, 3))
    there = p @ rot_z(0.7).T + np.array([4.0, -2.0, 1.0])
    np.testing.assert_allclose(aligned(p, there), p, rtol=0, atol=1e-12)
    with pytest.raises(TooFewObservationsError, match="1 common points"):
        aligned(p[:1], there[:1])


def test_parameters_are_compared_in_units_of_their_sigma():
    one = np.ones(2)
    differences, sigmas, significant = compare_numbers(
        one, 0.3 * one, one + np.array([0.4, 4.0]), 0.4 * one
    )
    np.testing.assert_allclose(sigmas, 0.5)
    assert differences.tolist() == pytest.approx([0.4, 4.0])
    assert significant.tolist() == [False, True]


def test_pairs_that_always_differ_have_an_interval_beside_zero():
    rng = np.random.default_rng(6)
    first = rng.uniform(1.0, 9.0, 40)
    found = compare_pairs(first, first + rng.normal(0.5, 0.2, 40))
    assert found.low < 0.5 < found.high
    assert found.low > 0.0
    assert found.p_value < 1e-6
    with pytest.raises(TooFewObservationsError, match="5 common stops"):
        compare_pairs(np.ones(5), np.zeros(5))


def test_the_interval_of_a_median_holds_it_in_95_of_100_samples():
    rng = np.random.default_rng(3)
    samples = [compare_pairs(np.zeros(15), rng.normal(size=15)) for _ in range(800)]
    held = np.mean([one.low <= 0.0 <= one.high for one in samples])
    assert held >= 0.95 - 3.0 * np.sqrt(0.05 * 0.95 / 800)


def test_holm_rejects_in_steps():
    assert holm(np.array([0.01, 0.04, 0.03])).tolist() == [True, False, False]
    assert holm(np.array([0.001, 0.02, 0.04])).tolist() == [True, True, True]
