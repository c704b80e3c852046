import numpy as np
import pytest
from numpy.testing import assert_allclose

from spheremark.pipelines.accuracy.truth import UNMATCHED, centre_errors, mean_incidence, summarise
from spheremark.pipelines.geometry import inverse, rigid, rot_x, rot_y, rot_z, transform
from spheremark.pipelines.model import Beams, ControlMarks, StopTruth

EXACT = 1e-12  # [m]


def field(rng, n=14):
    marks = rng.uniform([-9, -9, 0.5], [9, 9, 1.5], (n, 3))
    names = tuple(f"T{i}" for i in range(n))
    return ControlMarks(names=names, p_site=marks, cov_p_site=np.zeros((n, 3, 3)))


def leaning_stop(rng):
    R = rot_z(rng.uniform(-3, 3)) @ rot_y(0.05) @ rot_x(-0.03)
    return StopTruth(name="stop", T_site_base=rigid(R, rng.uniform(-3, 3, 3)))


def test_the_error_of_a_moved_centre_is_its_motion_in_the_base_frame():
    rng = np.random.default_rng(1)
    marks, stop = field(rng), leaning_stop(rng)
    motions = rng.normal(0, 0.02, (14, 3))
    p_base = transform(inverse(stop.T_site_base), marks.p_site) + motions
    order = rng.permutation(14)
    errors = centre_errors(p_base[order], stop, marks)
    assert_allclose(errors.error_base, motions[order], rtol=0, atol=EXACT)
    assert np.array_equal(errors.marks, order)


def test_the_radial_error_is_positive_away_from_the_station():
    rng = np.random.default_rng(2)
    marks, stop = field(rng), leaning_stop(rng)
    p_base = transform(inverse(stop.T_site_base), marks.p_site)
    errors = centre_errors(
        p_base * (1 + 0.01 / np.linalg.norm(p_base, axis=1))[:, None], stop, marks
    )
    assert_allclose(errors.error_radial, 0.01, rtol=0, atol=EXACT)


def test_a_false_marker_has_no_error_and_takes_no_true_mark():
    rng = np.random.default_rng(3)
    marks, stop = field(rng), leaning_stop(rng)
    p_base = transform(inverse(stop.T_site_base), marks.p_site)
    errors = centre_errors(np.vstack([p_base[:3], [[40.0, 0.0, 0.0]]]), stop, marks)
    assert errors.marks.tolist() == [0, 1, 2, UNMATCHED]
    assert np.isnan(errors.error_3d[3])
    assert_allclose(errors.error_3d[:3], 0, rtol=0, atol=EXACT)


def test_no_centres_have_no_errors():
    rng = np.random.default_rng(4)
    assert len(centre_errors(np.zeros((0, 3)), leaning_stop(rng), field(rng)).error_3d) == 0


def test_a_summary_leaves_out_what_is_unknown():
    summary = summarise([0.03, np.nan, 0.04, 0.0], tolerance=0.03)
    assert summary.n == 3
    assert summary.rms == pytest.approx(np.sqrt(25e-4 / 3))
    assert summary.share_within == pytest.approx(2 / 3)
    assert summary.largest == 0.04


def test_a_summary_of_nothing_says_so():
    summary = summarise([np.nan], tolerance=0.03)
    assert summary.n == 0
    assert np.isnan(summary.rms)


def test_beams_through_the_middle_meet_a_sphere_square_and_grazing_ones_at_its_edge():
    offsets = np.array([0.0, 0.05, 0.2])
    n = len(offsets)
    shots = Beams(
        origins_base=np.column_stack([np.zeros(n), offsets, np.zeros(n)]),
        directions_base=np.tile([1.0, 0.0, 0.0], (n, 1)),
        ranges=np.full(n, 8.0),
        across_base=np.tile([0.0, 1.0, 0.0], (n, 1)),
        rings=np.zeros(n, dtype=np.uint8),
        intensities=np.zeros(n),
        times=np.zeros(n),
        divergence=np.array([0.003, 0.0015]),
    )
    expected = np.radians((0.0 + 30.0 + 90.0) / 3)
    found = mean_incidence(shots, np.array([8.0, 0.0, 0.0]), 0.1)
    assert found == pytest.approx(expected, abs=1e-9)
