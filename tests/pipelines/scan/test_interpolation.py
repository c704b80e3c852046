"""How well angles of a gimbal are known between their samples, against movements that are known."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from spheremark.pipelines.model import Timed
from spheremark.pipelines.scan.interpolation import (
    errors_of_interpolation,
    scatter_of_angles,
    speeds_of,
)

REST, MOVE, SPEED, PERIOD = 0.1, 0.05, 1.7, 9_300_000  # [s], [s], [rad/s], [ns] between samples


def stepped_angle(times):
    """Angle of a gimbal that rests and moves in turn [rad]."""
    n, within = np.divmod(times, REST + MOVE)
    return SPEED * (n * MOVE + np.maximum(within - REST, 0.0))


def sampled(angle, scatter=0.0, step=0.0):
    """Angles of returns between samples of a movement, which an encoder rounds."""
    samples = np.arange(0, 3_000_000_000, PERIOD)
    noise = scatter * np.random.default_rng(4).standard_normal(len(samples))
    values = angle(1e-9 * samples) + noise
    values = np.round(values / step) * step if step else values
    rates = np.append(np.diff(values) / PERIOD, 0.0)
    stamps = np.arange(50_000_000, 2_900_000_000, 137_000)
    return Timed(stamps, samples, values, rates)


def test_corners_of_a_movement_are_off_by_what_interpolation_cuts_off():
    column = sampled(stepped_angle)
    off = np.abs(column[:].astype(float) - stepped_angle(1e-9 * column.stamps_ns))
    assert off.max() > 2e-3
    found = errors_of_interpolation(column, np.arange(len(column)))
    assert_allclose(found, off, atol=2e-6)  # angles are of single precision


def test_corners_are_found_through_the_scatter_of_the_samples():
    column = sampled(stepped_angle, scatter=5e-5)
    off = np.abs(column[:].astype(float) - stepped_angle(1e-9 * column.stamps_ns))
    found = errors_of_interpolation(column, np.arange(len(column)))
    assert np.all(found[off > 3e-4] > 0.5 * off[off > 3e-4])
    assert np.all(found[off > 1e-3] > 0.8 * off[off > 1e-3])
    assert np.mean(found > 0.0) < 0.2


@pytest.mark.parametrize(
    "angle",
    [
        lambda times: 0.5 * times,
        lambda times: 0.5 * times + 3e-3 * np.sin(3.0 * times),
        lambda times: 0.5 * times + 1e-3 * np.sin(60.0 * times),
    ],
)
def test_an_even_or_rippling_turn_has_no_corners(angle):
    column = sampled(angle, scatter=5e-5)
    assert not errors_of_interpolation(column, np.arange(len(column))).any()
    assert not errors_of_interpolation(column[:], np.arange(len(column))).any()


def hurried_angle(times):
    """Angle of a gimbal that moves, smoothly, for three fifths of the time [rad]."""
    n, within = np.divmod(times, 0.1)
    share = np.clip(within - 0.04, 0.0, None) / 0.06
    return 0.05 * (n + 0.5 - 0.5 * np.cos(np.pi * share))


@pytest.mark.parametrize("angle", [lambda times: 0.47 * times, stepped_angle, hurried_angle])
@pytest.mark.parametrize(("jitter", "step"), [(1e-4, 0.0), (1e-4, 2e-4), (2e-4, 4e-4)])
def test_the_scatter_is_that_of_the_encoder_however_the_gimbal_moves(angle, jitter, step):
    column = sampled(angle, jitter, step)
    # noise s is 2/3 s^2 between two samples, in the mean; rounding adds a twelfth of a step squared
    expected = np.sqrt(2.0 / 3.0) * np.hypot(jitter, step / np.sqrt(12.0))
    assert scatter_of_angles(column, np.nan) == pytest.approx(expected, rel=0.3)


def test_speeds_are_those_between_the_samples_and_none_without_samples():
    column = sampled(stepped_angle)
    times = 1e-9 * column.stamps_ns
    speeds = speeds_of(column, np.arange(len(column)))
    within, between = times % (REST + MOVE), 2e-9 * PERIOD
    assert_allclose(speeds[within > REST + between][:20], SPEED)
    assert_allclose(speeds[(within > between) & (within < REST - between)], 0.0, atol=1e-9)
    assert not speeds_of(column[:], np.arange(len(column))).any()
