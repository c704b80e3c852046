"""The MCAP container: from a file to batches of raw messages, one channel at a time.

Hides records, chunks, compression, checksums, and the readable part of a damaged file. The file is
walked once from front to back, so that an index is neither needed nor trusted; no declared length
is used before it is checked.
"""

from __future__ import annotations

import mmap
import struct
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from isal.isal_zlib import crc32

from spheremark.pipelines.errors import (
    NotFoundError,
    NotMcapError,
    RecordingError,
    TruncatedRecordingError,
)
from spheremark.pipelines.model import Nanos
from spheremark.storage.recordings.chunks import Chunks
from spheremark.storage.recordings.records import (
    CHANNEL,
    CHUNK,
    DATA_END,
    FOOTER,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    RECORD_HEAD,
    SCHEMA,
    Octets,
    text,
    walk,
)

_OF_USE, _OF_CHUNKS, _ENDS = 1, 2, 3
_USES = np.zeros(256, np.uint8)  # of records, by their opcodes
_USES[[SCHEMA, CHANNEL, MESSAGE]] = _OF_USE
_USES[CHUNK] = _OF_CHUNKS
_USES[[FOOTER, DATA_END]] = _ENDS
_KEEP_MAPPED = 1 << 25  # [bytes] pages behind this distance are given back
_MORE = 1.1  # margin of the expansion of a file over that of its first chunks
_EXPANSION_MAX = 10.0  # largest expansion for which memory is reserved in advance
_RECORDS_MAX = 50_000_000  # chunks among them: a day of 500 messages a second
_UNPACKED_MAX = (
    1 << 29,
    100,
)  # [bytes] of all chunks, and per byte of the file; 10 is usual
RECOVER = "use what is readable with --recover (recover=true in a request)"


@dataclass(frozen=True, slots=True, kw_only=True)
class Channel:
    """One topic of a recording, with the description of its messages.

    Attributes
    ----------
    topic : str
        Name of the topic.
    encoding : str
        How messages are encoded: ``cdr``, ``ros1``, ``protobuf``, ``json``.
    schema : str
        Name of the message type; empty when the channel has none.
    schema_encoding : str
        How the definition is written: ``ros2msg``, ``ros2idl``, ``protobuf``, ``jsonschema``.
    definition : bytes
        The definition itself.
    """

    topic: str
    encoding: str
    schema: str
    schema_encoding: str
    definition: bytes


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Batch:
    """Consecutive messages of one channel as windows into one buffer.

    Attributes
    ----------
    channel : Channel
        The channel.
    octets : (size,) uint8
        The buffer; valid until the next batch.
    starts : (n,)
        First byte of each message's data.
    lengths : (n,)
        Length of each message's data [bytes].
    log_times_ns : (n,)
        When each message was recorded.
    """

    channel: Channel
    octets: Octets
    starts: Nanos
    lengths: Nanos
    log_times_ns: Nanos

    def __iter__(self) -> Iterator[tuple[Octets, int]]:
        """Yield data and log time of each message."""
        for start, length, log_time in zip(
            self.starts.tolist(), self.lengths.tolist(), self.log_times_ns.tolist(), strict=True
        ):
            yield self.octets[start : start + length], log_time


@dataclass(slots=True)
class Container:
    """A recording during and after its walk.

    Attributes
    ----------
    octets : (size,) uint8
        The whole file.
    mapping : mmap or None
        What the bytes are mapped through, when they are.
    file : int or None
        Descriptor of the file, when there is one.
    channels : dict of int to Channel
        By identifier, as far as the walk has come.
    """

    octets: Octets
    mapping: mmap.mmap | None = None
    file: int | None = None
    channels: dict[int, Channel] = field(default_factory=dict)
    _source: Chunks = field(init=False)
    _schemas: dict[int, tuple[str, str, bytes]] = field(default_factory=dict)
    _first_ns: int | None = None
    _last_ns: int = 0
    _released: int = 0
    _n_records: int = 0
    _n_unpacked: int = 0

    def __post_init__(self) -> None:
        found = self.octets[: len(MAGIC)].tobytes()
        if found != MAGIC:
            raise NotMcapError(
                f"The file begins with {found!r}, not with {MAGIC!r}: it is not an MCAP file."
            )
        self._source = Chunks(self.octets, self.file)

    @property
    def size(self) -> int:
        """Length of the file [bytes]."""
        return len(self.octets)

    @property
    def likely_size(self) -> int:
        """Length of the file if it were not compressed, judged by its first chunks [bytes]."""
        expansion = self._source.expansion
        likely = min(_MORE * expansion, _EXPANSION_MAX) if expansion > 1.0 else 1.0
        return int(likely * self.size)

    @property
    def topics(self) -> dict[str, Channel]:
        """Channel of each topic, as far as the walk has come."""
        return {channel.topic: channel for channel in self.channels.values()}

    def batches(self) -> Iterator[Batch]:
        """Yield all messages, in the order of the file."""
        position, is_whole = len(MAGIC), True
        plain = False  # whether messages stand outside chunks
        while is_whole and position < self.size:
            rows, position, is_whole = walk(self.octets, position)
            self._count(len(rows), 0)
            for alike in _runs(rows[_USES[rows[:, 0]] > 0]):
                opcode, start, length = alike[0, :3].tolist()
                if opcode == FOOTER:
                    return self._check_end(start + length)
                if opcode == CHUNK:
                    yield from self._chunked(alike)
                elif opcode != DATA_END:
                    plain |= bool((alike[:, 0] == MESSAGE).any())
                    yield from self._group(self.octets, alike)
                elif plain:
                    self._check_data(start, length)
                self._release(int(alike[-1, 1:3].sum()))
        what = "the file ends without its footer" if is_whole else "a record is cut"
        raise self._truncated(position, what)

    def _chunked(self, rows: Nanos) -> Iterator[Batch]:
        """Yield the messages of chunks that follow each other."""
        for stretch in self._source.stretches(rows):
            self._count(len(stretch.rows), len(stretch.octets))
            yield from self._group(stretch.octets, stretch.rows)
            if stretch.damage is not None:
                raise self._truncated(*stretch.damage)

    def _count(self, n_records: int, n_unpacked: int) -> None:
        """Refuse more records, or more unpacked bytes, than any recording of this size has."""
        self._n_records += n_records
        self._n_unpacked += n_unpacked
        most = _UNPACKED_MAX[0] + _UNPACKED_MAX[1] * self.size
        if self._n_records > _RECORDS_MAX or self._n_unpacked > most:
            raise RecordingError(
                f"The recording has over {self._n_records:,} records, of {self._n_unpacked:,} "
                f"unpacked bytes; {_RECORDS_MAX:,} and {most:,} are the most. Record less at once."
            )

    def _group(self, octets: Octets, rows: Nanos) -> Iterator[Batch]:
        """Register schemas and channels of some records, then yield their messages by channel."""
        kinds = rows[:, 0]
        for opcode, start, length in rows[(kinds == SCHEMA) | (kinds == CHANNEL), :3].tolist():
            self._register(opcode, octets[start : start + length].tobytes())
        rows = rows[kinds == MESSAGE]
        if not len(rows):
            return
        self._last_ns = max(self._last_ns, int(rows[:, 4].max()))
        first = int(rows[:, 4].min())
        self._first_ns = first if self._first_ns is None else min(first, self._first_ns)
        for identifier in np.flatnonzero(np.bincount(rows[:, 3])).tolist():
            if (channel := self.channels.get(identifier)) is None:
                continue
            mine = rows[rows[:, 3] == identifier]
            yield Batch(
                channel=channel,
                octets=octets,
                starts=mine[:, 1] + MESSAGE_HEAD,
                lengths=mine[:, 2] - MESSAGE_HEAD,
                log_times_ns=mine[:, 4],
            )

    def _register(self, opcode: int, body: bytes) -> None:
        """Register a schema or a channel; a malformed one costs its channel, not the file."""
        try:
            if opcode == SCHEMA:
                name, at = text(body, 2)
                encoding, at = text(body, at)
                (length,) = struct.unpack_from("<I", body, at)
                schema = (name, encoding, body[at + 4 : at + 4 + length])
                self._schemas[int.from_bytes(body[:2], "little")] = schema
                return
            identifier, schema_id = struct.unpack_from("<HH", body)
            topic, at = text(body, 4)
            encoding, at = text(body, at)
        except (struct.error, ValueError):
            return
        name, schema_encoding, definition = self._schemas.get(schema_id, ("", "", b""))
        self.channels[identifier] = Channel(
            topic=topic,
            encoding=encoding,
            schema=name,
            schema_encoding=schema_encoding,
            definition=definition,
        )

    def _check_data(self, start: int, length: int) -> None:
        """Compare the checksum over the data section, for files whose messages have no other."""
        (expected,) = struct.unpack("<I", self.octets[start : start + length].tobytes()[:4])
        end = start - RECORD_HEAD
        if expected and crc32(self.octets[:end].data) != expected:
            raise self._truncated(end, "the checksum of the data section does not agree")

    def _check_end(self, end: int) -> None:
        """Require the magic bytes after the footer."""
        if self.octets[end : end + len(MAGIC)].tobytes() != MAGIC:
            raise self._truncated(end, "the closing magic bytes are missing")

    def _release(self, position: int) -> None:
        """Release pages that lie far behind, so that memory stays bounded."""
        if self.mapping is None or position - self._released < _KEEP_MAPPED:
            return
        end = position // mmap.PAGESIZE * mmap.PAGESIZE
        self.mapping.madvise(mmap.MADV_DONTNEED, self._released, end - self._released)
        self._released = end

    def _truncated(self, position: int, what: str) -> TruncatedRecordingError:
        """Return the error with the readable part of the file."""
        duration = 0.0 if self._first_ns is None else (self._last_ns - self._first_ns) / 1e9
        return TruncatedRecordingError(
            f"The recording is incomplete: {what}. It is readable up to byte {position:,} of "
            f"{self.size:,}, which is {duration:.1f} s of messages; {RECOVER}."
        )


@contextmanager
def mapped(path: Path) -> Iterator[Container]:
    """Open an MCAP file for one walk."""
    with path.open("rb") as file:
        mapping = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        mapping.madvise(mmap.MADV_SEQUENTIAL)
        # Not closed here: views may outlive the walk, and the last one of them unmaps.
        yield Container(np.frombuffer(mapping, np.uint8), mapping, file.fileno())


@contextmanager
def local_copy(url: str | Path) -> Iterator[Path]:
    """Yield the path of a recording on this machine, copied if it is elsewhere.

    Parameters
    ----------
    url : str or Path
        A file, a folder, or any address of a file that fsspec knows.

    Yields
    ------
    Path
        The recording; a copy lasts until the end of the context.

    Raises
    ------
    NotFoundError
        If there is no such file.
    RecordingError
        If it is a folder that is not on this machine, or no regular file.
    """
    if "://" not in str(url) and ((here := Path(url)).is_file() or here.is_dir()):
        yield here
        return
    import fsspec  # slow to import; a file on a disk needs none of it

    files, inner = fsspec.core.url_to_fs(str(url))
    try:
        details = files.info(inner)
    except FileNotFoundError as error:
        raise NotFoundError(f"There is no recording {url}.") from error
    if details["type"] == "directory":
        raise RecordingError(f"{url} is a folder; name the files in it, or a zip of them.")
    if isinstance(files, fsspec.implementations.local.LocalFileSystem):
        require_file(Path(inner))
        yield Path(inner)
        return
    with tempfile.TemporaryDirectory(prefix="spheremark-") as folder:
        path = Path(folder) / Path(inner).name
        files.get_file(inner, str(path))
        yield path


def require_file(path: Path) -> None:
    """Raise an error for pipes and devices, which may never end.

    Parameters
    ----------
    path : Path
        Something on this machine.

    Raises
    ------
    RecordingError
        If it is a terminal, a pipe, a device or anything else without a length of its own.
    """
    if not path.is_file():
        raise RecordingError(
            f"{path} is no regular file: a recording is read from a disk, not from a pipe or a "
            "device. Save it to a file and name that."
        )


def _runs(rows: Nanos) -> Iterator[Nanos]:
    """Cut records into chunks that follow each other, ends, and all others."""
    uses = _USES[rows[:, 0]]
    is_new = (uses[1:] != uses[:-1]) | (uses[1:] == _ENDS)
    yield from (run for run in np.split(rows, np.flatnonzero(is_new) + 1) if len(run))
