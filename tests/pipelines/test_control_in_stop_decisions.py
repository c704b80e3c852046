"""Decisions on stops name control marks that the distances between markers contradict."""

from dataclasses import replace

import numpy as np
import pytest

from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.model import ControlMarks
from spheremark.pipelines.positioning.quality_control import check_distances
from spheremark.pipelines.stop_decisions import decide
from tests.surveyed import marks, stop


@pytest.fixture(scope="module")
def control():
    return marks()


@pytest.fixture(scope="module")
def seen(control):
    result, _ = stop("quarry-1", np.array([0.5, 0.4, 1.1]), control, np.random.default_rng(3))
    return result


def moved(control, place, shift):
    p = control.p_site.copy()
    p[place] += shift
    return ControlMarks(names=control.names, p_site=p, cov_p_site=control.cov_p_site)


def checked(seen, control):
    config = SurveyConfig()
    fits = next(iter(seen.fits.values()))
    return replace(
        seen, distances=check_distances(fits, control, config.resection, config.tolerance)
    )


@pytest.mark.parametrize("shift", [0.08, 0.4])
def test_a_control_mark_that_the_distances_contradict_is_named(seen, control, shift):
    wrong = moved(control, 2, [shift, 0.0, 0.0])
    assert (
        f"look at {control.names[2]}." in decide(checked(seen, wrong), SurveyConfig(), wrong).text
    )


def test_control_that_agrees_and_no_control_are_not_spoken_of(seen, control):
    assert "look at" not in decide(checked(seen, control), SurveyConfig(), control).text
    assert "look at" not in decide(replace(seen, fixes={}), SurveyConfig(), None).text
