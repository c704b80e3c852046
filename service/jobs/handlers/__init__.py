"""The kinds of jobs: what each one does in a worker process, from an order to rows.

``orders`` is what all have in common; each kind has a module of its own. A new kind is a member of
``JobKind``, a module with its work, and a line in ``KINDS``; its tables are named in ``storage``.
"""

from collections.abc import Mapping

from spheremark.service.jobs.handlers import adjust as adjusting
from spheremark.service.jobs.handlers import calibrate as calibrating
from spheremark.service.jobs.handlers import process as processing
from spheremark.service.jobs.handlers import sites as siting
from spheremark.service.jobs.specification import JobKind, Kind, Log, Options, Order, Outcome

__all__ = ["KINDS", "JobKind", "Kind", "Log", "Options", "Order", "Outcome"]

KINDS: Mapping[JobKind, Kind] = {
    JobKind.PROCESS: Kind(work=processing.work, takes_one_log=True),
    JobKind.ADJUST: Kind(
        work=adjusting.work, options=adjusting.AdjustOptions, gather=adjusting.gather
    ),
    JobKind.CALIBRATE: Kind(work=calibrating.work, begins_with_rig_of_survey=False),
    JobKind.SITE: Kind(work=siting.work, options=siting.SiteOptions, gather=siting.gather),
}
