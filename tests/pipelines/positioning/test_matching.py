from dataclasses import replace
from itertools import combinations
from time import thread_time

import numpy as np
import pytest

from spheremark.pipelines.config import ResectionConfig
from spheremark.pipelines.errors import AmbiguousMatchError, NoMatchError
from spheremark.pipelines.geometry import rigid, rot_z
from spheremark.pipelines.positioning.matching import (
    gather,
    match_marks,
    moved,
    observe,
    solve_poses,
)
from tests.synthetic import control, field, marker_fit, pose, sightings

CONFIG = ResectionConfig()
COV = np.eye(3) * 4e-3**2


@pytest.fixture
def rng():
    return np.random.default_rng(11)


def matched(fits, marks):
    return match_marks(gather(fits, marks, CONFIG), CONFIG).marks


def some_of(marks, chosen):
    return control(marks.p_site[chosen])


def with_fits(fits, *p_base):
    """The fits with false markers after them."""
    return replace(fits, fits=(*fits.fits, *(marker_fit(p, COV) for p in p_base)))


@pytest.mark.parametrize("seed", range(8))
def test_markers_are_matched_whatever_their_order_and_the_heading(seed):
    rng = np.random.default_rng(seed)
    marks = field(rng)
    order = rng.permutation(14)
    T = pose(rng.uniform(-4, 4, 3) * [1, 1, 0.1], rng.uniform(-3, 3), lean=(0.03, -0.06))
    fits = sightings(
        some_of(marks, order), T, lean=(0.03, -0.06), noise=rng.normal(0, 4e-3, (14, 3))
    )
    np.testing.assert_array_equal(matched(fits, marks), order)


def test_false_and_missing_markers_do_not_matter(rng):
    marks = field(rng)
    seen = [1, 2, 5, 8, 9, 12]
    T = pose([1.0, -2.0, 0.8], 2.5)
    fits = sightings(some_of(marks, seen), T, noise=rng.normal(0, 4e-3, (6, 3)))
    false = rng.uniform([-9, -9, -0.5], [9, 9, 0.9], (10, 3))
    np.testing.assert_array_equal(matched(with_fits(fits, *false), marks), [*seen, *[-1] * 10])


def test_an_unlevelled_base_is_matched_too(rng):
    marks = field(rng)
    fits = sightings(marks, pose([1.0, -2.0, 0.8], 2.5, lean=(0.05, 0.04)), sigma_level=0.05)
    np.testing.assert_array_equal(matched(fits, marks), np.arange(14))


def crowd(rng, n):
    """A field of n marks, equally dense for any n; n / 4 are seen among as many false markers."""
    reach = 40.0 * np.sqrt(n / 200)
    marks = control(np.column_stack([rng.uniform(-reach, reach, (n, 2)), rng.uniform(0, 2, n)]))
    seen = rng.permutation(n)[: n // 4]
    fits = sightings(some_of(marks, seen), pose([3.0, 4.0, 1.0], -1.0))
    false = rng.uniform([-reach, -reach, -1], [reach, reach, 1], (n // 4, 3))
    return with_fits(fits, *false), marks, seen


def test_a_hundred_markers_among_two_hundred_marks_are_matched_and_few_false_ones(rng):
    fits, marks, seen = crowd(rng, 200)
    found = matched(fits, marks)
    np.testing.assert_array_equal(found[:50], seen)
    assert np.sum(found[50:] >= 0) <= 1


def test_matching_costs_far_less_than_to_try_all_pairs_of_markers_on_all_pairs_of_marks(rng):
    few, many = crowd(rng, 50)[:2], crowd(rng, 200)[:2]

    def cost(fits, marks):
        start = thread_time()  # of this thread alone: a busy machine changes it little
        matched(fits, marks)
        return thread_time() - start

    cost(*few)  # compiles
    least = np.min([[cost(*few), cost(*many)] for _ in range(5)], axis=0)
    assert least[1] < 4**4 * least[0]  # four times the markers and marks


@pytest.mark.parametrize("seed", range(6))
def test_marks_of_another_field_are_refused(seed):
    rng = np.random.default_rng(seed)
    marks, others = field(rng), field(rng)
    fits = sightings(marks, pose([1.0, -2.0, 0.8], 2.5))
    with pytest.raises(NoMatchError, match="another field"):
        matched(fits, others)


@pytest.mark.parametrize("seed", range(6))
def test_a_mirror_image_does_not_match(seed):
    marks = field(np.random.default_rng(seed))
    fits = sightings(marks, pose([1.0, -2.0, 0.8], 2.5))
    with pytest.raises(NoMatchError):
        matched(fits, control(marks.p_site * [-1, 1, 1]))


def test_a_field_upside_down_does_not_match(rng):
    marks = field(rng)
    fits = sightings(marks, pose([1.0, -2.0, 0.8], 2.5))
    with pytest.raises(NoMatchError):
        matched(fits, control(marks.p_site * [1, -1, -1]))


def test_distances_that_nothing_shares_are_refused():
    fits = sightings(control([[5, 0, 1], [-3, 1, 1.4]]), pose([0, 0, 0.8], 0.3))
    with pytest.raises(NoMatchError, match="No two of the 2 markers"):
        matched(fits, control([[0, 0, 0], [30, 0, 0], [0, 50, 0]]))


@pytest.mark.parametrize("n", [3, 4, 6])
def test_a_symmetric_field_is_ambiguous(n):
    angle = np.arange(n) * 2 * np.pi / n
    marks = control(np.stack([8 * np.cos(angle), 8 * np.sin(angle), np.ones(n)], axis=1))
    fits = sightings(marks, pose([1.0, 0.5, 0.8], 2.5))
    with pytest.raises(AmbiguousMatchError, match="symmetric"):
        matched(fits, marks)


def test_a_field_that_is_symmetric_but_for_one_mark_is_not_ambiguous():
    angle = np.arange(6) * 2 * np.pi / 6
    ring = np.stack([8 * np.cos(angle), 8 * np.sin(angle), np.ones(6)], axis=1)
    marks = control(np.vstack([ring, [5.0, 1.0, 1.5]]))
    fits = sightings(marks, pose([1.0, 0.5, 0.8], 2.5))
    np.testing.assert_array_equal(matched(fits, marks), np.arange(7))


def test_two_marks_at_one_height_can_be_swapped_and_the_other_place_is_named():
    marks, place = control([[6, 0, 1], [-5, 2, 1]]), np.array([0.5, 1.0, 0.8])
    scene = gather(sightings(marks, pose(place, 1.0)), marks, CONFIG)
    match = match_marks(scene, CONFIG)
    places = np.vstack([match.T_site_base[:3, 3], match.alternatives]) + scene.middle
    swapped = 2 * np.array([0.5, 1.0, 1.0]) - place  # half a turn about the middle of the marks
    swapped[2] = place[2]
    for expected in (place, swapped):
        assert np.linalg.norm(places - expected, axis=1).min() < 1e-6
    assert len(places) == 2


def test_two_marks_of_different_height_are_told_apart_by_gravity():
    marks = control([[6, 0, 0.7], [-5, 2, 1.4]])
    fits = sightings(marks, pose([0.5, 1.0, 0.8], 1.0))
    np.testing.assert_array_equal(matched(fits, marks), [0, 1])


@pytest.mark.parametrize("seed", range(5))
def test_two_marks_are_found_among_many_markers(seed):
    rng = np.random.default_rng(seed)
    everything = field(rng)
    p = everything.p_site
    apart = np.triu(np.abs(p[:, None, 2] - p[None, :, 2]), 1)
    i, j = np.unravel_index(np.argmax(apart), apart.shape)
    noise = rng.normal(0, 4e-3, (len(p), 3))
    fits = sightings(everything, pose([0.5, 1.0, 0.8], 1.0), noise=noise)
    found = matched(fits, control(p[[i, j]]))
    assert (found[i], found[j]) == (0, 1)
    assert np.sum(found >= 0) == 2


def test_a_mark_goes_to_the_nearer_of_two_markers(rng):
    marks = field(rng)
    fits = sightings(marks, pose([1.0, -2.0, 0.8], 2.5))
    double = fits.fits[3].p_base + np.array([0.05, 0.05, 0.0])
    np.testing.assert_array_equal(matched(with_fits(fits, double), marks), [*range(14), -1])


@pytest.mark.parametrize("seed", range(5))
def test_derivatives_of_the_observations_are_right(seed):
    rng = np.random.default_rng(seed)
    marks = field(rng)
    lean = tuple(rng.uniform(-0.3, 0.3, 2))
    T = pose(rng.uniform(-4, 4, 3), rng.uniform(-3, 3), lean=lean)
    scene = gather(sightings(marks, T, lean=lean), marks, CONFIG)
    pairs = np.stack([np.arange(14), rng.permutation(14)], axis=1)
    state = moved(T, rng.normal(0, 0.1, 6))
    h = 1e-6
    for k, step in enumerate(h * np.eye(6)):
        ahead, behind = (
            observe(scene, pairs, moved(state, step)),
            observe(scene, pairs, moved(state, -step)),
        )
        here = observe(scene, pairs, state)
        for group, plus, minus in zip(here, ahead, behind, strict=True):
            change = (plus.residuals - minus.residuals) / (2 * h)
            np.testing.assert_allclose(group.J[..., k], change, rtol=0, atol=1e-8)


def test_the_covariance_of_gravity_is_that_of_roll_and_pitch():
    lean, h = (0.4, -0.3), 1e-6
    marks = control([[6, 0, 0.7], [-5, 2, 1.4]])
    T = pose([0.5, 1.0, 0.8], 1.0, lean=lean)
    pairs = np.array([[0, 0], [1, 1]])

    def up(roll, pitch):
        scene = gather(sightings(marks, T, lean=(roll, pitch), sigma_level=2e-3), marks, CONFIG)
        return observe(scene, pairs, T)[1]

    columns = [
        (up(lean[0] + h, lean[1]).residuals - up(lean[0] - h, lean[1]).residuals) / (2 * h),
        (up(lean[0], lean[1] + h).residuals - up(lean[0], lean[1] - h).residuals) / (2 * h),
    ]
    J = np.stack([column[0] for column in columns], axis=1)
    np.testing.assert_allclose(up(*lean).cov[0], 2e-3**2 * J @ J.T, rtol=1e-6)


def _scene_of(rng, n=8):
    """A scene whose marks are their markers' in turn, and a pose near the truth."""
    lean = (0.06, -0.04)
    marks, T = field(rng, n), pose((0.7, -1.2, 0.4), 2.2, lean)
    fits = sightings(marks, T, lean=lean, noise=rng.normal(0, 4e-3, (n, 3)))
    scene = gather(fits, marks, ResectionConfig())
    start = T @ rigid(scene.R_station_base @ rot_z(0.02), [0.05, -0.03, 0.02])
    start[:3, 3] -= scene.middle
    return scene, start


def test_many_poses_at_once_are_those_of_each_alone(rng):
    scene, start = _scene_of(rng)
    chosen = np.array(list(combinations(range(8), 5)))
    pairs = np.stack([chosen, chosen], axis=2)
    found = solve_poses(scene, pairs, start)
    assert found.is_settled.all()
    for one, T, cov in zip(pairs, found.estimates, found.covs, strict=True):
        alone = solve_poses(scene, one[None], start)
        np.testing.assert_allclose(T, alone.estimates[0], rtol=0, atol=1e-9)
        np.testing.assert_allclose(cov, alone.covs[0], rtol=1e-6, atol=1e-14)


def test_a_mark_that_is_no_number_spoils_no_other_pose(rng):
    scene, start = _scene_of(rng)
    chosen = np.array([[0, 1, 2], [1, 2, 3], [3, 4, 5]])
    pairs, spoilt = np.stack([chosen, chosen], axis=2), scene.marks_site.copy()
    spoilt[0] = np.nan
    found = solve_poses(replace(scene, marks_site=spoilt), pairs, start)
    assert found.is_settled.tolist() == [False, True, True]
    alone = solve_poses(scene, pairs[1:], start)
    np.testing.assert_allclose(found.estimates[1:], alone.estimates, rtol=0, atol=1e-12)
