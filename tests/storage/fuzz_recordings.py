"""Coverage-guided fuzzing of containers and message decoders, run by hand for as long as given.

    python tests/storage/fuzz_recordings.py CORPUS [options of libFuzzer, as -max_total_time=1200]

Needs `atheris`, which is no dependency. Kernels run as Python, so that an index out of bounds is
an error. The first byte of an input chooses what the rest is: a file, or a message of a type and
an encoding. An input must give a log or one of the errors that the package documents. Memory grows
by about 2 kB a run: atheris keeps the result of each comparison of NumPy values. The decoders keep
none, as ``mutated_logs`` measures.
"""

import os
import sys
import tempfile
import warnings
from pathlib import Path

os.environ["NUMBA_DISABLE_JIT"] = "1"

import atheris
import numpy as np

with atheris.instrument_imports(include=["spheremark.storage.recordings"]):
    from spheremark.pipelines.errors import SpheremarkError
    from spheremark.pipelines.model import Origin
    from spheremark.storage.recordings import LogOptions
    from spheremark.storage.recordings.container import Channel
    from spheremark.storage.recordings.decoding import Decoders
    from spheremark.storage.recordings.reading import assemble
    from spheremark.storage.recordings.sources import Recording, opened
    from spheremark.storage.recordings.translations import batch_of

_TYPES = (
    ("sensor_msgs/msg/PointCloud2", "cdr"),
    ("velodyne_msgs/msg/VelodyneScan", "cdr"),
    ("sensor_msgs/msg/JointState", "cdr"),
    ("tf2_msgs/msg/TFMessage", "cdr"),
    ("sensor_msgs/msg/Imu", "cdr"),
    ("livox_ros_driver2/msg/CustomMsg", "cdr"),
    ("std_msgs/msg/Float64", "cdr"),
    ("sensor_msgs/msg/PointCloud2", "ros1"),
    ("sensor_msgs/msg/JointState", "ros1"),
    ("livox_ros_driver2/msg/CustomMsg", "ros1"),
    ("foxglove.PointCloud", "json"),
    ("foxglove.FrameTransforms", "json"),
    ("sensor_msgs/msg/Imu", "json"),
)
_PLACE = Path(tempfile.mkdtemp(prefix="spheremark-fuzz-", dir="/dev/shm")) / "log"


def one_input(data: bytes) -> None:
    """Read one input."""
    if len(data) < 2:
        return
    kind, rest = data[0], data[1:]
    options = LogOptions(recover=bool(kind & 0x80))
    try:
        if (kind & 0x7F) < len(_TYPES):
            _read_message(*_TYPES[kind & 0x7F], rest, options)
        else:
            _PLACE.write_bytes(rest)
            with opened(_PLACE, recover=options.recover) as recording:
                decoders = Decoders(recording)
                for batch in recording.batches():
                    decoders.add(batch)
            assemble(decoders, options, Origin(name="fuzz", digest=""))
    except SpheremarkError:
        pass


def _read_message(schema: str, encoding: str, data: bytes, options: LogOptions) -> None:
    """Read an input as two messages of a type, the second with its last byte changed."""
    channel = Channel(
        topic="/topic", encoding=encoding, schema=schema, schema_encoding="", definition=b""
    )
    decoders = Decoders(Recording([]))
    other = data[:-1] + bytes([data[-1] ^ 1])
    decoders.add(batch_of(channel, [data, other], [10**18, 10**18 + 10**8]))
    for role in (decoders.joints, decoders.numbers, decoders.frames, decoders.ahrs):
        for decoder in role.values():
            decoder.series()
    for lidar in decoders.lidars.values():
        lidar.returns()
    decoders.all_notes()
    assemble(decoders, options, Origin(name="fuzz", digest=""))


def seed(corpus: Path) -> None:
    """Write a file of each container, and a message of each type, as inputs to begin with."""
    from rosbags.rosbag1 import Writer as Bag1

    from tests.storage.recorder import T0, encoded, frames, imu, record, small_log
    from tests.storage.test_recordings_of_others import MOUNT, as_ros1, rosbag1, rosbag2

    rng = np.random.default_rng(2)
    items = [("/tf", T0, frames(MOUNT)), *small_log(rng)[:12], ("/imu", T0, imu(T0, (0, 0, 0, 1)))]
    corpus.mkdir(parents=True, exist_ok=True)
    place = corpus.parent / "seed"
    files = {
        "mcap": record(place.with_suffix(".mcap"), items, chunk_size=2000, enable_crcs=False),
        "bag": rosbag1(place.with_suffix(".bag"), items, next(iter(Bag1.CompressionFormat))),
        "plain": rosbag1(place.with_suffix(".plain"), items),
        "db3": next(rosbag2(place.with_suffix(".db3"), items).glob("*.db3")),
    }
    for name, path in files.items():
        (corpus / name).write_bytes(b"\x7f" + path.read_bytes())
    for _, _, message in items:
        schema, data = encoded(message)
        for number, (kind, encoding) in enumerate(_TYPES):
            if kind == schema and encoding != "json":
                body = data if encoding == "cdr" else as_ros1(message)
                (corpus / f"message-{number}").write_bytes(bytes([number]) + body)
    link = b'{"transforms": [{"timestamp": {"sec": 1, "nsec": 2}, "parent_frame_id": "a", '
    (corpus / "json").write_bytes(bytes([11]) + link + b'"child_frame_id": "b"}]}')


def main() -> None:
    """Seed the corpus and fuzz."""
    warnings.simplefilter("ignore")
    corpus = Path(sys.argv[1])
    if not corpus.exists():
        seed(corpus)
    atheris.Setup([*sys.argv, "-timeout=5", "-rss_limit_mb=1024"], one_input)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
