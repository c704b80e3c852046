import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spheremark.pipelines.geometry import (
    exp_motion,
    included_angle,
    inverse,
    left_jacobian,
    levelling_rotation,
    log_motion,
    rigid,
    rot_x,
    rot_y,
    rot_z,
    skew,
    transform,
    wrap,
    yaw_pitch_roll,
)
from spheremark.pipelines.model import Levelling
from tests.synthetic import lean_matrix, turn_z

ROUNDING = 1e-12  # [rad] and [m] for numbers of the size of ten

coordinate = st.floats(-10, 10)
vector = st.tuples(coordinate, coordinate, coordinate).map(np.array)
angle = st.floats(-1.5, 1.5)
motion = st.tuples(*[angle] * 3, *[coordinate] * 3).map(np.array)


@given(vector, vector)
def test_skew_is_the_cross_product(v, w):
    np.testing.assert_allclose(skew(v) @ w, np.cross(v, w), rtol=0, atol=ROUNDING * 100)


@given(motion)
def test_log_undoes_exp(xi):
    np.testing.assert_allclose(log_motion(exp_motion(xi)), xi, rtol=0, atol=1e-9)


@given(motion)
def test_exp_is_the_limit_of_many_small_steps(xi):
    step = np.eye(4)
    step[:3, :3] += skew(xi[:3]) / 2**20
    step[:3, 3] = xi[3:] / 2**20
    expected = np.linalg.matrix_power(step, 2**20)
    np.testing.assert_allclose(exp_motion(xi), expected, rtol=0, atol=2e-4)


@given(motion, motion, vector)
def test_motions_compose_and_invert(first, second, p):
    a, b = exp_motion(first), exp_motion(second)
    np.testing.assert_allclose(
        transform(a @ b, p), transform(a, transform(b, p)), rtol=0, atol=1e-11
    )
    np.testing.assert_allclose(transform(inverse(a), transform(a, p)), p, rtol=0, atol=1e-11)


@given(motion)
def test_the_left_jacobian_is_the_derivative_of_the_exponential(xi):
    phi, h = xi[:3], 1e-6
    for k, axis in enumerate(np.eye(3)):
        ahead = exp_motion(np.r_[phi + h * axis, 0, 0, 0])
        behind = exp_motion(np.r_[phi - h * axis, 0, 0, 0])
        change = log_motion(ahead @ inverse(behind))[:3] / (2 * h)
        np.testing.assert_allclose(left_jacobian(phi)[:, k], change, rtol=0, atol=1e-8)


def test_a_motion_of_nothing_is_nothing():
    np.testing.assert_array_equal(exp_motion(np.zeros(6)), np.eye(4))
    np.testing.assert_array_equal(log_motion(np.eye(4)), np.zeros(6))


def test_rotations_turn_counter_clockwise_about_their_axis():
    x, y, z = np.eye(3)
    quarter = np.pi / 2
    np.testing.assert_allclose(rot_x(quarter) @ y, z, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(rot_y(quarter) @ z, x, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(rot_z(quarter) @ x, y, rtol=0, atol=ROUNDING)


@given(angle, angle, angle)
def test_yaw_pitch_and_roll_are_those_of_the_conventions(yaw, pitch, roll):
    levelling = Levelling(roll=roll, pitch=pitch, sigma=1e-3, is_measured=True)
    R = turn_z(np.array(yaw)) @ lean_matrix(roll, pitch)
    np.testing.assert_allclose(rot_z(yaw) @ levelling_rotation(levelling), R, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(yaw_pitch_roll(R), (yaw, pitch, roll), rtol=0, atol=1e-9)


@pytest.mark.parametrize("truth", [0.0, 1e-9, 1e-3, 1.0, np.pi / 2, 3.0, np.pi - 1e-9, np.pi])
def test_included_angles_are_exact_when_small_and_when_flat(truth):
    v, w = np.array([2.0, 0, 0]), 3.0 * np.array([np.cos(truth), np.sin(truth), 0])
    assert included_angle(v, w) == pytest.approx(truth, abs=1e-15)


@given(st.floats(-100, 100))
def test_wrapping_keeps_the_direction_and_lands_in_the_half_open_turn(value):
    wrapped = float(wrap(value))
    assert -np.pi <= wrapped < np.pi
    assert np.cos(wrapped - value) == pytest.approx(1, abs=1e-12)


def test_rigid_is_rotation_then_shift():
    T = rigid(rot_z(np.pi / 2), (1, 2, 3))
    np.testing.assert_allclose(transform(T, [[1, 0, 0]]), [[1, 3, 3]], rtol=0, atol=ROUNDING)
