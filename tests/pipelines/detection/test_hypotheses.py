"""What is known of the height at which each hypothesis is met."""

import numpy as np
import pytest

from spheremark.pipelines.detection.hypotheses import (
    _HEIGHTS,
    _boulder_densities,
    _height_density,
    _standing_densities,
)
from spheremark.pipelines.detection.shapes import BALL, CLUTTER, HEAD, NAMES, SPHERE

RADIUS, SIGMA = 0.1, 0.05  # of a marker, and of the height of a place [m]


@pytest.mark.parametrize("kind", range(len(NAMES)), ids=NAMES)
def test_an_object_is_at_some_height(kind):
    heights = np.linspace(-1.0, _HEIGHTS, 2001)  # what stands for a wrong ground reaches below it
    densities = [_height_density(kind, float(one), SIGMA, RADIUS) for one in heights]
    # 4 % less for what begins a radius above the ground, 3 % more for a wrong ground
    assert np.trapezoid(densities, heights) == pytest.approx(1.0, abs=0.06)


@pytest.mark.parametrize(("height", "is_as_of_heads"), [(0.8, False), (1.2, False), (1.6, True)])
def test_heads_are_met_where_people_have_them(height, is_as_of_heads):
    head, sphere = (_height_density(kind, height, SIGMA, RADIUS) for kind in (HEAD, SPHERE))
    assert (head > 3.0 * sphere) == is_as_of_heads
    assert (head < sphere) != is_as_of_heads


def test_an_unknown_height_tells_nothing():
    found = [_height_density(kind, np.inf, np.inf, RADIUS) for kind in range(len(NAMES))]
    np.testing.assert_allclose(found, 1.0 / _HEIGHTS)


def test_low_things_stand_on_something_wide_and_most_high_ones_on_poles():
    low, high = (_standing_densities(height, SIGMA, RADIUS) for height in (0.3, 1.6))
    assert low[2] > 0.3 * low[0]
    assert high[2] < 0.001 * high[0]  # else heads on shoulders are markers on crates
    for density, share in ((high[1], 0.1), (high[3], 0.02)):  # tripods; vehicles and walls
        assert density == pytest.approx(share / 0.68 * high[0], rel=0.1)


def test_a_boulder_higher_than_itself_lies_on_another():
    low, high = (_boulder_densities(height, SIGMA, RADIUS) for height in (0.05, 0.4))
    assert low[0] > 10.0 * low[1]
    assert high[1] > 5.0 * high[0]


def test_few_markers_are_as_high_as_lamps_and_crowns_of_trees():
    """Above 2.5 m, a metre higher are as many as e goes into; a wrong ground shows any height."""
    for other in (BALL, CLUTTER):
        low, high, highest, unsure = (
            _height_density(SPHERE, height, sigma, RADIUS)
            / _height_density(other, height, sigma, RADIUS)
            for height, sigma in ((2.0, SIGMA), (6.0, SIGMA), (30.0, SIGMA), (4.0, 2.0))
        )
        wrong, poles = 0.02, 0.98 * 0.8  # with what is wide and as high
        as_high = np.exp(-(6.0 - RADIUS - SIGMA - 2.5))
        assert high / low == pytest.approx((poles * as_high + wrong) / (poles + wrong), rel=0.01)
        assert highest / low == pytest.approx(wrong / (poles + wrong), rel=0.01)
        assert unsure / low == pytest.approx(1.0, abs=0.4)  # a ground known to metres says nothing
