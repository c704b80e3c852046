import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2, norm

from spheremark.pipelines.errors import (
    DegenerateGeometryError,
    NotConvergedError,
    TooFewObservationsError,
)
from spheremark.pipelines.estimation.least_squares import Observations, adjust, solve, solve_each
from spheremark.pipelines.estimation.statistical_tests import snoop
from tests import chance

LEVELS = {"test_level": 0.001, "test_power": 0.80}


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def covariances(rng, k, m):
    roots = rng.normal(size=(k, m, m))
    return roots @ np.swapaxes(roots, 1, 2) + 0.1 * np.eye(m)


def line(rng, n=12, noise=1.0):
    """Straight line through n correlated pairs of readings: linear, two unknowns."""
    design = np.stack([np.ones(2 * n), np.linspace(-1, 1, 2 * n)], axis=1).reshape(n, 2, 2)
    cov = covariances(rng, n, 2)
    errors = np.stack([rng.multivariate_normal(np.zeros(2), Q) for Q in cov])
    return design, design @ [3.0, -2.0] + noise * errors, cov


def linear(design, readings, cov):
    def linearise(x):
        # computed = design x, so residual = reading - design x
        return (Observations(residuals=readings - design @ x, J=-design, cov=cov),)

    return linearise


def add(x, step):
    return x + step


def dense(design, readings, cov):
    """The textbook: one big design matrix, one big covariance, written out."""
    n, m, p = design.shape
    full = np.zeros((n * m, n * m))
    for k in range(n):
        full[m * k : m * k + m, m * k : m * k + m] = cov[k]
    weights = np.linalg.inv(full)
    design, y = design.reshape(-1, p), readings.ravel()
    cov_x = np.linalg.inv(design.T @ weights @ design)
    x = cov_x @ design.T @ weights @ y
    v = y - design @ x
    return x, cov_x, v, weights, full - design @ cov_x @ design.T


def test_estimate_and_statistics_are_those_of_the_textbook(rng):
    problem = line(rng)
    result = adjust(linear(*problem), add, np.zeros(2), **LEVELS)
    x, cov_x, v, weights, cov_v = dense(*problem)
    np.testing.assert_allclose(result.estimate, x, rtol=1e-9)
    np.testing.assert_allclose(result.cov, cov_x, rtol=1e-9)
    assert result.dof == 22
    assert result.vtpv == pytest.approx(v @ weights @ v)
    assert result.sigma0 == pytest.approx(np.sqrt(v @ weights @ v / 22))
    assert result.passes_global_test == (chi2.sf(v @ weights @ v, 22) >= 0.001)
    np.testing.assert_allclose(
        result.redundancies, np.diag(cov_v @ weights).reshape(-1, 2).sum(axis=1), rtol=1e-8
    )
    tested = weights @ cov_v @ weights
    w = np.abs(weights @ v) / np.sqrt(np.diag(tested))
    np.testing.assert_allclose(result.w_statistics, w.reshape(-1, 2).max(axis=1), rtol=1e-8)
    assert result.noncentrality**2 == pytest.approx(17.07, abs=0.01)  # Baarda's table
    for k in range(12):
        weakest = np.linalg.eigvalsh(tested[2 * k : 2 * k + 2, 2 * k : 2 * k + 2])[0]
        assert result.detectable_biases[k] == pytest.approx(np.sqrt(17.075 / weakest), rel=1e-3)


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 10_000), n=st.integers(3, 30))
def test_redundancies_add_up_to_the_degrees_of_freedom(seed, n):
    rng = np.random.default_rng(seed)
    result = adjust(linear(*line(rng, n)), add, np.zeros(2), **LEVELS)
    assert result.redundancies.sum() == pytest.approx(result.dof)


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 10_000), n=st.integers(3, 30))
def test_scaling_all_sigmas_scales_the_covariance_by_the_square(seed, n):
    rng = np.random.default_rng(seed)
    design, readings, cov = line(rng, n)
    one = adjust(linear(design, readings, cov), add, np.zeros(2), **LEVELS)
    ten = adjust(linear(design, readings, 100 * cov), add, np.zeros(2), **LEVELS)
    np.testing.assert_allclose(ten.estimate, one.estimate, rtol=1e-9)
    np.testing.assert_allclose(ten.cov, 100 * one.cov, rtol=1e-9)
    assert ten.sigma0 == pytest.approx(one.sigma0 / 10)


def test_no_unseen_bias_moves_the_estimate_farther_than_external_reliability_says(rng):
    design, readings, cov = line(rng, noise=0.0)
    result = adjust(linear(design, readings, cov), add, np.zeros(2), **LEVELS)
    limits = result.external_reliabilities(np.eye(2))
    _, _, _, weights, cov_v = dense(design, readings, cov)
    tested = weights @ cov_v @ weights
    for k in range(12):
        block = tested[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]
        shifts = []
        for turn in np.linspace(0, np.pi, 181):
            direction = np.array([np.cos(turn), np.sin(turn)])
            bias = direction * result.noncentrality / np.sqrt(direction @ block @ direction)
            wrong = readings.copy()
            wrong[k] += bias
            x, *_ = dense(design, wrong, cov)
            shifts.append(np.linalg.norm(x - result.estimate))
        assert max(shifts) == pytest.approx(limits[k], rel=2e-3)
        assert max(shifts) <= limits[k] * (1 + 1e-9)


@pytest.mark.slow
def test_the_detectable_bias_is_found_with_the_promised_power(rng):
    design, _, cov = line(rng)
    found = 0
    trials = 3000
    for _ in range(trials):
        errors = np.stack([rng.multivariate_normal(np.zeros(2), Q) for Q in cov])
        readings = design @ [3.0, -2.0] + errors
        result = adjust(linear(design, readings, cov), add, np.zeros(2), **LEVELS)
        _, _, _, weights, cov_v = dense(design, readings, cov)
        values, vectors = np.linalg.eigh((weights @ cov_v @ weights)[:2, :2])
        readings[0] += vectors[:, 0] * result.detectable_biases[0]
        _, _, v, _, _ = dense(design, readings, cov)
        w = vectors[:, 0] @ (weights @ v)[:2] / np.sqrt(values[0])
        found += abs(w) > norm.ppf(0.9995)
    assert found / trials == pytest.approx(0.80, abs=0.03)


def test_global_test_and_w_tests_reject_good_data_at_their_level(rng):
    design, _, cov = line(rng)
    levels = {"test_level": 0.05, "test_power": 0.8}
    roots = np.linalg.cholesky(cov)
    results = []
    for _ in range(600):
        errors = np.einsum("kij,kj->ki", roots, rng.normal(size=(12, 2)))
        results.append(adjust(linear(design, errors, cov), add, np.zeros(2), **levels))
    low, high = chance.of_share(0.05, len(results))
    assert low <= np.mean([not r.passes_global_test for r in results]) <= high
    # the larger of two tests at 5 % that are anything between the same and independent
    exceeded = np.mean([r.w_statistics > r.critical_w for r in results], axis=1)
    slack = chance.of_mean(exceeded)
    assert slack < 0.02
    assert 0.05 - slack < np.mean(exceeded) < 1 - 0.95**2 + slack


def test_an_observation_without_redundancy_is_said_to_be_untestable():
    design = np.array([[[1.0, 0.0]], [[1.0, 0.0]], [[0.0, 1.0]]])
    readings = np.array([[1.0], [1.1], [5.0]])
    result = adjust(linear(design, readings, np.ones((3, 1, 1))), add, np.zeros(2), **LEVELS)
    np.testing.assert_allclose(result.redundancies, [0.5, 0.5, 0.0], atol=1e-12)
    assert np.isnan(result.w_statistics[2])
    assert np.isinf(result.detectable_biases[2])
    assert np.isinf(result.external_reliabilities(np.eye(2))[2])
    assert np.all(np.isfinite(result.detectable_biases[:2]))


def test_without_redundancy_nothing_is_tested():
    design, readings = np.eye(2)[:, None], np.array([[1.0], [2.0]])
    result = adjust(linear(design, readings, np.ones((2, 1, 1))), add, np.zeros(2), **LEVELS)
    np.testing.assert_allclose(result.estimate, [1, 2])
    assert result.dof == 0
    assert result.passes_global_test
    assert np.isnan(result.sigma0)


def test_many_problems_are_solved_at_once_as_one_by_one(rng):
    problems = [line(rng) for _ in range(5)]
    design, readings, cov = (np.stack(part) for part in zip(*problems, strict=True))

    def linearise(x, rows):
        residuals = readings[rows] - np.einsum("bkmp,bp->bkm", design[rows], x)
        return (Observations(residuals=residuals, J=-design[rows], cov=cov[rows]),)

    together = solve_each(linearise, add, np.zeros((5, 2)))
    assert together.is_settled.all()
    for k, problem in enumerate(problems):
        x, cov_x, *_ = dense(*problem)
        np.testing.assert_allclose(together.estimates[k], x, rtol=1e-9)
        np.testing.assert_allclose(together.covs[k], cov_x, rtol=1e-9)


def test_a_problem_without_a_solution_spoils_no_other(rng):
    problems = [line(rng) for _ in range(4)]
    design, readings, cov = (np.stack(part) for part in zip(*problems, strict=True))
    readings[0, 0], design[2, ..., 1] = np.nan, design[2, ..., 0]

    def linearise(x, rows):
        residuals = readings[rows] - np.einsum("bkmp,bp->bkm", design[rows], x)
        return (Observations(residuals=residuals, J=-design[rows], cov=cov[rows]),)

    found = solve_each(linearise, add, np.zeros((4, 2)))
    assert found.is_settled.tolist() == [False, True, False, True]
    assert np.isnan(found.covs[2]).all()
    for k in (1, 3):
        np.testing.assert_allclose(found.estimates[k], dense(*problems[k])[0], rtol=1e-9)


def test_a_curved_problem_is_solved_from_afar():
    towers = np.array([[0.0, 0.0], [10.0, 0.0], [3.0, 9.0]])
    truth = np.array([4.0, 3.0])
    ranges = np.linalg.norm(towers - truth, axis=1)

    def linearise(p):
        v = p - towers
        computed = np.linalg.norm(v, axis=1)
        J = -(v / computed[:, None])[:, None, :]
        return (
            Observations(residuals=(ranges - computed)[:, None], J=J, cov=np.full((3, 1, 1), 1e-4)),
        )

    result = adjust(linearise, add, np.array([8.0, 8.0]), **LEVELS)
    np.testing.assert_allclose(result.estimate, truth, rtol=0, atol=1e-9)


def test_snooping_finds_the_bad_ones_and_keeps_the_good(rng):
    design, readings, cov = line(rng, n=20)
    readings[4] += 30 * np.sqrt(np.diagonal(cov[4]))
    readings[11] -= 20 * np.sqrt(np.diagonal(cov[11]))
    levels = LEVELS | {"test_level": 1e-6}  # 40 good readings: one is dropped once in 25,000 runs

    def kept(keep):
        return adjust(linear(design[keep], readings[keep], cov[keep]), add, np.zeros(2), **levels)

    result, keep, dropped = snoop(kept, 20, lambda _keep, _block: True)
    assert {block for block, _ in dropped} == {4, 11}
    assert all(w > result.critical_w for _, w in dropped)
    np.testing.assert_array_equal(np.flatnonzero(~keep), [4, 11])
    assert result.passes_global_test


def test_a_good_reading_that_bad_ones_made_look_bad_is_taken_back():
    n, bad = 8, [0, 1, 3]
    design = np.stack([np.ones(n), np.linspace(0.0, 1.0, n)], axis=1)[:, None]
    readings, cov = design @ np.array([1.0, 2.0]), np.full((n, 1, 1), 1e-4)
    readings[bad, 0] += [-0.8, 0.5, 0.5]
    tried = []

    def kept(keep):
        tried.append(set(np.flatnonzero(~keep)))
        return adjust(linear(design[keep], readings[keep], cov[keep]), add, np.zeros(2), **LEVELS)

    result, keep, dropped = snoop(kept, n, lambda _keep, _block: True)
    assert {0, 1, 2, 3} in tried  # the third, good one was out in between
    assert sorted(block for block, _ in dropped) == bad
    np.testing.assert_array_equal(np.flatnonzero(~keep), bad)
    np.testing.assert_allclose(result.estimate, [1.0, 2.0], atol=1e-9)


def test_snooping_keeps_what_may_not_be_dropped(rng):
    design, readings, cov = line(rng, n=6)
    readings[2] += 100

    def kept(keep):
        return adjust(linear(design[keep], readings[keep], cov[keep]), add, np.zeros(2), **LEVELS)

    result, keep, dropped = snoop(kept, 6, lambda _keep, _block: False)
    assert keep.all()
    assert dropped == ()
    assert not result.passes_global_test


def test_an_unknown_that_nothing_touches_is_refused():
    design = np.array([[[1.0, 0.0]], [[1.0, 0.0]]])
    with pytest.raises(DegenerateGeometryError, match="touch"):
        adjust(linear(design, np.ones((2, 1)), np.ones((2, 1, 1))), add, np.zeros(2), **LEVELS)


def test_unknowns_that_cannot_be_told_apart_are_refused():
    design = np.array([[[1.0, 1.0]], [[2.0, 2.0]], [[3.0, 3.0]]])
    with pytest.raises(DegenerateGeometryError, match="undetermined"):
        adjust(linear(design, np.ones((3, 1)), np.ones((3, 1, 1))), add, np.zeros(2), **LEVELS)


def test_fewer_observations_than_unknowns_are_refused(rng):
    design = rng.normal(size=(1, 1, 2))
    with pytest.raises(TooFewObservationsError, match="1 observations cannot determine 2"):
        adjust(linear(design, np.ones((1, 1)), np.ones((1, 1, 1))), add, np.zeros(2), **LEVELS)


def test_steps_that_do_not_settle_are_refused():
    def linearise(x):
        root = np.sign(x) * np.sqrt(np.abs(x))  # Newton's steps jump between -x and x
        slope = 0.5 / np.sqrt(np.abs(x))
        return (Observations(residuals=root[None], J=slope[None, :, None], cov=np.eye(1)[None]),)

    with pytest.raises(NotConvergedError, match="50 steps"):
        solve(linearise, add, np.array([1.0]))


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 10_000), n=st.integers(3, 30))
def test_the_w_statistic_is_the_jump_of_the_fit_when_the_reading_is_left_out(seed, n):
    rng = np.random.default_rng(seed)
    design, readings, cov = line(rng, n)
    design, readings = design.reshape(-1, 1, 2), readings.reshape(-1, 1)
    cov = np.diagonal(cov, axis1=1, axis2=2).reshape(-1, 1, 1)
    result = adjust(linear(design, readings, cov), add, np.zeros(2), **LEVELS)
    for k in range(len(readings)):
        rest = np.arange(len(readings)) != k
        x, cov_x, *_ = dense(design[rest], readings[rest], cov[rest])
        off = (readings[k] - design[k] @ x) / np.sqrt(cov[k, 0] + design[k] @ cov_x @ design[k].T)
        assert result.w_statistics[k] == pytest.approx(abs(off.item()), rel=1e-8)


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 10_000), n=st.integers(3, 30))
def test_the_order_of_the_observations_does_not_matter(seed, n):
    rng = np.random.default_rng(seed)
    design, readings, cov = line(rng, n)
    order = rng.permutation(len(readings))
    one = adjust(linear(design, readings, cov), add, np.zeros(2), **LEVELS)
    other = adjust(linear(design[order], readings[order], cov[order]), add, np.zeros(2), **LEVELS)
    np.testing.assert_allclose(other.estimate, one.estimate, rtol=1e-9)
    np.testing.assert_allclose(other.cov, one.cov, rtol=1e-9)
    np.testing.assert_allclose(other.w_statistics, one.w_statistics[order], rtol=1e-7)
