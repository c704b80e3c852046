"""What is refused for its surroundings, and when a shape is close enough to do without them."""

import numpy as np
import pytest

from spheremark.pipelines.config import ExtractionConfig
from spheremark.pipelines.detection.decision import (
    is_resolved,
    reason_by_evidence,
    reason_by_features,
    reference_of,
    with_reference_scatter,
)
from spheremark.pipelines.detection.evidence import Evidence
from spheremark.pipelines.detection.features import Features
from spheremark.pipelines.detection.target import Target

TARGET = Target(0.10, np.array([0.0, 0.0, 1.0]), 0.003)
SHOULDERS = {"n_below": 14}


def features(n_points=70, scatter_free=0.0075, **changes):
    """A ball of the known radius 10 m away, as a VLP-16 sees it."""
    seen = Features(
        x=10.0, y=0.0, z=0.5, n_points=n_points, n_unexplained=0, n_beside=0, n_below=0,
        scatter=0.0075, width=0.2, height=0.19, radius_free=0.1, sigma_radius=0.0009,
        scatter_free=scatter_free, gain_free=0.0, flat_across=0.0, sigma_across=0.05,
        flat_along=0.0, sigma_along=0.05, blur=0.015,
    )  # fmt: skip
    return seen._replace(**changes)


def evidence(**changes):
    """A ball that stands on a pole before something far."""
    seen = Evidence(
        n_on=70, n_through=0, n_before=0, spread=0.55, n_held=0, n_past=150, n_short=0,
        brightness=50.0, n_distinct=70, rows=np.empty(0, np.int32), seen=np.empty((3, 0)),
    )  # fmt: skip
    return seen._replace(**changes)


def refusal(seen, about):
    return reason_by_features(seen, ExtractionConfig(), TARGET) or reason_by_evidence(
        seen, about, TARGET
    )


def test_a_ball_on_a_pole_passes_and_a_head_on_shoulders_does_not():
    assert refusal(features(), evidence()) == ""
    assert "shoulders" in refusal(features(), evidence(n_held=56, n_past=3))
    assert "head" in refusal(features(**SHOULDERS), evidence())


def test_a_ball_seen_more_closely_than_any_other_shape_may_stand_on_something():
    close = features(scatter_free=0.003, **SHOULDERS)
    assert is_resolved(close, TARGET)
    assert refusal(close, evidence(n_held=56, n_past=3)) == ""


def test_among_markers_that_scatter_more_none_is_seen_closely():
    """Of seventy returns, a robust scatter is less by a third once in fifty."""
    lucky = features(scatter_free=0.005, **SHOULDERS)
    others = [(features(), evidence()) for _ in range(3)]
    assert is_resolved(lucky, TARGET)
    usual = with_reference_scatter(lucky, reference_of([*others, (lucky, evidence())]))
    assert usual == lucky._replace(scatter_free=0.0075)
    assert not is_resolved(usual, TARGET)
    assert "head" in refusal(usual, evidence())


def test_a_ball_alone_or_among_others_as_close_stays_close():
    close = features(scatter_free=0.003)
    alone = reference_of([(close, evidence())] * 2)
    assert np.isnan(alone.scatter_free)
    assert with_reference_scatter(close, alone) == close
    among = reference_of([(features(scatter_free=s), evidence()) for s in (0.002, 0.0032, 0.004)])
    assert is_resolved(with_reference_scatter(close, among), TARGET)


@pytest.mark.parametrize("share_seen", [1.0, 0.5, 0.04])
def test_what_is_held_below_counts_by_how_much_is_seen_there(share_seen):
    """A tenth of the returns that a ball there would have may be held, and one."""
    n_seen = round(100 * share_seen)
    about = evidence(n_on=120, n_short=100 - n_seen)
    n_few = 1 + round(0.1 * 120 * share_seen)
    passes = about._replace(n_held=n_few - 1, n_past=n_seen - n_few + 1)
    held = about._replace(n_held=n_few + 2, n_past=n_seen - n_few - 2)
    assert "pole" not in reason_by_evidence(features(n_points=120), passes, TARGET)
    assert "pole" in reason_by_evidence(features(n_points=120), held, TARGET)


def test_of_a_ball_two_thirds_may_be_hidden():
    assert refusal(features(n_points=25), evidence(n_on=25, n_before=50)) == ""
    assert "hidden" in refusal(features(n_points=25), evidence(n_on=25, n_before=55))


def test_a_ball_of_which_something_hides_a_side_may_look_slim():
    slim = features(n_points=34, width=0.056)
    assert "slim" in refusal(slim, evidence(n_on=34))
    assert refusal(slim, evidence(n_on=34, n_before=30)) == ""
    assert "slim" in refusal(slim._replace(width=0.04), evidence(n_on=34, n_before=30))
