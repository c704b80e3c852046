import numpy as np
import pytest

from spheremark.pipelines.accuracy.error_model import Bound
from spheremark.web.pages import statements as study


def fits(n_stops=8, *, with_errors=True):
    """Errors that grow with distance, of two methods."""
    rng = np.random.default_rng(2)
    n = 14 * n_stops
    ranges = np.tile(np.linspace(4.0, 13.0, 14), n_stops)
    errors = np.concatenate([0.0015 * ranges / 8, 0.02 * ranges / 8])
    return {
        "stop": np.tile(np.repeat([f"lane3-stop{i}" for i in range(n_stops)], 14), 2),
        "fit_method": np.repeat(np.array(["along_beam", "paper"], dtype=object), n),
        "range_m": np.tile(ranges, 2),
        "n_points": np.ceil(6800 / np.tile(ranges, 2) ** 2),
        "error_3d_m": errors * rng.uniform(0.7, 1.3, 2 * n)
        if with_errors
        else np.full(2 * n, np.nan),
    }


@pytest.mark.parametrize(
    ("bound", "words"),
    [
        (Bound(value=12.34, low=11.0, high=13.9, seen=(5, 30)), "12.3 m (11.0 m to 13.9 m)"),
        (Bound(value=np.inf, low=np.inf, high=np.inf, seen=(5, 30)), "≥ 30.0 m"),
        (Bound(value=np.inf, low=21.0, high=np.inf, seen=(5, 30)), "≥ 30.0 m (21.0 m to ≥ 30.0 m)"),
        (Bound(value=0.0, low=0.0, high=0.0, seen=(5, 30)), "nowhere"),
    ],
)
def test_a_distance_is_written_with_its_interval_and_never_beyond_what_was_seen(bound, words):
    assert study.distance_words(bound) == words


@pytest.mark.parametrize(
    ("bound", "words"),
    [
        (Bound(value=41.2, low=30.0, high=55.0, seen=(9, 400)), "42 (30 to 55)"),
        (Bound(value=0.0, low=0.0, high=12.1, seen=(9, 400)), "≤ 9 (≤ 9 to 13)"),
        (Bound(value=np.inf, low=np.inf, high=np.inf, seen=(9, 400)), "> 400"),
    ],
)
def test_a_count_is_written_whole_and_never_below_what_was_seen(bound, words):
    assert study.count_words(bound) == words


def test_each_method_has_its_statement_from_the_rows_of_the_database():
    ours, paper = study.statements(fits(), 0.03)
    assert (ours.method, paper.method) == ("along_beam", "paper")
    assert ours.distance == "≥ 13.0 m"
    assert paper.p95.greatest_distance.value == pytest.approx(8 * 0.03 / 0.0255, rel=0.1)
    assert "m (" in paper.distance
    assert paper.power("incidence") == "\N{EN DASH}"
    assert "±" in paper.power("distance")


def test_the_same_rows_give_the_same_words():
    assert study.statements(fits(), 0.03)[1].distance == study.statements(fits(), 0.03)[1].distance


def test_without_truth_nothing_is_said():
    assert study.statements(fits(with_errors=False), 0.03) == ()


def test_too_few_errors_are_said_in_place_of_a_statement():
    few = {name: column[[0, 1, 2]] for name, column in fits().items()}
    (only,) = study.statements(few, 0.03)
    assert only.model is None
    assert only.distance.startswith("3 known errors are too few")
