"""Poles below a sphere: depths that agree with one another say more than any one of them."""

import numpy as np
import pytest

from spheremark.pipelines.detection.beams import Beams
from spheremark.pipelines.detection.shapes import (
    MEAN,
    N_PARAMETERS,
    NOISE,
    POLE,
    SCATTER,
    SPHERE,
    Z,
    log_likelihood,
    trust,
)
from spheremark.pipelines.detection.target import slope_of

NOISE_OF_RANGES, HALF, N = 0.1, 0.3, 40


def beams_at(depths, plumb=(0.0, 0.0)):
    """Beams on the middle of a pole below a sphere, and how much deeper they end [radii]."""
    ones = np.ones(len(depths))
    return Beams(
        x=0.0 * ones,
        y=np.linspace(-1.3, -3.0, len(depths)),
        z=np.array(depths),
        face=0.5 * ones,
        behind=0.05 * ones,
        wide=0.0 * ones,
        empty=ones,
        even=0.0 * ones,
        away=np.inf * ones,
        merged=0.0 * ones,
        widths=np.array([[0.05, 0.0], [0.05, 0.0]]),
        lost=0.02,
        faintest=0.1,
        plumb=plumb,
    )


def log_of(beams):
    """Logarithm of the likelihood of the beams below a sphere on a pole."""
    shape, prior = np.zeros(N_PARAMETERS), np.zeros((2, N_PARAMETERS))
    shape[Z], shape[NOISE], shape[POLE] = -MEAN, np.log(NOISE_OF_RANGES), np.log(HALF)
    shape[SCATTER] = -9.0
    prior[0], prior[1, POLE] = shape, 0.8
    densities = np.empty(len(beams.x))
    return log_likelihood(SPHERE, shape, prior, beams, densities) / trust(beams)


@pytest.fixture
def noise():
    return NOISE_OF_RANGES * np.random.default_rng(5).normal(size=N)


def test_depths_on_a_pole_are_likelier_than_as_many_about_it(noise):
    straight, scattered = -HALF + noise, -HALF + 8.0 * noise
    assert log_of(beams_at(straight)) > log_of(beams_at(scattered)) + 0.5 * N


def test_a_pole_beside_its_axis_costs_less_than_its_beams_would_one_by_one(noise):
    def cost(n):
        return log_of(beams_at(noise[:n] - HALF)) - log_of(beams_at(noise[:n] - HALF + 0.2))

    assert cost(N // 4) > 0.5
    assert cost(N) < 2.5 * cost(N // 4)


def test_the_order_of_the_beams_says_next_to_nothing(noise):
    rng, depths = np.random.default_rng(6), -HALF + noise
    logs = [log_of(beams_at(rng.permutation(depths))) for _ in range(20)]
    assert np.ptp(logs) < 1.0, "where scattered depths cost eighty"


def test_what_is_upright_is_farther_away_the_lower_it_is_from_above():
    eye, centre, up = np.zeros(3), np.array([6.0, 0.0, -1.5]), np.array([0.0, 0.0, 1.0])
    radius, distance = 0.1, float(np.linalg.norm(centre))
    plumb = (slope_of(centre, up), radius / distance)
    for down in (1.0, 2.0, 3.0):
        point = centre - down * radius * up
        away = float(np.linalg.norm(point - eye))
        nearest = centre @ point / away
        deeper = (away - nearest) / radius
        above = centre / distance
        across_up = up - (up @ above) * above
        y = (nearest * point / away) @ across_up / np.linalg.norm(across_up) / radius
        assert y * (plumb[0] + y * plumb[1]) == pytest.approx(deeper, abs=0.02)


def test_a_pole_below_a_marker_that_is_seen_from_above_is_upright(noise):
    plumb = (-0.3, 0.01)
    y = beams_at(noise).y
    depths = -HALF + noise + y * (plumb[0] + y * plumb[1])
    assert log_of(beams_at(depths, plumb)) > log_of(beams_at(depths)) + 0.5 * N
