"""The page of the reproduction: the study's tables and figures from simulated scans."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from spheremark.pipelines import published as study
from spheremark.pipelines.accuracy import ErrorSummary
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
from spheremark.web.pages.base import Panel
from spheremark.web.pages.readouts import Readout
from spheremark.web.pages.statements import Statement
from spheremark.web.templating import environment, number

_DISTANCES_SHOWN = (5.0, 7.5, 10.0, 15.0, 20.0)  # [m]
_ICP_LABELS = {OURS: "ours", PAPER: "hemisphere", FULL_SPHERE: "full sphere"}
_PLACES = {FIELD: "the study's field", LANE: "noise 30 mm", REAL: "noise of a real VLP-16"}


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
    context = {field.name: getattr(page, field.name) for field in dataclasses.fields(page)}
    return (
        environment()
        .get_template("reproduction.html")
        .render(
            **context,
            panels={panel.name: panel for panel in panels(page)},
            readouts=_readouts(page),
            methods=(OURS, PAPER),
            cuts={PAPER: "half of each sphere", GROUND: "below the highest ground"},
            noises_of={
                CENTRE: f"{study.SIGMA_RANGE * MM:g} mm, the study's simulator",
                CENTRE_REAL: "7 to 14 mm, a real VLP-16",
            },
            total=_total(page.table_2),
            study=study,
        )
    )


def panels(page: ReproductionPage) -> tuple[Panel, ...]:
    """Return all figures of a reproduction."""
    return (
        *_centre_panels(page),
        *_far_panels(page),
        *_angle_panels(page),
        Panel(
            name="figure9",
            figure=figures.before_and_after_cut(page.example),
            caption="Figure 9. One simulated marker as the LiDAR sees it. Dashed: the cut, which "
            "leaves the hemisphere that the study shows; dotted, where it is near: the highest "
            "ground point of this scan.",
        ),
        Panel(
            name="figure3",
            figure=figures.models_of_icp(page.example, _ICP_LABELS),
            caption="Figure 3. The same marker from the side, the LiDAR to the left: the sphere by "
            "ICP with a hemisphere, by ICP with a full sphere, and by our fit.",
        ),
        Panel(
            name="figure11",
            figure=error_along_lane(page.lane, page.tolerance_m),
            caption="Figure 11. Mean over markers and worlds at each stop; whiskers end at the "
            "largest.",
        ),
        Panel(
            name="noise",
            figure=figures.noise_by_reflectivity(page.noises),
            caption="From runs of twelve shots of one laser on one surface, freed of a parabola"
            + ("; real: packets of a VLP-16." if len(page.noises) > 1 else "; the first scan."),
        ),
    )


def _centre_panels(page: ReproductionPage) -> tuple[Panel, ...]:
    """Return the two halves of Figure 8."""
    distance = error_against_distance(page.centre, page.tolerance_m)
    count = error_against_count(page.centre, page.tolerance_m)
    return (
        Panel(
            name="figure8-distance",
            figure=figures.study_claims(distance, of="distance"),
            caption="Figure 8, left. Every point is a sphere seen from the centre stop of one "
            "world; crosses are the study's own Table 2.",
        ),
        Panel(
            name="figure8-count",
            figure=figures.study_claims(count, of="count"),
            caption="Figure 8, right. The same spheres by the returns that each method used: the "
            "study's cut leaves it fewer.",
        ),
    )


def _far_panels(page: ReproductionPage) -> tuple[Panel, ...]:
    """Return the figures that separate distance from count."""
    models = {one.method: one.model for one in page.statements if one.place == LANE and one.model}
    ladder = error_against_distance(page.distances, page.tolerance_m, is_log=True)
    ladder.update_layout(title_text="Error of sphere centres to 30 m, noise 30 mm")
    real = error_against_distance(page.real, page.tolerance_m, is_log=True)
    real.update_layout(title_text="Error of sphere centres to 30 m, noise of a real VLP-16")
    return (
        Panel(
            name="turns",
            figure=figures.model_against_count(
                page.distances, models, page.tolerance_m, _DISTANCES_SHOWN
            ),
            caption="Each line is one distance, each point one time of the turn: "
            "along a line only the count changes, from line to line only the distance. Dotted: the "
            "error model.",
        ),
        Panel(
            name="ladder",
            figure=ladder,
            caption="The same spheres, all times of the turn; lines are the RMS in bins of 1 m. "
            "The study's field ends at 9.3 m.",
        ),
        Panel(
            name="ladder-real",
            figure=real,
            caption="The same again with the noise by reflectivity of real packets, under 14 mm.",
        ),
    )


def _angle_panels(page: ReproductionPage) -> tuple[Panel, ...]:
    """Return the figures of the station by included angle."""
    return (
        Panel(
            name="figure10",
            figure=figures.station_by_angle(page.angles),
            caption="Figure 10. Lines: medians over all signs of the errors. Crosses: the study's "
            "printed errors. The free station has the lower limit and no upper one.",
        ),
        Panel(
            name="limits",
            figure=figures.limit_by_sigma(page.angles.limits, page.tolerance_m),
            caption="Between the lines the horizontal error of two marks is within. Two centres "
            "have a lower limit that falls with their sigma, two circles an upper one too.",
        ),
        Panel(
            name="figure4",
            figure=figures.circles_of_study(page.angles.arcs),
            caption="Figure 4. Circles of the true distances about marks that are off by 17 mm per "
            "axis; of all signs of the errors, those whose error is the median.",
        ),
    )


def _readouts(page: ReproductionPage) -> tuple[Readout, ...]:
    """Return mean errors beside the study's, and the greatest distances that keep the tolerance."""
    found = []
    published = float(study.TABLE_2.errors_3d.mean())
    for method in (PAPER, OURS):
        errors = floats(page.centre, "error_3d_m")[
            np.array(texts(page.centre, "fit_method")) == method
        ]
        found.append(
            Readout(
                label=f"Table 2, {theme.method_style(method).label}",
                value=number(float(errors.mean()) * MM, 1),
                unit="mm mean error",
                note=f"the study: {published * MM:.1f} mm; {len(errors)} spheres here",
                method=method,
            )
        )
    for one in page.statements:
        if one.method == OURS:
            value, _, interval = one.distance.partition(" m")
            where = _PLACES[one.place]
            found.append(
                Readout(
                    label=f"{page.tolerance_m * MM:g} mm kept, {where}",
                    value=value,
                    unit="m",
                    note=interval.strip(" ()") or "as far as markers stand there",
                    method=OURS,
                )
            )
    return tuple(found)


def _total(rows: Sequence[Plain]) -> dict[str, float]:
    """Return the mean of Table 2's column of each method [m]."""
    return {
        method: float(np.nanmean([row[f"{method}_error_3d_mean_m"] for row in rows]))
        for method in (OURS, PAPER)
    }
