"""The benchmark of speed on a short scan: the parts of its report are consistent."""

import json
import os

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from spheremark.pipelines.errors import RecordingError
from spheremark.pipelines.simulation import SimulationConfig, scenario, simulate_stop
from spheremark.service.bench import chain, growth, peers, speed, yardstick
from spheremark.service.bench.yardstick import Cost
from spheremark.service.cli.main import app
from spheremark.service.cli.render import print_tables
from spheremark.storage.recordings import read_log, write_log

TURN = 4.0  # [s]: half a million returns


@pytest.fixture(scope="module")
def report():
    shares = []
    options = speed.SpeedOptions(repeats=1, turn=TURN)
    found = speed.speed(None, options, lambda share, _what: shares.append(share))
    assert all(0.0 <= share <= 1.0 for share in shares)
    return found


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """One stop as points, in zstd and as packets."""
    stop = simulate_stop(scenario("paper-field", 1), "lane3-stop4", SimulationConfig(turn=TURN))
    folder = tmp_path_factory.mktemp("bench")
    paths = {name: folder / f"{name}.mcap" for name in ("points", "zstd", "packets")}
    write_log(stop.log, paths["points"])
    write_log(stop.log, paths["zstd"], compression="zstd")
    write_log(stop.log, paths["packets"], firings=stop.firings)
    return paths


def test_one_scan_is_measured_in_three_formats_against_one_yardstick(report):
    variants = {one["name"]: one for one in report["variants"]}
    assert list(variants) == ["points", "packets", "points in zstd"]
    assert variants["points in zstd"]["bar_ratio"] > variants["points"]["bar_ratio"] > 0.0
    sizes = [variants[name]["size_bytes"] for name in ("packets", "points in zstd", "points")]
    assert sizes == sorted(sizes)
    assert report["log"]["size_bytes"] == variants["points"]["size_bytes"]
    for one in variants.values():
        assert 0.0 < one["read_log_seconds"] < one["chain_seconds"]


def test_the_steps_are_those_of_the_chain(report):
    seconds = {one["step"]: one["seconds"] for one in report["steps"]}
    assert list(seconds) == [
        "preflight", "read log", "stitching", "extraction", "fitting.along_beam", "resection",
        "subsets", "quality_control", "rows", "commit", "log to rows committed",
    ]  # fmt: skip
    parts = list(seconds.values())[1:-1]
    assert min(parts) > 0.0
    assert sum(parts) <= seconds["log to rows committed"]  # they lie within it, one after the other
    theirs = {one["step"]: one["peer_seconds"] for one in report["peers"]}
    assert list(theirs) == [
        "read log", "stitching", "extraction", "fitting", "rows and commit",
        "log to rows committed",
    ]  # fmt: skip
    total = theirs.pop("log to rows committed")
    assert total == pytest.approx(sum(theirs.values()))
    points = report["variants"][0]
    assert points["peer_seconds"] == total
    assert points["factor"] == report["peers"][-1]["factor"]


def test_ratios_are_the_cost_over_that_of_a_read_and_factors_the_cost_of_the_peer_over_ours(
    tmp_path,
):
    log = tmp_path / "log.mcap"
    log.write_bytes(b"12345")
    costs = {"read log": Cost(2.0, 3.0), "log to rows committed": Cost(12.0, 20.0)}
    measured = chain.Measured(costs=costs, result=None, n_returns=1)
    one = speed._variant("points", log, measured, Cost(4.0, 5.0))
    assert (one["ratio"], one["cpu_ratio"]) == (3.0, 4.0)
    assert (one["read_log_ratio"], one["read_log_cpu_ratio"]) == (0.5, 0.6)
    assert one["size_bytes"] == 5
    seconds = {"rows": 1.0, "commit": 3.0, "fitting.along_beam": 5.0, "log to rows committed": 12.0}
    steps = [{"step": name, "seconds": cost} for name, cost in seconds.items()]
    beside = speed._steps_of_peers(steps, {"fitting": 10.0, "rows and commit": 2.0})
    assert [row["factor"] for row in beside] == [2.0, 0.5, 1.0]


def test_memory_is_that_of_a_fresh_process(report):
    memory = report["memory"]
    assert 50e6 < memory["before_bytes"] < memory["peak_bytes"] < 1e9
    assert memory["scan_bytes"] == memory["peak_bytes"] - memory["before_bytes"]


def test_the_centres_of_all_are_held_against_the_truth(report):
    by_method = {one["method"]: one for one in report["accuracy"]}
    assert {"spheremark, along_beam", "Open3D: plane, DBSCAN, ICP"} <= set(by_method)
    for one in by_method.values():
        assert one["n_markers"] == 14
        assert (one["error_rms_m"] is None) == (one["n_found"] == 0)


def test_the_report_is_a_table_and_json(report):
    out = Console(record=True, width=160)
    print_tables(out, speed.speed_tables(report))
    text = out.export_text()
    for word in ("read log", "packets", "points in zstd", "usual libraries", "Memory"):
        assert word in text
    assert json.loads(json.dumps(report)) == report


@pytest.mark.parametrize("form", ["points", "zstd", "packets"])
def test_the_usual_libraries_read_the_same_returns(written, form):
    log = read_log(written[form])
    points, instants, joints = peers._decode(written[form])
    assert np.abs(points - log.p_lidar).max() < 1e-4
    ours = (log.stamps_lidar_ns - log.stamps_gimbal_ns[0]) * 1e-9
    assert np.abs(instants - ours).max() < 3e-6  # the decoder counts whole microseconds
    assert np.abs(np.unwrap(joints[:, 1]) - log.gimbal_angles).max() < 1e-12


def test_a_log_of_ones_own_is_measured_without_truth(written):
    command = ["bench", str(written["packets"]), "--repeats", "1", "--quick", "--json"]
    found = json.loads(CliRunner().invoke(app, command).stdout)
    assert found["log"]["n_returns"] == len(read_log(written["points"]).p_lidar)
    assert [one["bar_ratio"] for one in found["variants"]] == [None]
    assert "peers" not in found


def test_a_log_that_is_no_file_is_refused(tmp_path):
    os.mkfifo(tmp_path / "log.mcap")
    with pytest.raises(RecordingError, match="no regular file"):
        speed.speed(
            tmp_path / "log.mcap", speed.SpeedOptions(is_quick=True), lambda _share, _what: None
        )


def test_the_yardstick_is_measured_in_a_process_of_its_own(tmp_path):
    (tmp_path / "a").write_bytes(bytes(50_000_000))
    (tmp_path / "b").write_bytes(bytes(50))
    long, short = (yardstick.read_cost(tmp_path / name) for name in "ab")
    # CPU time, which a busy machine hardly changes; a million times the bytes
    assert long.cpu_seconds > 10 * short.cpu_seconds > 0.0
    assert long.seconds > 0.9 * long.cpu_seconds  # one thread: the clock runs no more slowly


def test_a_stretched_log_turns_on_evenly(written):
    log = read_log(written["points"])
    n = 2 * len(log.p_lidar) + 100
    longer = growth._stretched(log, n)
    assert len(longer.p_lidar) == n
    assert (np.diff(longer.stamps_lidar_ns) >= 0).all()
    assert (np.diff(longer.stamps_gimbal_ns) > 0).all()
    same = longer.p_lidar[len(log.p_lidar) : 2 * len(log.p_lidar)]
    assert (same == log.p_lidar).all()
    turned = longer.gimbal_angles[len(log.gimbal_angles)] - log.gimbal_angles[0]
    assert abs(turned) == pytest.approx(2.0 * np.pi)


def test_a_straight_line_tells_what_is_fixed_and_what_each_return_costs():
    n = np.array([1e6, 3e6, 1e7])
    sizes = [{"n_returns": int(k), "seconds": 0.02 + 3e-8 * k} for k in n]
    found = growth.line(sizes, "n_returns", "seconds")
    assert found["fixed_seconds"] == pytest.approx(0.02)
    assert found["line_seconds_each"] == pytest.approx(3e-8)
    assert found["worst_share_off_line"] < 1e-9
    sizes[2]["seconds"] *= 1.5
    assert growth.line(sizes, "n_returns", "seconds")["worst_share_off_line"] > 0.05


def test_a_network_is_assembled_and_adjusted_as_it_is_timed():
    found = growth.adjust(12, 20)
    assert (found["n_stations"], found["n_marks"], found["n_sightings"]) == (12, 20, 168)
    assert 0.8 < found["sigma0"] < 1.2


def test_growth_is_printed_with_its_lines():
    costs = {"fixed_seconds": 0.2, "line_seconds_each": 5e-3, "worst_share_off_line": 0.07}
    sizes = {"n_returns": 2, "seconds": 1.0, "ns_per_return": 1, "cpu_ns_per_return": 1, "ratio": 2}
    report = {
        "linearity": {"sizes": [sizes], **costs, "cpu": costs},
        "network": [growth.adjust(n, 20) for n in (12, 24)],
        "network_linearity": {"n_marks": 20, "assembly": costs, "adjustment": costs},
    }
    out = Console(record=True, width=160)
    print_tables(out, growth.growth_tables(report))
    text = out.export_text()
    assert "24 x 20" in text
    assert "CPU of adjustment with 20 marks in a straight line: 200.0 ms and 5.00 ms" in text


def test_peers_find_a_sphere_in_the_open_and_say_where():
    rng = np.random.default_rng(4)
    centre, radius = np.array([5.0, 1.0, 0.2]), 0.1
    away = rng.standard_normal((600, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    ball = centre + radius * away[away @ centre < 0.0]
    ground = np.column_stack([rng.uniform(2.0, 9.0, (20_000, 2)), np.full(20_000, -1.0)])
    cloud = np.concatenate([ground, ball]) + rng.normal(0.0, 0.003, (20_000 + len(ball), 3))
    found = peers.spheres_of_peers(cloud, radius)
    assert set(found) == set(peers.PEERS)
    for centres in found.values():
        assert centres.shape == (1, 3)
        assert np.linalg.norm(centres[0] - centre) < 0.03


def test_random_worlds_are_measured_and_kept_with_their_tables(tmp_path, monkeypatch):
    monkeypatch.setenv("SPHEREMARK_DATA", str(tmp_path))
    command = ["bench", "--worlds", "1", "--first-seed", "22", "--quick", "--json"]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.stderr
    found = json.loads(done.stdout)
    assert [one["family"] for one in found["families"]] == ["radius"]
    kept = json.loads((tmp_path / "worlds.json").read_text())
    assert kept["markers"] == found["markers"]
    assert len(kept["tables"]) == 8
    assert (tmp_path / "worlds-families.csv").read_text().startswith("family,")
