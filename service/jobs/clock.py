"""The clock of the loops that drive jobs; imported before one runs, in the service and in workers.

Tornado, and Dask's queues of messages, count waits by the time of day. Where that is set back, what
was to be sent in a moment would wait as long as the clock jumped.
"""

import time

import distributed.batched
from tornado.ioloop import IOLoop

setattr(IOLoop, "time", lambda _loop: time.monotonic())  # noqa: B010  its type forbids to assign
distributed.batched.time = time.monotonic  # its deadlines are those of the loop
