"""Spheres in a scan: candidates, fitted centres, and groups that were refused."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from spheremark.pipelines.model.arrays import Array, Column, Index, same_length, seal
from spheremark.pipelines.model.scan import Levelling


class Status(StrEnum):
    """How far a result can be relied on."""

    OK = "ok"
    WEAK = "weak"


def _no_numbers() -> Array:
    """Return no numbers."""
    return np.zeros(0)


def _no_rows() -> Index:
    """Return no rows."""
    return np.zeros(0, dtype=np.intp)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MarkerCandidate:
    """A group of returns that may be a marker."""

    name: str  # name of the marker at this stop, the same for every method
    # (n,) rows of the stitched cloud, ascending: the sphere, and the part of its pole that touches
    # it
    members: Index
    p_base_rough: Array  # (3,) rough centre, good to a few centimetres [m]
    probability: float = np.nan  # posterior probability that it is a marker; NaN when not computed
    hypothesis: str = ""  # the most likely other hypothesis with the odds, as words
    log_likelihoods: Array = field(default_factory=_no_numbers)  # (k,), see ``MarkerFit``

    def __post_init__(self) -> None:
        seal(self, members=(None,), p_base_rough=(3,), log_likelihoods=(None,))


def marker_name(place: int, letter: str = "M") -> str:
    """Return the name of the marker at a place among those of a stop: M01, M02, ...

    Parameters
    ----------
    place : int
        From 0.
    letter : str
        M; P for possible markers.

    Returns
    -------
    str
        Its name within one stop.
    """
    return f"{letter}{place + 1:02d}"


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Rejection:
    """A group of returns that was examined and is not used as a marker."""

    p_base: Array  # (3,) where it is [m]
    n_points: int  # number of its returns
    reason: str  # why it was rejected, as a sentence
    probability: float = np.nan  # posterior probability that it is a marker; NaN when not computed
    log_likelihoods: Array = field(default_factory=_no_numbers)  # (k,), see ``MarkerFit``
    members: Index = field(default_factory=_no_rows)  # (n,) rows of the cloud of a possible marker

    def __post_init__(self) -> None:
        seal(self, p_base=(3,), log_likelihoods=(None,), members=(None,))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MarkerCandidates:
    """The markers of one stitched cloud, possible ones, and groups that were rejected."""

    candidates: tuple[MarkerCandidate, ...]  # groups that are markers
    # groups that passed the first test, with the reason against them
    rejected: tuple[Rejection, ...]
    # height of the highest ground point near the station in the levelled frame, the level of the
    # published method's cut [m]; minus infinity when no ground was seen
    ground_height_max: float
    # groups too probable to be rejected, not probable enough to be markers
    possible: tuple[Rejection, ...] = ()


OPTICS = ("beam_width", "beam_window", "echo_cosine")
"""Names of what a scan determines of its beams, see ``Optics``."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Optics:
    """What a scan shows of its beams.

    Three numbers: relative excess of the divergence, width at the window in units of the VLP-16's,
    and power of the cosine of incidence with which an echo weighs.

    Attributes
    ----------
    estimates : (3,)
        Their values, with which the centres of the scan were computed.
    weights : (3, 3)
        Inverse covariance of what the scan says of them.
    sigmas_prior : (3,)
        Standard deviations before any scan, about zero.
    sigmas_profile : (3,)
        Standard deviations of what no scan says: beams of other profiles seem to differ by so much.
    """

    estimates: Array
    weights: Array
    sigmas_prior: Array
    sigmas_profile: Array

    def __post_init__(self) -> None:
        seal(self, estimates=(3,), weights=(3, 3), sigmas_prior=(3,), sigmas_profile=(3,))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MarkerFit:
    """A marker centre with covariance.

    Attributes
    ----------
    name : str
        Name of the marker at this stop: that of its candidate.
    p_base : (3,)
        Centre [m].
    cov_p_base : (3, 3)
        Covariance of the centre, without levelling and heading [m^2].
    method : str
        Name of the fitting method.
    status : Status
        Whether the fit can be relied on.
    reason : str
        Why it is weak; empty when it is not.
    radius : float
        Radius that was assumed [m].
    radius_free : float
        Radius when estimated together with the centre; NaN when it is not determined [m].
    sigma_radius_free : float
        Standard deviation of ``radius_free``; NaN likewise [m].
    mean_range : float
        Distance from the mean beam origin to the centre [m].
    mean_intensity : float
        Mean reflectivity of the used returns, 0-255.
    used : (n,)
        Rows of the stitched cloud that carry the estimate.
    rejected : (m,)
        Rows of the candidate that were set aside.
    residuals : (n,)
        Observed minus computed, along the beam, of the used returns [m].
    sigma0 : float
        Square root of the a-posteriori variance factor; 1 means noise as assumed.
    n_rings : int
        Number of different lasers among the used returns; 0 when rings are not recorded.
    coverage : float
        Share of the visible half of the sphere that has returns, 0 to 1.
    incidence : float
        Mean angle between the used beams and the sphere's normals; NaN when not computed [rad].
    variant : str
        Which form of its method ran, where it has several; else empty.
    sigma_range_shared : float
        Part of its standard deviation along the line of sight that all centres of the stop have in
        common, included in its covariance; NaN when not computed [m].
    sigma_height_shared : float
        Part of its standard deviation square to the line of sight, upward, that all centres of the
        stop have in common by the difference between the limb above and below, likewise; 0 where
        the method does not use the limb [m].
    shared_base : (3, k)
        Factor of the errors that it shares with the other centres of the stop, of ranges, of the
        limb and of the mounting: the covariance of two centres is the product of their factors, and
        that with itself is part of ``cov_p_base``; no columns when not computed [m].
    optics : Optics, optional
        What the scan of this centre shows of its beams, the same for all of its centres.
    range_by_optics : (3,)
        By how much this centre is too far where each number of ``optics`` is too small [m].
    probability : float
        Posterior probability that it is a marker; NaN when not computed.
    hypothesis : str
        The most likely other hypothesis with the odds, as words; empty likewise.
    log_likelihoods : (k,)
        Logarithms of the likelihoods of all hypotheses, the marker first; empty likewise.
    """

    name: str
    p_base: Array
    cov_p_base: Array
    method: str
    status: Status
    reason: str
    radius: float
    radius_free: float
    sigma_radius_free: float
    mean_range: float
    mean_intensity: float
    used: Index
    rejected: Index
    residuals: Array
    sigma0: float
    n_rings: int
    coverage: float
    incidence: float = np.nan
    variant: str = ""
    sigma_range_shared: float = np.nan
    sigma_height_shared: float = 0.0
    shared_base: Array = field(default_factory=lambda: np.zeros((3, 0)))
    optics: Optics | None = None
    range_by_optics: Array = field(default_factory=lambda: np.zeros(3))
    probability: float = np.nan
    hypothesis: str = ""
    log_likelihoods: Array = field(default_factory=_no_numbers)

    def __post_init__(self) -> None:
        seal(
            self,
            log_likelihoods=(None,),
            range_by_optics=(3,),
            shared_base=(3, None),
            p_base=(3,),
            cov_p_base=(3, 3),
            used=(None,),
            rejected=(None,),
            residuals=(None,),
        )
        same_length(self, "used", "residuals")

    @property
    def n_points(self) -> int:
        """Number of returns that carry the estimate."""
        return len(self.used)

    @property
    def rms(self) -> float:
        """Root mean square of the residuals [m]."""
        if not self.n_points:
            return np.nan
        return float(np.sqrt(self.residuals @ self.residuals / self.n_points))

    def cov_with_heading(self, sigma_heading: float) -> Array:
        """Return ``cov_p_base`` with the effect of the stop's unknown heading [rad] added [m^2]."""
        sideways = np.array([-self.p_base[1], self.p_base[0], 0.0])
        return self.cov_p_base + sigma_heading**2 * np.outer(sideways, sideways)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MarkerFits:
    """All markers of one stop, fitted by one method.

    Attributes
    ----------
    method : str
        Name of the fitting method.
    fits : tuple of MarkerFit
        Markers in the order of their azimuth in the base frame, from -pi.
    rejected : tuple of Rejection
        Groups that this method or the detection rejected.
    levelling : Levelling
        How the base leans.
    possible : tuple of Rejection
        Groups too probable to be rejected, not probable enough to be markers: they enter nothing
        but a network in which other stops or control confirm them.
    possible_fits : tuple of MarkerFit
        Centres of those of them that have one, P01, P02 ...
    sample_base : (n, 3) float32
        An even sample of the returns of the stop, which shows what hides a place [m].
    mounting_factor : float
        By how much errors of the mounting exceed what the configuration expects, by the two faces
        of the spheres; 1 where they do not.
    """

    method: str
    fits: tuple[MarkerFit, ...]
    rejected: tuple[Rejection, ...]
    levelling: Levelling
    possible: tuple[Rejection, ...] = ()
    possible_fits: tuple[MarkerFit, ...] = ()
    sample_base: Column = field(default_factory=lambda: np.zeros((0, 3), dtype=np.float32))
    mounting_factor: float = 1.0
