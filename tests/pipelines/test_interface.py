"""The functions for notebooks: their answers are those of the parts that they join."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import spheremark
from spheremark.pipelines.errors import InputError
from spheremark.pipelines.placement import Costs, PlaceRules
from spheremark.pipelines.simulation import SimulationConfig, scenario, simulate_stop
from tests import chance

CENTRES = np.array([[4.0, 1.0, 0.2], [-3.0, 4.0, 0.1], [0.5, -5.0, 0.4]])
RADIUS = 0.10


def scan_of_spheres(rng, sigma=0.002):
    """Even beams from the origin on three spheres on poles above flat ground at z = -1 m."""
    azimuth, elevation = np.meshgrid(
        np.arange(-np.pi, np.pi, 0.002), np.arange(-0.5, 0.25, 0.002), indexing="ij"
    )
    d = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
         np.sin(elevation)], axis=-1,
    ).reshape(-1, 3)  # fmt: skip
    with np.errstate(divide="ignore"):
        ranges = np.where(d[:, 2] < 0, -1.0 / d[:, 2], np.inf)
    for centre in CENTRES:
        along = d @ centre
        inside = along**2 - centre @ centre + RADIUS**2
        met = along - np.sqrt(np.maximum(inside, 0.0))
        ranges = np.where((inside > 0) & (met > 0) & (met < ranges), met, ranges)
    seen = ranges < 20.0
    noisy = ranges[seen] + sigma * rng.standard_normal(int(seen.sum()))
    return d[seen] * noisy[:, None]


def centres_of(fits):
    p = np.array([fit.p_base for fit in fits.fits])
    return p[np.argsort(p[:, 0])]


def test_spheres_of_a_cloud_are_found_where_they_stand():
    xyz = scan_of_spheres(np.random.default_rng(3))
    found = spheremark.find_spheres(xyz, RADIUS, divergence=1e-4)
    want = CENTRES[np.argsort(CENTRES[:, 0])]
    assert len(found.fits) == len(want)
    errors = centres_of(found) - want
    covs = [f.cov_p_base for f in sorted(found.fits, key=lambda f: f.p_base[0])]
    squared = [e @ np.linalg.solve(c, e) for e, c in zip(errors, covs, strict=True)]
    assert sum(squared) < 27.9  # chi-square with 9 degrees of freedom, one run in a thousand


def test_moving_the_cloud_and_its_sensor_moves_the_centres_and_nothing_else():
    xyz, shift = scan_of_spheres(np.random.default_rng(4)), np.array([1000.0, -500.0, 30.0])
    still = spheremark.find_spheres(xyz, RADIUS, divergence=1e-4)
    moved = spheremark.find_spheres(xyz + shift, RADIUS, origins=shift, divergence=1e-4)
    assert_allclose(centres_of(moved) - shift, centres_of(still), rtol=0, atol=1e-6)  # [m]


def test_rows_that_are_not_finite_are_left_out():
    xyz = scan_of_spheres(np.random.default_rng(5))
    holed = np.vstack([xyz, np.full((10, 3), np.nan)])
    first, second = (spheremark.find_spheres(p, RADIUS) for p in (xyz, holed))
    assert_allclose(centres_of(first), centres_of(second), rtol=0, atol=0)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"xyz": np.zeros((4, 2))}, r"shape \(4, 2\)"),
        ({"xyz": np.full((4, 3), np.nan)}, "None of the 4 rows"),
        ({"rings": np.zeros(4)}, r"rings has shape \(4,\)"),
        ({"origins": np.zeros((2, 3))}, r"origins has shape \(2, 3\)"),
        ({"origins": np.diag([0.0, 2.0, 4.0])}, "several positions"),
    ],
)
def test_a_cloud_that_cannot_be_used_is_refused_with_what_was_found(change, sentence):
    given = {"xyz": np.ones((3, 3)), "radius": RADIUS} | change
    with pytest.raises(InputError, match=sentence):
        spheremark.find_spheres(given.pop("xyz"), given.pop("radius"), **given)


def test_scans_are_processed_and_adjusted_with_two_calls():
    quick, seeds, squares = SimulationConfig(only_near_spheres=True), (2, 4, 6, 8, 11, 12), []
    for seed in seeds:
        field = scenario("paper-field", seed)
        made = [simulate_stop(field, stop.name, quick) for stop in field.stops[:2]]
        stops = [spheremark.process(one.log, marks=field.marks)[0] for one in made]
        network = spheremark.adjust(stops, field.marks)
        assert network.T_site_station.shape == (2, 4, 4)
        for one, T, cov in zip(
            made, network.T_site_station, network.station_covariances, strict=True
        ):
            error = T[:3, 3] - one.truth.T_site_base[:3, 3]
            squares.append(error @ np.linalg.solve(cov, error))
    # the two stations of a survey share its rig and marks: as one of three degrees of freedom
    assert np.mean(squares) / 3.0 < chance.of_mean_square(3 * len(seeds))[1]


def test_an_optimised_plan_is_better_than_marks_in_a_bunch_and_evaluates_to_what_it_promised():
    stops = np.array([[0.0, 0.0, 1.05], [3.0, 1.0, 1.05]])
    costs = Costs(per_mark=2.0, per_metre=0.1)
    found = spheremark.optimise_plan(stops, 4, rules=PlaceRules(spacing=2.0), costs=costs)
    assert_allclose(found.cost, 8.0 + 0.1 * found.walk, rtol=1e-12)
    bunch = spheremark.evaluate_plan([[6, 0, 1], [6, 1.5, 1], [7, 0, 1], [7, 1.5, 1]], stops)
    assert found.evaluation.sigma_3d.max() < bunch.sigma_3d.max()
    again = spheremark.evaluate_plan(found.evaluation.marks.p_site, stops)
    assert_allclose(again.sigma_3d, found.evaluation.sigma_3d, rtol=0.05)


def test_every_public_name_loads():
    for name in spheremark.__all__:
        assert getattr(spheremark, name).__doc__, name
    with pytest.raises(AttributeError, match="no attribute 'nope'"):
        spheremark.nope  # noqa: B018
