import json
import os
import re
import shutil
import signal
import struct
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import duckdb
import numpy as np
import pyarrow as pa
import pytest

from spheremark.pipelines.errors import ConflictError, ControlError, InputError, NotFoundError
from spheremark.pipelines.model import ControlMarks
from spheremark.pipelines.scan.rigs import rig_to_mapping
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.catalogue.migrations import SchemaConflictError
from spheremark.storage.catalogue.records import JobStatus
from tests.storage.made_up import MARKS, made_tables, truth

ROOT = Path(__file__).parents[2]
DIGEST = "ab" * 32


def opened(folder):
    return Catalogue(folder / "data" / "results.duckdb", snapshots=folder / "snapshots")


@pytest.fixture
def catalogue(tmp_path):
    with opened(tmp_path) as found:
        yield found


def recording(catalogue, digest=DIGEST):
    return catalogue.add_recording(
        digest, name="L1S1", size_bytes=7, url="/logs/x", preflight={"verdict": "ok", "rate": 10.0}
    )


def job(catalogue, survey="lane", digest=DIGEST):
    recording(catalogue, digest)
    return catalogue.create_job(
        "process", survey=survey, recording_id=digest, config={"tolerance": 0.02}
    )


def running(catalogue, **wanted):
    return catalogue.start_job(job(catalogue, **wanted).job_id)


def finished(catalogue, run_id="run1", digest=DIGEST):
    survey_id = catalogue.get_survey("lane").survey_id
    begun = running(catalogue, digest=digest)
    rows = made_tables(run_id=run_id, job_id=begun.job_id, survey_id=survey_id, recording_id=digest)
    catalogue.finish_job(begun.job_id, rows)
    return catalogue.get_job(begun.job_id)


def count(catalogue, sql):
    return catalogue.rows(sql)[0]["n"]


N_FITS = "SELECT count(*) AS n FROM marker_fits"


# Opening


def test_a_database_that_another_process_has_open_is_refused(tmp_path):
    with opened(tmp_path) as catalogue:
        code = (
            "import sys; from pathlib import Path\n"
            "from spheremark.storage.catalogue.catalogue import Catalogue\n"
            "from spheremark.pipelines.errors import ConflictError\n"
            "try: Catalogue(Path(sys.argv[1]), snapshots=Path(sys.argv[2]))\n"
            "except ConflictError as error: print(error)"
        )
        snapshots = str(tmp_path / "other")
        other = subprocess.run(
            [sys.executable, "-c", code, str(catalogue.path), snapshots],
            cwd=ROOT, capture_output=True, text=True, check=True,
        )  # fmt: skip
    assert f"results.duckdb is in use by another process (PID {os.getpid()})" in other.stdout


def test_a_database_that_this_process_has_open_is_refused(tmp_path):
    with opened(tmp_path) as first:
        with pytest.raises(ConflictError, match="already open in this process"):
            opened(tmp_path)
        first.create_survey("still works")


def test_a_file_that_is_no_database_is_refused(tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "results.duckdb").write_bytes(b"not a database" * 1000)
    with pytest.raises(InputError, match="is not a database"):
        opened(tmp_path)


def test_a_database_of_a_newer_version_is_refused(tmp_path):
    with opened(tmp_path) as catalogue:
        path = catalogue.path
    with duckdb.connect(str(path)) as connection:
        connection.execute("INSERT INTO schema_migrations VALUES (99, 'later', 'x', now())")
    with pytest.raises(SchemaConflictError, match=r"99 \(later\)"):
        opened(tmp_path)


def test_the_owner_reaches_no_file_and_its_configuration_is_locked(catalogue):
    with pytest.raises(duckdb.PermissionException):
        catalogue.rows("SELECT * FROM read_csv('/etc/passwd')")
    with pytest.raises(duckdb.InvalidInputException, match="locked"):
        catalogue.rows("SET enable_external_access = true")


def test_all_that_was_put_is_there_after_a_restart(tmp_path):
    with opened(tmp_path) as catalogue:
        survey = catalogue.create_survey("lane", tolerance=0.02)
        catalogue.put_control_marks("lane", MARKS)
        done = finished(catalogue)
    with opened(tmp_path) as catalogue:
        assert catalogue.get_survey("lane").survey_id == survey.survey_id
        assert catalogue.control_marks("lane").names == MARKS.names
        assert catalogue.get_job(done.job_id) == done
        assert count(catalogue, N_FITS) == 14


# Surveys


def test_a_survey_is_found_by_id_and_by_name(catalogue):
    made = catalogue.create_survey("lane 1", tolerance=0.02)
    assert catalogue.get_survey("lane 1") == catalogue.get_survey(made.survey_id) == made
    assert (made.name, made.tolerance, made.n_control_marks) == ("lane 1", 0.02, 0)
    assert made.created_at.tzinfo is not None


def test_two_surveys_cannot_have_one_name(catalogue):
    catalogue.create_survey("lane")
    with pytest.raises(ConflictError, match="already a survey called 'lane'"):
        catalogue.create_survey("lane")


@pytest.mark.parametrize(
    ("name", "tolerance"),
    [("", 0.03), ("a\nb", 0.03), ("a/b", 0.03), ("..", 0.03), ("a", 0.0), ("a", 2)],
)
def test_a_survey_that_makes_no_sense_is_refused(catalogue, name, tolerance):
    with pytest.raises(InputError):
        catalogue.create_survey(name, tolerance=tolerance)


def test_what_is_not_there_is_not_found(catalogue):
    catalogue.create_survey("lane")
    with pytest.raises(NotFoundError, match="no survey 'x'"):
        catalogue.get_survey("x")
    with pytest.raises(NotFoundError, match="no recording"):
        catalogue.create_job("process", survey="lane", recording_id=DIGEST, config={})
    with pytest.raises(NotFoundError, match="no job"):
        catalogue.start_job("x")
    with pytest.raises(NotFoundError, match="no run"):
        catalogue.get_run("x")


def test_a_list_comes_in_parts_that_together_are_the_whole(catalogue):
    names = [f"s{i}" for i in range(7)]
    for name in names:
        catalogue.create_survey(name)
    found, after = [], None
    while True:
        part = catalogue.list_surveys(after=after, limit=3)
        found += [survey.name for survey in part.items]
        after = part.next
        if after is None:
            break
        catalogue.create_survey(f"new while listing {len(found)}")
    assert found == names[::-1]


def test_an_invented_place_in_a_list_is_refused(catalogue):
    for wrong in ("x", "aGVsbG8=", "aGVsbG8gd29ybGQ="):
        with pytest.raises(InputError, match="no place in this list"):
            catalogue.list_surveys(after=wrong)
    with pytest.raises(InputError, match="from 1 to 1000"):
        catalogue.list_surveys(limit=0)


# Marks and truth


def test_control_marks_come_back_as_they_were_put(catalogue):
    catalogue.create_survey("lane")
    assert catalogue.control_marks("lane") is None
    rng = np.random.default_rng(1)
    cov = np.eye(3) * rng.uniform(0, 1e-4, (6, 3))[:, None, :]
    marks = ControlMarks(names=MARKS.names[::-1], p_site=rng.normal(size=(6, 3)), cov_p_site=cov)
    catalogue.put_control_marks("lane", marks)
    found = catalogue.control_marks("lane")
    assert found.names == marks.names
    np.testing.assert_array_equal(found.p_site, marks.p_site)
    np.testing.assert_allclose(found.cov_p_site, cov, rtol=1e-14)
    assert catalogue.get_survey("lane").n_control_marks == 6


def test_new_control_marks_take_the_place_of_the_old_ones(catalogue):
    catalogue.create_survey("lane")
    catalogue.create_survey("other")
    catalogue.put_control_marks("lane", MARKS)
    catalogue.put_control_marks("other", MARKS)
    fewer = ControlMarks(names=("F", "new"), p_site=np.ones((2, 3)), cov_p_site=np.zeros((2, 3, 3)))
    catalogue.put_control_marks("lane", fewer)
    assert catalogue.control_marks("lane").names == ("F", "new")
    np.testing.assert_array_equal(catalogue.control_marks("lane").p_site, np.ones((2, 3)))
    assert catalogue.control_marks("other").names == MARKS.names


@pytest.mark.parametrize(
    ("names", "p_site", "cov", "reason"),
    [
        (("A", "A"), np.zeros((2, 3)), np.zeros((2, 3, 3)), "all different"),
        (("A", ""), np.zeros((2, 3)), np.zeros((2, 3, 3)), "must have names"),
        (("A", "B"), np.full((2, 3), np.nan), np.zeros((2, 3, 3)), "finite coordinates"),
        (("A", "B"), np.zeros((2, 3)), -np.ones((2, 3, 3)), "not negative"),
        (("A", "B"), np.zeros((2, 3)), np.ones((2, 3, 3)), "independent coordinates"),
    ],
)
def test_marks_that_a_survey_cannot_use_are_refused(catalogue, names, p_site, cov, reason):
    catalogue.create_survey("lane")
    with pytest.raises(ControlError, match=reason):
        catalogue.put_control_marks(
            "lane", ControlMarks(names=names, p_site=p_site, cov_p_site=cov)
        )


def test_truth_comes_back_as_it_was_put_and_grows_by_stops(catalogue):
    catalogue.create_survey("lane")
    assert catalogue.truth("lane") is None
    catalogue.put_truth("lane", truth("L1S1"))
    catalogue.put_truth("lane", truth("L1S2"))
    found, expected = catalogue.truth("lane"), truth("L1S1", "L1S2")
    assert [stop.name for stop in found.stops] == ["L1S1", "L1S2"]
    for one, other in zip(found.stops, expected.stops, strict=True):
        np.testing.assert_allclose(one.T_site_base, other.T_site_base, rtol=0, atol=1e-14)
    assert found.marks.names == expected.marks.names
    np.testing.assert_array_equal(found.marks.p_site, expected.marks.p_site)
    assert rig_to_mapping(found.rig) == rig_to_mapping(expected.rig)
    assert found.about == expected.about


def test_truth_that_comes_late_gives_old_results_the_errors_of_new_ones(catalogue):
    catalogue.create_survey("lane")
    finished(catalogue, "run1")
    assert count(catalogue, "SELECT count(error_3d_m) AS n FROM marker_fits") == 0
    catalogue.put_truth("lane", truth("L1S1"))
    finished(catalogue, "run2")
    for table in ("marker_fits", "station_fixes", "resections"):
        found = [
            catalogue.rows(f"SELECT * EXCLUDE (run_id) FROM {table} WHERE run_id = '{run}'")  # noqa: S608
            for run in ("run1", "run2")
        ]
        assert found[0] == found[1]
        assert any(row["error_3d_m"] is not None for row in found[0])


def test_truth_of_one_survey_leaves_the_results_of_others_alone(catalogue):
    catalogue.create_survey("lane")
    catalogue.create_survey("other")
    finished(catalogue)
    catalogue.put_truth("other", truth("L1S1"))
    assert count(catalogue, "SELECT count(error_3d_m) AS n FROM marker_fits") == 0


# Recordings


def test_the_same_bytes_twice_are_one_recording(catalogue):
    first = recording(catalogue)
    again = catalogue.add_recording(
        DIGEST, name="renamed", size_bytes=7, url="/logs/y", preflight={"verdict": "weak"}
    )
    assert again == first == catalogue.get_recording(DIGEST)
    assert first.preflight == {"verdict": "ok", "rate": 10.0}
    assert len(catalogue.list_recordings().items) == 1


@pytest.mark.parametrize(
    ("digest", "preflight"),
    [
        ("ab", {"verdict": "ok"}),
        (DIGEST, {}),
        (DIGEST, {"verdict": "fine"}),
        (DIGEST, {"verdict": "ok", "rate": float("nan")}),
    ],
)
def test_a_recording_that_makes_no_sense_is_refused(catalogue, digest, preflight):
    with pytest.raises(InputError):
        catalogue.add_recording(digest, name="x", size_bytes=1, url="/x", preflight=preflight)


# Jobs


def test_a_job_goes_from_accepted_to_successful(catalogue):
    catalogue.create_survey("lane")
    made = job(catalogue)
    assert (made.status, made.survey, made.recording) == (JobStatus.ACCEPTED, "lane", "L1S1")
    assert made.config == {"tolerance": 0.02}
    begun = catalogue.start_job(made.job_id)
    assert (begun.status, begun.attempts) == (JobStatus.RUNNING, 1)
    catalogue.report_progress(made.job_id, 40.0, "Fitting.")
    half = catalogue.get_job(made.job_id)
    assert (half.progress_percent, half.message) == (40.0, "Fitting.")
    catalogue.finish_job(made.job_id, {}, message="14 markers.")
    done = catalogue.get_job(made.job_id)
    assert (done.status, done.progress_percent, done.message) == (
        JobStatus.SUCCESSFUL, 100.0, "14 markers.",
    )  # fmt: skip
    assert done.created_at <= done.started_at <= done.finished_at


def test_a_job_that_is_finished_twice_writes_its_results_once(catalogue):
    catalogue.create_survey("lane")
    done = finished(catalogue)
    rows = made_tables(run_id="other", job_id=done.job_id)
    catalogue.finish_job(done.job_id, rows)
    assert catalogue.get_job(done.job_id) == done
    assert count(catalogue, N_FITS) == 14


def test_a_job_whose_results_cannot_be_written_writes_none_and_runs_on(catalogue):
    catalogue.create_survey("lane")
    begun = running(catalogue)
    rows = made_tables(job_id=begun.job_id)
    at = rows["observations"].column_names.index("marker")
    nameless = pa.nulls(rows["observations"].num_rows, pa.string())
    rows["observations"] = rows["observations"].set_column(at, "marker", nameless)
    with pytest.raises(duckdb.ConstraintException):
        catalogue.finish_job(begun.job_id, rows)
    assert catalogue.get_job(begun.job_id).status is JobStatus.RUNNING
    assert count(catalogue, N_FITS) == count(catalogue, "SELECT count(*) AS n FROM runs") == 0
    catalogue.finish_job(begun.job_id, made_tables(job_id=begun.job_id))
    assert catalogue.get_job(begun.job_id).status is JobStatus.SUCCESSFUL
    assert count(catalogue, N_FITS) == 14


def test_results_that_were_written_outlive_a_crash(tmp_path):
    with opened(tmp_path) as catalogue:
        catalogue.create_survey("lane")
        done = finished(catalogue)
        left = tmp_path / "left"  # what is on disk, with nothing closed
        subprocess.run(["cp", "-r", str(tmp_path / "data"), str(left)], check=True)
    with Catalogue(left / "results.duckdb", snapshots=tmp_path / "others") as again:
        assert again.get_job(done.job_id) == done
        given = made_tables(job_id=done.job_id)
        written = {
            "runs": again.rows("SELECT run_id FROM runs"),
            "stops": again.rows("SELECT stop FROM stops"),
            "marker_fits": again.rows("SELECT * FROM marker_fits ORDER BY rowid"),
            "rejections": again.rows("SELECT * FROM rejections ORDER BY rowid"),
            "station_fixes": again.rows("SELECT * FROM station_fixes"),
            "observations": again.rows("SELECT * FROM observations ORDER BY rowid"),
            "resections": again.rows("SELECT * FROM resections ORDER BY rowid"),
        }
    for name, rows in written.items():
        assert rows == given[name].select(list(rows[0])).to_pylist()


@pytest.mark.parametrize(
    ("table", "sql"),
    [
        ("marker_fits", "SELECT * FROM marker_fits WHERE run_id = $id ORDER BY rowid"),
        ("observations", "SELECT * FROM observations WHERE run_id = $id ORDER BY rowid"),
        ("resections", "SELECT * FROM resections WHERE run_id = $id ORDER BY rowid"),
    ],
)
def test_the_rows_of_each_run_come_out_as_they_went_in(catalogue, table, sql):
    catalogue.create_survey("lane")
    for run_id, digest in (("run1", "ab" * 32), ("run2", "cd" * 32)):
        finished(catalogue, run_id, digest=digest)
    for run_id in ("run1", "run2"):
        given = made_tables(run_id=run_id)[table].to_pylist()
        assert catalogue.rows(sql, {"id": run_id}) == given


def test_results_whose_columns_hold_nothing_are_written_as_others(catalogue):
    catalogue.create_survey("lane")
    begun = running(catalogue)
    rows = made_tables(job_id=begun.job_id)
    at = rows["marker_fits"].column_names.index("mark")
    n = rows["marker_fits"].num_rows
    rows["marker_fits"] = rows["marker_fits"].set_column(at, "mark", pa.nulls(n))
    catalogue.finish_job(begun.job_id, rows)
    assert count(catalogue, N_FITS) == 14
    assert count(catalogue, "SELECT count(mark) AS n FROM marker_fits") == 0


def test_results_for_a_table_that_no_job_writes_are_refused(catalogue):
    catalogue.create_survey("lane")
    begun = running(catalogue)
    with pytest.raises(InputError, match="No job writes 'surveys'"):
        catalogue.finish_job(begun.job_id, {"surveys": made_tables()["runs"]})


def test_a_failed_job_has_its_reason(catalogue):
    catalogue.create_survey("lane")
    begun = running(catalogue)
    catalogue.fail_job(begun.job_id, code="solve", reason="No markers.", traceback="line 1")
    failed = catalogue.get_job(begun.job_id)
    assert failed.status is JobStatus.FAILED
    assert (failed.error_code, failed.error_reason) == ("solve", "No markers.")
    assert failed.error_traceback == "line 1"


def test_a_job_at_its_end_does_not_change_any_more(catalogue):
    catalogue.create_survey("lane")
    dismissed = catalogue.dismiss_job(running(catalogue).job_id)
    assert dismissed.status is JobStatus.DISMISSED
    with pytest.raises(ConflictError, match="is dismissed, not running"):
        catalogue.finish_job(dismissed.job_id, made_tables(job_id=dismissed.job_id))
    with pytest.raises(ConflictError):
        catalogue.fail_job(dismissed.job_id, code="x", reason="x")
    with pytest.raises(ConflictError):
        catalogue.start_job(dismissed.job_id)
    catalogue.report_progress(dismissed.job_id, 50.0, "late")
    assert catalogue.get_job(dismissed.job_id) == dismissed
    assert count(catalogue, N_FITS) == 0


def test_jobs_that_ran_when_the_service_died_are_taken_up_again(tmp_path):
    with opened(tmp_path) as catalogue:
        catalogue.create_survey("lane")
        ran, waited = running(catalogue), job(catalogue)
        done = finished(catalogue)
    with opened(tmp_path) as catalogue:
        taken = catalogue.take_up_jobs(3, "The worker died.")
        assert [one.job_id for one in taken] == [ran.job_id, waited.job_id]
        assert all(one.status is JobStatus.ACCEPTED for one in taken)
        assert catalogue.start_job(ran.job_id).attempts == 2
        assert catalogue.get_job(done.job_id).status is JobStatus.SUCCESSFUL


def test_a_job_that_ended_the_service_too_often_fails_at_its_next_start(catalogue):
    catalogue.create_survey("lane")
    begun = running(catalogue)
    for _ in range(2):
        (taken,) = catalogue.take_up_jobs(3, "The worker died.")
        catalogue.start_job(taken.job_id)
    assert catalogue.get_job(begun.job_id).attempts == 3
    assert catalogue.take_up_jobs(3, "The worker died.") == ()
    failed = catalogue.get_job(begun.job_id)
    assert (failed.status, failed.error_code) == (JobStatus.FAILED, "worker_died")
    assert failed.error_reason == "The worker died."


def test_an_attempt_that_the_end_of_the_service_interrupts_does_not_count(catalogue):
    catalogue.create_survey("lane")
    begun = running(catalogue)
    catalogue.release_jobs()
    released = catalogue.get_job(begun.job_id)
    assert (released.status, released.attempts) == (JobStatus.ACCEPTED, 0)


def test_the_job_of_a_key_is_known_after_a_restart(tmp_path):
    with opened(tmp_path) as catalogue:
        catalogue.create_survey("lane")
        made = catalogue.create_job(
            "process", survey="lane", recording_id=None, config={}, key=("k", "digest")
        )
    with opened(tmp_path) as catalogue:
        assert catalogue.job_of_key("k") == ("digest", catalogue.get_job(made.job_id))
        assert catalogue.job_of_key("other") is None


def test_a_job_whose_worker_died_waits_for_another_attempt(catalogue):
    catalogue.create_survey("lane")
    begun = running(catalogue)
    waiting = catalogue.requeue_job(begun.job_id, "The worker died.")
    assert (waiting.status, waiting.message) == (JobStatus.ACCEPTED, "The worker died.")


def test_jobs_and_runs_are_listed_by_what_they_belong_to(catalogue):
    catalogue.create_survey("lane")
    catalogue.create_survey("other")
    done, waiting = finished(catalogue), job(catalogue, survey="other", digest="cd" * 32)

    def ids(**wanted):
        return [one.job_id for one in catalogue.list_jobs(**wanted).items]

    assert ids() == [waiting.job_id, done.job_id]
    assert ids(survey="lane") == ids(status=JobStatus.SUCCESSFUL) == [done.job_id]
    assert ids(recording_id="cd" * 32) == [waiting.job_id]
    (run,) = catalogue.list_runs(job_id=done.job_id).items
    assert run == catalogue.get_run("run1")
    assert run.duration == 1.5
    assert catalogue.list_runs(survey="other").items == ()
    assert catalogue.get_survey("lane").n_recordings == 1


def test_a_log_whose_only_job_was_dismissed_is_no_log_of_the_survey(catalogue):
    catalogue.create_survey("lane")
    catalogue.dismiss_job(job(catalogue).job_id)
    assert catalogue.get_survey("lane").n_recordings == 0
    assert catalogue.recordings_of_survey("lane") == ()


# Queries, views and schema


def test_columns_turn_null_into_nan_and_instants_into_utc(catalogue):
    found = catalogue.columns(
        "SELECT * FROM (VALUES (1, 1.5, 'a', [1.0], TIMESTAMPTZ '2026-01-02 03:04:05+01'), "
        "(NULL, NULL, NULL, NULL, NULL)) AS t(i, x, s, l, at_)"
    )
    np.testing.assert_array_equal(found["i"], [1.0, np.nan])
    np.testing.assert_array_equal(found["x"], [1.5, np.nan])
    assert found["s"].tolist() == ["a", None]
    assert found["at_"][0] == np.datetime64("2026-01-02T02:04:05")
    assert np.isnat(found["at_"][1])


def test_values_are_bound_and_never_pasted(catalogue):
    catalogue.create_survey("lane")
    evil = "x'; DROP TABLE surveys; --"
    sql = "SELECT count(*) AS n FROM surveys WHERE name = $name"
    assert catalogue.rows(sql, {"name": evil}) == [{"n": 0}]
    assert catalogue.rows(sql, {"name": "lane"}) == [{"n": 1}]


def test_an_answer_that_is_too_long_is_refused(catalogue):
    with pytest.raises(InputError, match="200001 rows; the limit is 200000"):
        catalogue.columns("SELECT * FROM range(200001)")


def names_of_surveys(catalogue):
    return [row["name"] for row in catalogue.rows("SELECT name FROM surveys ORDER BY name")]


def test_a_value_is_computed_once_until_something_is_written(catalogue):
    begun = []

    def compute():
        begun.append(threading.get_ident())
        time.sleep(0.05)
        return names_of_surveys(catalogue)

    with ThreadPoolExecutor(4) as threads:
        for n_written, name in enumerate(("a", "b", "c"), 1):
            catalogue.create_survey(name)
            found = list(threads.map(lambda _: catalogue.computed("names", compute), range(8)))
            assert found == [names_of_surveys(catalogue)] * 8
            assert len(begun) == n_written


def test_a_value_that_cannot_be_computed_is_tried_again(catalogue):
    def fail():
        raise InputError("not yet")

    with pytest.raises(InputError, match="not yet"):
        catalogue.computed("x", fail)
    assert catalogue.computed("x", lambda: 3) == 3


def test_values_that_are_kept_are_bounded(catalogue):
    for number in range(200):
        assert catalogue.computed(number, lambda number=number: number) == number
    assert len(catalogue._kept) <= 64


def test_views_show_the_newest_run_only(catalogue):
    catalogue.create_survey("lane")
    catalogue.put_truth("lane", truth("L1S1"))
    finished(catalogue, "run1")
    survey_id = catalogue.get_survey("lane").survey_id
    begun = running(catalogue)
    later = made_tables(
        run_id="run2", job_id=begun.job_id, survey_id=survey_id, recording_id=DIGEST
    )
    at = later["runs"].column_names.index("finished_at")
    newer = later["runs"].column("finished_at").to_pylist()[0].replace(year=2027)
    later["runs"] = later["runs"].set_column(at, later["runs"].schema.field(at), [[newer]])
    catalogue.finish_job(begun.job_id, later)
    assert count(catalogue, N_FITS) == 28
    found = catalogue.rows("SELECT DISTINCT run_id FROM latest_marker_fits")
    assert found == [{"run_id": "run2"}]
    found = catalogue.rows(
        "SELECT sum(n_fits) AS n_fits, sum(n_errors) AS n_errors FROM accuracy_by_distance"
    )
    assert found == [{"n_fits": 14, "n_errors": 12}]
    pair, triple = catalogue.rows(
        "SELECT * FROM accuracy_by_included_angle WHERE n_errors > 0 ORDER BY n_marks"
    )
    for row, n_marks, degrees, error in ((pair, 2, 30.0, 0.010), (triple, 3, 100.0, 0.013)):
        assert (row["n_marks"], row["included_angle_from_deg"]) == (n_marks, degrees)
        assert row["error_3d_mean_m"] == pytest.approx(error)
    stops = catalogue.rows("SELECT * FROM accuracy_by_stop ORDER BY fit_method")
    assert [row["status"] for row in stops] == ["ok", "failed"]
    assert [row["n_fits"] for row in stops] == [7, 7]
    counts = catalogue.rows("SELECT sum(n_errors) AS n FROM accuracy_by_point_count")
    assert counts == [{"n": 12}]


def test_every_column_of_a_result_is_documented(catalogue):
    tables = {table.name: table for table in catalogue.schema()}
    obvious = {"run_id", "survey_id", "survey", "recording_id", "job_id", "stop", "fit_method"}
    obvious |= {"resection_method", "marker", "mark"}
    for name in ("marker_fits", "station_fixes", "latest_station_fixes", "accuracy_by_distance"):
        for column in tables[name].columns:
            assert column.comment or column.name in obvious, f"{name}.{column.name}"
    units = {column.name: column.unit for column in tables["marker_fits"].columns}
    assert (units["range_m"], units["cov_xx_m2"], units["azimuth_deg"]) == ("m", "m²", "°")
    assert (units["n_points"], units["status"]) == ("", "")
    assert tables["accuracy_by_stop"].kind == "view"


# Snapshots


def test_a_snapshot_holds_what_was_committed_and_is_kept_until_more_is(catalogue):
    catalogue.create_survey("lane")
    first = catalogue.snapshot()
    begun = running(catalogue)
    second = catalogue.snapshot()
    catalogue.report_progress(begun.job_id, 10.0, "On the way.")
    assert second != first
    assert catalogue.snapshot() == second
    with duckdb.connect(str(second), read_only=True) as copy:
        assert copy.execute("SELECT name FROM surveys").fetchall() == [("lane",)]
        assert copy.execute("SELECT status FROM jobs").fetchall() == [("running",)]


def test_old_snapshots_go(catalogue, tmp_path):
    made = []
    for i in range(6):
        catalogue.create_survey(f"s{i}")
        made.append(catalogue.snapshot())
    kept = sorted((tmp_path / "snapshots").iterdir())
    assert kept == made[-3:]


def test_a_lent_snapshot_stays_however_many_are_made_meanwhile(catalogue, tmp_path):
    catalogue.create_survey("lane")
    with catalogue.lent_snapshot() as lent:
        for i in range(6):
            catalogue.create_survey(f"s{i}")
            catalogue.snapshot()
        with duckdb.connect(str(lent), read_only=True) as copy:
            assert copy.execute("SELECT name FROM surveys").fetchall() == [("lane",)]
    assert len(list((tmp_path / "snapshots").iterdir())) == 3


def test_an_export_stays_while_results_are_committed_and_others_export(catalogue, tmp_path):
    def exported(names, number):
        for i in range(4):
            catalogue.create_survey(f"{number}-{i}")
            with catalogue.lent_export() as copy:
                barrier.wait()  # all are made, and older ones are removed, before any is opened
                with duckdb.connect(str(copy), read_only=True) as found:
                    names[number, i] = set(found.execute("SELECT name FROM surveys").fetchall())

    found, barrier = {}, threading.Barrier(3, timeout=60)
    threads = [threading.Thread(target=exported, args=(found, number)) for number in range(3)]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    assert len(found) == 12
    for (number, i), names in found.items():
        assert {(f"{number}-{k}",) for k in range(i + 1)} <= names
    left = {path.name.partition("-")[0] for path in (tmp_path / "snapshots").iterdir()}
    assert left == {"snapshot", "portable"}


def test_a_snapshot_does_not_open_the_door_to_other_owners(catalogue):
    catalogue.create_survey("lane")
    catalogue.snapshot()
    code = f"import duckdb; duckdb.connect({str(catalogue.path)!r})"
    other = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert "Could not set lock" in other.stderr


def test_an_export_has_the_storage_version_that_duckdb_1_0_reads(catalogue):
    catalogue.create_survey("lane")
    with (
        catalogue.lent_export() as copy,
        duckdb.connect(str(copy), read_only=True) as found,
    ):
        magic, version = struct.unpack_from("<4sQ", copy.read_bytes(), 8)
        assert (magic, version) == (b"DUCK", 64)
        assert found.execute("SELECT name FROM surveys").fetchall() == [("lane",)]
        assert found.execute("SELECT count(*) FROM placements").fetchall() == [(0,)]
        query = "SELECT count(*) FROM duckdb_columns() WHERE comment IS NOT NULL"
        assert found.execute(query).fetchall()[0][0] > 300


@pytest.mark.slow
@pytest.mark.parametrize("version", ["1.1.3", "1.2.2", "1.3.2", "1.4.1"])
def test_older_releases_of_duckdb_open_an_export(catalogue, version):
    catalogue.create_survey("lane")
    code = (
        "import duckdb, sys; c = duckdb.connect(sys.argv[1], read_only=True); "
        "print(c.execute('SELECT name FROM surveys').fetchall(), "
        "len(c.execute('SHOW TABLES').fetchall()))"
    )
    uv = shutil.which("uv", path=f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    if uv is None:
        pytest.skip("Older releases of DuckDB cannot be had here: uv is not installed.")
    command = [uv, "run", "--quiet", "--no-project", "--with", f"duckdb=={version}", "python", "-c"]
    with catalogue.lent_export() as copy:
        run = subprocess.run([*command, code, copy], capture_output=True, text=True, check=False)
    if run.returncode and re.search(r"dns error|connect|timed out|network|resolve", run.stderr):
        pytest.skip(f"DuckDB {version} cannot be had here: {run.stderr.strip()[-200:]}")
    assert run.stdout.startswith("[('lane',)]"), run.stderr


# Many at once, and sudden death


def test_readers_never_see_half_a_job_while_one_writes(catalogue):
    catalogue.create_survey("lane")
    wrong, stop = [], threading.Event()

    def read():
        while not stop.is_set():
            found = catalogue.rows(
                "SELECT (SELECT count(*) FROM marker_fits) AS fits, "
                "(SELECT count(*) FROM jobs WHERE status = 'successful') AS done"
            )[0]
            if found["fits"] != 14 * found["done"]:
                wrong.append(found)

    readers = [threading.Thread(target=read) for _ in range(2)]
    for reader in readers:
        reader.start()
    try:
        for i in range(5):
            finished(catalogue, f"run{i}")
            catalogue.snapshot()
    finally:
        stop.set()
        for reader in readers:
            reader.join()
    assert wrong == []
    assert count(catalogue, N_FITS) == 5 * 14


def test_writers_from_many_threads_take_turns(catalogue):
    failures = []

    def write(k):
        try:
            for i in range(5):
                catalogue.create_survey(f"s{k}-{i}")
        except Exception as error:  # noqa: BLE001  a thread's error must reach the test
            failures.append(error)

    writers = [threading.Thread(target=write, args=(k,)) for k in range(6)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert failures == []
    assert len(catalogue.list_surveys().items) == 30


def test_a_process_killed_while_it_writes_leaves_whole_jobs_only(tmp_path):
    code = """
import sys
from pathlib import Path
from tests.storage.test_catalogue import finished, opened
with opened(Path(sys.argv[1])) as catalogue:
    catalogue.create_survey("lane")
    for i in range(100000):
        finished(catalogue, f"run{i}")
        print(i, flush=True)
"""
    with subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)], cwd=ROOT, stdout=subprocess.PIPE, text=True
    ) as writer:
        for line in writer.stdout:
            if int(line) == 5:
                break
        writer.send_signal(signal.SIGKILL)
    with opened(tmp_path) as catalogue:
        done = count(catalogue, "SELECT count(*) AS n FROM jobs WHERE status = 'successful'")
        assert done >= 6
        assert count(catalogue, "SELECT count(*) AS n FROM runs") == done
        assert count(catalogue, N_FITS) == 14 * done


def test_preflight_and_config_are_json_in_the_database(catalogue):
    catalogue.create_survey("lane")
    job(catalogue)
    (row,) = catalogue.rows("SELECT preflight->>'verdict' AS v, preflight FROM recordings")
    assert row["v"] == "ok"
    assert json.loads(row["preflight"]) == {"verdict": "ok", "rate": 10.0}
