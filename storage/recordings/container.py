"""The MCAP container: from a file to batches of raw messages, one channel at a time.

Hides: records, chunks, compression, checksums, and how far a damaged file can be believed. The file
is mapped into memory and walked once from front to back, so that an index is neither needed nor
trusted; no declared length is used before it is checked.
"""

from __future__ import annotations

import hashlib
import mmap
import struct
import tempfile
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import fsspec
import lz4.frame
import numba
import numpy as np
import zstandard
from isal.isal_zlib import crc32
from numpy.typing import NDArray

from pipelines.errors import NotFoundError, NotMcapError, RecordingError, TruncatedRecordingError
from pipelines.values import Nanos

Octets = NDArray[np.uint8]

MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0F
_RECORD_HEAD = 9  # [bytes] opcode and length before the body of a record
_MESSAGE_HEAD = 22  # [bytes] channel, sequence and two times before the data of a message
_ROWS = 1 << 16  # records that one step of the walk reports
_CHUNK_LIMIT = 1 << 29  # [bytes] a larger decompressed chunk is refused, whatever it declares
_KEEP_MAPPED = 1 << 25  # [bytes] pages behind this distance are given back
_BLOCK = 1 << 22  # [bytes] read at a time for the digest
_UNPACKERS = 2  # threads that unpack and check chunks ahead of the walk
_RECOVER = "recover what is readable with `mcap recover` and use the result"


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
        The buffer; valid until the next batch is asked for.
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
        """Give data and log time of each message."""
        for start, length, log_time in zip(
            self.starts.tolist(), self.lengths.tolist(), self.log_times_ns.tolist(), strict=True
        ):
            yield self.octets[start : start + length], log_time


@dataclass(slots=True)
class Container:
    """A recording that is being walked; afterwards, what was seen on the way.

    Attributes
    ----------
    octets : (size,) uint8
        The whole file.
    mapping : mmap or None
        What the bytes are mapped through, when they are.
    pool : ThreadPoolExecutor
        What unpacks and checks chunks ahead of the walk; stopped before the file is given back.
    channels : dict of int to Channel
        By identifier, as far as the walk has come.
    """

    octets: Octets
    mapping: mmap.mmap | None = None
    pool: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(_UNPACKERS))
    channels: dict[int, Channel] = field(default_factory=dict)
    _schemas: dict[int, tuple[str, str, bytes]] = field(default_factory=dict)
    _first_ns: int | None = None
    _last_ns: int = 0
    _released: int = 0

    def __post_init__(self) -> None:
        found = self.octets[: len(MAGIC)].tobytes()
        if found != MAGIC:
            raise NotMcapError(
                f"The file begins with {found!r}, not with {MAGIC!r}: it is not an MCAP file. "
                "Record with `ros2 bag record --storage mcap`, or convert with `mcap convert`."
            )

    @property
    def size(self) -> int:
        """Length of the file [bytes]."""
        return len(self.octets)

    def topics(self) -> dict[str, str]:
        """Return the message type of each topic, as far as the walk has come."""
        return {channel.topic: channel.schema for channel in self.channels.values()}

    def batches(self) -> Iterator[Batch]:
        """Give all messages, in the order of the file.

        Yields
        ------
        Batch
            Messages of one channel.

        Raises
        ------
        TruncatedRecordingError
            When the walk meets damage, after all that is readable before it.
        """
        position = len(MAGIC)
        plain = False  # whether messages stand outside chunks
        while True:
            rows, position, is_whole = _walk(self.octets, position)
            chunked = np.isin(rows[:, 0], (_CHUNK, _FOOTER, _DATA_END)).nonzero()[0]
            chunks = self._unpacked(rows[rows[:, 0] == _CHUNK, 1:3])
            begin = 0
            for end in [*chunked.tolist(), len(rows)]:
                plain |= bool((rows[begin:end, 0] == _MESSAGE).any())
                yield from self._group(self.octets, rows[begin:end])
                begin = end + 1
                if end == len(rows):
                    break
                opcode, start, length = rows[end, :3].tolist()
                if opcode == _FOOTER:
                    return self._check_end(start + length)
                if opcode == _CHUNK:
                    yield from self._chunk(start, next(chunks))
                elif plain:
                    self._check_data(start, length)
                self._release(start + length)
            if not is_whole:
                raise self._truncated(position, "a record is cut")
            if not len(rows):
                raise self._truncated(position, "the file ends without its footer")

    def _group(self, octets: Octets, rows: Nanos) -> Iterator[Batch]:
        """Register schemas and channels of some records, then give their messages by channel."""
        kinds = rows[:, 0]
        for opcode, start, length in rows[(kinds == _SCHEMA) | (kinds == _CHANNEL), :3].tolist():
            self._register(opcode, octets[start : start + length].tobytes())
        rows = rows[kinds == _MESSAGE]
        if not len(rows):
            return
        self._last_ns = max(self._last_ns, int(rows[:, 4].max()))
        first = int(rows[:, 4].min())
        self._first_ns = first if self._first_ns is None else min(first, self._first_ns)
        for identifier in np.unique(rows[:, 3]).tolist():
            if (channel := self.channels.get(identifier)) is None:
                continue
            mine = rows[rows[:, 3] == identifier]
            yield Batch(
                channel=channel,
                octets=octets,
                starts=mine[:, 1] + _MESSAGE_HEAD,
                lengths=mine[:, 2] - _MESSAGE_HEAD,
                log_times_ns=mine[:, 4],
            )

    def _register(self, opcode: int, body: bytes) -> None:
        """Remember a schema or a channel; a malformed one costs its channel, not the file."""
        try:
            if opcode == _SCHEMA:
                name, at = _text(body, 2)
                encoding, at = _text(body, at)
                (length,) = struct.unpack_from("<I", body, at)
                schema = (name, encoding, body[at + 4 : at + 4 + length])
                self._schemas[int.from_bytes(body[:2], "little")] = schema
                return
            identifier, schema_id = struct.unpack_from("<HH", body)
            topic, at = _text(body, 4)
            encoding, at = _text(body, at)
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

    def _unpacked(self, spans: Nanos) -> Iterator[Future[Octets]]:
        """Give the chunks at starts with lengths; the next ones are being unpacked meanwhile."""
        ahead: deque[Future[Octets]] = deque()
        for start, length in spans.tolist():
            ahead.append(self.pool.submit(_unpack_chunk, self.octets[start : start + length]))
            if len(ahead) > _UNPACKERS:
                yield ahead.popleft()
        yield from ahead

    def _chunk(self, start: int, unpacked: Future[Octets]) -> Iterator[Batch]:
        """Give the messages of one chunk."""
        try:
            octets = unpacked.result()
        except (ValueError, struct.error, zstandard.ZstdError, RuntimeError) as error:
            raise self._truncated(start - _RECORD_HEAD, f"a chunk is damaged: {error}") from error
        position, is_whole = 0, True
        while is_whole and position < len(octets):
            rows, position, is_whole = _walk(octets, position)
            yield from self._group(octets, rows)
        if not is_whole:
            raise self._truncated(start - _RECORD_HEAD, "a record in a chunk is cut")

    def _check_data(self, start: int, length: int) -> None:
        """Compare the checksum over the data section, for files whose messages have no other."""
        (expected,) = struct.unpack("<I", self.octets[start : start + length].tobytes()[:4])
        end = start - _RECORD_HEAD
        if expected and crc32(self.octets[:end].data) != expected:
            raise self._truncated(end, "the checksum of the data section does not agree")

    def _check_end(self, end: int) -> None:
        """Require the magic bytes after the footer."""
        if self.octets[end : end + len(MAGIC)].tobytes() != MAGIC:
            raise self._truncated(end, "the closing magic bytes are missing")

    def _release(self, position: int) -> None:
        """Give pages that lie far behind back to the system, so that memory stays bounded."""
        if self.mapping is None or position - self._released < _KEEP_MAPPED:
            return
        end = position // mmap.PAGESIZE * mmap.PAGESIZE
        self.mapping.madvise(mmap.MADV_DONTNEED, self._released, end - self._released)
        self._released = end

    def _truncated(self, position: int, what: str) -> TruncatedRecordingError:
        """Return the error that says how far the file is readable."""
        duration = 0.0 if self._first_ns is None else (self._last_ns - self._first_ns) / 1e9
        return TruncatedRecordingError(
            f"The recording is incomplete: {what}. It is readable up to byte {position:,} of "
            f"{self.size:,}, which is {duration:.1f} s of messages; {_RECOVER}."
        )


@contextmanager
def opened(url: str | Path) -> Iterator[Container]:
    """Open a recording for one walk.

    Parameters
    ----------
    url : str or Path
        A path, or any address that fsspec knows; what is not local is copied first.

    Yields
    ------
    Container
        The recording; its batches are valid as long as it is open.

    Raises
    ------
    NotFoundError
        If there is no such file.
    NotMcapError
        If it does not begin as an MCAP file.
    """
    with local_copy(url) as path, path.open("rb") as file:
        if path.stat().st_size == 0:
            raise NotMcapError(f"{path.name} is empty, not an MCAP file: was the upload cut?")
        mapping = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        mapping.madvise(mmap.MADV_SEQUENTIAL)
        # Not closed by hand: views may outlive the walk, and the last one of them unmaps.
        with ThreadPoolExecutor(_UNPACKERS) as pool:
            yield Container(np.frombuffer(mapping, np.uint8), mapping, pool)


@contextmanager
def local_copy(url: str | Path) -> Iterator[Path]:
    """Give the path of a recording on this machine, copied for the time being if it is elsewhere.

    Parameters
    ----------
    url : str or Path
        A path, or any address that fsspec knows.

    Yields
    ------
    Path
        The local file.

    Raises
    ------
    NotFoundError
        If there is no such file.
    """
    files, inner = fsspec.core.url_to_fs(str(url))
    try:
        details = files.info(inner)
    except FileNotFoundError as error:
        raise NotFoundError(f"There is no recording {url}.") from error
    if details["type"] == "directory":
        raise RecordingError(f"{url} is a folder; name the .mcap file in it.")
    if isinstance(files, fsspec.implementations.local.LocalFileSystem):
        yield Path(inner)
        return
    with tempfile.TemporaryDirectory(prefix="spheremark-") as folder:
        path = Path(folder) / Path(inner).name
        files.get_file(inner, str(path))
        yield path


def file_digest(url: str | Path) -> str:
    """Return the SHA-256 of a file's bytes, in hexadecimal.

    Parameters
    ----------
    url : str or Path
        A path, or any address that fsspec knows.

    Returns
    -------
    str
        64 hexadecimal digits.

    Raises
    ------
    NotFoundError
        If there is no such file.
    """
    digest = hashlib.sha256()
    try:
        with fsspec.open(str(url), "rb") as file:
            while block := file.read(_BLOCK):
                digest.update(block)
    except FileNotFoundError as error:
        raise NotFoundError(f"There is no recording {url}.") from error
    return digest.hexdigest()


def _text(body: bytes, at: int) -> tuple[str, int]:
    """Read a string with its length before it; return it and the place behind it."""
    (length,) = struct.unpack_from("<I", body, at)
    end = at + 4 + length
    if end > len(body):
        raise ValueError("a string is longer than its record")
    return body[at + 4 : end].decode(), end


def _unpack_chunk(body: Octets) -> Octets:
    """Return the records of a chunk, decompressed and checked."""
    head = body[: 8 + 8 + 8 + 4 + 4 + 64].tobytes()
    size, crc = struct.unpack_from("<QI", head, 16)
    compression, at = _text(head, 28)
    (length,) = struct.unpack_from("<Q", head, at)
    packed = body[at + 8 : at + 8 + length]
    if len(packed) != length:
        raise ValueError(f"it declares {length:,} bytes and has {len(packed):,}")
    octets = packed if compression == "" else _decompress(compression, packed, size)
    if len(octets) != size:
        raise ValueError(f"it declares {size:,} bytes of records and holds {len(octets):,}")
    if crc and crc32(octets.data) != crc:
        raise ValueError("its checksum does not agree")
    return octets


def _decompress(compression: str, packed: Octets, size: int) -> Octets:
    """Decompress at most the declared size, which must itself be bearable."""
    if size > _CHUNK_LIMIT:
        raise ValueError(f"it declares {size:,} bytes, more than {_CHUNK_LIMIT:,}")
    if compression == "lz4":
        unpacked = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
    elif compression == "zstd":
        if zstandard.frame_content_size(packed.data) not in (-1, size):
            raise ValueError("its compressed frame declares another size")
        unpacked = zstandard.ZstdDecompressor().decompress(
            packed.data, max_output_size=max(size, 1)
        )
    else:
        raise ValueError(f"its compression {compression!r} is unknown; known: lz4, zstd")
    return np.frombuffer(unpacked, np.uint8)


def _walk(octets: Octets, position: int) -> tuple[Nanos, int, bool]:
    """Return the next records (opcode, start, length, channel, log time), the place behind them
    and whether the walk can go on.
    """  # noqa: D205
    rows = np.empty((min(_ROWS, (len(octets) - position) // _RECORD_HEAD + 1), 5), np.int64)
    n, position, is_whole = _walk_kernel(octets, position, rows)
    return rows[:n], position, is_whole


@numba.njit(cache=True, nogil=True)
def _walk_kernel(octets, position, rows):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Fill rows with records until they are full, the footer is met, or a record is cut."""
    size = len(octets)
    n = 0
    while n < len(rows) and position < size:
        if position + 9 > size:
            return n, position, False
        opcode = octets[position]
        length = np.int64(0)
        for k in range(8):
            length |= np.int64(octets[position + 1 + k]) << (8 * k)
        start = position + 9
        if opcode == 0 or length < 0 or length > size - start or (opcode == 5 and length < 22):
            return n, position, False
        channel = np.int64(-1)
        log_time = np.int64(0)
        if opcode == 5:
            channel = np.int64(octets[start]) | np.int64(octets[start + 1]) << 8
            for k in range(8):
                log_time |= np.int64(octets[start + 6 + k]) << (8 * k)
        rows[n, 0] = opcode
        rows[n, 1] = start
        rows[n, 2] = length
        rows[n, 3] = channel
        rows[n, 4] = log_time
        n += 1
        position = start + length
        if opcode == 2:
            break
    return n, position, True
