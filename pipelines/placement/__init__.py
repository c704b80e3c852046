"""Where to put markers: predicted accuracy of an arrangement, and the best arrangement.

- ``plan`` has the types of a plan; ``sites`` makes sites, ``candidates`` where marks may stand,
- ``sensor`` predicts the returns from a sphere, ``centre_model`` the accuracy of its centre,
  ``empirical_model`` the same from one's own surveys, ``visibility`` what hides it,
- ``station_covariance`` and ``probability`` propagate centres to positions,
- ``evaluation`` joins these for stops and for a grid over the field, ``bounds`` limits them,
- ``scoring`` rates sets of marks, ``search`` improves them, ``stop_moves`` the stops beside them;
  ``optimisation`` returns the best with its bound, ``random_plans`` is the study's own procedure.

An arrangement is evaluated in milliseconds without simulating a scan, so that hundreds of thousands
can be compared; simulated scans test the predictions.
"""

from spheremark.pipelines.placement.candidates import Candidates, PlaceRules, find_candidates
from spheremark.pipelines.placement.centre_model import CentreModel, Provenance, sensor_model
from spheremark.pipelines.placement.empirical_model import FitRows, fitted_model
from spheremark.pipelines.placement.evaluation import (
    check_sizes,
    evaluate,
    field_map,
    map_stations,
    worst_after_loss,
)
from spheremark.pipelines.placement.optimisation import (
    Costs,
    Optimum,
    Proposal,
    Report,
    SearchState,
    TradeOff,
    best_without_search,
    optimise,
    propose_mark,
    trade_off,
)
from spheremark.pipelines.placement.plan import (
    PLAN_METHODS,
    Arrangement,
    Evaluation,
    FieldMap,
    Requirement,
    Site,
    Stops,
    Visibility,
)
from spheremark.pipelines.placement.random_plans import (
    PassRate,
    RandomPlanResults,
    RandomPlanSpec,
    by_number,
    by_worst_angle,
    errors_by_angle,
    marks_at_angle,
    simulate_random_plans,
    three_circle_errors,
)
from spheremark.pipelines.placement.search import MARKS_MOST, OBJECTIVES, Goal
from spheremark.pipelines.placement.sensor import Sensor
from spheremark.pipelines.placement.sites import (
    marks_of_field,
    site_of_field,
    site_of_grid,
    stops_of_field,
)
from spheremark.pipelines.placement.visibility import find_visibility
from spheremark.pipelines.placement.walk import round_trip

__all__ = [
    "MARKS_MOST",
    "OBJECTIVES",
    "PLAN_METHODS",
    "Arrangement",
    "Candidates",
    "CentreModel",
    "Costs",
    "Evaluation",
    "FieldMap",
    "FitRows",
    "Goal",
    "Optimum",
    "PassRate",
    "PlaceRules",
    "Proposal",
    "Provenance",
    "RandomPlanResults",
    "RandomPlanSpec",
    "Report",
    "Requirement",
    "SearchState",
    "Sensor",
    "Site",
    "Stops",
    "TradeOff",
    "Visibility",
    "best_without_search",
    "by_number",
    "by_worst_angle",
    "check_sizes",
    "errors_by_angle",
    "evaluate",
    "field_map",
    "find_candidates",
    "find_visibility",
    "fitted_model",
    "map_stations",
    "marks_at_angle",
    "marks_of_field",
    "optimise",
    "propose_mark",
    "round_trip",
    "sensor_model",
    "simulate_random_plans",
    "site_of_field",
    "site_of_grid",
    "stops_of_field",
    "three_circle_errors",
    "trade_off",
    "worst_after_loss",
]
