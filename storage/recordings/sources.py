"""Where messages come from: MCAP, rosbag2 (.db3), ROS 1 bags, PCAP; single, in folders or in zips.

A file is known by its first bytes, never by its name. The parts of a folder or a zip are read one
after the other as one log. Declared sizes are checked against those of files before they are used.
"""

from __future__ import annotations

import bz2
import hashlib
import lzma
import re
import shutil
import sqlite3
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, BinaryIO, Protocol
from urllib.parse import quote

import lz4.frame
import zstandard

from spheremark.pipelines.errors import (
    NotFoundError,
    NotMcapError,
    RecordingError,
    TruncatedRecordingError,
)
from spheremark.storage.recordings import packets
from spheremark.storage.recordings.container import (
    RECOVER,
    Batch,
    Channel,
    local_copy,
    mapped,
)
from spheremark.storage.recordings.messages import scan_of_packets
from spheremark.storage.recordings.records import MAGIC
from spheremark.storage.recordings.translations import batch_of

if TYPE_CHECKING:
    from rosbags.rosbag1.reader import Header

PCAP_TOPIC, _PCAP_FRAME = "/velodyne_packets", "velodyne"
_HEAD = 16  # [bytes] that show what a file is
_BATCH = 1 << 24  # [bytes] of messages that are decoded together
_TIME_LIMIT = 1 << 63  # [ns] in the year 2262
_PIECE_LIMIT = 1 << 29  # [bytes] a larger decompressed chunk or message is refused
_EXPANSION_MAX = 100  # of a zip; what recorders write expands by 10 at most
_ZSTD = b"\x28\xb5\x2f\xfd"
_PLAIN = (ValueError, KeyError, TypeError, EOFError, OverflowError, RuntimeError, OSError)
_PCAPS = (b"\xa1\xb2\xc3\xd4", b"\xd4\xc3\xb2\xa1", b"\xa1\xb2\x3c\x4d", b"\x4d\x3c\xb2\xa1")
_PACKET = 1206  # [bytes] of data from a Velodyne
_PACKET_HEAD = b"\xff\xee"
_SCAN_PACKETS = 76  # of a revolution at 10 Hz

Item = tuple[Channel, int, bytes]  # channel, log time [ns], message


class Source(Protocol):
    """One file of messages, walked once."""

    @property
    def size(self) -> int:
        """Length of the file [bytes]."""

    @property
    def likely_size(self) -> int:
        """Length of the file if it were not compressed [bytes]."""

    @property
    def topics(self) -> dict[str, Channel]:
        """Channel of each topic, as far as the walk has come."""

    def batches(self) -> Iterator[Batch]:
        """Yield all messages, in the order of the file."""


@dataclass(slots=True)
class Messages:
    """A file that a library reads message by message.

    Attributes
    ----------
    path : Path
        The file.
    read : callable
        Yields its messages; enters channels without messages in the mapping that it is given.
    topics : dict of str to Channel
        Channel of each topic, as far as the walk has come.
    """

    path: Path
    read: Callable[[Path, dict[str, Channel]], Iterator[Item]]
    topics: dict[str, Channel] = field(default_factory=dict)

    @property
    def size(self) -> int:
        """Length of the file [bytes]."""
        return self.path.stat().st_size

    @property
    def likely_size(self) -> int:
        """Length of the file if it were not compressed [bytes]."""
        return self.size

    def batches(self) -> Iterator[Batch]:
        """Yield all messages, some at a time; what comes before damage is yielded too."""
        waiting: dict[Channel, tuple[list[bytes], list[int]]] = {}
        n_octets = n_messages = 0
        damage: Exception | None = None
        stream = self.read(self.path, self.topics)
        while damage is None:
            try:
                channel, log_time, data = next(stream)
            except StopIteration:
                break
            except _damages() as error:
                damage = error
                break
            self.topics[channel.topic] = channel
            parts, log_times = waiting.setdefault(channel, ([], []))
            parts.append(data)
            log_times.append(log_time)
            n_octets, n_messages = n_octets + len(data), n_messages + 1
            if n_octets >= _BATCH:
                yield from _batches(waiting)
                n_octets = 0
        yield from _batches(waiting)
        if damage is not None:
            raise TruncatedRecordingError(
                f"The recording is incomplete or damaged: {str(damage).strip(' .')}. "
                f"{n_messages:,} messages are before the damage; {RECOVER}."
            ) from damage


def _batches(waiting: dict[Channel, tuple[list[bytes], list[int]]]) -> Iterator[Batch]:
    """Yield what is waiting, channel by channel."""
    for channel, (parts, log_times) in waiting.items():
        yield batch_of(channel, parts, log_times)
    waiting.clear()


def _damages() -> tuple[type[Exception], ...]:
    """Return what libraries raise at damaged files."""
    from dpkt import Error
    from rosbags.rosbag1.reader import ReaderError

    return (ReaderError, Error, sqlite3.Error, struct.error, zstandard.ZstdError, *_PLAIN)


@dataclass(slots=True)
class Recording:
    """The parts of a log, walked one after the other.

    Attributes
    ----------
    sources : sequence of Source
        The parts.
    recover : bool
        Whether a damaged part is used up to its damage.
    lost : list of str
        What was lost so far, as sentences.
    """

    sources: Sequence[Source]
    recover: bool = False
    lost: list[str] = field(default_factory=list)

    @property
    def size(self) -> int:
        """Length of all parts [bytes]."""
        return sum(source.size for source in self.sources)

    @property
    def likely_size(self) -> int:
        """Length of all parts if they were not compressed [bytes]."""
        return sum(source.likely_size for source in self.sources)

    @property
    def channels(self) -> dict[str, Channel]:
        """Channel of each topic, as far as the walk has come."""
        return {topic: one for source in self.sources for topic, one in source.topics.items()}

    def topics(self) -> dict[str, str]:
        """Return the message type of each topic, as far as the walk has come."""
        return {topic: one.schema for topic, one in self.channels.items()}

    def batches(self) -> Iterator[Batch]:
        """Yield all messages, part by part."""
        for source in self.sources:
            try:
                yield from source.batches()
            except TruncatedRecordingError as error:
                if not self.recover:
                    raise
                self.lost.append(str(error).split(f"; {RECOVER}")[0].rstrip(".") + ".")


@contextmanager
def opened(
    url: str | Path, beside: Sequence[Path] = (), *, recover: bool = False
) -> Iterator[Recording]:
    """Open a log for one walk: a file, a folder or a zip, and files beside it."""
    with ExitStack() as stack:
        sources: list[Source] = []
        for one in (url, *beside):
            sources += _sources(stack.enter_context(local_copy(one)), stack)
        yield Recording(sources, recover)


def _sources(path: Path, stack: ExitStack) -> list[Source]:
    """Return what reads a file, or the parts of a folder or a zip."""
    if path.is_dir():
        return _of_folder(path, stack)
    with path.open("rb") as file:
        head = file.read(_HEAD)
    if head.startswith(b"PK\3\4"):
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="spheremark-")))
        _unzip(path, folder)
        return _of_folder(folder, stack, path.name)
    source = _source(path, head, stack)
    if source is None:
        raise NotMcapError(_complaint(path, head))
    return [source]


def _source(path: Path, head: bytes, stack: ExitStack) -> Source | None:
    """Return what reads a single file, or None if it is no log."""
    if head.startswith(_ZSTD):
        path, head = _decompressed(path, stack)
    if head.startswith(MAGIC):
        return stack.enter_context(mapped(path))
    if head.startswith(b"SQLite format 3\0"):
        return Messages(path, _of_rosbag2)
    if head.startswith(b"#ROSBAG V2."):
        return Messages(path, _of_rosbag1)
    if head.startswith((b"\x0a\x0d\x0d\x0a", *_PCAPS)):
        return Messages(path, _of_pcap)
    return None


def _complaint(path: Path, head: bytes) -> str:
    """Return the reason why a file is no log."""
    if not head:
        return f"{path.name} is empty, not an MCAP file: was the upload cut?"
    if head.startswith(_PACKET_HEAD):
        return (
            f"{path.name} has the packets of a Velodyne without the times at which they came: save "
            "them as a PCAP (tcpdump, Wireshark), and read it with the gimbal's log (--pcap)."
        )
    found = head[:8].decode("latin-1")
    return (
        f"The file begins with {found!r}: it is not an MCAP file, nor a rosbag2 (.db3), a ROS 1 "
        "bag, a PCAP of a Velodyne, or a zip of these. The cloud of a single scan is read by "
        "`spheremark spheres`."
    )


def _of_folder(folder: Path, stack: ExitStack, name: str = "") -> list[Source]:
    """Return what reads the parts of a folder, in the order of their names."""
    files = sorted((one for one in folder.rglob("*") if one.is_file()), key=_natural)
    sources: list[Source] = []
    for path in files:
        with path.open("rb") as file:
            head = file.read(_HEAD)
        if (source := _source(path, head, stack)) is not None:
            sources.append(source)
    if not sources:
        raise NotMcapError(
            f"{name or folder.name} holds no log. Found: "
            f"{', '.join(one.name for one in files[:10]) or 'nothing'}. Expected the .mcap, .db3, "
            ".bag or .pcap files of one recording."
        )
    return sources


def _natural(path: Path) -> list[tuple[int, str]]:
    """Return the key of a natural order: numbers in names count as numbers."""
    parts = re.split(r"(\d{1,18})", str(path))
    return [(int(one), "") if i % 2 else (0, one) for i, one in enumerate(parts)]


def _unzip(path: Path, folder: Path) -> None:
    """Extract the members of a zip, if they can be as large as they declare."""
    try:
        with zipfile.ZipFile(path) as archive:
            members = [one for one in archive.infolist() if not one.is_dir()]
            n_octets, room = sum(one.file_size for one in members), shutil.disk_usage(folder).free
            if n_octets > min(_EXPANSION_MAX * path.stat().st_size, room):
                raise RecordingError(
                    f"The zip declares {n_octets:,} bytes, more than {_EXPANSION_MAX} times its "
                    f"own {path.stat().st_size:,} or than the {room:,} that are free."
                )
            members.sort(key=lambda one: _natural(Path(one.filename)))
            for number, member in enumerate(members):
                place = folder / f"{number:06d}" / Path(member.filename).name
                place.parent.mkdir()
                with archive.open(member) as packed, place.open("wb") as file:
                    shutil.copyfileobj(packed, file, _BATCH)
    except (zipfile.BadZipFile, zlib.error, lzma.LZMAError, *_PLAIN) as error:
        raise RecordingError(f"The zip cannot be read: {error}. Pack it again.") from error


def _decompressed(path: Path, stack: ExitStack) -> tuple[Path, bytes]:
    """Decompress a part that rosbag2 has compressed as a whole."""
    folder = Path(stack.enter_context(TemporaryDirectory(prefix="spheremark-")))
    target, n_most = folder / path.stem, _EXPANSION_MAX * path.stat().st_size
    try:
        with path.open("rb") as packed, target.open("wb") as file:
            reader = zstandard.ZstdDecompressor().stream_reader(packed)
            while block := reader.read(_BATCH):
                file.write(block)
                if file.tell() > n_most:
                    raise RecordingError(f"{path.name} expands to more than {n_most:,} bytes.")
    except zstandard.ZstdError as error:
        raise RecordingError(f"{path.name} cannot be decompressed: {error}.") from error
    with target.open("rb") as file:
        return target, file.read(_HEAD)


def _of_rosbag2(path: Path, topics: dict[str, Channel]) -> Iterator[Item]:
    """Yield the messages of a part of rosbag2 in SQLite; views are not believed."""
    uri = f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1"
    with closing(sqlite3.connect(uri, uri=True)) as connection:
        connection.text_factory = lambda octets: octets.decode("utf-8", "replace")
        size = path.stat().st_size
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(min(size, _PIECE_LIMIT), 1 << 16))
        connection.execute("PRAGMA trusted_schema = OFF")
        connection.execute("PRAGMA writable_schema = ON")  # opens a file that was cut, too
        tables = {
            name
            for name, text in connection.execute("SELECT name, sql FROM sqlite_master")
            if str(text).upper().startswith("CREATE TABLE")
        }
        if not {"topics", "messages"} <= tables:
            raise ValueError("it is an SQLite database, but has no tables topics and messages")
        definitions = {}
        if "message_definitions" in tables:
            query = (
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            )
            definitions = {
                str(kind): (str(e), str(text)) for kind, e, text in connection.execute(query)
            }
        query = "SELECT id, name, type, serialization_format FROM topics"
        channels = {}
        for identifier, topic, kind, encoding in connection.execute(query):
            form, text = definitions.get(str(kind), ("", ""))
            channel = Channel(
                topic=str(topic),
                encoding=str(encoding),
                schema=str(kind),
                schema_encoding=form,
                definition=text.encode(),
            )
            channels[identifier] = topics[channel.topic] = channel
        for identifier, log_time, data in connection.execute(
            "SELECT topic_id, timestamp, data FROM messages ORDER BY id"
        ):
            if identifier in channels:
                yield channels[identifier], _log_time(log_time), _message(bytes(data))


def _log_time(value: float) -> int:
    """Return the time at which rosbag2 has recorded a message [ns]."""
    log_time = int(value)
    if not 0 <= log_time < _TIME_LIMIT:
        raise ValueError(f"a message has the time {value:g} ns; expected 0 to {_TIME_LIMIT:g}")
    return log_time


def _message(data: bytes) -> bytes:
    """Return a message, decompressed if rosbag2 has compressed it."""
    if not data.startswith(_ZSTD):
        return data
    size = zstandard.frame_content_size(data)
    if size > _PIECE_LIMIT:
        raise ValueError(f"a message declares {size:,} bytes")
    return zstandard.ZstdDecompressor().decompress(data, max_output_size=_PIECE_LIMIT)


def _of_rosbag1(path: Path, topics: dict[str, Channel]) -> Iterator[Item]:
    """Yield the messages of a ROS 1 bag, front to back: an index is neither needed nor trusted."""
    from rosbags.rosbag1.reader import Header, read_bytes, read_uint32

    channels: dict[int, Channel] = {}
    size = path.stat().st_size
    with path.open("rb") as file:
        file.readline(32)
        while file.tell() < size:
            header = Header.read(file)
            if header.get_uint8("op") != 5:
                yield from _rosbag1_record(file, header, channels, topics)
                continue
            if header.get_string("compression") == "none":
                read_uint32(file)  # its records follow, be they whole or cut
                continue
            data = _unpacked(read_bytes(file, read_uint32(file)), header)
            chunk = BytesIO(data)
            while chunk.tell() < len(data):
                yield from _rosbag1_record(chunk, Header.read(chunk), channels, topics)


def _rosbag1_record(
    file: BinaryIO, header: Header, channels: dict[int, Channel], topics: dict[str, Channel]
) -> Iterator[Item]:
    """Read a record of a ROS 1 bag; yield it if it is a message."""
    from rosbags.rosbag1.reader import Header, normalize, read_bytes, read_uint32
    from rosbags.typesys.msg import normalize_msgtype

    kind = header.get_uint8("op")
    data = read_bytes(file, read_uint32(file))
    if kind == 7:
        about = Header.read(BytesIO(len(data).to_bytes(4, "little") + data))
        channel = Channel(
            topic=normalize(header.get_string("topic")),
            encoding="ros1",
            schema=normalize_msgtype(about.get_string("type")),
            schema_encoding="ros1msg",
            definition=about.get("message_definition", b""),
        )
        channels[header.get_uint32("conn")] = topics[channel.topic] = channel
    elif kind == 2 and header.get_uint32("conn") in channels:
        yield channels[header.get_uint32("conn")], header.get_time("time"), data


def _unpacked(data: bytes, header: Header) -> bytes:
    """Decompress a chunk of a ROS 1 bag, to no more than it declares."""
    size, compression = header.get_uint32("size"), header.get_string("compression")
    if size > _PIECE_LIMIT:
        raise ValueError(f"a chunk declares {size:,} bytes")
    if compression == "bz2":
        data = bz2.BZ2Decompressor().decompress(data, size + 1)
    elif compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(data, size + 1)
    else:
        raise ValueError(f"a chunk is compressed by {compression!r}")
    if len(data) != size:
        raise ValueError(f"a chunk declares {size:,} bytes and holds {len(data):,}")
    return data


def _of_pcap(path: Path, topics: dict[str, Channel]) -> Iterator[Item]:
    """Yield the packets of each Velodyne in a capture, as the messages of its driver."""
    from dpkt.pcap import UniversalReader

    waiting: dict[bytes, list[tuple[int, bytes]]] = {}
    channels: dict[bytes, Channel] = {}
    with path.open("rb") as file:
        for seconds, frame in UniversalReader(file):
            data = frame[-_PACKET:]  # the payload is the end of a frame, whatever carries it
            if len(data) < _PACKET or data[:2] != _PACKET_HEAD:
                continue
            sender = frame[-_PACKET - 16 : -_PACKET - 12]  # IPv4, before its receiver and UDP
            if sender not in channels:
                number = f"_{len(channels) + 1}" if channels else ""
                channels[sender] = Channel(
                    topic=PCAP_TOPIC + number,
                    encoding="cdr",
                    schema=packets.SCHEMA,
                    schema_encoding="",
                    definition=b"",
                )
                topics[channels[sender].topic] = channels[sender]
            scan = waiting.setdefault(sender, [])
            scan.append((round(seconds * 1_000_000) * 1_000, data))
            if len(scan) == _SCAN_PACKETS:
                yield _scan(channels[sender], waiting.pop(sender))
    for sender, scan in waiting.items():
        yield _scan(channels[sender], scan)


def _scan(channel: Channel, scan: Sequence[tuple[int, bytes]]) -> Item:
    """Return packets as a message of the driver."""
    return channel, scan[-1][0], scan_of_packets(scan[0][0], _PCAP_FRAME, scan)


def file_digest(url: str | Path) -> str:
    """Return the SHA-256 of a file's bytes, or of the digests of a folder's, in hexadecimal."""
    import fsspec

    digest = hashlib.sha256()
    if "://" not in str(url) and Path(url).is_dir():
        files = sorted((one for one in Path(url).rglob("*") if one.is_file()), key=_natural)
        for one in files:
            digest.update(file_digest(one).encode())
        return digest.hexdigest()
    try:
        with fsspec.open(str(url), "rb") as file:
            while block := file.read(_BATCH):
                digest.update(block)
    except FileNotFoundError as error:
        raise NotFoundError(f"There is no recording {url}.") from error
    return digest.hexdigest()
