"""The records of jobs when the database is busy: news of a beginning that come after the end."""

import asyncio
import threading
from types import SimpleNamespace

from spheremark.service.jobs.handlers import JobResult
from spheremark.service.jobs.queue import JobQueue
from spheremark.service.settings import Settings
from spheremark.storage.catalogue.catalogue import Catalogue

PATIENCE = 120.0  # [s] ends a test that would hang; one that passes never waits for it
STARTED = {"event": "started", "percent": 0.0, "message": "Started.", "worker": "tcp://far"}


def hold(catalogue, until):
    """Keep all others from writing, in a thread of its own."""
    has_begun = threading.Event()

    def write():
        with catalogue.writing():
            has_begun.set()
            until.wait(PATIENCE)

    threading.Thread(target=write).start()
    assert has_begun.wait(PATIENCE)


async def outrun(queue, catalogue, job):
    """Let a job end before the news of its beginning, both while another writes."""
    done, free = asyncio.get_running_loop().create_future(), threading.Event()
    asked = asyncio.Event()

    def submit(*_, **__):
        asked.set()
        return done

    queue._client = SimpleNamespace(submit=submit)  # of Dask: the work is done elsewhere
    queue._start(job)
    await asked.wait()
    hold(catalogue, free)
    (followed,) = queue._followers
    done.set_result(JobResult(tables={}, message="Found."))
    await asyncio.sleep(0.1)
    recorder = asyncio.create_task(queue._record())
    queue._events_in.put_nowait(STARTED | {"job": job.job_id})
    await asyncio.sleep(0.1)
    free.set()
    await followed
    recorder.cancel()
    return [event.job.status for event in queue.events.since(0, job.job_id)]


def test_a_job_that_ends_before_the_news_of_its_beginning_is_recorded_once(tmp_path):
    with Catalogue(tmp_path / "rows.duckdb", snapshots=tmp_path) as catalogue:
        survey = catalogue.create_survey("busy").survey_id
        for _ in range(3):
            queue = JobQueue(Settings(data=tmp_path), catalogue, tmp_path)
            job = catalogue.create_job("adjust", survey=survey, recording_id=None, config={})
            states = asyncio.run(outrun(queue, catalogue, job))
            ended = catalogue.get_job(job.job_id)
            assert (ended.status, ended.attempts, ended.message) == ("successful", 1, "Found.")
            assert states[-1] == "successful"
