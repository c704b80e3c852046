"""Files on their way in: a body streamed to disk while it is hashed, then named by its digest.

Hides temporary files, blocks and threads; nothing of an upload that breaks off remains.
"""

from __future__ import annotations

import asyncio
import hashlib
import os
import tempfile
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, ClassVar

from starlette.requests import ClientDisconnect

from spheremark.pipelines.errors import InputError, NotFoundError
from spheremark.service.errors import EmptyBodyError, RefusedRecordingError, TooLargeError
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.catalogue.records import RecordingRecord
from spheremark.storage.recordings import inspect_log

_BLOCK = 4 << 20  # [bytes] hashed and written at once; large enough that a thread pays off


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
    """A folder of files named by digest, and the files that are still being written beside it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._partial = folder / ".partial"

    def open(self) -> None:
        """Make the folders, and remove unfinished uploads of an earlier process."""
        self._partial.mkdir(parents=True, exist_ok=True)
        for left in self._partial.iterdir():
            left.unlink()

    async def receive(self, chunks: AsyncIterator[bytes], max_bytes: int) -> Received:
        """Keep a log as ``<sha256>.mcap``; the same bytes twice are one file."""
        async with self.received(chunks, max_bytes) as part:
            return replace(part, path=await asyncio.to_thread(self.keep, part, ".mcap"))

    @asynccontextmanager
    async def received(
        self, chunks: AsyncIterator[bytes], max_bytes: int
    ) -> AsyncIterator[Received]:
        """Have a body as a file without a name of its own, which is removed at the end."""
        handle, name = tempfile.mkstemp(dir=self._partial)
        path = Path(name)
        try:
            with os.fdopen(handle, "wb") as file:
                digest, size = await _write_and_hash(chunks, file, max_bytes)
            if size == 0:
                raise EmptyBodyError("The body is empty; send the file itself as the body.")
            yield Received(path=path, digest=digest, size_bytes=size)
        finally:
            path.unlink(missing_ok=True)  # noqa: ASYNC240  at once: threads may all be busy

    def keep(self, part: Received, ending: str) -> Path:
        """Name a file by the digest of what was received."""
        target = self.folder / f"{part.digest}{ending}"
        part.path.chmod(0o644)
        part.path.replace(target)
        return target


async def _write_and_hash(
    chunks: AsyncIterator[bytes], file: IO[bytes], max_bytes: int
) -> tuple[str, int]:
    """Write all chunks; return the SHA-256 and the size of what was written."""
    sha = hashlib.sha256()
    block = bytearray()
    size = 0

    def put(data: bytearray) -> None:
        file.write(data)
        sha.update(data)

    try:
        async for chunk in chunks:
            block += chunk
            size += len(chunk)
            if size > max_bytes:
                raise TooLargeError(f"The body is larger than the {max_bytes:,} bytes accepted.")
            if len(block) >= _BLOCK:
                await asyncio.to_thread(put, block)
                block = bytearray()
    except ClientDisconnect as error:
        raise InterruptedUploadError(f"The sender went away after {size:,} bytes.") from error
    await asyncio.to_thread(put, block)
    return sha.hexdigest(), size


def take_in(catalogue: Catalogue, received: Received, name: str) -> tuple[RecordingRecord, bool]:
    """Enter a log that arrived, with its preflight; return it, and whether it is new.

    A log that cannot be processed is kept with the reason, which is then raised.
    """
    try:
        recording, is_new = catalogue.get_recording(received.digest), False
    except NotFoundError:
        recording, is_new = _enter(catalogue, received, name), True
    if recording.verdict == "refused":
        raise RefusedRecordingError.of(recording)
    return recording, is_new


def _enter(catalogue: Catalogue, received: Received, name: str) -> RecordingRecord:
    """Inspect a log and enter it with what was found."""
    return catalogue.add_recording(
        received.digest,
        name=name.removesuffix(".mcap"),
        size_bytes=received.size_bytes,
        url=str(received.path),
        preflight=inspect_log(received.path).to_mapping(),
    )
