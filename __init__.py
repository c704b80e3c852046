"""Station positions from spherical markers and a gimbal-mounted LiDAR.

The public interface: each name is loaded at first use, so that ``import spheremark`` costs nothing.

>>> import spheremark
>>> stops = spheremark.process(spheremark.read_log("stop1.mcap"))  # doctest: +SKIP
>>> stops[0].fits["along_beam"].fits[0].p_base                     # doctest: +SKIP
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from spheremark.pipelines.calibration import calibrate
    from spheremark.pipelines.config import SurveyConfig
    from spheremark.pipelines.errors import SpheremarkError
    from spheremark.pipelines.interface import adjust, evaluate_plan, find_spheres, optimise_plan
    from spheremark.pipelines.model import ControlMarks
    from spheremark.pipelines.survey import process
    from spheremark.service.client import Client
    from spheremark.storage.imports.survey_files import read_control
    from spheremark.storage.recordings import read_log

__all__ = [
    "Client",
    "ControlMarks",
    "SpheremarkError",
    "SurveyConfig",
    "adjust",
    "calibrate",
    "evaluate_plan",
    "find_spheres",
    "optimise_plan",
    "process",
    "read_control",
    "read_log",
]

_HOMES = {
    "Client": "service.client",
    "ControlMarks": "pipelines.model",
    "SpheremarkError": "pipelines.errors",
    "SurveyConfig": "pipelines.config",
    "adjust": "pipelines.interface",
    "calibrate": "pipelines.calibration",
    "evaluate_plan": "pipelines.interface",
    "find_spheres": "pipelines.interface",
    "optimise_plan": "pipelines.interface",
    "process": "pipelines.survey",
    "read_control": "storage.imports.survey_files",
    "read_log": "storage.recordings",
}


def __getattr__(name: str) -> Any:
    """Load a public name at first use."""
    if name not in _HOMES:
        raise AttributeError(f"module 'spheremark' has no attribute {name!r}")
    value = getattr(import_module(f"spheremark.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted(__all__)
