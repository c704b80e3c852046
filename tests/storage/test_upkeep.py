"""Upkeep of a data folder: findings, backups, and back again."""

import hashlib
import json
import os
import shutil
import time

import pytest

from spheremark.pipelines.errors import ConflictError, InputError
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.upkeep import (
    DamagedBackupError,
    back_up,
    examine,
    mend,
    remove_abandoned,
    restore,
)


def log(catalogue, data, content=b"a log"):
    digest = hashlib.sha256(content).hexdigest()
    path = data / "recordings" / f"{digest}.mcap"
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content)
    catalogue.add_recording(
        digest, name="a", size_bytes=len(content), url=str(path), preflight={"verdict": "ok"}
    )
    return path


@pytest.fixture
def data(tmp_path):
    folder = tmp_path / "data"
    folder.mkdir(mode=0o700)
    return folder


@pytest.fixture
def catalogue(data):
    with Catalogue(data / "spheremark.duckdb", snapshots=data / "snapshots") as opened:
        opened.create_survey("lane")
        yield opened


def kinds(catalogue, data):
    return sorted(one.kind for one in examine(catalogue.snapshot(), data))


def backup(catalogue, data, target):
    with catalogue.lent_export() as copy:
        return back_up(copy, data, target)


def test_nothing_is_wrong_with_a_folder_in_order(catalogue, data):
    log(catalogue, data)
    assert kinds(catalogue, data) == []


def test_each_fault_is_named(catalogue, data):
    missing, damaged, cut = (log(catalogue, data, bytes([i]) * 100) for i in range(3))
    missing.unlink()
    damaged.write_bytes(b"x" * 100)
    cut.write_bytes(b"x")
    (data / "recordings" / "unknown.mcap").write_bytes(b"x")
    for name in ("clouds/left.parquet", "octrees/cut.part", "recordings/.damaged/log.mcap"):
        (data / name).parent.mkdir()
        (data / name).write_bytes(b"x")
    data.chmod(0o755)
    with catalogue.writing() as cursor:
        cursor.execute(
            "INSERT INTO rejections VALUES ('no run', 's', 'm', 0, 0, 0, 1, 'r', 0, false)"
        )
    assert kinds(catalogue, data) == [
        "clouds.without_row", "octrees.without_row", "permissions", "recordings.damaged",
        "recordings.damaged", "recordings.missing", "recordings.set_aside",
        "recordings.without_row", "rows.lost",
    ]  # fmt: skip
    left = mend(examine(catalogue.snapshot(), data))
    assert {one.kind for one in left} == {
        "recordings.damaged", "recordings.missing", "recordings.set_aside",
        "recordings.without_row", "rows.lost",
    }  # fmt: skip
    assert not (data / "clouds" / "left.parquet").exists()
    assert data.stat().st_mode & 0o777 == 0o700


def cloud(catalogue, data, name):
    """Enter a stop whose cloud has this name, and write that."""
    survey = catalogue.get_survey("lane").survey_id
    path = data / "clouds" / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b"x")
    with catalogue.writing() as cursor:
        cursor.execute(
            "INSERT INTO runs VALUES ('run1', 'job1', ?, 'r', '{}', 'd', '1', 'd', now(), 1, NULL)",
            [survey],
        )
        cursor.execute(
            "INSERT INTO stops VALUES ('run1', 's', 1, 360, 1, 0, 0, 0, 0, 0, ?, [], '{}')",
            [str(path)],
        )


def test_what_ended_processes_left_is_removed_also_after_the_folder_was_moved(
    catalogue, data, tmp_path
):
    cloud(catalogue, data, "known.parquet")
    for name in ("run1.mcap", "run2.mcap", "left.parquet", "known.parquet.0f.part"):
        (data / "clouds" / name).write_bytes(b"x")
    moved = tmp_path / "moved"
    shutil.copytree(data, moved)
    for folder in (data, moved):
        assert remove_abandoned(catalogue, folder) == 3
        found = sorted(path.name for path in (folder / "clouds").iterdir())
        assert found == ["known.parquet", "run1.mcap"]


def test_what_a_running_job_has_written_is_no_fault_while_it_is_served(catalogue, data):
    survey = catalogue.get_survey("lane").survey_id
    (data / "clouds").mkdir()
    (data / "clouds" / "left.parquet").write_bytes(b"x")
    os.utime(data / "clouds" / "left.parquet", (0, 0))
    job = catalogue.create_job("adjust", survey=survey, recording_id=None, config={})
    catalogue.start_job(job.job_id)
    (data / "clouds" / "new.parquet").write_bytes(b"x")
    copy = catalogue.snapshot()
    served = examine(copy, data, time.time())
    assert [one.place for one in served] == [str(data / "clouds" / "left.parquet")]
    assert len(examine(copy, data)) == 2


def test_a_backup_of_a_database_in_use_is_restored_elsewhere(catalogue, data, tmp_path):
    kept = log(catalogue, data)
    assert backup(catalogue, data, tmp_path / "copy") == 2
    catalogue.create_survey("later")
    log(catalogue, data, b"another")
    assert backup(catalogue, data, tmp_path / "copy") == 3
    shutil.rmtree(tmp_path / "copy" / "other", ignore_errors=True)
    assert restore(tmp_path / "copy", tmp_path / "new") == 3
    with Catalogue(
        tmp_path / "new" / "spheremark.duckdb", snapshots=tmp_path / "new" / "snapshots"
    ) as again:
        assert {one.name for one in again.list_surveys().items} == {"lane", "later"}
        url = again.get_recording(kept.stem).url
        assert url == str(tmp_path / "new" / "recordings" / kept.name)
        assert examine(again.snapshot(), tmp_path / "new") == []
        again.create_survey("goes on")


def test_logs_of_results_and_ended_searches_are_in_order_and_backup(catalogue, data, tmp_path):
    kept = log(catalogue, data)
    row = ["run1", "job1", catalogue.get_survey("lane").survey_id, kept.stem]
    with catalogue.writing() as cursor:
        sql = "INSERT INTO runs VALUES (?, ?, ?, ?, '{}', 'd', '1', 'd', now(), 1, NULL)"
        cursor.execute(sql, row)
    files = {
        "clouds/run1.mcap": "spheres",
        "clouds/left.mcap": "of no run",
        "searches/ended.json": '{"status": "successful"}',
        "searches/open.json": '{"status": "running"}',
        "searches/damaged.json": '{"status": "succ',
        "worlds.json": "{}",
    }
    for name, text in files.items():
        (data / name).parent.mkdir(exist_ok=True)
        (data / name).write_text(text)
    (unknown,) = examine(catalogue.snapshot(), data)
    assert unknown.place == str(data / "clouds/left.mcap")
    backup(catalogue, data, tmp_path / "copy")
    restore(tmp_path / "copy", tmp_path / "new")
    copied = {name for name in files if (tmp_path / "new" / name).exists()}
    assert copied == {"clouds/run1.mcap", "searches/ended.json", "worlds.json"}


def test_a_damaged_backup_is_refused_before_anything_is_made(catalogue, data, tmp_path):
    kept = log(catalogue, data)
    backup(catalogue, data, tmp_path / "copy")
    (tmp_path / "copy" / "recordings" / kept.name).write_bytes(b"other")
    with pytest.raises(DamagedBackupError, match=kept.name):
        restore(tmp_path / "copy", tmp_path / "new")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    "manifest",
    [None, "{", "[]", json.dumps({"format": "spheremark-backup/1", "files": {"../x": {}}})],
)
def test_what_is_no_backup_is_refused(tmp_path, manifest):
    if manifest is not None:
        (tmp_path / "manifest.json").write_text(manifest)
    with pytest.raises(DamagedBackupError):
        restore(tmp_path, tmp_path / "new")


def test_a_folder_with_a_database_is_not_overwritten(catalogue, data, tmp_path):
    backup(catalogue, data, tmp_path / "copy")
    with pytest.raises(ConflictError, match="another folder"):
        restore(tmp_path / "copy", data)


def test_a_damaged_log_is_not_copied_as_if_it_were_whole(catalogue, data, tmp_path):
    log(catalogue, data).write_bytes(b"other")
    with pytest.raises(InputError, match="is damaged"):
        backup(catalogue, data, tmp_path / "copy")
    assert not (tmp_path / "copy" / "manifest.json").exists()
