"""Weights, scale and covariance of robust estimates."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spheremark.pipelines.estimation.robust import (
    HUBER,
    huber_weights,
    robust_sigma,
    sandwich_covariance,
    tukey_loss,
    tukey_weights,
)


@given(v=st.floats(-12.0, 12.0), limit=st.floats(1.0, 9.0))
def test_the_weight_of_tukey_times_the_residual_is_the_slope_of_the_loss(v, limit):
    h = 1e-5
    slope = (tukey_loss(np.array([v + h]), limit) - tukey_loss(np.array([v - h]), limit)) / (2 * h)
    assert slope == pytest.approx(v * tukey_weights(np.array([v]), limit)[0], abs=1e-6)


def test_an_outlier_has_a_bounded_influence_by_huber_and_none_by_tukey():
    far = np.array([10.0, 1e3, 1e6])
    np.testing.assert_allclose(huber_weights(far) * far, HUBER, rtol=1e-12)
    np.testing.assert_array_equal(tukey_weights(far, 6.0), 0.0)
    np.testing.assert_array_equal(huber_weights(np.array([-1.3, 0.0, 1.3])), 1.0)


def test_the_robust_sigma_of_a_contaminated_sample_is_that_of_the_good_part():
    rng = np.random.default_rng(2)
    sample = rng.normal(0.0, 0.5, 20_000)
    assert robust_sigma(sample) == pytest.approx(0.5, rel=0.03)  # four of its standard errors
    sample[:200] = 1e6
    assert robust_sigma(sample) == pytest.approx(0.5, rel=0.05)


def test_the_sandwich_covers_what_clusters_share():
    rng, errors, claimed = np.random.default_rng(3), [], []
    clusters = np.repeat(np.arange(40), 5)
    design = np.column_stack([np.ones(200), rng.normal(size=40)[clusters]])
    bread = np.linalg.inv(design.T @ design)
    for _ in range(300):
        y = rng.normal(size=40)[clusters] + 0.3 * rng.normal(size=200)
        beta = bread @ design.T @ y
        scores = design * (y - design @ beta)[:, None]
        errors.append(beta)
        claimed.append(sandwich_covariance(bread, scores, clusters, np.zeros((2, 2))))
    spread, promised = np.cov(np.array(errors).T), np.mean(claimed, axis=0)
    # the variance of 300 estimates is known to 8 %, and few clusters bias the sandwich downwards
    np.testing.assert_allclose(np.diag(promised), np.diag(spread), rtol=0.35)
    assert np.all(np.diag(promised) > 3.0 * np.diag(bread) * 1.09 / 2.0)
