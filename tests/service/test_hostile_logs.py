"""Logs and documents that are sent are read in confined processes, with limits of their own."""

import struct
import time
from concurrent.futures import ThreadPoolExecutor

import psutil
import pytest
import zstandard

from spheremark.pipelines.errors import ControlError, RecordingError, RigError, TruthError
from spheremark.pipelines.model import Origin
from spheremark.storage.imports import uploads
from spheremark.storage.imports.uploads import (
    control_of,
    inspect_upload,
    read_upload,
    rig_of,
    truth_of,
)
from spheremark.storage.recordings import LogOptions, inspect_log

MAGIC = b"\x89MCAP0\r\n"
LARGEST = 1 << 29  # [bytes] of a chunk that the reader still unpacks
END = struct.pack("<BQ", 2, 20) + bytes(20) + MAGIC


def record(opcode, body):
    return struct.pack("<BQ", opcode, len(body)) + body


def chunk(content):
    """A chunk that declares its size truly, packed to almost nothing."""
    packed = zstandard.ZstdCompressor().compress(content)
    head = struct.pack("<QQQI", 0, 0, len(content), 0) + struct.pack("<I", 4) + b"zstd"
    return record(6, head + struct.pack("<Q", len(packed)) + packed)


def bomb(kind):
    """A log of a few kilobytes that stands for half a gigabyte or more."""
    repeated = {
        "zeros": bytes(1 << 20),
        "empty records": record(15, b"") * 100_000,
        "messages": record(5, bytes(22)) * 30_000,
    }[kind]
    return MAGIC + chunk(repeated * (LARGEST // len(repeated))) * 4 + END


@pytest.mark.parametrize("kind", ["zeros", "empty records", "messages"])
def test_a_log_that_unpacks_to_gigabytes_costs_the_service_no_memory(site, kind):
    own = psutil.Process()
    before = own.memory_info().rss
    answer = site.upload(bomb(kind), name="bomb")
    assert answer.status_code == 422, answer.text
    assert answer.json()["code"].startswith("input.recording")
    assert own.memory_info().rss - before < 64 << 20


def test_a_log_beyond_its_limits_is_refused_with_the_limit(monkeypatch, stop):
    monkeypatch.setattr(uploads, "_SECONDS", 0.001)
    monkeypatch.setattr(uploads, "_BYTES_PER_SECOND", 1e12)
    found = inspect_upload(stop.log)
    assert (found.verdict, found.code) == ("refused", RecordingError.code)
    assert "took more than 0.001" in found.reasons[0]
    with pytest.raises(RecordingError, match=r"took more than 0\.001"):
        read_upload(stop.log, LogOptions(), Origin(name="a", digest="b"))


def test_the_report_of_an_upload_is_that_of_the_reader(stop):
    options = LogOptions(lidar_offset_s=0.001)
    assert (
        inspect_upload(stop.log, options).to_mapping()
        == inspect_log(stop.log, options).to_mapping()
    )


@pytest.mark.parametrize(
    ("parse", "text", "error"),
    [
        (rig_of, "[" * 100_000, RigError),
        (rig_of, '{"T_head_lidar": 3}', RigError),
        (truth_of, '{"format": "x"}', TruthError),
        (control_of, "mark,x_m\na,1\n", ControlError),
        (control_of, "a\x00,1,2,3\n" * 3, ControlError),
    ],
)
def test_a_refused_document_has_the_error_of_its_kind(parse, text, error):
    with pytest.raises(error) as found:
        parse(text)
    assert type(found.value) is error


def test_many_bombs_at_once_leave_the_service_responsive(site):
    content = bomb("messages")
    with ThreadPoolExecutor(6) as threads:
        bombs = [threads.submit(site.upload, content + bytes([n]), f"b{n}") for n in range(6)]
        slowest = 0.0
        while not all(one.done() for one in bombs):
            begin = time.monotonic()
            assert site.client.get("/healthz").status_code == 200
            slowest = max(slowest, time.monotonic() - begin)
        assert {one.result().status_code for one in bombs} == {422}
    assert slowest < 10.0  # the service has no processor of its own here
