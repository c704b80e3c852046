"""How well a sphere's centre will be known from a place: the planner's model of accuracy.

Two sources: what the sensor's returns are worth (``sensor_model``), and how the fits of a user's
own surveys differ from that (``fitting_model.fitted_model``).
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.model import Array, seal
from spheremark.pipelines.placement.plan import Arrangement, Sights
from spheremark.pipelines.placement.sensor import Returns, Sensor, returns_of
from spheremark.pipelines.placement.visibility import N_STRIPS

AXES = ("towards", "left", "up")
"""The axes of a centre's uncertainty, as seen from the stop."""

TERMS = ("distance", "count", "incidence", "reflectivity")
"""What the fits of a survey may say otherwise than the sensor model, beside a factor by axis."""

REFERENCE_DISTANCE = 8.0
"""Distance at which the factors of a model hold [m]."""

# Variance of fits by ``along_beam`` over the bound of their returns: towards, left, up. Pooled over
# 700 simulated spheres from 2 to 16 m; the outline gives back what the pole and lost limbs cost.
_EFFICIENCY = (0.85, 1.02, 0.93)
Group = tuple[Any, ...]  # arrays and numbers that go together into a kernel
# A surface close behind a sphere mixes with the returns of its limb, and touches it where it is too
# near to be told apart. Over 130 simulated spheres at 0.2 to 0.85 m before a wall.
_TOUCHING, _MIXING = 0.15, 0.85  # [m]
_MIXED_RETURNS, _MIXED_VARIANCE = 0.79, 2.5
_LOST_MAX = 0.05  # share of places between the lines where a sphere may be missed


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Provenance:
    """Where a model's numbers come from.

    Attributes
    ----------
    source : str
        ``sensor``, or ``fitted``.
    n_rows, n_stops : int
        Fits and stops that it rests on; 0 for the sensor model.
    surveys : tuple of str
        Names of the surveys that they are from.
    fit_method : str
        Fitting method that they are from; empty for the sensor model.
    newest : str
        When the newest of them was made, ISO 8601; empty likewise.
    note : str
        What a user should know, for people.
    """

    source: str
    n_rows: int = 0
    n_stops: int = 0
    surveys: tuple[str, ...] = ()
    fit_method: str = ""
    newest: str = ""
    note: str = ""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class CentreModel:
    """How many returns a sphere will have, and the covariance of its centre.

    Attributes
    ----------
    sensor : Sensor
        The sensor and how it is driven.
    marker_radius : float
        Radius of the spheres [m].
    log_factors : (7,)
        Logarithms of variance over the sensor model's: of the three ``AXES`` at the reference, and
        the powers of the four ``TERMS``.
    cov_log_factors : (7, 7)
        Their covariance.
    log_count : (2,)
        Logarithm of returns over the sensor model's, and its standard deviation.
    at : (4,)
        The terms' values where a mark will stand less those at the reference, in logarithms; the
        first two are replaced by those of each mark.
    provenance : Provenance
        Where the numbers come from.
    """

    sensor: Sensor
    marker_radius: float
    log_factors: Array
    cov_log_factors: Array
    log_count: Array
    at: Array
    provenance: Provenance = field(default_factory=lambda: Provenance(source="sensor"))

    def __post_init__(self) -> None:
        k = len(AXES) + len(TERMS)
        seal(self, log_factors=(k,), cov_log_factors=(k, k), log_count=(2,), at=(len(TERMS),))

    @property
    def version(self) -> str:
        """First 16 hexadecimal digits of the SHA-256 of all its numbers."""
        numbers = {
            "sensor": asdict(self.sensor),
            "marker_radius": self.marker_radius,
            "log_factors": self.log_factors.tolist(),
            "cov_log_factors": self.cov_log_factors.tolist(),
            "log_count": self.log_count.tolist(),
            "at": self.at.tolist(),
            "rows": self.provenance.n_rows,
        }
        text = json.dumps(numbers, sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @property
    def returns(self) -> Returns:
        """What the returns of a sphere are worth."""
        return returns_of(self.sensor, self.marker_radius, N_STRIPS)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Centres:
    """What is to be expected of each mark's centre from each eye.

    Attributes
    ----------
    shares : (e, n)
        Share of the returns of a wholly visible sphere, 0 to 1.
    n_points : (e, n)
        Expected returns.
    lost : (e, n)
        Probability that lines pass the sphere by; 1 where a surface touches it.
    cov_site : (e, n, 3, 3)
        Covariance of the centre by the noise of its returns, in the axes of the site; infinite on
        the diagonal where nothing is seen [m^2].
    """

    shares: Array
    n_points: Array
    lost: Array
    cov_site: Array


def sensor_model(sensor: Sensor, marker_radius: float = 0.100) -> CentreModel:
    """Return the model that follows from the sensor alone.

    Parameters
    ----------
    sensor : Sensor
        The sensor and how it is driven.
    marker_radius : float
        Radius of the spheres [m].

    Returns
    -------
    CentreModel
        The bound of the returns times the efficiency of the fit in simulation.
    """
    k = len(AXES) + len(TERMS)
    return CentreModel(
        sensor=sensor,
        marker_radius=marker_radius,
        log_factors=np.zeros(k),
        cov_log_factors=np.zeros((k, k)),
        log_count=np.zeros(2),
        at=np.zeros(len(TERMS)),
        provenance=Provenance(
            source="sensor",
            note="No fits of a survey of one's own: the bound of the sensor's returns is used.",
        ),
    )


def expect_centres(
    model: CentreModel, eyes_site: Array, marks: Arrangement, sights: Sights
) -> Centres:
    """Say what is to be expected of marks' centres.

    Notes
    -----
    The information of the returns of the visible part of a disc is inverted as it is: a sphere of
    which only the top is seen has a height that hangs on its distance. Returns thicken with the
    secant of elevation. Of a sphere before a surface a fifth fewer carry the centre, whose errors
    are larger for what is mixed.
    """
    table, sensor = model.returns, model.sensor
    shape = (len(eyes_site), len(marks.names))
    shares, n_points, lost = np.zeros(shape), np.zeros(shape), np.ones(shape)
    covs = np.empty((*shape, 3, 3))
    factors = np.array(_EFFICIENCY) * np.exp(
        model.log_factors[:3] + model.log_factors[5:] @ model.at[2:]
    )
    _expect(
        (np.ascontiguousarray(eyes_site), np.ascontiguousarray(marks.p_site), sights.lowest),
        (table.distances, table.areas, table.information, table.spread, table.lost[:, 1]),
        (factors, model.log_factors[3], model.log_factors[4], float(np.exp(model.log_count[0]))),
        (
            1.0 / (sensor.line_spacing * sensor.shot_spacing),
            np.sin(sensor.elevations[0]),
            np.sin(sensor.elevations[1]),
            model.marker_radius,
            0.5 * max(sensor.divergence),
        ),
        (shares, n_points, lost, covs),
    )
    is_mixed = sights.gaps < _MIXING
    n_points[is_mixed] *= _MIXED_RETURNS
    covs[is_mixed] *= _MIXED_VARIANCE
    lost[sights.gaps < _TOUCHING] = 1.0
    return Centres(shares=shares, n_points=n_points, lost=lost, cov_site=covs)


def is_found(centres: Centres, n_points_min: float, share_min: float) -> np.ndarray:
    """Tell which spheres will be found."""
    is_shown = (centres.n_points >= n_points_min) & (centres.shares >= share_min)
    return np.asarray(is_shown & (centres.lost <= _LOST_MAX))


@compiled
def _seen(
    table: Group, place: float, lowest: np.ndarray, share: float, info: Array
) -> tuple[float, float]:
    """Fill in the information of the visible part of a disc; return its area and that of all.

    The disc of the table is wider than the sphere, by what footprints reach: the sphere is a share
    of it.
    """
    areas, information = table[1], table[2]
    n_strips, n_rows = areas.shape[1], areas.shape[2] - 1
    i = int(place)
    seen, whole = 0.0, 0.0
    info[:] = 0.0
    for c in range(n_strips):
        cut = lowest[c] if abs(lowest[c]) >= 1.0 else lowest[c] * share
        rows = 0.5 * (1.0 - cut) * n_rows
        k = min(int(rows), n_rows - 1)
        w = rows - k
        for side in range(2):
            part = place - i if side == 1 else 1.0 - place + i
            whole += part * areas[i + side, c, n_rows]
            lower, upper = part * (1.0 - w), part * w
            seen += lower * areas[i + side, c, k] + upper * areas[i + side, c, k + 1]
            for q in range(6):
                info[q] += lower * information[i + side, c, k, q]
                info[q] += upper * information[i + side, c, k + 1, q]
    return seen, whole


@compiled
def _local(info: Array, density: float, out: Array) -> bool:
    """Fill in the covariance towards, left and up; false where nothing determines it."""
    a, b, c = density * info[0] + 1.0, density * info[1], density * info[2]
    g, h, f = density * info[3] + 1.0, density * info[4], density * info[5] + 1.0
    det = a * (g * f - h * h) - b * (b * f - h * c) + c * (b * h - g * c)
    if det <= 0.0:
        return False
    out[0, 0], out[1, 1], out[2, 2] = g * f - h * h, a * f - c * c, a * g - b * b
    out[0, 1] = out[1, 0] = c * h - b * f
    out[0, 2] = out[2, 0] = b * h - c * g
    out[1, 2] = out[2, 1] = b * c - a * h
    out /= det
    return True


@compiled
def _axes(v: Array, d: float, flat: float, out: Array) -> None:
    """Fill in the axes towards, left and up, in columns."""
    out[:, 0] = v / d
    out[0, 1], out[1, 1], out[2, 1] = -v[1] / flat, v[0] / flat, 0.0
    out[0, 2], out[1, 2] = -v[2] * v[0] / (d * flat), -v[2] * v[1] / (d * flat)
    out[2, 2] = flat / d


@compiled
def _expect(places: Group, table: Group, factors: Group, constants: Group, out: Group) -> None:
    """Fill in shares, counts, chances of loss and covariances of every eye and mark."""
    eyes, marks, lowest = places
    distances, spread, lost_at = table[0], table[3], table[4]
    axis_factors, by_distance, by_count, count_factor = factors
    density, sine_min, sine_max, radius, flare = constants
    shares, n_points, lost, covs = out
    first, ratio = np.log(distances[0]), np.log(distances[1] / distances[0])
    info, local, axes, v = np.empty(6), np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for e in range(len(eyes)):
        for m in range(len(marks)):
            covs[e, m] = np.diag(np.full(3, np.inf))
            v[:] = marks[m] - eyes[e]
            flat = max(np.hypot(v[0], v[1]), 1e-9)
            d = np.hypot(flat, v[2])
            place = (np.log(d) - first) / ratio
            is_far = place < 0.0 or place >= len(distances) - 1.0
            if is_far or v[2] < sine_min * d or v[2] > sine_max * d:
                continue
            i = int(place)
            t = place - i
            seen, whole = _seen(table, place, lowest[e, m], radius / (radius + flare * d), info)
            here = count_factor * density / (d * flat)
            shares[e, m] = seen / whole
            n_points[e, m] = here * seen
            lost[e, m] = (1.0 - t) * lost_at[i] + t * lost_at[i + 1]
            if shares[e, m] <= 1e-6 or not _local(info, here, local):
                continue
            extra = (d / REFERENCE_DISTANCE) ** by_distance * max(shares[e, m], 1e-3) ** by_count
            scale = np.sqrt(axis_factors * extra * ((1.0 - t) * spread[i] + t * spread[i + 1]))
            _axes(v, d, flat, axes)
            axes *= scale
            covs[e, m] = axes @ local @ axes.T
