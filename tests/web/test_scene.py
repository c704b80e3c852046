import numpy as np
import pytest
from numpy.testing import assert_allclose

from spheremark.web.figures import scene

CENTRE = np.array([6.0, 0.0, 0.5])
RADIUS = 0.1


def made_scan():
    """Return a sphere of 60 returns, 5 returns of its pole, and a floor that reaches far."""
    rng = np.random.default_rng(5)
    facing = rng.normal(size=(60, 3)) * 0.5 - [1.0, 0.0, 0.0]
    sphere = CENTRE + RADIUS * facing / np.linalg.norm(facing, axis=1, keepdims=True)
    pole = CENTRE + np.column_stack([np.zeros((5, 2)), np.linspace(-0.125, -0.11, 5)])
    floor = np.column_stack([rng.uniform(-40, 40, (50_000, 2)), np.full(50_000, -1.0)])
    points = np.concatenate([sphere, pole, floor]).astype(np.float32)
    residuals = np.full(len(points), np.nan, np.float32)
    residuals[:60] = 0.004
    return scene.Scan(
        p_station=points,
        markers=np.where(np.arange(len(points)) < 60, 0, -1),
        residuals=residuals,
        names=("M01",),
        fit_method="along_beam",
    )


def fits(method="along_beam", n=1):
    return {
        "fit_method": np.array([method], dtype=object)[:n],
        "marker": np.array(["M01"], dtype=object)[:n],
        "mark": np.array([None], dtype=object)[:n],
        "x_m": CENTRE[[0]][:n],
        "y_m": CENTRE[[1]][:n],
        "z_m": CENTRE[[2]][:n],
        "radius_m": np.array([RADIUS])[:n],
        "range_m": np.array([6.02])[:n],
        "rms_m": np.array([0.005])[:n],
        "n_points": np.array([60])[:n],
        "error_3d_m": np.array([np.nan])[:n],
    }


REJECTIONS = {
    "x_m": np.array([1.0]),
    "y_m": np.array([2.0]),
    "z_m": np.array([-1.0]),
    "reason": np.array(["Not round."], dtype=object),
}


def trace(figure, name):
    return next(one for one in figure.data if one.name == name)


def test_returns_of_a_marker_carry_the_residuals_that_were_kept():
    returns = scene.marker_returns(made_scan(), fits(), 0)
    assert np.count_nonzero(returns.is_used) == 60
    assert np.count_nonzero(~returns.is_used) == 5
    assert_allclose(returns.residuals[returns.is_used], 0.004, atol=1e-8)


def test_another_method_shows_distances_from_its_own_sphere():
    figure = scene.marker_residuals(made_scan(), fits("paper"), 0)
    assert figure.layout.yaxis.title.text == "Distance from the sphere [mm]"
    y = np.sort(np.abs(figure.data[0].y))
    assert_allclose(y[:60], 0.0, atol=1e-3)  # float32 at 6 m


def test_the_residual_plot_shows_its_sigma_in_millimetres():
    figure = scene.marker_residuals(made_scan(), fits(), 0)
    band = figure.layout.shapes[0]
    assert (band.y0, band.y1) == pytest.approx((-5.0, 5.0))
    assert_allclose(figure.data[0].y, 4.0, atol=1e-4)
    assert figure.layout.yaxis.title.text == "Residual along the beam [mm]"


def test_a_scene_has_equal_axes_and_colours_zero_neutrally():
    figure = scene.stop_scene(made_scan(), fits(), REJECTIONS)
    marker = trace(figure, "returns of markers").marker
    assert figure.layout.scene.aspectmode == "data"
    assert figure.layout.scene.xaxis.title.text == "x, station [m]"
    assert marker.cmin == -marker.cmax
    assert marker.colorscale[1] == (0.5, "var(--middle)")


def test_a_scene_ends_beyond_the_farthest_marker_and_stays_light():
    figure = scene.stop_scene(made_scan(), fits(), REJECTIONS)
    shown = trace(figure, "surroundings")
    assert np.hypot(shown.x, shown.y).max() < 10.0
    assert 100 < len(shown.x) < 30_000


def test_a_stop_without_markers_is_still_a_scene():
    figure = scene.stop_scene(made_scan(), fits(n=0), REJECTIONS)
    assert [one.name for one in figure.data] == ["surroundings", "rejected"]


def test_the_graticule_of_a_close_up_lies_on_the_sphere():
    figure = scene.marker_close_up(made_scan(), fits(), 0)
    sphere = trace(figure, "sphere")
    p = np.column_stack([sphere.x, sphere.y, sphere.z])
    radii = np.linalg.norm(p - CENTRE, axis=1)
    assert_allclose(radii[np.isfinite(radii)], RADIUS, atol=1e-5)
