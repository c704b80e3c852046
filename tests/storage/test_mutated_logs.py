"""Whatever is wrong with a log, it gives a log or a reason, soon and in little memory."""

import json
import os
import subprocess
import sys

import pytest

N = int(os.environ.get("SPHEREMARK_MUTATED_LOGS", "500"))
UNACCEPTABLE = ("silently empty", "no reason", "angles that are no numbers")


@pytest.mark.slow
def test_mutated_logs_end_with_a_log_or_a_reason():
    command = [sys.executable, "-m", "tests.storage.mutated_logs", str(N), "2"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=3600)
    assert done.returncode == 0, done.stderr[-3000:]
    found = json.loads(done.stdout)
    assert sum(found["outcomes"].values()) == N
    assert not [one for one in found["outcomes"] if one.endswith(UNACCEPTABLE)]
    assert any(one.endswith(": log") for one in found["outcomes"])
    assert found["seconds"] < 5.0
    assert found["peak_bytes"] < 1 << 30
    assert found["kept_blocks"] < 1.0  # blocks of memory for each log: a cache by its bytes shows
