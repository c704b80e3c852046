"""Many stations and marks, adjusted together.

- ``assembly``: which marker of which station is which mark, and approximate values
- ``mark_evidence``: whether it is a mark, by all stations that should see it
- ``normal_equations``, ``snooping``: solution and tests
- ``adjustment``: the result with reliability and warnings

A network is assembled first and adjusted then: refused stations and exported observations need no
adjustment.
"""

from spheremark.pipelines.model.network import (
    RANGE_BIAS,
    AdjustedNetwork,
    BlockTests,
    Decision,
    Finding,
    LeftOut,
    MarkEvidence,
    Network,
    Refusal,
    Repeat,
    Shared,
)
from spheremark.pipelines.network.adjustment import adjust_network
from spheremark.pipelines.network.assembly import assemble
from spheremark.pipelines.network.comparison import NetworkErrors, compare
from spheremark.pipelines.network.repeated_stops import repeated_stops

__all__ = [
    "RANGE_BIAS",
    "AdjustedNetwork",
    "BlockTests",
    "Decision",
    "Finding",
    "LeftOut",
    "MarkEvidence",
    "Network",
    "NetworkErrors",
    "Refusal",
    "Repeat",
    "Shared",
    "adjust_network",
    "assemble",
    "compare",
    "repeated_stops",
]
