import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from spheremark.pipelines.errors import RigError
from spheremark.pipelines.scan.rigs import (
    rig_digest,
    rig_from_mapping,
    rig_to_mapping,
    tilted_vlp16,
)


def mapping(**changes):
    return rig_to_mapping(tilted_vlp16("study", (0.03, 0.02))) | changes


def test_a_rig_survives_its_mapping():
    rig = rig_from_mapping(json.loads(json.dumps(mapping(gimbal_clock_offset_s=0.001))))
    assert rig.gimbal_clock_offset == 0.001
    assert rig_digest(rig_from_mapping(rig_to_mapping(rig))) == rig_digest(rig)


def test_beams_cross_where_the_maker_says():
    rig = tilted_vlp16("study", (0.0, 0.0))
    heights = rig.laser_heights + 0.04191 * np.tan(rig.laser_elevations)
    assert_allclose(heights, 0.0, rtol=0, atol=1e-12)
    assert_allclose(rig.laser_heights[[0, -1]], [0.0112, -0.0112], rtol=0, atol=5e-5)


def test_the_spin_axis_of_the_study_is_level():
    T = tilted_vlp16("study", (0.03, 0.02)).T_head_lidar
    assert_allclose(T[:3, 2], [1, 0, 0], rtol=0, atol=1e-12)
    assert_allclose(T[:3, 3], [0.03, 0.02, 0.0], rtol=0, atol=0)


def test_a_mounting_alone_is_a_rig():
    assert rig_from_mapping({"T_head_lidar": np.eye(4).tolist()}).cloud_carries_heights


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({}, "no T_head_lidar"),
        (mapping(tilt=1), "unknown key 'tilt'"),
        (mapping(T_head_lidar=[[1, 2], [3, 4]]), "four rows of four"),
        (mapping(T_head_lidar=(2 * np.eye(4)).tolist()), "T_head_lidar is not a rotation"),
        (mapping(R_mount_imu=np.diag([1.0, 1.0, -1.0]).tolist()), "R_mount_imu is not a rotation"),
        (mapping(laser_heights_m=[float("nan")] * 16), "not finite"),
        (mapping(laser_heights_m="high"), "wrong kind"),
        (mapping(laser_heights_m=[0.0]), "different lengths"),
        (mapping(divergence_rad=[0.0]), "shape"),
        (mapping(gimbal_clock_offset_s="soon"), "wrong kind"),
        (mapping(imu_mount="roof"), "wrong kind"),
        (mapping(cloud_carries_heights=1), "true or false"),
    ],
)
def test_a_rig_that_is_none_is_refused_with_the_reason(values, sentence):
    with pytest.raises(RigError, match=sentence):
        rig_from_mapping(values)
