"""Checks of stated uncertainty, and the decision on a survey."""

import numpy as np
import pytest

from spheremark.pipelines.accuracy import acceptance
from spheremark.pipelines.accuracy.acceptance import Compared, SolutionQuality
from spheremark.pipelines.accuracy.probability import keeps_tolerance, probability_within

NAMES = ("A", "B", "C", "D", "E", "F")
GOOD = np.tile(3e-8 * np.eye(3), (6, 1, 1))  # 0.3 mm, 3-D
WIDE = np.concatenate([GOOD[:5], [1.4e-4 * np.eye(3)]])  # 33 mm hold 95 %
THIN = np.concatenate([GOOD[:5], [np.diag([2.5e-4, 0.0, 0.0])]])  # 31 mm hold 95 %


def drawn(rng, n_scans, n, shared_sigma):
    """Return errors of positions whose scans share a part, their covariances and shared effects."""
    shared = shared_sigma * rng.normal(size=(n_scans, n, 1, 3))
    own = np.diag([4.0, 1.0, 2.0])
    cov = own + np.einsum("sjki,sjkl->sjil", shared, shared)
    common = rng.normal(size=(n_scans, 1, 1))
    errors = rng.normal(size=(n_scans, n, 3)) @ np.sqrt(own) + common * shared[:, :, 0]
    scans = np.repeat(np.arange(n_scans), n)
    return errors.reshape(-1, 3), cov.reshape(-1, 3, 3), shared.reshape(-1, 1, 3), scans


@pytest.mark.parametrize("shared_sigma", [0.0, 2.0])
def test_the_interval_by_chance_holds_95_of_100_surveys_whose_sigmas_hold(shared_sigma):
    rng = np.random.default_rng(4)
    inside = []
    for _ in range(400):
        errors, cov, shared, scans = drawn(rng, 4, 10, shared_sigma)
        dof = acceptance.independent_coordinates(cov, shared, scans)
        names = [str(i) for i in range(len(errors))]
        check = acceptance.check_errors("centres", Compared(names, errors), cov, dof)
        inside.append(check.is_within)
    assert 0.90 < np.mean(inside) < 0.99  # 0.95, with its own chance of 400 draws


def test_errors_without_shared_parts_are_all_independent():
    cov = np.tile(np.eye(3), (7, 1, 1))
    none = np.zeros((7, 1, 3))
    assert acceptance.independent_coordinates(cov, none, np.zeros(7, np.intp)) == pytest.approx(
        21.0
    )


def test_sigmas_of_half_the_errors_are_found_too_small():
    rng = np.random.default_rng(6)
    differences = 2e-3 * rng.normal(size=(6, 3))
    check = acceptance.check_control(NAMES, differences, np.full((6, 3), 1e-3))
    assert check.is_within is False
    assert "times its sigma" in check.excess
    lengths = np.linalg.norm(differences, axis=1)
    assert check.largest == pytest.approx(lengths.max())
    assert check.where == NAMES[int(lengths.argmax())]


def control(size):
    return acceptance.check_control(NAMES, np.full((6, 3), size), np.full((6, 3), size))


def test_a_survey_whose_tests_pass_within_the_tolerance_is_accepted():
    quality = SolutionQuality(stations=NAMES, covariances=GOOD, control=control(5e-4))
    found = acceptance.decide(quality, 0.03)
    assert found.status == "accepted"
    assert found.sentence == (
        "6 stations, 0.3 mm (3-D sigma, RMS), control met to 0.9 mm (largest): accepted"
    )
    assert found.reasons == ()


@pytest.mark.parametrize(
    ("changed", "status", "reason"),
    [
        ({"failed": ("B",)}, "refused", "The global test fails at B"),
        ({"covariances": WIDE}, "refused", "F: errors are within the tolerance of 30 mm with a"),
        ({"covariances": THIN}, "refused", "F: errors are within the tolerance of 30 mm with a"),
        ({"control": control(0.02)}, "refused", "Control differs by 34.6 mm at A"),
        ({"missing": ("G",)}, "weak", "No position in this solution: G"),
        ({"warnings": ("Only one mark is shared.",)}, "weak", "Only one mark"),
    ],
)
def test_a_survey_is_not_accepted_for_a_reason(changed, status, reason):
    given = {"stations": NAMES, "covariances": GOOD, "control": control(5e-4)}
    found = acceptance.decide(SolutionQuality(**(given | changed)), 0.03)
    assert found.status == status
    assert any(one.startswith(reason) for one in found.reasons), found.reasons
    if changed.get("failed"):
        assert "no valid sigma" in found.sentence


def test_the_bound_of_the_rule_and_its_quadrature_agree():
    """95 % of errors along one axis are within 1.96 sigma, of spherical ones within 2.7955."""
    rng = np.random.default_rng(8)
    roots = rng.normal(size=(300, 3, 3)) * 10.0 ** rng.uniform(-3.0, -1.5, size=(300, 1, 3))
    covs = roots @ np.swapaxes(roots, 1, 2)
    within = probability_within(covs, 0.03)
    assert 30 < np.sum(within >= 0.95) < 270
    assert (keeps_tolerance(covs, 0.03) == (within >= 0.95)).all()
    for axes, radius in (((1.0, 0.0, 0.0), 1.95996), ((1.0, 1.0, 1.0), 2.79548)):
        for factor in (0.999, 1.001):
            cov = np.diag(axes)[None] * (0.03 / radius * factor) ** 2
            assert keeps_tolerance(cov, 0.03)[0] == (factor < 1.0)
    assert not keeps_tolerance(np.full((1, 3, 3), np.nan), 0.03)[0]


def test_a_survey_without_positions_has_no_decision():
    assert (
        acceptance.decide(
            SolutionQuality(stations=(), covariances=np.zeros((0, 3, 3))), 0.03
        ).status
        == "none"
    )
