"""One reader on one foreign file, in a process that can do nothing else.

Hides what the operating system offers against a parser that a file makes misbehave: limits of
memory, time and output, no network, no other file. Linux forbids other files from 5.13 on
(Landlock), and the network where it allows user namespaces; elsewhere the limits alone hold.

The child is this module run as a program: the request is its argument, the file its standard
input, a memory file of bounded size its standard output. It must stay light to import. For readers
of a module that is kept ready it is forked from a process that has loaded them, which takes
milliseconds.
"""

from __future__ import annotations

import atexit
import fcntl
import gc
import importlib
import json
import math
import mmap
import os
import re
import resource
import selectors
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from time import monotonic
from typing import IO, Any, ClassVar, NoReturn

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.errors import InputError, SpheremarkError
from spheremark.pipelines.progress import checkpoint
from spheremark.storage.confinement import (
    enter_folder,
    forbid_files,
    leave_files,
    leave_network,
    limit_resources,
    show_file,
)
from spheremark.storage.scratch import scratch

Result = dict[str, Any]
Reader = Callable[..., Mapping[str, Any]]

READY = "spheremark.storage.imports.ready"
"""The module of the readers of logs and documents; it is always kept ready."""

CLOUDS = "spheremark.storage.imports.cloud_files"
"""The module of the readers of terrains that are clouds; it is kept ready from the first one on."""


_DTYPES = ("<f8", "<f4", "<i8", "|u1")  # of results
_DIMENSIONS_MAX = 3
_HEAD_MAX = 1 << 22  # [bytes] of the line before the arrays
_LOG_MAX = 1 << 16  # [bytes] of what a child printed last
_REQUEST_MAX = 1 << 18  # [bytes]; headers and queries of HTTP have 64 kB at most
_ALIGNED = 64  # [bytes] to a multiple of which head and arrays are filled up
_THREADS = 4  # of a reader that gets a path
_MESSAGE_MAX = 400  # characters of a message out of the child
_EXCEPTION = re.compile(r"^[\w.]+: ")  # the name of a class before its message
_START_MAX = 20.0  # [s] until a process may have started on a machine that is busy
_PROGRAM = (sys.executable, "-P", "-m", "spheremark.storage.confined")
_LOOK_EVERY = 0.5  # [s] whether the caller still waits
_CHILDREN: set[subprocess.Popen[bytes]] = set()
_AWAITED: set[socket.socket] = set()  # to forked children; each ends once nothing can be sent there
_SEALABLE = 0x1 | 0x2  # a memory file that is closed in new programs (Linux)
_SEALS = 0x1 | 0x2 | 0x4 | 0x8  # of seals, shrinking, growing and writing (Linux)
_AT_ONCE = threading.BoundedSemaphore(2)  # children; others wait, and so memory is bounded too
_ENVIRONMENT = {  # no settings, so no secrets; no threads, whose memory would count
    "PATH": os.defpath,
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "RAYON_NUM_THREADS": "1",
    "MALLOC_ARENA_MAX": "1",
}
_COMPILED = ("HOME", "NUMBA_")  # variables that say where compiled kernels are


class UnreadableFileError(InputError):
    """A foreign file cannot be read within the limits.

    Attributes
    ----------
    signal : int or None
        Number of the signal that ended its reader, if one did.
    """

    code: ClassVar[str] = "input.unreadable"

    def __init__(self, message: str, signal: int | None = None) -> None:
        super().__init__(message)
        self.signal = signal


class ReaderEndedError(SpheremarkError):
    """The service ends, and with it the reading of a foreign file."""

    code: ClassVar[str] = "reader_ended"


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


def run_confined(
    reader: str,
    file: Path | IO[bytes],
    limits: Limits,
    *,
    name: str,
    by_path: bool = False,
    **options: Any,
) -> Result:
    """Run a reader on a file in a confined process.

    Parameters
    ----------
    reader : str
        ``package.module:function``. The function gets the open file, ``name`` and the options, and
        returns arrays, and values that are plain for JSON, by name. It runs in the child, where
        nothing can be imported any more.
    file : Path or binary file
        The file.
    limits : Limits
        What the reading may use.
    name : str
        Name of the file in messages.
    by_path : bool
        Whether the reader also gets the ``path`` of the file, and may make files in its temporary
        folder.
    **options
        Further arguments, plain enough for JSON.

    Returns
    -------
    dict
        What the reader returned; its arrays are read-only. Of them only dtypes, dimensions and
        sizes were checked.

    Raises
    ------
    InputError
        If the reader refuses the file; of the class that it raised.
    UnreadableFileError
        If the reader fails, crashes, or exceeds a limit.
    ReaderEndedError
        If it was ended by ``end_children``, which is no fault of the file.

    Notes
    -----
    Takes as long as the imports of the reader's module, and 0.2 s; 0.03 s for one kept ready.
    """
    request = {"reader": reader, "limits": asdict(limits), "options": {"name": name, **options}}
    forks = _FORKS.get(reader.partition(":")[0]) if sys.platform == "linux" else None
    with ExitStack() as stack:
        opened = stack.enter_context(file.open("rb")) if isinstance(file, Path) else file
        result, log = stack.enter_context(_memory_file()), stack.enter_context(_memory_file())
        files = (opened, result, log)
        n_ended = _n_ended
        with forks.places if forks else _AT_ONCE:
            if by_path:
                request["path"] = str(file.resolve()) if isinstance(file, Path) else ""
                request["folder"] = str(stack.enter_context(scratch()))
            if forks:
                code = _wait_for_fork(forks, json.dumps(request), files, limits)
            else:
                code = _wait_for_child(json.dumps(request), files, limits)
        if code < 0 and _n_ended != n_ended:
            raise ReaderEndedError(f"The service ended while it read {name}; it is read again.")
        if code:
            reason = _reason(code, log, limits, name)
            raise UnreadableFileError(reason, signal=-code if code < 0 else None)
        return _result(result, limits, name)


def keep_ready(module: str, n_at_once: int) -> None:
    """Keep a process from which the children of a module's readers are forked.

    Parameters
    ----------
    module : str
        The module; its ``prepare`` is called once there.
    n_at_once : int
        Number of children at the same time; others wait.
    """
    _FORKS.setdefault(module, _Forks(module, threading.BoundedSemaphore(n_at_once)))


def start_readers() -> None:
    """Start the processes that keep readers ready, so that the first file need not wait for it."""
    if sys.platform == "linux":
        for module, forks in tuple(_FORKS.items()):
            if module != CLOUDS:  # which few services ever get
                forks.start()


def end_children() -> None:
    """End all readers that run, as at the end of the service; processes that are ready stay."""
    global _n_ended
    _n_ended += 1
    for awaited in tuple(_AWAITED):
        with suppress(OSError):  # its child ended a moment ago
            awaited.shutdown(socket.SHUT_WR)
    for child in tuple(_CHILDREN):
        with suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)


def _memory_file() -> IO[bytes]:
    """Return a file without a name, in memory on Linux; a limit of file size bounds it."""
    if sys.platform != "linux":
        return tempfile.TemporaryFile()  # type: ignore[return-value]  # a file of bytes
    return os.fdopen(os.memfd_create("spheremark", _SEALABLE), "w+b")


def _wait_for_child(request: str, files: tuple[IO[bytes], ...], limits: Limits) -> int:
    """Run the child to its end, or end it, and return its code."""
    with subprocess.Popen(
        [*_PROGRAM, request],
        stdin=files[0],
        stdout=files[1],
        stderr=files[2],
        cwd="/",
        env=_environment(),
        start_new_session=True,
    ) as child:
        _CHILDREN.add(child)
        try:
            for _ in _looks(limits):
                with suppress(subprocess.TimeoutExpired):
                    return child.wait(_LOOK_EVERY)
            return -signal.SIGALRM
        finally:
            _CHILDREN.discard(child)
            if child.returncode is None:
                os.killpg(child.pid, signal.SIGKILL)


def _environment() -> dict[str, str]:
    """Return the variables of a child."""
    return {**_ENVIRONMENT, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


def _wait_for_fork(
    forks: _Forks, request: str, files: tuple[IO[bytes], ...], limits: Limits
) -> int:
    """Run a child that is forked from a ready process, and return its code; or end it."""
    ours, theirs = socket.socketpair()
    with ours:
        _AWAITED.add(ours)
        try:
            with theirs:
                forks.send(request.encode(), [*(f.fileno() for f in files), theirs.fileno()])
            ours.settimeout(_LOOK_EVERY)
            for _ in _looks(limits):
                with suppress(TimeoutError):
                    code = ours.recv(4)
                    return int.from_bytes(code, "little", signed=True) if code else -signal.SIGKILL
            ours.shutdown(socket.SHUT_WR)  # ends the child
            ours.settimeout(None)
            ours.recv(4)
            return -signal.SIGALRM
        finally:
            _AWAITED.discard(ours)


def _looks(limits: Limits) -> Iterator[None]:
    """Yield until a child has had its time, and end where its caller does."""
    deadline = monotonic() + limits.seconds + _START_MAX
    while monotonic() < deadline:
        checkpoint()
        yield


class _Forks:
    """The process that keeps a module's readers loaded and forks; started when needed."""

    def __init__(self, module: str, places: threading.BoundedSemaphore) -> None:
        self._module = module
        self.places = places
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._socket: socket.socket | None = None

    def start(self) -> socket.socket:
        """Return the socket of the process, which is started anew if it has ended."""
        with self._lock:
            if self._process is None or self._process.poll() is not None:
                if self._socket is not None:
                    self._socket.close()
                self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
                kept = {k: v for k, v in os.environ.items() if k.startswith(_COMPILED)}
                with theirs:
                    self._process = subprocess.Popen(
                        [*_PROGRAM, "--ready", self._module],
                        stdin=theirs.fileno(),
                        stdout=subprocess.DEVNULL,
                        cwd="/",
                        env={**_environment(), **kept},
                        start_new_session=True,
                    )
                if not self._socket.recv(1):
                    raise RuntimeError("the process that reads foreign files cannot be started")
            assert self._socket is not None
            return self._socket

    def send(self, request: bytes, descriptors: list[int]) -> None:
        """Send a request and its files."""
        try:
            socket.send_fds(self.start(), [request], descriptors)
        except (BrokenPipeError, ConnectionResetError):  # it ended a moment ago
            assert self._process is not None
            self._process.wait(_START_MAX)
            socket.send_fds(self.start(), [request], descriptors)

    def end(self) -> None:
        """End the process and its children."""
        with self._lock:
            if self._socket is not None and self._process is not None:
                self._socket.close()
                try:
                    self._process.wait(_START_MAX)
                except subprocess.TimeoutExpired:  # it is stopped, or the machine too busy
                    self._process.kill()
                    self._process.wait()
            self._socket = self._process = None


_FORKS = {module: _Forks(module, _AT_ONCE) for module in (READY, CLOUDS)}
_n_ended = 0  # times that all readers were ended


@atexit.register
def _end_all() -> None:
    """End readers, and the processes that keep them ready, with this process."""
    end_children()
    for forks in tuple(_FORKS.values()):
        forks.end()


def _reason(code: int, log: IO[bytes], limits: Limits, name: str) -> str:
    """Say why a child ended without a result."""
    if code in (-signal.SIGALRM, -signal.SIGXCPU, -signal.SIGPROF):
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
    log.seek(max(0, log.tell() - _LOG_MAX))
    lines = log.read().decode(errors="replace").strip().splitlines()
    last = _EXCEPTION.sub("", lines[-1]) if lines else ""
    if not last or "/" in last:  # paths of this machine concern no one else
        last = "its reader failed at it; the file is damaged, or of a kind that is not known"
    return f"{name} cannot be read: {_printable(last, _MESSAGE_MAX).strip(' .')}."


def _result(file: IO[bytes], limits: Limits, name: str) -> Result:
    """Return the values and arrays of an answer, which a file may have forged."""
    try:
        if sys.platform == "linux":  # what could still be changed is no answer
            fcntl.fcntl(file.fileno(), fcntl.F_ADD_SEALS, _SEALS)
        file.seek(0)
        head = json.loads(file.readline(_HEAD_MAX))
        if "refused" in head:
            text = _printable(str(head["refused"]), 4 * _MESSAGE_MAX)
            raise _refusals().get(str(head.get("code")), InputError)(text)
        octets = mmap.mmap(file.fileno(), 0, mmap.MAP_PRIVATE, mmap.PROT_READ)
        place, found = file.tell(), dict(head["values"])
        for one in head["arrays"]:
            array = _array(octets, place, str(one["dtype"]), one["shape"], limits)
            found[str(one["name"])] = array
            place += _filled(array.nbytes)
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise UnreadableFileError(
            f"{name} cannot be read: its reader gave no sensible answer."
        ) from error
    return found


def _refusals() -> dict[str, type[InputError]]:
    """Return the classes of refusals by their codes."""
    found, classes = {InputError.code: InputError}, [InputError]
    while classes:
        inner = classes.pop().__subclasses__()
        classes += inner
        found.update((one.code, one) for one in inner if one.code not in found)
    return found


def _filled(n_bytes: int) -> int:
    """Return how many bytes an array or a head takes in an answer."""
    return -(-n_bytes // _ALIGNED) * _ALIGNED


def _printable(text: str, n_most: int) -> str:
    """Return a text out of the child without control characters, and not too long."""
    return "".join(c if c.isprintable() else " " for c in text)[:n_most]


def _array(octets: mmap.mmap, place: int, dtype: str, shape: Any, limits: Limits) -> NDArray[Any]:
    """Return an array of an answer, as a window into it."""
    if dtype not in _DTYPES or len(shape) > _DIMENSIONS_MAX:
        raise ValueError("unexpected dtype or dimensions")
    if not all(type(n) is int and n >= 0 for n in shape):
        raise ValueError("unexpected shape")
    if math.prod(shape) * np.dtype(dtype).itemsize > limits.result_bytes:
        raise ValueError("too large")
    if not math.prod(shape):
        return np.empty(shape, dtype)
    return np.frombuffer(octets, dtype, math.prod(shape), place).reshape(shape)


# What follows runs in the child.


def _main() -> None:
    """Answer the request that is the argument, or those that come, by forks."""
    if sys.argv[1] == "--ready":
        with suppress(ConnectionError):  # its parent ended before it was ready
            _serve(sys.argv[2], socket.socket(fileno=os.dup(0)))
        os._exit(0)  # what is frozen is never freed, and libraries would report it
    else:
        _answer(json.loads(sys.argv[1]))


def _serve(module: str, control: socket.socket) -> None:
    """Load the readers; fork for each request; end with the process that sends them."""
    importlib.import_module(module).prepare()
    gc.freeze()
    control.send(b".")
    children: dict[int, tuple[int, socket.socket]] = {}  # with what ends with them, and with us
    with selectors.DefaultSelector() as selector:
        selector.register(control, selectors.EVENT_READ)
        while True:
            for key, _ in selector.select():
                if key.data is not None:
                    _follow(selector, key, children)
                    continue
                request, files, *_ = socket.recv_fds(control, _REQUEST_MAX, 4)
                if not request:
                    for child in children:
                        os.kill(child, signal.SIGKILL)
                    return
                if (child := os.fork()) == 0:
                    _run_fork(request, files)
                for one in files[:3]:
                    os.close(one)
                children[child] = (os.pidfd_open(child), socket.socket(fileno=files[3]))
                for place in children[child]:
                    selector.register(place, selectors.EVENT_READ, child)


def _follow(
    selector: selectors.BaseSelector,
    key: selectors.SelectorKey,
    children: dict[int, tuple[int, socket.socket]],
) -> None:
    """Send the code of a child that has ended; end one whose result is not awaited any more."""
    if key.data not in children:  # it ended a moment ago
        return
    ended, status = children[key.data]
    if key.fileobj is status:
        os.kill(key.data, signal.SIGKILL)
        selector.unregister(status)
        return
    code = os.waitstatus_to_exitcode(os.waitpid(key.data, 0)[1])
    with suppress(ProcessLookupError):
        os.killpg(key.data, signal.SIGKILL)  # what it has left behind
    with suppress(OSError):
        status.send(code.to_bytes(4, "little", signed=True))
    for place in children.pop(key.data):
        with suppress(KeyError):
            selector.unregister(place)
    os.close(ended)
    status.close()


def _run_fork(request: bytes, files: list[int]) -> NoReturn:
    """Be the child of one request."""
    code = 1
    try:
        os.setsid()
        for place, one in enumerate(files[:3]):
            os.dup2(one, place)
        os.closerange(3, 1 << 10)
        _answer(json.loads(request))
        code = 0
    except BaseException:  # noqa: BLE001  as at the end of a program
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(code)


def _answer(request: Result) -> None:
    """Confine this process, run the reader, and write its answer."""
    limits, options = Limits(**request["limits"]), request["options"]
    answer = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print is no part of the answer
    is_alone = leave_network()
    module, _, function = request["reader"].partition(":")
    reader: Reader = getattr(importlib.import_module(module), function)
    file = os.fdopen(0, "rb", closefd=False)  # not sys.stdin: in a fork that was a socket
    limit_resources(
        memory_bytes=_memory_in_use() + limits.memory_bytes,
        seconds=limits.seconds,
        file_bytes=limits.result_bytes + _HEAD_MAX,
    )
    folder: int | None = None
    if "folder" in request:
        folder, options["path"] = _enter(Path(request["folder"]), request["path"])
    elif is_alone:
        leave_files()
    if folder is None or is_alone:  # in a namespace only its own threads and processes count
        n_most = 0 if folder is None else _THREADS
        resource.setrlimit(resource.RLIMIT_NPROC, (n_most, n_most))  # root is exempt
    forbid_files([file.fileno()], folder)
    try:
        found = reader(file, **options)
    except InputError as error:
        _write(answer, {"refused": str(error), "code": error.code}, {})
    except MemoryError:
        text = f"{options['name']} needs more than {limits.memory_bytes >> 20} MiB"
        text += " to be read, the limit. Take a part of it."
        _write(answer, {"refused": text, "code": UnreadableFileError.code}, {})
    else:
        _write(answer, {"values": {k: v for k, v in found.items() if not _is_array(v)}}, found)


def _enter(folder: Path, path: str) -> tuple[int, str]:
    """Make a folder the only one; return its descriptor, and the path of the input from there."""
    tempfile.tempdir = str(folder)
    if path:
        place = folder / "input" / Path(path).name
        place.parent.mkdir()
        place.touch()
        show_file(Path(path), place)
    descriptor = os.open(folder, os.O_RDONLY)
    if enter_folder(folder) == folder:
        return descriptor, path
    tempfile.tempdir = "/"
    return descriptor, f"/input/{Path(path).name}"


def _is_array(value: object) -> bool:
    """Return whether a part of a result is an array."""
    return isinstance(value, np.ndarray)


def _write(answer: IO[bytes], head: Result, found: Mapping[str, Any]) -> None:
    """Write an answer: a line of JSON, then the arrays."""
    arrays = {name: np.ascontiguousarray(one) for name, one in found.items() if _is_array(one)}
    about = [
        {"name": name, "dtype": one.dtype.str, "shape": one.shape} for name, one in arrays.items()
    ]
    text = json.dumps({**head, "arrays": about}).encode()
    answer.write(text.ljust(_filled(len(text) + 1) - 1) + b"\n")
    for one in arrays.values():
        answer.write(one.data.cast("B") if one.size else b"")
        answer.write(bytes(_filled(one.nbytes) - one.nbytes))
    answer.close()


def _memory_in_use() -> int:
    """Return the addresses that this process has taken [bytes]."""
    if sys.platform != "linux":
        return 0
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    return pages * resource.getpagesize()


if __name__ == "__main__":
    _main()
