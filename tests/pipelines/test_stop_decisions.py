"""Decisions on stops: good enough, which marker is bad, what would help."""

from dataclasses import replace

import numpy as np

from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.geometry import skew, turn_in_place
from spheremark.pipelines.model import Exclusion, NoFix, Status
from spheremark.pipelines.stop_decisions import _sigmas_with, decide, is_good_enough
from tests.storage.made_up import MARKS
from tests.storage.made_up import stop as made_up_stop

FIRST = ("along_beam", "free_station")


def decision_of(stop, **changes):
    found = replace(stop, fixes={FIRST: replace(stop.fixes[FIRST], **changes)})
    return decide(found, SurveyConfig(), MARKS)


def test_a_station_is_good_enough_if_95_of_100_errors_are_within_the_tolerance():
    """Of a spherical normal error, 95 % are within 2.7955 sigma (chi with 3 degrees of freedom)."""
    for sigma, is_good in ((0.0099, True), (0.0101, False)):
        cov = np.eye(3) * (0.03 / 2.7955 / 0.01 * sigma) ** 2
        assert is_good_enough("ok", cov, 0.03) is is_good
        assert not is_good_enough("weak", cov, 0.03)


def test_a_decision_names_bad_markers_and_what_would_help():
    found = decision_of(made_up_stop(), cov_p_site=np.eye(3) * 0.02**2)
    assert not found.is_good_enough
    assert "M07 is weak: Few points." in found.bad_markers
    assert "M06 is left out: Fails the w-test." in found.bad_markers
    (missing,) = (one for one in found.advice if "was not found" in one)
    assert missing.startswith(MARKS.names[5])  # the one mark of six that the fix does not use
    assert found.text.startswith("L1S1: not good enough.")
    good = decision_of(made_up_stop(), cov_p_site=np.eye(3) * 1e-6)
    assert (good.is_good_enough, good.advice) == (True, ())


def test_a_heading_that_clocks_leave_unknown_changes_no_advice():
    stop = made_up_stop()
    fix, weak = stop.fixes[FIRST], {"cov_p_site": np.eye(3) * 0.02**2}
    turn = turn_in_place(fix.T_site_station)
    cov = fix.cov_T_site_station + 0.014**2 * np.outer(turn, turn)
    unknown = decision_of(stop, cov_T_site_station=cov, sigma_heading=0.014, **weak)
    assert unknown.advice == decision_of(stop, **weak).advice


def test_a_stop_without_position_or_control_is_decided_on_by_its_reason_and_its_markers():
    stop = made_up_stop()
    no = NoFix(method="free_station", code="solve.no_match", reason="No match")
    found = decide(replace(stop, fixes={FIRST: no}), SurveyConfig(), MARKS)
    assert (found.is_good_enough, "no position: No match." in found.summary) == (False, True)
    alone = decide(replace(stop, fixes={}), SurveyConfig(), None)
    assert alone.is_good_enough
    fits = stop.fits["along_beam"]
    few = replace(stop, fixes={}, fits={"along_beam": replace(fits, fits=fits.fits[:2])})
    assert "Place more markers" in decide(few, SurveyConfig(), None).advice[-1]


def test_a_turn_that_is_not_full_is_advised_to_be():
    stop = made_up_stop()
    stop = replace(stop, cloud=replace(stop.cloud, coverage=np.radians(200.0)))
    found = decision_of(
        stop, status=Status.WEAK, reason="weak", excluded=(Exclusion(fit=0, reason="x."),)
    )
    assert any("turned by 200 deg" in one for one in found.advice)


def test_the_gain_of_one_more_marker_is_that_of_the_normal_equations():
    rng = np.random.default_rng(2)
    root = rng.normal(size=(6, 6)) * 1e-3
    cov, offset, variance = root @ root.T, np.array([3.0, -4.0, 0.5]), 4e-6
    J = np.hstack([-skew(offset), np.eye(3)])
    expected = np.linalg.inv(np.linalg.inv(cov) + J.T @ J / variance)
    (sigma,) = _sigmas_with(cov, offset[None], variance)
    np.testing.assert_allclose(sigma, np.sqrt(np.trace(expected[3:, 3:])), rtol=1e-7, atol=0)
