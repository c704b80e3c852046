"""The frozen values that flow through the pipeline: scan, marker, station.

A network's values are in ``network``; those of a plan are in ``placement.plan``.
"""

from spheremark.pipelines.model.arrays import (
    RING_UNKNOWN,
    Array,
    Column,
    Index,
    Mask,
    Nanos,
    Rings,
    Shape,
    same_length,
    seal,
)
from spheremark.pipelines.model.marker import (
    MarkerCandidate,
    MarkerCandidates,
    MarkerFit,
    MarkerFits,
    Rejection,
    Status,
    marker_name,
)
from spheremark.pipelines.model.scan import (
    Beams,
    Firings,
    ImuMount,
    Levelling,
    Origin,
    Rig,
    ScanLog,
    StitchedCloud,
    Timed,
)
from spheremark.pipelines.model.station import (
    ControlMarks,
    Exclusion,
    NoFix,
    StationFix,
    StopResult,
    StopTruth,
    SubsetFixes,
    Truth,
)

__all__ = [
    "RING_UNKNOWN",
    "Array",
    "Beams",
    "Column",
    "ControlMarks",
    "Exclusion",
    "Firings",
    "ImuMount",
    "Index",
    "Levelling",
    "MarkerCandidate",
    "MarkerCandidates",
    "MarkerFit",
    "MarkerFits",
    "Mask",
    "Nanos",
    "NoFix",
    "Origin",
    "Rejection",
    "Rig",
    "Rings",
    "ScanLog",
    "Shape",
    "StationFix",
    "Status",
    "StitchedCloud",
    "StopResult",
    "StopTruth",
    "SubsetFixes",
    "Timed",
    "Truth",
    "marker_name",
    "same_length",
    "seal",
]
