"""Places at which a sphere may stand, by where a surface ends upward and to a side."""

import numpy as np

from spheremark.pipelines.detection.seeds import find_seeds
from spheremark.pipelines.detection.target import Target

RADIUS = 0.1
TARGET = Target(RADIUS, np.array([0.0, 0.0, 1.0]), 0.003)
CENTRE = np.array([2.5, 0.3, -0.4])


def ball(rng, n):
    """Returns on the side of a ball that faces the sensor."""
    out = rng.standard_normal((n, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    out[out @ CENTRE > 0.0] *= -1.0
    return CENTRE + RADIUS * out


def nearest(points):
    seeds = find_seeds(points.astype(np.float32), TARGET, 5)
    return np.linalg.norm(seeds - CENTRE, axis=1).min(initial=np.inf)


def test_dust_about_a_near_ball_does_not_hide_where_it_ends():
    rng = np.random.default_rng(0)
    dust = rng.uniform(CENTRE - 0.6, CENTRE + 0.6, (1500, 3))
    assert nearest(np.vstack([ball(rng, 2000), dust])) < 0.6 * RADIUS


def test_a_surface_does_not_end_where_another_goes_on():
    """Between the seeds of its upper corners, a wall has none."""
    rng = np.random.default_rng(0)
    wall = np.column_stack(
        [np.full(9000, 2.5), rng.uniform(-1, 1, 9000), rng.uniform(-1.2, 1, 9000)]
    )
    assert nearest(wall) > 3.0 * RADIUS
