"""A site over HTTP and on the command line: clouds, ground, and the page that shows them."""

import json

import laspy
import numpy as np
import pye57
import pytest
from typer.testing import CliRunner

from spheremark.pipelines.errors import SpheremarkError
from spheremark.pipelines.ground_model import StationPose
from spheremark.service.cli.main import app
from spheremark.service.jobs.site import SiteRequest, make_site
from spheremark.storage.exports.ground_model import read_geotiff
from spheremark.storage.recordings import read_log, write_log


@pytest.fixture(scope="module")
def too_early(site):
    """Return the job that was requested before any log of the survey was processed."""
    site.survey("quarry")
    recording = site.upload().json()["recording_id"]
    wanted = {"kind": "site", "survey": "quarry", "recordings": [recording]}
    answer = site.client.post("/api/v1/jobs", json=wanted)
    return site.ended(answer.json()["job_id"])


@pytest.fixture(scope="module")
def made(site, too_early):
    """Return the products of a survey whose one log was processed."""
    assert too_early["status"] == "failed"
    job = site.upload(survey="quarry", process="true").json()["job"]["job_id"]
    assert site.ended(job)["status"] == "successful"
    wanted = {"kind": "site", "survey": "quarry", "options": {"cell_m": 1.0, "voxel_m": 0.02}}
    answer = site.client.post("/api/v1/jobs", json=wanted)
    done = site.ended(answer.json()["job_id"])
    assert done["status"] == "successful", done
    listed = site.client.get("/api/v1/surveys/quarry/products").json()["items"]
    return {one["kind"]: one for one in listed}


@pytest.fixture(scope="module")
def files(site, made, tmp_path_factory):
    """Return the products as local files."""
    folder = tmp_path_factory.mktemp("products")
    for kind, one in made.items():
        answer = site.client.get(one["file"])
        assert answer.status_code == 200
        assert len(answer.content) == one["size_bytes"]
        (folder / kind).write_bytes(answer.content)
    return folder


def pose(site):
    """Return position and rotation of the station, from its own row."""
    (fix,) = site.client.get("/api/v1/station-fixes?survey=quarry&fit_method=along_beam").json()[
        "items"
    ]
    return np.array([fix[f"{a}_m"] for a in "xyz"]), np.reshape(fix["rotation"], (3, 3))


def test_a_job_makes_clouds_and_ground_of_a_survey(made, files, site):
    assert set(made) == {"laz", "e57", "geotiff"}
    assert {one["poses"] for one in made.values()} == {"fixes"}
    cloud = laspy.read(files / "laz")
    assert cloud.header.point_count == made["laz"]["n_points"] == made["e57"]["n_points"]
    assert cloud.x.min() == pytest.approx(made["laz"]["min_x_m"], abs=0.001)
    position, rotation = pose(site)
    with pye57.E57(str(files / "e57")) as scans:
        header = scans.get_header(0)
        np.testing.assert_allclose(header.translation, position, atol=1e-12)
        np.testing.assert_allclose(header.rotation_matrix, rotation, atol=1e-9)
        moved = scans.read_scan(0, ignore_missing_fields=True)
    np.testing.assert_allclose(moved["cartesianZ"], cloud.z, atol=0.002)
    ground = read_geotiff(files / "geotiff")
    assert ground.cell == 1.0
    under = ground.heights[
        int((position[1] - ground.corner[1]) // 1.0), int((position[0] - ground.corner[0]) // 1.0)
    ]
    assert 0.8 < position[2] - under < 1.3  # the LiDAR stands a metre and a little above ground


def test_rows_of_products_are_in_the_database(made, site):
    sql = "SELECT kind, sha256, min_z_m < max_z_m FROM site_products ORDER BY kind"
    rows = site.client.post("/api/v1/sql", json={"sql": sql}).json()["rows"]
    assert rows == [[kind, made[kind]["sha256"], True] for kind in ("e57", "geotiff", "laz")]


def test_the_page_of_a_site_draws_the_ground_and_offers_the_files(made, site):
    page = site.client.get("/surveys/quarry/site").text
    assert 'id="figure-ground"' in page
    assert 'id="figure-sigma"' in page
    assert all(f'href="{one["file"]}"' in page for one in made.values())
    assert "/surveys/quarry/site" in site.client.get("/surveys/quarry").text


def test_a_log_without_a_pose_is_named_as_missing(made, site, tmp_path):
    write_log(read_log(site.stop.log), tmp_path / "again.mcap", compression="zstd")
    again = site.upload((tmp_path / "again.mcap").read_bytes(), name="again").json()
    posed = site.upload().json()
    wanted = {
        "kind": "site",
        "survey": "quarry",
        "recordings": [posed["recording_id"], again["recording_id"]],
        "options": {"cell_m": 2.0, "clouds": False},
    }
    job = site.client.post("/api/v1/jobs", json=wanted).json()["job_id"]
    message = site.ended(job)["message"]
    assert message.startswith(f"{made['laz']['n_stations']} station")
    assert "Without again, of which there is no pose." in message


def test_the_form_of_a_site_starts_a_job(made, site):
    assert made
    form = {"Content-Type": "application/x-www-form-urlencoded"}
    answer = site.client.post(
        "/surveys/quarry/site",
        content="cell_m=2.0&gap_m=0.5",
        headers=form,
        follow_redirects=False,
    )
    assert answer.status_code == 303
    job = answer.headers["location"].rpartition("/")[2]
    assert site.ended(job)["status"] == "successful"


def test_a_survey_without_poses_is_refused_with_what_to_do(too_early):
    assert too_early["error_code"] == "not_found"
    assert "adjust" in too_early["error_reason"]


def test_what_is_no_product_is_not_found(made, site):
    assert site.client.get("/api/v1/products/none/laz").status_code == 404
    assert site.client.get(made["laz"]["file"].replace("laz", "png")).status_code == 422


def test_the_command_wants_to_know_what_to_write(stop):
    done = CliRunner().invoke(app, ["site", str(stop.log)])
    assert done.exit_code == 2


@pytest.mark.parametrize("ending", ["laz", "e57", "geotiff"])
def test_a_folder_that_is_not_there_is_said_before_anything_is_done(ending, stop, tmp_path):
    target = tmp_path / "none" / "site.x"
    done = CliRunner().invoke(app, ["site", str(stop.log), f"--{ending}", str(target)])
    assert isinstance(done.exception, SpheremarkError)
    assert str(tmp_path / "none") in str(done.exception)


def test_a_site_that_fails_leaves_no_files_and_spoils_none(tmp_path):
    targets = {"e57": tmp_path / "site.e57", "geotiff": tmp_path / "site.tif"}
    targets["e57"].write_text("of yesterday")
    pose = StationPose(name="S1", T_site_station=np.eye(4), cov_T_site_station=1e-6 * np.eye(6))
    with pytest.raises(SpheremarkError):
        make_site((), (pose,), SiteRequest(targets=targets))  # no stop, so that there is no return
    assert [path.name for path in tmp_path.iterdir()] == ["site.e57"]
    assert targets["e57"].read_text() == "of yesterday"


@pytest.mark.parametrize(
    "options", [{"range_m": "inf"}, {"voxel_m": "inf"}, {"voxel_m": 1e300}, {"range_m": "nan"}]
)
def test_lengths_that_nobody_can_mean_are_refused_by_name(site, options):
    wanted = {"kind": "site", "survey": "quarry", "options": options}
    answer = site.client.post("/api/v1/jobs", json=wanted)
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["field"] == f"options.{next(iter(options))}"


@pytest.mark.slow
def test_the_command_puts_two_stops_into_one_frame(tmp_path):
    from spheremark.pipelines.simulation import SimulationConfig
    from spheremark.service.cli.fieldwork import Assignment, survey

    wanted = Assignment(
        scenario="paper-field",
        stops="lane2-stop3,lane3-stop4",
        seed=5,
        config=SimulationConfig(only_near_spheres=True),
        compression="none",
    )
    (tmp_path / "broken.mcap").write_bytes(b"no log")
    logs = [str(tmp_path / "broken.mcap")]  # which costs the others nothing
    logs += [str(made.log) for made in survey(tmp_path, wanted)]
    outputs = [f"--{kind}={tmp_path / kind}" for kind in ("laz", "e57", "geotiff")]
    control = ["--control", str(tmp_path / "control.csv"), "--cell-m", "1", "--json"]
    done = CliRunner().invoke(app, ["site", *logs, *outputs, *control])
    assert done.exit_code == 0, done.output
    answer = json.loads(done.stdout)
    assert (answer["poses"], answer["n_stations"]) == ("control", 2)
    assert [one["station"] for one in answer["refused"]] == ["broken"]
    cloud = laspy.read(tmp_path / "laz")
    assert set(np.unique(cloud.point_source_id)) == {1, 2}
    assert answer["files"][0]["n_points"] == cloud.header.point_count
