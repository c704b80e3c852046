"""What Linux can forbid a process of ours, for good: memory, time, files and the network.

Hides system calls that Python has no functions for. It must stay light to import.
"""

from __future__ import annotations

import ctypes
import math
import os
import resource
import signal
import struct
import sys
from collections.abc import Iterable
from pathlib import Path

_FILES_MAX = 64  # open files of the process
_NEW_NAMESPACES = 0x10000000 | 0x40000000 | 0x08000000  # of users, of networks, of shared memory
_NEW_MOUNTS, _MOUNT_BIND = 0x00020000, 1 << 12
_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446  # Landlock, on every architecture
_RIGHTS = (13, 14, 15, 15, 16)  # to files, that versions 1 to 5 of Landlock know
_EXECUTE, _READ_FILE = 1 << 0, 1 << 2


def limit_resources(*, memory_bytes: int, seconds: float, file_bytes: int) -> None:
    """Bound what this process may use.

    Parameters
    ----------
    memory_bytes : int
        Addresses of the process.
    seconds : float
        From now on, after which it is ended, whatever it does [s].
    file_bytes : int
        Size of any file that it writes.
    """
    bounds = {
        resource.RLIMIT_AS: memory_bytes if sys.platform == "linux" else resource.RLIM_INFINITY,
        resource.RLIMIT_FSIZE: file_bytes,
        resource.RLIMIT_CORE: 0,
        resource.RLIMIT_CPU: math.ceil(seconds) + 1,
        resource.RLIMIT_NOFILE: _FILES_MAX,
    }
    for what, bound in bounds.items():
        resource.setrlimit(what, (bound, bound))
    signal.setitimer(signal.ITIMER_REAL, seconds)  # nothing handles it: it ends the process


def leave_network() -> bool:
    """Move this process to a network without interfaces.

    Returns
    -------
    bool
        Whether it could be: user namespaces must be allowed, and the process have one thread.
    """
    if sys.platform != "linux":
        return False
    return bool(ctypes.CDLL(None).unshare(_NEW_NAMESPACES) == 0)


def leave_files() -> bool:
    """Make the open files of this process the only ones that have a path: ``/0`` and so on.

    Call it after ``leave_network``, whose namespace allows it. Sockets by path and the attributes
    of files, which Landlock does not cover, are out of reach then.

    Returns
    -------
    bool
        Whether it could be.
    """
    return enter_folder(Path("/proc/self/fd")) == Path("/")


def enter_folder(folder: Path) -> Path:
    """Make a folder the root of this process's files, where it may.

    Call it after ``leave_network``, whose namespace allows it.

    Parameters
    ----------
    folder : Path
        The folder.

    Returns
    -------
    Path
        Its path from now on: ``/``, or the path as before.
    """
    try:
        os.chroot(folder)
        os.chdir("/")
    except OSError:
        return folder
    return Path("/")


def show_file(path: Path, place: Path) -> None:
    """Make a file appear at another path too, for this process alone, where it may.

    Call it after ``leave_network``, whose namespace allows it.

    Parameters
    ----------
    path : Path
        The file.
    place : Path
        An existing file, hidden from now on.
    """
    libc = ctypes.CDLL(None)
    if libc.unshare(_NEW_MOUNTS) == 0:
        libc.mount(os.fsencode(path), os.fsencode(place), None, ctypes.c_ulong(_MOUNT_BIND), None)


def forbid_files(readable: Iterable[int], folder: int | None = None) -> bool:
    """Forbid to open, make and run files, to use TCP and to signal other processes (Landlock).

    Parameters
    ----------
    readable : iterable of int
        Descriptors of the only files that may still be opened, for reading.
    folder : int, optional
        Descriptor of the only folder in which files may still be made, read, written and removed.

    Returns
    -------
    bool
        Whether it is so: Linux 5.13 forbids files, 6.7 TCP, 6.12 signals.
    """
    if sys.platform != "linux":
        return False
    libc = ctypes.CDLL(None)
    version = libc.syscall(_CREATE_RULESET, None, ctypes.c_size_t(0), 1)
    if version < 1:
        return False
    rights = (1 << _RIGHTS[min(version, len(_RIGHTS)) - 1]) - 1
    network, scope = (3 if version >= 4 else 0), (3 if version >= 6 else 0)
    rules = struct.pack("=QQQ", rights, network, scope)
    ruleset = libc.syscall(_CREATE_RULESET, rules, ctypes.c_size_t(len(rules)), 0)
    allowed = [(_READ_FILE, descriptor) for descriptor in readable]
    if folder is not None:
        allowed.append((rights & ~_EXECUTE, folder))
    for right, descriptor in allowed:
        libc.syscall(_ADD_RULE, ruleset, 1, struct.pack("=Qi", right, descriptor), 0)
    libc.prctl(38, 1, 0, 0, 0)  # PR_SET_NO_NEW_PRIVS
    is_restricted = libc.syscall(_RESTRICT_SELF, ruleset, 0) == 0
    os.close(ruleset)
    return bool(is_restricted)
