"""The study again, in simulation: its tables and figures by its own method and by ours.

``plan`` lists the scans; ``reproduce`` (``scans``) simulates each, finds its markers and fits them;
``tables`` puts the errors against truth into the shape of the study: ``table_2`` (centres by
distance), ``table_4`` (mean error per stop of a lane), ``readings`` (what the study leaves open),
``findings`` (what keeps the tolerance, and the model behind it). ``included_angle`` is the study's
controlled experiment with the station (Table 3), which needs no scan; ``noise`` sees the noise of
ranges in any log. Series of scans:

- ``centre``: the centre stop of the study's field, several worlds: Table 2, Figures 8, 9 and 3;
- ``lane 2``: its seven stops: Table 4 and Figure 11;
- ``turns``: the centre stop with other times of a turn: other counts at the same distances;
- ``distances``: eight markers at each of eleven distances to 30 m, with four times of a turn:
  distance and count told apart.

All have the noise of the study's simulator; the centre stop and the distances come again with the
noise of a real sensor.
"""

from spheremark.pipelines.evaluation.reproduction.included_angle import (
    AngleExperiment,
    AngleLimit,
    Arcs,
    Table3Row,
    angle_experiment,
)
from spheremark.pipelines.evaluation.reproduction.noise import (
    REFLECTIVITY_BINS,
    RangeNoise,
    range_noise,
)
from spheremark.pipelines.evaluation.reproduction.plan import (
    CENTRE,
    CENTRE_REAL,
    DISTANCES,
    DISTANCES_REAL,
    FULL_SPHERE,
    GROUND,
    LANE_2,
    OURS,
    PAPER,
    TURNS,
    Scan,
    plan,
)
from spheremark.pipelines.evaluation.reproduction.scans import (
    Centres,
    Example,
    Reproduction,
    reproduce,
)
from spheremark.pipelines.evaluation.reproduction.tables import (
    FIELD,
    LANE,
    REAL,
    Finding,
    Reading,
    Table2Row,
    Table4Row,
    findings,
    models_of_icp,
    readings,
    table_2,
    table_4,
)

__all__ = [
    "CENTRE",
    "CENTRE_REAL",
    "DISTANCES",
    "DISTANCES_REAL",
    "FIELD",
    "FULL_SPHERE",
    "GROUND",
    "LANE",
    "LANE_2",
    "OURS",
    "PAPER",
    "REAL",
    "REFLECTIVITY_BINS",
    "TURNS",
    "AngleExperiment",
    "AngleLimit",
    "Arcs",
    "Centres",
    "Example",
    "Finding",
    "RangeNoise",
    "Reading",
    "Reproduction",
    "Scan",
    "Table2Row",
    "Table3Row",
    "Table4Row",
    "angle_experiment",
    "findings",
    "models_of_icp",
    "plan",
    "range_noise",
    "readings",
    "reproduce",
    "table_2",
    "table_4",
]
