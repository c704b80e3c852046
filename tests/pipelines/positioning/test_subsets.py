"""The station from pairs and triples of its markers."""

from dataclasses import replace
from itertools import combinations
from time import thread_time

import numpy as np
import pytest

from spheremark.pipelines.config import RESECTION_METHODS, ResectionConfig
from spheremark.pipelines.errors import ConfigError
from spheremark.pipelines.positioning.resection import resect
from spheremark.pipelines.positioning.subsets import resect_subsets
from tests import chance
from tests.synthetic import control, field, pose, sightings

EXACT = 1e-7  # [m] and [rad] noise-free in, truth out
CONFIG = ResectionConfig(
    sigma_common=0.0, sigma_range=0.0, sigma_range_shared=0.0, sigma_height=0.0
)
STAND = (0.7, -1.2, 0.4)
LEAN = (0.06, -0.04)


@pytest.fixture
def rng():
    return np.random.default_rng(19)


def seen(marks, T, method="free_station", config=CONFIG, **how):
    """Pairs and triples by a method, from the free station of all markers."""
    fits = sightings(marks, T, **how)
    fix = resect("free_station", fits, marks, config)
    return resect_subsets([method], fix, fits, marks, config)[method]


def angles_of(v, chosen):
    unit = v / np.linalg.norm(v, axis=1, keepdims=True)
    return np.array(
        [[np.arccos(unit[i] @ unit[j]) for i, j in combinations(row, 2)] for row in chosen]
    )


def test_every_method_of_the_configuration_has_subsets_and_no_other(rng):
    marks = field(rng)
    for method in RESECTION_METHODS:
        pairs, triples = seen(marks, pose(STAND, 2.2), method)
        assert (pairs.method, triples.marks.shape[1]) == (method, 3)
    with pytest.raises(ConfigError, match="no resection method 'magic'; known: free_station"):
        seen(marks, pose(STAND, 2.2), "magic")


def test_free_station_has_all_pairs_and_triples_with_their_angles_and_places(rng):
    marks, T = field(rng), pose(STAND, 2.2, LEAN)
    for found, n in zip(seen(marks, T, lean=LEAN), (91, 364), strict=True):
        assert len({tuple(row) for row in found.marks.tolist()}) == n
        np.testing.assert_allclose(found.p_site, np.tile(T[:3, 3], (n, 1)), rtol=0, atol=EXACT)
        v = marks.p_site - T[:3, 3]
        for shown, of in (
            (found.included_angles, v),
            (found.included_angles_horizontal, v * [1, 1, 0]),
        ):
            expected = angles_of(of, found.marks)
            np.testing.assert_allclose(shown[:, 0], expected.min(axis=1), rtol=0, atol=1e-6)
            np.testing.assert_allclose(shown[:, 1], expected.max(axis=1), rtol=0, atol=1e-6)


@pytest.mark.parametrize("sigma_shared", [0.0, 5e-3])  # [m] of an error that centres share
@pytest.mark.parametrize("chosen", [(2, 9), (0, 1), (1, 6, 11)])
def test_a_subset_is_the_fix_of_its_markers_alone(rng, chosen, sigma_shared):
    p = field(rng).p_site.copy()
    p[chosen[0], 2] = p[chosen[1], 2] + 1.0  # [m] two marks at one height could be swapped
    marks, T = control(p), pose(STAND, 2.2, LEAN)
    noise, config = rng.normal(0, 4e-3, (14, 3)), replace(CONFIG, sigma_range=sigma_shared)
    towards = (marks.p_site - T[:3, 3]) @ T[:3, :3]
    shared = sigma_shared * (towards / np.linalg.norm(towards, axis=1, keepdims=True))[..., None]
    cov = 4e-3**2 * np.eye(3) + shared @ np.swapaxes(shared, 1, 2)
    fits = sightings(marks, T, lean=LEAN, noise=noise, cov=cov)
    pairs = zip(fits.fits, shared, strict=True)
    fits = replace(fits, fits=tuple(replace(fit, shared_base=one) for fit, one in pairs))
    fix = resect("free_station", fits, marks, config)
    every = resect_subsets(["free_station"], fix, fits, marks, config)["free_station"]
    found = every[len(chosen) - 2]
    row = int(np.flatnonzero(np.all(found.marks == chosen, axis=1))[0])
    few = replace(fits, fits=tuple(fits.fits[i] for i in chosen))
    alone = resect("free_station", few, control(marks.p_site[list(chosen)]), config)
    np.testing.assert_allclose(found.p_site[row], alone.p_site, rtol=0, atol=2e-6)
    assert found.sigma_3d[row] == pytest.approx(alone.sigma_3d, rel=5e-3)  # sigma of another pose


def test_pairs_of_centres_have_the_error_that_the_theory_says():
    # sigma sqrt(1 + cot^2(angle / 2) / 2) in the plane, heading unknown; heights: mean of two
    sigma = 5e-3
    for angle in np.radians([30, 60, 90, 120, 150, 179]):
        marks = control(
            [[7.5, 0, 0.8], [7.5 * np.cos(angle), 7.5 * np.sin(angle), 0.8], [-3, 2, 0.6]]
        )
        T = pose((0, 0, 0.8), 0.4)
        pairs, _ = seen(marks, T, cov=np.eye(3) * sigma**2, sigma_level=1e-6)
        horizontal = sigma * np.sqrt(1 + 1 / np.tan(angle / 2) ** 2 / 2)
        assert pairs.sigma_horizontal[0] == pytest.approx(horizontal, rel=1e-3)
        assert pairs.sigma_3d[0] == pytest.approx(
            np.hypot(horizontal, sigma / np.sqrt(2)), rel=1e-3
        )


def test_pairs_of_circles_have_the_error_that_the_theory_says(rng):
    sigma, marks = 4e-3, field(rng)
    pairs, _ = seen(marks, pose([0.0, 0.0, 0.9], 1.0), "paper", sigma_level=1e-6)
    assert len(pairs.marks) > 60
    theory = np.sqrt(2.0) * sigma / np.sin(pairs.included_angles_horizontal[:, 0])
    np.testing.assert_allclose(pairs.sigma_horizontal, theory, rtol=1e-3)
    np.testing.assert_allclose(pairs.p_site, np.tile([0, 0, 0.9], (len(theory), 1)), atol=EXACT)


@pytest.mark.parametrize("method", ["free_station", "paper"])
def test_predicted_sigmas_are_the_spread_of_the_errors(rng, method):
    marks, T = field(rng, 6), pose(STAND, 2.2)
    ratios = []
    for _ in range(500):
        level = rng.normal(0, 2e-3, 2)
        found = seen(
            marks, T, method, lean=level, sigma_level=2e-3, noise=rng.normal(0, 4e-3, (6, 3))
        )
        ratios.append(
            [
                np.mean((one.p_site - T[:3, 3])[:, :2] ** 2 / one.sigma_horizontal[:, None] ** 2)
                for one in found
            ]
        )
    slack = chance.of_mean(ratios)
    assert np.all(slack < 0.1)
    assert np.all(np.abs(np.mean(ratios, axis=0) - 0.5) < slack)


@pytest.mark.parametrize("method", ["free_station", "paper"])
def test_errors_that_all_centres_share_are_in_the_predicted_sigmas_as_shared(rng, method):
    bias, height, own, lean = 3e-3, 3e-3, 3e-3, 1e-3  # [m] and [rad]
    config = replace(
        CONFIG, sigma_range=bias, sigma_range_shared=bias, sigma_height=height, test_level=1e-6
    )
    marks, T, flat, upright = field(rng, 6), pose([0.5, -0.4, -0.2], 2.2), [], []
    towards = (marks.p_site - T[:3, 3]) @ T[:3, :3]
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    cov = own**2 * np.eye(3) + bias**2 * towards[:, :, None] * towards[:, None, :]
    for _ in range(500):
        noise = rng.normal(0, own, (6, 3)) + rng.normal(0, bias) * towards
        noise[:, 2] += rng.normal(0, height)
        found = seen(
            marks, T, method, config=config, lean=tuple(rng.normal(0, lean, 2)),
            sigma_level=lean, cov=cov, noise=noise,
        )  # fmt: skip
        off = [one.p_site - T[:3, 3] for one in found]
        rows = list(zip(off, found, strict=True))
        flat.append(
            [np.mean(np.sum(d[:, :2] ** 2, axis=1) / x.sigma_horizontal**2) for d, x in rows]
        )
        upright.append(
            [np.mean(d[:, 2] ** 2 / (x.sigma_3d**2 - x.sigma_horizontal**2)) for d, x in rows]
        )
    # as if every centre had them for itself: 0.6 to 1.2 in the plane, 1.5 to 2.5 upright
    for ratios in (flat, upright):
        slack = chance.of_mean(ratios)
        assert np.all(slack < 0.3)
        assert np.all(np.abs(np.mean(ratios, axis=0) - 1.0) < slack)


def test_a_third_mark_never_makes_the_prediction_worse(rng):
    pairs, triples = seen(field(rng), pose(STAND, 2.2))
    of_pair = {tuple(m): s for m, s in zip(pairs.marks.tolist(), pairs.sigma_3d, strict=True)}
    for marks, sigma in zip(triples.marks.tolist(), triples.sigma_3d, strict=True):
        assert sigma < min(of_pair[pair] for pair in combinations(marks, 2))


def test_a_pair_on_a_plumb_line_is_left_out():
    marks = control([[5, 0, 0.5], [5, 0, 1.7], [0, 6, 0.9], [-4, -3, 1.3]])
    pairs, triples = seen(marks, pose((0, 0, 0.8), 0.4))
    assert len(pairs.marks) == 5
    assert [0, 1] not in pairs.marks.tolist()
    assert len(triples.marks) == 4


def test_circles_that_only_touch_are_left_out_and_those_that_miss_each_other_are_met_between():
    marks = control([[7.5, 0, 0.8], [-7.5, 0.01, 0.8], [0, 7.0, 0.8], [-7.4, 1.2, 0.8]])
    noise = np.zeros((4, 3))
    noise[[0, 3], 0] = [-0.04, 0.04]  # both distances too short: the circles do not meet
    pairs, triples = seen(marks, pose((0, 0, 0.8), 0.0), "paper", noise=noise)
    assert [0, 1] not in pairs.marks.tolist()
    assert len(triples.marks) == 4
    row = pairs.marks.tolist().index([0, 3])
    assert abs(pairs.p_site[row, 0]) < 0.05
    assert np.isfinite(pairs.p_site).all()


def test_two_slope_distances_tell_no_position_and_three_do(rng):
    marks = field(rng)
    p = marks.p_site.copy()
    p[:, 2] = rng.uniform(0.0, 5.0, len(p))
    pairs, triples = seen(control(p), pose(STAND, 2.2), "ranges")
    assert len(pairs.marks) == 0
    assert len(triples.marks) > 200
    np.testing.assert_allclose(
        triples.p_site, np.tile(STAND, (len(triples.marks), 1)), rtol=0, atol=1e-6
    )


@pytest.mark.parametrize("method", ["free_station", "paper"])
def test_all_subsets_of_a_stop_cost_less_than_the_fix_of_a_few_of_them(rng, method):
    marks, T = field(rng), pose(STAND, 2.2)
    fits = sightings(marks, T, noise=rng.normal(0, 4e-3, (14, 3)))
    fix = resect("free_station", fits, marks, CONFIG)

    def cost(work):
        start = thread_time()
        work()
        return thread_time() - start

    resect_subsets([method], fix, fits, marks, CONFIG)
    whole = min(cost(lambda: resect_subsets([method], fix, fits, marks, CONFIG)) for _ in range(5))
    one = min(cost(lambda: resect("free_station", fits, marks, CONFIG)) for _ in range(5))
    assert whole < 10 * one  # 455 of them
