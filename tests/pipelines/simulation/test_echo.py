import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from spheremark.pipelines.simulation.echo import Aims, trace
from spheremark.pipelines.simulation.scene import Mesh, Poles, Scene, Spheres

DIVERGENCE = np.array([3.0e-3, 1.5e-3])
RADIUS, DISTANCE = 0.100, 7.5


def aims(offsets):
    """Beams from the origin along x, moved sideways by offsets at the sphere; 16 at a time."""
    targets = np.column_stack([np.full(len(offsets), DISTANCE), offsets])
    return Aims(
        origins_site=np.zeros((len(offsets), 3)),
        directions_site=targets / np.linalg.norm(targets, axis=1, keepdims=True),
        spin_axes_site=np.tile([0.0, 0.0, 1.0], (len(offsets), 1)),  # sweeps along y
    )


def scene(wall_behind, shade=0.2):
    """A sphere at the distance, and a wall some way behind its centre."""
    x = DISTANCE + wall_behind
    corners = np.array([[x, -9, -9], [x, 9, -9], [x, 9, 9], [x, -9, 9]], dtype=float)
    nothing = np.zeros((0, 3))
    return Scene(
        mesh=Mesh.even(corners, np.array([[0, 1, 2], [0, 2, 3]]), shade),
        spheres=Spheres(
            p_site=np.array([[DISTANCE, 0.0, 0.0]]),
            radii=np.array([RADIUS]),
            reflectivities=np.array([0.5]),
        ),
        poles=Poles(feet_site=nothing, tops_site=nothing.copy(), radii=np.zeros(0)),
    )


@pytest.fixture
def raster():
    """Beams all over the sphere and its surroundings."""
    y, z = np.meshgrid(np.linspace(-0.2, 0.2, 160), np.linspace(-0.2, 0.2, 160))
    return np.column_stack([y.ravel(), z.ravel()])


def seen(world, offsets, divergence=DIVERGENCE, anyway=None):
    return trace(world, aims(offsets), divergence, anyway)


def test_a_pencil_beam_meets_the_sphere_where_geometry_says(raster):
    echoes = seen(scene(50.0), raster, np.zeros(2))
    directions = aims(raster).directions_site
    along = directions[:, 0] * DISTANCE
    inside = RADIUS**2 - (DISTANCE**2 - along**2)
    hits = inside > 0
    assert_allclose(echoes.ranges[hits], along[hits] - np.sqrt(inside[hits]), rtol=0, atol=1e-12)
    assert (echoes.ranges[~hits] > 50.0).all()


def test_a_wide_beam_in_the_middle_measures_the_mean_over_its_footprint():
    echoes = seen(scene(50.0), np.zeros((16, 2)))
    half_y, half_z = DIVERGENCE / 2 * (DISTANCE - RADIUS)
    mean_depth = (half_y**2 + half_z**2) / 4 / (2 * RADIUS)  # of y^2 and z^2 over an ellipse
    mean_depth += (half_y**2 + half_z**2) / 4 / (2 * (DISTANCE - RADIUS))  # rays fan out
    assert_allclose(echoes.ranges, DISTANCE - RADIUS + mean_depth, rtol=0, atol=1e-5)


def test_beams_that_only_brush_the_sphere_answer_too():
    grazing = np.tile([RADIUS + 0.008, 0.0], (16, 1))  # the footprint reaches 11 mm along the sweep
    along_axis = np.tile([0.0, RADIUS + 0.008], (16, 1))  # but only 6 mm along the spin axis
    assert (seen(scene(50.0, shade=0.001), grazing).ranges < DISTANCE).all()
    assert (seen(scene(50.0, shade=0.001), along_axis).ranges > 50.0).all()


def test_mixed_pixels_exist_at_the_edge_and_nowhere_else(raster):
    echoes = seen(scene(0.4), raster)
    reach = np.linalg.norm(raster, axis=1)
    is_mixed = (echoes.ranges > DISTANCE + 0.02) & (echoes.ranges < DISTANCE + 0.38)
    assert is_mixed.sum() > 500
    assert (np.abs(reach[is_mixed] - RADIUS) < 0.0125).all()


def test_returns_far_apart_split_and_the_stronger_one_is_reported(raster):
    echoes = seen(scene(3.0), raster)
    is_mixed = (echoes.ranges > DISTANCE + 0.02) & (echoes.ranges < DISTANCE + 2.9)
    assert not is_mixed.any()
    dark_wall = seen(scene(3.0, shade=0.001), raster).ranges < DISTANCE
    assert dark_wall.sum() > (echoes.ranges < DISTANCE).sum() + 50


def test_the_share_of_the_footprint_dims_an_echo():
    half = np.tile([RADIUS, 0.0], (16, 1))
    echoes = seen(scene(50.0, shade=0.001), half)
    assert_allclose(echoes.reflectivities, 0.25, rtol=0, atol=0.05)  # half of a shade of 0.5


def test_only_beams_near_spheres_are_traced_when_asked(raster):
    wide = raster * 10.0  # out to 2 m
    is_sampled = np.arange(len(wide)) // 16 % 128 == 0
    echoes = seen(scene(0.4), wide, anyway=is_sampled)
    is_traced = np.isfinite(echoes.ranges)
    is_near = np.linalg.norm(wide, axis=1) < 0.34
    assert is_traced[is_near | is_sampled].all()
    assert not is_traced[~is_sampled & (np.linalg.norm(wide, axis=1) > 0.36)].any()
    whole = seen(scene(0.4), wide)
    on_sphere = whole.ranges < DISTANCE
    assert_array_equal(echoes.ranges[on_sphere], whole.ranges[on_sphere])


def test_nothing_answers_from_an_empty_world():
    empty = scene(1.0)
    nothing = Scene(
        mesh=Mesh.merged([]),
        spheres=Spheres(p_site=np.zeros((0, 3)), radii=np.zeros(0), reflectivities=np.zeros(0)),
        poles=empty.poles,
    )
    assert np.isinf(seen(nothing, np.zeros((16, 2))).ranges).all()
