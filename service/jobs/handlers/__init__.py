"""The kinds of jobs: one module for each, with a handler that runs in a worker process.

A new kind is a member of ``JobKind``, a module with its handler, and a line in ``KINDS``; its
tables are named in ``storage``.
"""

from collections.abc import Mapping

from spheremark.service.jobs.handlers import adjust, calibrate, process, sites
from spheremark.service.jobs.specification import (
    JobKind,
    JobResult,
    JobSpecification,
    Kind,
    Log,
    Options,
    Reading,
)

__all__ = ["KINDS", "JobKind", "JobResult", "JobSpecification", "Kind", "Log", "Options", "Reading"]

KINDS: Mapping[JobKind, Kind] = {
    JobKind.PROCESS: Kind(handle=process.handle, takes_one_log=True, options=Reading),
    JobKind.ADJUST: Kind(handle=adjust.handle, options=adjust.AdjustOptions, gather=adjust.gather),
    JobKind.CALIBRATE: Kind(
        handle=calibrate.handle, begins_with_rig_of_survey=False, options=Reading
    ),
    JobKind.SITE: Kind(handle=sites.handle, options=sites.SiteOptions, gather=sites.gather),
}
