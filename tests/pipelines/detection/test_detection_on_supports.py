"""Markers on the ground, on drums, posts and tripods: what is below them stops beams."""

from dataclasses import replace

import numpy as np
import pytest

from spheremark.pipelines.config import ExtractionConfig
from spheremark.pipelines.detection import extract
from spheremark.pipelines.detection.beams import _behind
from spheremark.pipelines.model import RING_UNKNOWN
from tests.pipelines.synthetic_stop import RADIUS, World, ring_of_markers, scan

GROUND, N = -0.8, 6
DRUM_RADIUS = 0.25


def ring(distance, height, turn):
    """Places around the sensor, their centres so high above the ground [m]."""
    phi = 2 * np.pi * (np.arange(N) + turn) / N
    level = distance * np.column_stack([np.cos(phi), np.sin(phi)])
    return np.column_stack([level, np.full(N, GROUND + height)])


def found_in(places, posts=(), has_rings=True):
    """Whether each place has a marker, and how many markers lie elsewhere, among some on poles."""
    on_poles = ring_of_markers(n=5)
    world = World(
        balls=tuple((tuple(p), RADIUS) for p in (*on_poles, *places)), posts=posts, ground=GROUND
    )
    cloud = scan(world, np.random.default_rng(8))
    if not has_rings:  # nothing shows which pulses had no return
        cloud = replace(cloud, rings=np.full_like(cloud.rings, RING_UNKNOWN))
    found = extract(cloud, ExtractionConfig(), RADIUS)
    rough = np.array([one.p_base_rough for one in found.candidates])
    gaps = np.linalg.norm(rough[:, None] - np.vstack([on_poles, places]), axis=2)
    is_met = gaps < 0.5 * RADIUS
    return is_met[:, 5:].any(axis=0), int(np.sum(~is_met.any(axis=1)))


@pytest.mark.parametrize(
    ("distance", "height"), [(3.5, 0.5), (6.0, 0.5), (6.0, 0.8), (6.0, 1.2), (8.0, 2.0)]
)
def test_markers_on_drums_are_found(distance, height):
    places = ring(distance, height + RADIUS, 0.5)
    drums = tuple(((x, y, GROUND), DRUM_RADIUS, height) for x, y, _ in places)
    is_found, n_others = found_in(places, drums)
    assert is_found.all()
    assert n_others == 0


@pytest.mark.parametrize(("distance", "share"), [(4.0, 0.8), (9.0, 0.6)])
def test_markers_on_posts_nearly_as_wide_are_found(distance, share):
    places, height = ring(distance, 1.0, 0.5), 1.0 - RADIUS
    posts = tuple(((x, y, GROUND), share * RADIUS, height) for x, y, _ in places)
    is_found, n_others = found_in(places, posts)
    assert is_found.all()
    assert n_others == 0


@pytest.mark.parametrize("has_rings", [True, False])
@pytest.mark.parametrize("distance", [5.0, 9.0])
def test_markers_on_tripods_as_high_as_people_are_found(distance, has_rings):
    """Before the sky: the head of a tripod begins where shoulders would, but no body is below."""
    places = ring(distance, 1.6, 0.5)
    heads = tuple(((x, y, z - RADIUS - 0.19), 0.08, 0.1) for x, y, z in places)
    rods = tuple(((x, y, z - RADIUS - 0.1), 0.01, 0.1) for x, y, z in places)
    legs = tuple(
        ((x + a, y + b, GROUND), 0.02, z - GROUND - RADIUS - 0.19)
        for x, y, z in places
        for a, b in ((0.0, 0.0), (0.2, 0.0), (0.0, -0.2))
    )
    is_found, n_others = found_in(places, (*heads, *rods, *legs), has_rings)
    assert is_found.all()
    assert n_others == 0


@pytest.mark.parametrize(("distance", "has_rings"), [(9.0, True), (5.0, False), (9.0, False)])
def test_heads_that_are_spheres_are_none_on_bodies(distance, has_rings):
    """Helmets as large as markers: a body below them stops beams that pass the legs of a tripod."""
    heads = ring(distance, 1.6, 0.5)
    bodies = tuple(((x, y, GROUND), 0.2, z - GROUND - 0.22) for x, y, z in heads)
    is_found, n_others = found_in(heads, bodies, has_rings)
    assert not is_found.any()
    assert n_others == 0


def test_posts_as_wide_as_markers_are_none():
    tops = ring(6.0, 1.0, 0.5)
    posts = tuple(((x, y, GROUND), RADIUS, 1.0) for x, y, _ in tops)
    is_found, n_others = found_in(tops, posts)
    assert not is_found.any()
    assert n_others == 0


@pytest.mark.parametrize("distance", [3.0, 4.5, 6.0])
def test_markers_on_the_ground_are_found(distance):
    is_found, n_others = found_in(ring(distance, RADIUS, 0.5))
    assert is_found.all()
    assert n_others == 0


def densities_below(z_beside, z_below):
    """Density of a beam below an object, where those beside it at the same height end."""
    sides = np.linspace(-2.2, 2.2, 40)
    low = np.stack([sides, np.full(40, -1.5), np.full(40, z_beside)])
    below = np.array([[0.0], [-1.5], [z_below]])
    return _behind(below, low, np.zeros(1), (np.array([0.003]), 0.98))


def test_beams_below_an_object_end_as_those_beside_them_do():
    on_drum, wide = densities_below(-0.8, -0.8)
    before_drum, _ = densities_below(-0.8, 1.5)
    assert on_drum > 5.0 * before_drum
    assert wide > 0.9
    past, wide = densities_below(np.inf, np.inf)
    assert past > 0.9
    assert wide == 0.0
    behind_the_pole, wide = densities_below(0.8, 0.8)
    assert behind_the_pole == on_drum
    assert wide == 0.0


def test_the_side_of_a_box_goes_on_below_an_object():
    """It turns by 50 degrees from the line of sight: no beam beside it is as deep as one below."""
    sides = np.array([-2.2, -1.9, -1.6, -1.3, 1.3, 1.6, 1.9, 2.2])
    low = np.stack([sides, np.full(8, -1.5), 0.8 * sides])
    depths = np.array([0.0, 0.7])
    below = np.stack([np.zeros(2), np.full(2, -1.5), depths])
    on_side, off_side = _behind(below, low, np.zeros(2), (np.full(2, 0.003), 0.98))[0]
    assert on_side > 5.0 * off_side
    assert off_side > 0.02  # it may turn a corner there


def test_beams_below_end_as_the_others_below_do_if_something_wide_is_there():
    """A stone bulges: none of the beams beside an object is as deep as those on it below."""
    sides = np.array([-2.2, -1.8, 1.8, 2.2])
    low = np.stack([sides, np.full(4, -1.5), np.full(4, 0.5)])
    below = np.stack([np.linspace(-0.4, 0.4, 9), np.full(9, -1.5), np.full(9, -1.0)])
    on_pole, doubtful, on_stone = (
        _behind(below, low, np.full(9, held), (np.full(9, 0.003), 0.98))[0]
        for held in (0.0, 0.5, 1.0)
    )
    assert (on_stone > 5.0 * on_pole).all()
    assert ((on_pole < doubtful) & (doubtful < on_stone)).all()
    alone = _behind(below[:, :1], low, np.ones(1), (np.full(1, 0.003), 0.98))[0]
    np.testing.assert_allclose(alone, on_pole[0])  # a beam says nothing about itself
