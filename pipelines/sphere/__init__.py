"""Candidate -> marker centre with covariance, by named methods.

A method takes all candidates of a stop together, because they share the noise and the lasers of one
sensor:

- ``along_beam`` is maximum likelihood with the range of each beam's footprint, which exists only
  where the footprint meets the sphere,
- ``silhouette`` adds the pulses that passed without a return (``pulses``),
- ``astm_e3125`` is the surveyors' standard: cone, cylinder, 3 sigma,
- ``free_radius`` and ``algebraic`` estimate the radius too, for comparison,
- ``paper`` is the study's registration of a hemisphere by ICP.

The maximum-likelihood methods share ``estimation``: a joint least-squares adjustment of all centres
(``normal_equations``), with ranges averaged over footprints (``footprint``) and linearised over the
uncertainty of the centres (``linearisation``), robust weights (``noise``), the limb (``limb``) as
far as nothing hides it (``occlusion``), errors of the mounting (``mounting``) and a test of the
assumed radius (``radius``). ``bound`` is the Cramer-Rao bound, for comparisons with truth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from spheremark.pipelines.config import FittingConfig
from spheremark.pipelines.errors import ConfigError
from spheremark.pipelines.model import (
    MarkerCandidate,
    MarkerCandidates,
    MarkerFit,
    MarkerFits,
    StitchedCloud,
    marker_name,
)
from spheremark.pipelines.sphere.description import Fits
from spheremark.pipelines.sphere.methods import along_beam, astm, paper, silhouette
from spheremark.pipelines.sphere.methods import free_radius as free

Method = Callable[[StitchedCloud, MarkerCandidates, FittingConfig, float], Fits]
METHODS: dict[str, Method] = {
    along_beam.NAME: along_beam.fit,
    silhouette.NAME: silhouette.fit,
    astm.NAME: astm.fit,
    free.GEOMETRIC: free.fit_geometric,
    free.ALGEBRAIC: free.fit_algebraic,
    paper.NAME: paper.fit,
}

_POSSIBLE = "P"  # first letter of the names of possible markers
_N_SAMPLE = 200_000  # returns that show what hides a place: ten within a degree of most directions


def fit_markers(
    method: str,
    cloud: StitchedCloud,
    candidates: MarkerCandidates,
    config: FittingConfig,
    marker_radius: float,
) -> MarkerFits:
    """Estimate the centres of a stop's markers by one method.

    Parameters
    ----------
    method : str
        One of ``METHODS``.
    cloud : StitchedCloud
        The stop.
    candidates : MarkerCandidates
        The candidates found in it.
    config : FittingConfig
        Prior noise.
    marker_radius : float
        Radius of the spheres [m].

    Returns
    -------
    MarkerFits
        Centres in the order of the candidates; candidates refused by the detection and by the
        method, with reasons. There may be no fits.

    Raises
    ------
    ConfigError
        If the method is unknown.
    """
    if method not in METHODS:
        raise ConfigError(f"Fitting method {method!r} is unknown; known: {', '.join(METHODS)}.")
    found = METHODS[method](cloud, candidates, config, marker_radius)
    more = _with_possible(candidates)
    together = (
        METHODS[method](cloud, more, config, marker_radius) if more is not candidates else found
    )
    levelling = cloud.levelling
    # what parts the two faces has a turn of both beside it, which only the heading would show
    sigma_heading = found.mounting_factor * levelling.sigma_heading
    return MarkerFits(
        method=method,
        fits=tuple(_judged(fit, candidates) for fit in found.fits),
        rejected=candidates.rejected + found.rejected,
        levelling=replace(levelling, sigma_heading=sigma_heading),
        possible=candidates.possible,
        possible_fits=tuple(
            _judged(fit, more) for fit in together.fits if fit.name.startswith(_POSSIBLE)
        ),
        sample_base=cloud.p_base[:: max(1, len(cloud.p_base) // _N_SAMPLE)].copy(),
        mounting_factor=found.mounting_factor,
    )


def _with_possible(candidates: MarkerCandidates) -> MarkerCandidates:
    """Return the possible markers as candidates beside the others, whose noise they share."""
    possible = tuple(
        MarkerCandidate(
            name=marker_name(place, _POSSIBLE),
            members=one.members,
            p_base_rough=one.p_base,
            probability=one.probability,
            hypothesis=one.reason,
            log_likelihoods=one.log_likelihoods,
        )
        for place, one in enumerate(candidates.possible)
    )
    if not possible:
        return candidates
    return replace(candidates, candidates=candidates.candidates + possible)


def _judged(fit: MarkerFit, candidates: MarkerCandidates) -> MarkerFit:
    """Return a fit with the probability of its candidate."""
    one = next(one for one in candidates.candidates if one.name == fit.name)
    return replace(
        fit,
        probability=one.probability,
        hypothesis=one.hypothesis,
        log_likelihoods=one.log_likelihoods,
    )
