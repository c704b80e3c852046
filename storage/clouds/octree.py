"""Clouds in levels of detail: an octree whose nodes are read one by one, for a viewer.

A node holds at most one point of each of 64^3 cells of its cube, those without nodes below them
all their points.
Bytes of a node: positions in its cube (3 x uint16 of 65535ths of the edge, n times), residuals
(int16, 0.1 mm; the least value where there is none), intensities (uint8), markers (uint8: one more
than the place in the names, 0 for none), each n times in turn; little endian.
"""

from __future__ import annotations

import json
import secrets
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.errors import InputError
from spheremark.pipelines.model import Index
from spheremark.storage.clouds.stop import CloudView, read_cloud
from spheremark.storage.files import require_free, unwritten

BYTES_PER_POINT = 10
_VERSION = 1
_CELLS = 64  # along an edge of a node
_LEAF = 4000  # points of a node that has no more below it
_LEVELS = 8
_UNKNOWN = np.iinfo(np.int16).min
_RESIDUAL = 1e-4  # [m] of one unit
_STEPS = 65535
_building = threading.Lock()  # one at a time: a build holds a cloud in memory


@dataclass(frozen=True, slots=True)
class Octree:
    """An octree on disk: its description, and the place of its points in the file."""

    index: dict[str, Any]
    path: Path
    begin: int


def octree_of(url: str, folder: Path, min_free: int = 0) -> Octree:
    """Return the octree of a stop's cloud, made when it is not there yet.

    Parameters
    ----------
    url : str
        Result of ``write_cloud``; names the cloud by its digest.
    folder : Path
        Where octrees are kept.
    min_free : int
        Space that is kept free on its disk, for the database [bytes].

    Returns
    -------
    Octree
        Ready to be read.

    Raises
    ------
    NotFoundError
        If the cloud is not there any more.
    StorageError
        If the file cannot be written, or not without that space.
    """
    path = folder / f"{url.rsplit('/', 1)[-1].removesuffix('.parquet')}-{_VERSION}.octree"
    if not path.exists():
        with _building:
            if not path.exists():
                _write(read_cloud(url), path, min_free)
    with path.open("rb") as file:
        size = int.from_bytes(file.read(8), "little")
        return Octree(json.loads(file.read(size)), path, 8 + size)


def node_bytes(octree: Octree, key: str) -> bytes:
    """Return the points of a node.

    Parameters
    ----------
    octree : Octree
        Of a cloud.
    key : str
        Key of the node in the index.

    Returns
    -------
    bytes
        As the module describes.

    Raises
    ------
    InputError
        If there is no such node.
    """
    node = octree.index["nodes"].get(key)
    if node is None:
        raise InputError(f"The octree has no node {key!r}; its index lists them.")
    with octree.path.open("rb") as file:
        file.seek(octree.begin + node["offset"])
        return file.read(node["n"] * BYTES_PER_POINT)


def _write(cloud: CloudView, path: Path, min_free: int) -> None:
    """Write the octree of a cloud under another name, then move it."""
    index, content = build(cloud)
    text = json.dumps(index).encode()
    part = path.with_suffix(f".{secrets.token_hex(4)}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        require_free(path.parent, len(text) + len(content) + min_free)
        part.write_bytes(len(text).to_bytes(8, "little") + text + content)
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise unwritten(path, error) from error


def build(cloud: CloudView) -> tuple[dict[str, Any], bytes]:
    """Return the index of an octree and the bytes of its nodes.

    Parameters
    ----------
    cloud : CloudView
        Points in any order.

    Returns
    -------
    tuple of dict and bytes
        The index has ``origin_m``, ``edge_m``, ``names`` and the nodes by key: ``r`` for the root,
        with a digit for each level below it (4 x + 2 y + z).

    Notes
    -----
    Cost grows with points times levels.
    """
    p = cloud.p_station.astype(np.float64)
    low, high = (p.min(axis=0), p.max(axis=0)) if len(p) else (np.zeros(3), np.ones(3))
    edge = max(float(np.max(high - low)), 1e-3) * (1.0 + 1e-6)
    scaled = (p - low) / edge
    rest: Index = np.random.default_rng(0).permutation(len(p))  # no pattern of the scan in a level
    nodes: dict[str, Any] = {}
    parts: list[bytes] = []
    size = 0
    for level in range(_LEVELS):
        codes, places = _nodes(scaled[rest], level)
        kept = _kept(codes, places, is_last=level == _LEVELS - 1)
        for code, rows in _grouped(codes[kept], rest[kept]):
            key, corner = _key(code, level)
            content = _encoded(cloud, rows, scaled[rows] * 2**level - corner)
            nodes[key] = {"n": len(rows), "offset": size}
            parts.append(content)
            size += len(content)
        rest = rest[~kept]
        if not len(rest):
            break
    index = {
        "version": _VERSION,
        "n_points": len(p),
        "n_returns": cloud.n_returns,
        "origin_m": low.tolist(),
        "edge_m": edge,
        "cells": _CELLS,
        "names": list(cloud.names),
        "fit_method": cloud.fit_method,
        "nodes": nodes,
    }
    return index, b"".join(parts)


def _nodes(p: NDArray[np.float64], level: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the node of each point at a level, and its place in it."""
    at = p * 2**level
    corner = np.minimum(np.floor(at).astype(np.int64), 2**level - 1)
    codes = (corner[:, 0] << 2 * _LEVELS) | (corner[:, 1] << _LEVELS) | corner[:, 2]
    return codes, at - corner


def _kept(
    codes: NDArray[np.int64], places: NDArray[np.float64], *, is_last: bool
) -> NDArray[np.bool_]:
    """Return which points stay in their node: all of a small one, else one of each cell."""
    if is_last:
        return np.ones(len(codes), dtype=np.bool_)
    _, inverse, counts = np.unique(codes, return_inverse=True, return_counts=True)
    kept = np.asarray(counts[inverse] <= _LEAF)
    cells = np.minimum((places * _CELLS).astype(np.int64), _CELLS - 1)
    cell = (cells[:, 0] * _CELLS + cells[:, 1]) * _CELLS + cells[:, 2]
    kept[np.unique(codes * _CELLS**3 + cell, return_index=True)[1]] = True
    return kept


def _grouped(codes: NDArray[np.int64], rows: Index) -> list[tuple[int, Index]]:
    """Return the rows of each node."""
    order = np.argsort(codes, kind="stable")
    known, begins = np.unique(codes[order], return_index=True)
    return list(zip(known.tolist(), np.split(rows[order], begins[1:]), strict=True))


def _key(code: int, level: int) -> tuple[str, NDArray[np.int64]]:
    """Return the key of a node and its corner, in edges of its level."""
    mask = (1 << _LEVELS) - 1
    corner = [code >> 2 * _LEVELS, code >> _LEVELS & mask, code & mask]
    digits = [
        str(sum((axis >> bit & 1) << place for axis, place in zip(corner, (2, 1, 0), strict=True)))
        for bit in reversed(range(level))
    ]
    return "r" + "".join(digits), np.array(corner)


def _encoded(cloud: CloudView, rows: Index, places: NDArray[np.float64]) -> bytes:
    """Return the points of a node as bytes."""
    positions = np.clip(np.round(places * _STEPS), 0, _STEPS).astype("<u2")
    residuals = cloud.residuals[rows].astype(np.float64) / _RESIDUAL
    known = np.isfinite(residuals)
    limit = np.iinfo(np.int16).max
    steps = np.where(
        known, np.clip(np.round(np.where(known, residuals, 0)), -limit, limit), _UNKNOWN
    )
    intensities = np.clip(np.nan_to_num(cloud.intensities[rows]), 0, 255).astype(np.uint8)
    markers = np.clip(cloud.markers[rows] + 1, 0, 255).astype(np.uint8)
    return b"".join(
        [
            positions.tobytes(),
            steps.astype("<i2").tobytes(),
            intensities.tobytes(),
            markers.tobytes(),
        ]
    )
