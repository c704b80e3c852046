"""A world whose truth is known, and the log that a rig would record in it.

``scenario`` makes a ``Field``: terrain, rocks, markers and stops. ``simulate_stop`` turns the
gimbal at one of the stops and returns the log and, apart from it, the truth. Inside,

- ``options`` says what can be chosen,
- ``terrain`` and ``rocks`` make the ground, ``scene`` holds whatever a beam can meet,
- ``field`` puts them together into the study's field; ``bodies`` and ``clutter`` add what is no
  marker, ``lane`` spreads markers over distances, ``scenarios`` knows all worlds by name,
- ``visibility`` says how much of each marker a stop can see,
- ``rig`` moves the LiDAR and records encoder and AHRS,
- ``sensor`` fires the lasers and records their echoes, which ``echo`` traces,
- ``stop`` runs all of it for one stop.

Why so: the pipeline is believed because it finds what this room hid. Nothing here is imported by
the steps of the pipeline, and a log holds nothing of the truth.
"""

from spheremark.pipelines.simulation.field import Decoy, Field, Stop
from spheremark.pipelines.simulation.options import SimulationConfig
from spheremark.pipelines.simulation.rig import commensurability, horizon_lines
from spheremark.pipelines.simulation.scenarios import SCENARIOS, scenario
from spheremark.pipelines.simulation.stop import SimulatedStop, simulate_stop, survey_truth

__all__ = [
    "SCENARIOS",
    "Decoy",
    "Field",
    "SimulatedStop",
    "SimulationConfig",
    "Stop",
    "commensurability",
    "horizon_lines",
    "scenario",
    "simulate_stop",
    "survey_truth",
]
