"""What a worker is made to do; loads nothing that its job may be loading just then."""

import time

import numpy as np


def take_memory(n_bytes):
    """Fill memory in a worker, as a scan of too many returns would."""
    hoard = np.ones(n_bytes // 8)
    time.sleep(5.0)  # several looks of the process that watches it
    return float(hoard[0])
