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

N = 10  # beams in each row on each side
# shares held by what is low and by what is tall, and perched: as high as poles, crates, and as what
# lies on the ground
ON_POLES, ON_WIDE, LOW = ((0.05, 0.0), 1.0), ((0.6, 0.0), 1.0), ((0.6, 0.0), 0.0)


def logs(*near):
    """Log probabilities where so many of the beams of each row end near, on both sides alike."""
    return logs_by(ON_POLES, near)


def logs_by(shares, near):
    stopped = np.array([near, near], np.float64)
    return _log_supports(stopped, N - stopped, *shares)[0]


@pytest.mark.parametrize(("n_near", "n_past"), [(0, 0), (3, 4), (40, 2)])
def test_a_share_of_beams_has_the_probability_of_one_order_of_a_beta_binomial(n_near, n_past):
    n = n_near + n_past
    expected = betabinom.logpmf(n_near, n, 0.3, 5.0) - np.log(comb(n, n_near))
    assert _log_share(n_near, n_past, (0.3, 5.0)) == pytest.approx(expected, abs=1e-9)


def test_legs_that_spread_are_no_shoulders_though_they_stop_as_many_beams():
    legs = logs(0, 3, 3, 3, 3, 3, 3, 3, 3)
    shoulders = logs(0, 0, 0, 0, 0, 0, 4, N, N)
    assert legs[SPHERE] > legs[HEAD] + 4.0
    assert shoulders[HEAD] > shoulders[SPHERE] + 2.0


def test_what_stops_every_beam_from_some_row_on_is_a_head_or_a_boulder():
    neck = logs(0, 0, 0, 0, N, N, N, N, N)
    assert np.argmax(neck) == HEAD
    ground = logs_by(LOW, [N] * N_ROWS)
    assert np.argmax(ground) == BOULDER


def test_what_is_tall_begins_where_a_sphere_ends_and_shoulders_below_a_neck():
    wall, shoulders = [0, 0, *[N] * 7], [0, 0, 0, 0, 0, *[N] * 4]
    pole_alone, as_high = ((0.0, 0.0), 1.0), ((0.0, 0.07), 1.0)
    gained = [
        logs_by(as_high, own)[SPHERE] - logs_by(pole_alone, own)[SPHERE]
        for own in (wall, shoulders)
    ]
    assert gained[0] > 3.0
    assert gained[1] < 0.1
    as_head = logs_by(as_high, shoulders)
    assert as_head[HEAD] > as_head[SPHERE] + 4.0


def test_a_boulder_on_another_is_held_as_a_sphere_on_something_wide():
    """Its stone widens right below it; on legs, which begin farther down, no boulder stands."""
    stone, legs = [0, 0, 3, *[N] * 6], [0, 0, 0, 0, 0, 0, *[N] * 3]
    perched, on_ground = (logs_by(((0.99, 0.0), share), stone) for share in (0.99, 0.01))
    rarer = np.log(0.33 / (0.9 * 0.2))  # a crate begins in more rows, and may be anything
    assert perched[BOULDER] == pytest.approx(perched[SPHERE] + rarer, abs=0.1)
    assert perched[BOULDER] > on_ground[BOULDER]
    on_legs = logs_by(((0.99, 0.0), 0.99), legs)
    assert on_legs[SPHERE] > on_legs[BOULDER] + 5.0


def test_shoulders_of_which_one_is_hidden_are_shoulders():
    stopped = np.zeros((2, N_ROWS))
    stopped[1, 4:] = N
    seen = np.full((2, N_ROWS), float(N))
    seen[0] = 0.0
    one_side = _log_supports(stopped, seen - stopped, *ON_POLES)[0]
    assert np.argmax(one_side) == HEAD


def test_what_is_wide_from_under_it_on_is_rather_a_crate_where_these_are_as_high():
    """Where only poles are, it is rather shoulders."""
    near = np.array([[0, 0, 0, *[N] * 6]] * 2, np.float64)
    low, high = (_log_supports(near, N - near, *one)[0] for one in (ON_WIDE, ON_POLES))
    assert low[SPHERE] - low[HEAD] > high[SPHERE] - high[HEAD] + 2.0


def test_what_is_neither_a_boulder_nor_a_head_is_held_as_a_sphere_is():
    for near in ([0] * N_ROWS, [0, 0, 2, 5, 1, 8, 0, 3, 4], [N] * N_ROWS):
        others = np.delete(logs(*near), (BOULDER, HEAD))
        np.testing.assert_array_equal(others, others[SPHERE])


def test_beams_below_show_whether_something_wide_holds_a_place():
    """However rare that is so high, and from where; rows that all let past show a pole."""
    box, tripod, pole = np.zeros((3, 2, N_ROWS))
    box[:, 1:], tripod[:, 5:] = N, N
    on_box, on_tripod, on_pole = (
        _log_supports(near, N - near, (0.01, 0.0), 0.1)[1] for near in (box, tripod, pole)
    )
    assert (on_box[1:] > 0.99).all()
    assert (on_tripod[5:] > 0.99).all()
    assert (on_tripod[:5] < 0.01).all()
    assert (on_pole < 0.001).all()


def test_without_beams_below_nothing_is_known():
    nothing, held = _log_supports(np.zeros((2, N_ROWS)), np.zeros((2, N_ROWS)), *ON_POLES)
    np.testing.assert_allclose(nothing, 0.0, atol=1e-9)
    assert held[0] == 0.0
    assert held[-1] == pytest.approx(0.899 * ON_POLES[0][0])  # or anything does, or nothing


def beams_below(level, counted=1):
    """Silent beams below a place, by sides, and how many of them are known to go past.

    Ground is heard far to the left of it, and to the right where silent pulses are not known.
    """
    x, y = np.mgrid[-3.95:4.0:0.1, -2.5:-0.3:0.1].reshape(2, -1)
    is_heard = (x < -2.0) | (np.hypot(x, y) > 3.0)
    silent = np.array([x, y, 0.5 * np.ones(len(x))])[:, ~is_heard]
    below = np.array([np.zeros((2, N_ROWS), np.int64), counted * beside_pole(silent, 0.1)])
    seen = Evidence(
        n_on=70, n_before=0, below=below, brightness=50.0, n_distinct=70,
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
