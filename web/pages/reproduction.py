"""The page of the reproduction: the study's tables and figures from simulated scans."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from spheremark.pipelines import published as study
from spheremark.pipelines.accuracy.truth import ErrorSummary
from spheremark.pipelines.evaluation.experiment import Plain
from spheremark.pipelines.evaluation.reproduction.included_angle import AngleExperiment
from spheremark.pipelines.evaluation.reproduction.noise import RangeNoise
from spheremark.pipelines.evaluation.reproduction.plan import (
    CENTRE,
    CENTRE_REAL,
    FULL_SPHERE,
    GROUND,
    OURS,
    PAPER,
)
from spheremark.pipelines.evaluation.reproduction.scans import Example
from spheremark.pipelines.evaluation.reproduction.tables import FIELD, LANE, REAL
from spheremark.web import theme
from spheremark.web.columns import MM, Columns, floats, texts
from spheremark.web.figures import reproduction as figures
from spheremark.web.figures.survey import (
    error_against_count,
    error_against_distance,
    error_along_lane,
)
from spheremark.web.pages.base import Panel, Readout
from spheremark.web.pages.statements import Statement
from spheremark.web.templating import number, render

_DISTANCES_SHOWN = (5.0, 7.5, 10.0, 15.0, 20.0)  # [m]
_ICP_LABELS = {OURS: "ours", PAPER: "hemisphere", FULL_SPHERE: "full sphere"}
_PLACES = {FIELD: "the study's field", LANE: "noise 30 mm", REAL: "noise of a real VLP-16"}

_CAPTIONS = {
    "figure8-distance": "Figure 8, left. Every point is a sphere seen from the centre stop of one "
    "world; crosses are the study's own Table 2.",
    "figure8-count": "Figure 8, right. The same spheres by the returns that each method used: the "
    "study's cut leaves it fewer.",
    "turns": "Each line is one distance, each point one time of the turn: along a line only the "
    "count changes, from line to line only the distance. Dotted: the error model.",
    "ladder": "The same spheres, all times of the turn; lines are the RMS in bins of 1 m. The "
    "study's field ends at 9.3 m.",
    "ladder-real": "The same again with the noise by reflectivity of real packets, under 14 mm.",
    "figure10": "Figure 10. Lines: medians over all signs of the errors. Crosses: the study's "
    "printed errors. The free station has the lower limit and no upper one.",
    "limits": "Between the lines the horizontal error of two marks is within. Two centres have a "
    "lower limit that falls with their sigma, two circles an upper one too.",
    "figure4": "Figure 4. Circles of the true distances about marks that are off by 17 mm per "
    "axis; of all signs of the errors, those whose error is the median.",
    "figure9": "Figure 9. One simulated marker as the LiDAR sees it. Dashed: the cut, which leaves "
    "the hemisphere that the study shows; dotted, where it is near: the highest ground point of "
    "this scan.",
    "figure3": "Figure 3. The same marker from the side, the LiDAR to the left: the sphere by ICP "
    "with a hemisphere, by ICP with a full sphere, and by our fit.",
    "figure11": "Figure 11. Mean over markers and worlds at each stop; whiskers end at the "
    "largest.",
    "noise": "From runs of twelve returns of one laser on one surface, freed of a parabola: the "
    "first simulated scan and, where they are given, packets of a real VLP-16.",
}


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ReproductionPage:
    """The contents of the page of a reproduction.

    ``centre``, ``lane``, ``distances`` and ``real`` are columns of fits as the database names them,
    with ``turn_s``; the last are the distances with the noise of a real sensor.
    """

    tolerance_m: float
    scans: Sequence[Mapping[str, Any]]
    statements: tuple[Statement, ...]
    table_2: Sequence[Plain]
    table_4: Sequence[Plain]
    readings: Sequence[Plain]
    angles: AngleExperiment
    icp: Mapping[str, ErrorSummary]
    example: Example
    centre: Columns
    lane: Columns
    distances: Columns
    real: Columns
    noises: Mapping[str, RangeNoise]
    spheres: Sequence[Mapping[str, Any]]
    code_version: str
    config_digest: str
    seed: int


def reproduction_page(page: ReproductionPage) -> str:
    """Return the page: one file, with Plotly's script beside it."""
    context = {field.name: getattr(page, field.name) for field in fields(page)}
    sigma = f"{study.SIGMA_RANGE * MM:g} mm, the study's simulator"
    return render(
        "reproduction.html",
        **context,
        panels={panel.name: panel for panel in panels(page)},
        readouts=_readouts(page),
        methods=(OURS, PAPER),
        cuts={PAPER: "half of each sphere", GROUND: "below the highest ground"},
        noises_of={CENTRE: sigma, CENTRE_REAL: "7 to 14 mm, a real VLP-16"},
        total=_total(page.table_2),
        study=study,
    )


def panels(page: ReproductionPage) -> tuple[Panel, ...]:
    """Return all figures of a reproduction."""
    limit, example, angles = page.tolerance_m, page.example, page.angles
    models = {one.method: one.model for one in page.statements if one.place == LANE and one.model}
    distance = error_against_distance(page.centre, limit)
    ladder = error_against_distance(page.distances, limit, is_log=True)
    ladder.update_layout(title_text="Error of sphere centres to 30 m, noise 30 mm")
    real = error_against_distance(page.real, limit, is_log=True)
    real.update_layout(title_text="Error of sphere centres to 30 m, noise of a real VLP-16")
    drawn = {
        "figure8-distance": figures.study_claims(distance, of="distance"),
        "figure8-count": figures.study_claims(error_against_count(page.centre, limit), of="count"),
        "turns": figures.model_against_count(page.distances, models, limit, _DISTANCES_SHOWN),
        "ladder": ladder,
        "ladder-real": real,
        "figure10": figures.station_by_angle(angles),
        "limits": figures.limit_by_sigma(angles.limits, limit),
        "figure4": figures.circles_of_study(angles.arcs),
        "figure9": figures.before_and_after_cut(example),
        "figure3": figures.models_of_icp(example, _ICP_LABELS),
        "figure11": error_along_lane(page.lane, limit),
        "noise": figures.noise_by_reflectivity(page.noises),
    }
    return tuple(Panel(name, figure, _CAPTIONS[name]) for name, figure in drawn.items())


def _readouts(page: ReproductionPage) -> tuple[Readout, ...]:
    """Return mean errors beside the study's, and the greatest distances that keep the tolerance."""
    found = []
    published = float(study.TABLE_2.errors_3d.mean())
    methods, errors = np.array(texts(page.centre, "fit_method")), floats(page.centre, "error_3d_m")
    for method in (PAPER, OURS):
        own = errors[methods == method]
        label, value = theme.method_style(method).label, number(float(own.mean()) * MM, 1)
        note = f"the study: {published * MM:.1f} mm; {len(own)} spheres here"
        found.append(Readout(f"Table 2, {label}", value, "mm mean error", note, method))
    for one in page.statements:
        if one.method == OURS:
            value, _, interval = one.distance.partition(" m")
            label = f"{page.tolerance_m * MM:g} mm kept, {_PLACES[one.place]}"
            note = interval.strip(" ()") or "as far as markers stand there"
            found.append(Readout(label, value, "m", note, OURS))
    return tuple(found)


def _total(rows: Sequence[Plain]) -> dict[str, float]:
    """Return the mean of Table 2's column of each method [m]."""
    return {
        method: float(np.nanmean([row[f"{method}_error_3d_mean_m"] for row in rows]))
        for method in (OURS, PAPER)
    }
