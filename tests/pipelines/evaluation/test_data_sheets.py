"""Settings that the data sheets of random worlds give."""

from dataclasses import replace

import numpy as np
import pytest

from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.evaluation.data_sheets import data_sheet, with_sheet
from spheremark.pipelines.scan.rigs import tilted_vlp16
from spheremark.pipelines.simulation import draw_world
from spheremark.pipelines.simulation.worlds import PRIORS, latency_rms

SEED = 40


@pytest.fixture(scope="module")
def worlds():
    return {name: draw_world(SEED, name) for name in ("plain", "optics", "rig", "clock")}


def test_usual_worlds_have_the_defaults_of_ranges_and_optics_do_not(worlds):
    default, usual, wide = (
        config.fitting
        for config in (SurveyConfig(), data_sheet(worlds["plain"]), data_sheet(worlds["optics"]))
    )
    assert usual.sigma_range_common == pytest.approx(default.sigma_range_common, rel=0.01)
    assert wide.sigma_range_common > 1.8 * default.sigma_range_common
    assert wide.sigma_range_scale > default.sigma_range_scale > usual.sigma_range_scale


def test_a_sheet_has_the_sigmas_of_rig_and_ahrs_in_each_setting(worlds):
    world = worlds["rig"]
    config, sheet = world.config, data_sheet(world)
    assert sheet.marker_radius == world.field.marker_radius
    assert sheet.fitting.sigma_range_bias == config.sigma_laser_bias
    assert sheet.fitting.sigma_mounting == config.sigma_misalignment
    assert sheet.fitting.sigma_offset == config.sigma_axis_offset
    assert sheet.fitting.sigma_gimbal_clock == pytest.approx(latency_rms("rig"))
    assert sheet.stitching.sigma_levelling > config.sigma_ahrs_bias
    assert sheet.resection.sigma_range**2 == pytest.approx(
        sheet.fitting.sigma_range_common**2 + config.sigma_laser_bias**2 / 16.0
    )


@pytest.mark.parametrize("family", ["plain", "optics"])
def test_sigmas_of_drawn_errors_are_the_root_of_their_mean_square(family):
    rng, prior = np.random.default_rng(7), PRIORS["range_bias"]
    biases = [rng.normal(0.0, prior.draw(rng, family)) for _ in range(40_000)]
    assert np.sqrt(np.mean(np.square(biases))) == pytest.approx(prior.rms(family), rel=0.03)


def test_clocks_are_as_far_apart_as_their_family_draws_them(worlds):
    assert data_sheet(worlds["clock"]).stitching.sigma_clock > 0.03
    assert data_sheet(worlds["plain"]).stitching.sigma_clock < 3e-4
    latencies = [abs(worlds[name].config.gimbal_clock_offset) for name in ("plain", "clock")]
    assert latencies[0] < 3.0 * latency_rms("plain") < latency_rms("clock")
    assert 5e-3 <= latencies[1] <= 0.1


def test_the_heading_of_a_rig_is_as_uncertain_as_its_mounting_and_never_surer(worlds):
    rig, world = tilted_vlp16("rig", (0.03, 0.02)), worlds["rig"]
    assert with_sheet(rig, world).sigma_heading == world.config.sigma_misalignment
    loose = replace(rig, sigma_heading=0.1)
    assert with_sheet(loose, world).sigma_heading == 0.1
