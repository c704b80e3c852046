import math
import os
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from spheremark.pipelines.config import StitchingConfig
from spheremark.pipelines.scan.stitching import stitch
from spheremark.pipelines.threads import by_turns, in_processes, side_by_side
from tests.synthetic import crooked_rig, scan_log

PATIENCE = 120.0  # [s] ends a test that would hang; one that passes never waits for it


@pytest.mark.parametrize("n_rows", [0, 1, 7, 49_999, 50_000, 100_001])
def test_every_row_is_done_once_and_in_order(n_rows):
    parts = side_by_side(lambda first, end: np.arange(first, end), n_rows)
    np.testing.assert_array_equal(np.concatenate(parts), np.arange(n_rows))


def test_parts_are_done_at_the_same_time():
    meeting = threading.Barrier(2, timeout=PATIENCE)  # breaks unless both parts get there
    assert len(side_by_side(lambda _first, _end: meeting.wait(), 10, threaded_from=2)) == 2


def test_an_error_in_any_part_reaches_the_caller():
    def fail_late(first, _end):
        if first:
            raise ArithmeticError("the second part")

    with pytest.raises(ArithmeticError, match="the second part"):
        side_by_side(fail_late, 10, threaded_from=2)


@pytest.mark.parametrize("n_rows", [0, 1, 7, 64])
def test_pieces_taken_by_turns_come_in_the_order_of_the_rows(n_rows):
    parts = by_turns(lambda first, end: np.arange(first, end), n_rows, size=3, threaded_from=2)
    np.testing.assert_array_equal(np.concatenate(parts), np.arange(n_rows))
    assert max(len(part) for part in parts) <= 3


def test_a_late_thread_leaves_its_pieces_to_the_other():
    done = threading.Event()

    def work(first, end):
        if first == 0:
            return done.wait(PATIENCE)
        if end == 50:
            done.set()
        return True

    assert all(by_turns(work, 50, size=1, threaded_from=2))


def test_what_fails_by_turns_is_told_when_both_threads_have_stopped():
    with pytest.raises(ValueError, match="piece 7"):
        by_turns(_fail_at_seven, 10, size=1, threaded_from=2)


def _fail_at_seven(first, _end):
    if first == 7:
        raise ValueError("piece 7")


def test_returns_left_out_in_either_half_leave_no_gap():
    rng = np.random.default_rng(4)
    rig = crooked_rig(rng)
    log, _ = scan_log(rng, rig, n=120_000)
    log = replace(log, intensities=np.arange(120_000, dtype=np.float32))  # tells rows apart
    whole = stitch(log, rig, StitchingConfig())
    reach = np.linalg.norm(log.p_lidar, axis=1)
    limits = StitchingConfig(range_min=float(np.quantile(reach, 0.3)))
    part = stitch(log, rig, limits)
    keep = np.isin(whole.intensities, part.intensities)
    assert 50_000 < len(part.p_base) < len(whole.p_base)
    for column in ("p_base", "gimbal_angles", "intensities", "rings", "times"):
        np.testing.assert_array_equal(getattr(part, column), getattr(whole, column)[keep])


def test_seeds_are_worked_on_in_other_processes_and_answered_in_order():
    shares = []
    found = in_processes(
        math.factorial, range(4), n_processes=2, progress=lambda share, _what: shares.append(share)
    )
    assert found == [1, 1, 2, 6]
    assert shares == [0.0, 0.25, 0.5, 0.75, 1.0]


def test_an_error_and_a_cancellation_in_a_process_reach_the_caller():
    with pytest.raises(ValueError, match="negative"):
        in_processes(math.factorial, [3, -1], n_processes=2)

    def cancel(share, _what):
        if share:
            raise KeyboardInterrupt

    for n_processes in (1, 2):
        with pytest.raises(KeyboardInterrupt):
            in_processes(math.factorial, range(5), n_processes=n_processes, progress=cancel)


_WORK_ON_AND_ON = """
import os, time
from pathlib import Path
from spheremark.pipelines.threads import in_processes

def work(folder):
    Path(folder, str(os.getpid())).touch()
    time.sleep(600.0)

if __name__ == "__main__":
    in_processes(work, [os.environ["FOLDER"]] * 2, n_processes=2)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not end them")
def test_processes_end_when_the_command_that_started_them_is_killed(tmp_path):
    script, folder = tmp_path / "work.py", tmp_path / "started"
    script.write_text(_WORK_ON_AND_ON)
    folder.mkdir()
    with subprocess.Popen([sys.executable, script], env=os.environ | {"FOLDER": folder}) as command:
        until(lambda: len(list(folder.iterdir())) == 2)
        command.kill()
    until(lambda: not any(is_running(path.name) for path in folder.iterdir()))


def is_running(pid):
    """Whether a process has not ended; one that is dead but still listed has."""
    status = Path("/proc", pid, "status")
    return status.exists() and "State:\tZ" not in status.read_text()


def until(condition):
    """Wait for a condition."""
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, "it has not come about"
        time.sleep(0.05)
