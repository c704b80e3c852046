"""Scan logs: MCAP, bags of ROS and PCAP to ``ScanLog``, that to MCAP, and the preflight report.

A recording is walked once (``sources``, ``container`` for MCAP); messages of other encodings and
types are rewritten (``translations``); each message family is a module that turns its messages
into neutral columns (``families``): ``pointclouds``, ``packets``, ``joint_states``, ``transforms``,
``orientations``. ``reading`` chooses among topics and builds the log. Nothing is executed from a
recording, and every declared length is checked before use.
"""

from spheremark.storage.recordings.closed import closed_logs
from spheremark.storage.recordings.container import local_copy, require_file
from spheremark.storage.recordings.options import LogOptions
from spheremark.storage.recordings.preflight import Preflight, TopicReport, inspect_log
from spheremark.storage.recordings.reading import LogFile, diagnosis, read_log
from spheremark.storage.recordings.sources import file_digest
from spheremark.storage.recordings.writing import write_log

__all__ = [
    "LogFile",
    "LogOptions",
    "Preflight",
    "TopicReport",
    "closed_logs",
    "diagnosis",
    "file_digest",
    "inspect_log",
    "local_copy",
    "read_log",
    "require_file",
    "write_log",
]
