import numpy as np
import pytest
from numpy.testing import assert_allclose

from spheremark.pipelines.positioning.subsets import angles_that_keep, theory_of_pairs

TOLERANCE = 0.03


def test_limits_are_where_the_theory_meets_the_tolerance():
    for sigma, degrees in ((0.017, 52.0), (0.010, 28.0)):
        least, widest = angles_that_keep("free_station", sigma, TOLERANCE)
        assert np.degrees(least) == pytest.approx(degrees, abs=0.5)
        assert widest == np.pi
        assert theory_of_pairs("free_station", sigma, least) == pytest.approx(TOLERANCE)
    least, widest = angles_that_keep("paper", 0.01, TOLERANCE)
    assert_allclose(theory_of_pairs("paper", 0.01, np.array([least, widest])), TOLERANCE)


@pytest.mark.parametrize("method", ["free_station", "paper"])
def test_centres_as_bad_as_the_tolerance_keep_it_at_no_angle(method):
    assert np.isnan(angles_that_keep(method, 1.01 * TOLERANCE, TOLERANCE)).all()
