"""Coverage of error ellipses: the measure itself, and whole simulated surveys."""

from functools import partial

import numpy as np
import pytest

from spheremark.pipelines.config import FittingConfig
from spheremark.pipelines.errors import ConfigError, TooFewObservationsError
from spheremark.pipelines.evaluation.ellipse_coverage import (
    LEVELS,
    METHODS,
    QUANTITIES,
    Draws,
    coverage,
    drawn_optics,
    ellipse_coverage,
    joined,
    nees,
    survey_draws,
)
from spheremark.pipelines.threads import in_processes
from tests import chance


def drawn(rng, n_surveys=200, n_stops=7, scale=1.0, shared=0.0):
    """Squares of normal errors, ``scale`` times as large as nominal, partly shared by a survey."""
    n = n_surveys * n_stops
    squares = {}
    for method in METHODS:
        for quantity, k in QUANTITIES.items():
            own = rng.normal(size=(n_surveys, n_stops, k))
            common = rng.normal(size=(n_surveys, 1, k))
            errors = np.sqrt(1 - shared) * own + np.sqrt(shared) * common
            squares[method, quantity] = scale**2 * np.sum(errors**2, axis=2).ravel()
    return Draws(
        surveys=np.repeat(np.arange(n_surveys), n_stops),
        squares=squares,
        errors={method: np.zeros((n, 3)) for method in METHODS},
        sigmas={method: np.ones(n) for method in METHODS},
    )


def test_honest_ellipses_hold_their_shares():
    draws = drawn(np.random.default_rng(1))
    found = coverage(draws)
    assert len(found) == len(METHODS) * len(QUANTITIES) * len(LEVELS)
    for one in found:
        assert abs(one.share - one.level) < 0.04
        assert one.low < one.share < one.high
    assert all(abs(value - 1) < 0.1 for value in nees(draws).values())


@pytest.mark.parametrize("scale", [0.7, 1.5])
def test_ellipses_of_the_wrong_size_are_found_out(scale):
    draws = drawn(np.random.default_rng(2), scale=scale)
    for one in coverage(draws):
        assert (one.share - one.level) * (1 - scale) > 0
        if one.level == 0.68:
            assert not one.low <= one.level <= one.high
    assert nees(draws)["network", "position"] == pytest.approx(scale**2, rel=0.1)


def test_intervals_know_that_stops_of_a_survey_share_their_rig():
    alone = coverage(drawn(np.random.default_rng(3)))
    shared = coverage(drawn(np.random.default_rng(3), shared=0.9))
    widths = [np.mean([one.high - one.low for one in some]) for some in (alone, shared)]
    assert widths[1] > 1.5 * widths[0]


def test_stations_that_could_not_be_positioned_do_not_count():
    draws = drawn(np.random.default_rng(4))
    squares = {key: value.copy() for key, value in draws.squares.items()}
    squares["network", "pose"][:700] = np.nan
    part = Draws(surveys=draws.surveys, squares=squares, errors=draws.errors, sigmas=draws.sigmas)
    counts = {(one.method, one.quantity): one.n for one in coverage(part)}
    assert counts["network", "pose"] == 700
    assert counts["network", "position"] == 1400


def test_a_method_that_positions_few_stations_has_an_interval_and_one_that_positions_none_says_so():
    draws = drawn(np.random.default_rng(6), 8, 5)
    squares = {key: value.copy() for key, value in draws.squares.items()}
    squares["network", "pose"][10:] = np.nan  # the stations of two surveys of eight are left
    few = Draws(surveys=draws.surveys, squares=squares, errors=draws.errors, sigmas=draws.sigmas)
    (one,) = (
        row for row in coverage(few, (0.68,)) if (row.method, row.quantity) == ("network", "pose")
    )
    assert 0.0 <= one.low <= one.share <= one.high <= 1.0
    squares["network", "pose"][:] = np.nan
    for ask in (coverage, nees):
        with pytest.raises(TooFewObservationsError, match="None of 40 stations"):
            ask(few)


def test_the_report_has_shares_with_intervals_for_each_method_and_quantity():
    draws = drawn(np.random.default_rng(7), 40, 5)
    experiment = ellipse_coverage(40, 5, seed=3)
    assert list(experiment.worlds) == list(range(3, 43))
    parts = [
        Draws(
            surveys=draws.surveys[own],
            squares={key: value[own] for key, value in draws.squares.items()},
            errors={key: value[own] for key, value in draws.errors.items()},
            sigmas={key: value[own] for key, value in draws.sigmas.items()},
        )
        for own in (draws.surveys < 20, draws.surveys >= 20)
    ]
    report = experiment.pool(parts)
    assert (report["seed"], report["n_surveys"], report["n_stations"]) == (3, 40, 200)
    assert all(sum(row["counts"]) == 200 for row in report["nees"])
    (table,) = experiment.tables(report)
    (row,) = (row for row in table.rows if row["method"] == "network" and row["dimensions"] == 2)
    (level,) = (
        one for one in report["levels"]
        if (one["method"], one["quantity"], one["level"]) == ("network", "horizontal", 0.95)
    )  # fmt: skip
    cells = {column.heading: column.cell(row) for column in table.columns}
    assert cells["95 %"].startswith(f"{100 * level['share']:.1f} (")


def test_one_survey_and_no_stop_are_refused():
    with pytest.raises(TooFewObservationsError, match="two surveys or more"):
        joined([drawn(np.random.default_rng(5), 1)])
    with pytest.raises(ConfigError, match="stops"):
        survey_draws(1, n_stops=0)


def test_lidars_differ_by_as_much_as_fits_allow_for():
    rng, prior = np.random.default_rng(8), FittingConfig()
    lidars = [drawn_optics(rng) for _ in range(1000)]
    low, high = chance.of_mean_square(len(lidars))
    for name, sigma in (("range_bias", prior.sigma_range_common), ("range_scale", 1e-4)):
        squares = [(getattr(one, name) / sigma) ** 2 for one in lidars]
        assert low < np.mean(squares) < high
    assert {one.profile for one in lidars} == set(type(lidars[0].profile))
    assert all(one.divergence_scale > 0.0 for one in lidars)


@pytest.mark.long
def test_ellipses_of_whole_simulated_surveys_hold_their_shares():
    """Noise, biases, optics, encoder, misalignment, axis offset and tilt are all random.

    A share of one half among 300 stations is known to 2.9 points, and the limit is 7.5. Of products
    whose ellipses hold 96 % pass, of those whose variances are wrong by an eighth 46 %, by a
    quarter 1 %. With 660 stations, for which a test is no place, shares were within 3.2 points.
    """
    draws = joined(in_processes(partial(survey_draws, n_stops=15), range(9000, 9020)))
    assert all(np.isfinite(squares).all() for squares in draws.squares.values())
    for one in coverage(draws):
        if one.quantity != "pose":
            assert abs(one.share - one.level) <= 0.075, one
    for (_, quantity), value in nees(draws).items():
        if quantity != "pose":
            assert 0.83 < value < 1.2
