import numpy as np
from numpy.testing import assert_allclose

from spheremark.pipelines.ground_model import ElevationModel
from spheremark.web.figures import site

NORTH_WEST = np.array([-1.0, 1.0]) / np.sqrt(2.0)


def model(heights, sigmas, cell=0.5):
    heights = np.asarray(heights, np.float32)
    return ElevationModel(
        corner=np.array([10.0, 20.0]),
        cell=cell,
        heights=heights,
        sigmas=np.asarray(sigmas, np.float32),
        counts=np.ones(heights.shape, np.int32),
        is_filled=np.zeros(heights.shape, np.bool_),
    )


def places(name, n):
    return {name: np.array(["a"] * n, dtype=object), "x_m": np.ones(n), "y_m": np.ones(n)}


def plane(slope, n=6):
    """Heights that rise by a slope in one direction, x and y."""
    y, x = np.mgrid[0:n, 0:n].astype(float)
    return slope[0] * x + slope[1] * y


def test_level_ground_is_half_bright_and_slopes_are_lit_from_the_north_west():
    assert_allclose(site.hillshade(np.zeros((4, 4)), 1.0), 0.5)
    assert site.hillshade(plane(-0.2 * NORTH_WEST), 1.0).min() > 0.5  # falls towards the light
    assert site.hillshade(plane(0.2 * NORTH_WEST), 1.0).max() < 0.5


def test_the_brightness_of_a_slope_does_not_depend_on_the_cell():
    slope = np.array([0.1, 0.05])
    assert_allclose(site.hillshade(plane(slope), 1.0), site.hillshade(plane(slope / 4), 0.25))


def test_heights_are_drawn_at_the_centres_of_their_cells_and_unknown_cells_stay_blank():
    heights = plane([0.1, 0.0], 4)
    heights[1, 2] = np.nan
    figure = site.ground(
        model(heights, np.full((4, 4), 0.01)), places("mark", 1), places("name", 2)
    )
    drawn = figure.data[0]
    assert_allclose(drawn.x, [10.25, 10.75, 11.25, 11.75])
    assert_allclose(drawn.y, [20.25, 20.75, 21.25, 21.75])
    assert_allclose(drawn.z, heights, atol=1e-4)
    assert [one.name for one in figure.data[2:]] == ["stations", "control marks"]
    assert figure.layout.yaxis.scaleanchor == "x"


def test_sigmas_are_drawn_in_millimetres_with_ticks_inside_their_range():
    sigmas = np.linspace(0.003, 0.04, 16).reshape(4, 4)
    drawn = site.sigma(model(np.zeros((4, 4)), sigmas), places("mark", 0), places("name", 0)).data[
        0
    ]
    assert_allclose(drawn.customdata, 1e3 * sigmas, atol=0.05)
    assert list(drawn.colorbar.ticktext) == ["5", "10", "20"]
    assert_allclose(drawn.colorbar.tickvals, np.log10([5, 10, 20]))


def test_a_large_ground_is_thinned_alike_in_both_directions():
    big = np.zeros((1200, 500))
    drawn = site.ground(model(big, big + 0.01), places("mark", 0), places("name", 0)).data[0]
    assert np.asarray(drawn.z).shape == (400, 167)
    assert_allclose(np.diff(drawn.x), 1.5)
    assert_allclose(np.diff(drawn.y), 1.5)
