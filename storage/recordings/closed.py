"""Which recordings in a folder are complete, so that they can be read while others are recorded."""

from __future__ import annotations

import re
from pathlib import Path

from spheremark.storage.recordings.records import FOOTER, MAGIC

METADATA = "metadata.yaml"  # `ros2 bag record` writes it when it closes a bag
_PART = re.compile(r"^\s*(?:-|path:)\s+(\S+\.(?:mcap|db3)(?:\.zstd)?)\s*$", re.MULTILINE)
_FOOTER = 1 + 8 + 20  # [bytes] of opcode, length and content
_SQLITE_HEAD = 32  # [bytes] up to the number of pages


def closed_logs(folder: Path) -> list[Path]:
    """Return the complete recordings in a folder, in the order in which they were closed.

    Parameters
    ----------
    folder : Path
        Folder of bags and of MCAP files and ROS 1 bags.

    Returns
    -------
    list of Path
        A folder of rosbag2 once it has its metadata and all parts that this names; an MCAP file
        once it has its footer; a ROS 1 bag, which has another name while it is recorded.
    """
    found = []
    for path in folder.iterdir():
        try:
            if _is_closed(path):
                found.append((path.stat().st_mtime_ns, path))
        except OSError:  # removed or renamed in the meantime
            continue
    return [path for _, path in sorted(found)]


def _is_closed(path: Path) -> bool:
    """Return whether a recording is complete."""
    if path.is_dir():
        about = path / METADATA
        if not about.is_file():
            return False
        text = about.read_text("utf-8", "replace")  # it may be half written
        parts = {path / Path(name).name for name in _PART.findall(text)}
        return bool(parts) and all(one.is_file() and _is_whole(one) for one in parts)
    if path.suffix == ".bag":
        return path.stat().st_size > 0
    return path.suffix == ".mcap" and _is_whole(path)


def _is_whole(path: Path) -> bool:
    """Return whether a part ends as its format does; a copy may still be under way."""
    size = path.stat().st_size
    with path.open("rb") as file:
        if path.suffix == ".mcap":
            if size < _FOOTER + 2 * len(MAGIC):
                return False
            file.seek(size - _FOOTER - len(MAGIC))
            end = file.read()
            return end[0] == FOOTER and end.endswith(MAGIC)
        if path.suffix == ".db3":
            head = file.read(_SQLITE_HEAD)
            page = int.from_bytes(head[16:18], "big")
            n_pages = int.from_bytes(head[28:32], "big")
            log = path.with_name(f"{path.name}-wal")
            is_pending = log.is_file() and log.stat().st_size > 0
            return size > 0 and not is_pending and size >= n_pages * (65536 if page == 1 else page)
    return size > 0
