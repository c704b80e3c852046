"""The evidence of a shape, against the sum over a fine grid of its parameters."""

from itertools import product

import numpy as np
import pytest

from spheremark.pipelines.detection.beams import Beams
from spheremark.pipelines.detection.maxima import climbed
from spheremark.pipelines.detection.shapes import (
    EDGE,
    FORM,
    MEAN,
    N_PARAMETERS,
    NOISE,
    SCATTER,
    SPHERE,
    STRETCH,
    X,
    Y,
    Z,
    log_likelihood,
    trust,
)
from spheremark.pipelines.detection.volumes import log_integral, log_volume

NOISE_OF_RANGES = 0.1  # radii
GRID = np.linspace(-4.5, 4.5, 241)  # standard deviations of a prior


def beams_at(rng, step):
    """Beams on a lattice before an empty sky; those that pass less than a radius off hit."""
    axis = np.arange(-1.6, 1.6, step)
    x, y = (values.ravel() + rng.uniform(0, step) for values in np.meshgrid(axis, axis))
    off = np.hypot(x, y)
    surface = -np.sqrt(np.maximum(1.0 - off**2, 0.0)) + NOISE_OF_RANGES * rng.normal(size=len(x))
    ones = np.ones(len(x))
    return Beams(
        x=x,
        y=y,
        z=np.where(off < 1.0, surface, np.inf),
        face=0.5 * ones,
        behind=np.where(off < 1.0, 1e-3, 0.9),
        wide=0.0 * ones,
        empty=ones,
        even=0.0 * ones,
        away=np.inf * ones,
        merged=0.0 * ones,
        widths=np.array([[0.05, 0.0], [0.05, 0.0]]),
        lost=0.02,
        faintest=0.1,
    )


def prior_of(free):
    """A sphere about the origin; what is not free is known."""
    prior = np.zeros((2, N_PARAMETERS))
    prior[0, Z], prior[0, NOISE], prior[0, EDGE] = -MEAN, np.log(NOISE_OF_RANGES), 0.5
    prior[0, SCATTER] = -9.0
    sigmas = {X: 0.3, Y: 0.3, Z: 0.4, NOISE: 0.3, STRETCH: 0.1, FORM: 0.1}
    for parameter in free:
        prior[1, parameter] = sigmas[parameter]
    return prior


def by_grid(prior, free, beams):
    """Logarithm of the mean likelihood over the prior."""
    densities, shape, logs = np.empty(len(beams.x)), prior[0].copy(), []
    for point in product(GRID, repeat=len(free)):
        shape[list(free)] = prior[0, list(free)] + point * prior[1, list(free)]
        logs.append(log_likelihood(SPHERE, shape, prior, beams, densities))
    step = (GRID[1] - GRID[0]) / np.sqrt(2.0 * np.pi)
    return np.logaddexp.reduce(logs) + len(free) * np.log(step)


@pytest.mark.parametrize("free", [(X, FORM), (NOISE, STRETCH), (Y, FORM)])
def test_the_integral_is_the_sum_over_a_grid_and_laplace_s_is_less_near(free):
    rng, errors = np.random.default_rng(7), []
    for step in (0.35, 0.45, 0.55, 0.65):
        beams, prior = beams_at(rng, step), prior_of(free)
        shape, densities = prior[0].copy(), np.empty(len(beams.x))
        begun = log_likelihood(SPHERE, shape, prior, beams, densities)
        climbed(SPHERE, shape, prior[1] > 0.0, prior, beams, begun)
        best = log_likelihood(SPHERE, shape, prior, beams, densities)
        true = by_grid(prior, free, beams)
        laplace = best + log_volume(SPHERE, shape, prior, beams)
        errors.append((log_integral(SPHERE, shape, prior, beams) - true, laplace - true))
    by_integral, by_laplace = np.abs(errors).T
    assert by_integral.max() < 0.5  # of sixteen shapes alone
    assert by_integral.mean() < by_laplace.mean()


def test_the_likelihood_of_thousands_of_exact_ranges_is_finite():
    noise = 1e-6  # radii: densities whose product is greater than any number
    beams = beams_at(np.random.default_rng(3), 0.05)
    off = np.minimum(np.hypot(beams.x, beams.y), 1.0)
    beams = beams._replace(
        z=np.where(beams.z < np.inf, -np.sqrt(1.0 - off**2), np.inf), widths=np.zeros((2, 2))
    )
    shape, densities = prior_of(())[0], np.empty(len(beams.x))
    shape[NOISE] = np.log(noise)
    found = log_likelihood(SPHERE, shape, np.zeros((2, N_PARAMETERS)), beams, densities)
    assert found == pytest.approx(trust(beams) * np.log(densities).sum())
    assert found > 1000.0
