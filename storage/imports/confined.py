"""One reader on one foreign file, in a process that can do nothing else.

Hides what the operating system offers against a parser that a file makes misbehave: limits of
memory, time and output, no network, no other file. Linux forbids other files from 5.13 on
(Landlock), and the network where it allows user namespaces; elsewhere the limits alone hold.

The child is this module run as a program: the request is its argument, the file its standard
input, a memory file of bounded size its standard output. It must stay light to import.
"""

from __future__ import annotations

import importlib
import json
import math
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.errors import InputError
from spheremark.storage.confinement import (
    forbid_files,
    leave_files,
    leave_network,
    limit_resources,
)

Arrays = dict[str, NDArray[Any]]
Reader = Callable[..., Mapping[str, NDArray[Any]]]

_DTYPES = ("<f8", "<f4", "<i8", "|u1")  # of results
_DIMENSIONS_MAX = 3
_HEAD_MAX = 1 << 16  # [bytes] of the line before the arrays
_MESSAGE_MAX = 400  # characters of a message out of the child
_EXCEPTION = re.compile(r"^[\w.]+: ")  # the name of a class before its message
_START_MAX = 20.0  # [s] until a process may have started on a machine that is busy
_CHILDREN: set[subprocess.Popen[bytes]] = set()
_AT_ONCE = threading.BoundedSemaphore(2)  # children; others wait, and so memory is bounded too
_ENVIRONMENT = {  # no settings, so no secrets; no threads, whose memory would count
    "PATH": os.defpath,
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "RAYON_NUM_THREADS": "1",
    "MALLOC_ARENA_MAX": "1",
}


class UnreadableFileError(InputError):
    """A foreign file cannot be read within the limits."""

    code: ClassVar[str] = "input.unreadable"


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """What the reading of one file may use.

    Attributes
    ----------
    seconds : float
        From the confinement of the process to its killing [s].
    memory_bytes : int
        Beyond what the process takes before it reads.
    result_bytes : int
        Size of all arrays of the result.
    """

    seconds: float
    memory_bytes: int
    result_bytes: int


def run_confined(reader: str, path: Path, limits: Limits, *, name: str, **options: Any) -> Arrays:
    """Run a reader on a file in a confined process.

    Parameters
    ----------
    reader : str
        ``package.module:function``. The function gets the open file, ``name`` and the options, and
        returns arrays by name. It runs in the child, where nothing can be imported any more.
    path : Path
        The file.
    limits : Limits
        What the reading may use.
    name : str
        Name of the file in messages.
    **options
        Further arguments, plain enough for JSON.

    Returns
    -------
    dict of str to array
        What the reader returned. Only dtypes, dimensions and sizes were checked.

    Raises
    ------
    InputError
        If the reader refuses the file.
    UnreadableFileError
        If the reader fails, crashes, or exceeds a limit.

    Notes
    -----
    Takes as long as the imports of the reader's module, and 0.2 s.
    """
    request = {"reader": reader, "limits": asdict(limits), "options": {"name": name, **options}}
    with path.open("rb") as file, _memory_file() as result, _memory_file() as log:
        with _AT_ONCE:
            code = _wait_for_child(json.dumps(request), (file, result, log), limits)
        if code:
            raise UnreadableFileError(_reason(code, log, limits, name))
        return _arrays(result, limits, name)


def end_children() -> None:
    """End all readers that run, as at the end of the service."""
    for child in tuple(_CHILDREN):
        with suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)


def _memory_file() -> IO[bytes]:
    """Return a file without a name, in memory on Linux; a limit of file size bounds it."""
    if sys.platform != "linux":
        return tempfile.TemporaryFile()  # type: ignore[return-value]  # a file of bytes
    return os.fdopen(os.memfd_create("spheremark"), "w+b")


def _wait_for_child(request: str, files: tuple[IO[bytes], ...], limits: Limits) -> int:
    """Run the child to its end, or end it, and return its code."""
    with subprocess.Popen(
        [sys.executable, "-P", "-m", "spheremark.storage.imports.confined", request],
        stdin=files[0],
        stdout=files[1],
        stderr=files[2],
        cwd="/",
        env={**_ENVIRONMENT, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        start_new_session=True,
    ) as child:
        _CHILDREN.add(child)
        try:
            return child.wait(limits.seconds + _START_MAX)
        except subprocess.TimeoutExpired:
            return -signal.SIGALRM
        finally:
            _CHILDREN.discard(child)
            if child.returncode is None:
                os.killpg(child.pid, signal.SIGKILL)


def _reason(code: int, log: IO[bytes], limits: Limits, name: str) -> str:
    """Say why a child ended without a result."""
    if code in (-signal.SIGALRM, -signal.SIGXCPU):
        return (
            f"Reading {name} took more than {limits.seconds:g} s, the limit. Take a part of it, or "
            "thin it out."
        )
    if code < 0:
        known = {one.value: one.name for one in signal.Signals}
        return (
            f"{name} cannot be read: the reader ended with {known.get(-code, -code)}. The file "
            f"is damaged, or needs more than {limits.memory_bytes >> 20} MiB."
        )
    log.seek(0, os.SEEK_END)
    log.seek(max(0, log.tell() - _HEAD_MAX))
    lines = log.read().decode(errors="replace").strip().splitlines()
    last = _EXCEPTION.sub("", lines[-1]) if lines else ""
    if not last or "/" in last:  # paths of this machine concern no one else
        last = "its reader failed at it; the file is damaged, or of a kind that is not known"
    return f"{name} cannot be read: {_printable(last, _MESSAGE_MAX).strip(' .')}."


def _arrays(result: IO[bytes], limits: Limits, name: str) -> Arrays:
    """Return the arrays of an answer, which a file may have forged."""
    result.seek(0)
    try:
        head = json.loads(result.readline(_HEAD_MAX))
        if "refused" in head:
            raise InputError(_printable(str(head["refused"]), 4 * _MESSAGE_MAX))
        return {
            str(one["name"]): _array(result, str(one["dtype"]), one["shape"], limits)
            for one in head["arrays"]
        }
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise UnreadableFileError(
            f"{name} cannot be read: its reader gave no sensible answer."
        ) from error


def _printable(text: str, n_most: int) -> str:
    """Return a text out of the child without control characters, and not too long."""
    return "".join(c if c.isprintable() else " " for c in text)[:n_most]


def _array(result: IO[bytes], dtype: str, shape: Any, limits: Limits) -> NDArray[Any]:
    """Return the next array of an answer."""
    if dtype not in _DTYPES or len(shape) > _DIMENSIONS_MAX:
        raise ValueError("unexpected dtype or dimensions")
    if not all(type(n) is int and n >= 0 for n in shape):
        raise ValueError("unexpected shape")
    n_bytes = math.prod(shape) * np.dtype(dtype).itemsize
    if n_bytes > limits.result_bytes:
        raise ValueError("too large")
    values = np.empty(math.prod(shape), dtype)
    if n_bytes and result.readinto(values.data.cast("B")) != n_bytes:  # type: ignore[attr-defined]
        raise ValueError("cut short")
    return values.reshape(shape)


# What follows runs in the child.


def _main() -> None:
    """Answer the request that is the argument."""
    request = json.loads(sys.argv[1])
    limits = Limits(**request["limits"])
    answer = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print is no part of the answer
    is_alone = leave_network()
    module, _, function = request["reader"].partition(":")
    reader: Reader = getattr(importlib.import_module(module), function)
    file = sys.stdin.buffer
    limit_resources(
        memory_bytes=_memory_in_use() + limits.memory_bytes,
        seconds=limits.seconds,
        file_bytes=limits.result_bytes + _HEAD_MAX,
    )
    resource.setrlimit(resource.RLIMIT_NPROC, (0, 0))  # no thread or process more; root is exempt
    if is_alone:
        leave_files()
    forbid_files([file.fileno()])
    try:
        arrays = reader(file, **request["options"])
    except InputError as error:
        _write(answer, {"refused": str(error)}, [])
    except MemoryError:
        text = f"{request['options']['name']} needs more than {limits.memory_bytes >> 20} MiB"
        _write(answer, {"refused": f"{text} to be read, the limit. Take a part of it."}, [])
    else:
        plain = {name: np.ascontiguousarray(values) for name, values in arrays.items()}
        about = [
            {"name": name, "dtype": values.dtype.str, "shape": values.shape}
            for name, values in plain.items()
        ]
        _write(answer, {"arrays": about}, plain.values())


def _write(answer: IO[bytes], head: Mapping[str, Any], arrays: Iterable[NDArray[Any]]) -> None:
    """Write an answer: a line of JSON, then the arrays."""
    answer.write(json.dumps(head).encode() + b"\n")
    for values in arrays:
        answer.write(values.data.cast("B") if values.size else b"")
    answer.close()


def _memory_in_use() -> int:
    """Return the addresses that this process has taken [bytes]."""
    if sys.platform != "linux":
        return 0
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    return pages * resource.getpagesize()


if __name__ == "__main__":
    _main()
