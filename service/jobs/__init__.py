"""Jobs: the queue, the worker processes, and what each kind of job does there."""
