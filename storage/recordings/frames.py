"""The tree of frames of a recording, and the rig that it describes."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from spheremark.pipelines.geometry import inverse, rigid, skew
from spheremark.pipelines.model import Array, ImuMount, Rig
from spheremark.pipelines.scan.rigs import vlp16
from spheremark.storage.recordings.families import Series

HEAD, BASE, WORLDS = "gimbal_link", "base_link", ("map", "odom", "world", "earth")
_UNIT = 1e-3  # how far the norm of a quaternion may be from 1


@dataclass(slots=True)
class FrameTree:
    """The frames and their parents, by transforms that do not change.

    Attributes
    ----------
    parents : dict of str to (str, (4, 4))
        Parent of each frame and the transform from the frame to it [m].
    turning : dict of str to Series
        By child: transforms that change.
    """

    parents: dict[str, tuple[str, Array]] = field(default_factory=dict)
    turning: dict[str, Series] = field(default_factory=dict)

    def add(self, series: Series) -> None:
        """Add a frame under its parent: one whose transform changes, or one that is fixed."""
        parent, child = series.names
        is_finite = np.isfinite(series.values).all(axis=1)
        if not is_finite.all():
            stamps, values = series.stamps_ns[is_finite], series.values[is_finite]
            series = replace(series, stamps_ns=stamps, values=values)
        if not len(series.values):
            return
        if not series.topic.endswith("tf_static") and np.ptp(series.values, axis=0).any():
            self.turning[child] = series
        elif child not in self.parents:
            translation, quaternion = np.split(series.values[-1], [3])
            norm = math.hypot(*quaternion)
            if abs(norm - 1.0) < _UNIT:
                *axis, w = quaternion / norm
                cross = skew(axis)
                R = np.eye(3) + 2.0 * (w * cross + cross @ cross)
                self.parents[child] = (parent, rigid(R, translation))

    def chain(self, frame: str) -> dict[str, Array]:
        """Return each frame from the given one up to its root, with the transform up to it."""
        chain = {frame: np.eye(4)}
        while frame in self.parents:
            parent, T_parent_frame = self.parents[frame]
            if parent in chain:
                break
            chain[parent] = T_parent_frame @ chain[frame]
            frame = parent
        return chain

    def head_of(self, frame: str) -> str | None:
        """Return the turning head that a frame sits on, or None.

        It is the frame whose own transform changes; else ``gimbal_link``; else a frame named after
        a gimbal; else the root, unless that is a base or a world, which do not turn.
        """
        chain = list(self.chain(frame))
        turning = [one for one in chain if one in self.turning]
        called = [one for one in chain if "gimbal" in one and "base" not in one]
        if turning or HEAD in chain or called:
            return next(iter([*turning, *(one for one in chain if one == HEAD), *called]))
        root = chain[-1]
        is_fixed = "base" in root or root in WORLDS or root == frame
        return None if is_fixed else root

    def base_of(self, head: str) -> str:
        """Return the fixed frame that a head turns against."""
        return self.turning[head].names[0] if head in self.turning else BASE


def recorded_rig(
    tree: FrameTree, frame: str, imu_frame: str | None
) -> tuple[Rig | None, tuple[str, ...]]:
    """Build the rig from the frames of a recording."""
    head = tree.head_of(frame)
    if head is None:
        known = ", ".join(sorted(set(tree.parents) | set(tree.turning))) or "none"
        return None, (
            f"No transform relates {frame or 'the LiDAR'} to the gimbal "
            f"(frames with a parent: {known}); give a rig.",
        )
    mount, R_mount_imu, notes = _imu_mounting(tree, head, imu_frame)
    rig = vlp16("recorded", tree.chain(frame)[head], R_mount_imu=R_mount_imu, imu_mount=mount)
    return rig, notes


def _imu_mounting(
    tree: FrameTree, head: str, imu_frame: str | None
) -> tuple[ImuMount, Array, tuple[str, ...]]:
    """Return the part that carries the AHRS and its rotation there."""
    if imu_frame is None:
        return ImuMount.BASE, np.eye(3), ()
    chain = tree.chain(imu_frame)
    if head in chain:
        return ImuMount.HEAD, chain[head][:3, :3], ()
    base = tree.base_of(head)
    base_chain = tree.chain(base)
    common = [one for one in chain if one in base_chain]
    if common:
        T_base_imu = inverse(base_chain[common[0]]) @ chain[common[0]]
        return ImuMount.BASE, T_base_imu[:3, :3], ()
    note = f"No transform relates {imu_frame} to {base}; it is taken as aligned with it."
    return ImuMount.BASE, np.eye(3), (note,)
