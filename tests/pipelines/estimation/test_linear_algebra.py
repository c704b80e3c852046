"""Compiled solvers of small systems against LAPACK."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spheremark.pipelines.errors import DegenerateGeometryError
from spheremark.pipelines.estimation.linear_algebra import (
    eliminate,
    factorise,
    inverse,
    invert,
    invert_each,
    solve,
)


def _positive_definite(seed: int, n: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(n + 3, n)) * 10.0 ** rng.uniform(-2.0, 2.0, n)
    return J.T @ J


@settings(deadline=None)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 24))
def test_the_inverse_is_that_of_lapack(seed, n):
    N = _positive_definite(seed, n)
    expected = np.linalg.inv(N)
    scale = np.sqrt(np.diag(expected))
    found = inverse(N)
    np.testing.assert_array_equal(found, found.T)
    bound = 1e-12 * np.linalg.cond(N * np.outer(scale, scale))
    np.testing.assert_allclose(
        found / np.outer(scale, scale), expected / np.outer(scale, scale), rtol=0, atol=bound
    )


@settings(deadline=None)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 24))
def test_the_solution_meets_the_equations(seed, n):
    N = _positive_definite(seed, n)
    expected = np.random.default_rng(seed + 1).normal(size=n)
    expected /= np.sqrt(np.diag(N))
    b = N @ expected
    assert solve(N.copy(), b)
    scale = np.sqrt(np.diag(N))
    bound = 1e-12 * np.linalg.cond(N / np.outer(scale, scale))
    np.testing.assert_allclose(b * scale, expected * scale, rtol=0, atol=bound)


def test_the_factor_times_its_transpose_is_the_matrix():
    N, root = _positive_definite(3, 7), np.zeros((7, 7))
    assert factorise(N, root)
    np.testing.assert_allclose(root @ root.T, N, rtol=1e-12, atol=1e-12)


def test_a_matrix_may_be_inverted_in_place_and_only_its_lower_triangle_is_read():
    N = _positive_definite(5, 6)
    lower = np.tril(N)
    assert invert(lower, lower)
    np.testing.assert_array_equal(lower, inverse(N))


@pytest.mark.parametrize(
    "N",
    [
        np.zeros((2, 2)),
        np.array([[1.0, 2.0], [2.0, 1.0]]),
        np.array([[4.0, 2.0], [2.0, 1.0]]),
        np.array([[np.nan, 0.0], [0.0, 1.0]]),
    ],
    ids=["zero", "indefinite", "singular", "not a number"],
)
def test_what_is_not_positive_definite_has_no_inverse_and_no_solution(N):
    out, b = np.empty((2, 2)), np.array([1.0, 2.0])
    assert not invert(N, out)
    assert np.isnan(out).all()
    assert np.isnan(inverse(N)).all()
    assert not solve(N.copy(), b)
    np.testing.assert_array_equal(b, [1.0, 2.0])


def test_one_singular_matrix_of_a_stack_spoils_no_other():
    stack = np.stack([_positive_definite(k, 3) for k in range(4)]).reshape(2, 2, 3, 3)
    stack[1, 0] = 1.0
    found, is_regular = invert_each(stack)
    assert is_regular.tolist() == [[True, True], [False, True]]
    assert np.isnan(found[1, 0]).all()
    np.testing.assert_array_equal(found[0, 1], inverse(stack[0, 1]))


@settings(deadline=None)
@given(seed=st.integers(0, 10_000), s=st.integers(1, 5), a=st.integers(1, 6), q=st.integers(0, 7))
def test_elimination_gives_what_the_dense_system_gives(seed, s, a, q):
    rng, n = np.random.default_rng(seed), s * a + q
    locals_of = np.repeat(np.arange(s), a)
    J = rng.normal(size=(4 * n, n))
    J[:, : s * a] *= rng.integers(0, s, 4 * n)[:, None] == locals_of  # each row one set
    N, rhs = J.T @ J + 0.1 * np.eye(n), rng.normal(size=n)
    local = np.array([N[a * k : a * k + a, a * k : a * k + a] for k in range(s)])
    mixed = N[: s * a, s * a :].reshape(s, a, q)
    reduced = eliminate(local, mixed, rhs[: s * a].reshape(s, a), N[s * a :, s * a :], rhs[s * a :])
    dense, expected = np.linalg.inv(N), np.linalg.solve(N, rhs)
    cov = np.linalg.inv(reduced.N)
    np.testing.assert_allclose(cov, dense[s * a :, s * a :], rtol=1e-8, atol=1e-10)
    common = cov @ reduced.rhs
    np.testing.assert_allclose(common, expected[s * a :], rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(
        reduced.local_steps(common).ravel(), expected[: s * a], rtol=1e-8, atol=1e-10
    )
    gains = reduced.gains
    for k, found in enumerate(reduced.own + gains @ cov @ np.swapaxes(gains, 1, 2)):
        own = dense[a * k : a * k + a, a * k : a * k + a]
        np.testing.assert_allclose(found, own, rtol=1e-8, atol=1e-10)


def test_a_set_of_local_unknowns_that_nothing_determines_is_refused():
    with pytest.raises(DegenerateGeometryError, match="1 of 2 sets"):
        eliminate(
            np.stack([np.eye(2), np.ones((2, 2))]),
            np.zeros((2, 2, 1)),
            np.zeros((2, 2)),
            np.eye(1),
            np.zeros(1),
        )
