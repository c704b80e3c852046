"""Folders for temporary files: gone at their end, and of killed processes at the next start."""

import subprocess
import sys

import pytest

from spheremark.storage.scratch import remove_abandoned, scratch

HOLD = (
    "import os, sys, tempfile, time\n"
    "tempfile.tempdir = sys.argv[1]\n"
    "from spheremark.storage.scratch import scratch\n"
    "with scratch() as folder:\n"
    "    (folder / 'large').write_bytes(b'x')\n"
    "    print(folder, flush=True)\n"
    "    time.sleep(60)\n"
)


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return tmp_path


def test_a_folder_is_removed_at_its_end_and_kept_until_then(place):
    (place / "another").mkdir()
    with scratch() as folder:
        assert remove_abandoned() == 0
        assert folder.parent == place
        assert {path.name for path in place.iterdir()} == {"another", folder.name}
    assert [path.name for path in place.iterdir()] == ["another"]


def test_the_folder_of_a_killed_process_is_removed_and_that_of_a_living_one_is_not(place):
    command = [sys.executable, "-c", HOLD, str(place)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        left = process.stdout.readline().strip()
        assert remove_abandoned() == 0
        process.kill()
    assert [str(path) for path in place.iterdir()] == [left]
    assert remove_abandoned() == 1
    assert list(place.iterdir()) == []
