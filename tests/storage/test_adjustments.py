import json
from dataclasses import replace

import numpy as np
import pytest

from spheremark.pipelines.errors import NotFoundError
from spheremark.pipelines.geometry import (
    exp_motion,
    inverse,
    rigid,
    rot_z,
    transform,
    yaw_pitch_roll,
)
from spheremark.pipelines.model import ControlMarks, Rejection, StopTruth, Truth
from spheremark.pipelines.scan.rigs import rig_digest, rig_to_mapping, tilted_vlp16
from spheremark.storage.catalogue.adjustments import TABLES, with_errors
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.catalogue.centres import CENTRES, read_centres
from spheremark.storage.catalogue.products import documents
from spheremark.storage.catalogue.results import tables
from spheremark.storage.catalogue.schema import table_of, tables_of
from tests.storage.made_up import MARKS, made_tables, run, stop

AWAY = rigid(rot_z(1.1), [40.0, -3.0, 2.0])  # where the free network lies


def true_field(n_stops=3):
    rng = np.random.default_rng(8)
    marks = ControlMarks(
        names=tuple(f"P{i}" for i in range(6)),
        p_site=rng.uniform(-9, 9, (6, 3)) + np.arange(6)[:, None],
        cov_p_site=np.zeros((6, 3, 3)),
    )
    stops = tuple(
        StopTruth(name=f"S{i}", T_site_base=exp_motion(rng.uniform(-0.05, 0.05, 6)) @
                  rigid(rot_z(rng.uniform(-3, 3)), rng.uniform(-4, 4, 3)))
        for i in range(n_stops)
    )  # fmt: skip
    return Truth(marks=marks, stops=stops, rig=None)


def placed(p):
    x, y, z = p
    cov = dict.fromkeys([f"cov_{a}_m2" for a in ("xx", "xy", "xz", "yy", "yz", "zz")], 1e-6)
    names = ("major_m", "minor_m", "bearing_deg", "major_95_m", "minor_95_m")
    ellipse = {f"ellipse_{name}": 0.001 for name in names}
    rest = {"sigma_3d_m": 0.002, "n_observations": 5, "mean_redundancy": 2.5}
    return {"x_m": x, "y_m": y, "z_m": z, **cov, **ellipse, **rest}


def network(truth, datum, T=None, shift=(0.0, 0.0, 0.0)):
    """Return the tables of a network that T moves away from the truth; its first mark is off."""
    T = np.eye(4) if T is None else T
    stations = []
    for one in truth.stops:
        pose = T @ one.T_site_base
        named = {"station": one.name, "stop": one.name, "run_id": "r", "recording_id": "d",
                 "rig_digest": "rig", "rotation": pose[:3, :3].ravel().tolist(),
                 "cov_motion": np.eye(6).ravel().tolist(), "sigma_yaw_deg": 0.01}  # fmt: skip
        yaw = float(np.degrees(yaw_pitch_roll(pose[:3, :3])[0]))
        stations.append(named | {"yaw_deg": yaw} | placed(pose[:3, 3]))
    p = transform(T, truth.marks.p_site)
    p[0] += shift
    marks = [
        {"mark": f"M{i}", "is_control": False, "status": "ok", "reason": ""} | placed(one)
        for i, one in enumerate([*p, p[0] + [0.0, 0.0, 3.0]])
    ]
    whole = {"job_id": "job", "survey_id": "survey", "n_stations": len(stations), "datum": datum,
             "n_marks": len(marks), "dof": 9, "sigma0": np.nan, "passes_global_test": True,
             "finished_at": None, "warnings": []}  # fmt: skip
    return tables_of(
        TABLES,
        {"adjustments": [whole], "adjusted_stations": stations, "adjusted_marks": marks},
        adjustment_id="one",
    )


def errors(found, table, axes=("x", "y", "z")):
    return np.array(
        [[row[f"error_{a}_m"] for a in axes] for row in found[table].to_pylist()], dtype=float
    )


def test_a_free_network_has_no_error_of_place_and_heading():
    truth = true_field()
    found = with_errors(network(truth, "free", AWAY), truth)
    np.testing.assert_allclose(errors(found, "adjusted_stations"), 0.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(errors(found, "adjusted_marks")[:6], 0.0, rtol=0, atol=1e-9)
    yaw = [row["error_yaw_deg"] for row in found["adjusted_stations"].to_pylist()]
    np.testing.assert_allclose(yaw, 0.0, rtol=0, atol=1e-9)


def test_a_network_with_control_keeps_its_error_of_place():
    truth = true_field()
    moved = rigid(np.eye(3), [0.01, 0.0, -0.02])
    found = with_errors(network(truth, "control", moved), truth)
    for table in ("adjusted_stations", "adjusted_marks"):
        np.testing.assert_allclose(
            errors(found, table)[:3], [[0.01, 0.0, -0.02]] * 3, rtol=0, atol=1e-9
        )


def test_a_free_network_that_leans_keeps_that_error():
    truth = true_field()
    leaning = exp_motion(np.array([0.001, 0.0, 0.0, 0.0, 0.0, 0.0]))
    found = with_errors(network(truth, "free", AWAY @ leaning), truth)
    p = np.vstack([truth.marks.p_site, [one.T_site_base[:3, 3] for one in truth.stops]])
    expected = transform(leaning, p) - p
    expected -= expected.mean(axis=0)
    up = np.concatenate([errors(found, "adjusted_marks")[:6, 2],
                         errors(found, "adjusted_stations")[:, 2]])  # fmt: skip
    np.testing.assert_allclose(up, expected[:, 2], rtol=0, atol=1e-5)


def test_a_mark_that_stands_beside_no_true_one_has_no_error():
    truth = true_field()
    found = with_errors(network(truth, "control"), truth)
    assert np.isnan(errors(found, "adjusted_marks")[6]).all()
    assert np.isfinite(errors(found, "adjusted_marks")[:6]).all()


def test_without_truth_or_with_one_station_of_a_free_network_there_are_no_errors():
    truth = true_field()
    one = Truth(marks=truth.marks, stops=truth.stops[:1], rig=None)
    for known in (None, one):
        found = with_errors(network(truth, "free", AWAY), known)
        assert np.isnan(errors(found, "adjusted_stations")).all()
        assert np.isnan(errors(found, "adjusted_marks")).all()


def test_centres_come_back_from_their_rows_as_they_were_fitted():
    made, fitted = made_tables(run_id="run1"), stop()
    ((name, found),) = read_centres({key: made[key] for key in CENTRES}, "run1", "along_beam")
    expected = fitted.fits["along_beam"]
    assert name == fitted.name
    assert (found.levelling.roll, found.levelling.pitch) == pytest.approx(
        (expected.levelling.roll, expected.levelling.pitch), abs=1e-15
    )
    assert found.levelling.sigma_heading == pytest.approx(fitted.sigma_heading)
    for one, other in zip(found.fits, expected.fits, strict=True):
        np.testing.assert_allclose(one.p_base, other.p_base, rtol=0, atol=1e-14)
        np.testing.assert_allclose(one.cov_p_base, other.cov_p_base, rtol=0, atol=1e-15)
        assert (one.status, one.reason, one.method) == (other.status, other.reason, other.method)
        np.testing.assert_equal(one.sigma_range_shared, other.sigma_range_shared)
        assert one.sigma_height_shared == other.sigma_height_shared


def test_evidence_and_possible_markers_come_back_from_their_rows():
    fitted = stop()
    known = fitted.fits["along_beam"]
    logs = np.linspace(-9.0, -1.0, 9)
    sure = tuple(replace(fit, log_likelihoods=logs + i) for i, fit in enumerate(known.fits))
    last = replace(sure[-1], name="P01", probability=0.95, hypothesis="post: likelier")
    compared = Rejection(
        p_base=np.array([4.0, -2.0, 0.5]), n_points=31, reason="A box.", probability=0.2,
        log_likelihoods=logs - 5.0,
    )  # fmt: skip
    bare = Rejection(p_base=np.array([1.0, 7.0, 0.3]), n_points=12, reason="One line.")
    with_more = replace(known, fits=sure, possible_fits=(last,), rejected=(compared, bare))
    result = replace(fitted, fits={**fitted.fits, "along_beam": with_more})
    made = tables(run(run_id="run1"), (result,), marks=MARKS)
    ((_, found),) = read_centres({key: made[key] for key in CENTRES}, "run1", "along_beam")
    for one, other in zip(found.fits, sure, strict=True):
        np.testing.assert_array_equal(one.log_likelihoods, other.log_likelihoods)
    (possible,) = found.possible_fits
    np.testing.assert_allclose(possible.p_base, last.p_base, rtol=0, atol=1e-14)
    np.testing.assert_allclose(possible.cov_p_base, last.cov_p_base, rtol=0, atol=1e-15)
    assert (possible.name, possible.probability) == ("P01", 0.95)
    np.testing.assert_array_equal(possible.log_likelihoods, last.log_likelihoods)
    groups = {one.reason: one for one in found.rejected}
    assert set(groups) == {"A box.", "One line."}
    np.testing.assert_array_equal(groups["A box."].log_likelihoods, compared.log_likelihoods)
    assert not len(groups["One line."].log_likelihoods)
    np.testing.assert_allclose(groups["One line."].p_base, bare.p_base, rtol=0, atol=1e-14)


@pytest.fixture
def catalogue(tmp_path):
    with Catalogue(tmp_path / "x.duckdb", snapshots=tmp_path / "snapshots") as found:
        found.create_survey("lane")
        yield found


def test_truth_that_comes_late_gives_networks_their_errors(catalogue):
    truth = true_field()
    survey_id = catalogue.get_survey("lane").survey_id
    job = catalogue.create_job("adjust", survey="lane", recording_id=None, config={})
    catalogue.start_job(job.job_id)
    made = network(truth, "control", rigid(np.eye(3), [0.01, 0.0, 0.0]))
    rows = made["adjustments"].to_pylist()[0]
    rows |= {"survey_id": survey_id, "finished_at": job.created_at}
    made["adjustments"] = table_of("adjustments", [{"adjustment_id": "one"} | rows])
    catalogue.finish_job(job.job_id, made)
    sql = "SELECT max(error_3d_m) AS error FROM latest_adjusted_stations"
    assert catalogue.rows(sql)[0]["error"] is None
    catalogue.put_truth("lane", truth)
    assert catalogue.rows(sql)[0]["error"] == pytest.approx(0.01)
    assert catalogue.rows("SELECT count(error_3d_m) AS n FROM adjusted_marks")[0]["n"] == 6


def test_the_same_rig_twice_is_one_and_comes_back_as_it_was(catalogue):
    rig = tilted_vlp16("bench", (0.03, -0.02))
    digest = catalogue.put_rig(rig)
    assert catalogue.put_rig(rig) == digest == rig_digest(rig)
    assert rig_to_mapping(catalogue.get_rig(digest)) == rig_to_mapping(rig)
    assert catalogue.rows("SELECT count(*) AS n FROM rigs")[0]["n"] == 1


def test_a_survey_uses_the_rig_that_was_chosen_until_another_is(catalogue):
    digest = catalogue.put_rig(tilted_vlp16("bench", (0.03, -0.02)))
    assert catalogue.choose_rig("lane", digest).rig_digest == digest
    assert catalogue.get_survey("lane").rig_digest == digest
    assert catalogue.choose_rig("lane", None).rig_digest is None
    with pytest.raises(NotFoundError, match="no rig 'none'"):
        catalogue.choose_rig("lane", "none")


def test_the_logs_of_a_survey_are_those_that_its_jobs_read(catalogue):
    catalogue.create_survey("other")
    for i, survey in enumerate(("lane", "lane", "other", "lane")):
        digest = f"{i:064x}"
        catalogue.add_recording(
            digest, name=f"log{i}", size_bytes=1, url="x", preflight={"verdict": "ok"}
        )
        job = catalogue.create_job("process", survey=survey, recording_id=digest, config={})
        if i == 3:
            catalogue.dismiss_job(job.job_id)
    assert catalogue.recordings_of_survey("lane") == (f"{0:064x}", f"{1:064x}")


def test_what_was_chosen_for_a_job_is_kept_beside_its_configuration(catalogue):
    options = {"control": False, "recordings": ["a", "b"]}
    job = catalogue.create_job(
        "adjust", survey="lane", recording_id=None, config={"tolerance": 0.02}, options=options
    )
    assert catalogue.get_job(job.job_id).options == options
    (row,) = catalogue.rows("SELECT options FROM jobs")
    assert json.loads(row["options"]) == options


def test_a_file_of_a_result_has_a_media_type():
    rows = documents("a", {"a.csv": "x", "b.json": "{}", "c.txt": "", "d.xml": "<a/>"}).to_pylist()
    assert [row["media_type"] for row in rows] == [
        "text/csv", "application/json", "text/plain", "application/xml",
    ]  # fmt: skip


def test_the_network_is_laid_on_the_truth_whatever_way_it_was_turned():
    truth = true_field()
    for yaw in (-3.0, 0.0, 2.9):
        away = rigid(rot_z(yaw), [5.0, 6.0, 7.0])
        found = with_errors(network(truth, "free", inverse(away), shift=(0.0, 0.0, 0.02)), truth)
        worst = np.abs(errors(found, "adjusted_marks")[:6]).max()
        assert 0.01 < worst < 0.02  # the mark that is off, less its share in the datum
