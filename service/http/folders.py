"""The files of a folder that come in one body (multipart/form-data), kept as one zip.

Hides the format of the body. Files are stored without compression, in the order in which they
come and without times: the same files in the same order give the same zip.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import PurePosixPath
from typing import IO

from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from spheremark.pipelines.errors import InputError

FORM = "multipart/form-data"
_FILES_MAX = 1000  # of one folder; a rosbag2 that is split every minute has 60 an hour
_TIME = (1980, 1, 1, 0, 0, 0)  # the first that a zip can have


class _Sink:
    """A file that is only written to, whose bytes are seen once: a zip then has no gaps to fill."""

    def __init__(self, file: IO[bytes], seen: Callable[[bytes], None]) -> None:
        self._file, self._seen = file, seen

    def write(self, data: bytes) -> int:
        """Write some bytes."""
        octets = bytes(data)
        self._file.write(octets)
        self._seen(octets)
        return len(octets)

    def flush(self) -> None:
        """Hand over what was written."""
        self._file.flush()


class FolderWriter:
    """Turns the parts of a body into the members of a zip, while they arrive.

    Parameters
    ----------
    content_type : str
        Header of the body, with its boundary.
    file : binary file
        Takes the zip.
    seen : callable
        Takes each of its bytes once.
    """

    def __init__(self, content_type: str, file: IO[bytes], seen: Callable[[bytes], None]) -> None:
        kind, options = parse_options_header(content_type)
        if kind != FORM.encode() or not options.get(b"boundary"):
            raise InputError(
                f"The body is {content_type[:80]!r}; {FORM} with a boundary has files."
            )
        self._zip = zipfile.ZipFile(_Sink(file, seen), "w", zipfile.ZIP_STORED)  # type: ignore[call-overload]
        self._member: IO[bytes] | None = None
        self._head: dict[bytes, bytes] = {}
        self._name, self._value = b"", b""
        self._is_ended = False
        self._parser = MultipartParser(
            options[b"boundary"],
            {
                "on_part_begin": self._head.clear,
                "on_header_field": self._on_name,
                "on_header_value": self._on_value,
                "on_header_end": self._on_header,
                "on_headers_finished": self._begin,
                "on_part_data": self._add,
                "on_part_end": self._end,
                "on_end": self._on_end,
            },
        )

    def feed(self, data: bytes) -> None:
        """Take the next bytes of the body."""
        try:
            self._parser.write(data)
        except FormParserError as error:
            raise InputError(f"The body is no well-formed {FORM}: {error}.") from error

    def finish(self) -> None:
        """Require that the body is complete, and write the end of the zip."""
        if not self._is_ended:
            raise InputError(f"The body ends before its last boundary: {FORM} was cut.")
        if not self._zip.infolist():
            raise InputError("The body has no files; send each file as a part with a filename.")
        self._zip.close()

    def close(self) -> None:
        """Close the zip, however much of it there is; why it is not whole was raised before."""
        with suppress(OSError):
            self._end()
            self._zip.close()

    def _on_name(self, data: bytes, start: int, end: int) -> None:
        """Take a part of the name of a header."""
        self._name += data[start:end]

    def _on_value(self, data: bytes, start: int, end: int) -> None:
        """Take a part of the value of a header."""
        self._value += data[start:end]

    def _on_header(self) -> None:
        """Keep a header."""
        self._head[self._name.lower()] = self._value
        self._name, self._value = b"", b""

    def _begin(self) -> None:
        """Begin a member of the zip, if the part is a file."""
        _, options = parse_options_header(self._head.get(b"content-disposition", b""))
        if b"filename" not in options:
            return
        if len(self._zip.infolist()) >= _FILES_MAX:
            raise InputError(f"The folder has more than {_FILES_MAX} files.")
        path = PurePosixPath(options[b"filename"].decode("utf-8", "replace").replace("\\", "/"))
        about = zipfile.ZipInfo(path.name or "file", _TIME)
        if about.filename in self._zip.NameToInfo:
            raise InputError(
                f"The folder has two files called {about.filename!r}; the files of a log have "
                "names of their own. Send other folders as logs of their own."
            )
        self._member = self._zip.open(about, "w", force_zip64=True)

    def _add(self, data: bytes, start: int, end: int) -> None:
        """Write to the member."""
        if self._member is not None:
            self._member.write(data[start:end])

    def _end(self) -> None:
        """End the member."""
        if self._member is not None:
            self._member.close()
            self._member = None

    def _on_end(self) -> None:
        """Note that the body is complete."""
        self._is_ended = True
