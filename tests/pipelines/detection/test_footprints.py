"""How wide beams are along the spin axis: what spheres show of it, and what it changes."""

import numpy as np
import pytest

from spheremark.pipelines.detection.beams import Beams
from spheremark.pipelines.detection.hypotheses import SIGMAS, USUAL
from spheremark.pipelines.detection.search import shared_by
from spheremark.pipelines.detection.shapes import (
    ALONG,
    EDGE,
    FORM,
    MEAN,
    N_PARAMETERS,
    NOISE,
    SPHERE,
    STRETCH,
    Z,
    log_likelihood,
)

NOISE_OF_RANGES, ACROSS = 0.1, 0.2  # radii; half the width of a beam square to the spin axis
SIGMA_ALONG = SIGMAS[ALONG - NOISE - 1]  # what comes before is the noise


def beams_of(along, sheet, rng):
    """Beams at a sphere before an empty sky: how wide along a level spin axis, and by the sheet."""
    axis = np.arange(-1.7, 1.7, 0.12)
    x, y = (values.ravel() + rng.uniform(0, 0.12) for values in np.meshgrid(axis, axis))
    off = np.hypot(x, y)
    blur = np.hypot(along * x, ACROSS * y) / off
    reach = 1.0 + USUAL[0] * blur
    part = 0.5 * (np.clip(off - blur, 0.0, 1.0) + 1.0)  # the middle of a beam's part on the sphere
    surface = -np.sqrt(1.0 - np.where(off + blur < 1.0, off, part) ** 2)
    surface += NOISE_OF_RANGES * rng.normal(size=len(x))
    ones = np.ones(len(x))
    return Beams(
        x=x,
        y=y,
        z=np.where(off < reach, surface, np.inf),
        face=0.5 * ones,
        behind=np.where(off < reach, 1e-3, 0.9),
        wide=0.0 * ones,
        empty=ones,
        even=0.0 * ones,
        away=np.inf * ones,
        merged=0.0 * ones,
        widths=np.array([[0.0, sheet], [ACROSS, 0.0]]),
        lost=0.02,
        faintest=0.1,
    )


def prior_of():
    """A sphere about the origin in a scan of which nothing is known."""
    prior = np.zeros((2, N_PARAMETERS))
    prior[0, Z], prior[1, : Z + 1] = -MEAN, (0.3, 0.3, 0.4)
    prior[0, NOISE], prior[1, NOISE] = np.log(NOISE_OF_RANGES), 0.3
    prior[0, EDGE : FORM + 1], prior[1, EDGE : FORM + 1] = USUAL, SIGMAS
    prior[1, ALONG] = 0.0
    return prior


@pytest.mark.parametrize("ratio", [0.5, 1.0, 2.0])
def test_spheres_show_how_wide_beams_are_along_the_spin_axis(ratio):
    rng, prior = np.random.default_rng(11), prior_of()
    sheet, shown = 0.1, []
    for _ in range(8):
        beams = beams_of(ratio * sheet, sheet, rng)
        values, cov = shared_by(prior[0], prior, SIGMA_ALONG, beams)
        own = ALONG - NOISE
        alone = 1.0 / cov[own, own] - SIGMA_ALONG**-2.0  # information, without the prior's
        shown.append((alone, values[own] / cov[own, own]))
    information, pulls = np.sum(shown, axis=0)
    sigma = information**-0.5
    assert sigma < 0.2
    assert pulls / information == pytest.approx(np.log(ratio), abs=3.0 * sigma)


def test_the_comparison_takes_the_width_along_the_axis_as_it_is_given():
    beams = beams_of(0.2, 0.2, np.random.default_rng(5))
    by_sheet = beams._replace(widths=beams.widths * np.array([[1.0, 0.5], [1.0, 1.0]]))
    prior, densities = prior_of(), np.empty(len(beams.x))
    shape = prior[0].copy()
    true = log_likelihood(SPHERE, shape, prior, beams, densities)
    narrow = log_likelihood(SPHERE, shape, prior, by_sheet, densities)
    shape[ALONG] = prior[0, ALONG] = np.log(2.0)
    assert log_likelihood(SPHERE, shape, prior, by_sheet, densities) == pytest.approx(true)
    assert true > narrow + 10.0


def test_what_a_sphere_shares_is_estimated_without_changing_it():
    prior = prior_of()
    beams = beams_of(0.2, 0.1, np.random.default_rng(6))
    sphere = prior[0].copy()
    values, cov = shared_by(sphere, prior, SIGMA_ALONG, beams)
    assert len(values) == len(cov) == STRETCH + 2 - NOISE
    np.testing.assert_array_equal(sphere, prior[0])
    assert prior[1, ALONG] == 0.0
