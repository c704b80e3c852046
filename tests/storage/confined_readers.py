"""Readers that do what a parser does that a file has overcome; they run in the confined process."""

# ruff: noqa: ARG001  a reader is given a name and a path
import ctypes
import mmap
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from spheremark.pipelines.errors import InputError, TruncatedRecordingError


def prepare():
    pass


def size_of(file, *, name, path=""):
    return {"size": np.array([len(file.read())], "<i8"), "nothing": np.zeros((0, 3))}


def try_escapes(_file, *, name, path="", folder, port):
    """Try to read, write, run, connect and kill; return what worked, as numbers of the attempts."""

    def connect(kind, address):
        with socket.socket(socket.AF_INET, kind) as line:
            line.connect(address)
            line.send(b"x")

    def connect_by_path(path):
        with socket.socket(socket.AF_UNIX) as line:
            line.connect(str(path))

    folder = Path(folder)
    attempts = [
        lambda: (folder / "secret").read_text(),
        lambda: Path("/etc/passwd").read_text(),
        lambda: Path("/proc/self/environ").read_text(),
        lambda: list(folder.iterdir()),
        lambda: (folder / "written").write_text("x"),
        lambda: (folder / "secret").write_text("x"),
        lambda: (folder / "made").mkdir(),
        lambda: (folder / "secret").unlink(),
        lambda: os.truncate(folder / "secret", 0),
        lambda: subprocess.run(["/bin/true"], check=True),
        lambda: connect(socket.SOCK_STREAM, ("127.0.0.1", port)),
        lambda: connect(socket.SOCK_DGRAM, ("127.0.0.1", port)),
        lambda: os.kill(os.getppid(), 0),
        lambda: os.write(0, b"x"),
        lambda: os.environ["SPHEREMARK_TOKEN"],
        lambda: connect_by_path(folder / "socket"),
        lambda: (folder / "secret").chmod(0o777),
        lambda: os.utime(folder / "secret"),
        lambda: (folder / "secret").stat(),
    ]
    worked = []
    for number, attempt in enumerate(attempts):
        try:
            attempt()
        except (OSError, KeyError, subprocess.SubprocessError):
            continue
        worked.append(number)
    return {"worked": np.array(worked, "<i8")}


def take_memory(_file, *, name, path=""):
    return {"x": np.ones(1 << 30)}


def take_memory_in_c(_file, *, name, path=""):
    libc = ctypes.CDLL(None)
    libc.malloc.restype = ctypes.c_void_p
    while libc.malloc(ctypes.c_size_t(1 << 24)):
        pass
    os.abort()


def take_time(_file, *, name, path=""):
    while True:
        pass


def sleep(_file, *, name, path=""):
    signal.signal(signal.SIGALRM, signal.SIG_IGN)
    time.sleep(600)


def crash(_file, *, name, path=""):
    ctypes.string_at(0)


def fail(_file, *, name, path=""):
    raise RuntimeError(f"line one\nabout\x1b[31m {'x' * 10_000}")


def give_whole_numbers(_file, *, name, path="", cells_max):
    line = np.arange(2.0)
    return {"xs": line, "ys": line, "ground": np.zeros((2, 2), "<i8")}


def end_by_a_signal_without_a_name(_file, *, name, path=""):
    signal.signal(40, signal.SIG_DFL)
    os.kill(os.getpid(), 40)
    time.sleep(10)


def leave(_file, *, name, path=""):
    os._exit(0)


def print_much(_file, *, name, path=""):
    os.write(1, b"printed")
    sys.stderr.write("x" * 1000)
    return {"x": np.zeros(1)}


def give_much(_file, *, name, path=""):
    return {"x": np.zeros(1 << 21)}


def give_objects(_file, *, name, path=""):
    return {"x": np.array(["text"])}


def refuse(_file, *, name, path=""):
    raise InputError(f"{name} is refused\x07.")


def forge(_file, *, name, path="", answer):
    """Write an answer of its own to each descriptor that takes it, and end."""
    for descriptor in range(3, 10):
        try:
            os.write(descriptor, answer.encode())
        except OSError:
            continue
    os._exit(0)


def fork_on(_file, *, name, path=""):
    """Leave a process behind that goes on to write, and give its number."""
    child = os.fork()
    if child == 0:
        time.sleep(600)
        os._exit(0)
    return {"child": child}


def use_own_folder(_file, *, name, path=""):
    """Write into the temporary folder, as a reader that unpacks does; read the file by its path."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "unpacked"
        place.write_bytes(Path(path).read_bytes())
        return {"text": place.read_text(), "shown": Path(path).name}


def refuse_by_class(_file, *, name, path=""):
    raise TruncatedRecordingError("it ends early")


def forge_values(_file, *, name, path="", values):
    return values


def keep_the_answer_open(_file, *, name, path=""):
    """Map the memory of the answer, so that it could be changed while it is read."""
    for descriptor in range(3, 10):
        try:
            os.ftruncate(descriptor, 1 << 16)
            window = mmap.mmap(descriptor, 1 << 16)
            if os.fork() == 0:
                os.setsid()
                time.sleep(20)
                os._exit(len(window))
        except (OSError, ValueError):
            continue
    return {"x": np.ones(1000)}
