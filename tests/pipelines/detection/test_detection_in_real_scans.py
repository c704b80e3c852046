"""Spheres in scans that others have made, nearer, denser and larger or smaller than ours."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import least_squares

from spheremark.pipelines.config import ExtractionConfig, FittingConfig
from spheremark.pipelines.detection import extract
from spheremark.pipelines.model import RING_UNKNOWN, Levelling, StitchedCloud
from spheremark.pipelines.scan.rigs import vlp16
from spheremark.pipelines.sphere import fit_markers
from tests.real_scans import REAL, needs

# where an exhaustive search with free radius finds the sphere: to a few centimetres [m]
SPHERES = {
    "L1_S1": (-2.04, -1.46, -0.24),
    "L1_S2": (-2.79, -0.39, -0.24),
    "L1_S3": (-3.00, -0.48, 0.04),
    "L1_S4": (-2.27, -1.14, 0.23),
    "L1_S5": (-2.62, -1.10, -0.20),
    "L2_S1": (-2.75, -0.05, 0.04),
    "L2_S2": (-1.77, -0.87, -0.25),
    "L2_S3": (-1.61, -0.54, -0.18),
}
TARGETS = ("SPH101", "SPH102", "SPH103", "SPH104", "SPH105")


def points_of(path):
    return np.array(path.read_text().replace(",", " ").split(), float).reshape(-1, 3)


def at_rest(points, rig):
    """A cloud of a scanner that stands upright and still: no gimbal, rings, times, reflectivity."""
    n = len(points)
    return StitchedCloud(
        p_base=points.astype(np.float32),
        gimbal_angles=np.zeros(n, np.float32),
        intensities=np.zeros(n, np.float32),
        rings=np.full(n, RING_UNKNOWN, np.uint8),
        times=np.zeros(n, np.float32),
        levelling=Levelling(roll=0.0, pitch=0.0, sigma=0.003, is_measured=False),
        rig=rig,
        coverage=0.0,
        duration=0.1,
        name="rest",
    )


@needs("vlp16_spheres")
@pytest.mark.parametrize("name", SPHERES)
def test_the_sphere_is_found_among_people_and_furniture_and_nothing_else(name):
    cloud = at_rest(points_of(REAL / f"vlp16_spheres/{name}.xyz"), vlp16("upright", np.eye(4)))
    found = extract(cloud, ExtractionConfig(), 0.30)
    assert len(found.candidates) == 1
    assert_allclose(found.candidates[0].p_base_rough, SPHERES[name], rtol=0, atol=0.05)
    assert all(rejection.reason for rejection in found.rejected)


@needs("tls_spheres")
@pytest.mark.parametrize("name", TARGETS)
def test_a_target_of_a_terrestrial_scanner_is_fitted_as_nist_segments_it(name):
    rig = replace(vlp16("tls", np.eye(4)), laser_heights=np.zeros(16), divergence=np.full(2, 1e-4))
    cloud = at_rest(points_of(REAL / f"tls_spheres/{name}.xyz"), rig)
    found = extract(cloud, ExtractionConfig(), 0.050)
    fits = fit_markers("along_beam", cloud, found, FittingConfig(), 0.050).fits
    segment = points_of(REAL / f"tls_spheres/t{name}.xyz")
    nist = least_squares(
        lambda c: np.linalg.norm(segment - c, axis=1) - 0.050, segment.mean(axis=0) * 1.003
    ).x
    assert len(fits) == 1
    assert np.linalg.norm(fits[0].p_base - nist) < 0.0003
