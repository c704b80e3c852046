import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from spheremark.pipelines.errors import ConfigError
from spheremark.pipelines.model import ImuMount
from spheremark.pipelines.simulation import SimulationConfig, commensurability
from spheremark.pipelines.simulation.rig import (
    ahrs_samples,
    even_turn,
    joint_samples,
    nominal_rig,
    recorded_time,
    true_rig,
    turning,
)


@pytest.mark.parametrize("turn", [18.0, 12.0, 36.0, 9.0])
def test_commensurate_turns_are_warned_of(turn):
    assert "scan lines fall on scan lines" in commensurability(SimulationConfig(turn=turn))


@pytest.mark.parametrize("turn", [13.2, 12.6, 20.0, 17.0])
def test_turns_that_spread_the_lines_are_not_warned_of(turn):
    assert commensurability(SimulationConfig(turn=turn)) == ""


def test_the_warning_names_the_gap():
    assert "gaps of 1.00 deg (mean 0.06)" in commensurability(SimulationConfig(turn=18.0))


def test_the_same_turn_is_fine_at_another_speed():
    assert commensurability(SimulationConfig(turn=18.0, spin_rpm=640.0)) == ""


def test_the_encoder_is_read_with_its_eccentricity_and_clock():
    config = SimulationConfig.perfect(turn=4.0, sigma_eccentricity=0.01, gimbal_clock_offset=-0.3)
    rng = np.random.default_rng(2)
    rig, motion = true_rig(config, rng), even_turn(config, 0.1)
    angles, offsets_ns = joint_samples(motion, rig, config, rng)
    cosine, sine = rig.encoder_eccentricity
    truth = motion.angle_at(offsets_ns * 1e-9 - 0.3)
    corrected = angles + cosine * np.cos(angles) + sine * np.sin(angles)
    assert abs(cosine) + abs(sine) > 0.001
    # three fixed-point steps from the truth, each of which leaves a share of e
    e = np.hypot(cosine, sine)
    nanosecond = 1e-9 * 2 * np.pi / config.turn
    assert_allclose(corrected, truth, rtol=0, atol=e**4 * (1 + e) + nanosecond)


def test_encoder_jitter_and_steps_are_as_asked():
    config = SimulationConfig.perfect(turn=60.0, sigma_encoder=1e-4, encoder_step=1e-3)
    rng = np.random.default_rng(2)
    angles, offsets_ns = joint_samples(even_turn(config, 0.0), nominal_rig(config), config, rng)
    assert_allclose(angles / 1e-3, np.round(angles / 1e-3), rtol=0, atol=1e-9)
    off = angles - even_turn(config, 0.0).angle_at(offsets_ns * 1e-9)
    assert_allclose(np.std(off), np.hypot(1e-4, 1e-3 / np.sqrt(12)), rtol=0.05)


def test_the_bias_of_the_ahrs_is_as_large_as_asked():
    config = SimulationConfig.perfect(turn=0.5, sigma_ahrs_bias=0.004)
    rig, motion = nominal_rig(config), even_turn(config, 0.0)
    leans = []
    for seed in range(300):
        rng = np.random.default_rng(seed)
        quaternions, _ = ahrs_samples(motion, np.eye(3), rig, config, rng)
        up = Rotation.from_quat(quaternions).inv().apply([0.0, 0.0, 1.0])
        leans.append(up[:, :2].mean(axis=0))
    assert_allclose(np.std(leans), 0.004, rtol=0.1)


def test_a_perfect_rig_is_the_nominal_one():
    config = SimulationConfig.perfect()
    rig = true_rig(config, np.random.default_rng(1))
    assert_allclose(rig.T_head_lidar, nominal_rig(config).T_head_lidar, atol=1e-15)
    assert not rig.laser_range_biases.any()


def test_rigs_are_misaligned_as_far_as_asked():
    config = SimulationConfig(sigma_misalignment=0.001, sigma_axis_offset=0.002)
    nominal = nominal_rig(config).T_head_lidar
    rigs = [true_rig(config, np.random.default_rng(seed)) for seed in range(300)]
    turns = [np.trace(rig.T_head_lidar[:3, :3] @ nominal[:3, :3].T) for rig in rigs]
    angles = np.arccos((np.array(turns) - 1) / 2)
    assert_allclose(np.sqrt(np.mean(angles**2) / 3), 0.001, rtol=0.1)
    shifts = np.array([(rig.T_head_lidar - nominal)[:3, 3] for rig in rigs])
    assert_allclose(np.std(shifts[:, :2]), 0.002, rtol=0.1)
    assert not shifts[:, 2].any()  # by the definition of the base frame


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("turn", 0.0),
        ("spin_rpm", "fast"),
        ("drop_out", True),
        ("sigma_range", -0.01),
        ("sigma_tilt", float("nan")),
        ("axis_offset", (0.1,)),
        ("divergence", (0.003, -0.001)),
        ("imu_mount", "mast"),
    ],
)
def test_options_out_of_range_are_refused_by_name(name, value):
    with pytest.raises(ConfigError, match=f"simulation.{name} is"):
        SimulationConfig(**{name: value})


def test_options_are_plain_values_for_the_truth_file():
    mapping = SimulationConfig(imu_mount=ImuMount.HEAD).to_mapping()
    assert mapping["imu_mount"] == "head"
    assert mapping["spin_rpm"] == 600.0


def test_a_stepping_gimbal_rests_for_whole_revolutions_and_ends_with_a_full_turn():
    config = SimulationConfig(step=np.radians(50.0), rest_revolutions=2, move=0.15)
    motion = turning(config, 0.3)
    assert_allclose(recorded_time(config), 9 * 0.2 + 8 * 0.15)
    rests = np.arange(9) * 0.35
    for inside in (0.0, 0.1, 0.2):
        expected = 0.3 + np.radians([0, 50, 100, 150, 200, 250, 300, 350, 360])
        assert_allclose(motion.angle_at(rests + inside), expected, rtol=0, atol=1e-9)
    assert_allclose(motion.angle_at(np.array([0.275])), [0.3 + np.radians(25.0)])


def test_steps_that_are_multiples_of_the_channel_pitch_are_warned_of():
    assert "Rests every 10 deg" in commensurability(SimulationConfig(step=np.radians(10.0)))
    assert not commensurability(SimulationConfig(step=np.radians(1.27)))
