"""What is refused before it is compared, and which of those that are compared are markers."""

import numpy as np
import pytest
from scipy import stats

from spheremark.pipelines.detection.decision import (
    is_resolved,
    judgement_of,
    noise_of,
    paint_of,
    posteriors_of,
    reason_by_evidence,
    reason_by_features,
    shared_of,
    stones_of,
    sure_ones,
)
from spheremark.pipelines.detection.evidence import N_ROWS, Evidence
from spheremark.pipelines.detection.features import Features
from spheremark.pipelines.detection.hypotheses import STONES, USUAL, Physics
from spheremark.pipelines.detection.shapes import NAMES
from spheremark.pipelines.detection.target import Target
from spheremark.pipelines.scan.rigs import BEAM_WINDOW

TARGET = Target(0.10, np.array([0.0, 0.0, 1.0]), 0.003)


def features(n_points=70, **changes):
    """A ball of the known radius 10 m away, as a VLP-16 sees it."""
    seen = Features(
        x=10.0, y=0.0, z=0.5, n_points=n_points, n_off=0,
        scatter=0.0089, width=0.2, height=0.19,
    )  # fmt: skip
    return seen._replace(**changes)


def evidence(n_past=150, **changes):
    """A ball that stands on a pole before something far: half of the beams on each side."""
    below = np.zeros((2, 2, 2, N_ROWS), np.int64)
    below[1, :, 0, 4] = n_past // 2
    seen = Evidence(
        n_on=70, n_before=0, below=below, lower=np.zeros(2, np.int64),
        brightness=50.0, n_distinct=70,
        rows=np.empty(0, np.int32), seen=np.empty((3, 0)), faces=np.empty(0),
        strengths=np.empty(0), silent=None, widths=np.full((2, 2), 0.01), height=np.nan,
        sigma_height=np.inf,
    )  # fmt: skip
    return seen._replace(**changes)


def refusal(seen, about):
    return reason_by_features(seen, TARGET.radius) or reason_by_evidence(seen, about, TARGET)


def test_a_ball_on_a_pole_passes_and_a_piece_of_a_wall_does_not():
    assert refusal(features(), evidence()) == ""
    assert "does not stand free" in refusal(features(n_off=40), evidence())


def test_a_ball_seen_more_closely_than_any_other_shape_may_touch_something():
    close = features(scatter=0.003)
    assert is_resolved(close, TARGET.radius)
    assert refusal(close._replace(n_off=40), evidence()) == ""


def test_what_most_beams_below_go_past_shows_that_it_stands_on_a_pole():
    seen = evidence()
    assert seen.shows_below
    seen.below[0, 0, 0, 4] = 160
    assert not seen.shows_below


def test_what_is_held_by_a_body_stands_on_no_pole_though_its_neck_is_thin():
    seen = evidence(lower=np.array([160, 0]))
    assert not seen.shows_below
    assert not seen.stands_free(TARGET.radius)
    assert evidence(lower=np.array([40, 80])).stands_free(TARGET.radius)  # legs of a tripod


def test_what_stands_free_is_known_by_the_beams_below_or_else_by_its_height():
    seen, radius = evidence(), TARGET.radius
    assert seen._replace(height=0.5 * radius).stands_free(radius)
    held = evidence(n_past=0)
    held.below[0, :, 0, 4] = 2
    assert not held._replace(height=9.0 * radius).stands_free(radius)
    unseen = evidence(n_past=2)
    assert unseen.stands_free(radius)
    assert unseen._replace(height=3.0 * radius).stands_free(radius)
    assert not unseen._replace(height=1.5 * radius).stands_free(radius)


def test_of_a_ball_two_thirds_may_be_hidden():
    assert refusal(features(n_points=25), evidence(n_on=25, n_before=50)) == ""
    assert "hidden" in refusal(features(n_points=25), evidence(n_on=25, n_before=55))


MANY = 40  # returns


def likelihoods(*sphere_over_others):
    """Logarithms of likelihoods of groups whose other hypotheses are all alike."""
    found = np.zeros((len(sphere_over_others), len(NAMES)))
    found[:, 0] = sphere_over_others
    return found


def judged(found, n_returns, is_free):
    return [judgement_of(own, NAMES) for own in posteriors_of(found, n_returns, is_free)]


def test_probabilities_follow_the_likelihoods_and_name_the_best_other_hypothesis():
    found = likelihoods(12.0, 3.0, -4.0)
    found[2, NAMES.index("head on shoulders")] = 2.0
    sure, doubtful, head = judged(found, [MANY] * 3, [True] * 3)
    assert sure.probability > 0.999 > doubtful.probability > head.probability
    assert head.hypothesis.startswith("head on shoulders: ")
    assert head.reason.startswith("Head on shoulders: ")
    assert "likelier than a marker" in head.reason
    assert judged(likelihoods(), [], []) == []


def test_among_trees_a_group_that_may_be_leaves_is_rather_leaves():
    doubtful = likelihoods(4.0)
    leaves = likelihoods(*[-30.0] * 20)
    leaves[:, NAMES.index("foliage or other clutter")] = 5.0
    alone = judged(doubtful, [MANY], [True])[0].probability
    among = judged(np.vstack([doubtful, leaves]), [MANY] * 21, [True] * 21)
    assert among[0].probability < alone


def test_what_lies_on_something_says_nothing_of_what_stands_free():
    doubtful, stones = likelihoods(4.0, 4.0), likelihoods(*[-30.0] * 20)
    stones[:, NAMES.index("boulder on the ground")] = 5.0
    (alone,) = judged(doubtful[:1], [MANY], [True])
    free, lying, *_ = judged(np.vstack([doubtful, stones]), [MANY] * 22, [True] + [False] * 21)
    assert free == alone
    assert lying.probability < alone.probability


def test_of_what_is_far_less_is_a_marker_than_of_what_is_near():
    """Twice the distance is a quarter of the returns, and four times the ground."""
    near, far = (judged(likelihoods(6.0), [n], [True])[0].probability for n in (400, 8))
    assert near > far > 0.9


def test_markers_hold_no_more_false_ones_than_wanted():
    probabilities = [0.999, 0.996, 0.9999, 0.992, 0.3]
    assert sure_ones(probabilities, 0.01) == [True, True, True, False, False]
    assert sure_ones(probabilities, 0.02) == [True, True, True, True, False]
    assert sure_ones(probabilities, 1e-6) == [False] * 5
    assert sure_ones([], 0.01) == []


def test_what_a_plane_fits_as_well_shows_no_noise():
    balls = [features(scatter=sigma) for sigma in (0.010, 0.011, 0.012)]
    clutter = [features(scatter=0.03)] * 9
    assert noise_of(balls + clutter, TARGET.radius) == pytest.approx(0.011)
    assert np.isnan(noise_of(clutter, TARGET.radius))


def test_a_few_returns_beside_spheres_do_not_hide_their_noise():
    """As of panels close behind them; many are of leaves, whose scatter is no noise."""
    balls = [features(scatter=0.011, n_off=3)] * 3
    leaves = [features(scatter=0.02, n_off=30)] * 9
    assert noise_of(balls + leaves, TARGET.radius) == pytest.approx(0.011)


N_SHARED = len(USUAL) + 1  # with the noise


def physics(n, sigma, stones=(0.0, 1.0)):
    """Of groups of a scan: what nothing is known of but for a standard deviation, and 0.6."""
    shared = np.full(N_SHARED, 0.6), np.full(N_SHARED, sigma)
    return [Physics(*shared, 0.0, 0.0, np.array(stones))] * n


def shared(values, probabilities, sigma=100.0, half_widths=100.0):
    """What others show, where each shows the same value of all things, to a tenth."""
    half_widths = np.broadcast_to(half_widths, len(values))
    shown = np.repeat(np.array(values)[:, None], N_SHARED, axis=1)
    covs = np.repeat(0.01 * np.eye(N_SHARED)[None], len(values), axis=0)
    return shared_of((shown, covs), probabilities, physics(len(values), sigma), half_widths)


def test_what_markers_share_is_what_the_others_show_by_their_probability():
    means, sigmas = shared([0.2, 0.21, 0.19, 0.9], [1.0, 1.0, 1.0, 0.0])
    for own in means.T:
        assert own == pytest.approx([0.2, 0.195, 0.205, 0.2], abs=1e-3)
    assert np.all(sigmas[3] < sigmas[0])
    assert np.all(sigmas[0] < 0.25)


def test_a_sure_sphere_that_is_unlike_the_others_hardly_counts():
    values = [0.20, 0.21, 0.19, 0.20, 0.22, 0.18, 3.0]
    means, _ = shared(values, [1.0] * 7)
    assert means[0] == pytest.approx(0.2, abs=0.05)
    assert np.mean(values[1:]) > 0.6


def test_beams_that_are_wide_at_their_window_move_the_edges_of_near_markers_most():
    """Both edges, in half widths of a beam that has none there; but nothing else does."""
    half_widths = 0.0015 * np.array([3.0, 4.0, 6.0, 9.0, 12.0, 15.0])  # [m] of 3 mrad
    edges = 0.6 + 0.4 * 0.5 * BEAM_WINDOW.mean() / half_widths
    means, sigmas = shared(edges, np.ones(6), 0.3, half_widths)
    near, far = means[0], means[-1]
    assert near[1] > 0.6 + 0.6 * (edges[0] - 0.6)
    assert near[1] - far[1] > 0.6 * (edges[0] - edges[-1])
    assert near[3] < edges[1:].mean() + 0.01  # as the others show it
    alone, sigmas_alone = shared(edges[:1], [1.0], 0.3, half_widths[:1])
    assert alone[0] == pytest.approx(0.6)
    assert sigmas_alone[0, 2] > sigmas_alone[0, 1] > sigmas_alone[0, 3]
    assert sigmas[0, 1] < 0.7 * sigmas_alone[0, 1]


def test_the_last_echo_moves_the_edge_before_something_in_by_the_whole_width_at_the_window():
    half_widths = 0.0015 * np.array([3.0, 4.0, 6.0, 9.0, 12.0, 15.0])  # [m] of 3 mrad
    edges = 0.6 - 0.5 * BEAM_WINDOW.mean() / half_widths
    before_nothing, before_something = shared(edges, np.ones(6), 0.3, half_widths)[0].T[1:3]
    assert before_something[0] == pytest.approx(edges[0], abs=0.2)
    assert before_something[0] < before_nothing[0]


def test_rays_without_a_width_have_no_window():
    means, _ = shared([0.2, 0.21, 0.19], np.ones(3), half_widths=0.0)
    assert means[0] == pytest.approx(0.2, abs=1e-3)


def test_without_other_spheres_what_markers_share_is_the_usual():
    means, sigmas = shared([0.2], [1.0], sigma=0.4)
    assert means[0] == pytest.approx(0.6)
    assert np.all(sigmas[0] >= 0.4)


def painted(*reflectivities, n_past=150):
    """Ratios of a marker's paint to any paint, and sentences, of groups that may be markers."""
    groups = [evidence(brightness=value, n_past=n_past) for value in reflectivities]
    return paint_of(groups, along_a_line(len(groups)), [0.9] * len(groups), TARGET.radius)


def along_a_line(n, step=10.0):
    """Places [m] that are a step from one another."""
    return np.outer(step * np.arange(n), [1.0, 0.0, 0.0])


def test_what_is_painted_as_the_others_is_likelier_a_marker():
    ratios, texts = painted(50.0, 50.0, 51.0, 49.0, 20.0)
    assert min(ratios[:4]) > 1.0 > -2.0 > ratios[4]
    assert texts[:4] == [""] * 4
    assert "reflectivity is 20, that of the markers 50" in texts[4]


def test_dirt_may_hide_the_paint_of_a_marker_whose_pole_is_seen_only():
    """By the ratio of Student's densities of the paints of markers and of other things."""
    on_pole, unseen = (painted(50.0, 50.0, 51.0, 49.0, 10.0, n_past=n)[0][4] for n in (150, 0))
    dirty, scale = np.log(10.0 / 50.0), np.hypot(0.1, 0.4 / np.sqrt(70))
    tail = stats.t(3, scale=scale).logpdf(dirty) - stats.t(6, scale=0.7).logpdf(dirty)
    assert on_pole == pytest.approx(tail, abs=0.2)
    assert unseen < -8.0


@pytest.mark.parametrize("n_alike", [1, 5])
def test_a_paint_unlike_all_others_is_no_evidence_for_a_marker(n_alike):
    """Other things look alike, but one or five are black."""
    values = [50.0] * 3 + [3.0] * n_alike + list(np.geomspace(20.0, 60.0, 100))
    groups = [evidence(brightness=value) for value in values]
    shares = [0.99] * 3 + [0.1] * n_alike + [0.0] * 100
    ratios, _ = paint_of(groups, along_a_line(len(groups)), shares, TARGET.radius)
    assert max(ratios[3 : 3 + n_alike]) < 0.0 < min(ratios[:3])


def test_what_no_return_shows_the_paint_of_is_judged_by_its_shape_alone():
    values = [50.0] * 5 + list(np.geomspace(20.0, 60.0, 20))
    seen = [evidence(brightness=value) for value in values]
    shares = [0.99] * 5 + [0.01] * 20
    unseen = [evidence(n_on=0, n_distinct=0, brightness=0.0)] * 3
    alone, _ = paint_of(seen, along_a_line(25), shares, TARGET.radius)
    ratios, texts = paint_of(
        [*unseen, *seen], along_a_line(28) - 30.0, [0.5] * 3 + shares, TARGET.radius
    )
    np.testing.assert_array_equal(ratios[:3], 0.0)
    np.testing.assert_allclose(ratios[3:], alone)
    assert texts[:3] == [""] * 3


def test_many_doubtful_groups_do_not_outvote_a_few_sure_markers():
    """As among far stones, each of which may be a marker."""
    n_sure, doubtful = 5, np.geomspace(7.0, 16.0, 40)
    values = [*n_sure * [21.0], *doubtful]
    groups = [evidence(brightness=value, n_past=0) for value in values]  # no pole is seen
    shares = [0.9998] * n_sure + [0.3] * len(doubtful)
    ratios, _ = paint_of(groups, along_a_line(len(groups)), shares, TARGET.radius)
    assert min(ratios[:n_sure]) > 1.0 > max(ratios[n_sure:])


def test_what_shows_no_pole_does_not_outvote_markers_that_do():
    """As round stones on larger ones, each of which is a sphere by its shape."""
    n_markers, n_stones = 5, 9
    groups = [evidence(brightness=30.0, n_past=150)] * n_markers
    groups += [evidence(brightness=9.0, n_past=0)] * n_stones
    shares = [0.9998] * (n_markers + n_stones)
    ratios, _ = paint_of(groups, along_a_line(len(groups)), shares, TARGET.radius)
    assert min(ratios[:n_markers]) > 1.0 > -8.0 > max(ratios[n_markers:])


def test_the_scale_of_reflectivities_does_not_matter():
    """Some sensors give signals of thousands."""
    values = np.array([50.0, 50.0, 51.0, 49.0, 20.0])
    np.testing.assert_allclose(painted(*values)[0], painted(*100.0 * values)[0], atol=1e-6)


def test_a_group_alone_shows_no_paint():
    assert abs(painted(20.0)[0][0]) < 0.5
    assert len(painted()[0]) == 0


@pytest.mark.parametrize("n_others", [5, 40])
def test_where_all_things_look_alike_paint_says_nothing(n_others):
    """As in clouds without intensities."""
    groups = [evidence()] * (8 + n_others)
    shares = [0.99] * 8 + [0.1] * n_others
    ratios, _ = paint_of(groups, along_a_line(len(groups)), shares, TARGET.radius)
    assert np.all(np.abs(ratios) < 1.0)
    groups[8:] = [evidence(brightness=value) for value in np.geomspace(20.0, 125.0, n_others)]
    shares = [0.99] * 8 + [0.1] * n_others
    ratios, _ = paint_of(groups, along_a_line(len(groups)), shares, TARGET.radius)
    assert np.all(ratios[:8] > 1.2)


@pytest.mark.parametrize(
    ("step", "share", "is_fooled"), [(0.4, 0.1, False), (0.4, 0.5, False), (10.0, 0.5, True)]
)
def test_parts_of_one_thing_do_not_testify_for_one_another(step, share, is_fooled):
    """Five groups on the dark window of a car have a paint of their own."""
    n_markers, n_parts, others = 3, 5, np.geomspace(20.0, 125.0, 100)
    values = [50.0] * n_markers + [3.0] * n_parts + list(others)
    groups = [evidence(brightness=value) for value in values]
    places = along_a_line(len(groups))
    places[n_markers : n_markers + n_parts] = 100.0 + along_a_line(n_parts, step)
    shares = [0.99] * n_markers + [share] * n_parts + [0.0] * len(others)
    ratios, _ = paint_of(groups, places, shares, TARGET.radius)
    assert (ratios[n_markers] > ratios[0]) == is_fooled


@pytest.mark.parametrize("n_parts", [1, 3])
def test_a_group_is_as_probably_a_part_of_each_thing_near_by_as_a_thing_of_its_own(n_parts):
    """All have one paint: eight markers, one group, and parts of other things near by it or not."""
    groups, shares = [evidence()] * (9 + n_parts), [0.99] * 8 + [0.5] + [0.0] * n_parts
    near = along_a_line(9 + n_parts)
    near[9:] = near[8] + np.outer(np.linspace(0.6, 1.5, n_parts), [0.0, 1.0, 0.0])
    far, sharing = near.copy(), near.copy()
    far[9:] += [0.0, 50.0, 0.0]
    sharing[9:] = near[8] + [0.0, 0.0, 0.2]  # a radius or two away: of the same returns
    by_near, by_far, by_sharing = (
        paint_of(groups, places, shares, TARGET.radius)[0][8] for places in (near, far, sharing)
    )
    scale = np.hypot(0.1, 0.4 / np.sqrt(70))
    alone = stats.norm(scale=np.hypot(scale, 0.7 / np.sqrt(1.58 + n_parts))).pdf(0.0)
    of_parts = stats.norm(scale=np.sqrt(2.0) * scale).pdf(0.0)
    other = (alone + n_parts * of_parts) / (1.0 + n_parts)
    assert by_far - by_near == pytest.approx(np.log(other / alone), abs=1e-6)
    assert by_sharing == pytest.approx(by_far)


BEGUN = (-2.0, 0.5)  # what was expected of the scatter of stones when they were fitted


def stones(logs, shares, n_returns=MANY):
    """How rough the stones of a scan are; a tenth of a radius is usual."""
    n = len(logs)
    usual = np.full(n, np.log(0.1))
    return stones_of(np.array(logs), [n_returns] * n, np.array(shares), physics(n, 1, BEGUN), usual)


@pytest.mark.parametrize(("n", "n_returns"), [(1, MANY), (3, MANY), (12, MANY), (3, 8)])
def test_a_stone_is_as_rough_as_the_others_of_a_scan_say_and_as_surely(n, n_returns):
    within, between = STONES
    rng = np.random.default_rng(5)
    fitted = np.sqrt(0.5 / (n_returns - 6))  # of the logarithm of a scatter
    share = BEGUN[1] ** 2 / (BEGUN[1] ** 2 + fitted**2)
    off = []
    for mean in rng.normal(np.log(0.1), between, 2000):
        own = rng.normal(mean, within, n)
        shown = own + np.append(rng.normal(0.0, fitted, n - 1), 9.0)  # nothing shows itself
        means, sigmas = stones(BEGUN[0] + share * (shown - BEGUN[0]), [1.0] * n, n_returns)
        off.append((own[-1] - means[-1]) / sigmas[-1])
    assert np.mean(off) == pytest.approx(0.0, abs=0.08)
    assert np.std(off) == pytest.approx(1.0, abs=0.06)


def test_what_is_no_stone_says_nothing_of_stones():
    means, sigmas = stones([np.nan, -9.0, -4.0, -1.0], [1.0, 0.0, 0.0, 0.0])
    assert means == pytest.approx(np.log(0.1))
    assert sigmas == pytest.approx(np.hypot(*STONES))
