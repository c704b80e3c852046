"""The events of each job in order: replayed, then live.

Hides how listeners wait and catch up. Identifiers are milliseconds since 1970 that only
grow, so that they stay in order after a restart of the service without being stored.
"""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict, deque
from collections.abc import AsyncIterator
from dataclasses import dataclass

from spheremark.storage.catalogue.records import JobRecord

_JOBS_KEPT = 500  # jobs whose events are kept for listeners that reconnect
_EVENTS_KEPT = 200  # of each job; its end is always among them


@dataclass(frozen=True, slots=True, kw_only=True)
class JobEvent:
    """An event: the state of a job at that time."""

    number: int
    job: JobRecord


class EventLog:
    """The events since the service started; used on its event loop alone."""

    def __init__(self) -> None:
        self._events: OrderedDict[str, deque[JobEvent]] = OrderedDict()
        self._number = 0
        self._bell = asyncio.Condition()
        self._closed = False

    async def add(self, job: JobRecord) -> None:
        """Append the state of a job and wake the listeners."""
        self._number = max(self._number + 1, time.time_ns() // 1_000_000)
        event = JobEvent(number=self._number, job=job)
        self._events.setdefault(job.job_id, deque(maxlen=_EVENTS_KEPT)).append(event)
        while len(self._events) > _JOBS_KEPT:
            self._events.popitem(last=False)
        async with self._bell:
            self._bell.notify_all()

    async def close(self) -> None:
        """End all listeners."""
        self._closed = True
        async with self._bell:
            self._bell.notify_all()

    def since(self, number: int, job_id: str | None = None) -> list[JobEvent]:
        """Return the events after a number, of one job or of all, in order."""
        logs = self._events.values() if job_id is None else [self._events.get(job_id, deque())]
        found = [event for log in logs for event in log if event.number > number]
        return sorted(found, key=lambda event: event.number)

    async def follow(self, number: int, job_id: str | None = None) -> AsyncIterator[JobEvent]:
        """Yield the events after a number as they come, until the job's last or the end."""
        while True:
            found = self.since(number, job_id)
            for event in found:
                number = event.number
                yield event
                if event.job.status.is_final and job_id is not None:
                    return
            async with self._bell:
                if self._closed:
                    return
                if not self.since(number, job_id):
                    await self._bell.wait()
