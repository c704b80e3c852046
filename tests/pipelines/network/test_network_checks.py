"""What a network knows without truth, and what it does with marks and rigs that may be wrong."""

from dataclasses import replace

import numpy as np
import pytest

from spheremark.pipelines.config import ResectionConfig
from spheremark.pipelines.errors import DegenerateGeometryError
from spheremark.pipelines.model import OPTICS, Optics, Status
from spheremark.pipelines.network import (
    Decision,
    Shared,
    adjust_network,
    assemble,
    repeated_stops,
)
from tests.synthetic import control, field, pose, sightings

CONFIG = ResectionConfig(sigma_common=0.0, sigma_range=0.0, sigma_range_scale=0.0, sigma_height=0.0)
SIGMA = 4e-3  # [m] of a centre, per axis
LEVEL = 3e-3  # [rad] of roll and of pitch


@pytest.fixture
def rng():
    return np.random.default_rng(83)


def station(rng, marks, place):
    """The fits of a station that sees all marks."""
    lean = rng.uniform(-0.1, 0.1, 2)
    T = pose(place, rng.uniform(-3, 3), lean)
    return sightings(
        marks, T, lean=tuple(lean + rng.normal(0, LEVEL, 2)), sigma_level=LEVEL,
        cov=np.eye(3) * SIGMA**2, noise=rng.normal(0, SIGMA, (len(marks.names), 3)),
    )  # fmt: skip


def survey(rng, marks, n):
    middle = marks.p_site.mean(axis=0)
    places = middle + rng.uniform([-4, -4, -0.4], [4, 4, 0], (n, 3))
    return [(f"stop{i + 1}", station(rng, marks, place)) for i, place in enumerate(places)]


def loose(marks, sigma=2e-3):
    return replace(marks, cov_p_site=np.tile(np.eye(3) * sigma**2, (len(marks.names), 1, 1)))


def with_ghost(rng, n, n_seen, *, is_weak=False):
    """A survey in which the stations farthest from it see one thing more than the marks."""
    marks = field(rng)
    ghost = control([*marks.p_site, [14.0, 9.0, 0.2]])
    scans = sorted(survey(rng, ghost, n), key=lambda scan: -np.linalg.norm(scan[1].fits[-1].p_base))
    scans = [(f"stop{i + 1}", fits) for i, (_, fits) in enumerate(scans)]
    cut = []
    for i, (name, fits) in enumerate(scans):
        last = fits.fits[-1]
        if is_weak:
            last = replace(last, status=Status.WEAK, reason="Only 9 returns.")
        some = (*fits.fits[:-1], last) if i < n_seen else fits.fits[:-1]
        cut.append((name, replace(fits, fits=some)))
    return marks, cut


@pytest.mark.parametrize("is_exact", [True, False])
def test_a_control_mark_is_predicted_as_if_it_had_not_been_given(rng, is_exact):
    marks = field(rng, 7)
    given = marks if is_exact else loose(marks)
    scans = survey(rng, marks, 4)
    network = assemble(scans, given, CONFIG)
    result = adjust_network(network, CONFIG)
    for row, mark in enumerate(network.controls):
        keep = np.delete(np.arange(len(network.controls)), row)
        others = replace(
            network,
            controls=network.controls[keep],
            p_control_site=network.p_control_site[keep],
            cov_control_site=network.cov_control_site[keep],
        )
        anew = adjust_network(others, CONFIG)
        off = anew.p_site[mark] - network.p_control_site[row]
        np.testing.assert_allclose(result.control_predictions[row], off, rtol=0, atol=5e-5)
        cov = anew.mark_covariances[mark] + network.cov_control_site[row]
        np.testing.assert_allclose(
            np.diag(result.cov_control_predictions[row]), np.diag(cov), rtol=0.02
        )


def test_of_two_control_marks_neither_is_predicted(rng):
    marks = field(rng)
    scans = survey(rng, marks, 3)
    rise = np.abs(marks.p_site[:, None, 2] - marks.p_site[None, :, 2])
    first, second = np.unravel_index(np.argmax(rise), rise.shape)
    two = control(marks.p_site[[first, second]])
    result = adjust_network(assemble(scans, two, CONFIG), CONFIG)
    assert np.isnan(result.control_predictions).all()


def test_what_few_stations_see_is_no_mark_of_the_network(rng):
    _, scans = with_ghost(rng, 10, 2)
    result = adjust_network(assemble(scans, None, CONFIG), CONFIG)
    assert len(result.network.marks) == 14
    gone = [one for one in result.left_out if "stations that stand near enough" in one.reason]
    assert {(one.station, one.marker) for one in gone} == {("stop1", "M15"), ("stop2", "M15")}


def test_what_a_third_of_the_stations_see_is_a_mark_with_a_doubt(rng):
    _, scans = with_ghost(rng, 9, 3)
    result = adjust_network(assemble(scans, None, CONFIG), CONFIG)
    assert len(result.network.marks) == 15
    (reason,) = [text for text in result.mark_weaknesses if text]
    assert "Only 3 of the" in reason
    assert any("may be false" in warning for warning in result.warnings)


def test_weak_sightings_of_a_third_of_the_stations_are_no_mark(rng):
    _, scans = with_ghost(rng, 9, 3, is_weak=True)
    result = adjust_network(assemble(scans, None, CONFIG), CONFIG)
    assert len(result.network.marks) == 14
    assert any("Only 9 returns" in one.reason for one in result.left_out)


def test_a_ball_of_another_radius_is_no_mark(rng):
    marks = field(rng)
    odd = []
    for name, fits in survey(rng, marks, 5):
        first = replace(fits.fits[0], radius_free=0.13, sigma_radius_free=0.01)
        odd.append((name, replace(fits, fits=(first, *fits.fits[1:]))))
    result = adjust_network(assemble(odd, None, CONFIG), CONFIG)
    (one,) = [one for one in result.network.evidence if one.decision is Decision.REFUSED]
    assert one.mark not in result.network.marks
    assert one.decoy == "sphere of nearly that radius"
    gone = [left for left in result.left_out if "Its own radius is 130 mm" in left.reason]
    assert {left.marker for left in gone} == {"M01"}
    assert len(gone) == 5


def test_a_station_that_needs_a_doubtful_mark_keeps_it(rng):
    _, scans = with_ghost(rng, 10, 2)
    name, fits = scans[0]
    scans[0] = (name, replace(fits, fits=(*fits.fits[:2], fits.fits[-1])))
    result = adjust_network(assemble(scans, None, CONFIG), CONFIG)
    assert name in result.network.stations
    assert len(result.network.marks) == 15


def test_what_a_rig_does_to_all_stations_is_found_with_its_sigma(rng):
    marks = field(rng)
    scaled = []
    for _ in range(16):
        network = assemble(survey(rng, marks, 6), None, CONFIG)
        true = rng.normal(0, [3e-3, 2e-3])
        towards = network.p_base / np.linalg.norm(network.p_base, axis=1)[:, None]
        tilted = np.cross(network.p_base, [0.0, 1.0, 0.0])
        effects = np.stack([towards, tilted * np.abs(network.p_base[:, :1])], axis=2)
        moved = network.p_base + effects @ true
        shared = Shared(
            names=("common_range_bias", "bend"), derivatives=effects, prior_weights=np.zeros((2, 2))
        )
        result = adjust_network(replace(network, p_base=moved, shared=shared), CONFIG)
        off = result.shared - true
        scaled.append(off @ np.linalg.solve(result.cov_shared, off) / 2)
    assert np.mean(scaled) == pytest.approx(1.0, abs=0.6)


def test_the_joint_covariance_holds_those_of_each_station_and_mark(rng):
    result = adjust_network(assemble(survey(rng, field(rng), 4), None, CONFIG), CONFIG)
    joint = result.cov_positions
    for i, cov in enumerate(result.station_covariances):
        np.testing.assert_allclose(joint[3 * i : 3 * i + 3, 3 * i : 3 * i + 3], cov, atol=1e-10)
    assert np.linalg.eigvalsh(joint)[0] > -1e-12
    np.testing.assert_allclose(joint[12:, 12:], result.cov_p_site)


def test_positions_move_together_as_the_joint_covariance_says(rng):
    marks, apart, predicted = field(rng, 8), [], []
    for _ in range(40):
        places = marks.p_site.mean(axis=0) + np.array([[-3, 0, 0], [3, 1, 0], [0, -3, 0.0]])
        scans = [(f"stop{i}", station(rng, marks, place)) for i, place in enumerate(places)]
        given = replace(loose(marks, 1e-2), p_site=marks.p_site + rng.normal(0, 1e-2, (8, 3)))
        result = adjust_network(assemble(scans, given, CONFIG), CONFIG)
        p, cov = result.T_site_station[:, :3, 3], result.cov_positions
        apart.append(p[1] - p[0] - (places[1] - places[0]))
        predicted.append(cov[:3, :3] + cov[3:6, 3:6] - cov[:3, 3:6] - cov[3:6, :3])
    ratio = np.mean([d @ np.linalg.solve(c, d) / 3 for d, c in zip(apart, predicted, strict=True)])
    assert ratio == pytest.approx(1.0, abs=0.4)


def test_a_stop_made_twice_agrees_as_well_as_is_predicted(rng):
    marks = field(rng)
    ratios = []
    for _ in range(15):
        scans = [*survey(rng, marks, 2), ("a", station(rng, marks, [0.2, 0.1, 1.0]))]
        scans.append(("b", station(rng, marks, [0.25, 0.1, 1.0])))
        result = adjust_network(assemble(scans, marks, CONFIG), CONFIG)
        found = [one for one in repeated_stops(result) if one.stations == (2, 3)]
        (repeat,) = found
        assert np.linalg.norm(repeat.apart) == pytest.approx(0.05, abs=0.01)
        ratios.append((repeat.rms / repeat.predicted_rms) ** 2)
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.25)


def test_one_control_mark_is_refused_with_what_to_do(rng):
    marks = field(rng)
    with pytest.raises(DegenerateGeometryError, match=r"[Ff]ree|two"):
        assemble(survey(rng, marks, 2), control(marks.p_site[:1]), CONFIG)


def test_control_marks_on_a_line_hold_a_network_with_gravity(rng):
    marks = field(rng)
    p = np.array([[-6.0, 0.3, 0.7], [-1.0, 0.3, 0.9], [2.5, 0.3, 1.4], [7.0, 0.3, 0.8]])
    line = control(p)
    scans = survey(rng, control([*p, *marks.p_site]), 3)
    result = adjust_network(assemble(scans, line, CONFIG), CONFIG)
    sigmas = np.sqrt(np.trace(result.station_covariances, axis1=1, axis2=2))
    assert len(result.network.stations) == 3
    assert sigmas.max() < 0.05


def test_a_field_that_is_its_own_image_turned_is_refused_for_each_station(rng):
    angle = np.arange(6) * np.pi / 3
    ring = control(np.stack([8 * np.cos(angle), 8 * np.sin(angle), np.full(6, 1.0)], axis=1))
    with pytest.raises(DegenerateGeometryError, match="more than one way"):
        assemble(survey(rng, ring, 3), ring, CONFIG)


def test_optics_that_scans_estimated_apart_are_brought_together_and_blur_the_scale(rng):
    marks, true = field(rng), np.array([0.2, 0.3, 0.8])
    weights = np.diag(np.array([0.1, 0.05, 0.3]) ** -2.0)
    scans = []
    for name, fits in survey(rng, marks, 6):
        own = true + rng.normal(0, [0.1, 0.05, 0.3])
        optics = Optics(
            estimates=own,
            weights=weights.copy(),
            sigmas_prior=np.array([0.35, 0.5, 0.7]),
            sigmas_profile=np.full(3, 1e-3),
        )
        changed = []
        for fit in fits.fits:
            towards = fit.p_base / np.linalg.norm(fit.p_base)
            by_optics = 1e-5 * (fit.p_base @ fit.p_base) * np.array([1.0, 0.5, -0.5])
            moved = fit.p_base + towards * (by_optics @ (true - own))
            changed.append(replace(fit, p_base=moved, optics=optics, range_by_optics=by_optics))
        scans.append((name, replace(fits, fits=tuple(changed))))
    network = assemble(scans, None, CONFIG)
    result = adjust_network(network, CONFIG)
    assert network.shared.names == OPTICS
    sigmas = np.sqrt(np.diag(result.cov_shared))
    assert np.all(sigmas < 0.6 * np.array([0.1, 0.05, 0.3]))  # six scans know more than one
    fixed = replace(network, shared=Shared.none(len(network.fits)))
    trusting = adjust_network(fixed, CONFIG)
    assert np.trace(result.cov_p_site) > np.trace(trusting.cov_p_site)
