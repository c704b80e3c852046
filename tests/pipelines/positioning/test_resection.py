from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from spheremark.pipelines.config import ResectionConfig
from spheremark.pipelines.errors import ConfigError, DegenerateGeometryError, NoMarkersError
from spheremark.pipelines.geometry import inverse, levelling_rotation, log_motion, rigid
from spheremark.pipelines.model import Levelling, Status
from spheremark.pipelines.positioning.resection import resect
from tests import chance
from tests.synthetic import control, field, lean_matrix, marker_fit, pose, sightings, turn_z

EXACT = 1e-7  # [m] and [rad] noise-free in, truth out
CONFIG = ResectionConfig(sigma_range=0.0, sigma_range_shared=0.0, sigma_height=0.0)
LEAN = (0.06, -0.04)
STAND = (1.0, -2.0, 0.8)


@pytest.fixture
def rng():
    return np.random.default_rng(31)


def station(T_site_base, levelling):
    """The true pose of the measured station frame."""
    return T_site_base @ inverse(rigid(levelling_rotation(levelling), np.zeros(3)))


def free(fits, marks, config=CONFIG):
    return resect("free_station", fits, marks, config)


@pytest.mark.parametrize("middle", [(0, 0, 0), (431_250.0, 5_412_800.0, 312.0)])
def test_noise_free_centres_give_the_true_pose(rng, middle):
    marks = field(rng, middle=middle)
    T = pose(np.array(middle) + STAND, 2.2, LEAN)
    fits = sightings(marks, T, lean=LEAN)
    fix = free(fits, marks)
    np.testing.assert_allclose(fix.p_site, T[:3, 3], rtol=0, atol=EXACT)
    np.testing.assert_allclose(
        fix.T_site_station[:3, :3], turn_z(np.array(2.2)), rtol=0, atol=EXACT
    )
    np.testing.assert_allclose(fix.residuals_site, 0, atol=EXACT)
    assert fix.status is Status.OK
    assert fix.dof == 3 * 14 + 2 - 6
    assert fix.redundancies.sum() < fix.dof  # gravity has the rest
    assert fix.sigma_3d < 4e-3


def test_residuals_are_observed_minus_computed_in_the_site(rng):
    marks = field(rng)
    T = pose(STAND, 2.2, LEAN)
    fits = sightings(marks, T, lean=LEAN, noise=rng.normal(0, 4e-3, (14, 3)))
    fix = free(fits, marks)
    T_site_base = fix.T_site_station @ rigid(lean_matrix(*LEAN), np.zeros(3))
    for (fit, mark), residual in zip(fix.matches, fix.residuals_site, strict=True):
        p_site = T_site_base[:3, :3] @ fits.fits[fit].p_base + T_site_base[:3, 3]
        np.testing.assert_allclose(residual, p_site - marks.p_site[mark], rtol=0, atol=1e-9)


moves = st.tuples(st.floats(-3, 3), *[st.floats(-1000, 1000)] * 3)


@settings(max_examples=15, deadline=None)
@given(move=moves, seed=st.integers(0, 50))
def test_moving_the_world_moves_the_answer_and_nothing_else(move, seed):
    rng = np.random.default_rng(seed)
    marks = field(rng)
    fits = sightings(marks, pose(STAND, 2.2), noise=rng.normal(0, 4e-3, (14, 3)))
    shift = pose(move[1:], move[0])
    elsewhere = control(marks.p_site @ shift[:3, :3].T + shift[:3, 3])
    here, there = free(fits, marks), free(fits, elsewhere)
    np.testing.assert_allclose(there.T_site_station, shift @ here.T_site_station, rtol=0, atol=1e-7)
    np.testing.assert_allclose(
        there.cov_p_site, shift[:3, :3] @ here.cov_p_site @ shift[:3, :3].T, rtol=0, atol=1e-10
    )
    np.testing.assert_allclose(there.redundancies, here.redundancies, rtol=0, atol=1e-6)
    assert there.sigma0 == pytest.approx(here.sigma0, rel=1e-6)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 50))
def test_the_order_of_markers_and_marks_does_not_matter(seed):
    rng = np.random.default_rng(seed)
    marks = field(rng)
    fits = sightings(marks, pose(STAND, 2.2), noise=rng.normal(0, 4e-3, (14, 3)))
    shuffled = replace(fits, fits=tuple(fits.fits[k] for k in rng.permutation(14)))
    order = rng.permutation(14)
    fix, again = free(fits, marks), free(shuffled, control(marks.p_site[order]))
    np.testing.assert_allclose(again.T_site_station, fix.T_site_station, rtol=0, atol=1e-8)
    np.testing.assert_allclose(again.cov_T_site_station, fix.cov_T_site_station, rtol=1e-4)


def test_scaling_all_sigmas_scales_the_covariance_by_the_square(rng):
    marks = field(rng)
    T = pose(STAND, 2.2)
    noise = rng.normal(0, 4e-3, (14, 3))
    exact = replace(CONFIG, sigma_common=0.0)
    one = free(sightings(marks, T, noise=noise, cov=np.eye(3) * 4e-3**2), marks, exact)
    thrice = sightings(marks, T, noise=noise, cov=np.eye(3) * 12e-3**2, sigma_level=9e-3)
    three = free(thrice, marks, exact)
    np.testing.assert_allclose(three.T_site_station, one.T_site_station, rtol=0, atol=1e-9)
    np.testing.assert_allclose(three.cov_T_site_station, 9 * one.cov_T_site_station, rtol=1e-6)
    assert three.sigma0 == pytest.approx(one.sigma0 / 3, rel=1e-6)


def test_the_common_sigma_and_the_marks_own_covariance_are_added(rng):
    marks = field(rng)
    fits = sightings(marks, pose(STAND, 2.2))
    plain = free(fits, marks, replace(CONFIG, sigma_common=3e-3))
    loose = replace(marks, cov_p_site=np.broadcast_to(np.eye(3) * 3e-3**2, (14, 3, 3)).copy())
    by_marks = free(fits, loose, replace(CONFIG, sigma_common=0.0))
    np.testing.assert_allclose(by_marks.cov_T_site_station, plain.cov_T_site_station, rtol=1e-6)


def noisy_fix(rng, marks, cov_root, lean_sigma=3e-3):
    """A fix from a random pose with noise as claimed, and its error as a small motion."""
    lean = rng.uniform(-0.1, 0.1, 2)
    T = pose(rng.uniform(-3, 3, 3) * [1, 1, 0.1] + marks.p_site.mean(0), rng.uniform(-3, 3), lean)
    n = len(marks.names)
    noise = np.einsum("nij,nj->ni", cov_root, rng.normal(size=(n, 3)))
    cov = cov_root @ np.swapaxes(cov_root, 1, 2)
    measured = tuple(lean + rng.normal(0, lean_sigma, 2))
    fits = sightings(marks, T, lean=measured, sigma_level=lean_sigma, cov=cov, noise=noise)
    fix = free(fits, marks, replace(CONFIG, sigma_common=0.0, test_level=1e-6))
    error = log_motion(station(T, fits.levelling) @ inverse(fix.T_site_station))
    return fix, error, T


def whitened(rng, n_marks, trials):
    """Whitened pose errors, (trials, 6), and normalised squared position errors."""
    marks = field(rng, n_marks, middle=(100.0, 50.0, 10.0))
    roots = rng.normal(0, 3e-3, (n_marks, 3, 3)) + 4e-3 * np.eye(3)
    errors, squares = [], []
    for _ in range(trials):
        fix, xi, T = noisy_fix(rng, marks, roots)
        errors.append(np.linalg.solve(np.linalg.cholesky(fix.cov_T_site_station), xi))
        off = T[:3, 3] - fix.p_site
        squares.append(off @ np.linalg.solve(fix.cov_p_site, off))
    return np.array(errors), np.array(squares)


def test_the_covariance_of_the_pose_is_honest(rng):
    errors, squares = whitened(rng, 5, 500)
    eigenvalues = np.linalg.eigvalsh(errors.T @ errors / len(errors))
    least, greatest = chance.of_eigenvalues(*errors.shape)  # 0.69 and 1.39
    assert least < eigenvalues[0]
    assert eigenvalues[-1] < greatest
    low, high = chance.of_mean_square(3 * len(squares))
    assert low < np.mean(squares) / 3 < high


@pytest.mark.long
@pytest.mark.parametrize("n_marks", [4, 14])
def test_the_covariance_of_the_pose_is_honest_at_length(n_marks):
    errors, squares = whitened(np.random.default_rng(n_marks), n_marks, 2500)
    eigenvalues = np.linalg.eigvalsh(errors.T @ errors / len(errors))
    least, greatest = chance.of_eigenvalues(*errors.shape)  # 0.85 and 1.17
    assert least < eigenvalues[0]
    assert eigenvalues[-1] < greatest
    for squared, dof, probability in ((np.sum(errors**2, axis=1), 6, 0.99), (squares, 3, 0.95)):
        low, high = chance.of_share(probability, len(squared))
        assert low <= np.mean(chi2.cdf(squared, dof) < probability) <= high


def squares_of_poses(draws, marks):
    """Squared errors over covariances of poses, from true poses and what was seen there."""
    squares = []
    for T, fits in draws:
        fix = free(fits, marks)
        assert fix.status is Status.OK
        xi = log_motion(station(T, fits.levelling) @ inverse(fix.T_site_station))
        squares.append(xi @ np.linalg.solve(fix.cov_T_site_station, xi))
    return np.array(squares)


def test_an_unknown_heading_turns_the_station_about_the_axis_of_its_gimbal(rng):
    """A gimbal that leans by 4 degrees, and clocks that leave 2 degrees of heading unknown."""
    marks, sigma = field(rng), np.radians(2.0)

    def draws():
        for _ in range(200):
            T, noise = pose(STAND, 2.2, LEAN), rng.normal(0, 4e-3, (14, 3))
            turned = T @ rigid(turn_z(np.array(rng.normal(0, sigma))), np.zeros(3))
            fits = sightings(marks, turned, lean=LEAN, noise=noise, sigma_level=1e-2)
            yield T, replace(fits, levelling=replace(fits.levelling, sigma_heading=sigma))

    low, high = chance.of_mean_square(6 * 200)
    assert low < np.mean(squares_of_poses(draws(), marks)) / 6 < high


def test_errors_that_all_centres_share_do_not_average_out(rng):
    """A scan of one face: a direction of the mounting lifts all centres by their distance."""
    marks, T, sigma = field(rng), pose(STAND, 2.2), 3e-4
    p = (marks.p_site - T[:3, 3]) @ T[:3, :3]
    factors = sigma * np.linalg.norm(p, axis=1)[:, None, None] * np.array([[0.0], [0.0], [1.0]])
    factors[:, :2, 0] = 1e-3 * p[:, :2] / np.linalg.norm(p[:, :2], axis=1, keepdims=True)
    own = 1e-3**2 * np.eye(3)

    def draws(*, reports):
        for _ in range(200):
            noise = rng.normal(0, 1e-3, (14, 3)) + (factors @ rng.normal(size=1))
            cov = own + factors @ np.swapaxes(factors, 1, 2)
            fits = sightings(marks, T, noise=noise, cov=cov)
            if reports:
                pairs = zip(fits.fits, factors, strict=True)
                found = tuple(replace(fit, shared_base=factor) for fit, factor in pairs)
                fits = replace(fits, fits=found)
            yield T, fits

    config = replace(CONFIG, sigma_range=3.5e-3)
    low, high = chance.of_mean_square(3 * 200)
    found = {}
    for reports in (False, True):
        squares = []
        for _, fits in draws(reports=reports):
            fix = free(fits, marks, config if reports else CONFIG)
            off = T[:3, 3] - fix.p_site
            squares.append(off @ np.linalg.solve(fix.cov_p_site, off) / 3)
        found[reports] = np.mean(squares)
    assert found[False] > 1.5
    assert low < found[True] < high


def test_a_range_error_that_centres_share_is_estimated_beside_the_pose(rng):
    """Four marks of 1 mm each, and 3.5 mm of all ranges: taken as each one's own it blurs them."""
    marks, T = control(field(rng).p_site[[0, 4, 7, 11]]), pose(STAND, 2.2)
    p = (marks.p_site - T[:3, 3]) @ T[:3, :3]
    factors = 3.5e-3 * (p / np.linalg.norm(p, axis=1, keepdims=True))[..., None]
    cov = 1e-3**2 * np.eye(3) + factors @ np.swapaxes(factors, 1, 2)
    squares, errors = [], {False: [], True: []}
    for _ in range(200):
        noise = rng.normal(0, 1e-3, (4, 3)) + factors @ rng.normal(size=1)
        fits = sightings(marks, T, noise=noise, cov=cov)
        pairs = zip(fits.fits, factors, strict=True)
        reported = tuple(replace(fit, shared_base=factor) for fit, factor in pairs)
        for is_shared, some in ((False, fits.fits), (True, reported)):
            config = replace(CONFIG, sigma_range=3.5e-3 * is_shared)
            fix = free(replace(fits, fits=some), marks, config)
            errors[is_shared].append(np.linalg.norm(fix.p_site - T[:3, 3]))
        off = T[:3, 3] - fix.p_site
        squares.append(off @ np.linalg.solve(fix.cov_p_site, off) / 3)
    low, high = chance.of_mean_square(3 * 200)
    assert low < np.mean(squares) < high
    assert np.mean(np.square(errors[True])) < 0.7 * np.mean(np.square(errors[False]))


@pytest.mark.parametrize("method", ["free_station", "ranges", "paper"])
def test_positions_far_from_the_origin_are_as_sure_as_at_it(rng, method):
    marks = field(rng)
    fits = sightings(marks, pose([0.5, -1.0, 1.5], 0.3), noise=rng.normal(0, 1e-3, (14, 3)))
    fits = replace(fits, levelling=replace(fits.levelling, sigma_heading=0.02))
    far = control(np.add(marks.p_site, [431_250.0, 5_412_800.0, 312.0]))
    here, there = resect(method, fits, marks, CONFIG), resect(method, fits, far, CONFIG)
    np.testing.assert_allclose(there.cov_p_site, here.cov_p_site, rtol=1e-5, atol=1e-12)
    x, y, z = here.p_site
    J = np.array([[0, z, -y, 1, 0, 0], [-z, 0, x, 0, 1, 0], [y, -x, 0, 0, 0, 1]])
    np.testing.assert_allclose(
        here.cov_p_site, J @ here.cov_T_site_station @ J.T, rtol=1e-6, atol=1e-12
    )


def test_a_false_marker_and_a_moved_mark_are_left_out_with_reasons(rng):
    marks = field(rng)
    noise = rng.normal(0, 4e-3, (14, 3))
    noise[4] += [0.05, 0.0, 0.03]
    T = pose(STAND, 2.2)
    fits = sightings(marks, T, noise=noise)
    fits = replace(fits, fits=(*fits.fits, marker_fit([3.0, 3.0, 0.0], np.eye(3) * 1e-5)))
    fix = free(fits, marks)
    assert [exclusion.fit for exclusion in fix.excluded] == [4, 14]
    assert fix.excluded[0].reason.startswith("w = ")
    assert f"mark {marks.names[4]}" in fix.excluded[0].reason
    assert "false marker" in fix.excluded[1].reason
    assert 4 not in fix.matches[:, 0]
    assert fix.status is Status.OK
    np.testing.assert_allclose(fix.p_site, T[:3, 3], rtol=0, atol=5 * fix.sigma_3d)


@pytest.mark.parametrize(("n", "status"), [(4, Status.WEAK), (5, Status.OK)])
def test_a_moved_mark_among_so_few_that_it_may_be_another_makes_a_weak_fix(rng, n, status):
    marks = field(rng, n)
    noise = rng.normal(0, 1e-3, (n, 3))
    noise[1] += [0.06, 0.0, 0.03]
    fix = free(sightings(marks, pose(STAND, 2.2), noise=noise), marks)
    assert [exclusion.fit for exclusion in fix.excluded] == [1]
    assert fix.status is status
    assert ("one of the others" in fix.reason) == (status is Status.WEAK)


@pytest.mark.parametrize("method", ["free_station", "ranges", "paper"])
def test_control_of_which_half_was_moved_makes_a_weak_fix_that_names_both_places(rng, method):
    marks, T = field(rng), pose(STAND, 2.2)
    noise = rng.normal(0, 4e-3, (14, 3))
    moved = control(marks.p_site + np.where(np.arange(14) < 7, 0.0, 0.5)[:, None] * [1, 0, 0])
    fix = resect(method, sightings(marks, T, noise=noise), moved, CONFIG)
    assert fix.status is Status.WEAK
    assert "7 markers fit here, and 7 others fit at" in fix.reason
    assert "0.50 m away" in fix.reason


def test_false_markers_and_two_moved_marks_are_no_contradiction(rng):
    marks, T = field(rng), pose(STAND, 2.2)
    away = np.where(np.arange(14) < 12, 0.0, 0.5)[:, None] * [1, 0, 0]
    fits = sightings(marks, T, noise=rng.normal(0, 4e-3, (14, 3)))
    strange = [
        marker_fit(p, np.eye(3) * 1e-5) for p in rng.uniform([-9, -9, -1], [9, 9, 1], (8, 3))
    ]
    fits = replace(fits, fits=(*fits.fits, *strange))
    assert free(fits, control(marks.p_site + away)).status is Status.OK


def test_reliability_is_better_with_more_marks(rng):
    marks = field(rng)
    T = pose(STAND, 2.2)
    few = control(marks.p_site[:3])
    three, all_of_them = free(sightings(few, T), few), free(sightings(marks, T), marks)
    assert three.detectable_biases.min() > all_of_them.detectable_biases.max()
    assert three.external_reliabilities.min() > 2 * all_of_them.external_reliabilities.max()
    assert np.all(all_of_them.redundancies > 2)


def test_two_marks_give_a_weak_fix_thanks_to_gravity():
    marks = control([[6, 0, 0.7], [-5, 2, 1.4]])
    T = pose(STAND, 2.2, LEAN)
    fix = free(sightings(marks, T, lean=LEAN), marks)
    np.testing.assert_allclose(fix.p_site, T[:3, 3], rtol=0, atol=EXACT)
    assert fix.status is Status.WEAK
    assert "only two marks" in fix.reason
    assert fix.dof == 2


def test_two_marks_that_can_be_swapped_have_a_covariance_that_holds_both_places():
    marks, place = control([[6, 0, 1], [-5, 2, 1]]), np.array([0.5, 3.0, 0.8])
    fix = free(sightings(marks, pose(place, 1.0)), marks)
    assert fix.status is Status.WEAK
    assert "2 ways about equally well" in fix.reason
    off = fix.p_site - place
    assert off @ np.linalg.pinv(fix.cov_p_site) @ off < 3.0
    assert fix.sigma_yaw > np.pi / 2


def test_marks_on_a_line_give_a_weak_fix_thanks_to_gravity():
    marks = control([[-6, 3, 0.7], [-1, 3, 0.7], [3, 3, 0.7], [7, 3, 0.7]])
    T = pose((1.0, -2.0, 0.8), 2.2, LEAN)
    fix = free(sightings(marks, T, lean=LEAN), marks)
    np.testing.assert_allclose(fix.p_site, T[:3, 3], rtol=0, atol=EXACT)
    assert fix.status is Status.WEAK
    assert "on one line" in fix.reason


def test_two_marks_on_a_plumb_line_are_refused():
    marks = control([[6, 0, 0.7], [6, 0, 1.9]])
    with pytest.raises(DegenerateGeometryError, match="plumb line"):
        free(sightings(marks, pose(STAND, 2.2)), marks)


def test_one_marker_gives_no_position(rng):
    marks = field(rng)
    fits = sightings(marks, pose(STAND, 2.2))
    with pytest.raises(DegenerateGeometryError, match="One marker gives no position"):
        free(replace(fits, fits=fits.fits[:1]), marks)
    with pytest.raises(DegenerateGeometryError, match="One control mark gives no position"):
        free(fits, control(marks.p_site[:1]))


def test_no_marker_at_all_is_refused(rng):
    marks = field(rng)
    fits = sightings(marks, pose(STAND, 2.2))
    with pytest.raises(NoMarkersError):
        free(replace(fits, fits=()), marks)


def test_an_unknown_method_is_refused(rng):
    marks = field(rng)
    with pytest.raises(ConfigError, match="free_station"):
        resect("astrolabe", sightings(marks, pose(STAND, 2.2)), marks, CONFIG)


def test_sigmas_that_are_too_small_throughout_cost_no_markers_but_make_a_weak_fix(rng):
    marks = field(rng)
    noise = rng.normal(0, 8e-3, (14, 3))
    fits = sightings(marks, pose(STAND, 2.2), noise=noise, cov=np.eye(3) * 1e-3**2)
    fix = free(fits, marks)
    assert len(fix.matches) == 14
    assert fix.status is Status.WEAK
    assert not fix.passes_global_test
    assert "sigma0" in fix.reason


def test_an_assumed_levelling_makes_a_weak_fix(rng):
    marks = field(rng)
    T = pose(STAND, 2.2, (0.02, 0.01))
    fits = sightings(marks, T)
    level = Levelling(roll=0.0, pitch=0.0, sigma=np.radians(3), is_measured=False)
    fix = free(replace(fits, levelling=level), marks)
    assert fix.status is Status.WEAK
    assert "assumed" in fix.reason
    np.testing.assert_allclose(fix.p_site, T[:3, 3], rtol=0, atol=1e-3)


def test_a_levelling_that_contradicts_the_marks_is_left_out(rng):
    marks = field(rng)
    T = pose(STAND, 2.2)
    fix = free(sightings(marks, T, lean=(np.radians(2), 0.0), sigma_level=1e-3), marks)
    np.testing.assert_allclose(fix.p_site, T[:3, 3], rtol=0, atol=EXACT)
    assert fix.status is Status.WEAK
    assert "levelling contradicts" in fix.reason
    assert fix.excluded == ()


def test_included_angles_are_those_at_the_station():
    marks = control([[5, 0, 0.8], [0, 5, 0.8], [-5, 0, 1.4]])
    fix = free(sightings(marks, pose((0, 0, 0.8), 1.0)), marks)
    flat = np.arctan2(0.6, 5.0)
    np.testing.assert_allclose(fix.included_angles, [np.pi / 2, np.pi - flat], rtol=0, atol=EXACT)
