"""Centres against the truth of a small world: noise-free, repeated, and with what spoils them."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import chi2

from spheremark.pipelines.accuracy.truth import marker_errors
from spheremark.pipelines.config import (
    FITTING_METHODS,
    ExtractionConfig,
    FittingConfig,
    StitchingConfig,
)
from spheremark.pipelines.detection import extract
from spheremark.pipelines.errors import ConfigError, DegenerateGeometryError
from spheremark.pipelines.geometry import rot_z
from spheremark.pipelines.model import (
    RING_UNKNOWN,
    MarkerCandidate,
    MarkerCandidates,
    Rejection,
    Status,
    Timed,
    marker_name,
)
from spheremark.pipelines.published import TABLE_2
from spheremark.pipelines.scan.stitching import beams, stitch
from spheremark.pipelines.simulation import SimulationConfig, scenario, simulate_stop
from spheremark.pipelines.sphere import METHODS, fit_markers
from spheremark.pipelines.sphere.bound import cramer_rao, hits
from spheremark.pipelines.sphere.footprint import predict
from spheremark.pipelines.sphere.methods.along_beam import fit_ranges
from tests import chance
from tests.pipelines.synthetic_stop import (
    RADIUS,
    RIG,
    Shots,
    cloud_of,
    fire,
    lit_ranges,
    marker_shots,
    sphere_ranges,
    towards,
)

CENTRE = np.array([6.2, 4.1, 0.3])
OFF = np.array([0.02, -0.015, 0.01])  # [m] by which a rough centre may be off
CONFIG = FittingConfig()
RAY = replace(RIG, divergence=np.zeros(2))


def found(*groups, ground=-10.0):
    """Candidates from (members, rough centre) pairs."""
    candidates = tuple(
        MarkerCandidate(name=marker_name(i), members=np.array(rows), p_base_rough=np.array(p))
        for i, (rows, p) in enumerate(groups)
    )
    return MarkerCandidates(candidates=candidates, rejected=(), ground_height_max=ground)


def fit_one(cloud, rough, method="along_beam", ground=-10.0, config=CONFIG):
    rows = np.arange(len(cloud.p_base))
    return fit_markers(method, cloud, found((rows, rough), ground=ground), config, RADIUS)


def why_not_good(result):
    """Return the reason for which the only candidate has no good centre: it is weak or refused."""
    (outcome,) = (*result.fits, *result.rejected)
    assert all(fit.status is Status.WEAK for fit in result.fits)
    return outcome.reason


def joined(*parts):
    """Several (shots, ranges) as one, with the rows of each."""
    shots = Shots(*(np.concatenate([s[k] for s, _ in parts]) for k in range(len(Shots._fields))))
    sizes = np.cumsum([0, *(len(r) for _, r in parts)])
    rows = [np.arange(a, b) for a, b in pairwise(sizes)]
    return shots, np.concatenate([r for _, r in parts]), rows


def returns(shots, ranges):
    keep = np.isfinite(ranges)
    return shots.take(keep), ranges[keep]


def stop_of(rng, distance, n, *, sigma, bias=0.0, pole=0.015, **optics):
    """A stop with n markers at a distance: cloud, candidates with rough centres, true centres."""
    phi = 2 * np.pi * (np.arange(n) + rng.uniform(0, 1)) / n
    centres = distance * np.column_stack([np.cos(phi), np.sin(phi), 0.05 * np.sin(5 * phi)])
    parts = [returns(*marker_shots(c, rng, sigma=0, step=0, pole=pole, **optics)) for c in centres]
    shots, ranges, rows = joined(*parts)

    def draw(rng):
        biases = bias * rng.standard_normal(16)
        noisy = ranges + biases[shots.rings] + sigma * rng.standard_normal(len(ranges))
        rough = centres + 0.01 * rng.standard_normal(centres.shape)
        cloud = cloud_of(shots, np.round(noisy / 0.002) * 0.002)
        return cloud, found(*zip(rows, rough, strict=True))

    return draw, centres


def optics_of_prior(rng, distance):
    """Optics drawn from their priors: width of the footprint as a divergence, power of cosines."""
    sigmas = CONFIG.sigma_beam_width, CONFIG.sigma_beam_window, CONFIG.sigma_echo_cosine
    width, window, power = np.array(sigmas) * rng.standard_normal(3)
    divergence = (1 + width) * RIG.divergence + window * np.array([12.7e-3, 9.5e-3]) / distance
    return {"divergence": np.maximum(divergence, 1e-5), "power": power}


def of_wrong_angles(rng, cloud):
    """A cloud whose gimbal angles are off as their prior says, each scan line by its own."""
    line = np.cumsum(np.abs(np.diff(cloud.times, prepend=cloud.times[:1])) > 0.01)
    off = CONFIG.sigma_direction * rng.standard_normal(line[-1] + 1)[line]
    (x, y, z), c, s = cloud.p_base.T.astype(float), np.cos(off), np.sin(off)
    turned = np.column_stack([c * x - s * y, s * x + c * y, z]).astype(np.float32)
    return replace(cloud, p_base=turned, gimbal_angles=np.float32(cloud.gimbal_angles + off))


NOTHING_IN_COMMON = replace(CONFIG, sigma_range_common=0.0, sigma_range_scale=0.0)


def whitened(draw, centres, rng, n_repeats, config=NOTHING_IN_COMMON):
    """Squared errors in units of the claimed covariance, errors and unit vectors to the centres."""
    squares, errors, outward = [], [], []
    for _ in range(n_repeats):
        fits = fit_markers("along_beam", *draw(rng), config, RADIUS).fits
        for fit in fits:
            true = centres[np.argmin(np.linalg.norm(centres - fit.p_base, axis=1))]
            errors.append(fit.p_base - true)
            outward.append(true / np.linalg.norm(true))
            squares.append(errors[-1] @ np.linalg.solve(fit.cov_p_base, errors[-1]))
    return np.array(squares), np.array(errors), np.array(outward)


def test_every_method_of_the_configuration_exists_and_no_other():
    assert set(METHODS) == set(FITTING_METHODS)


def test_an_unknown_method_is_refused_with_the_known_ones_named():
    with pytest.raises(ConfigError, match="along_beam"):
        fit_one(cloud_of(*marker_shots(CENTRE, np.random.default_rng(1))), CENTRE, "magic")


def test_rays_without_noise_give_the_true_centre():
    shots = towards(fire(), CENTRE, 0.2)
    ranges = sphere_ranges(shots.origins, shots.directions, CENTRE, RADIUS)
    cloud = cloud_of(shots, ranges, rig=RAY)
    candidate = found((np.arange(len(cloud.p_base)), CENTRE + OFF))
    by_ranges = fit_ranges(cloud, candidate, CONFIG, RADIUS)[0][0]
    assert_allclose(by_ranges.p_base, CENTRE, rtol=0, atol=1e-5)
    # the outermost rays hold the limb only as exactly as they lie on it
    assert_allclose(fit_one(cloud, CENTRE + OFF).fits[0].p_base, CENTRE, rtol=0, atol=4e-5)


def test_wide_beams_without_noise_give_the_true_centre():
    shots, ranges = returns(*marker_shots(CENTRE, np.random.default_rng(1), step=0.0))
    fits = fit_one(cloud_of(shots, ranges), CENTRE + OFF).fits
    # 24 x 24 rays a beam: the world itself is good to some hundredths of a millimetre
    assert_allclose(fits[0].p_base, CENTRE, rtol=0, atol=5e-5)


def test_beams_that_are_thinner_than_specified_are_found_out_from_their_ranges():
    shots = towards(fire(), CENTRE, 0.2)
    cloud = cloud_of(shots, sphere_ranges(shots.origins, shots.directions, CENTRE, RADIUS))
    outward = CENTRE / np.linalg.norm(CENTRE)
    exact = FittingConfig(sigma_beam_width=0.0, sigma_beam_window=0.0, sigma_echo_cosine=0.0)
    wide, free = (
        (fit_one(cloud, CENTRE, config=config).fits[0].p_base - CENTRE) @ outward
        for config in (exact, CONFIG)
    )
    assert -2e-3 < wide < -1e-4
    assert abs(free) < abs(wide) / 4


def test_predicted_ranges_are_the_mean_over_many_rays():
    shots = towards(fire(), CENTRE, 0.13)
    ranges, lit = lit_ranges(shots, CENTRE, RADIUS, RIG.divergence, n=96)
    shots, hits = shots.take(lit > 0.3), lit > 0.3
    cloud = cloud_of(shots, ranges[hits])
    rows = np.arange(len(cloud.p_base))
    found_ = predict(beams(cloud, rows), CENTRE[None], np.array([RADIUS]), 0 * rows)
    is_full = lit[hits] > 0.999
    assert_allclose(found_.ranges[is_full], ranges[hits][is_full], rtol=0, atol=3e-5)
    assert_allclose(found_.ranges, ranges[hits], rtol=0, atol=5e-4)
    assert_allclose(found_.lit, lit[hits], rtol=0, atol=0.02)


def test_derivatives_of_ranges_agree_with_central_differences():
    shots = towards(fire(), CENTRE, 0.12)
    cloud = cloud_of(shots, np.full(len(shots.times), 7.4))
    which = np.zeros(len(cloud.p_base), dtype=np.intp)
    table = beams(cloud, np.arange(len(which)))
    h = 1e-8

    def ranges(step):
        return predict(table, (CENTRE + step[:3])[None], np.array([RADIUS + step[3]]), which).ranges

    numeric = np.stack([(ranges(h * e) - ranges(-h * e)) / (2 * h) for e in np.eye(4)], axis=1)
    exact = predict(table, CENTRE[None], np.array([RADIUS]), which)
    is_lit = exact.lit > 0.05
    assert is_lit.sum() > 100
    assert_allclose(exact.J[is_lit], numeric[is_lit], rtol=0, atol=1e-4)


def test_covariances_agree_with_errors_and_the_mean_is_not_biased():
    rng = np.random.default_rng(11)
    squares, errors, outward = whitened(*stop_of(rng, 7.5, 8, sigma=0.01, bias=0.003), rng, 15)
    assert 2.3 < squares.mean() < 3.8  # 120 fits: standard deviation of the mean 0.22
    assert abs((errors * outward).sum(axis=1).mean()) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("distance", "sigma", "low", "high"),
    # the limb of this world is the same at every distance and without blur: what few returns add
    # to a covariance, found where neither holds, is more than they need here
    [(4, 0.01, 2.4, 3.6), (7.5, 0.02, 2.4, 3.6), (10, 0.01, 2.4, 3.6), (20, 0.02, 2.0, 4.5)],
)
def test_covariances_hold_at_every_distance(distance, sigma, low, high):
    rng, squares = np.random.default_rng(12), []
    for _ in range(6):
        optics = optics_of_prior(rng, distance)
        draw, centres = stop_of(rng, distance, 14, sigma=sigma, bias=0.003, **optics)

        def drawn(rng, draw=draw):
            cloud, candidates = draw(rng)
            return of_wrong_angles(rng, cloud), candidates

        squares.append(whitened(drawn, centres, rng, 12)[0])
    squares = np.concatenate(squares)
    assert len(squares) > 950
    assert low < squares.mean() < high


def test_a_gimbal_whose_angles_scatter_widens_the_covariance_across_the_beam():
    cloud = cloud_of(*returns(*marker_shots(CENTRE, np.random.default_rng(33), sigma=0.01)))
    stamps_ns, samples_ns = np.int64(1e9 * cloud.times), np.arange(0, 13_300_000_000, 10_000_000)
    angles = np.pi + 2 * np.pi * 1e-9 * samples_ns / 13.2
    across = np.array([-CENTRE[1], CENTRE[0], 0.0]) / np.hypot(*CENTRE[:2])

    def sigma(scatter):
        values = angles + scatter * np.random.default_rng(34).standard_normal(len(angles))
        rates = np.append(np.diff(values) / 10_000_000, 0.0)
        column = Timed(stamps_ns, samples_ns, values, rates, is_angle=True)
        cov = fit_one(replace(cloud, gimbal_angles=column), CENTRE).fits[0].cov_p_base
        return np.sqrt(across @ cov @ across)

    lines = 1 + np.sum(np.diff(np.sort(cloud.times)) > 0.01)
    added = np.sqrt(sigma(1e-3) ** 2 - sigma(1e-7) ** 2)
    # an angle between two samples has two thirds of their variance in the mean
    expected = 1e-3 * np.sqrt(2 / 3) * np.hypot(*CENTRE[:2]) / np.sqrt(lines)
    assert 0.5 * expected < added < 2.0 * expected


def jerked(cloud, every):
    """The cloud of a gimbal that starts or stops during every few scan lines, and its angles."""
    stamps_ns, samples_ns = np.int64(1e9 * cloud.times), np.arange(0, 13_300_000_000, 10_000_000)
    intervals = np.unique(stamps_ns // 10_000_000)
    lines = intervals[np.append(True, np.diff(intervals) > 1)]
    corners = 0.01 * (lines[::every] + 0.5)
    knots = np.concatenate([[0.0], corners, [13.4]])
    speeds = np.where(np.arange(len(knots) - 1) % 2, 1.9, 0.2)
    at_knots = np.append(0.0, np.cumsum(speeds * np.diff(knots)))
    values = np.interp(1e-9 * samples_ns, knots, at_knots)
    rates = np.append(np.diff(values) / 10_000_000, 0.0)
    column = Timed(stamps_ns, samples_ns, values, rates)
    k = stamps_ns // 10_000_000
    interpolated = values[k] + rates[k] * (stamps_ns - samples_ns[k])
    off = interpolated - np.interp(1e-9 * stamps_ns, knots, at_knots)
    c, s, (x, y, z) = np.cos(off), np.sin(off), cloud.p_base.T
    moved = np.column_stack([c * x - s * y, s * x + c * y, z]).astype(np.float32)
    return replace(cloud, p_base=moved, gimbal_angles=column), np.abs(off)


def test_returns_while_a_gimbal_starts_or_stops_are_left_out_and_move_no_centre():
    cloud = cloud_of(*returns(*marker_shots(CENTRE, np.random.default_rng(35), sigma=0.01)))
    moved, off = jerked(cloud, every=4)
    is_off = off > 2.0 * CONFIG.sigma_direction
    assert 0.1 < np.mean(is_off) < 0.4
    assert off.max() > 3e-3  # 22 mm at this distance
    exact = replace(CONFIG, sigma_gimbal_clock=0.0)
    (fit,) = fit_one(moved, CENTRE, config=exact).fits
    assert not set(fit.used) & set(np.flatnonzero(is_off))
    assert set(np.flatnonzero(is_off)) <= set(fit.rejected)
    even = found((np.flatnonzero(~is_off), CENTRE))
    (without,) = fit_markers("along_beam", cloud, even, CONFIG, RADIUS).fits
    assert_allclose(fit.p_base, without.p_base, atol=5e-4)
    # a clock that one sphere alone has to show moves it by less than a sigma
    (free,) = fit_one(moved, CENTRE).fits
    off = free.p_base - without.p_base
    assert off @ np.linalg.solve(free.cov_p_base, off) < 1.0


def test_a_marker_that_a_gimbal_passes_only_while_it_starts_or_stops_keeps_its_returns():
    cloud = cloud_of(*returns(*marker_shots(CENTRE, np.random.default_rng(36), sigma=0.01)))
    moved, off = jerked(cloud, every=1)
    assert np.mean(off > 2.0 * CONFIG.sigma_direction) > 0.5
    (fit,) = fit_one(moved, CENTRE).fits
    assert len(fit.used) > 0.5 * len(off)


@pytest.mark.parametrize("share", [0.04, 0.08])
def test_pole_and_outliers_are_rejected(share):
    rng = np.random.default_rng(3)
    errors, n_misled = [], 0
    for _ in range(20):
        shots, ranges = returns(*marker_shots(CENTRE, rng, sigma=0.008, pole=0.03))
        strays = rng.random(len(ranges)) < share
        ranges = ranges + np.where(strays, rng.uniform(0.06, 0.2, len(ranges)), 0.0)
        fit = fit_one(cloud_of(shots, ranges), CENTRE + 0.015).fits[0]
        error = fit.p_base - CENTRE
        errors.append(np.linalg.norm(error))
        # of 20 centres one is farther off by chance once in 10,000 runs
        assert error @ np.linalg.solve(fit.cov_p_base, error) < chi2.isf(1e-4 / 20, 3)
        assert_allclose(np.sort(np.r_[fit.used, fit.rejected]), np.arange(len(ranges)))
        n_misled += strays[fit.used].sum() > 1
    # noise of 8 mm on 140 returns leaves 1.5 mm; strays that are used leave 5 to 14 mm
    assert np.median(errors) < 0.003
    # strays mislead one fit in 100: more than three of 20 once in 20,000 runs
    assert n_misled <= 3


def before_panel(centre, gap):
    """Shots at a marker before a panel: the echoes of both are one, at their mean range."""
    near = towards(fire(), centre, 1.45 * RADIUS)
    on_sphere, lit = lit_ranges(near, centre, RADIUS, RIG.divergence)
    away = np.linalg.norm(centre)
    axis = centre / away
    on_panel = (away + gap - near.origins @ axis) / (near.directions @ axis)
    return near, lit * np.where(lit > 0, on_sphere, 0.0) + (1.0 - lit) * on_panel


@pytest.mark.parametrize(("distance", "gap"), [(3.5, 0.15), (7.0, 0.25)])
def test_echoes_mixed_with_those_of_a_panel_close_behind_move_no_centre(distance, gap):
    rng = np.random.default_rng(41)
    phi = 2 * np.pi * (np.arange(6) + 0.3) / 6
    centres = distance * np.column_stack([np.cos(phi), np.sin(phi), 0.05 * np.sin(5 * phi)])
    parts = [before_panel(centre, gap) for centre in centres[:3]]
    parts += [returns(*marker_shots(c, rng, sigma=0, step=0)) for c in centres[3:]]
    shots, ranges, rows = joined(*parts)

    def draw(rng):
        noisy = ranges + 0.008 * rng.standard_normal(len(ranges))
        rough = centres + 0.01 * rng.standard_normal(centres.shape)
        cloud = cloud_of(shots, np.round(noisy / 0.002) * 0.002)
        return cloud, found(*zip(rows, rough, strict=True))

    squares = whitened(draw, centres, rng, 8)[0].reshape(8, 6) / 3
    high = chance.of_mean_square(3 * 3 * len(squares))[1]
    assert squares[:, :3].mean() < high
    assert squares[:, 3:].mean() < high


def behind_screen(centre, side, edge, before):
    """Shots at a marker, part of which a screen hides, with those that meet the marker.

    The screen hides what lies to one side of an upright line at ``edge``, seen from the scanner.
    """
    away = np.linalg.norm(centre)
    axis, across = centre / away, np.cross([0.0, 0.0, 1.0], centre / away)
    near = towards(fire(), centre, 1.45 * RADIUS)
    on_sphere, lit = lit_ranges(near, centre, RADIUS, RIG.divergence)
    on_screen = (away - before - near.origins @ axis) / (near.directions @ axis)
    places = (near.origins + on_screen[:, None] * near.directions) @ across
    is_hidden = side * places > edge * (1.0 - before / away)
    ranges = np.where(is_hidden, on_screen, np.where(lit > 0.5, on_sphere, np.inf))
    keep = np.isfinite(ranges)
    return near.take(keep), ranges[keep], ~is_hidden[keep]


@pytest.mark.parametrize(("distance", "before"), [(2.5, 0.6), (3.5, 1.0)])
def test_spheres_half_hidden_are_not_drawn_away_from_what_hides_them(distance, before):
    rng = np.random.default_rng(47)
    phi = 2 * np.pi * (np.arange(8) + 0.3) / 8
    centres = distance * np.column_stack([np.cos(phi), np.sin(phi), 0.05 * np.sin(5 * phi)])
    sides, edges = np.tile([1.0, -1.0], 4), RADIUS * np.repeat([0.0, 0.1, 0.2, 0.3], 2)
    parts = [behind_screen(c, s, e, before) for c, s, e in zip(centres, sides, edges, strict=True)]
    shots, ranges, rows = joined(*(part[:2] for part in parts))
    members = [some[part[2]] for some, part in zip(rows, parts, strict=True)]
    across = np.cross([0.0, 0.0, 1.0], centres / distance) * sides[:, None]

    def draw(rng):
        noisy = ranges + 0.008 * rng.standard_normal(len(ranges))
        rough = centres + 0.01 * rng.standard_normal(centres.shape)
        cloud = cloud_of(shots, np.round(noisy / 0.002) * 0.002)
        return cloud, found(*zip(members, rough, strict=True))

    squares, errors, _ = whitened(draw, centres, rng, 16)
    towards_screens = np.einsum("dki,ki->dk", errors.reshape(16, 8, 3), across).mean(axis=1)
    assert abs(towards_screens.mean()) < chance.of_mean(towards_screens)
    assert np.mean(squares) / 3 < chance.of_mean_square(3 * len(squares))[1]


def test_laser_biases_are_estimated_and_corrected():
    rng = np.random.default_rng(4)
    draw, centres = stop_of(rng, 9.0, 14, sigma=0.006, bias=0.01)
    cloud, candidates = draw(rng)
    knowing = fit_markers("along_beam", cloud, candidates, CONFIG, RADIUS)
    blind = fit_markers(
        "along_beam", cloud, candidates, FittingConfig(sigma_range_bias=1e-6), RADIUS
    )

    def spread(fits):
        errors = np.array([fit.p_base for fit in fits.fits]) - centres
        return np.sqrt(np.mean(np.var(errors, axis=0)))

    assert spread(knowing) < 0.8 * spread(blind)


def test_a_possible_marker_gets_a_centre_and_changes_no_other():
    rng = np.random.default_rng(24)
    draw, centres = stop_of(rng, 9.0, 5, sigma=0.006)
    cloud, candidates = draw(rng)
    last = candidates.candidates[-1]
    possible = Rejection(
        p_base=last.p_base_rough, n_points=len(last.members), reason="", members=last.members
    )
    others = replace(candidates, candidates=candidates.candidates[:-1])
    alone = fit_markers("along_beam", cloud, others, CONFIG, RADIUS)
    both = fit_markers("along_beam", cloud, replace(others, possible=(possible,)), CONFIG, RADIUS)
    for one, other in zip(alone.fits, both.fits, strict=True):
        np.testing.assert_array_equal(one.p_base, other.p_base)
    assert alone.possible_fits == ()
    (fit,) = both.possible_fits
    assert fit.name == "P01"
    error = fit.p_base - centres[-1]
    assert error @ np.linalg.solve(fit.cov_p_base, error) < chi2.isf(1e-4, 3)


def test_the_range_error_that_all_centres_share_has_a_sigma():
    rng = np.random.default_rng(21)

    def shared_sigma(bias):
        draw, _ = stop_of(rng, 8.0, 8, sigma=0.006, bias=bias)
        fits = fit_markers("along_beam", *draw(rng), NOTHING_IN_COMMON, RADIUS).fits
        sigmas = np.array([fit.sigma_range_shared for fit in fits])
        assert np.ptp(sigmas) < 0.05 * sigmas.mean()
        return sigmas.mean()

    rough = np.array([shared_sigma(0.01) for _ in range(6)])
    # a mean over 16 lasers of 10 mm each; how far these spread has 15 degrees of freedom a stop
    low, high = chance.of_mean_square(15 * len(rough))
    typical = np.sqrt(np.mean(rough**2))
    assert np.sqrt(low) < typical / (0.01 / 4.0) < np.sqrt(high)
    assert shared_sigma(0.0) < 0.4 * typical


def test_a_bias_that_all_lasers_share_is_in_the_covariance_and_not_in_the_centres():
    rng, common = np.random.default_rng(22), CONFIG.sigma_range_common
    draw, centres = stop_of(rng, 8.0, 8, sigma=0.006, bias=0.0)
    cloud, candidates = draw(rng)
    lines = centres / np.linalg.norm(centres, axis=1, keepdims=True)
    longer = replace(cloud, p_base=(cloud.p_base + common * unit_of(cloud)).astype(np.float32))
    plain, moved = (
        fit_markers("along_beam", one, candidates, CONFIG, RADIUS).fits for one in (cloud, longer)
    )
    steps = np.array([m.p_base - p.p_base for p, m in zip(plain, moved, strict=True)])
    # centres go with the ranges, to the share by which the apparent size of spheres holds them
    assert_allclose(np.sum(steps * lines, axis=1), common, rtol=0.15)
    for fit, line in zip(plain, lines, strict=True):
        assert common**2 < line @ fit.cov_p_base @ line < 3.0 * common**2
        assert common < fit.sigma_range_shared < 1.2 * common


def unit_of(cloud):
    """Directions of the beams of a cloud."""
    return beams(cloud, np.arange(len(cloud.p_base))).directions_base


def test_three_returns_are_refused_with_the_reason():
    shots, ranges = returns(*marker_shots(CENTRE, np.random.default_rng(1)))
    cloud = cloud_of(shots.take(slice(40, 43)), ranges[40:43])
    for method in METHODS:
        result = fit_one(cloud, CENTRE, method)
        assert not result.fits
        assert "needs" in result.rejected[0].reason


@pytest.mark.parametrize("method", METHODS)
def test_a_marker_keeps_its_name_where_the_method_refuses_one_before_it(method):
    shots, ranges = returns(*marker_shots(CENTRE, np.random.default_rng(1), sigma=0.005))
    rows = np.arange(len(ranges))
    groups = found((rows[40:43], CENTRE), (rows, CENTRE))
    result = fit_markers(method, cloud_of(shots, ranges), groups, CONFIG, RADIUS)
    assert [fit.name for fit in result.fits] == ["M02"]


def test_returns_on_one_line_are_weak_or_refused():
    shots, ranges = returns(*marker_shots(CENTRE, np.random.default_rng(2), sigma=0.005))
    ring = shots.rings == np.argmax(np.bincount(shots.rings))
    first = ring & (np.abs(shots.times - shots.times[np.flatnonzero(ring)[0]]) < 0.02)
    reason = why_not_good(fit_one(cloud_of(shots.take(first), ranges[first]), CENTRE))
    assert "one line" in reason or "one laser" in reason


def test_half_a_sphere_is_weak_with_the_reason():
    shots, ranges = returns(*marker_shots(CENTRE, np.random.default_rng(2), sigma=0.008))
    cloud = cloud_of(shots, ranges)
    side = np.cross([0, 0, 1.0], CENTRE / np.linalg.norm(CENTRE))
    half = (cloud.p_base - CENTRE) @ side > 0.0
    fit = fit_one(cloud_of(shots.take(half), ranges[half]), CENTRE).fits[0]
    assert fit.status is Status.WEAK
    assert "is seen" in fit.reason


def test_a_sphere_of_another_size_is_weak_or_refused():
    shots = towards(fire(), CENTRE, 0.3)
    ranges, lit = lit_ranges(shots, CENTRE, 0.14, RIG.divergence)
    ranges = ranges + 0.006 * np.random.default_rng(5).standard_normal(len(ranges))
    reason = why_not_good(fit_one(cloud_of(shots, np.where(lit > 0.5, ranges, np.inf)), CENTRE))
    assert "own radius" in reason or "no sphere of radius" in reason


def test_the_free_radius_is_the_true_one_within_its_sigma():
    shots, ranges = marker_shots(CENTRE * 0.6, np.random.default_rng(6), sigma=0.01)
    fit = fit_one(cloud_of(shots, ranges), CENTRE * 0.6).fits[0]
    assert 0 < fit.sigma_radius_free < 0.003
    assert abs(fit.radius_free - RADIUS) < 3 * fit.sigma_radius_free


def test_the_order_of_shots_does_not_matter():
    rng = np.random.default_rng(7)
    shots, ranges = returns(*marker_shots(CENTRE, rng, sigma=0.01))
    mixed = rng.permutation(len(ranges))
    first = fit_one(cloud_of(shots, ranges), CENTRE).fits[0]
    second = fit_one(cloud_of(shots.take(mixed), ranges[mixed]), CENTRE).fits[0]
    assert_allclose(second.p_base, first.p_base, rtol=0, atol=1e-9)
    variance = np.trace(first.cov_p_base)
    assert_allclose(second.cov_p_base, first.cov_p_base, rtol=0, atol=1e-6 * variance)


@pytest.mark.parametrize("method", METHODS)
def test_turning_the_world_turns_the_centre_and_nothing_else(method):
    shots, ranges = marker_shots(CENTRE, np.random.default_rng(8), sigma=0.01)
    cloud = cloud_of(shots, ranges)
    turn = 0.7
    R = rot_z(turn)
    turned = replace(
        cloud,
        p_base=(cloud.p_base @ R.T).astype(np.float32),
        gimbal_angles=(cloud.gimbal_angles + np.float32(turn)).astype(np.float32),
    )
    first = fit_one(cloud, CENTRE, method).fits[0]
    second = fit_one(turned, R @ CENTRE, method).fits[0]
    # float32 columns move the points by half a micrometre; ICP starts its rotation elsewhere
    atol = 2e-3 if method == "paper" else 2e-4 if method == "silhouette" else 1e-5
    assert_allclose(second.p_base, R @ first.p_base, rtol=0, atol=atol)


def test_returns_of_unknown_lasers_are_fitted_without_rings():
    shots, ranges = marker_shots(CENTRE, np.random.default_rng(9), sigma=0.01)
    known = cloud_of(shots, ranges)
    unknown = replace(known, rings=np.full(len(known.rings), RING_UNKNOWN, np.uint8))
    rig = replace(RIG, laser_heights=np.zeros(16))
    fit = fit_one(replace(unknown, rig=rig), CENTRE).fits[0]
    assert fit.n_rings == 0
    assert np.linalg.norm(fit.p_base - CENTRE) < 0.01


def test_the_study_is_drawn_to_the_scanner_and_our_centre_is_not():
    rng = np.random.default_rng(10)
    outward = CENTRE / np.linalg.norm(CENTRE)
    pulls = {method: [] for method in ("along_beam", "paper")}
    for _ in range(6):
        cloud = cloud_of(*marker_shots(CENTRE, rng, sigma=0.02))
        for method, pulled in pulls.items():
            fit = fit_one(cloud, CENTRE, method).fits[0]
            pulled.append((fit.p_base - CENTRE) @ outward)
    assert np.mean(pulls["paper"]) < -0.01
    assert abs(np.mean(pulls["along_beam"])) < 0.004


def test_the_cut_of_the_study_lifts_its_centre():
    cloud = cloud_of(*marker_shots(CENTRE, np.random.default_rng(13), sigma=0.01))
    config = FittingConfig(paper_cut="ground")
    whole = fit_one(cloud, CENTRE, "paper", config=config).fits[0]
    cut = fit_one(cloud, CENTRE, "paper", ground=CENTRE[2] - 0.02, config=config).fits[0]
    assert cut.n_points < whole.n_points
    assert cut.p_base[2] - whole.p_base[2] > 0.005
    half = fit_one(cloud, CENTRE, "paper").fits[0]
    assert 0.4 < half.n_points / whole.n_points < 0.6
    assert half.p_base[2] - whole.p_base[2] > 0.005


def test_cut_at_the_equator_the_height_of_the_ground_does_not_matter():
    cloud = cloud_of(*marker_shots(CENTRE, np.random.default_rng(17), sigma=0.01))
    low, high = (
        fit_one(cloud, CENTRE, "paper", ground=CENTRE[2] + above).fits[0].p_base
        for above in (-1.0, 0.2)
    )
    assert_allclose(low, high, rtol=0, atol=0)


def test_the_whole_sphere_as_a_model_is_drawn_further_than_the_hemisphere():
    cloud = cloud_of(*marker_shots(CENTRE, np.random.default_rng(16), sigma=0.01))
    outward = CENTRE / np.linalg.norm(CENTRE)

    def pull(model):
        config = FittingConfig(paper_model=model)
        return (fit_one(cloud, CENTRE, "paper", config=config).fits[0].p_base - CENTRE) @ outward

    assert pull("sphere") < 1.5 * pull("hemisphere") < -0.01


def test_an_unknown_model_is_refused_with_the_known_ones_named():
    with pytest.raises(ConfigError, match="hemisphere"):
        FittingConfig(paper_model="cube")
    with pytest.raises(ConfigError, match="equator"):
        FittingConfig(paper_cut="pole")


def test_the_study_refuses_a_sphere_below_the_cut_with_the_reason():
    cloud = cloud_of(*marker_shots(CENTRE, np.random.default_rng(14), sigma=0.01))
    config = FittingConfig(paper_cut="ground")
    result = fit_one(cloud, CENTRE, "paper", ground=CENTRE[2] + 0.2, config=config)
    assert not result.fits
    assert "highest ground point" in result.rejected[0].reason


@pytest.mark.parametrize("method", METHODS)
def test_no_candidates_give_no_fits(method):
    cloud = cloud_of(*marker_shots(CENTRE, np.random.default_rng(15)))
    assert fit_markers(method, cloud, found(), CONFIG, RADIUS).fits == ()


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.02, 0.03])
def test_the_study_errs_as_in_its_table_under_its_noise(sigma):
    field = scenario("paper-field", 4)
    stop = simulate_stop(field, "lane3-stop4", SimulationConfig(sigma_range=sigma))
    cloud = stitch(stop.log, stop.log.rig, StitchingConfig())
    candidates = extract(cloud, ExtractionConfig(), RADIUS)
    fits = fit_markers("paper", cloud, candidates, CONFIG, RADIUS)
    errors = marker_errors(fits, stop.truth, field.marks)
    assert len(fits.fits) == 14
    assert abs(errors.error_3d.mean() - TABLE_2.errors_3d.mean()) < 0.003
    assert 0.012 < errors.error_3d.min() < 0.028
    assert 0.030 < errors.error_3d.max() < 0.055
    assert errors.error_radial.mean() < -0.01
    assert errors.error_base[:, 2].mean() > 0.005


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_returns_without_a_place_are_left_out(method, wrong):
    shots, ranges = returns(*marker_shots(CENTRE, np.random.default_rng(21), sigma=0.01))
    cloud = cloud_of(shots, ranges)
    p = cloud.p_base.copy()
    p[::7] = wrong
    fit = fit_one(replace(cloud, p_base=p), CENTRE + OFF / 4, method).fits[0]
    assert np.linalg.norm(fit.p_base - CENTRE) < 0.05
    assert not np.isin(fit.used, np.arange(0, len(p), 7)).any()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("radius", [0.07, 0.14, 0.3])
def test_a_radius_that_is_not_there_is_weak_or_refused(method, radius):
    cloud = cloud_of(*marker_shots(CENTRE * 0.7, np.random.default_rng(22), sigma=0.006))
    rows = np.arange(len(cloud.p_base))
    result = fit_markers(method, cloud, found((rows, CENTRE * 0.7)), CONFIG, radius)
    reason = why_not_good(result)
    assert "own radius" in reason or "no sphere of radius" in reason


@pytest.mark.parametrize("method", METHODS)
def test_every_method_gives_all_diagnostics(method):
    cloud = cloud_of(*marker_shots(CENTRE * 0.7, np.random.default_rng(31), sigma=0.008, pole=0.02))
    config = FittingConfig(paper_cut="ground")
    fit = fit_one(cloud, CENTRE * 0.7, method, config=config).fits[0]
    assert_allclose(np.sort(np.r_[fit.used, fit.rejected]), np.arange(len(cloud.p_base)))
    assert len(fit.residuals) == fit.n_points
    assert fit.n_rings > 5
    assert fit.coverage > 0.6
    assert 0.5 < fit.incidence < 1.0
    assert 0.0 < fit.sigma_radius_free < 0.004
    assert abs(fit.radius_free - RADIUS) < (0.012 if method == "algebraic" else 0.005)
    assert (fit.status is Status.OK) == (fit.reason == "")


@pytest.mark.parametrize("method", METHODS)
def test_without_rings_every_method_fits_and_names_the_variant(method):
    known = cloud_of(*marker_shots(CENTRE, np.random.default_rng(9), sigma=0.01))
    blank = np.full(len(known.rings), RING_UNKNOWN, np.uint8)
    fit = fit_one(replace(known, rings=blank), CENTRE, method).fits[0]
    assert fit.n_rings == 0
    assert "rings" in fit.variant
    assert np.linalg.norm(fit.p_base - CENTRE) < 0.06


@pytest.mark.parametrize("method", METHODS)
def test_one_ring_alone_is_weak_or_refused_by_every_method(method):
    shots, ranges = returns(*marker_shots(CENTRE, np.random.default_rng(23), sigma=0.005))
    ring = shots.rings == np.argmax(np.bincount(shots.rings))
    result = fit_one(cloud_of(shots.take(ring), ranges[ring]), CENTRE, method)
    reason = why_not_good(result)
    assert "one laser" in reason if result.fits else reason


@pytest.mark.parametrize("missing", ["rings", "times"])
def test_without_rings_or_times_the_limb_is_not_used_with_the_reason(missing):
    cloud = cloud_of(*marker_shots(CENTRE, np.random.default_rng(24), sigma=0.01))
    n = len(cloud.rings)
    blank = {
        "rings": np.full(n, RING_UNKNOWN, np.uint8),
        "times": (np.floor(cloud.times * 10) / 10).astype(np.float32),
    }[missing]
    less = replace(cloud, **{missing: blank})
    fit = fit_one(less, CENTRE, "silhouette").fits[0]
    ranges_only = fit_one(less, CENTRE, "along_beam").fits[0]
    assert fit.status is Status.WEAK
    assert "limb is not used" in fit.reason
    assert missing in fit.variant
    assert_allclose(fit.p_base, ranges_only.p_base)


def test_the_limb_sharpens_centres_with_missing_pulses_too():
    rng = np.random.default_rng(25)
    squares = np.zeros(3)
    for _ in range(24):
        cloud = cloud_of(*marker_shots(CENTRE, rng, sigma=0.02))
        candidate = found((np.arange(len(cloud.p_base)), CENTRE))
        for k, method in enumerate((fit_ranges, METHODS["along_beam"], METHODS["silhouette"])):
            (fit,) = method(cloud, candidate, CONFIG, RADIUS).fits
            squares[k] += np.sum((fit.p_base - CENTRE) ** 2)
    by_ranges, by_returns, by_both = squares
    # Of 240 draws the shares are 0.50 and 0.42; those of 24 draws spread by 0.04 about them, so
    # that these limits are missed by chance once in more than 10^9 times.
    assert by_returns < 0.8 * by_ranges
    assert by_both < 0.75 * by_ranges


def test_the_limb_never_lowers_a_covariance_below_what_samples_support():
    rng = np.random.default_rng(32)
    shares = []
    for _ in range(40):
        cloud = cloud_of(*marker_shots(CENTRE * 0.7, rng, sigma=0.02))
        candidate = found((np.arange(len(cloud.p_base)), CENTRE * 0.7))
        by_ranges = fit_ranges(cloud, candidate, CONFIG, RADIUS)[0][0].cov_p_base
        by_both = fit_one(cloud, CENTRE * 0.7, "silhouette").fits[0].cov_p_base
        shares.append(np.linalg.eigvals(np.linalg.solve(by_ranges, by_both)).real.min())
    assert min(shares) > 0.2 * np.median(shares)


def test_the_standard_names_its_variant():
    far = cloud_of(*marker_shots(CENTRE, np.random.default_rng(26), sigma=0.01))
    near = cloud_of(*marker_shots(CENTRE / 2, np.random.default_rng(26), sigma=0.01))
    assert "small sample" in fit_one(far, CENTRE, "astm_e3125").fits[0].variant
    assert "small sample" not in fit_one(near, CENTRE / 2, "astm_e3125").fits[0].variant


def test_incidence_is_that_of_an_evenly_seen_sphere():
    cloud = cloud_of(*marker_shots(CENTRE / 2, np.random.default_rng(27)))
    # rays spread evenly over a disc meet its sphere at pi / 4 on average
    for method in METHODS:
        fit = fit_one(cloud, CENTRE / 2, method, config=FittingConfig(paper_cut="ground")).fits[0]
        if method != "astm_e3125":  # its cone ends at 60 degrees
            assert abs(fit.incidence - np.pi / 4) < 0.06


def test_the_bound_falls_with_noise_squared_and_needs_three_returns():
    cloud = cloud_of(*marker_shots(CENTRE, np.random.default_rng(28), step=0.0))
    table = beams(cloud, np.arange(len(cloud.p_base)))
    bound = cramer_rao(table, CENTRE, RADIUS, 0.02)
    assert_allclose(cramer_rao(table, CENTRE, RADIUS, 0.01), bound / 4)
    assert 0.002 < np.sqrt(np.trace(bound)) < 0.005
    assert hits(table, CENTRE, RADIUS, 0.01).all()
    with pytest.raises(DegenerateGeometryError, match="leave its centre undetermined"):
        cramer_rao(beams(cloud, np.arange(2)), CENTRE, RADIUS, 0.02)


def test_a_range_error_in_common_adds_its_variance_to_the_bound_along_the_line_of_sight():
    cloud = cloud_of(*marker_shots(CENTRE, np.random.default_rng(28), step=0.0))
    table = beams(cloud, np.arange(len(cloud.p_base)))
    line = CENTRE / np.linalg.norm(CENTRE)
    sharp = cramer_rao(table, CENTRE, RADIUS, 0.02)
    added = cramer_rao(table, CENTRE, RADIUS, 0.02, 0.003) - sharp
    assert line @ added @ line == pytest.approx(0.003**2, rel=0.1)
    assert np.trace(added) < 1.3 * 0.003**2
    assert_allclose(cramer_rao(table, CENTRE, RADIUS, 0.02, 1e-9), sharp, rtol=1e-6)
