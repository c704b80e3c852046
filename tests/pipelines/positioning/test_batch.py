"""Stations in compiled loops, against the adjustment of each alone."""

from itertools import combinations

import numpy as np
import pytest

from spheremark.pipelines.config import ResectionConfig
from spheremark.pipelines.geometry import rigid, rot_z
from spheremark.pipelines.positioning.batch import Sightings, adjust, meet, place
from spheremark.pipelines.positioning.matching import gather, solve_pose
from tests.synthetic import field, pose, sightings

STAND, LEAN = (0.7, -1.2, 0.4), (0.06, -0.04)


@pytest.fixture
def rng():
    return np.random.default_rng(23)


def scene_of(rng, n=8):
    """A scene whose marks are their markers' in turn, and a pose near the truth."""
    marks, T = field(rng, n), pose(STAND, 2.2, LEAN)
    fits = sightings(marks, T, lean=LEAN, noise=rng.normal(0, 4e-3, (n, 3)))
    scene = gather(fits, marks, ResectionConfig())
    start = T @ rigid(scene.R_station_base @ rot_z(0.02), [0.05, -0.03, 0.02])
    start[:3, 3] -= scene.middle
    return scene, start


def seen_of(scene):
    return Sightings(
        p_base=scene.centres_base,
        cov_base=scene.cov_centres,
        marks=scene.marks_site,
        cov_marks=scene.cov_marks,
        up_base=scene.R_station_base[2],
        J_up=scene.sigma_level * scene.J_up,
    )


def test_stations_stand_where_the_adjustment_of_each_alone_puts_them(rng):
    scene, start = scene_of(rng)
    chosen = np.array(list(combinations(range(8), 5)))
    found = adjust(chosen, seen_of(scene), start)
    assert found.is_settled.all()
    for row, T, cov in zip(chosen, found.T, found.cov, strict=True):
        alone = solve_pose(scene, np.stack([row, row], axis=1), start)
        np.testing.assert_allclose(T, alone.estimate, rtol=0, atol=1e-8)
        shift = np.eye(6)
        shift[3:, :3] = [
            [0.0, T[2, 3], -T[1, 3]],
            [-T[2, 3], 0.0, T[0, 3]],
            [T[1, 3], -T[0, 3], 0.0],
        ]  # a turn about the station moves it nowhere; one about the middle of the marks does
        np.testing.assert_allclose(cov, shift @ alone.cov @ shift.T, rtol=1e-5, atol=1e-12)


def test_what_is_no_number_settles_nowhere_and_spoils_no_other(rng):
    scene, start = scene_of(rng)
    chosen = np.array([[0, 1, 2], [1, 2, 3], [3, 4, 5]])
    seen = seen_of(scene)
    spoilt = seen.marks.copy()
    spoilt[0] = np.nan
    found = adjust(chosen, seen._replace(marks=spoilt), start)
    assert found.is_settled.tolist() == [False, True, True]
    np.testing.assert_array_equal(found.T[1:], adjust(chosen[1:], seen, start).T)
    R, t, weights = start[:3, :3], start[:3, 3], np.tile(1e4 * np.eye(3), (8, 1, 1))
    q, up = seen.p_base @ R.T, R @ seen.up_base
    placed = place(chosen, q, spoilt - t, weights, up, 1e6 * np.eye(2))
    assert placed.is_settled.tolist() == [False, True, True]
    distances = np.linalg.norm(seen.marks - t, axis=1)[:, None]
    met = meet(chosen, spoilt, distances, np.full((8, 1, 1), 1e4), t)
    assert met.is_settled.tolist() == [False, True, True]
    np.testing.assert_allclose(met.p[1:], np.tile(t, (2, 1)), rtol=0, atol=1e-6)
