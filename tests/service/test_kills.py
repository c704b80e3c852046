"""A service that is killed at its work loses no log, upload or job, and keeps no run twice."""

import pytest

from tests.service.kills import run


@pytest.mark.parametrize(
    "rounds",
    [
        pytest.param(1, marks=pytest.mark.slow),
        pytest.param(5, marks=pytest.mark.long),  # of the fifth, a worker is killed first
    ],
)
def test_kills_lose_nothing_and_double_nothing(tmp_path, stop, control, rounds):
    faults, about = run(tmp_path, stop.log.read_bytes(), control, rounds=rounds, seed=4)
    assert not faults
    assert about["rounds"] == rounds
    assert about["logs"] >= rounds
    assert about["runs"] >= 1
