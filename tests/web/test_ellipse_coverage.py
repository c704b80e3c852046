"""The page on the coverage of error ellipses."""

import numpy as np
import pytest

from spheremark.web.pages.base import Frame
from spheremark.web.pages.ellipse_coverage import (
    calibration_figure,
    coverage_page,
    squares_figure,
)

METHODS, QUANTITIES = ("free_station", "network"), {"horizontal": 2, "position": 3, "pose": 6}


@pytest.fixture
def report():
    """Stations that are within their ellipses as often as they should, but for one share."""
    keys = [(method, quantity) for method in METHODS for quantity in QUANTITIES]

    def shares(levels):
        return [
            {"method": m, "quantity": q, "level": level, "share": level, "low": level - 0.04,
             "high": level + 0.04, "n": 100}
            for m, q in keys for level in levels
        ]  # fmt: skip

    levels = shares((0.5, 0.68, 0.95))
    levels[0]["share"] = 0.4
    return {
        "made_at": "2026-01-02T03:04:05+00:00", "code_version": "1.2+gabc", "seed": 7,
        "n_surveys": 20, "n_stations": 100, "levels": levels, "curve": shares((0.25, 0.5, 0.75)),
        "methods": [
            {"method": m, "n": 100, "error_3d_rms_m": 0.00321, "sigma_3d_rms_m": 0.00333}
            for m in METHODS
        ],
        "nees": [
            {"method": m, "quantity": q, "dimensions": QUANTITIES[q], "per_dimension": 1.04,
             "counts": [60, 30, 10]}
            for m, q in keys
        ],
        "bins": [0.0, 0.5, 1.0, 1.5],
    }  # fmt: skip


def test_shares_that_miss_their_level_by_more_than_five_points_are_marked(report):
    text = coverage_page(Frame(), report)
    assert text.count('class="over"') == 1
    assert '<span class="over">40.0</span>' in text
    assert "Red shares are off by more than five points" in text
    assert "20 simulated surveys" in text
    assert "error 3.21 mm, predicted 3.33 mm" in text


def test_a_released_report_names_its_worlds(report):
    text = coverage_page(Frame(), report | {"is_released": True})
    assert "measured for the release" in text
    assert f"Seeds {report['seed']} to {report['seed'] + report['n_surveys'] - 1}" in text


def test_found_shares_are_drawn_against_nominal_ones_with_their_intervals(report):
    figure = calibration_figure(report, "position")
    network = next(trace for trace in figure.data if trace.name == "network")
    np.testing.assert_allclose(network.x, [25.0, 50.0, 75.0])
    np.testing.assert_allclose(network.error_y.array, 4.0)
    np.testing.assert_allclose(network.error_y.arrayminus, 4.0)
    assert figure.layout.xaxis.title.text == "Nominal share [%]"


def test_squares_are_a_density_beside_chi_square_of_their_dimension(report):
    figure = squares_figure(report, "position")
    bars = [trace for trace in figure.data if trace.type == "bar"]
    assert len(bars) == len(METHODS)
    for one in bars:
        assert np.sum(np.multiply(one.y, one.width)) == pytest.approx(1.0)
    assert figure.data[-1].name == "chi-square, 3 dimensions"
