"""Which returns have a limb opposite them that is seen, against the place of what hides it."""

import numpy as np
import pytest

from spheremark.pipelines.model import MarkerCandidate
from spheremark.pipelines.scan.stitching import beams
from spheremark.pipelines.sphere.linearisation import linearise
from spheremark.pipelines.sphere.occlusion import faces_seen, others_towards
from spheremark.pipelines.sphere.returns import returns_of
from tests.pipelines.synthetic_stop import RADIUS, cloud_of, fire, passing, sphere_ranges, towards

CENTRE = np.array([2.9, 1.7, 0.2])
AWAY = np.linalg.norm(CENTRE)
ACROSS = np.cross([0.0, 0.0, 1.0], CENTRE / AWAY)


def beside_plane(depth, edge):
    """A sphere and a plane at a depth from it, met by beams that pass it beyond an upright line.

    Returns which returns face a seen limb, and how far across they and their distances from the
    centre are [radii].
    """
    shots = towards(fire(), CENTRE, 2.5 * RADIUS)
    axis = CENTRE / AWAY
    on_plane = (AWAY + depth - shots.origins @ axis) / (shots.directions @ axis)
    along, _ = passing(shots, CENTRE)
    on_plane[(shots.origins + along[:, None] * shots.directions) @ ACROSS < edge] = np.inf
    on_sphere = sphere_ranges(shots.origins, shots.directions, CENTRE, RADIUS)
    ranges = np.minimum(on_sphere, on_plane)
    cloud = cloud_of(shots, ranges)
    rows = np.flatnonzero((on_sphere < on_plane)[np.isfinite(ranges)])
    candidate = MarkerCandidate(name="M01", members=rows, p_base_rough=CENTRE + 0.01)
    nothing = np.zeros(len(rows), np.intp)
    returns = returns_of(
        beams(cloud, rows),
        np.array([0, len(rows)]),
        np.array([0.0, 0.0, 1.0]),
        nothing,
        (nothing, np.full(len(rows), 0.01), 0.0),
    )
    linear = linearise(returns, np.array([[*CENTRE, RADIUS]]), np.full((1, 4, 4), 1e-9))
    others = others_towards(cloud, [candidate], RADIUS)
    is_seen = faces_seen(returns, linear, CENTRE[None], others, RADIUS)
    passed = returns.first_axes * linear.offsets[0] + returns.second_axes * linear.offsets[1]
    return is_seen, ACROSS @ passed / RADIUS, np.hypot(*linear.offsets) / RADIUS


@pytest.mark.parametrize("edge", [-0.3, 0.0, 0.3, 0.6])
def test_returns_opposite_what_hides_the_limb_do_not_face_it(edge):
    is_seen, across, distances = beside_plane(-0.8, edge * RADIUS)
    clear = (distances > 0.8) & (np.abs(across + edge) > 0.15)  # of the spacing of pulses
    faces_hidden = across < -edge
    assert faces_hidden[clear].any()
    assert np.array_equal(is_seen[clear], ~faces_hidden[clear])


@pytest.mark.parametrize("depth", [0.3, 1.0])
def test_what_stands_behind_hides_no_limb(depth):
    is_seen, across, _ = beside_plane(depth, 0.0)
    assert is_seen.all()
    assert across.max() > 0.9


def test_all_beams_that_pass_closely_are_found_wherever_they_end():
    rng = np.random.default_rng(5)
    shots = towards(fire(), CENTRE, 12 * RADIUS)
    ranges = 1.0 / rng.uniform(1 / 40, 1 / 0.9, len(shots.rings))
    along, gap2 = passing(shots, CENTRE)
    candidate = MarkerCandidate(
        name="M01", members=np.array([], np.intp), p_base_rough=CENTRE + 0.25 * RADIUS
    )
    others = others_towards(cloud_of(shots, ranges), [candidate], RADIUS)
    close = (along > 0) & (gap2 < (3 * RADIUS) ** 2)
    missing = np.setdiff1d(np.float32(ranges[close]), np.float32(others.beams.ranges))
    assert len(others.beams.ranges) < len(ranges)
    reach = np.abs(others.beams.ranges[:, None] - np.atleast_1d(missing)).min(axis=0, initial=9)
    assert reach.max(initial=0) < 1e-5  # of points in single precision
