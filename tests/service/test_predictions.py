"""Searches of plans run in processes with limits of time and memory."""

import os
import threading
import time

import numpy as np
import pytest

from spheremark.pipelines.errors import SolveError
from spheremark.pipelines.progress import checked_by
from spheremark.service.errors import PredictionTimeoutError
from spheremark.service.planning.predictions import Predictions

PATIENCE = 300.0  # [s] ends a test that would hang; one that passes never waits for it


@pytest.fixture(scope="module")
def predictions():
    found = Predictions(n_processes=1, seconds=PATIENCE, memory_bytes=1 << 30)
    yield found
    found.close()


@pytest.mark.parametrize(("function", "argument"), [(np.ones, 1 << 28), (os._exit, 9)])
def test_a_search_that_needs_too_much_memory_is_refused(predictions, function, argument):
    with pytest.raises(SolveError, match="more than 1024 MiB of memory"):
        predictions.run(function, argument)
    assert predictions.run(len, "four") == 4


def test_the_process_of_a_search_ends_when_its_client_leaves(predictions):
    before = predictions.run(os.getpid)
    leave = threading.Event()
    threading.Timer(0.5, leave.set).start()

    def look():
        if leave.is_set():
            raise InterruptedError

    with checked_by(look), pytest.raises(InterruptedError):
        predictions.run(time.sleep, PATIENCE)
    assert predictions.run(os.getpid) != before


def test_a_search_ends_at_its_time_limit():
    predictions = Predictions(n_processes=1, seconds=0.2, memory_bytes=1 << 30)
    with pytest.raises(PredictionTimeoutError, match=r"0\.2 s, its time limit"):
        predictions.run(time.sleep, PATIENCE)
    predictions.close()


def test_processes_that_were_never_needed_are_closed_too():
    Predictions(n_processes=1, seconds=1.0, memory_bytes=1 << 30).close()
