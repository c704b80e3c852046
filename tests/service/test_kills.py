"""A service that is killed at its work loses no log, upload or job, and keeps no run twice."""

import pytest

from tests.service.kills import run

ROUNDS = 5  # of the fifth, a worker is killed first


@pytest.mark.slow
def test_kills_lose_nothing_and_double_nothing(tmp_path, stop, control):
    faults, about = run(tmp_path, stop.log.read_bytes(), control, rounds=ROUNDS, seed=4)
    assert not faults
    assert about["rounds"] == ROUNDS
    assert about["logs"] >= ROUNDS
    assert about["runs"] >= 1
