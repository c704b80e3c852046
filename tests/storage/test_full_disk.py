"""A disk that is full: what is refused, what is kept, and that no restart is needed after it."""

import os
import subprocess
from contextlib import suppress
from pathlib import Path

import pytest

from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.files import Reserve, StorageFullError, free_bytes, require_free


@pytest.fixture
def disk(tmp_path):
    """A file system of 120 MB in memory."""
    made = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=120m", "tmpfs", tmp_path],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if made.returncode:
        pytest.skip(f"NOT TESTED: a full disk; no file system can be mounted: {made.stderr}")
    yield tmp_path
    subprocess.run(["umount", "--lazy", tmp_path], check=True)


@pytest.fixture
def catalogue(disk):
    with Catalogue(disk / "a.duckdb", snapshots=disk / "snapshots") as opened:
        yield opened


def fill(disk: Path, left: int = 0) -> Path:
    """Fill a disk up to some bytes."""
    with (disk / "filling").open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, free_bytes(disk) - left - 4096)
    return disk / "filling"


def surveys(catalogue):
    return {one.name for one in catalogue.list_surveys(limit=1000).items}


def written_until_full(catalogue):
    """Create surveys until the disk refuses one; return those that were acknowledged."""
    written = set()
    with suppress(StorageFullError):
        for i in range(1000):  # the log of the database has a page or two
            written.add(catalogue.create_survey(f"s{i}").name)
    assert len(written) < 1000
    return written


def test_a_database_on_a_full_disk_stays_readable_and_recovers_without_a_restart(catalogue, disk):
    catalogue.create_survey("before")
    filling = fill(disk)
    written = {"before"} | written_until_full(catalogue)
    assert surveys(catalogue) == written
    catalogue.create_survey("in the reserve")
    filling.unlink()
    catalogue.create_survey("after")
    assert surveys(catalogue) == written | {"in the reserve", "after"}
    catalogue.snapshot()
    assert (disk / "reserve").stat().st_size > 10 << 20


def test_a_checkpoint_on_a_full_disk_invalidates_nothing_for_long(catalogue, disk):
    for i in range(20):
        catalogue.create_survey(f"s{i}")
    filling = fill(disk)
    with pytest.raises(StorageFullError):
        catalogue.snapshot()
    assert len(surveys(catalogue)) == 20
    catalogue.create_survey("next")
    filling.unlink()
    catalogue.snapshot()
    assert len(surveys(catalogue)) == 21
    path = catalogue.path
    catalogue.close()
    with Catalogue(path, snapshots=disk / "snapshots") as again:
        assert len(surveys(again)) == 21


def test_a_reserve_is_taken_only_where_there_is_room(disk):
    reserve = Reserve(disk / "own", 40 << 20)
    reserve.hold()
    assert (disk / "own").stat().st_blocks * 512 >= 40 << 20
    reserve.release()
    fill(disk, 60 << 20)
    reserve.hold()
    assert not (disk / "own").exists()


def test_too_little_free_space_is_refused_with_both_figures(tmp_path):
    require_free(tmp_path, 1)
    with pytest.raises(StorageFullError, match=r"bytes free; 1,000,000,000,000,000 are needed"):
        require_free(tmp_path, 10**15)
