"""The radius that returns show by themselves: unbiased at any distance, with a true sigma."""

import numpy as np
import pytest

from spheremark.pipelines.config import FittingConfig, StitchingConfig
from spheremark.pipelines.geometry import inverse, transform
from spheremark.pipelines.model import MarkerCandidate, MarkerCandidates
from spheremark.pipelines.scan.stitching import choose_rig, stitch
from spheremark.pipelines.simulation import SimulationConfig, simulate_stop
from spheremark.pipelines.simulation.lane import range_lane
from spheremark.pipelines.sphere import fit_markers

DISTANCES = np.array([5.0, 10.0, 15.0, 20.0])


@pytest.fixture(scope="module")
def lane():
    """A stitched stop, its true centres, and the returns about each."""
    world = range_lane(8801, DISTANCES, 20)
    simulated = simulate_stop(world, "centre", SimulationConfig(only_near_spheres=True))
    cloud = stitch(simulated.log, choose_rig(simulated.log, None), StitchingConfig())
    centres = transform(inverse(simulated.truth.T_site_base), world.marks.p_site)
    members = [
        np.flatnonzero(np.linalg.norm(cloud.p_base - centre, axis=1) < 0.17) for centre in centres
    ]
    candidates = tuple(
        MarkerCandidate(name="", members=rows, p_base_rough=centre)
        for rows, centre in zip(members, centres, strict=True)
    )
    return cloud, candidates


def fits_of(lane, method, radius):
    cloud, candidates = lane
    found = MarkerCandidates(candidates=candidates, rejected=(), ground_height_max=0.0)
    return fit_markers(method, cloud, found, FittingConfig(), radius).fits


def at(fits, distance):
    return [fit for fit in fits if abs(np.linalg.norm(fit.p_base) - distance) < 1.0]


@pytest.mark.parametrize("method", ["along_beam", "astm_e3125"])
def test_free_radii_of_true_spheres_are_unbiased_with_a_sigma_that_holds(lane, method):
    fits = fits_of(lane, method, 0.1)
    assert len(fits) == 80
    off = np.array([(fit.radius_free - 0.1) / fit.sigma_radius_free for fit in fits])
    assert np.isfinite(off).all()
    assert abs(np.median(off)) < 0.4
    assert 0.6 < 1.4826 * np.median(np.abs(off - np.median(off))) < 1.5
    assert np.std(np.clip(off, -4.0, 4.0)) < 1.5
    assert sum("own radius" in fit.reason for fit in fits) <= 3
    for distance in DISTANCES:
        mine = at(fits, distance)
        sigma = np.median([fit.sigma_radius_free for fit in mine])
        mean = np.mean([fit.radius_free for fit in mine])
        assert abs(mean - 0.1) < 3.5 * sigma / np.sqrt(len(mine)) + 0.0005


@pytest.mark.parametrize(("assumed", "reach"), [(0.075, 5.0), (0.12, 10.0), (0.14, 10.0)])
def test_a_wrong_assumed_radius_is_reported(lane, assumed, reach):
    for distance in DISTANCES[reach >= DISTANCES]:
        fits = at(fits_of(lane, "along_beam", assumed), distance)
        reported = [fit for fit in fits if "own radius" in fit.reason]
        assert len(reported) > 0.8 * len(fits)
        assert abs(np.median([fit.radius_free for fit in reported]) - 0.1) < 0.006
