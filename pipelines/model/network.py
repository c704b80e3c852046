"""What goes into the adjustment of a network, and what comes out of it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.errors import InputError
from spheremark.pipelines.geometry import by_motion
from spheremark.pipelines.model import Array, ErrorEllipse, Index, Mask

RANGE_BIAS = "common_range_bias"
"""Name of the common range bias: the amount by which all ranges are too long [m]."""

RANGE_SCALE = "range_scale"
"""Name of the scale of all ranges: the share by which they are too long."""

HEIGHT_BIAS = "common_height_bias"
"""Name of the common height bias: the amount by which all centres are too high [m]."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Refusal:
    """A station that is not in the network."""

    station: str  # its name
    code: str  # stable code of the error
    reason: str  # why, as a sentence for people


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class LeftOut:
    """An observation that is not used."""

    kind: str  # ``centre``, ``gravity`` or ``control``
    station: str  # whose observation; empty for a control mark
    marker: str  # what the marker is called at the station; empty where it is no centre
    mark: str  # name of the mark; empty where none is known
    reason: str  # why, as a sentence for people


class Finding(StrEnum):
    """What a station shows at the place of a mark."""

    MARKER = "marker"
    POSSIBLE = "possible"
    REFUSED = "refused"
    NOTHING = "nothing"
    HIDDEN = "hidden"


class Decision(StrEnum):
    """What all stations together make of a mark."""

    CONFIRMED = "confirmed"
    DOUBTFUL = "doubtful"
    REFUSED = "refused"


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class StationEvidence:
    """The evidence of one station that is near enough to a mark to see it."""

    station: str  # its name
    marker: str  # what the marker is called at the station; empty where there is none
    finding: Finding
    range: float  # distance from the station to the mark [m]
    log_odds: float  # natural logarithm of how much likelier a marker makes it than the decoy
    reason: str  # what it is there, as words; empty where nothing is known


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MarkEvidence:
    """The evidence of all stations on one mark, or on what may be one."""

    mark: str  # its name
    p_site: Array  # (3,) approximate place [m]
    decision: Decision
    probability: float  # posterior probability that a marker stands there
    decoy: str  # the most likely other hypothesis
    hypothesis: str  # the same with its odds, as words
    log_odds_prior: float  # of a marker against the decoy before any scan
    log_odds_radius: float  # what the own radius of all its fits adds, against another radius
    log_odds: float  # the same after all scans: the prior, the radius, and the sum over stations
    stations: tuple[StationEvidence, ...]

    def __post_init__(self) -> None:
        seal(self, {"p_site": (3,)})


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Shared:
    """Systematic errors common to all stations, which no single centre reveals."""

    # ``RANGE_BIAS``, ``RANGE_SCALE``, ``HEIGHT_BIAS``, optics, or parameters of the rig
    names: tuple[str, ...]
    derivatives: Array  # (n, 3, k) of each observed centre, in base, by each of them
    # (k, k) weights about zero: the inverse of a covariance, singular where nothing is known
    prior_weights: Array

    def __post_init__(self) -> None:
        k = len(self.names)
        n = len(self.derivatives)
        seal(self, {"derivatives": (n, 3, k), "prior_weights": (k, k)})

    @classmethod
    def none(cls, n: int) -> Shared:
        """Return no unknowns of n centres.

        Parameters
        ----------
        n : int
            Number of centres.

        Returns
        -------
        Shared
            Without names.
        """
        return cls(names=(), derivatives=np.zeros((n, 3, 0)), prior_weights=np.zeros((0, 0)))

    @classmethod
    def of_sensor(
        cls, p_base: Array, ups_base: Array, sigmas: tuple[float, float, float]
    ) -> Shared:
        """Return what all ranges of a survey are too long, and all centres too high.

        Parameters
        ----------
        p_base : (n, 3)
            Observed centres [m].
        ups_base : (n, 3)
            The up direction in base, for each.
        sigmas : tuple of float
            Standard deviations of bias [m] and scale of ranges, and of the heights [m], before
            anything is seen; 0 for no such unknown.

        Returns
        -------
        Shared
            With three names or fewer.
        """
        towards = p_base / np.linalg.norm(p_base, axis=1)[:, None]
        columns = ((RANGE_BIAS, towards), (RANGE_SCALE, p_base), (HEIGHT_BIAS, ups_base))
        known = [(*column, sigma) for column, sigma in zip(columns, sigmas, strict=True) if sigma]
        if not known:
            return cls.none(len(p_base))
        return cls(
            names=tuple(name for name, _, _ in known),
            derivatives=np.stack([derivative for _, derivative, _ in known], axis=-1),
            prior_weights=np.diag([sigma**-2.0 for _, _, sigma in known]),
        )

    def joined(self, other: Shared) -> Shared:
        """Return the unknowns of both.

        Parameters
        ----------
        other : Shared
            Other unknowns of the same centres.

        Returns
        -------
        Shared
            These first.
        """
        k = len(self.names)
        weights = np.zeros((k + len(other.names),) * 2)
        weights[:k, :k], weights[k:, k:] = self.prior_weights, other.prior_weights
        return Shared(
            names=(*self.names, *other.names),
            derivatives=np.concatenate([self.derivatives, other.derivatives], axis=2),
            prior_weights=weights,
        )


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Network:
    """Stations, marks and what was observed between them, with approximate values.

    Attributes
    ----------
    stations : tuple of str
        Names, all different.
    marks : tuple of str
        Names, all different.
    sightings : (n, 2)
        Place of station and mark of each observed centre, by station, each pair once.
    fits : (n,)
        Place of each centre among the fits of its station.
    markers : (n,) tuple of str
        What each is called at its station.
    p_base : (n, 3)
        Observed centres in the base frames of their stations [m].
    cov_p_base : (n, 3, 3)
        Their covariances, what all centres have in common included [m^2].
    heights_base : (n, 3)
        How one standard deviation of the error of height that all centres of a station have in
        common moves each of them; not in ``cov_p_base`` [m].
    R_station_base : (s, 3, 3)
        Measured levelling; the last row is the up direction in base.
    cov_up_base : (s, 3, 3)
        Covariance of that direction in base, of rank two [rad^2].
    sigma_headings : (s,)
        Standard deviation of what mounting and encoder leave unknown of each heading [rad].
    controls : (c,)
        Places of the control marks among the marks.
    p_control_site : (c, 3)
        Their given coordinates [m]; none make a free network.
    cov_control_site : (c, 3, 3)
        Their covariances, regular [m^2].
    T_site_base : (s, 4, 4)
        Approximate poses [m].
    p_site : (m, 3)
        Approximate marks [m].
    shared : Shared
        What all stations have in common.
    suspicions : (m,) tuple of str
        Why each mark may be false, as a sentence for people; empty where there is no reason.
    refused : tuple of Refusal
        Stations that share too little with the others.
    left_out : tuple of LeftOut
        Centres that are no marks of the network, control marks without an observation.
    evidence : tuple of MarkEvidence
        What all stations say of each mark, and of what may be one.
    """

    stations: tuple[str, ...]
    marks: tuple[str, ...]
    sightings: Index
    fits: Index
    markers: tuple[str, ...]
    p_base: Array
    cov_p_base: Array
    heights_base: Array
    R_station_base: Array
    cov_up_base: Array
    sigma_headings: Array
    controls: Index
    p_control_site: Array
    cov_control_site: Array
    T_site_base: Array
    p_site: Array
    shared: Shared
    suspicions: tuple[str, ...]
    refused: tuple[Refusal, ...] = ()
    left_out: tuple[LeftOut, ...] = ()
    evidence: tuple[MarkEvidence, ...] = ()

    def __post_init__(self) -> None:
        n, s, m, c = (len(x) for x in (self.sightings, self.stations, self.marks, self.controls))
        seal(
            self,
            {
                "sightings": (n, 2),
                "fits": (n,),
                "p_base": (n, 3),
                "cov_p_base": (n, 3, 3),
                "heights_base": (n, 3),
                "R_station_base": (s, 3, 3),
                "cov_up_base": (s, 3, 3),
                "sigma_headings": (s,),
                "controls": (c,),
                "p_control_site": (c, 3),
                "cov_control_site": (c, 3, 3),
                "T_site_base": (s, 4, 4),
                "p_site": (m, 3),
            },
        )
        if (k := len(self.shared.derivatives)) != n:
            raise InputError(f"There are {n} centres, but derivatives of {k}.")
        if len(self.markers) != n:
            raise InputError(f"There are {n} centres, but names of {len(self.markers)}.")
        if len(self.suspicions) != m:
            raise InputError(f"There are {m} marks, but suspicions about {len(self.suspicions)}.")

    @property
    def sigma_range(self) -> float:
        """What the range bias is known to beforehand; 0 where there is no such unknown [m]."""
        if RANGE_BIAS not in self.shared.names:
            return 0.0
        place = self.shared.names.index(RANGE_BIAS)
        return float(self.shared.prior_weights[place, place] ** -0.5)

    @property
    def sigma_heights(self) -> Array:
        """Mean size of the error of height that the centres of each station share, (s,) [m]."""
        sizes, n = np.linalg.norm(self.heights_base, axis=1), len(self.stations)
        counts = np.bincount(self.sightings[:, 0], minlength=n)
        return np.asarray(np.bincount(self.sightings[:, 0], sizes, n) / np.maximum(counts, 1))

    @property
    def is_free(self) -> bool:
        """Whether the marks alone fix position and direction of the network."""
        return len(self.controls) == 0

    @property
    def n_blocks(self) -> int:
        """Number of blocks of observations: centres, gravity of each station, control marks."""
        return len(self.sightings) + len(self.stations) + len(self.controls)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class BlockTests:
    """Statistics of blocks of observations, one row per block."""

    # (b, k) observed minus computed, in the site frame [m], or of the up direction [rad]
    residuals: Array
    # (b,) redundancy of the block's observations together; NaN where it is not used
    redundancies: Array
    # (b,) largest absolute w-statistic of the block; NaN where not testable or not used
    w_statistics: Array
    # (b,) minimal detectable bias along the weakest axis; infinite if none is, NaN if not used
    detectable_biases: Array

    def __post_init__(self) -> None:
        b = len(self.residuals)
        columns = dict.fromkeys(("redundancies", "w_statistics", "detectable_biases"), (b,))
        seal(self, {"residuals": self.residuals.shape, **columns})


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Parts:
    """What the joint covariance of stations, marks and shared unknowns is made of."""

    # (s, 6, 6) covariance of each station's motion if marks and shared unknowns were known
    own: Array
    # (s, 6, 3m + k) how much a station moves, with the sign turned, when marks and shared unknowns
    # move
    coupling: Array
    cov_common: Array  # (3m + k, 3m + k) covariance of marks and shared unknowns

    def __post_init__(self) -> None:
        s, u = len(self.own), len(self.cov_common)
        seal(self, {"own": (s, 6, 6), "coupling": (s, 6, u), "cov_common": (u, u)})


class Repeat(NamedTuple):
    """Two stations at one place, each with its own centres alone."""

    stations: tuple[int, int]  # (2,) places among the stations
    apart: Array  # (3,) how far the second stands from the first, after the adjustment [m]
    n_marks: int  # marks that both saw
    # root mean square 3-D difference of the centres, laid on each other by a rigid motion [m]
    rms: float
    predicted_rms: float  # what their covariances promise [m]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class AdjustedNetwork:
    """All stations and marks of a survey, adjusted together.

    Attributes
    ----------
    network : Network
        What was observed.
    T_site_station : (s, 4, 4)
        Poses of the levelled frames [m].
    cov_T_site_station : (s, 6, 6)
        Covariance of a small motion of each, (rotation [rad], translation [m]) on the left.
    station_covariances : (s, 3, 3)
        Covariance of each station's position [m^2]. Kept apart: far from the origin the one of the
        motion has too few digits for it.
    p_site : (m, 3)
        Marks [m].
    cov_p_site : (3m, 3m)
        Their joint covariance [m^2].
    used : (b,)
        Whether each block is used: centres, then gravity, then control marks.
    centres : BlockTests
        Of the observed centres.
    gravity : BlockTests
        Of the stations' levelling.
    control : BlockTests
        Of the control marks.
    station_shifts : (n,)
        External reliability: largest shift of its station that a just undetectable bias of each
        centre causes; infinite where a bias cannot be detected, NaN where not used [m].
    mark_shifts : (n,)
        The same of its mark [m].
    heights : (s,)
        What the centres of each station are too high, in units of ``Network.heights_base``.
    sigma_heights : (s,)
        Standard deviations of these, 1 where nothing determines them.
    shared : (k,)
        The unknowns that all stations share, as estimated.
    cov_shared : (k, k)
        Their covariance.
    parts : Parts
        What the joint covariance of all is made of.
    control_predictions : (c, 3)
        Where each control mark would be by all else, minus where it is given; NaN where nothing
        else determines it [m].
    cov_control_predictions : (c, 3, 3)
        Covariances of these differences [m^2].
    mark_weaknesses : tuple of str
        Why each mark should be used with care, as a sentence for people; empty where there is no
        reason.
    dof : int
        Degrees of freedom: observations minus unknowns plus the datum's defect.
    vtpv : float
        Weighted sum of squares of the residuals.
    sigma0 : float
        Square root of the a-posteriori variance factor (a priori 1); NaN without redundancy.
    passes_global_test : bool
        Whether the residuals are no larger than the sigmas promise.
    limit_vtpv : float
        Largest ``vtpv`` that passes.
    variance_factors : (3,)
        Sum of squares over redundancy of centres, gravity and control; NaN without redundancy.
    critical_w : float
        Largest w that is not a gross error.
    noncentrality : float
        How many sigmas a bias must move w to be found with the power of the test.
    left_out : tuple of LeftOut
        All observations that are not used.
    warnings : tuple of str
        Why the network cannot be relied on, in sentences; empty when it can.
    repeats : tuple of Repeat
        Stations that stand at one place, compared with each other.
    """

    network: Network
    T_site_station: Array
    cov_T_site_station: Array
    station_covariances: Array
    p_site: Array
    cov_p_site: Array
    used: Mask
    centres: BlockTests
    gravity: BlockTests
    control: BlockTests
    station_shifts: Array
    mark_shifts: Array
    heights: Array
    sigma_heights: Array
    shared: Array
    cov_shared: Array
    parts: Parts
    control_predictions: Array
    cov_control_predictions: Array
    mark_weaknesses: tuple[str, ...]
    dof: int
    vtpv: float
    sigma0: float
    passes_global_test: bool
    limit_vtpv: float
    variance_factors: Array
    critical_w: float
    noncentrality: float
    left_out: tuple[LeftOut, ...]
    warnings: tuple[str, ...]
    repeats: tuple[Repeat, ...] = ()

    def __post_init__(self) -> None:
        s, m = len(self.network.stations), len(self.network.marks)
        n = len(self.network.sightings)
        seal(
            self,
            {
                "T_site_station": (s, 4, 4),
                "cov_T_site_station": (s, 6, 6),
                "station_covariances": (s, 3, 3),
                "p_site": (m, 3),
                "cov_p_site": (3 * m, 3 * m),
                "used": (self.network.n_blocks,),
                "station_shifts": (n,),
                "mark_shifts": (n,),
                "heights": (s,),
                "sigma_heights": (s,),
                "shared": (len(self.network.shared.names),),
                "control_predictions": self.network.p_control_site.shape,
                "cov_control_predictions": self.network.cov_control_site.shape,
                "variance_factors": (3,),
            },
        )

    @property
    def range_bias(self) -> float:
        """What all ranges of the survey are too long; 0 where the network has no such unknown."""
        names = self.network.shared.names
        return float(self.shared[names.index(RANGE_BIAS)]) if RANGE_BIAS in names else 0.0

    @property
    def sigma_range_bias(self) -> float:
        """Standard deviation of the range bias [m]."""
        names = self.network.shared.names
        if RANGE_BIAS not in names:
            return 0.0
        place = names.index(RANGE_BIAS)
        return float(np.sqrt(self.cov_shared[place, place]))

    @property
    def shared_redundancies(self) -> Array:
        """Redundancy number of the prior of each shared unknown, (k,)."""
        return np.asarray(1.0 - np.diag(self.network.shared.prior_weights @ self.cov_shared))

    @property
    def n_observations(self) -> int:
        """Observed coordinates and angles that are used, and priors of systematic errors."""
        n, s = len(self.network.sightings), len(self.network.stations)
        centres, gravity, control = (int(part.sum()) for part in np.split(self.used, [n, n + s]))
        return 3 * centres + 2 * gravity + 3 * control + self._n_systematic

    @property
    def n_unknowns(self) -> int:
        """Coordinates, angles and systematic errors that are estimated."""
        network = self.network
        return 6 * len(network.stations) + 3 * len(network.marks) + self._n_systematic

    @property
    def _n_systematic(self) -> int:
        """Unknowns with a prior: what all stations share, and heights of stations."""
        return len(self.network.shared.names) + int(np.sum(self.network.sigma_heights > 0.0))

    @property
    def sightings_used(self) -> Index:
        """Station and mark of each centre that is used, (k, 2)."""
        sightings = self.network.sightings
        return np.asarray(sightings[self.used[: len(sightings)]])

    @property
    def p_base(self) -> Array:
        """Observed centres less what all have in common, (n, 3) [m]."""
        network = self.network
        lifted = self.heights[network.sightings[:, 0], None] * network.heights_base
        return np.asarray(network.p_base - lifted - network.shared.derivatives @ self.shared)

    @property
    def cov_positions(self) -> Array:
        """Joint covariance of all stations' positions, then all marks, (3s + 3m, 3s + 3m) [m^2].

        Grows with the square of the stations: for networks of tens of them.
        """
        s, m = len(self.T_site_station), len(self.p_site)
        J = by_motion(self.T_site_station[:, :3, 3])
        coupled = (J @ self.parts.coupling).reshape(3 * s, -1)
        own = J @ self.parts.own @ np.swapaxes(J, -1, -2)
        stations = coupled @ self.parts.cov_common @ coupled.T
        for i, cov in enumerate(own):
            stations[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += cov
        between = -coupled @ self.parts.cov_common[:, : 3 * m]
        return np.block([[stations, between], [between.T, self.cov_p_site]])

    @property
    def mark_covariances(self) -> Array:
        """Covariance of each mark, (m, 3, 3) [m^2]."""
        m = len(self.p_site)
        return np.asarray(np.einsum("iaib->iab", self.cov_p_site.reshape(m, 3, m, 3)))

    @property
    def station_ellipses(self) -> tuple[ErrorEllipse, ...]:
        """Error ellipse of the horizontal position of each station."""
        return tuple(ErrorEllipse.of(cov) for cov in self.station_covariances)

    @property
    def mark_ellipses(self) -> tuple[ErrorEllipse, ...]:
        """Error ellipse of the horizontal position of each mark."""
        return tuple(ErrorEllipse.of(cov) for cov in self.mark_covariances)


def seal(value: object, shapes: dict[str, tuple[int, ...]]) -> None:
    """Check the shape of each named array and make it read-only.

    Parameters
    ----------
    value : object
        Whose arrays.
    shapes : dict
        Expected shape by name.

    Raises
    ------
    InputError
        If an array has another shape.
    """
    for name, shape in shapes.items():
        array = getattr(value, name)
        if array.shape != shape:
            kind = type(value).__name__
            raise InputError(f"{kind}.{name} has shape {array.shape}, not {shape}.")
        array.flags.writeable = False
