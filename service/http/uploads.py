"""Files on their way in: streamed to disk while they are hashed, then named by their digest.

Hides temporary files, blocks, threads, and what a loss of power could take: a file has its name
only when it is complete, its digest right, and file and folder are synced. Nothing of an upload
that breaks off remains, but for resumable ones (``Resumable``) until they expire.
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import json
import logging
import os
import re
import secrets
import tempfile
import threading
import time
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager, closing, contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import IO, Any, ClassVar

from starlette.requests import ClientDisconnect

from spheremark.pipelines.errors import InputError, NotFoundError
from spheremark.service.errors import (
    ChecksumError,
    DigestError,
    EmptyBodyError,
    LockedError,
    MalformedHeaderError,
    OffsetError,
    QuotaError,
    RefusedRecordingError,
    TooLargeError,
)
from spheremark.service.http.folders import FORM, FolderWriter
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.catalogue.records import RecordingRecord
from spheremark.storage.files import require_free, sync_folder, unwritten
from spheremark.storage.imports.uploads import inspect_upload
from spheremark.storage.recordings import LogOptions

logger = logging.getLogger(__name__)

LOG = ".mcap"
_ENDING = re.compile(r"\.(mcap|db3|bag|pcap|pcapng|zip)$", re.IGNORECASE)
_BLOCK = 4 << 20  # [bytes] hashed and written at once; large enough that a thread pays off
_KEPT_SECONDS = 7 * 24 * 3600.0  # until an upload that is not resumed is removed
_DIGEST = re.compile(r"(?:^|,)\s*sha-256=([^,;]*)")
_DIGEST_HEADERS = ("Repr-Digest", "Content-Digest")
_RESUMABLE = "resumable"  # name of a folder
_NAME = re.compile(rf"([0-9a-f]{{64}}){re.escape(LOG)}")


class InterruptedUploadError(InputError):
    """The sender went away before the body was complete."""

    code: ClassVar[str] = "input.interrupted"


@dataclass(frozen=True, slots=True, kw_only=True)
class Received:
    """A file that arrived whole: where it is, its SHA-256 and its size [bytes]."""

    path: Path
    digest: str
    size_bytes: int


class Inbox:
    """A folder of files named by digest, and the files that are still being written beside it.

    ``min_free`` is what must stay free on the disk [bytes]; ``quota`` is what all files may take,
    those being written included [bytes], and 0 for no limit.
    """

    def __init__(self, folder: Path, min_free: int = 0, quota: int = 0) -> None:
        self.folder = folder
        self.min_free = min_free
        self.quota = quota
        self.partial = folder / ".partial"

    def open(self) -> None:
        """Make the folders, and remove unfinished uploads of an earlier process."""
        self.partial.mkdir(parents=True, exist_ok=True)
        for left in self.partial.iterdir():
            if left.is_file():
                left.unlink()

    async def receive(
        self, chunks: AsyncIterator[bytes], max_bytes: int, headers: Mapping[str, str]
    ) -> Received:
        """Keep a log under its digest; the same bytes twice are one file.

        The files of a body of several (multipart/form-data) are one log, kept as a zip.
        """
        self.require_room(int(headers.get("content-length", "0")))
        expected = _declared_digests(headers)
        form = headers["content-type"] if media_type_of(headers) == FORM else ""
        async with self.received(chunks, max_bytes, form) as part:
            if not form:
                _check_digest(part.digest, expected)
            return replace(part, path=await asyncio.to_thread(self.keep, part, LOG))

    def require_room(self, n_bytes: int) -> None:
        """Refuse so many bytes where too little would be free for the database, or beyond quota."""
        require_free(self.folder, n_bytes + self.min_free)
        if self.quota and n_bytes and (used := self._used()) + n_bytes > self.quota:
            raise QuotaError(
                f"All logs take {used:,} bytes, unfinished uploads included; {n_bytes:,} more "
                f"exceed the {self.quota:,} that they may take (SPHEREMARK_QUOTA_BYTES)."
            )

    def _used(self) -> int:
        """Return what all files take [bytes]."""
        n_bytes = 0
        for folder in (self.folder, self.partial, self.partial / _RESUMABLE):
            for one in folder.glob("*"):
                with suppress(FileNotFoundError):  # named or removed in the meantime
                    is_log = one.suffix != ".json" and one.is_file()
                    n_bytes += one.stat().st_size if is_log else 0
        return n_bytes

    @asynccontextmanager
    async def received(
        self, chunks: AsyncIterator[bytes], max_bytes: int, form: str = ""
    ) -> AsyncIterator[Received]:
        """Have a body as a file without a name of its own, which is removed at the end.

        With the content type of a form, the file is a zip of the files in it.
        """
        with _translated(self.folder):
            handle, name = tempfile.mkstemp(dir=self.partial)
        path = Path(name)
        sha = hashlib.sha256()
        try:
            with os.fdopen(handle, "wb") as file:
                if form:
                    with closing(FolderWriter(form, file, sha.update)) as folder:
                        size = await self._write(chunks, folder.feed, max_bytes)
                        if size:
                            await asyncio.to_thread(folder.finish)
                    size = size and file.tell()
                else:
                    size = await self.write(chunks, file, max_bytes, sha.update)
                file.flush()
                await asyncio.to_thread(os.fsync, file.fileno())
            if size == 0:
                raise EmptyBodyError("The body is empty; send the file itself as the body.")
            yield Received(path=path, digest=sha.hexdigest(), size_bytes=size)
        finally:
            path.unlink(missing_ok=True)  # noqa: ASYNC240  at once: threads may all be busy

    def keep(self, part: Received, ending: str) -> Path:
        """Name a file by the digest of what was received."""
        target = self.folder / f"{part.digest}{ending}"
        with _translated(target):
            part.path.chmod(0o600)
            part.path.replace(target)
            sync_folder(self.folder)
        return target

    async def write(
        self,
        chunks: AsyncIterator[bytes],
        file: IO[bytes],
        max_bytes: int,
        seen: Callable[[bytes], None],
    ) -> int:
        """Write all chunks and return how many bytes they are; what was received stays."""

        def add(data: bytes) -> None:
            file.write(data)
            file.flush()
            seen(data)

        return await self._write(chunks, add, max_bytes)

    async def _write(
        self, chunks: AsyncIterator[bytes], add: Callable[[bytes], None], max_bytes: int
    ) -> int:
        """Give all chunks to a function in a thread; return how many bytes they are.

        While one block is written and hashed, the next one is received.
        """
        block: list[bytes] = []
        size = n_put = 0
        putting: asyncio.Task[None] | None = None

        def put(data: list[bytes]) -> None:
            self.require_room(sum(map(len, data)))
            with _translated(self.folder):
                for one in data:
                    add(one)

        try:
            async for chunk in chunks:
                block.append(chunk)
                size += len(chunk)
                if size > max_bytes:
                    raise TooLargeError(
                        f"The body is larger than the {max_bytes:,} bytes accepted."
                    )
                if size - n_put >= _BLOCK:
                    if putting is not None:
                        await putting
                    putting = asyncio.create_task(asyncio.to_thread(put, block))
                    block, n_put = [], size
        except ClientDisconnect as error:
            if putting is not None:
                await putting
            await asyncio.to_thread(put, block)
            raise InterruptedUploadError(f"The sender went away after {size:,} bytes.") from error
        finally:
            if putting is not None:  # the file is open until its thread has ended
                await putting
        await asyncio.to_thread(put, block)
        return size


@contextmanager
def _translated(folder: Path) -> Any:
    """Turn errors of the disk into ours."""
    try:
        yield
    except OSError as error:
        raise unwritten(folder, error) from error


def media_type_of(headers: Mapping[str, str]) -> str:
    """Return the media type of a body, in lower case and without parameters; empty without one."""
    return headers.get("content-type", "").partition(";")[0].strip().lower()


def _declared_digests(headers: Mapping[str, str]) -> tuple[str, ...]:
    """Return the SHA-256 that headers name for a body (RFC 9530), in hexadecimal."""
    found = []
    for name in _DIGEST_HEADERS:
        if match := _DIGEST.search(headers.get(name.lower(), "")):
            text = match[1].strip()
            try:
                digest = base64.b64decode(text[1:-1], validate=True)
            except ValueError:
                digest = b""
            if len(digest) != hashlib.sha256().digest_size or text != f":{text[1:-1]}:":
                raise MalformedHeaderError(
                    f"{name} has sha-256={text[:80]!r}; the Base64 of 32 bytes between two colons "
                    "is expected. Correct the header, or send the body without it."
                )
            found.append(digest.hex())
    return tuple(found)


def _check_digest(found: str, expected: Sequence[str]) -> None:
    """Refuse a body that is not the one whose SHA-256 its headers name."""
    for one in expected:
        if one != found:
            raise DigestError(
                f"The SHA-256 of the body is {found}, that of its header {one}: it was "
                "changed on its way. Send it again."
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Upload:
    """A resumable upload: its whole length [bytes], what the sender says of it, and its end."""

    upload_id: str
    length: int
    metadata: Mapping[str, str]
    expires_at: float
    path: Path

    @property
    def offset(self) -> int:
        """Number of bytes that are here."""
        return self.path.stat().st_size


@dataclass(slots=True)
class _Progress:
    """The SHA-256 of the first bytes of an upload."""

    sha: Any = field(default_factory=hashlib.sha256)
    n_bytes: int = 0

    def add(self, data: bytes | bytearray) -> None:
        """Take in the next bytes."""
        self.sha.update(data)
        self.n_bytes += len(data)


class Resumable:
    """Uploads that go on after an interruption, also of the service: files beside the inbox."""

    def __init__(self, inbox: Inbox) -> None:
        self._inbox = inbox
        self._folder = inbox.partial / _RESUMABLE
        self._progress: dict[str, _Progress] = {}
        self._lock = threading.Lock()
        self._busy: set[str] = set()

    def open(self) -> None:
        """Make the folder, and remove uploads that have expired."""
        self._folder.mkdir(parents=True, exist_ok=True)
        self._sweep()
        known = {about.stem for about in self._folder.glob("*.json")}
        for left in self._folder.iterdir():
            if left.stem not in known:
                left.unlink()

    def create(self, length: int, metadata: Mapping[str, str]) -> Upload:
        """Begin an upload of so many bytes; remove those that have expired."""
        with self._lock:
            self._sweep()
        self._inbox.require_room(length)
        upload_id = secrets.token_hex(16)
        path = self._folder / upload_id
        upload = Upload(
            upload_id=upload_id,
            length=length,
            metadata=dict(metadata),
            expires_at=time.time() + _KEPT_SECONDS,
            path=path,
        )
        about = asdict(upload) | {"path": str(path)}
        with self._lock, _translated(path):
            path.touch(mode=0o600)
            path.with_suffix(".json").write_text(json.dumps(about), encoding="utf-8")
        return upload

    def get(self, upload_id: str) -> Upload:
        """Return an upload that has not expired."""
        with self._lock:
            return self._found(upload_id)

    def _found(self, upload_id: str) -> Upload:
        """Return an upload; raise NotFoundError if there is none."""
        upload = self._existing(upload_id) if re.fullmatch(r"[0-9a-f]{32}", upload_id) else None
        if upload is None:
            raise NotFoundError(
                f"There is no upload {upload_id!r}: it is complete, was ended, or has expired."
            )
        return upload

    def end(self, upload_id: str) -> None:
        """Forget an upload and its bytes; raise LockedError while a request writes to it."""
        with self._lock:
            self._require_idle(upload_id)
            self._remove(upload_id)

    def _require_idle(self, upload_id: str) -> None:
        """Refuse an upload to which a request is writing."""
        if upload_id in self._busy:
            raise LockedError("Another request is writing to this upload; wait for its end.")

    def _sweep(self) -> None:
        """Remove uploads that have expired or are damaged."""
        for about in self._folder.glob("*.json"):
            self._existing(about.stem)

    def _remove(self, upload_id: str) -> None:
        """Remove what is kept of an upload."""
        self._progress.pop(upload_id, None)
        path = self._folder / upload_id
        path.with_suffix(".json").unlink(missing_ok=True)
        path.unlink(missing_ok=True)

    async def append(
        self,
        upload: Upload,
        offset: int,
        chunks: AsyncIterator[bytes],
        checksum: tuple[str, bytes] | None,
    ) -> Received | None:
        """Write the next part; return the file once it is complete."""
        with self._lock:
            self._require_idle(upload.upload_id)
            self._found(upload.upload_id)  # it may have been ended since the request began
            self._busy.add(upload.upload_id)
        try:
            if offset != upload.offset:
                raise OffsetError(
                    f"The part begins at byte {offset:,}; the upload ends at {upload.offset:,}. "
                    "Ask for the offset (HEAD) and send the rest."
                )
            await self._write(upload, chunks, checksum)
            if upload.offset < upload.length:
                return None
            return await asyncio.to_thread(self._complete, upload)
        finally:
            self._busy.discard(upload.upload_id)

    async def _write(
        self, upload: Upload, chunks: AsyncIterator[bytes], checksum: tuple[str, bytes] | None
    ) -> None:
        """Append a part; one with a wrong checksum leaves nothing."""
        offset = upload.offset
        progress = await asyncio.to_thread(self._progress_of, upload)
        part = hashlib.new(checksum[0]) if checksum else None
        backup = progress.sha.copy()

        def seen(data: bytes | bytearray) -> None:
            progress.add(data)
            if part is not None:
                part.update(data)

        with upload.path.open("ab") as file:
            await self._inbox.write(chunks, file, upload.length - offset, seen)
            if part is not None and checksum is not None and part.digest() != checksum[1]:
                file.truncate(offset)
                self._progress[upload.upload_id] = _Progress(backup, offset)
                raise ChecksumError(
                    f"The {checksum[0]} of the part is not that of its header; send it again."
                )
            await asyncio.to_thread(os.fsync, file.fileno())

    def _progress_of(self, upload: Upload) -> _Progress:
        """Return the digest so far; read again what an earlier process has received."""
        progress = self._progress.get(upload.upload_id)
        if progress is None or progress.n_bytes != upload.offset:
            progress = _Progress()
            with upload.path.open("rb") as file:
                while data := file.read(_BLOCK):
                    progress.add(data)
            self._progress[upload.upload_id] = progress
        return progress

    def _complete(self, upload: Upload) -> Received:
        """Give a complete file its name."""
        digest = self._progress_of(upload).sha.hexdigest()
        part = Received(path=upload.path, digest=digest, size_bytes=upload.length)
        kept = replace(part, path=self._inbox.keep(part, LOG))
        self._remove(upload.upload_id)
        return kept

    def _existing(self, upload_id: str) -> Upload | None:
        """Return an upload if it is there; remove one that has expired or is damaged."""
        path = self._folder / upload_id
        try:
            about = json.loads(path.with_suffix(".json").read_text("utf-8"))
            upload = Upload(**about | {"path": path})
        except (OSError, ValueError, TypeError):
            upload = None
        is_expired = upload is not None and upload.expires_at < time.time()
        if upload is None or not path.exists() or (is_expired and upload_id not in self._busy):
            self._remove(upload_id)
            return None
        return upload


def take_in(
    catalogue: Catalogue, received: Received, name: str, options: LogOptions
) -> tuple[RecordingRecord, bool]:
    """Enter a log that arrived, with its preflight; return it, and whether it is new.

    A log that cannot be processed is kept with the reason, which is then raised.
    """
    recording, is_new = enter(catalogue, received, name, options)
    if recording.verdict == "refused":
        raise RefusedRecordingError.of(recording)
    return recording, is_new


def enter(
    catalogue: Catalogue, received: Received, name: str, options: LogOptions | None = None
) -> tuple[RecordingRecord, bool]:
    """Enter a log that arrived, with its preflight; return it, and whether it is new.

    One that was here already is inspected again if it was refused, perhaps only because its reader
    was ended, or if it is to be read in another way.
    """
    try:
        known = catalogue.get_recording(received.digest)
        is_as_before = options is None or known.preflight.get("reading", {}) == options.to_mapping()
        if is_as_before and known.verdict != "refused":
            return known, False
        found = inspect_upload(received.path, options, known.name).to_mapping()
        return catalogue.inspect_again(received.digest, found), False
    except NotFoundError:
        name = _ENDING.sub("", name) or name
        recording = catalogue.add_recording(
            received.digest,
            name=name,
            size_bytes=received.size_bytes,
            url=str(received.path),
            preflight=inspect_upload(received.path, options, name).to_mapping(),
        )
        return recording, True


def adopt_orphans(catalogue: Catalogue, inbox: Inbox) -> int:
    """Enter the logs of which an ended process left the file and no row; return their number.

    Files whose bytes are not those of their name go to ``.damaged`` beside them.
    """
    files = {
        match[1]: path for path in inbox.folder.iterdir() if (match := _NAME.fullmatch(path.name))
    }
    known = {row["recording_id"] for row in catalogue.rows("SELECT recording_id FROM recordings")}
    n_adopted = 0
    for digest in sorted(files.keys() - known):
        path = files[digest]
        with path.open("rb") as file:
            is_whole = hashlib.file_digest(file, "sha256").hexdigest() == digest
        if is_whole:
            received = Received(path=path, digest=digest, size_bytes=path.stat().st_size)
            enter(catalogue, received, f"recovered-{digest[:8]}")
            n_adopted += 1
        else:
            damaged = inbox.folder / ".damaged"
            damaged.mkdir(exist_ok=True)
            path.replace(damaged / path.name)
        logger.warning("%s without a row: %s", path.name, "entered" if is_whole else "damaged")
    return n_adopted
