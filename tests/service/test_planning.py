"""``spheremark plan`` from the outside, and the files that go into it."""

import json
from datetime import UTC, datetime

import numpy as np
import pyarrow as pa
import pytest
import rasterio
from rasterio.transform import Affine
from typer.testing import CliRunner

from spheremark.pipelines.errors import (
    ConfigError,
    DegenerateGeometryError,
    InputError,
    NotFoundError,
)
from spheremark.pipelines.placement import (
    RandomPlanSpec,
    errors_by_angle,
    sensor_model,
    simulate_random_plans,
)
from spheremark.pipelines.placement.sensor import Sensor
from spheremark.pipelines.published import TABLE_3
from spheremark.service.cli.main import app
from spheremark.service.planning.random_plans import limits_of_results
from spheremark.service.serialise.plans import to_csv
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.imports.plan_files import read_keep_out, read_marks, read_stops
from spheremark.storage.imports.terrain import read_terrain
from tests.storage.made_up import made_tables


def plan(*words):
    result = CliRunner().invoke(app, ["plan", *map(str, words)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def write_plain(path, slope=0.0, n=300):
    """Write an elevation model of 0.2 m cells about the origin."""
    x = (np.arange(n) - n / 2 + 0.5) * 0.2
    heights = np.tile(slope * x, (n, 1)).astype(np.float32)
    with rasterio.open(
        path, "w", driver="GTiff", width=n, height=n, count=1, dtype="float32",
        transform=Affine(0.2, 0, -n * 0.1, 0, -0.2, n * 0.1), nodata=-9999.0,
    ) as file:  # fmt: skip
        file.write(heights, 1)
    return path


@pytest.fixture
def small(tmp_path):
    terrain = write_plain(tmp_path / "plain.tif")
    stops = tmp_path / "stops.csv"
    stops.write_text("name,x_m,y_m\nA,0,0\nB,3,1\n")
    return ("--terrain", terrain, "--stops", stops)


def test_what_optimise_answers_evaluate_answers_again(small, tmp_path):
    csv, geojson = tmp_path / "plan.csv", tmp_path / "plan.geojson"
    options = (*small, "--spacing-m", 2.0, "--json")
    best = plan("optimise", "--marks", 4, "--csv", csv, "--geojson", geojson,
                "--origin", "16.37,48.21", *options)  # fmt: skip
    assert [stop["name"] for stop in best["stops"]] == ["A", "B"]
    assert len(best["marks"]) == 4
    file = tmp_path / "best.json"
    file.write_text(json.dumps(best))
    for marks in (file, csv):
        again = plan("evaluate", "--marks", marks, *small, "--json")
        assert again["stops"] == best["stops"]
    drawn = json.loads(geojson.read_text())
    assert len(drawn["features"]) == 6
    assert best["stops"][0]["probability_within_tolerance"] > 0.999


def test_the_least_number_of_marks_is_found_and_one_more_is_named(small, tmp_path):
    best = plan("optimise", *small, "--spacing-m", 2.0, "--tolerance-m", 0.005, "--json")
    assert 3 < len(best["marks"]) <= 5  # with two of three left, no stop keeps 5 mm
    assert best["optimum"]["keeps_tolerance"]
    file = tmp_path / "best.json"
    file.write_text(json.dumps(best))
    more = plan("evaluate", "--marks", file, *small, "--suggest", "--json")["one_more"]
    assert more["worst_sigma_3d_m"] < more["worst_sigma_3d_before_m"]


def test_numbers_of_marks_are_compared_beside_those_that_stand(small, tmp_path):
    standing = tmp_path / "standing.csv"
    standing.write_text("mark,x_m,y_m,z_m\nOLD,4,0,1\n")
    options = (*small, "--spacing-m", 2.5, "--standing", standing, "--placement-m", 0.1)
    found = plan("trade-off", *options, "--numbers", "3-4", "--cost-mark", 5, "--json")
    three, four = found["by_number"]
    assert four["worst_sigma_3d_m"] < three["worst_sigma_3d_m"]
    for one in (three, four):
        assert one["marks"][0]["name"] == "OLD"
        assert one["marks"][0]["position_m"][:2] == [4.0, 0.0]
        assert one["optimum"]["worst_sigma_3d_as_placed_m"] > 0
    assert (three["optimum"]["cost"], four["optimum"]["cost"]) == (15, 20)
    words = ["plan", "trade-off", *map(str, options), "--numbers"]
    for numbers in ("four", "8-4", "4-6-8", "4,-5"):
        with pytest.raises(InputError, match="must be a list as 4-8"):
            CliRunner().invoke(app, [*words, numbers], catch_exceptions=False)
    for numbers in ("1", "4,100"):
        with pytest.raises(ConfigError, match="from 2 to 40 can be placed"):
            CliRunner().invoke(app, [*words, numbers], catch_exceptions=False)


def test_a_plan_refuses_what_cannot_be(small, tmp_path):
    marks = tmp_path / "marks.csv"
    marks.write_text("mark,x_m,y_m,z_m\nM1,4,0,-0.5\nM2,0,4,1\nM3,-4,0,1\n")
    with pytest.raises(InputError, match="M1 is under the ground"):
        plan("evaluate", "--marks", marks, *small)
    with pytest.raises(DegenerateGeometryError, match="Ask for a larger tolerance"):
        plan("optimise", *small, "--spacing-m", 3.0, "--tolerance-m", 0.00002)
    marks.write_text("mark,x_m,y_m,z_m\n" + "".join(f"M{i},{i},0,1\n" for i in range(10_000)))
    with pytest.raises(InputError, match="10,000 marks"):
        plan("evaluate", "--marks", marks, *small)
    stops = tmp_path / "off.csv"
    stops.write_text("name,x_m,y_m\nfar,400,0\n")
    with pytest.raises(InputError, match=r"far at 400\.00, 0\.00 m is off the terrain"):
        plan("optimise", "--marks", 3, small[0], small[1], "--stops", stops)


def test_tables_for_people_say_their_units(small, tmp_path):
    marks = tmp_path / "marks.csv"
    marks.write_text("mark,x_m,y_m,z_m\nM1,4,0,1\nM2,0,4,1\nM3,-4,0,1\n")
    said = CliRunner().invoke(app, ["plan", "evaluate", "--marks", str(marks), *map(str, small)])
    for heading in ("pole", "sigma 3-D", "angles", "[m]", "[mm]", "[deg]"):
        assert heading in said.output


def test_a_survey_whose_fits_are_wanted_must_be_there(small, tmp_path):
    marks = tmp_path / "marks.csv"
    marks.write_text("mark,x_m,y_m,z_m\nM1,4,0,1\nM2,0,4,1\nM3,-4,0,1\n")
    wanted = ("evaluate", "--marks", marks, *small, "--survey", "quarry")
    with pytest.raises(ConfigError, match="--data or --url"):
        plan(*wanted)
    with Catalogue(tmp_path / "spheremark.duckdb", snapshots=tmp_path / "snapshots") as catalogue:
        catalogue.create_survey("pit")
    with pytest.raises(NotFoundError, match="no survey 'quarry'"):
        plan(*wanted, "--data", tmp_path)
    assert plan(*wanted[:-1], "pit", "--data", tmp_path, "--json")["model"]["source"] == "sensor"


def test_terrains_are_read_with_the_right_way_up(tmp_path):
    site = read_terrain(write_plain(tmp_path / "slope.tif", slope=0.1))
    assert float(site.ground_at(np.array([10.0, -5.0]))) == pytest.approx(1.0, abs=1e-3)
    grid = tmp_path / "grid.asc"
    rows = "\n".join(" ".join(str(10 * j + i) for i in range(4)) for j in range(3, -1, -1))
    grid.write_text(f"ncols 4\nnrows 4\nxllcorner 100\nyllcorner 200\ncellsize 1\n{rows}\n")
    site = read_terrain(grid)
    assert float(site.ground_at(np.array([102.5, 201.5]))) == pytest.approx(12.0)


def test_a_cloud_becomes_ground_and_what_hides(tmp_path):
    import laspy

    rng = np.random.default_rng(1)
    p = np.column_stack([rng.uniform(-4, 4, (60_000, 2)), rng.normal(0.0, 0.005, 60_000)])
    wall = (np.abs(p[:, 0] - 1.0) < 0.1) & (np.abs(p[:, 1]) < 1.0)
    p[wall, 2] = rng.uniform(0.0, 2.0, wall.sum())
    cloud = laspy.LasData(laspy.LasHeader(point_format=3, version="1.4"))
    cloud.header.scales, cloud.header.offsets = [0.001] * 3, [0.0] * 3
    cloud.x, cloud.y, cloud.z = p.T
    cloud.write(tmp_path / "scan.laz")
    site = read_terrain(tmp_path / "scan.laz")
    assert abs(float(site.ground_at(np.array([-2.0, 0.5])))) < 0.03
    middle = np.argmin(np.abs(site.ys)), np.argmin(np.abs(site.xs - 1.0))
    assert site.surface[middle] > 1.5
    assert site.ground[middle] < 0.3


def test_what_is_no_terrain_is_refused(tmp_path):
    wrong = tmp_path / "wrong.tif"
    wrong.write_text("no raster")
    with pytest.raises(InputError, match="no elevation model"):
        read_terrain(wrong)
    with pytest.raises(InputError, match="is expected"):
        read_terrain(write_plain(tmp_path / "plain.tif").rename(tmp_path / "plain.txt"))
    with pytest.raises(InputError, match="are the most"):
        read_terrain(huge_raster(tmp_path / "huge.tif"))


def huge_raster(path):
    """Write a raster of 10^9 cells that holds nothing."""
    with rasterio.open(
        path, "w", driver="GTiff", width=50_000, height=20_000, count=1, dtype="uint8",
        transform=Affine(0.1, 0, 0, 0, -0.1, 0), tiled=True, sparse_ok=True,
    ):  # fmt: skip
        return path


def test_files_of_a_plan_say_what_is_wrong(tmp_path):
    file = tmp_path / "file"
    file.write_text("name,x_m\nA,1\n")
    with pytest.raises(InputError, match="name,x_m,y_m"):
        read_stops(file)
    for reader, kind in ((read_stops, "stop"), (read_marks, "mark")):
        for head in ("", f"kind,name,x_m,y_m,z_m\n{kind},"):
            file.write_text(head + "A" * 140_000 + ",1,2,3\n")
            with pytest.raises(InputError, match=r"Line . of file has a cell of more than 131,072"):
                reader(file)
    file.write_text('{"marks": [{"name": "A"}]}')
    with pytest.raises(InputError, match="position_m"):
        read_marks(file)
    file.write_text('{"type": "Point", "coordinates": [0, 0]}')
    with pytest.raises(InputError, match="no polygon"):
        read_keep_out(file)
    file.write_text('{"type": "Polygon", "coordinates": []}')
    with pytest.raises(InputError, match="Polygon or MultiPolygon in metres"):
        read_keep_out(file)
    for reader in (read_stops, read_marks, read_keep_out):
        for deep in ("[" * 100_000 + "]" * 100_000, '{"stops": ' * 9_000 + "1" + "}" * 9_000):
            file.write_text(deep)
            with pytest.raises(InputError, match="more than 32 levels"):
                reader(file)
    square = {"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]]]}
    file.write_text(json.dumps(square))
    assert len(read_keep_out(file)[0]) == 5


def test_marks_of_a_plan_may_have_commas_in_their_names(tmp_path):
    file = tmp_path / "plan.csv"
    place = {"position_m": [1.0, 2.0, 3.0]}
    answer = {"marks": [{"name": "north, low", **place}], "stops": [{"name": "S", **place}]}
    file.write_text(to_csv(answer))
    assert read_marks(file).names == ("north, low",)


def test_three_circles_give_the_study_s_table():
    errors = errors_by_angle(TABLE_3.included_angles, 0.017, 7.5)
    assert np.sqrt(np.mean((errors - TABLE_3.errors) ** 2)) < 0.002


def test_the_study_s_window_parts_what_passes_from_what_does_not():
    window = (np.radians(30.0), np.radians(150.0))
    result = simulate_random_plans(
        RandomPlanSpec(n_arrangements=30_000, n_marks=(3, 3), angles=window)
    )
    inside = result.passes[result.is_in_window].mean()
    outside = result.passes[~result.is_in_window].mean()
    assert inside > 0.83 > 0.75 > outside
    again = simulate_random_plans(
        RandomPlanSpec(n_arrangements=30_000, n_marks=(3, 3), angles=window)
    )
    np.testing.assert_array_equal(result.errors_3d, again.errors_3d)


def test_centres_as_good_as_ours_pass_whatever_the_angles():
    result = simulate_random_plans(
        RandomPlanSpec(n_arrangements=5_000, error=None), sensor_model(Sensor())
    )
    assert result.passes.mean() > 0.999


def with_column(table, name, value):
    """Return a table with one value in a column."""
    return table.set_column(table.column_names.index(name), name, pa.array([value] * len(table)))


def test_limits_of_results_are_those_of_the_newest_run_and_of_the_survey(tmp_path):
    with Catalogue(tmp_path / "x.duckdb", snapshots=tmp_path / "snapshots") as catalogue:
        digest, ids = 64 * "a", [catalogue.create_survey(name).survey_id for name in "AB"]
        catalogue.add_recording(
            digest, name="L1", size_bytes=7, url="x", preflight={"verdict": "ok"}
        )
        config = {"survey": ids[0], "recording_id": digest, "config": {}}
        for day in (1, 2):
            job = catalogue.create_job("process", **config).job_id
            names = {"job_id": job, "survey_id": ids[0], "recording_id": digest}
            when = datetime(2026, 1, day, tzinfo=UTC)
            rows = made_tables(run_id=f"run{day}", finished_at=when, **names)
            fits, pairs = rows["marker_fits"], rows["resections"]
            both = pa.concat_tables([pairs, with_column(pairs, "resection_method", "paper")])
            for name, table in (("marker_fits", fits), ("resections", both)):
                rows[name] = pa.concat_tables(
                    [with_column(table, "stop", f"S{i}") for i in range(8)]
                )
            catalogue.start_job(job)
            catalogue.finish_job(job, rows)

        def ask(sql):
            table = catalogue.table(sql)
            rows = [list(row.values()) for row in table.to_pylist()]
            return {"columns": [{"name": name} for name in table.column_names], "rows": rows}

        n_fits = 8 * sum(
            row["fit_method"] == "along_beam" and row["mark"] is not None
            for row in fits.to_pylist()
        )
        n_pairs = 8 * sum(row["n_marks"] == 2 for row in pairs.to_pylist())
        for survey in ("", "A"):
            limits = limits_of_results(ask, "along_beam", 0.03, survey)
            assert limits["distance_source"] == f"{n_fits:,} fits by along_beam"
            assert limits["angle_source"] == f"{n_pairs:,} pairs of marks by along_beam"
        assert limits_of_results(ask, "along_beam", 0.03, "B")["distance_source"] == "study"


def test_trials_come_as_tables_and_figures(tmp_path):
    answer = plan("random", "--arrangements", 3000, "--out", tmp_path, "--json")
    assert {row["n_marks"] for row in answer["by_number_of_marks"]} == set(range(3, 15))
    assert answer["window_that_keeps_tolerance_deg"] == pytest.approx([47.5, 142.5], abs=15)
    names = {path.name for path in tmp_path.iterdir()}
    assert {"index.html", "table3.csv", "by_worst_angle.csv"} <= names
