"""Checks without truth, against worlds whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest

from spheremark.pipelines.config import ResectionConfig
from spheremark.pipelines.model import StationFix, Status
from spheremark.pipelines.positioning.quality_control import (
    check_distances,
    dilution_of_precision,
    leave_each_out,
)
from spheremark.pipelines.positioning.resection import resect
from tests import chance
from tests.synthetic import control, field, pose, sightings

CONFIG = ResectionConfig(sigma_common=0.0, sigma_range=0.0, sigma_range_shared=0.0)
SIGMA = 4e-3  # [m] of a centre, per axis
TOLERANCE = 0.03  # [m]


@pytest.fixture
def rng():
    return np.random.default_rng(61)


def seen(rng, marks, *, noise=SIGMA):
    """The fits of a station among marks."""
    T = pose(marks.p_site.mean(axis=0) + np.array([0.5, -0.4, -0.2]), 0.7, (0.02, -0.03))
    return sightings(
        marks, T, lean=(0.02, -0.03), cov=np.eye(3) * SIGMA**2,
        noise=rng.normal(0, noise, (len(marks.names), 3)),
    )  # fmt: skip


def wrong(marks, place, shift):
    """The marks with one given wrongly."""
    p = marks.p_site.copy()
    p[place] += shift
    return control(p)


def without(fits, marks, place):
    """Fits and marks without one mark."""
    keep = [k for k in range(len(marks.names)) if k != place]
    return replace(fits, fits=tuple(fits.fits[k] for k in keep)), control(marks.p_site[keep])


def test_distances_are_those_between_the_points_with_the_sigma_of_chance(rng):
    marks = field(rng)
    scaled = []
    for _ in range(20):
        fits = seen(rng, marks)
        checks = check_distances(fits, marks, CONFIG, TOLERANCE)
        p = np.array([fit.p_base for fit in fits.fits])[checks.fits]
        np.testing.assert_allclose(checks.measured, np.linalg.norm(p[:, 0] - p[:, 1], axis=1))
        scaled.append((checks.measured - checks.given) / checks.sigmas)
        assert len(checks.given) == 14 * 13 / 2
    assert np.std(scaled) == pytest.approx(1.0, abs=0.15)
    assert np.mean(np.abs(scaled) > 3.29) < 0.01


def test_a_mark_that_is_given_wrongly_is_the_suspect(rng):
    marks = field(rng)
    checks = check_distances(
        seen(rng, marks), wrong(marks, 4, [0.05, 0.06, 0.0]), CONFIG, TOLERANCE
    )
    assert checks.suspects[:1] == (4,)
    assert (checks.marks[checks.is_off] == 4).any(axis=1).mean() > 0.8


def test_a_mark_that_no_marker_stands_on_is_the_suspect_where_one_stands_beside_it(rng):
    marks = field(rng)
    control_marks = wrong(marks, 4, [0.3, 0.0, 0.0])  # farther than a match may be
    checks = check_distances(seen(rng, marks), control_marks, CONFIG, TOLERANCE)
    assert checks.suspects[:1] == (4,)
    assert len(checks.given) == 14 * 13 / 2
    far = check_distances(seen(rng, marks), wrong(marks, 4, [3.0, 0.0, 0.0]), CONFIG, TOLERANCE)
    assert 4 not in far.marks


def test_without_errors_nothing_is_suspect(rng):
    marks = field(rng)
    checks = check_distances(seen(rng, marks, noise=0.0), marks, CONFIG, TOLERANCE)
    assert checks.suspects == ()
    assert not checks.is_off.any()


def test_a_range_bias_in_common_makes_distances_less_sure(rng):
    marks = field(rng)
    fits = seen(rng, marks)
    sharp, blunt = (
        check_distances(fits, marks, replace(CONFIG, sigma_range=sigma), TOLERANCE).sigmas
        for sigma in (0.0, 0.01)
    )
    assert np.all(blunt > sharp)
    assert np.sqrt(blunt**2 - sharp**2).max() == pytest.approx(0.02, rel=0.05)  # across the ring


def test_a_range_bias_that_centres_claim_as_their_own_counts_once(rng):
    bias, own = 2e-3, 2e-3  # [m]
    config = replace(CONFIG, sigma_range=bias, sigma_range_shared=bias)
    scaled = []
    for _ in range(150):
        marks = field(rng, 6)
        T = pose([0.5, -0.4, -0.2], 0.7)
        towards = (marks.p_site - T[:3, 3]) @ T[:3, :3]
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        cov = own**2 * np.eye(3) + bias**2 * towards[:, :, None] * towards[:, None, :]
        noise = rng.normal(0, own, (6, 3)) + rng.normal(0, bias) * towards
        fits = sightings(marks, T, cov=cov, noise=noise)
        checks = check_distances(fits, marks, config, TOLERANCE)
        scaled.append((checks.measured - checks.given) / checks.sigmas)
    assert np.sqrt(np.mean(np.square(scaled))) == pytest.approx(1.0, abs=0.06)


def test_leaving_a_marker_out_is_positioning_without_it(rng):
    marks = field(rng, 6)
    fits = seen(rng, marks)
    fix = resect("free_station", fits, marks, CONFIG)
    omissions = leave_each_out(fix, fits, marks, CONFIG)
    assert len(omissions.shifts_site) == 6
    for row, (_, mark) in enumerate(fix.matches):
        anew = resect("free_station", *without(fits, marks, mark), CONFIG)
        np.testing.assert_allclose(omissions.shifts_site[row], anew.p_site - fix.p_site, atol=1e-6)


def test_what_the_others_predict_for_a_mark_is_off_by_as_much_as_is_said(rng):
    squares = []
    for _ in range(40):
        marks = field(rng, 8)
        fits = seen(rng, marks)
        fix = resect("free_station", fits, marks, replace(CONFIG, test_level=1e-6))
        omissions = leave_each_out(fix, fits, marks, CONFIG)
        d, cov = omissions.predictions_site, omissions.cov_predictions_site
        squares.append(np.einsum("ni,nij,nj->n", d, np.linalg.inv(cov), d))
    assert np.mean(np.concatenate(squares)) / 3 == pytest.approx(1.0, abs=0.15)


def test_errors_that_centres_share_move_the_station_and_the_mark_that_it_predicts(rng):
    """A scan of one face: an error of range, and one that lifts all centres by their distance."""
    marks = field(rng, 6)
    T, own = pose([0.5, -0.4, -0.2], 0.7), 1e-3
    config = replace(CONFIG, sigma_range=4e-3, test_level=1e-6)
    p = (marks.p_site - T[:3, 3]) @ T[:3, :3]
    shared = np.stack([4e-3 * p / np.linalg.norm(p, axis=1, keepdims=True), 0.0 * p], axis=2)
    shared[:, 2, 1] = 5e-4 * np.linalg.norm(p, axis=1)
    cov = own**2 * np.eye(3) + shared @ np.swapaxes(shared, 1, 2)
    squares = []
    for _ in range(400):
        noise = rng.normal(0, own, (6, 3)) + shared @ rng.normal(size=2)
        fits = sightings(marks, T, cov=cov, noise=noise)
        pairs = zip(fits.fits, shared, strict=True)
        reported = tuple(replace(fit, shared_base=factors) for fit, factors in pairs)
        fits = replace(fits, fits=reported)
        fix = resect("free_station", fits, marks, config)
        omissions = leave_each_out(fix, fits, marks, config)
        for row, (_, mark) in enumerate(fix.matches[:1]):
            anew = resect("free_station", *without(fits, marks, mark), config).p_site
            np.testing.assert_allclose(omissions.shifts_site[row], anew - fix.p_site, atol=1e-5)
        d, covs = omissions.predictions_site, omissions.cov_predictions_site
        squares.append(np.mean(np.einsum("ni,nij,nj->n", d, np.linalg.inv(covs), d)) / 3)
    assert abs(np.mean(squares) - 1.0) < chance.of_mean(squares) < 0.15


def test_of_two_markers_none_can_be_left_out(rng):
    marks = control([[6, 0, 0.7], [-5, 2, 1.4]])
    fits = seen(rng, marks)
    fix = resect("free_station", fits, marks, CONFIG)
    assert len(leave_each_out(fix, fits, marks, CONFIG).shifts_site) == 0


def test_a_marker_whose_others_stand_on_one_pole_cannot_be_left_out(rng):
    marks = control([[6, 0, 0.7], [-5, 2, 0.6], [-5, 2, 1.6]])
    fits = seen(rng, marks)
    fix = resect("free_station", fits, marks, CONFIG)
    omissions = leave_each_out(fix, fits, marks, CONFIG)
    first = list(fix.matches[:, 1]).index(0)
    for column in (
        omissions.shifts_site,
        omissions.predictions_site,
        omissions.cov_predictions_site,
    ):
        assert np.isnan(column[first]).all()
        assert np.isfinite(np.delete(column, first, axis=0)).all()


def test_a_levelling_that_the_fix_left_out_does_not_tilt_what_the_others_predict(rng):
    marks = field(rng, 6)
    T = pose([0.5, -0.4, -0.2], 0.7)
    noise = rng.normal(0, SIGMA, (6, 3))
    fits = sightings(marks, T, lean=(0.01, 0.0), sigma_level=5e-4, noise=noise)
    fix = resect("free_station", fits, marks, CONFIG)
    assert "levelling contradicts" in fix.reason
    omissions = leave_each_out(fix, fits, marks, CONFIG)
    assert np.linalg.norm(omissions.predictions_site, axis=1).max() < 8 * SIGMA
    assert np.linalg.norm(omissions.shifts_site, axis=1).max() < 4 * SIGMA


@pytest.mark.parametrize(
    ("method", "directions", "expected"),
    [
        # centres all around: their mean in each of three coordinates
        ("free_station", [[7, 0, 0], [-3.5, 6.1, 0], [-3.5, -6.1, 0]], np.sqrt(3 / 3)),
        # a tetrahedron: J'J is 4/3 of the unit matrix
        ("ranges", [[5, 5, 5], [5, -5, -5], [-5, 5, -5], [-5, -5, 5]], np.sqrt(3 * 3 / 4)),
        # three circles at 120 degrees, and the mean of three heights
        ("paper", [[7, 0, 0], [-3.5, 6.0622, 0], [-3.5, -6.0622, 0]], np.sqrt(2 * 2 / 3 + 1 / 3)),
    ],
)
def test_the_dilution_of_precision_is_that_of_textbook_geometries(method, directions, expected):
    marks = control(directions)
    fix = StationFix(
        method=method, T_site_station=np.eye(4), cov_T_site_station=np.eye(6), cov_p_site=np.eye(3),
        matches=np.stack([np.arange(len(directions))] * 2, axis=1),
        **dict.fromkeys(("redundancies", "w_statistics", "detectable_biases",
                         "external_reliabilities"), np.zeros(len(directions))),
        residuals_site=np.zeros((len(directions), 3)), dof=1, sigma0=1.0, passes_global_test=True,
        included_angles=np.zeros(2), status=Status.OK, reason="", excluded=(),
    )  # fmt: skip
    assert dilution_of_precision(fix, marks) == pytest.approx(expected, rel=1e-3)


def test_ranges_in_one_plane_with_the_station_dilute_its_height_without_limit():
    marks = control([[7.0, 0, 0.8], [-3, 6, 0.8], [-3, -6, 0.8], [2, 7, 0.8]])
    fix = resect("free_station", sightings(marks, pose([0, 0, 0.8], 0.3)), marks, CONFIG)
    assert np.isfinite(dilution_of_precision(fix, marks))
    assert np.isinf(dilution_of_precision(replace(fix, method="ranges"), marks))
