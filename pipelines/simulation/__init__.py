"""A world whose truth is known, and the log that a rig would record in it.

``scenario`` makes a ``Field``: terrain, rocks, markers and stops. ``simulate_stop`` turns the
gimbal at one of the stops and returns the log and, apart from it, the truth. Inside,

- ``options`` is the configuration,
- ``terrain`` and ``rocks`` make the ground, ``scene`` holds all surfaces,
- ``field`` is the published field; ``bodies`` and ``objects`` make what is no marker, ``clutter``
  places it, ``lane`` spreads markers over distances, ``worlds`` draws all of it and the physics at
  random, ``scenarios`` lists all worlds by name,
- ``visibility`` computes the visible share of each marker from a stop,
- ``rig`` moves the LiDAR and records encoder and AHRS,
- ``sensor`` fires the lasers and records their echoes, which ``echo`` traces,
- ``stop`` simulates one stop.

The steps of the pipeline import nothing from here, and a log holds nothing of the truth.
"""

from spheremark.pipelines.simulation.field import Decoy, Field, Stop
from spheremark.pipelines.simulation.options import SimulationConfig
from spheremark.pipelines.simulation.rig import commensurability, face_lines, recorded_time
from spheremark.pipelines.simulation.scenarios import SCENARIOS, scenario
from spheremark.pipelines.simulation.stop import SimulatedStop, simulate_stop, survey_truth
from spheremark.pipelines.simulation.worlds import (
    FAMILIES,
    RandomWorld,
    draw_config,
    draw_world,
    random_world,
)

__all__ = [
    "FAMILIES",
    "SCENARIOS",
    "Decoy",
    "Field",
    "RandomWorld",
    "SimulatedStop",
    "SimulationConfig",
    "Stop",
    "commensurability",
    "draw_config",
    "draw_world",
    "face_lines",
    "random_world",
    "recorded_time",
    "scenario",
    "simulate_stop",
    "survey_truth",
]
