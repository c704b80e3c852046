"""Positions from distances, beside the free station."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from spheremark.pipelines.config import ResectionConfig
from spheremark.pipelines.errors import DegenerateGeometryError
from spheremark.pipelines.geometry import inverse, levelling_rotation, log_motion, rigid, unit
from spheremark.pipelines.positioning.resection import resect
from spheremark.pipelines.positioning.trilateration import (
    best_three,
    circles,
    meet,
    slope_ranges,
)
from tests import chance
from tests.synthetic import control, field, pose, sightings

EXACT = 1e-7  # [m] and [rad] noise-free in, truth out
CONFIG = ResectionConfig(
    sigma_common=0.0, sigma_range=0.0, sigma_range_shared=0.0, sigma_height=0.0
)
LEAN = (0.06, -0.04)
METHODS = ("ranges", "paper")


@pytest.fixture
def rng():
    return np.random.default_rng(19)


def tall(rng, n=8):
    """Marks whose heights differ enough for slope distances to tell a height."""
    marks = field(rng, n)
    p = marks.p_site.copy()
    p[:, 2] = rng.uniform(0.0, 5.0, n)
    return control(p)


@pytest.mark.parametrize("measure", [slope_ranges, circles])
def test_derivatives_agree_with_differences(rng, measure):
    v, h = rng.uniform(1, 9, (6, 3)), 1e-6
    _, J = measure(v)
    for k in range(3):
        d = h * np.eye(3)[k]
        numeric = (measure(v + d)[0] - measure(v - d)[0]) / (2 * h)
        np.testing.assert_allclose(J[..., k], numeric, rtol=0, atol=1e-8)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("middle", [(0, 0, 0), (431_250.0, 5_412_800.0, 312.0)])
def test_noise_free_distances_give_the_true_pose(rng, method, middle):
    marks = field(rng, middle=middle)
    T = pose(np.add(middle, [1.0, -2.0, 0.8]), 2.2, LEAN)
    fix = resect(method, sightings(marks, T, lean=LEAN), marks, CONFIG)
    np.testing.assert_allclose(fix.p_site, T[:3, 3], rtol=0, atol=EXACT)
    assert fix.yaw == pytest.approx(2.2, abs=EXACT)
    np.testing.assert_allclose(fix.residuals_site, 0, atol=EXACT)
    assert fix.method == method
    assert len(fix.matches) == (3 if method == "paper" else 14)
    assert len(fix.matches) + len(fix.excluded) == 14


@pytest.mark.parametrize("method", METHODS)
def test_the_covariance_of_the_pose_is_honest(rng, method):
    marks = tall(rng)
    root = rng.normal(0, 3e-3, (8, 3, 3)) + 4e-3 * np.eye(3)
    root_marks = np.tile(np.diag([2e-3, 1e-3, 3e-3]), (8, 1, 1))
    errors = []
    for _ in range(500):
        lean = rng.uniform(-0.05, 0.05, 2)
        T = pose([0.5, -1.0, 1.5], rng.uniform(-3, 3), lean)
        measured = tuple(lean + rng.normal(0, 3e-3, 2))
        fits = sightings(
            marks, T, lean=measured, cov=root @ np.swapaxes(root, 1, 2),
            noise=np.einsum("nij,nj->ni", root, rng.normal(size=(8, 3))),
        )  # fmt: skip
        off = np.einsum("nij,nj->ni", root_marks, rng.normal(size=(8, 3)))
        given = replace(
            marks, p_site=marks.p_site + off, cov_p_site=root_marks @ np.swapaxes(root_marks, 1, 2)
        )
        fix = resect(method, fits, given, replace(CONFIG, test_level=1e-6))
        true = T @ inverse(rigid(levelling_rotation(fits.levelling), np.zeros(3)))
        xi = log_motion(true @ inverse(fix.T_site_station))
        errors.append(np.linalg.solve(np.linalg.cholesky(fix.cov_T_site_station), xi))
    errors = np.array(errors)
    eigenvalues = np.linalg.eigvalsh(errors.T @ errors / len(errors))
    least, greatest = chance.of_eigenvalues(*errors.shape)  # 0.69 and 1.39
    assert least < eigenvalues[0]
    assert eigenvalues[-1] < greatest


@pytest.mark.parametrize("method", METHODS)
def test_errors_that_all_distances_share_are_in_the_covariance_as_shared(rng, method):
    bias, height, own = 2e-3, 5e-4, 2e-3  # [m]
    config = replace(
        CONFIG, sigma_range=bias, sigma_range_shared=bias, sigma_height=height, test_level=1e-6
    )
    marks, squares = field(rng, 8), []
    for _ in range(400):
        T = pose([0.5, -0.4, -0.2], rng.uniform(-3, 3))
        towards = (marks.p_site - T[:3, 3]) @ T[:3, :3]
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        cov = own**2 * np.eye(3) + bias**2 * towards[:, :, None] * towards[:, None, :]
        noise = rng.normal(0, own, (8, 3)) + rng.normal(0, bias) * towards
        noise[:, 2] += rng.normal(0, height)
        fits = sightings(
            marks, T, lean=tuple(rng.normal(0, 1e-4, 2)), sigma_level=1e-4, cov=cov, noise=noise
        )
        fix = resect(method, fits, marks, config)
        off, known = fix.p_site - T[:3, 3], fix.cov_p_site
        squares.append([np.sum(off[:2] ** 2) / np.trace(known[:2, :2]), off[2] ** 2 / known[2, 2]])
    slack = chance.of_mean(squares)
    assert np.all(slack < 0.4)
    assert np.all(np.abs(np.mean(squares, axis=0) - 1.0) < slack)


def test_a_gross_error_in_a_distance_is_found_and_named(rng):
    marks = tall(rng)
    T = pose([0.5, -1.0, 1.5], 0.3)
    fits = sightings(marks, T, noise=rng.normal(0, 4e-3, (8, 3)))
    bad = fits.fits[2].p_base
    bad = replace(fits.fits[2], p_base=bad * (1 + 0.06 / np.linalg.norm(bad)))
    spoiled = replace(fits, fits=(*fits.fits[:2], bad, *fits.fits[3:]))
    (out,) = resect("ranges", spoiled, marks, CONFIG).excluded
    assert out.fit == 2
    assert "distance to mark C" in out.reason


def test_distances_to_marks_in_one_plane_with_the_station_leave_its_height_weak(rng):
    p = field(rng, 6).p_site.copy()
    p[:, 2] = 0.8 + 0.02 * np.sin(np.arange(6.0))
    marks = control(p)
    fits = sightings(marks, pose([1.0, -2.0, 0.5], 0.3))
    fix = resect("ranges", fits, marks, CONFIG)
    assert fix.status == "weak" or fix.cov_p_site[2, 2] > 25 * fix.cov_p_site[0, 0]


def test_distances_that_tell_no_height_at_all_are_refused_with_the_reason():
    p = np.array([[6.0, 4.0, 0.9], [-6.0, 5.0, 0.9], [-3.0, -6.0, 0.9], [6.5, -3.0, 0.9]])
    marks = control(p)
    T = pose([0.0, 0.0, 1.0], 0.3)
    seen = (p - T[:3, 3]) @ T[:3, :3]
    shorter = -6e-3 * seen / np.linalg.norm(seen, axis=1, keepdims=True)  # than from any height
    fits = sightings(marks, T, noise=shorter)
    with pytest.raises(DegenerateGeometryError, match=r"leave the height open.*free_station"):
        resect("ranges", fits, marks, CONFIG)


@pytest.mark.parametrize("method", METHODS)
def test_marks_on_a_line_are_weak_because_of_the_position_on_the_other_side(method):
    marks = control([[-6.0, 6.0, 0.9], [-3.5, 6.0, 0.9], [1.2, 6.0, 0.9], [6.5, 6.05, 0.9]])
    T = pose([0.0, 0.0, 2.0], 0.3)
    fix = resect(method, sightings(marks, T), marks, CONFIG)
    assert fix.status == "weak"
    assert "on the other side of it the distances are the same" in fix.reason
    assert fix.p_site[1] == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize("method", METHODS)
def test_two_marks_are_refused(method):
    marks = control([[6.9, 1.1, 0.6], [-3.9, 7.1, 1.5]])
    fits = sightings(marks, pose([0, 0, 0.8], 0.3))
    with pytest.raises(DegenerateGeometryError, match="three are needed"):
        resect(method, fits, marks, CONFIG)


def test_a_mark_that_is_no_number_spoils_no_other_station(rng):
    marks, start = rng.uniform(-6, 6, (8, 3)), np.array([0.3, -0.2, 0.1])
    distances = np.linalg.norm(marks, axis=1)[:, None]
    spoilt = marks.copy()
    spoilt[0] = np.nan
    chosen = np.array([[0, 1, 2, 3], [1, 2, 3, 4], [3, 4, 5, 6]])
    found = meet(chosen, spoilt, distances, np.full((8, 1, 1), 1e4), start)
    assert found.is_settled.tolist() == [False, True, True]
    np.testing.assert_allclose(found.p[1:], 0.0, rtol=0, atol=1e-6)


def test_circles_that_miss_each_other_are_met_where_the_sum_of_squares_is_least():
    headings = np.radians([[0.0, 1.0, 180.5], [10.0, 130.0, 250.0]])
    marks = 5.0 * np.stack([np.cos(headings), np.sin(headings), 0.0 * headings], axis=2)
    marks = marks.reshape(-1, 3)
    measured = np.stack([np.full(6, 4.7), np.zeros(6)], axis=1)
    chosen, weights = np.arange(6).reshape(2, 3), np.tile(np.eye(2), (6, 1, 1))
    found = meet(chosen, marks, measured, weights, np.zeros(3))
    for p, three in zip(found.p, chosen, strict=True):
        squares = [
            np.sum((np.linalg.norm(marks[three, :2] - p[:2] - d, axis=1) - 4.7) ** 2)
            for d in ([0.0, 0.0], [1e-4, 0.0], [-1e-4, 0.0], [0.0, 1e-4], [0.0, -1e-4])
        ]
        assert np.argmin(squares) == 0


@pytest.mark.parametrize("window", [(-1.0, 1.0), (-0.9, 0.9)])
def test_the_best_three_have_the_least_cofactor_of_all_in_the_window(rng, window):
    lines, three = unit(rng.normal(size=(9, 2))), np.zeros(3, dtype=np.intp)
    spread, is_inside = best_three(lines, *window, three)
    traces = {}
    for triple in combinations(range(9), 3):
        J = lines[list(triple)]
        cosines = [J[i] @ J[j] for i, j in combinations(range(3), 2)]
        if window[0] <= min(cosines) and max(cosines) <= window[1]:
            traces[triple] = np.trace(np.linalg.inv(J.T @ J))
    assert is_inside
    assert tuple(three) == min(traces, key=traces.get)
    assert spread == pytest.approx(min(traces.values()))


def test_without_three_in_the_window_the_best_of_all_are_taken():
    lines, three = unit(np.array([[1.0, 0.0], [1.0, 0.1], [1.0, -0.1]])), np.zeros(3, np.intp)
    _, is_inside = best_three(lines, -0.5, 0.5, three)
    assert not is_inside
    assert tuple(three) == (0, 1, 2)
