"""A scheduler with one worker, until its standard input ends.

Services of most tests compute there: a worker of its own, with its reader, takes a second or more.
"""

import asyncio
import sys

import dask
from distributed import Nanny, Scheduler

dask.config.set(
    {"distributed.worker.profile.enabled": False, "distributed.admin.tick.interval": "1s"}
)  # as in the service: nothing is computed where nothing is asked for


async def main():
    """Print the address of the scheduler, and serve."""
    async with (
        Scheduler(host="127.0.0.1", port=0, dashboard=False) as scheduler,
        Nanny(scheduler.address, nthreads=1, dashboard=False, memory_limit=0),
    ):
        sys.stdout.write(scheduler.address + "\n")
        sys.stdout.flush()
        await asyncio.to_thread(sys.stdin.read)


if __name__ == "__main__":
    asyncio.run(main())
