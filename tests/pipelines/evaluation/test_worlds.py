"""Scores of random worlds pooled into tables; the worlds themselves are simulated elsewhere."""

import numpy as np
import pytest

from spheremark.pipelines.evaluation.worlds import (
    CLASSES,
    Call,
    Centre,
    Common,
    Peers,
    Score,
    Seen,
    Sheet,
    Station,
    _anew,
    _of_worlds,
    _rows,
    _squares,
    _tags,
    _turn,
    _without_heading,
    report_of,
    tables,
    worlds,
)
from spheremark.pipelines.geometry import rot_z
from spheremark.pipelines.simulation.worlds import draw_world, family_of

MANY, FEW, ONE_LINE, _, LYING, WIDE = CLASSES


def centre(error, sigma=1.0, status="ok", bound2=1.0, anew=1.0):
    return Centre(status, error**2, bound2, error**2 / sigma**2, anew)


def score(family, seen, calls, **more):
    return Score(2, family, seen, calls, more.get("decoys", []), more.get("station"), "", 0.1)


@pytest.fixture
def report():
    """Two scans: three of four markers found, a false one that is ok and a possible one."""
    first = score(
        "plain",
        [Seen(MANY, ("ok", "peer"), "", centre(1.0)), Seen(MANY, ("weak",), "", None)],
        [Call("ok", 0.99, 0, ""), Call("weak", 0.8, 1, ""), Call("peer", 1.0, 0, "")],
        station=Station("ok", 4.0, 6.0, 3.0),
    )
    second = score(
        "decoys",
        [Seen(FEW, ("possible",), "", None), Seen(MANY, (), "it is a pole", None)],
        [Call("possible", 0.4, 0, ""), Call("ok", 0.9, -1, "cube"), Call("peer", 1.0, -1, "cube")],
        decoys=["cube", "cube", "tree"],
    )
    return report_of([first, second], 2, ("peer",))


def row(report, table, key, value):
    return next(one for one in report[table] if one[key] == value)


def test_recall_is_by_class_and_by_method(report):
    many = row(report, "markers", "class", MANY)
    assert (many["n"], many["n_ok"], many["n_weak"]) == (3, 1, 1)
    assert many["share"] == pytest.approx(2 / 3)
    assert many["share_peer"] == pytest.approx(1 / 3)
    assert many["reasons"] == {"it is a pole": 1}
    assert row(report, "markers", "class", FEW)["n_possible"] == 1
    assert row(report, "markers", "class", ONE_LINE)["share"] is None


def test_precision_counts_false_markers_by_method_and_decoy(report):
    ok, peer = (row(report, "methods", "method", name) for name in ("ok", "peer"))
    assert (ok["n"], ok["n_false"], ok["false_per_scan"]) == (2, 1, 0.5)
    assert peer["precision"] == 0.5
    cube = row(report, "decoys", "decoy", "cube")
    assert (cube["n"], cube["n_ok"], cube["n_weak"], cube["n_peer"]) == (2, 1, 0, 1)
    assert row(report, "decoys", "decoy", "tree")["n_ok"] == 0


def test_the_curve_falls_from_precision_to_recall(report):
    strict, loose = report["curve"][0], report["curve"][-1]
    assert strict["level"] == 0.9  # the false one is just refused
    assert strict["precision"] == 1.0
    assert strict["recall_0"] == pytest.approx(1 / 3)
    assert strict["recall_1"] == 0.0
    assert loose["level"] is None
    assert (loose["recall_0"], loose["recall_1"]) == (pytest.approx(2 / 3), 1.0)


def test_probabilities_are_compared_with_the_share_of_markers():
    groups = [Call("ok", 0.995, 0, ""), Call("possible", 0.993, -1, "tree", 30)]
    groups += [Call("refused", 0.2, -1, "tree"), Call("peer", 0.999, -1, "tree")]
    seen = [Seen(MANY, ("ok", "peer"), "", None)]
    report = report_of([score("plain", seen, groups)], 0, ("peer",))
    sure = row(report, "calibration", "probability", "0.99 to 0.999")
    assert (sure["n"], sure["mean"], sure["share"]) == (2, pytest.approx(0.994), 0.5)
    assert row(report, "calibration", "probability", "0.1 to 0.5")["share"] == 0.0


def test_found_and_false_ones_are_counted_by_returns():
    seen = [Seen(MANY, ("ok",), "", None, 60), Seen(FEW, (), "it is a pole", None, 12)]
    calls = [Call("ok", 0.99, 0, "", 58), Call("possible", 0.95, -1, "tree", 30)]
    report = report_of([score("plain", seen, calls)], 0, ())
    assert row(report, "returns", "returns", "50 to 199")["n_ok"] == 1
    assert row(report, "returns", "returns", "8 to 19")["n_ok"] == 0
    assert row(report, "returns", "returns", "20 to 49")["false_possible"] == 1


def test_errors_are_over_bound_and_covariance_by_family():
    rng = np.random.default_rng(1)
    squares = (rng.standard_normal((4000, 3)) ** 2).sum(axis=1)
    seen = [Seen(MANY, ("ok",), "", centre(np.sqrt(s), bound2=3.0 / 4.0)) for s in squares]
    seen.append(Seen(MANY, ("weak",), "", centre(1e3, status="weak")))
    (family,) = report_of([score("rig", seen, [])], 0, ())["families"]
    assert family["n_centres"] == 4000
    assert family["rms_over_bound"] == pytest.approx(2.0, rel=0.03)
    assert family["nees"] == pytest.approx(1.0, rel=0.05)
    for level in (50, 68, 95):
        assert family[f"within_{level}"] == pytest.approx(level / 100, abs=0.025)


def test_stations_that_are_ok_count_and_families_are_summed(report):
    plain, decoys, both = report["families"]
    assert (plain["n_stations"], plain["station_rms_m"], plain["station_nees"]) == (1, 2.0, 1.0)
    assert decoys["n_stations"] == 0
    assert decoys["station_nees"] is None
    assert both["family"] == "all"
    assert both["n_scans"] == 2


def test_data_sheets_stand_beside_the_defaults(report):
    low, high = (
        score(
            "optics",
            [Seen(MANY, ("ok",), "", centre(3.0))],
            [],
            station=Station("ok", 1.0, s, s / 4.0),
        )
        for s in (12.0, 24.0)
    )
    weak = centre(30.0, status="weak")
    known = [
        one._replace(sheet=Sheet((centre(square**0.5), weak), Station("ok", 1.0, 6.0, 6.0)))
        for one, square in ((low, 2.0), (high, 4.0))
    ]
    (family,) = report_of(known, 0, ())["families"]
    assert (family["nees"], family["nees_se"]) == (3.0, 0.0)
    assert (family["station_nees"], family["station_nees_se"]) == (3.0, pytest.approx(1.0))
    assert family["sheet_nees"] == pytest.approx(1.0)
    assert family["sheet_nees_se"] == pytest.approx(1.0 / 3.0)
    assert family["station_sheet_nees"] == 1.0
    assert (family["position_nees"], family["position_nees_se"]) == (1.5, pytest.approx(0.5))
    assert family["position_sheet_nees"] == 2.0
    (empty, *_) = report["families"]
    assert (empty["sheet_nees"], empty["nees_se"]) == (None, None)


def test_a_standard_error_is_that_of_worlds_not_of_their_results():
    rng = np.random.default_rng(3)
    of_worlds = rng.standard_normal(12)
    groups = [[one] * 5 for one in of_worlds]
    mean, error = _of_worlds(groups)
    assert mean == pytest.approx(of_worlds.mean())
    assert error == pytest.approx(of_worlds.std(ddof=1) / np.sqrt(12))
    assert _of_worlds([*groups, []]) == (mean, error)
    assert _of_worlds([[1.0, 2.0], []]) == (1.5, None)
    assert _of_worlds([[]]) == (None, None)


def test_standard_errors_hold_for_worlds_of_unlike_size():
    rng = np.random.default_rng(5)
    means, errors = [], []
    for _ in range(400):
        shared = rng.standard_normal(20)
        mean, error = _of_worlds([[one] * rng.integers(1, 9) for one in shared])
        means.append(mean)
        errors.append(error)
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(np.std(means), rel=0.12)


PLACES = np.array([[6.0, 0.0, 0.2], [0.0, 9.0, -0.4], [-3.0, -4.0, 0.1], [10.0, -8.0, 0.6]])
SIGMAS = np.array([2e-3, 1e-3, 3e-3])


def own_covariances():
    return np.tile(np.diag(SIGMAS**2), (len(PLACES), 1, 1))


def test_a_turn_of_the_whole_scan_is_no_error_of_centres():
    found, covs = PLACES @ rot_z(-0.05), own_covariances()  # 0.05 rad of it is 13 mm at 10 m
    turn = _turn(found, PLACES, covs)
    assert turn == pytest.approx(0.05, abs=1e-4)
    errors = found @ rot_z(turn) - PLACES
    left, _ = _without_heading(errors, turn, PLACES, (covs, 1.0))
    assert np.abs(left).max() < 2e-5


def test_a_heading_that_is_known_beforehand_counts_as_a_prior():
    covs, turn = own_covariances(), 0.01
    errors = PLACES @ rot_z(-turn) @ rot_z(turn) - PLACES
    left, _ = _without_heading(errors, turn, PLACES, (covs, 1e-6))
    sideways = np.column_stack([-PLACES[:, 1], PLACES[:, 0], np.zeros(len(PLACES))])
    np.testing.assert_allclose(left, turn * sideways, rtol=0.01, atol=1e-9)


def test_biases_drawn_anew_say_the_same_with_less_scatter():
    rng, n = np.random.default_rng(11), 4000
    distances = np.linalg.norm(PLACES, axis=1)
    sights = PLACES / distances[:, None]
    common = Common(0.0, 0.0, 4e-3, 3e-4)
    variances = common.sigma_bias**2 + (common.sigma_scale * distances) ** 2
    covs = own_covariances() + variances[:, None, None] * sights[:, :, None] * sights[:, None]
    drawn, anew = [], []
    for _ in range(n):
        bias, scale = rng.normal(0.0, common.sigma_bias), rng.normal(0.0, common.sigma_scale)
        errors = SIGMAS * rng.standard_normal((len(PLACES), 3))
        errors += (bias + scale * distances)[:, None] * sights
        drawn.append(_squares(errors, covs).mean())
        anew.append(_anew(errors, covs, PLACES, common._replace(bias=bias, scale=scale)).mean())
    assert np.mean(drawn) == pytest.approx(3.0, abs=4.0 * np.std(drawn) / np.sqrt(n))
    assert np.mean(anew) == pytest.approx(3.0, abs=4.0 * np.std(anew) / np.sqrt(n))
    assert np.std(anew) < 0.8 * np.std(drawn)


def test_every_table_shows_its_rows(report):
    shown = [table.to_texts() for table in tables(report)]
    assert [len(one["rows"]) for one in shown] == [6, 4, 2, 7, 7, 5, 3, 3]
    assert all(len(row) == len(one["headings"]) for one in shown for row in one["rows"])
    assert shown[0]["rows"][0][:3] == [MANY, "3", "1"]


def test_rows_of_a_log_are_told_apart_beyond_the_whole_numbers_of_single_precision():
    n = 2**24 + 5
    kept = np.array([0, 1, 2**24 - 1, 2**24 + 1, n - 1])
    tags = _tags(n)
    assert np.isfinite(tags[kept]).all()
    assert (_rows(tags[kept]) == kept).all()


def test_every_other_seed_is_a_world():
    experiment = worlds(3, 5)
    assert list(experiment.worlds) == [5, 7, 9]


def everything(p_base, _radius):
    return {"one": p_base[:1], "none": np.zeros((0, 3))}


def test_a_world_is_scanned_and_scored_with_its_peers():
    seed = 0
    assert family_of(seed) == "plain"
    experiment = worlds(1, seed, Peers(("one", "none"), everything))
    report = experiment.run(n_processes=1)
    many, wide = (row(report, "markers", "class", name) for name in (MANY, WIDE))
    assert many["n"] + wide["n"] >= 4
    assert many["n_ok"] == many["n"]
    assert wide["n_ok"] >= wide["n"] - 1
    field = draw_world(seed).field
    heights = field.marks.p_site[:, 2] - field.terrain.height_at(field.marks.p_site)
    assert (heights - field.marker_radius < 0.05).sum() == 1
    assert row(report, "markers", "class", LYING)["n"] == 1
    n_wide = sum(stand not in ("pole", "ground") for stand in field.stands)
    assert wide["n"] == n_wide > 0
    assert row(report, "methods", "method", "one")["n_false"] == 1
    (family,) = report["families"]
    # the bound knows a bias that LiDARs differ by; this one's is drawn once, and may be near zero
    assert 0.05 < family["rms_over_bound"] < 2.5
    assert family["nees"] < 3.0
    assert family["sheet_nees"] == pytest.approx(family["nees"], rel=0.3)
