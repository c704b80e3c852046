"""Where to put markers: what an arrangement promises, and which promises most.

- ``values`` says what a site, an arrangement and an evaluation are; ``sites`` makes sites,
- ``sensor`` knows what a scan puts on a sphere, ``centres`` how well its centre will be known,
- ``sight`` what hides it, ``positions`` and ``probability`` what centres make of a position,
- ``evaluation`` puts these together for stops and for a grid over the field.

Why so: an arrangement is judged in milliseconds, without simulating a scan, so that hundreds of
thousands can be compared; simulation is what the promises are tested against.
"""

from pipelines.placement.centres import CentreModel, Provenance, sensor_model
from pipelines.placement.evaluation import evaluate, field_eyes, field_map
from pipelines.placement.sensor import Sensor
from pipelines.placement.sight import look
from pipelines.placement.sites import marks_of_field, site_of_field, site_of_grid, stops_of_field
from pipelines.placement.values import (
    PLAN_METHODS,
    Arrangement,
    Evaluation,
    FieldMap,
    Requirement,
    Sights,
    Site,
    Stops,
)

__all__ = [
    "PLAN_METHODS",
    "Arrangement",
    "CentreModel",
    "Evaluation",
    "FieldMap",
    "Provenance",
    "Requirement",
    "Sensor",
    "Sights",
    "Site",
    "Stops",
    "evaluate",
    "field_eyes",
    "field_map",
    "look",
    "marks_of_field",
    "sensor_model",
    "site_of_field",
    "site_of_grid",
    "stops_of_field",
]
