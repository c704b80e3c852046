"""Readers of logs and of small documents; run in processes forked from one that has loaded them.

Everything that they need is imported here: once confined, a process can import nothing.
"""

from __future__ import annotations

import codecs
import importlib
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np

from spheremark.pipelines.compilation import compile_in_memory, load_kernels
from spheremark.pipelines.model import Firings, Origin, ScanLog
from spheremark.pipelines.scan.rigs import rig_to_mapping, tilted_vlp16
from spheremark.storage.imports import survey_files
from spheremark.storage.recordings import LogOptions, definitions, inspect_log, read_log, write_log

_SECONDS, _N_RETURNS = 13.0, 2000  # of the log that compiles what no earlier process did
_NS = 1_000_000_000
_LOADED_LATE = (
    "dpkt.pcap",
    "mcap.exceptions",
    "mcap_protobuf.decoder",
    "numpy.ma",
    "rosbags.rosbag1.reader",
    "rosbags.serde.errors",
    "rosbags.serde.primitives",
    "rosbags.typesys.msg",
    "scipy.spatial.transform",
    "spheremark.pipelines.scan.stitching",
)
_CODECS = ("ascii", "cp437", "latin-1", "utf-8-sig", "utf-16", "utf-32")  # of zips and of JSON


def read(_file: IO[bytes], *, name: str, path: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a log; its rig as a mapping."""
    log = read_log(path, LogOptions.from_mapping(options), digest=name)
    return {
        **{field: getattr(log, field) for field in ScanLog.__slots__ if field != "origin"},
        "rig": None if log.rig is None else rig_to_mapping(log.rig),
    }


def inspect(
    _file: IO[bytes],
    *,
    name: str,
    path: str,
    options: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the preflight report of a log."""
    return {"report": inspect_log(path, LogOptions.from_mapping(options), name=name).to_mapping()}


def read_document(
    file: IO[bytes],
    *,
    name: str,  # noqa: ARG001
    kind: str,
    layout: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the text of a document in the form in which this program writes it."""
    text = file.read().decode()
    if kind == "rig":
        return {"text": survey_files.format_rig(survey_files.parse_rig(text))}
    if kind == "truth":
        return {"text": survey_files.format_truth(survey_files.parse_truth(text))}
    marks = survey_files.parse_control(text, survey_files.ControlLayout(**(layout or {})))
    return {"text": survey_files.format_control(marks)}


def prepare() -> None:
    """Load the compiled kernels, or compile them where no earlier process has kept them."""
    definitions.store()
    for module in _LOADED_LATE:
        importlib.import_module(module)
    for one in _CODECS:
        codecs.lookup(one)
    load_kernels("spheremark.pipelines.scan")
    if not load_kernels("spheremark.storage.recordings"):
        _compile()
    compile_in_memory()


def _compile() -> None:
    """Inspect a small log of points, and one of packets."""
    rng = np.random.default_rng(0)
    times = np.linspace(0.0, _SECONDS, 1300)
    log = ScanLog(
        p_lidar=rng.uniform(2.0, 9.0, (_N_RETURNS, 3)).astype(np.float32),
        intensities=np.full(_N_RETURNS, 50.0, np.float32),
        rings=rng.integers(0, 16, _N_RETURNS).astype(np.uint8),
        stamps_lidar_ns=_NS + np.sort(rng.integers(0, int(_SECONDS) * _NS, _N_RETURNS)),
        has_pulse_times=True,
        gimbal_angles=2.0 * np.pi * times / _SECONDS,
        stamps_gimbal_ns=_NS + (times * _NS).astype(np.int64),
        quaternions_imu=np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1)),
        stamps_imu_ns=_NS + (times * _NS).astype(np.int64),
        rig=tilted_vlp16("small", (0.0, 0.0)),
        origin=Origin(name="small", digest=""),
    )
    n_blocks = 12 * 100
    firings = Firings(
        azimuths=(np.arange(n_blocks) * 40 % 36_000).astype(np.uint16),
        distances=np.full((n_blocks, 32), 2000, np.uint16),
        reflectivities=np.full((n_blocks, 32), 50, np.uint8),
        start_ns=_NS,
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "small.mcap"
        for one in (None, firings):
            write_log(log, path, firings=one)
            inspect_log(path)
