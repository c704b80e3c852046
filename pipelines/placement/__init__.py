"""Where to put markers: what an arrangement promises, and which promises most.

- ``values`` says what a site, an arrangement and an evaluation are; ``sites`` makes sites,
- ``sensor`` knows what a scan puts on a sphere, ``centres`` how well its centre will be known,
- ``sight`` what hides it, ``positions`` and ``probability`` what centres make of a position,
- ``evaluation`` puts these together for stops and for a grid over the field,
- ``candidates`` says where marks may stand, ``optimising`` which of these places are best,
- ``trials`` is the study's own procedure: marks at random, pass or fail,
- ``learning`` fits the model of centres to one's own surveys.

Why so: an arrangement is judged in milliseconds, without simulating a scan, so that hundreds of
thousands can be compared; simulation is what the promises are tested against.
"""

from spheremark.pipelines.placement.candidates import Candidates, PlaceRules, find_candidates
from spheremark.pipelines.placement.centre_model import CentreModel, Provenance, sensor_model
from spheremark.pipelines.placement.empirical_model import FitRows, fitted_model
from spheremark.pipelines.placement.evaluation import check_sizes, evaluate, field_eyes, field_map
from spheremark.pipelines.placement.optimisation import (
    Goal,
    Optimum,
    Proposal,
    best_without_search,
    draw_arrangement,
    optimise,
    propose_mark,
)
from spheremark.pipelines.placement.plan import (
    PLAN_METHODS,
    Arrangement,
    Evaluation,
    FieldMap,
    Requirement,
    Sights,
    Site,
    Stops,
)
from spheremark.pipelines.placement.random_plans import (
    Share,
    Trial,
    TrialResult,
    by_number,
    by_worst_angle,
    errors_by_angle,
    marks_at_angle,
    three_circle_errors,
    try_at_random,
)
from spheremark.pipelines.placement.sensor import Sensor
from spheremark.pipelines.placement.sites import (
    marks_of_field,
    site_of_field,
    site_of_grid,
    stops_of_field,
)
from spheremark.pipelines.placement.visibility import look

__all__ = [
    "PLAN_METHODS",
    "Arrangement",
    "Candidates",
    "CentreModel",
    "Evaluation",
    "FieldMap",
    "FitRows",
    "Goal",
    "Optimum",
    "PlaceRules",
    "Proposal",
    "Provenance",
    "Requirement",
    "Sensor",
    "Share",
    "Sights",
    "Site",
    "Stops",
    "Trial",
    "TrialResult",
    "best_without_search",
    "by_number",
    "by_worst_angle",
    "check_sizes",
    "draw_arrangement",
    "errors_by_angle",
    "evaluate",
    "field_eyes",
    "field_map",
    "find_candidates",
    "fitted_model",
    "look",
    "marks_at_angle",
    "marks_of_field",
    "optimise",
    "propose_mark",
    "sensor_model",
    "site_of_field",
    "site_of_grid",
    "stops_of_field",
    "three_circle_errors",
    "try_at_random",
]
