"""Accuracy of a sphere's centre from a station, before any scan.

Two sources: what the sensor's returns are worth (``sensor_model``), and how the fits of a user's
own surveys differ from that (``empirical_model.fitted_model``).
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.model import Array, Column, Mask, seal
from spheremark.pipelines.placement.plan import Arrangement, Visibility
from spheremark.pipelines.placement.sensor import Returns, Sensor, returns_of
from spheremark.pipelines.placement.visibility import N_STRIPS, TOUCHING

AXES = ("towards", "left", "up")
"""The axes of a centre's uncertainty, as seen from the stop."""

TERMS = ("distance", "count", "incidence", "reflectivity")
"""Causes by which fits of a survey may differ from the sensor model, beside a factor by axis."""

REFERENCE_DISTANCE = 8.0
"""Distance at which the factors of a model hold [m]."""

# Variance of fits by ``along_beam`` over the bound of their returns: towards, left, up. Pooled over
# 700 simulated spheres from 2 to 16 m; the limb gives back what the pole and lost edges cost.
_EFFICIENCY = (0.85, 1.02, 0.93)
# A surface close behind a sphere mixes with the returns of its limb. Over 130 simulated spheres at
# 0.2 to 0.85 m before a wall.
_MIXING = 0.85  # [m]
_MIXED_RETURNS, _MIXED_VARIANCE = 0.79, 2.5
_MISSED = 0.7  # times the root of the returns: spheres that are not found or not matched
_LOST_MAX = 0.05  # share of places between the lines where a sphere may be missed


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Provenance:
    """Where a model's numbers come from."""

    source: str  # ``sensor``, or ``fitted``
    n_rows: int = 0  # fits and stops that it rests on; 0 for the sensor model
    n_stops: int = 0
    surveys: tuple[str, ...] = ()  # names of the surveys that they are from
    fit_method: str = ""  # fitting method that they are from; empty for the sensor model
    newest: str = ""  # when the newest of them was made, ISO 8601; empty likewise
    note: str = ""  # what a user should know, for people


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class CentreModel:
    """How many returns a sphere will have, and the covariance of its centre."""

    sensor: Sensor  # the sensor and how it is driven
    marker_radius: float  # radius of the spheres [m]
    # (7,) logarithms of variance over the sensor model's: of the three ``AXES`` at the reference,
    # and the powers of the four ``TERMS``
    log_factors: Array
    cov_log_factors: Array  # (7, 7) their covariance
    # (2,) logarithm of returns over the sensor model's, and its standard deviation
    log_count: Array
    # (4,) the terms' values where a mark will stand less those at the reference, in logarithms; the
    # first two are replaced by those of each mark
    at: Array
    # where the numbers come from
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
    """Prediction of each mark's centre from each station."""

    shares: Array  # (s, n) share of the returns of a wholly visible sphere, 0 to 1
    n_points: Array  # (s, n) expected returns
    lost: Array  # (s, n) probability that lines pass the sphere by; 1 where a surface touches it
    parted: Array  # (s, n) probability that the mounting parts its two faces too far
    sigma_aim: Array  # (s, n) standard deviation of its direction by mounting and encoder [rad]
    # (s, n, 3, 3) covariance of the centre by the noise of its returns, in the axes of the site;
    # infinite on the diagonal where nothing is seen [m^2]
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
    model: CentreModel, stations_site: Array, marks: Arrangement, visibility: Visibility
) -> Centres:
    """Predict the centres of marks.

    Notes
    -----
    The information of the returns of the visible part of a disc is inverted whole: a sphere of
    which only the top is seen has a height that is correlated with its distance. Returns thicken
    with the secant of elevation. Of a sphere before a surface a fifth fewer carry the centre, whose
    errors are larger by the mixed ones.
    """
    sensor, table = model.sensor, model.returns
    v = marks.p_site[None] - stations_site[:, None]
    flat = np.maximum(np.hypot(v[..., 0], v[..., 1]), 1e-9)
    d = np.hypot(flat, v[..., 2])
    first, second = np.log(table.distances[:2])
    place = (np.log(d) - first) / (second - first)
    sines = np.sin(sensor.elevations)
    is_near = (place >= 0.0) & (place < len(table.distances) - 1.0)
    is_near &= (v[..., 2] >= sines[0] * d) & (v[..., 2] <= sines[1] * d)
    place = np.where(is_near, place, 0.0)
    # the disc of the table is wider than the sphere, by what footprints reach
    share_of_disc = model.marker_radius / (model.marker_radius + 0.5 * max(sensor.divergence) * d)
    sums = np.zeros((*place.shape, 8))
    areas, worth = table.areas, table.information
    _add_visible(place, is_near, visibility.lowest, share_of_disc, (areas, worth), sums)
    seen, whole = sums[..., 6], sums[..., 7]
    per_sr = float(np.exp(model.log_count[0])) * sensor.density
    density = np.where(is_near, per_sr / (d * flat), 0.0)
    shares = np.where(is_near, seen / np.where(whole > 0.0, whole, 1.0), 0.0)
    n_points, lost = density * seen, np.where(is_near, _at(table.lost, place), 1.0)
    local, is_known = _local_covariances(density[..., None] * sums[..., :6])
    is_known &= shares > 1e-6
    factors = np.array(_EFFICIENCY) * np.exp(
        model.log_factors[:3] + model.log_factors[5:] @ model.at[2:]
    )
    factors = factors * _at(table.spread, place)
    factors *= ((d / REFERENCE_DISTANCE) ** model.log_factors[3])[..., None]
    factors *= (np.maximum(shares, 1e-3) ** model.log_factors[4])[..., None]
    axes = _axes(v, d, flat) * np.sqrt(factors)[..., None, :]
    covs = axes @ local @ np.swapaxes(axes, -1, -2)
    is_mixed = visibility.gaps < _MIXING
    n_points[is_mixed] *= _MIXED_RETURNS
    covs[is_mixed] *= _MIXED_VARIANCE
    covs[~is_known] = np.diag(np.full(3, np.inf))
    lost[visibility.gaps < model.marker_radius + TOUCHING] = 1.0
    aims = _at(table.aim, place)
    return Centres(
        shares=shares,
        n_points=n_points,
        lost=lost,
        parted=_at(table.parted, place),
        sigma_aim=aims,
        cov_site=covs,
    )


def centres_ahead(model: CentreModel, distances: Array) -> tuple[Array, Array]:
    """Return returns and variances towards, left and up at distances on open level ground [m^2]."""
    n = len(distances)
    marks = Arrangement.numbered(np.column_stack([distances, np.zeros((n, 2))]))
    centres = expect_centres(model, np.zeros((1, 3)), marks, Visibility.open(1, n, N_STRIPS))
    return centres.n_points[0], np.einsum("nii->ni", centres.cov_site[0])


def detection(centres: Centres) -> Array:
    """Return the probability that the chain finds and matches each sphere that is seen.

    An empirical curve, with no theory behind it: fitted to 736 spheres on poles, clear of surfaces,
    in even random worlds, of which 0.83 were found with 20 to 30 returns, 0.92 with 50 to 100, 0.97
    with more than 500.
    """
    missed = np.minimum(_MISSED / np.sqrt(np.maximum(centres.n_points, 1.0)), 1.0)
    return np.asarray((1.0 - centres.lost) * (1.0 - centres.parted) * (1.0 - missed))


def is_found(centres: Centres, n_points_min: float, share_min: float) -> Mask:
    """Return which spheres will be found."""
    is_shown = (centres.n_points >= n_points_min) & (centres.shares >= share_min)
    return np.asarray(is_shown & (centres.lost <= _LOST_MAX))


def _at(column: Array, place: Array) -> Array:
    """Interpolate a column of the table of returns."""
    i = place.astype(np.intp)
    t = (place - i).reshape(place.shape + (1,) * (column.ndim - 1))
    return np.asarray((1.0 - t) * column[i] + t * column[i + 1])


def _local_covariances(info: Array) -> tuple[Array, Mask]:
    """Return covariances towards, left and up from upper triangles, and where there is one.

    A prior of 1 m keeps them finite.
    """
    a, b, c, g, h, f = np.moveaxis(info + np.array([1.0, 0.0, 0.0, 1.0, 0.0, 1.0]), -1, 0)
    xx, xy, xz = g * f - h * h, c * h - b * f, b * h - c * g
    rows = (xx, xy, xz), (xy, a * f - c * c, b * c - a * h), (xz, b * c - a * h, a * g - b * b)
    det = a * xx + b * xy + c * xz
    adjugate = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    return adjugate / np.where(det > 0.0, det, 1.0)[..., None, None], det > 0.0


def _axes(v: Array, d: Array, flat: Array) -> Array:
    """Return the axes towards, left and up of vectors, in columns."""
    out = np.zeros((*v.shape, 3))
    out[..., 0] = v / d[..., None]
    out[..., 0, 1], out[..., 1, 1] = -v[..., 1] / flat, v[..., 0] / flat
    out[..., :2, 2] = -v[..., 2:] * v[..., :2] / (d * flat)[..., None]
    out[..., 2, 2] = flat / d
    return out


@compiled
def _add_visible(
    places: Array,
    is_near: Mask,
    lowest: Column,
    share_of_disc: Array,
    table: tuple[Array, Array],
    sums: Array,
) -> None:
    """Add up the visible parts of discs: information (6), area, and the area of the whole disc."""
    areas, information = table
    n_strips, n_rows = areas.shape[1], areas.shape[2] - 1
    for e in range(places.shape[0]):
        for m in range(places.shape[1]):
            if not is_near[e, m]:
                continue
            i = int(places[e, m])
            for c in range(n_strips):
                cut = np.float64(lowest[e, m, c])
                if abs(cut) < 1.0:
                    cut *= share_of_disc[e, m]
                rows = 0.5 * (1.0 - cut) * n_rows
                k = min(int(rows), n_rows - 1)
                w = rows - k
                for side in range(2):
                    part = places[e, m] - i if side == 1 else 1.0 - places[e, m] + i
                    lower, upper = part * (1.0 - w), part * w
                    for q in range(6):
                        sums[e, m, q] += lower * information[i + side, c, k, q]
                        sums[e, m, q] += upper * information[i + side, c, k + 1, q]
                    sums[e, m, 6] += lower * areas[i + side, c, k]
                    sums[e, m, 6] += upper * areas[i + side, c, k + 1]
                    sums[e, m, 7] += part * areas[i + side, c, n_rows]
