"""Centres of scans whose two faces do not sample a sphere alike, with a mounting that is wrong."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from spheremark.pipelines.accuracy.truth import marker_errors
from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.geometry import rot_z
from spheremark.pipelines.simulation import SimulationConfig, scenario, simulate_stop
from spheremark.pipelines.sphere.mounting import N_MOUNTING, effects_on, sigmas_of
from spheremark.pipelines.survey import process
from tests import chance

CONFIG = SurveyConfig.from_mapping({"fitting": {"methods": ["along_beam"]}})
STEPPED = SimulationConfig(step=np.radians(2.0), only_near_spheres=True)


@pytest.fixture(scope="module")
def field():
    return scenario("paper-field", 71)


@pytest.fixture(scope="module")
def stops(field):
    return [simulate_stop(field, name, STEPPED) for name in ("lane2-stop3", "lane4-stop6")]


def across(stops, marks, config):
    """Lateral and upward errors of centres after heading and lean are taken out, and sigmas [m]."""
    found = []
    for stop in stops:
        fits = process(stop.log, config=config)[0].fits["along_beam"]
        errors = marker_errors(fits, stop.truth, marks)
        p = np.array([fit.p_base for fit in fits.fits])
        flat = np.hypot(p[:, 0], p[:, 1])
        aside = np.stack([-p[:, 1] / flat, p[:, 0] / flat, 0 * flat], axis=1)
        lateral = np.einsum("ni,ni->n", aside, errors.error_base)
        covs = np.array([fit.cov_p_base for fit in fits.fits])
        sigma = np.sqrt(np.einsum("ni,nij,nj->n", aside, covs, aside))
        known = np.isfinite(lateral)
        turn = np.sum(lateral * flat / sigma**2, where=known) / np.sum(
            (flat / sigma) ** 2, where=known
        )
        found.append(np.stack([lateral - turn * flat, sigma])[:, known])
    return np.concatenate(found, axis=1)


def test_the_mounting_moves_faces_square_to_the_sight_or_by_the_offsets():
    centres = np.array([[5.0, 2.0, 0.5], [-3.0, 7.0, -1.0]])
    effects = effects_on(centres)
    assert effects.shape == (2, 3, N_MOUNTING)
    for k in (0, 1, 3, 4, 5):
        assert_allclose(np.einsum("mi,mi->m", effects[:, :, k], centres), 0, atol=1e-12)
    distances = np.linalg.norm(centres, axis=1)
    assert_allclose(np.linalg.norm(effects[:, :, 0], axis=1), distances)
    assert_allclose(np.linalg.norm(effects[:, :, 1], axis=1), distances)
    assert_allclose(effects[:, 2, 2], 0)
    assert_allclose(
        np.hypot(*np.linalg.norm(effects[:, :, 4:], axis=1).T), np.hypot(*centres[:, :2].T)
    )


def test_turning_the_base_turns_the_effects_and_mixes_the_amplitudes_of_the_encoder():
    centres, R = np.array([[5.0, 2.0, 0.5]]), rot_z(0.7)
    turned, plain = effects_on(centres @ R.T), effects_on(centres)
    assert_allclose(turned[0, :, :4], R @ plain[0, :, :4], atol=1e-12)
    assert_allclose(turned[0, :, 4:], R @ plain[0, :, 4:] @ R[:2, :2].T, atol=1e-12)


def test_a_mounting_that_is_taken_as_exact_has_no_sigma():
    assert not sigmas_of(0.0, 0.0).any()


def test_lines_of_rests_that_fall_together_give_centres_as_good_as_promised(field, stops):
    errors, sigmas = across(stops, field.marks, CONFIG)
    assert len(errors) > 20
    assert np.mean((errors / sigmas) ** 2) < 2.0
    trusting = replace(CONFIG.fitting, sigma_mounting=0.0, sigma_offset=0.0)
    before, promised = across(stops, field.marks, replace(CONFIG, fitting=trusting))
    assert np.mean((before / promised) ** 2) > 3.0
    assert np.mean((errors / sigmas) ** 2) < 0.5 * np.mean((before / sigmas) ** 2)


@pytest.mark.parametrize(
    "seed",
    [
        0,
        # 3.2, the limit is 2.5: the clock of the gimbal comes out as 0.7 ms, twice its sigma
        pytest.param(
            4, marks=[pytest.mark.xfail(strict=True, raises=AssertionError), pytest.mark.long]
        ),
    ],
)
def test_a_mounting_that_is_much_worse_than_its_prior_is_found_on_other_fields_too(seed):
    field = scenario("paper-field", seed)
    worse = replace(STEPPED, sigma_misalignment=np.radians(0.1), sigma_axis_offset=0.002)
    stops = [simulate_stop(field, name, worse) for name in ("lane2-stop3", "lane4-stop6")]
    errors, sigmas = across(stops, field.marks, CONFIG)
    assert len(errors) > 20
    assert np.mean((errors / sigmas) ** 2) < chance.of_mean_square(len(errors) - 2)[1]
    fits = process(stops[0].log, config=CONFIG)[0].fits["along_beam"]
    # what parts the two faces has a turn of both beside it, which only the heading would show
    assert fits.levelling.sigma_heading > 1.05 * stops[0].log.rig.sigma_heading


def test_spheres_that_were_found_where_one_face_of_them_is_are_fitted():
    """Faces of far ones are parted by more than their radius, and one of them has more returns."""
    field = scenario("paper-field", 4)
    worse = replace(
        SimulationConfig(only_near_spheres=True),
        sigma_misalignment=np.radians(0.3),
        sigma_axis_offset=0.005,
    )
    stop = simulate_stop(field, "lane4-stop6", worse)
    fits = process(stop.log, config=CONFIG)[0].fits["along_beam"]
    assert not [one.reason for one in fits.rejected if "left the place" in one.reason]
    errors, sigmas = across([stop], field.marks, CONFIG)
    assert np.mean((errors / sigmas) ** 2) < chance.of_mean_square(len(errors) - 1)[1]


def test_a_mounting_that_is_not_as_stated_is_said_with_what_to_do(field, stops):
    worse = replace(STEPPED, sigma_misalignment=np.radians(0.2), sigma_axis_offset=0.005)
    for log, is_said in (
        (stops[0].log, False),
        (simulate_stop(field, "lane2-stop3", worse).log, True),
    ):
        (stop,) = process(log, config=CONFIG)
        assert any("calibrate the rig" in note for note in stop.cloud.notes) == is_said
        assert (stop.fits["along_beam"].mounting_factor > 2.0) == is_said


def test_the_offset_of_the_clock_of_a_gimbal_that_steps_is_an_unknown():
    field = scenario("paper-field", 72)
    late = replace(STEPPED, step=np.radians(3.1), move=0.15, gimbal_clock_offset=0.004)
    stops = [simulate_stop(field, name, late) for name in ("lane2-stop3", "lane4-stop6")]
    exact = replace(CONFIG, fitting=replace(CONFIG.fitting, sigma_gimbal_clock=0.0))
    errors, sigmas = across(stops, field.marks, CONFIG)
    before, promised = across(stops, field.marks, exact)
    assert len(errors) > 20
    assert np.mean((errors / sigmas) ** 2) < 2.0
    assert np.mean((before / promised) ** 2) > 3.0
    assert np.median(np.abs(errors)) < 0.6 * np.median(np.abs(before))
