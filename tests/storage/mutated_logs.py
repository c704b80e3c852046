"""Logs with wrong bytes, lengths, orders and values, read in a process whose memory is measured.

python -m tests.storage.mutated_logs N SEED      (prints outcomes as JSON)
"""

import gc
import json
import struct
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType
from mcap_protobuf.writer import Writer as ProtobufWriter
from rosbags.rosbag1 import Writer as Bag1

from spheremark.pipelines.errors import SpheremarkError
from spheremark.storage.recordings import LogOptions, inspect_log, read_log
from tests.storage.recorder import (
    T0,
    cloud,
    encoded,
    frames,
    imu,
    record,
    small_log,
    turning,
    velodyne,
)
from tests.storage.test_recordings_of_others import (
    MOUNT,
    foxglove_items,
    rosbag1,
    rosbag2,
)

KINDS = ("flipped", "cut", "inflated", "zeroed", "swapped", "nan", "zero quaternions")
_SMALL_FILES = ("mcap", "lz4", "db3", "bag", "plain bag", "protobuf")


def _items(rng):
    """A complete small log with an AHRS."""
    clouds = [
        ("/points", T0 + k * 10**8, cloud(velodyne(rng), T0 + (k - 1) * 10**8)) for k in (1, 2)
    ]
    level = [("/imu", T0 + k * 10**7, imu(T0 + k * 10**7, (0, 0, 0, 1))) for k in range(8)]
    items = [("/tf_static", T0 - 1, frames(MOUNT)), *clouds, *level, *turning(step=0.01)]
    return sorted(items, key=lambda item: item[1])


def _files(folder, items):
    """The same log in many containers."""
    record(folder / "a.mcap", items, chunk_size=2000, enable_crcs=False)
    record(folder / "b.mcap", items, compression=CompressionType.LZ4, chunk_size=2000)
    (part,) = rosbag2(folder / "c", items).glob("*.db3")
    rosbag1(folder / "d.bag", items, next(iter(Bag1.CompressionFormat)))
    rosbag1(folder / "e.bag", items)
    with (folder / "f.mcap").open("wb") as file, ProtobufWriter(file) as writer:
        for topic, ns, message in foxglove_items(items):
            writer.write_message(topic, message, ns, ns)
    names = ("a.mcap", "b.mcap", part, "d.bag", "e.bag", "f.mcap")
    return {
        kind: (folder / name).read_bytes() for kind, name in zip(_SMALL_FILES, names, strict=True)
    }


def _of_bytes(kind, octets, rng):
    """A file with some bytes changed."""
    wrong = bytearray(octets)
    if kind == "cut":
        return bytes(wrong[: rng.integers(1, len(wrong))])
    for place in rng.integers(8, len(wrong) - 8, rng.integers(1, 8)).tolist():
        if kind == "flipped":
            wrong[place] ^= 1 << int(rng.integers(8))
        elif kind == "zeroed":
            wrong[place : place + 8] = bytes(8)
        else:
            value = int(rng.choice([2**31 - 1, 2**32 - 1, 2**40, 2**63 - 1]))
            wrong[place : place + 8] = struct.pack("<Q", value)
    return bytes(wrong)


def _of_values(kind, items, rng, path):
    """A file whose messages are swapped, or have values that cannot be."""
    changed = list(items)
    if kind == "swapped":
        for i, j in rng.integers(0, len(items), (20, 2)).tolist():
            (a, at, one), (b, then, other) = changed[i], changed[j]
            if a != b and rng.random() < 0.9:  # else on the topics of other types, too
                a, b = b, a
            changed[i], changed[j] = (a, at, other), (b, then, one)
    else:
        pattern = bytes(32) if kind == "zero quaternions" else struct.pack("<4d", *[np.nan] * 4)
        for i in rng.integers(0, len(items), rng.integers(1, len(items))).tolist():
            topic, ns, message = items[i]
            schema, data = encoded(message)
            wrong = bytearray(data)
            is_cloud = topic == "/points"
            if kind == "nan" and is_cloud:
                for place in rng.integers(60, len(wrong) - 4, 40).tolist():
                    wrong[place : place + 4] = struct.pack("<f", np.nan)
            elif not is_cloud:
                place = int(rng.integers(4, max(5, len(wrong) - 32)))
                wrong[place : place + 32] = pattern[: max(0, len(wrong) - place)]
            changed[i] = (topic, ns, (schema, bytes(wrong)))
    return record(path, changed).read_bytes()


def outcome(path, *, recover):
    """Read and inspect a log; return what came of it and the processor time that it took [s]."""
    begin = time.process_time()
    options = LogOptions(recover=recover)
    try:
        found = read_log(path, options)
        is_empty = not len(found.p_lidar) or not np.isfinite(found.p_lidar).all()
        what = "silently empty" if is_empty else "log"
        if not np.isfinite(found.gimbal_angles).all():
            what = "angles that are no numbers"
    except SpheremarkError as error:
        what = error.code if str(error) else "no reason"
    report = inspect_log(path, options)
    if not report.reasons and not report.n_returns:
        what = "silently empty"
    json.dumps(report.to_mapping(), allow_nan=False)
    return what, time.process_time() - begin


def _blocks():
    """Blocks of memory that Python holds."""
    gc.collect()
    return sys.getallocatedblocks()


def main(n, seed):
    """Read so many mutated logs, and print outcomes, the longest time and the most memory."""
    rng = np.random.default_rng(seed)
    items = _items(rng)
    outcomes, longest, blocks = Counter(), 0.0, 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        files, path = _files(folder, items), folder / "mutated"
        outcome(folder / "a.mcap", recover=False)  # kernels are loaded, or compiled
        small_log(rng)
        for k in range(n):
            kind = KINDS[k % len(KINDS)]
            if kind in ("swapped", "nan", "zero quaternions"):
                path.write_bytes(_of_values(kind, items, rng, folder / "changed.mcap"))
            else:
                octets = files[_SMALL_FILES[k // len(KINDS) % len(files)]]
                path.write_bytes(_of_bytes(kind, octets, rng))
            what, seconds = outcome(path, recover=bool(rng.integers(2)))
            outcomes[f"{kind}: {what}"] += 1
            longest = max(longest, seconds)
            if k == n // 2:  # what libraries make once is made
                blocks = _blocks()
    # of this program alone: ru_maxrss begins with that of the process that started it
    (line,) = (one for one in Path("/proc/self/status").read_text().splitlines() if "VmHWM" in one)
    peak = int(line.split()[1]) * 1024
    kept = (_blocks() - blocks) / (n - n // 2)
    found = {"outcomes": outcomes, "seconds": longest, "peak_bytes": peak, "kept_blocks": kept}
    sys.stdout.write(json.dumps(found) + "\n")


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
