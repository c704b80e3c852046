"""Parts of the sphere fit against dense, finite-difference or one-by-one counterparts."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from spheremark.pipelines.model import Beams
from spheremark.pipelines.sphere.description import limb_coverage
from spheremark.pipelines.sphere.estimation import _spread
from spheremark.pipelines.sphere.footprint import predict
from spheremark.pipelines.sphere.linearisation import linearise
from spheremark.pipelines.sphere.mounting import effects_on
from spheremark.pipelines.sphere.normal_equations import normals_of, reduce
from spheremark.pipelines.sphere.optics import UNKNOWNS, derivatives, with_widths
from spheremark.pipelines.sphere.radius import BeamErrors, Ranges, free_radii
from spheremark.pipelines.sphere.returns import (
    n_lines,
    of_markers,
    returns_of,
    scan_lines,
)

RADIUS, N_LASERS, SIGMA = 0.1, 3, 0.005
CENTRES = np.array([[6.0, 1.0, 0.2], [-2.0, 7.0, -0.1], [-5.0, -4.0, 0.3]])


@pytest.fixture(scope="module")
def stop():
    """Beams from near the origin at three spheres, and the same as returns."""
    rng, directions, starts = np.random.default_rng(3), [], [0]
    for centre, n in zip(CENTRES, (60, 90, 40), strict=True):
        aims = centre + rng.uniform(-0.1, 0.1, (n, 3))
        directions.append(aims / np.linalg.norm(aims, axis=1, keepdims=True))
        starts.append(starts[-1] + n)
    u = np.concatenate(directions)
    up, faces = np.array([0.0, 0.0, 1.0]), rng.choice([-1.0, 1.0], (len(u), 1))
    upward = up - (u @ up)[:, None] * u
    across = faces * upward / np.linalg.norm(upward, axis=1, keepdims=True)
    pulses = Beams(
        origins_base=rng.uniform(-0.02, 0.02, u.shape),
        directions_base=u,
        across_base=across,
        ranges=np.repeat(np.linalg.norm(CENTRES, axis=1), np.diff(starts)),
        divergence=np.array([3.0e-3, 1.5e-3]),
        intensities=np.full(len(u), 30.0, np.float32),
        rings=np.zeros(len(u), np.uint8),
        times=np.zeros(len(u)),
    )
    lasers = rng.integers(0, N_LASERS, len(u))
    noise = (np.zeros(len(u), np.intp), np.full(len(u), SIGMA), 1e-4)
    return pulses, returns_of(pulses, np.array(starts), up, lasers, noise)


def spheres_and_covs(sigma):
    covs = np.zeros((len(CENTRES), 4, 4))
    covs[:, :3, :3] = sigma**2 * np.eye(3)
    return np.column_stack([CENTRES, np.full(len(CENTRES), RADIUS)]), covs


def test_a_well_known_sphere_is_linearised_at_its_place(stop):
    pulses, returns = stop
    linear = linearise(returns, *spheres_and_covs(1e-6))
    exact = predict(pulses, CENTRES, np.full(3, RADIUS), returns.markers)
    # well inside the limb the rules of the two integrals agree to hundredths of a millimetre
    is_inside = np.hypot(*linear.offsets) + returns.half_widths.max(axis=0) < 0.85 * RADIUS
    assert is_inside.sum() > 50
    assert_allclose(linear.ranges[is_inside], exact.ranges[is_inside], rtol=0, atol=2e-5)
    assert_allclose(linear.J.T[is_inside], exact.J[is_inside], rtol=0, atol=2e-3)
    assert_allclose(linear.offsets.T, exact.offsets, rtol=0, atol=1e-12)


def test_near_the_limb_slopes_are_nearer_to_their_mean_over_the_uncertainty_than_at_one_place(stop):
    pulses, returns = stop
    rng, sigma, which = np.random.default_rng(9), 0.004, returns.markers
    radii = np.full(3, RADIUS)
    exact = predict(pulses, CENTRES, radii, which)
    is_limb = (exact.lit > 0.01) & (exact.lit < 0.999)
    assert is_limb.sum() > 20
    drawn = [
        predict(pulses, CENTRES + sigma * rng.standard_normal((3, 3)), radii, which).J[is_limb, :3]
        for _ in range(1000)
    ]
    mean = np.mean(drawn, axis=0)
    over_width = linearise(returns, *spheres_and_covs(sigma)).J.T[is_limb, :3]
    assert np.linalg.norm(over_width - mean) < 0.5 * np.linalg.norm(exact.J[is_limb, :3] - mean)


def test_the_eliminated_equations_have_the_solution_of_the_dense_ones(stop):
    _, returns = stop
    rng = np.random.default_rng(5)
    linear = linearise(returns, *spheres_and_covs(0.002))
    residuals = SIGMA * rng.standard_normal(len(returns.ranges))
    weights = rng.uniform(0.2, 1.0, len(residuals)) / SIGMA**2
    by_optics = derivatives(returns, returns, linear)
    q = len(by_optics)
    effects, precisions = effects_on(CENTRES), np.full(N_LASERS + q + 6, 1.0 / 0.01**2)
    N = normals_of(returns, (linear.J[:3], by_optics), residuals, weights, N_LASERS)
    reduced = reduce(N, effects, precisions, np.zeros(len(precisions)))
    shared = np.linalg.solve(reduced.N, reduced.rhs)

    design = np.zeros((len(residuals), 9 + N_LASERS + q + 6))
    design[:, 9 + N_LASERS : -6] = by_optics.T
    for i, m in enumerate(returns.markers):
        design[i, 3 * m : 3 * m + 3] = linear.J[:3, i]
        design[i, 9 + returns.lasers[i]] = 1.0
        design[i, -6:] = np.sign(returns.vertical[0, i]) * linear.J[:3, i] @ effects[m]
    assert_allclose(np.abs(returns.vertical[0]), 1.0)
    N = design.T @ (weights[:, None] * design) + np.diag([1.0] * 9 + list(precisions))
    dense = np.linalg.solve(N, design.T @ (weights * residuals))
    assert_allclose(reduced.local_steps(shared).ravel(), dense[:9], rtol=0, atol=1e-9)
    assert_allclose(shared, dense[9:], rtol=0, atol=1e-9)


@pytest.mark.parametrize("present", [(0.0, 0.0), (0.3, 0.8), (-0.4, 0.0)])
def test_derivatives_by_the_widths_agree_with_wider_footprints(stop, present):
    pulses, returns = stop
    spheres, covs = spheres_and_covs(1e-6)

    def predicted(width, window):
        wide = with_widths(returns, np.array([width, window, 0.0, 0.0, 0.0]))
        each = [
            predict(replace(pulses, divergence=own), CENTRES, spheres[:, 3], returns.markers)
            for own in (2.0 * wide.half_widths / returns.ranges).T
        ]
        ranges, lit = (
            np.array([getattr(one, name)[i] for i, one in enumerate(each)])
            for name in ("ranges", "lit")
        )
        return wide, ranges, lit

    widened, ranges, lit = predicted(*present)
    found = derivatives(returns, widened, linearise(widened, spheres, covs))
    seen, step = lit > 0.3, 0.1
    for k, row in enumerate(found[:2]):
        moved = np.array(present)
        moved[k] += step
        expected = (predicted(*moved)[1] - ranges)[seen] / step
        # the limb cuts some of the few strips of a footprint only when it is wider
        assert np.linalg.norm(row[seen] - expected) < 0.25 * np.linalg.norm(expected)


def test_the_derivative_by_the_weight_of_echoes_agrees_with_weighted_rays(stop):
    pulses, returns = stop
    spheres, covs = spheres_and_covs(1e-6)
    exact = predict(pulses, CENTRES, spheres[:, 3], returns.markers)
    seen, linear = exact.lit > 0.3, linearise(returns, spheres, covs)
    found = derivatives(returns, returns, linear)[UNKNOWNS.index("echo_cosine"), seen]
    depths = rays_of(returns, spheres)[seen]
    weighted = np.nansum(depths**2, axis=1) / np.nansum(depths, axis=1) - np.nanmean(depths, axis=1)
    assert_allclose(found, -weighted, rtol=0.1, atol=1e-4)


def rays_of(returns, spheres):
    """Depths of spheres, (n, rays), under the rays that fill each footprint; NaN beside them."""
    k = np.arange(1500)
    radii, turns = np.sqrt((k + 0.5) / len(k)), k * np.pi * (3 - np.sqrt(5))
    off = spheres[returns.markers, :3].T - returns.origins
    x = returns.half_widths[0][:, None] * radii * np.cos(turns)
    y = returns.half_widths[1][:, None] * radii * np.sin(turns)
    x = x - np.sum(off * returns.first_axes, axis=0)[:, None]
    y = y - np.sum(off * returns.second_axes, axis=0)[:, None]
    squares = RADIUS**2 - x**2 - y**2
    return np.sqrt(np.where(squares > 0.0, squares, np.nan))


def test_radii_of_many_spheres_are_those_of_each_alone(stop):
    _, returns = stop
    rng = np.random.default_rng(7)
    spheres, covs = spheres_and_covs(0.002)
    grown = spheres + np.array(
        [0.0, 0.0, 0.0, 0.012]
    )  # far from the assumed radius: steps are iterated
    ranges = linearise(returns, grown, covs).ranges
    ranges = ranges + 0.002 * rng.standard_normal(len(ranges))
    residuals = ranges - linearise(returns, spheres, covs).ranges
    observed = Ranges(ranges, np.full(len(ranges), 0.002**2), np.ones(len(ranges)))
    known = BeamErrors(np.zeros((1, len(ranges))), np.eye(1))
    together = np.array(free_radii(returns, observed, spheres, covs, residuals, known))
    for m in range(len(CENTRES)):
        one, rows = of_markers(returns, np.array([m]))
        its = Ranges(*(column[rows] for column in observed))
        its_known = BeamErrors(known.by_optics[:, rows], known.cov)
        alone = free_radii(one, its, spheres[[m]], covs[[m]], residuals[rows], its_known)
        assert_allclose(together[:, m], np.ravel(alone), rtol=1e-9)
    assert np.all(np.abs(together[0] - 0.112) < 4 * together[1])


def test_sigmas_of_radii_contain_what_unknown_optics_make_of_them(stop):
    """Draws of optics scatter the radii of ranges without noise as far as the sigmas say."""
    _, returns = stop
    spheres, covs = spheres_and_covs(0.002)
    linear = linearise(returns, spheres, covs)
    by_optics = derivatives(returns, returns, linear)[:1]
    cov, n = np.array([[0.3**2]]), len(returns.ranges)
    noise, nothing = np.full(n, 0.002**2), np.zeros((1, n))
    shifts = 0.1 * by_optics[0]  # small: the radius is linear in it

    def radii_of(residuals, errors):
        observed = Ranges(linear.ranges + residuals, noise, np.ones(n))
        return free_radii(returns, observed, spheres, covs, residuals, errors)

    moved = (radii_of(shifts, BeamErrors(nothing, cov))[0] - RADIUS) / 0.1
    _, by_noise = radii_of(np.zeros(n), BeamErrors(nothing, cov))
    _, found = radii_of(np.zeros(n), BeamErrors(by_optics, cov))
    assert_allclose(found**2, by_noise**2 + (0.3 * moved) ** 2, rtol=1e-6)
    assert np.all(found > 1.01 * by_noise)


def test_the_limb_is_covered_by_the_octants_that_have_returns():
    angles = np.radians(np.arange(22.5, 360.0, 45.0))
    directions = np.tile([[1.0], [0.0], [0.0]], len(angles))
    limb = 0.9 * RADIUS * np.stack([np.zeros(8), np.cos(angles), np.sin(angles)])
    assert limb_coverage(directions, limb, RADIUS) == 1.0
    assert limb_coverage(directions[:, :3], limb[:, :3], RADIUS) == 3.0 / 8.0
    assert limb_coverage(directions, 0.2 * limb, RADIUS) == 0.0


def test_lasers_that_cross_a_sphere_together_are_one_scan_line_in_whatever_order_they_come():
    crossings = np.array([0.3, 0.1, 0.2, 0.1, 0.3])  # [s], a revolution apart
    times = crossings + 1e-3 * np.array([0.0, 1.0, 2.0, 3.0, 4.0])
    assert scan_lines(times).tolist() == [2, 0, 1, 0, 2]
    assert n_lines(times) == 3
    assert n_lines(np.zeros(0)) == n_lines(times[:1]) == 1


def test_what_biases_have_in_common_does_not_loosen_their_prior():
    """Else it would grow with the prior that it loosens, as where outlines of spheres seem wide."""
    sigmas, cov = np.full(16, 0.003), 1e-8 * np.eye(16)
    apart = 0.006 * (-1.0) ** np.arange(16)
    as_they_are = _spread((apart, cov), sigmas, about_mean=True)
    assert as_they_are == pytest.approx(np.sqrt((16 * 4.0 + 2.0) / 17.0), rel=1e-3)
    assert _spread((apart + 0.03, cov), sigmas, about_mean=True) == pytest.approx(as_they_are)
    assert _spread((apart + 0.03, cov), sigmas, about_mean=False) > 4.0 * as_they_are
