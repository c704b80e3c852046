"""Scores of random worlds pooled into tables; the worlds themselves are simulated elsewhere."""

import numpy as np
import pytest

from spheremark.pipelines.evaluation.worlds import (
    CLASSES,
    Call,
    Centre,
    Peers,
    Score,
    Seen,
    Station,
    _rows,
    _tags,
    report_of,
    tables,
    worlds,
)
from spheremark.pipelines.simulation.worlds import family_of

MANY, FEW, ONE_LINE, _ = CLASSES


def centre(error, sigma=1.0):
    return Centre("ok", error**2, 1.0, error**2 / sigma**2)


def score(family, seen, calls, **more):
    return Score(2, family, seen, calls, more.get("decoys", []), more.get("station"), "", 0.1)


@pytest.fixture
def report():
    """Two scans: three of four markers found, a false one that is ok and a possible one."""
    first = score(
        "plain",
        [Seen(MANY, ("ok", "peer"), "", centre(1.0)), Seen(MANY, ("weak",), "", None)],
        [Call("ok", 0.99, 0, ""), Call("weak", 0.8, 1, ""), Call("peer", 1.0, 0, "")],
        station=Station("ok", 4.0, 6.0),
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
    seen = [Seen(MANY, ("ok",), "", Centre("ok", s, 3.0 / 4.0, s)) for s in squares]
    seen.append(Seen(MANY, ("weak",), "", Centre("weak", 1e6, 1.0, 1e6)))
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


def test_every_table_shows_its_rows(report):
    shown = [table.to_texts() for table in tables(report)]
    assert [len(one["rows"]) for one in shown] == [4, 4, 2, 7, 7, 5, 3]
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
    many = row(report, "markers", "class", MANY)
    assert many["n"] >= 4
    assert many["n_ok"] >= many["n"] - 1
    assert row(report, "methods", "method", "one")["n_false"] == 1
    (family,) = report["families"]
    # the bound knows a bias that LiDARs differ by; this one's is drawn once, and may be near zero
    assert 0.05 < family["rms_over_bound"] < 2.5
    assert family["nees"] < 3.0
