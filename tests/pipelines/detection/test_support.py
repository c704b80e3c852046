"""What holds an object up, by which beams below it end near."""

from math import comb

import numpy as np
import pytest
from scipy.stats import betabinom

from spheremark.pipelines.detection.evidence import N_ROWS, Evidence, beside_pole
from spheremark.pipelines.detection.shapes import BOULDER, HEAD, SPHERE
from spheremark.pipelines.detection.support import (
    _beams_below,
    _log_share,
    _log_supports,
)

N = 10  # beams in each row on each side, nearer and farther
# Shares held by a pole, by what is narrow, wide, tall: as high as poles, as crates, alone on a pole
AS_POLES, AS_CRATES = np.array([0.75, 0.2, 0.05, 0.0]), np.array([0.3, 0.1, 0.6, 0.0])
ON_POLE, AS_TALL = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.93, 0.0, 0.0, 0.07])
ON_GROUND, ON_ANOTHER = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])


def supports(near, farther=None, standing=AS_POLES, lying=ON_ANOTHER, lower=(0, 0)):
    """What so many of the beams of each row that end near show, on both sides alike."""
    stopped = np.array([[near, near if farther is None else farther]] * 2, np.float64)
    return _log_supports((stopped, N - stopped, np.array(lower, np.float64)), standing, lying)


def logs(near, farther=None, **shares):
    """Log probabilities of these beams by all hypotheses."""
    return supports(near, farther, **shares)[0]


def wide_from(row):
    """Beams that end near from some row on."""
    return [0] * row + [N] * (N_ROWS - row)


@pytest.mark.parametrize(("n_near", "n_past"), [(0, 0), (3, 4), (40, 2)])
def test_a_share_of_beams_has_the_probability_of_one_order_of_a_beta_binomial(n_near, n_past):
    n = n_near + n_past
    expected = betabinom.logpmf(n_near, n, 0.3, 5.0) - np.log(comb(n, n_near))
    assert _log_share(n_near, n_past, (0.3, 5.0)) == pytest.approx(expected, abs=1e-9)


def test_legs_that_spread_are_no_shoulders_though_they_stop_as_many_beams():
    legs, shoulders = logs([0, *[3] * 8]), logs([0, 0, 0, 0, 0, 0, 4, N, N])
    assert legs[SPHERE] > legs[HEAD] + 4.0
    assert shoulders[HEAD] > shoulders[SPHERE] + 2.0


def test_what_stops_every_beam_from_some_row_on_is_a_head_or_a_boulder():
    assert np.argmax(logs(wide_from(4))) == HEAD
    on_ground = {"standing": AS_CRATES, "lying": ON_GROUND}
    assert np.argmax(logs(wide_from(0), **on_ground)) == BOULDER


def test_where_a_body_would_be_it_stops_all_beams_and_legs_a_few():
    above, aside = wide_from(5), [0] * N_ROWS  # both are narrow right below
    as_seen = logs(above, aside)
    for n_near, n_past, is_body in ((30, 1, True), (12, 24, False), (0, 36, False)):
        found = logs(above, aside, lower=(n_near, n_past)) - as_seen
        expected = betabinom.logpmf(n_near, n_near + n_past, [3.0, 8.0], [7.0, 1.0])
        assert found[SPHERE] - found[HEAD] == pytest.approx(expected[0] - expected[1], abs=0.1)
        assert (found[HEAD] > found[SPHERE] + 3.0) == is_body


def test_the_head_of_a_tripod_is_narrower_than_a_body_that_is_not_seen_from_the_side():
    """Beams farther to the side go past it, but for its legs, which spread below."""
    head, legs = wide_from(5), [0] * 8 + [4]
    row, as_body = 0.899 * 0.08, 0.1996  # probabilities of that row
    for farther, marker, body in ((legs, 0.2, 0.25), (head, 0.05, 0.4)):
        found = logs(head, farther)
        expected = np.log(marker * row / (body * as_body))
        assert found[SPHERE] - found[HEAD] == pytest.approx(expected, abs=1e-3)


def test_what_is_tall_begins_where_a_sphere_ends_and_shoulders_below_a_neck():
    wall, shoulders = wide_from(2), wide_from(5)
    gained = [
        logs(own, standing=AS_TALL)[SPHERE] - logs(own, standing=ON_POLE)[SPHERE]
        for own in (wall, shoulders)
    ]
    assert gained[0] > 3.0
    assert gained[1] < 0.1
    as_head = logs(shoulders, standing=AS_TALL)
    assert as_head[HEAD] > as_head[SPHERE] + 4.0


def test_a_boulder_on_another_is_held_as_a_sphere_on_something_wide():
    """Its stone widens right below it; on legs, which begin farther down, no boulder stands."""
    stone, on_wide = [0, 0, 3, *[N] * 6], np.array([0.0, 0.0, 1.0, 0.0])
    perched, on_ground = (
        logs(stone, standing=on_wide, lying=share) for share in (ON_ANOTHER, ON_GROUND)
    )
    rarer = np.log(0.33 / (0.9 * 0.2))  # a crate begins in more rows, and may be anything
    assert perched[BOULDER] == pytest.approx(perched[SPHERE] + rarer, abs=0.1)
    assert perched[BOULDER] > on_ground[BOULDER]
    on_legs = logs(wide_from(6), standing=on_wide)
    assert on_legs[SPHERE] > on_legs[BOULDER] + 5.0


def test_shoulders_of_which_one_is_hidden_are_shoulders():
    stopped, seen = np.zeros((2, 2, N_ROWS)), np.full((2, 2, N_ROWS), float(N))
    stopped[1, :, 4:], seen[0] = N, 0.0
    one_side = _log_supports((stopped, seen - stopped, np.zeros(2)), AS_POLES, ON_ANOTHER)[0]
    assert np.argmax(one_side) == HEAD


def test_what_is_wide_from_under_it_on_is_rather_a_crate_where_these_are_as_high():
    """Where only poles are, it is rather shoulders."""
    low, high = (logs(wide_from(3), standing=own) for own in (AS_CRATES, AS_POLES))
    assert low[SPHERE] - low[HEAD] > high[SPHERE] - high[HEAD] + 2.0


def test_what_is_neither_a_boulder_nor_a_head_is_held_as_a_sphere_is():
    for near in ([0] * N_ROWS, [0, 0, 2, 5, 1, 8, 0, 3, 4], [N] * N_ROWS):
        others = np.delete(logs(near), (BOULDER, HEAD))
        np.testing.assert_array_equal(others, others[SPHERE])


def test_beams_below_show_whether_something_but_a_pole_holds_a_place():
    """However rare that is so high, and from where; rows that all let past show a pole."""
    rare = np.array([0.98, 0.01, 0.01, 0.0])
    on_box, on_tripod, on_pole = (
        supports(near, farther, standing=rare)[1]
        for near, farther in (
            (wide_from(1), None),
            (wide_from(5), [0] * N_ROWS),
            ([0] * N_ROWS, None),
        )
    )
    assert (on_box[1:] > 0.99).all()
    assert (on_tripod[5:] > 0.99).all()
    assert (on_tripod[:5] < 0.01).all()
    assert (on_pole < 0.001).all()


def test_without_beams_below_nothing_is_known():
    nothing = np.zeros((2, 2, N_ROWS))
    logs_of_nothing, held = _log_supports((nothing, nothing, np.zeros(2)), AS_POLES, ON_ANOTHER)
    np.testing.assert_allclose(logs_of_nothing, 0.0, atol=1e-8)
    assert held[0] == 0.0
    assert held[-1] == pytest.approx(0.899 * AS_POLES[1:].sum())  # or anything does, or nothing


def beams_below(level, counted=1):
    """Silent beams below a place, by sides, and how many of them are known to go past.

    Ground is heard far to the left of it, and to the right where silent pulses are not known.
    """
    x, y = np.mgrid[-3.95:4.0:0.1, -2.5:-0.3:0.1].reshape(2, -1)
    is_heard = (x < -2.0) | (np.hypot(x, y) > 3.0)
    silent = np.array([x, y, 0.5 * np.ones(len(x))])[:, ~is_heard]
    below = np.array([np.zeros((2, 2, N_ROWS), np.int64), counted * beside_pole(silent, 0.1)])
    seen = Evidence(
        n_on=70, n_before=0, below=below, lower=np.zeros(2, np.int64),
        brightness=50.0, n_distinct=70,
        rows=np.empty(0, np.int32), seen=np.array([x, y, 0.0 * x])[:, is_heard], faces=np.empty(0),
        strengths=np.empty(0), silent=silent, widths=np.array([[0.1, 0.0], [0.1, 0.0]]),
    )  # fmt: skip
    return below[1], _beams_below(seen, level, 1.0)[1]


def test_silence_below_shows_a_pole_only_where_ground_beside_it_is_heard():
    silent, past = beams_below(-5.0)
    assert past[0].sum() > 0.9 * silent[0].sum()
    assert past[1].sum() < 0.1 * silent[1].sum()


def test_silence_above_the_horizon_is_the_sky():
    silent, past = beams_below(5.0)
    np.testing.assert_array_equal(past, silent)


def test_no_more_beams_are_unknown_than_are_counted():
    """As where widths of a beam are known a little differently."""
    _, past = beams_below(-5.0, counted=0)
    np.testing.assert_array_equal(past, 0.0)
