"""Readers that do what a parser does that a file has overcome; they run in the confined process."""

# ruff: noqa: ARG001  a reader is given a name
import ctypes
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from spheremark.pipelines.errors import InputError


def size_of(file, *, name):
    return {"size": np.array([len(file.read())], "<i8"), "nothing": np.zeros((0, 3))}


def try_escapes(_file, *, name, folder, port):
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


def take_memory(_file, *, name):
    return {"x": np.ones(1 << 30)}


def take_memory_in_c(_file, *, name):
    libc = ctypes.CDLL(None)
    libc.malloc.restype = ctypes.c_void_p
    while libc.malloc(ctypes.c_size_t(1 << 24)):
        pass
    os.abort()


def take_time(_file, *, name):
    while True:
        pass


def sleep(_file, *, name):
    signal.signal(signal.SIGALRM, signal.SIG_IGN)
    time.sleep(600)


def crash(_file, *, name):
    ctypes.string_at(0)


def fail(_file, *, name):
    raise RuntimeError(f"line one\nabout\x1b[31m {'x' * 10_000}")


def give_whole_numbers(_file, *, name, cells_max):
    line = np.arange(2.0)
    return {"xs": line, "ys": line, "ground": np.zeros((2, 2), "<i8")}


def end_by_a_signal_without_a_name(_file, *, name):
    signal.signal(40, signal.SIG_DFL)
    os.kill(os.getpid(), 40)
    time.sleep(10)


def leave(_file, *, name):
    os._exit(0)


def print_much(_file, *, name):
    os.write(1, b"printed")
    sys.stderr.write("x" * 1000)
    return {"x": np.zeros(1)}


def give_much(_file, *, name):
    return {"x": np.zeros(1 << 21)}


def give_objects(_file, *, name):
    return {"x": np.array(["text"])}


def refuse(_file, *, name):
    raise InputError(f"{name} is refused\x07.")


def forge(_file, *, name, answer):
    """Write an answer of its own to each descriptor that takes it, and end."""
    for descriptor in range(3, 10):
        try:
            os.write(descriptor, answer.encode())
        except OSError:
            continue
    os._exit(0)
