"""Evidence of all beams towards and about a group, at whatever depth they end.

Hides how the beams of a direction are found. A sphere on a pole stops the beams that are aimed at
it and lets pass those beside it: a rock, a head or a crown of leaves does not.
"""

from __future__ import annotations

from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.detection.cells import Cells, rows_about
from spheremark.pipelines.detection.faces import faces_of
from spheremark.pipelines.detection.ground import Ground, planes_below
from spheremark.pipelines.detection.pulses import Hearing, hearing_of, unheard_about
from spheremark.pipelines.detection.target import (
    BROAD,
    REACH,
    Target,
    blur_at,
    is_beside_pole,
    seen_from,
    view_of,
)
from spheremark.pipelines.model import Array, Column, Rig, StitchedCloud
from spheremark.pipelines.scan.firings import Clock, clock_of, heard_of
from spheremark.pipelines.scan.interpolation import errors_of_interpolation
from spheremark.pipelines.threads import side_by_side

ROW, N_ROWS = 0.45, 9
"""Height in radii of a row of beams below a sphere, and number of rows."""

_REACH = 4.0  # radii about a centre: what is beside an object, and what holds it
_BEHIND = 1.0  # radii of depth from which a return lies behind the object
_ON = (-1.3, 0.3)  # radii of depth within which a return may lie on the sphere
_PLACE = 0.1  # radii: beams nearer to each other than this pass at the same place
_N_BELOW = 2  # beams below a place: as few show nothing of what it stands on
_LIFTED = 2.0  # radii: the centre of what lies on the ground is not as high above it
_MEAN_WIDTH = 0.75  # of the greater half width of a beam: in any direction
_ABOUT, _N_HIDDEN = 1.3, 5  # radii about a centre where a face shows nothing, of so many pulses
_BODY, _BODY_REACH = 0.65, 0.3  # [m] from a head down to the middle of a body, and about that
_HALF_BODY, _DEEP = 0.25, 0.4  # [m] from that up and down, and in depth: beams on it end there
_BESIDE = (0.05, 0.12)  # [m] to a side of that: beams there pass a pole, and are on a body
_AS_DENSE = 0.8  # of the pulses on a sphere: as many are there at least
_HEADS = (1.6, 0.6)  # [m] above the ground, where heads may be
_TINY = 1e-6
_UNKNOWN = Hearing(lost=1.0, weakest=0.0)


class Evidence(NamedTuple):
    """Beams towards and about a group, counted by the depth at which they end.

    Attributes
    ----------
    n_on : int
        Returns inside the limb at the depth of the sphere.
    n_before : int
        Returns inside the limb that lie before the sphere: beams that would have met it.
    below : (2, 2, 2, 9)
        Beams below it and beside the pole: returns that are no deeper than it; returns behind it
        and pulses without a return. To the left and to the right; within ``BROAD`` radii and
        farther; by how far below, in ``ROW`` radii.
    lower : (2,)
        Beams 0.4 to 0.9 m below it and 0.05 to 0.12 m beside, where a body would be below a head:
        returns that are about as deep; returns behind and pulses without a return. Zero where no
        head can be.
    brightness : float
        Reflectivity of the surface, 0-255: least squares over the beams of ``n_on``, weighted by
        their shares inside the limb.
    n_distinct : int
        Number of places, a tenth of the radius wide, where the beams of ``n_on`` pass the centre:
        repeated beams are not independent.
    rows : (m,) int32
        Returns of the cloud whose beams pass within four radii, ascending.
    seen : (3, m)
        How these beams pass the centre, as from ``passing`` [m].
    faces : (m,)
        Plus or minus a half by the face of the scan that they are of.
    strengths : (m,)
        Reflectivity over squared range of each [1/m^2].
    silent : (3, k), optional
        Where pulses without a return pass it, across and up [m], and their face; None where times
        or rings do not show them.
    widths : (2, 2)
        Half the width of a beam across and up the line of sight: that by its width square to the
        spin axis, and that by its width along it. Their squares add [m].
    height, sigma_height : float
        Height of the centre above the ground about it, and its standard deviation [m]; infinite
        where too little ground is seen.
    """

    n_on: int
    n_before: int
    below: NDArray[np.int64]
    lower: NDArray[np.int64]
    brightness: float
    n_distinct: int
    rows: NDArray[np.int32]
    seen: Array
    faces: Array
    strengths: Array
    silent: Array | None
    widths: Array
    height: float = np.nan
    sigma_height: float = np.inf

    @property
    def blur(self) -> Array:
        """Half the width of a beam across and up the line of sight, (2,) [m]."""
        return np.asarray(np.hypot(*self.widths.T))

    @property
    def shows_below(self) -> bool:
        """Whether most of all beams below it, beside the pole or where a body would be, go past."""
        n_near, n_past = self.below.sum(axis=(1, 2, 3)) + self.lower
        return bool(n_past > _N_BELOW and n_past > n_near)

    def stands_free(self, radius: float) -> bool:
        """Return whether a ball of some radius [m] stands on nothing wide, as far as is seen."""
        n_near, n_past = self.below.sum(axis=(1, 2, 3)) + self.lower
        if n_near + n_past > _N_BELOW:
            return bool(n_past > n_near)
        return not self.height < _LIFTED * radius

    def shows_beside(self, radius: float) -> bool:
        """Return whether returns beside a ball of some radius [m], left and right, show a look."""
        reach, across = radius + self.blur[0], self.seen[0]
        return bool((across < -reach).any() and (across > reach).any())


def gather_evidence(
    cloud: StitchedCloud, cells: Cells, ground: Ground, centres: Array, target: Target
) -> tuple[list[Evidence], Hearing]:
    """Return the beams towards and about some centres, and how well the scan hears its echoes."""
    if not len(centres):
        return [], _UNKNOWN
    clock, _ = clock_of(cloud)
    hearing, heard = _UNKNOWN, np.zeros(0, np.intp)
    if clock is not None:
        hearing, heard = hearing_of(cloud, clock, target.up), heard_of(cloud, clock)
    planes = planes_below(ground, cells, centres)
    heights = np.sum(planes[:, :3] * centres, axis=1) + planes[:, 3]

    reach = _REACH * target.radius
    bends = np.zeros(0)
    if clock is not None and clock.bends.any():
        bends = errors_of_interpolation(cloud.gimbal_angles, np.arange(len(cloud.p_base)))

    may_be_head = np.abs(heights - _HEADS[0]) < _HEADS[1]
    may_be_head &= target.radius < _BODY - _HALF_BODY

    def unheard_at(known: Clock | None, c: Array, reach: float) -> Array | None:
        return None if known is None else unheard_about(known, heard, c, target.up, reach)

    def evidence_at(i: int) -> Evidence:
        rows = np.sort(rows_about(cloud.p_base, cells, centres[i], reach, np.inf))
        straight, known = rows, clock
        if clock is not None:
            straight, bend_max = _straight(rows, bends, _PLACE * target.radius, centres[i])
            known = clock._replace(bend_max=bend_max)
        silent = unheard_at(known, centres[i], REACH * target.radius)
        found = _evidence_at(cloud, silent, straight, centres[i], target)
        if may_be_head[i]:
            c = centres[i] - _BODY * target.up
            points = cloud.p_base[rows_about(cloud.p_base, cells, c, _BODY_REACH, np.inf)]
            lower = _lower_at(points, unheard_at(known, c, _BODY_REACH), c, target, found.n_on)
            found = found._replace(lower=lower)
        return found._replace(height=float(heights[i]), sigma_height=float(planes[i, 4]))

    def gathered(first: int, end: int) -> list[Evidence]:
        return [evidence_at(i) for i in range(first, end)]

    return list(chain(*side_by_side(gathered, len(centres), threaded_from=4))), hearing


def _lower_at(
    points: Column, silent: Array | None, c: Array, target: Target, n_on: int
) -> NDArray[np.int64]:
    """Return ``Evidence.lower`` at the middle of a body.

    Where nothing shows the pulses without a return, pulses are nearly as dense there as on the
    sphere.
    """
    n = np.asarray(_count_lower(points, np.empty((3, 0)) if silent is None else silent, c, target))
    if silent is None:
        blur = blur_at(c, target)
        wide = max(_BESIDE[1] - _BESIDE[0] - 1.5 * blur, 0.0)
        area = 4.0 * _HALF_BODY * wide / (np.pi * (target.radius + blur) ** 2)
        n[1] += max(int(_AS_DENSE * area * n_on) - n.sum(), 0)
    return n


def _straight(
    rows: NDArray[np.int32], bends: Array, most: float, c: Array
) -> tuple[NDArray[np.int32], float]:
    """Return the returns about a place whose gimbal angle is known, and how far it may be off.

    Where a gimbal starts or stops between two samples of its angle, scan lines seem to pass
    elsewhere. All are kept if most are of this kind. ``bends`` are empty where there are none.
    """
    bend_max = most / float(np.linalg.norm(c))
    is_straight = bends[rows] <= bend_max if len(bends) else np.ones(len(rows), np.bool_)
    if 2 * is_straight.sum() < len(rows):
        return rows, np.inf
    return rows[is_straight], bend_max


def _evidence_at(
    cloud: StitchedCloud,
    silent: Array | None,
    rows: NDArray[np.int32],
    c: Array,
    target: Target,
) -> Evidence:
    """Return the evidence of the beams of some returns, and of silent pulses between them."""
    angles = cloud.gimbal_angles[rows.astype(np.intp)]
    origins = _origins(cloud.rig, angles)
    points = cloud.p_base[rows]
    n_on, n_before, below, brightness, n_distinct, seen = _count_beams(
        points, cloud.intensities[rows], c, target, origins
    )
    faces = faces_of(cloud.rig, angles, c)
    if silent is not None:
        silent = _unhidden(silent, seen, faces, target.radius)
        passing, blur = silent / target.radius, blur_at(c, target) / target.radius
        below[1] += beside_pole(passing, blur)
    return Evidence(
        n_on=n_on,
        n_before=n_before,
        below=below,
        lower=np.zeros(2, np.int64),
        brightness=brightness,
        n_distinct=n_distinct,
        rows=rows,
        seen=seen,
        faces=faces,
        strengths=cloud.intensities[rows] / np.sum(points.astype(np.float64) ** 2, axis=1),
        silent=silent,
        widths=_half_widths(cloud.rig, angles, c, target),
    )


def _unhidden(silent: Array, seen: Array, faces: Array, radius: float) -> Array:
    """Return the pulses without a return but for those of a face that shows nothing of a place.

    What the other face shows stands there: something that sends no return hides it, as a mast of
    the rover that is too near.
    """
    is_about = np.hypot(seen[0], seen[1]) < _ABOUT * radius
    is_inside = np.hypot(silent[0], silent[1]) < radius
    for face in (-0.5, 0.5):
        is_own = silent[2] == face
        if np.sum(is_own & is_inside) >= _N_HIDDEN and not np.any(is_about & (faces == face)):
            return silent[:, ~is_own]
    return silent


def _origins(rig: Rig, angles: Column) -> Array:
    """Return where the beams under some gimbal angles leave the head, (2, n) [m]."""
    c, s, (x, y) = np.cos(angles), np.sin(angles), rig.T_head_lidar[:2, 3]
    return np.array([c * x - s * y, s * x + c * y], np.float64)


def _half_widths(rig: Rig, angles: Column, c: Array, target: Target) -> Array:
    """Return ``Evidence.widths`` at a place."""
    if not len(angles):
        return np.full((2, 2), blur_at(c, target)) * (1.0, 0.0)
    angle = angles[len(angles) // 2]
    x, y, z = rig.T_head_lidar[:3, 2]
    axis = (np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y, z)
    view = view_of(c, target.up)
    along = np.minimum(np.abs([np.dot(axis, view.across), np.dot(axis, view.up)]), 1.0)
    shares = np.column_stack([np.sqrt(1.0 - along * along), along])
    return np.asarray(0.5 * np.linalg.norm(c) * shares * rig.divergence)


@compiled
def beside_pole(silent: Array, blur: float) -> NDArray[np.int64]:
    """Return how many pulses without a return pass a sphere below it and beside its pole.

    To the left and to the right, within ``BROAD`` radii or farther, by how far below, (2, 2, 9).
    """
    n = np.zeros((2, 2, N_ROWS), np.int64)
    for i in range(silent.shape[1]):
        across, along = silent[0, i], silent[1, i]
        if is_beside_pole(abs(across), along, blur):
            n[int(across > 0.0), int(abs(across) > BROAD + blur), _row(along)] += 1
    return n


@compiled
def _row(along: float) -> int:
    """Return the row of a beam that passes below a sphere."""
    return min(int(-along / ROW), N_ROWS - 1)


@compiled
def _count_beams(
    points: Column,
    intensities: Column,
    c: Array,
    target: Target,
    origins: Array,
) -> tuple[int, int, NDArray[np.int64], float, int, Array]:
    """Return the counts of ``Evidence``, its brightness, and how the beams pass the centre.

    Those below it end near or go past, as ``Evidence`` counts them.
    """
    radius = target.radius
    blur = blur_at(c, target) / radius
    view = view_of(c, target.up)
    seen = seen_from(points, view)
    for i in range(len(points)):  # the beam leaves the head, not the origin of the base
        share, x, y = seen[2, i] / np.sqrt(np.sum(points[i] ** 2)), origins[0, i], origins[1, i]
        seen[0, i] += share * (view.across[0] * x + view.across[1] * y)
        seen[1, i] += share * (view.up[0] * x + view.up[1] * y)
    n_on, n_before, n_distinct, below = 0, 0, 0, np.zeros((2, 2, 2, N_ROWS), np.int64)
    light, lit = 0.0, 0.0
    half = int((1.0 + blur) / _PLACE) + 1
    is_met = np.zeros((2 * half, 2 * half), np.bool_)
    for i in range(len(points)):
        across, along, depth = np.abs(seen[0, i]) / radius, seen[1, i] / radius, seen[2, i] / radius
        gap = np.hypot(across, along)
        is_aimed = gap < 1.0 + blur and along > -0.9
        if is_aimed and _ON[0] < depth < _ON[1]:
            n_on += 1
            column = half + int(np.floor(seen[0, i] / radius / _PLACE))
            row = half + int(np.floor(along / _PLACE))
            n_distinct += not is_met[column, row]
            is_met[column, row] = True
            share = _share_inside((1.0 - gap) / (_MEAN_WIDTH * blur))
            light += share * intensities[i]
            lit += share * share
        n_before += is_aimed and depth <= _ON[0]
        if is_beside_pole(across, along, blur):
            side, down = int(seen[0, i] > 0.0), _row(along)
            below[int(depth > _BEHIND), side, int(across > BROAD + blur), down] += 1
    return n_on, n_before, below, light / max(lit, _TINY), n_distinct, seen


@compiled
def _count_lower(points: Column, silent: Array, c: Array, target: Target) -> NDArray[np.int64]:
    """Return how many beams pass where a body would be about a place: ``Evidence.lower``."""
    seen, blur = seen_from(points, view_of(c, target.up)), blur_at(c, target)
    n = np.zeros(2, np.int64)
    for i in range(len(points)):  # what is nearer hides it
        if _is_on_body(seen[0, i], seen[1, i], blur) and seen[2, i] > -_DEEP:
            n[int(seen[2, i] > _DEEP)] += 1
    for i in range(silent.shape[1]):
        n[1] += _is_on_body(silent[0, i], silent[1, i], blur)
    return n


@compiled
def _is_on_body(across: float, up: float, blur: float) -> bool:
    """Return whether a beam passes where a body would be, and not where a pole would; in m."""
    return bool(abs(up) < _HALF_BODY and _BESIDE[0] + blur < abs(across) < _BESIDE[1] - 0.5 * blur)


@compiled
def _share_inside(inside: float) -> float:
    """Return the share of a beam inside an outline that it enters by so many half widths."""
    inside = min(max(inside, -1.0), 1.0)
    return float((np.arccos(-inside) + inside * np.sqrt(1.0 - inside * inside)) / np.pi)
