"""Vertices of PLY files: a small strict reader of the header, and NumPy for the body."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import IO

import numpy as np

from spheremark.pipelines.errors import InputError
from spheremark.pipelines.model import Array

_HEAD_MAX = 1 << 16  # [bytes] of a header
_NAME_MAX = 64  # characters of a property's name
_PROPERTIES_MAX = 256  # of a vertex
_DIGITS_MAX = 18  # of a count
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True, slots=True)
class Vertices:
    """Where the vertices of a PLY file are, and what each holds.

    Attributes
    ----------
    begin : int
        Byte of the first one.
    n : int
        Their number, as declared.
    dtype : dtype
        Properties of one.
    is_text : bool
        Whether each is a line of text.
    """

    begin: int
    n: int
    dtype: np.dtype[np.void]
    is_text: bool

    @property
    def smallest(self) -> int:
        """Least size of one [bytes]: in text, each value is a digit and what divides it."""
        return 2 * len(self.dtype.names or ()) if self.is_text else self.dtype.itemsize

    def pieces(self, file: IO[bytes], n_most: int) -> Iterator[Array]:
        """Return x, y and z piece by piece, (n, 3) [m]."""
        file.seek(self.begin)
        for first in range(0, self.n, n_most):
            n = min(n_most, self.n - first)
            points = self._lines(file, n) if self.is_text else self._rows(file, n)
            if len(points) < n:
                raise InputError(
                    f"The file ends after {first + len(points):,} of {self.n:,} vertices."
                )
            yield points

    def _rows(self, file: IO[bytes], n: int) -> Array:
        """Return the next vertices of a binary file."""
        data = file.read(n * self.dtype.itemsize)
        rows = np.frombuffer(data[: len(data) - len(data) % self.dtype.itemsize], self.dtype)
        return np.column_stack([rows[axis] for axis in "xyz"]).astype(np.float64)

    def _lines(self, file: IO[bytes], n: int) -> Array:
        """Return the next vertices of a text file."""
        names = self.dtype.names or ()
        lines = (line.decode("latin-1") for line in itertools.islice(file, n))
        places = [names.index(axis) for axis in "xyz"]
        return np.loadtxt(lines, usecols=places, ndmin=2, comments=None).reshape(-1, 3)


def vertices_of(file: IO[bytes], name: str) -> Vertices:
    """Return where the vertices are; InputError where the header is not one that is known.

    Parameters
    ----------
    file : binary file
        At its beginning.
    name : str
        What it is called.

    Returns
    -------
    Vertices
        As the header declares them; nothing was held against the size of the file.
    """
    try:
        begin, lines = _header(file.read(_HEAD_MAX))
        form = _form(lines)
        n, dtype = _element(lines[2:], _ORDERS[form])
    except InputError as error:
        raise InputError(f"{name} is no PLY cloud that can be read: {error}.") from error
    return Vertices(begin, n, dtype, form == "ascii")


def _header(head: bytes) -> tuple[int, list[list[str]]]:
    """Return where a header ends, and the words of its lines without comments."""
    text, mark, rest = head.partition(b"\nend_header")
    ending, newline, _ = rest.partition(b"\n")
    if not newline or ending.strip():
        raise InputError(f"its header has no end within {_HEAD_MAX:,} bytes")
    lines = [line.split() for line in text.decode("latin-1").split("\n")]
    lines = [line for line in lines if line and line[0] not in ("comment", "obj_info")]
    if len(lines) < 3:
        raise InputError("its header declares nothing")
    return len(text) + len(mark) + len(ending) + 1, lines


def _form(lines: Sequence[Sequence[str]]) -> str:
    """Return how the body is written, as the first two lines say."""
    if lines[0] != ["ply"] or lines[1][0] != "format":
        raise InputError("it does not begin with 'ply' and 'format'")
    if len(lines[1]) != 3 or lines[1][1] not in _ORDERS or lines[1][2] != "1.0":
        raise InputError(f"its format is not 1.0 of {', '.join(_ORDERS)}")
    return lines[1][1]


def _element(lines: Sequence[Sequence[str]], order: str) -> tuple[int, np.dtype[np.void]]:
    """Return number and type of the vertices, which must be the first element."""
    first = lines[0]
    if first[:2] != ["element", "vertex"] or len(first) != 3:
        raise InputError("its first element is not 'element vertex' with a number")
    if not (first[2].isascii() and first[2].isdigit() and len(first[2]) <= _DIGITS_MAX):
        raise InputError("its number of vertices is no number")
    own = list(itertools.takewhile(lambda line: line[0] == "property", lines[1:]))
    if len(own) > _PROPERTIES_MAX:
        raise InputError(
            f"its vertices have {len(own):,} properties; {_PROPERTIES_MAX} are the most"
        )
    for line in own:
        if len(line) != 3 or line[1] not in _TYPES:
            raise InputError("a property of its vertices has no type of a number, or no name")
        if len(line[2]) > _NAME_MAX:
            raise InputError(
                f"a property's name has {len(line[2]):,} characters; {_NAME_MAX} are the most"
            )
    types = {line[2]: _TYPES[line[1]] for line in own}
    if len(types) < len(own):
        raise InputError("two properties of its vertices have the same name")
    if not all(types.get(axis, "").startswith("f") for axis in "xyz"):
        raise InputError("its vertices have no x, y and z of type float or double")
    return int(first[2]), np.dtype([(one, order + kind) for one, kind in types.items()])
