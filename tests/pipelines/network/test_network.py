"""The network against a world whose truth is known, and against a dense solution of its own."""

import re
import sys
import time
import tracemalloc
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from spheremark.pipelines.config import ResectionConfig
from spheremark.pipelines.errors import DegenerateGeometryError, InputError
from spheremark.pipelines.geometry import inverse, levelling_rotation, log_motion, rigid
from spheremark.pipelines.network import Network, Shared, adjust_network, assemble
from spheremark.pipelines.network.normal_equations import linearise, start, step_to
from spheremark.pipelines.positioning.resection import resect
from tests.synthetic import control, field, pose, sightings

EXACT = 1e-7  # [m] and [rad] noise-free in, truth out
CONFIG = ResectionConfig(
    sigma_common=0.0,
    sigma_range=0.0,
    sigma_range_scale=0.0,
    sigma_range_shared=0.0,
    sigma_height=0.0,
)
SIGMA = 4e-3  # [m] of a centre, per axis
LEVEL = 3e-3  # [rad] of roll and of pitch


@pytest.fixture
def rng():
    return np.random.default_rng(47)


def survey(rng, marks, n, *, sigma=SIGMA, level=LEVEL, only=None):
    """Scans of n stations, with noise as claimed, and the true poses of base."""
    scans, poses = [], []
    for i in range(n):
        lean = rng.uniform(-0.1, 0.1, 2)
        place = marks.p_site.mean(axis=0) + rng.uniform([-4, -4, -0.4], [4, 4, 0])
        T = pose(place, rng.uniform(-3, 3), lean)
        seen = np.arange(len(marks.names)) if only is None else only[i]
        visible = control(marks.p_site[seen])
        fits = sightings(
            visible, T, lean=tuple(lean + rng.normal(0, level, 2)), sigma_level=LEVEL,
            cov=np.eye(3) * SIGMA**2, noise=rng.normal(0, sigma, (len(seen), 3)),
        )  # fmt: skip
        scans.append((f"stop{i + 1}", fits))
        poses.append(T)
    return scans, np.array(poses)


def biased(scans, station, fit, shift):
    """The scans with one centre moved."""
    name, fits = scans[station]
    moved = replace(fits.fits[fit], p_base=fits.fits[fit].p_base + shift)
    others = (*fits.fits[:fit], moved, *fits.fits[fit + 1 :])
    return [*scans[:station], (name, replace(fits, fits=others)), *scans[station + 1 :]]


def longer(scan, bias):
    """The scan with all ranges too long."""
    name, fits = scan
    moved = [
        replace(fit, p_base=fit.p_base * (1 + bias / np.linalg.norm(fit.p_base)))
        for fit in fits.fits
    ]
    return name, replace(fits, fits=tuple(moved))


def of_shared_height(scan, sigma):
    """The scan whose centres share a part of their sigma of height."""
    name, fits = scan
    shared = tuple(replace(fit, sigma_height_shared=sigma) for fit in fits.fits)
    return name, replace(fits, fits=shared)


def network(scans, marks=None, config=CONFIG):
    return adjust_network(assemble(scans, marks, config), config)


def turned_back(estimated, true):
    """The motion about the vertical, with translation, that lays marks on the true ones."""
    a, b = estimated - estimated.mean(axis=0), true - true.mean(axis=0)
    yaw = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a[:, :2] * b[:, :2]))
    R = pose([0, 0, 0], yaw)[:3, :3]
    return rigid(R, true.mean(axis=0) - R @ estimated.mean(axis=0))


def order_of(result, marks, scans, poses):
    """Which true mark each mark of a free network is, by one sighting of each."""
    names = [name for name, _ in scans]
    out = np.zeros(len(result.network.marks), np.intp)
    rows = zip(result.network.sightings, result.network.p_base, strict=True)
    for (station, mark), p in rows:
        T = poses[names.index(result.network.stations[station])]
        off = np.linalg.norm(marks.p_site - T[:3, :3] @ p - T[:3, 3], axis=1)
        out[mark] = np.argmin(off)
    return out


@pytest.mark.parametrize("middle", [(0, 0, 0), (431_250.0, 5_412_800.0, 312.0)])
def test_noise_free_centres_and_control_give_the_true_poses(rng, middle):
    marks = field(rng, middle=middle)
    scans, poses = survey(rng, marks, 4, sigma=0.0, level=0.0)
    result = network(scans, marks)
    R = np.array([levelling_rotation(fits.levelling) for _, fits in scans])
    np.testing.assert_allclose(result.T_site_station[:, :3, 3], poses[:, :3, 3], rtol=0, atol=EXACT)
    np.testing.assert_allclose(
        result.T_site_station[:, :3, :3] @ R, poses[:, :3, :3], rtol=0, atol=EXACT
    )
    np.testing.assert_allclose(result.centres.residuals, 0, atol=EXACT)
    assert result.left_out == ()
    assert result.dof == 3 * 4 * 14 + 2 * 4 + 3 * 14 - 6 * 4 - 3 * 14


def test_noise_free_centres_without_control_give_the_true_shape(rng):
    marks = field(rng)
    scans, poses = survey(rng, marks, 4, sigma=0.0, level=0.0)
    result = network(scans)
    order = order_of(result, marks, scans, poses)
    back = turned_back(result.p_site, marks.p_site[order])
    p = result.p_site @ back[:3, :3].T + back[:3, 3]
    np.testing.assert_allclose(p, marks.p_site[order], rtol=0, atol=EXACT)
    stations = (back @ result.T_site_station)[:, :3, 3]
    np.testing.assert_allclose(stations, poses[:, :3, 3], rtol=0, atol=EXACT)


def test_derivatives_agree_with_differences(rng):
    marks = field(rng, 5)
    scans, _ = survey(rng, marks, 3)
    config = replace(CONFIG, sigma_range=1e-3, sigma_height=1e-4)
    net = assemble([of_shared_height(scan, 1e-3) for scan in scans], marks, config)
    state, used = start(net), np.ones(net.n_blocks, np.bool_)
    state = step_to(state, rng.normal(0, 0.1, (3, 7)), rng.normal(0, 0.1, (5, 3)), np.zeros(2))
    here, h = linearise(net, state, used), 1e-6
    mark = net.sightings[:, 1]
    for k in range(7):
        xi = np.zeros((3, 7))
        xi[:, k] = h
        plus, minus = (
            linearise(net, step_to(state, sign * xi, np.zeros((5, 3)), np.zeros(2)), used)
            for sign in (1, -1)
        )
        numeric = (plus.v_centres - minus.v_centres) / (2 * h)
        np.testing.assert_allclose(here.J_centres[..., k], numeric, rtol=0, atol=1e-7)
        numeric = (plus.v_gravity - minus.v_gravity) / (2 * h)
        np.testing.assert_allclose(here.J_gravity[..., k], numeric, rtol=0, atol=1e-7)
    for k, unit in enumerate(np.eye(2)):
        plus, minus = (
            linearise(
                net, step_to(state, np.zeros((3, 7)), np.zeros((5, 3)), sign * h * unit), used
            )
            for sign in (1, -1)
        )
        numeric = (plus.v_centres - minus.v_centres) / (2 * h)
        np.testing.assert_allclose(here.J_common[..., 3 + k], numeric, rtol=0, atol=1e-7)
    dp = rng.normal(0, 1, (5, 3))
    there = linearise(net, step_to(state, np.zeros((3, 7)), dp, np.zeros(2)), used)
    np.testing.assert_allclose(there.v_centres - here.v_centres, -dp[mark], rtol=0, atol=1e-12)
    expected = -dp[net.controls]
    np.testing.assert_allclose(there.v_control - here.v_control, expected, rtol=0, atol=1e-12)


def dense(net, levellings):
    """Poses, marks and covariance of the marks by another parametrisation and a numeric Jacobian.

    Roll, pitch, yaw and place of each station; residuals in base; nothing is eliminated.
    """
    s, m = len(net.stations), len(net.marks)
    roots = np.linalg.inv(np.linalg.cholesky(net.cov_p_base))
    roots_control = np.linalg.inv(np.linalg.cholesky(net.cov_control_site))
    station, mark = net.sightings.T
    tilts = np.array([[one.pitch, one.roll] for one in levellings])

    def residuals(x):
        angles, t = x[: 3 * s].reshape(s, 3), x[3 * s : 6 * s].reshape(s, 3)
        p = x[6 * s : 6 * s + 3 * m].reshape(m, 3)
        R = Rotation.from_euler("ZYX", angles).as_matrix()[station]
        seen = np.einsum("nji,nj->ni", R, p[mark] - t[station])
        bias, heights = np.split(x[6 * s + 3 * m :], [-s])
        longer = seen / np.linalg.norm(seen, axis=1)[:, None] * bias.sum()
        v = net.p_base - seen - longer - heights[station, None] * net.heights_base
        whitened = np.einsum("nij,nj->ni", roots, v)
        levels = (tilts - angles[:, 1:]) / LEVEL
        given = np.einsum("nij,nj->ni", roots_control, net.p_control_site - p[net.controls])
        centroid = (p - net.p_site).mean(axis=0) if net.is_free else np.zeros(0)
        heading = (
            [np.sum(np.cross(net.p_site - net.p_site.mean(axis=0), p)[:, 2]) / 100]
            if net.is_free
            else []
        )
        return np.concatenate(
            [
                whitened.ravel(),
                levels.ravel(),
                given.ravel(),
                1e5 * centroid,
                1e5 * np.array(heading),
                bias / net.sigma_range if len(bias) else bias,
                heights,
            ]
        )

    angles = Rotation.from_matrix(net.T_site_base[:, :3, :3]).as_euler("ZYX")
    none = np.zeros(int(net.sigma_range > 0))
    places = [net.T_site_base[:, :3, 3].ravel(), net.p_site.ravel()]
    x0 = np.concatenate([angles.ravel(), *places, none, np.zeros(s)])
    found = least_squares(residuals, x0, method="trf", xtol=1e-14, ftol=1e-14, gtol=1e-12)
    cov = np.linalg.inv(found.jac.T @ found.jac)
    return found.x, cov, 2 * found.cost


@pytest.mark.parametrize("sigma_range", [0.0, 5e-3])
@pytest.mark.parametrize("is_free", [True, False])
def test_an_independent_dense_solution_agrees_to_a_tenth_of_a_millimetre(rng, is_free, sigma_range):
    marks = field(rng, 8)
    loose = replace(marks, cov_p_site=np.tile(np.eye(3) * 2e-3**2, (8, 1, 1)))
    given = replace(loose, p_site=marks.p_site + rng.normal(0, 2e-3, (8, 3)))
    scans, _ = survey(rng, marks, 5)
    config = replace(CONFIG, sigma_range=sigma_range)
    seen = [longer(of_shared_height(scan, 0.4 * SIGMA), 1.2 * sigma_range) for scan in scans]
    net = assemble(seen, None if is_free else given, config)
    result = adjust_network(net, config)
    assert result.used.all()
    x, cov, vtpv = dense(net, [fits.levelling for _, fits in scans])
    s = len(net.stations)
    tenth = 1e-4  # [m]
    np.testing.assert_allclose(
        result.p_site, x[6 * s : 6 * s + 24].reshape(-1, 3), rtol=0, atol=tenth
    )
    p_stations = x[3 * s : 6 * s].reshape(-1, 3)
    np.testing.assert_allclose(result.T_site_station[:, :3, 3], p_stations, rtol=0, atol=tenth)
    sigmas = np.sqrt(np.diag(cov))
    np.testing.assert_allclose(
        np.sqrt(np.diag(result.cov_p_site)), sigmas[6 * s : 6 * s + 24], rtol=0.02
    )
    own = np.einsum("sii->si", result.station_covariances).ravel()
    np.testing.assert_allclose(np.sqrt(own), sigmas[3 * s : 6 * s], rtol=0.02)
    assert result.vtpv == pytest.approx(vtpv, rel=0.02)
    if sigma_range:
        assert result.range_bias == pytest.approx(x[6 * s + 24], abs=tenth)
        assert result.sigma_range_bias == pytest.approx(sigmas[6 * s + 24], rel=0.02)
    np.testing.assert_allclose(result.heights, x[-s:], rtol=0, atol=0.01)


def test_what_all_ranges_are_too_long_is_found_where_control_tells(rng):
    marks = field(rng)
    scans, _ = survey(rng, marks, 4)
    config = replace(CONFIG, sigma_range=0.01)
    result = network([longer(scan, 0.015) for scan in scans], marks, config)
    assert result.range_bias == pytest.approx(0.015, abs=4 * result.sigma_range_bias)
    assert result.sigma_range_bias < 1e-3
    parts = (result.centres, result.gravity, result.control)
    total = sum(float(np.sum(part.redundancies)) for part in parts)
    total += 1 - (result.sigma_range_bias / 0.01) ** 2  # of its prior
    assert total == pytest.approx(result.dof, abs=1e-6)


def test_only_what_centres_say_that_they_share_is_taken_from_their_own_variances(rng):
    marks = field(rng)
    scans, _ = survey(rng, marks, 3)
    shared = 0.4 * SIGMA
    weighted = [
        (name, replace(fits, fits=tuple(replace(f, sigma_range_shared=s) for f in fits.fits)))
        for (name, fits), s in zip(scans, (0.0, shared, np.nan), strict=True)
    ]
    config = replace(CONFIG, sigma_range_shared=0.5 * SIGMA)
    found = assemble(weighted, marks, config)
    lines = found.p_base / np.linalg.norm(found.p_base, axis=1, keepdims=True)
    along = np.einsum("ni,nij,nj->n", lines, found.cov_p_base, lines)
    of_station = found.sightings[:, 0]
    for station, taken in enumerate((0.0, shared, 0.5 * SIGMA)):
        np.testing.assert_allclose(along[of_station == station], SIGMA**2 - taken**2, rtol=1e-6)


def test_one_station_with_control_is_a_free_station(rng):
    marks = field(rng)
    loose = replace(marks, cov_p_site=np.tile(np.eye(3) * 2e-3**2, (14, 1, 1)))
    scans, _ = survey(rng, marks, 1)
    fix, result = resect("free_station", scans[0][1], loose, CONFIG), network(scans, loose)
    off = log_motion(result.T_site_station[0] @ inverse(fix.T_site_station))
    np.testing.assert_allclose(off, 0, atol=2e-6)
    np.testing.assert_allclose(result.cov_T_site_station[0], fix.cov_T_site_station, rtol=1e-2,
                               atol=1e-9)  # fmt: skip
    assert result.vtpv == pytest.approx(fix.sigma0**2 * fix.dof, rel=1e-3)


def test_what_mounting_leaves_of_the_heading_turns_a_station_and_moves_none(rng):
    marks = field(rng)
    scans, _ = survey(rng, marks, 2)
    blurred = [
        (name, replace(fits, levelling=replace(fits.levelling, sigma_heading=0.01)))
        for name, fits in scans
    ]
    sharp, blunt = network(scans, marks), network(blurred, marks)
    np.testing.assert_allclose(
        blunt.station_covariances, sharp.station_covariances, rtol=0, atol=1e-12
    )
    more = (blunt.cov_T_site_station - sharp.cov_T_site_station)[:, :3, :3]
    axes = (blunt.T_site_station[:, :3, :3] @ blunt.network.R_station_base)[:, :, 2]
    expected = 1e-4 * axes[:, :, None] * axes[:, None]  # about the axes of the gimbals
    np.testing.assert_allclose(more, expected, rtol=0, atol=1e-7)
    fixes = [resect("ranges", one[0][1], marks, CONFIG) for one in (scans, blurred)]
    assert fixes[1].sigma_yaw == pytest.approx(np.hypot(fixes[0].sigma_yaw, 0.01), rel=1e-6)


@pytest.mark.parametrize("is_free", [True, False])
def test_redundancies_add_up_to_the_degrees_of_freedom(rng, is_free):
    marks = field(rng)
    scans, _ = survey(rng, marks, 5)
    result = network(scans, None if is_free else marks)
    parts = (result.centres, result.gravity, result.control)
    total = sum(float(np.sum(part.redundancies)) for part in parts)
    assert total == pytest.approx(result.dof, abs=1e-6)


def test_a_gross_error_of_five_centimetres_is_found_and_named(rng):
    marks = field(rng)
    scans, poses = survey(rng, marks, 6)
    clean = network(scans, marks)
    result = network(biased(scans, 3, 5, [0.03, -0.03, 0.026]), marks)
    assert clean.left_out == ()
    (out,) = result.left_out
    assert (out.kind, out.station, out.marker, out.mark) == ("centre", "stop4", "M06", "F")
    said = float(re.search(r"it is ([\d.]+) m", out.reason).group(1))
    assert said == pytest.approx(0.05, abs=3 * SIGMA)
    off = np.linalg.norm(result.T_site_station[3, :3, 3] - poses[3, :3, 3])
    assert off < 5e-3
    assert np.isnan(
        result.centres.redundancies[~result.used[: len(result.centres.residuals)]]
    ).all()


def test_a_contradicting_control_mark_is_found_and_named(rng):
    marks = field(rng)
    scans, _ = survey(rng, marks, 6)
    p = marks.p_site.copy()
    p[2] += [0.06, 0.0, -0.05]
    result = network(scans, control(p))
    (out,) = result.left_out
    assert (out.kind, out.mark) == ("control", "C")
    said = float(re.search(r"are ([\d.]+) m", out.reason).group(1))
    assert said == pytest.approx(0.078, abs=2 * SIGMA)
    assert result.passes_global_test


def test_a_control_mark_that_is_far_off_is_named_with_what_stands_beside_it(rng):
    marks = field(rng)
    scans, _ = survey(rng, marks, 4)
    p = marks.p_site.copy()
    p[2] += [0.3, 0.3, 0.0]
    result = network(scans, control(p))
    (out,) = result.left_out
    assert (out.kind, out.mark) == ("control", "C")
    stands = float(re.search(r"N01 stands ([\d.]+) m from it", out.reason).group(1))
    assert stands == pytest.approx(np.hypot(0.3, 0.3), abs=4 * SIGMA + 0.005)  # printed as cm


def test_two_control_marks_that_contradict_each_other_are_both_named(rng):
    marks = control([[6.9, 1.1, 0.6], [-3.9, 7.1, 1.5]])
    scans, _ = survey(rng, marks, 6)
    p = marks.p_site.copy()
    p[1] += 0.06 * (p[1] - p[0]) / np.linalg.norm(p[1] - p[0])
    result = network(scans, control(p))
    assert not result.passes_global_test
    assert any("The control marks A (w =" in one and "B (w =" in one for one in result.warnings)


def test_control_of_which_half_is_elsewhere_is_two_groups_of_which_one_is_left_out(rng):
    marks = field(rng)
    scans, _ = survey(rng, marks, 6)
    p = marks.p_site.copy()
    p[1::2] += [0.08, 0.0, 0.0]
    result = network(scans, control(p))
    out = {one.mark for one in result.left_out}
    halves = set(marks.names[::2]), set(marks.names[1::2])
    assert out in halves  # and none of the other half, which the first half made look bad
    assert result.passes_global_test
    (warning,) = result.warnings
    assert f"{len(out)} of {len(marks.names)} control marks contradict the others" in warning


def test_two_control_marks_among_many_markers_hold_a_network(rng):
    marks = field(rng)
    p = marks.p_site
    rise = np.abs(p[:, None, 2] - p[None, :, 2])
    chosen = list(np.unravel_index(np.argmax(rise), rise.shape))
    scans, poses = survey(rng, marks, 2)
    result = network(scans, control(p[chosen]))
    off = np.linalg.norm(result.T_site_station[:, :3, 3] - poses[:, :3, 3], axis=1)
    assert off.max() < 20 * SIGMA  # two marks only, and a levelling of 3 mrad


def test_a_station_that_two_marks_hold_is_named_as_unchecked(rng):
    marks = control([[6.9, 1.1, 0.6], [-3.9, 7.1, 1.5]])
    scans, _ = survey(rng, marks, 1)
    (warning,) = network(scans, marks).warnings
    assert warning == "Held by two marks only, where an error in one would not show: stop1."


def test_a_symmetric_field_makes_no_network_and_says_that_it_is_the_symmetry(rng):
    angles = np.arange(6) * np.pi / 3
    marks = control(np.column_stack([7 * np.cos(angles), 7 * np.sin(angles), np.full(6, 0.9)]))
    scans, _ = survey(rng, marks, 2)
    for given in (None, marks):
        with pytest.raises(DegenerateGeometryError, match="a symmetric field") as refused:
            network(scans, given)
        assert "in other units" not in str(refused.value)


def test_two_control_marks_that_no_markers_resemble_are_refused(rng):
    marks = field(rng)
    scans, _ = survey(rng, marks, 2)
    with pytest.raises(DegenerateGeometryError, match=r"two of the control marks.*in other units"):
        network(scans, control([[0.0, 0.0, 0.0], [60.0, 0.0, 3.0]]))


def test_a_station_that_shares_no_mark_is_refused_and_costs_no_other(rng):
    marks = field(rng)
    scans, _ = survey(rng, marks, 4)
    elsewhere, _ = survey(rng, field(rng, 9, radius=11.0), 1)
    result = network([*scans[:2], ("lost", elsewhere[0][1]), *scans[2:]], marks)
    assert [one.station for one in result.network.refused] == ["lost"]
    assert "shares too few marks" in result.network.refused[0].reason
    assert result.network.stations == ("stop1", "stop2", "stop3", "stop4")


def test_a_station_with_one_marker_is_refused_and_costs_no_other(rng):
    marks = field(rng)
    only = [np.arange(14)] * 3 + [np.array([4])]
    scans, _ = survey(rng, marks, 4, only=only)
    (refused,) = network(scans).network.refused
    assert refused.station == "stop4"
    assert "One marker was found" in refused.reason


def test_stations_in_a_row_are_chained_through_the_marks_they_share(rng):
    angle = np.arange(24) * 2.399963  # the golden angle: no two distances repeat
    p = np.stack([2.0 * np.arange(24), 6 * np.cos(angle), 1 + 0.4 * np.sin(3 * angle)], axis=1)
    marks = control(p)
    only = [np.arange(first, first + 12) for first in (0, 6, 12)]
    scans, poses = survey(rng, marks, 3, only=only, sigma=1e-4, level=1e-5)
    result = network(scans)
    assert len(result.network.marks) == 12  # that two stations share
    assert sum(one.kind == "centre" for one in result.left_out) == 12
    order = order_of(result, marks, scans, poses)
    back = turned_back(result.p_site, marks.p_site[order])
    off = (back @ result.T_site_station)[:, :3, 3] - poses[:, :3, 3]
    assert np.linalg.norm(off, axis=1).max() < 2e-3


def test_moving_the_control_moves_the_network_and_nothing_else(rng):
    marks = field(rng)
    scans, _ = survey(rng, marks, 4)
    shift = pose((812.0, -65.0, 33.0), 2.1)
    elsewhere = control(marks.p_site @ shift[:3, :3].T + shift[:3, 3])
    here, there = network(scans, marks), network(scans, elsewhere)
    np.testing.assert_allclose(there.T_site_station, shift @ here.T_site_station, rtol=0, atol=1e-7)
    np.testing.assert_allclose(
        there.station_covariances,
        shift[:3, :3] @ here.station_covariances @ shift[:3, :3].T,
        rtol=0, atol=1e-10,
    )  # fmt: skip
    np.testing.assert_allclose(
        there.centres.redundancies, here.centres.redundancies, rtol=0, atol=1e-5
    )


def test_positions_far_from_the_origin_are_as_sure_as_at_it(rng):
    marks = field(rng)
    scans, _ = survey(rng, marks, 4)
    scans = [
        (name, replace(fits, levelling=replace(fits.levelling, sigma_heading=0.01)))
        for name, fits in scans
    ]
    far = control(np.add(marks.p_site, [431_250.0, 5_412_800.0, 312.0]))
    here, there = network(scans, marks), network(scans, far)
    np.testing.assert_allclose(
        there.station_covariances, here.station_covariances, rtol=1e-5, atol=1e-12
    )


def test_a_network_of_one_station_without_control_is_refused(rng):
    scans, _ = survey(rng, field(rng), 1)
    with pytest.raises(DegenerateGeometryError, match="no two stations share two marks"):
        network(scans)


def test_two_logs_of_one_name_are_refused(rng):
    scans, _ = survey(rng, field(rng), 1)
    with pytest.raises(InputError, match="Two logs are called 'stop1'"):
        network(scans * 2)


def test_an_undetected_bias_moves_a_station_by_no_more_than_is_said(rng):
    marks = field(rng, 6)
    scans, _ = survey(rng, marks, 3, sigma=0.0, level=0.0)
    clean = network(scans, marks)
    k = 7
    station, _ = clean.network.sightings[k]
    fit = int(clean.network.fits[k])
    shifts = []
    for _ in range(30):
        v = rng.normal(size=3)
        moved = network(biased(scans, station, fit, 5e-3 * v / np.linalg.norm(v)), marks)
        off = moved.T_site_station[station, :3, 3] - clean.T_site_station[station, :3, 3]
        off = float(np.linalg.norm(off))
        shifts.append(off * clean.noncentrality / np.sqrt(moved.vtpv))  # just detectable
    assert 0.7 * clean.station_shifts[k] < max(shifts) <= 1.001 * clean.station_shifts[k]


@pytest.mark.slow
@pytest.mark.parametrize("is_free", [True, False])
def test_the_covariances_of_a_network_are_honest(rng, is_free):
    stations, all_marks = [], []
    for _ in range(60):
        marks = field(rng, 10)
        scans, poses = survey(rng, marks, 8)
        result = network(scans, None if is_free else marks, replace(CONFIG, test_level=1e-6))
        order = order_of(result, marks, scans, poses)
        back = turned_back(result.p_site, marks.p_site[order]) if is_free else np.eye(4)
        off = (back @ result.T_site_station)[:, :3, 3] - poses[:, :3, 3]
        R = back[:3, :3]
        cov = R @ result.station_covariances @ R.T
        stations.append(np.mean(np.einsum("si,sij,sj->s", off, np.linalg.inv(cov), off)) / 3)
        if is_free:
            e = (result.p_site @ R.T + back[:3, 3] - marks.p_site[order]) @ R
            pinv = np.linalg.pinv(result.cov_p_site, rcond=1e-9, hermitian=True)
            all_marks.append(e.ravel() @ pinv @ e.ravel() / (30 - 4))
    assert 0.85 < np.mean(stations) < 1.2
    assert not all_marks or 0.85 < np.mean(all_marks) < 1.2


def wide(rng, n_stations, n_marks=200, n_seen=14):
    """A network over a wide field, assembled by hand: each station sees the marks about it."""
    p = np.column_stack([rng.uniform(0, 120, (n_marks, 2)), rng.uniform(0.6, 1.5, n_marks)])
    T = np.array(
        [pose([*rng.uniform(0, 120, 2), 0.8], rng.uniform(-3, 3)) for _ in range(n_stations)]
    )
    far = np.linalg.norm(T[:, None, :3, 3] - p, axis=2)
    seen = np.argsort(far, axis=1)[:, :n_seen]
    centres = np.einsum("skj,sji->ski", p[seen] - T[:, None, :3, 3], T[:, :3, :3])
    n = n_stations * n_seen
    return Network(
        stations=tuple(f"stop{i}" for i in range(n_stations)),
        marks=tuple(f"M{i}" for i in range(n_marks)),
        sightings=np.column_stack([np.repeat(np.arange(n_stations), n_seen), seen.ravel()]),
        fits=np.tile(np.arange(n_seen), n_stations),
        markers=("",) * n,
        p_base=centres.reshape(n, 3) + rng.normal(0, SIGMA, (n, 3)),
        cov_p_base=np.tile(SIGMA**2 * np.eye(3), (n, 1, 1)),
        heights_base=np.zeros((n, 3)),
        R_station_base=np.tile(np.eye(3), (n_stations, 1, 1)),
        cov_up_base=np.tile(np.diag([LEVEL**2, LEVEL**2, 0.0]), (n_stations, 1, 1)),
        sigma_headings=np.zeros(n_stations),
        controls=np.zeros(0, np.intp),
        p_control_site=np.zeros((0, 3)),
        cov_control_site=np.zeros((0, 3, 3)),
        T_site_base=T,
        p_site=p + rng.normal(0, 0.01, p.shape),
        shared=Shared.none(n),
        suspicions=("",) * n_marks,
    )


@contextmanager
def counted():
    """Count calls of functions and the peak of memory: what neither load nor processor changes."""
    cost = SimpleNamespace(calls=0, peak_bytes=0)

    def count(*_):
        cost.calls += 1

    tracemalloc.start()
    sys.setprofile(count)
    try:
        yield cost
    finally:
        sys.setprofile(None)
        cost.peak_bytes = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()


@pytest.mark.slow
def test_a_thousand_stations_and_two_hundred_marks_are_adjusted_at_a_cost_that_grows_linearly(rng):
    nets, costs = {n: wide(rng, n) for n in (250, 1000)}, []
    adjust_network(nets[250], CONFIG)  # compiles
    for n, net in nets.items():
        with counted() as cost:
            result = adjust_network(net, CONFIG)
        costs.append(cost)
        assert result.dof == 3 * 14 * n + 2 * n - 6 * n - 600 + 4
        assert 0.9 < result.sigma0 < 1.1
    few, many = costs
    # four times the stations: n gives at most 4, n log n gives 5 and n^2 gives 16
    assert many.calls < 5 * few.calls
    assert many.peak_bytes < 5 * few.peak_bytes


@pytest.mark.benchmark
def test_the_time_of_an_adjustment_grows_more_slowly_than_the_stations_to_the_power_1_5(rng):
    nets = [wide(rng, n) for n in (250, 1000)]

    def cost(net):
        begin = time.thread_time()
        adjust_network(net, CONFIG)
        return time.thread_time() - begin

    few, many = np.min([[cost(net) for net in nets] for _ in range(5)], axis=0)
    assert many < 4**1.5 * few
