"""Worlds by name."""

from __future__ import annotations

from collections.abc import Callable

from spheremark.pipelines.errors import ConfigError
from spheremark.pipelines.simulation.clutter import clutter_field, rock_field
from spheremark.pipelines.simulation.field import Field, checked_seed, paper_field
from spheremark.pipelines.simulation.lane import range_lane
from spheremark.pipelines.simulation.worlds import random_field

SCENARIOS: dict[str, Callable[[int], Field]] = {
    "paper-field": paper_field,
    "clutter-field": clutter_field,
    "rock-field": rock_field,
    "range-lane": range_lane,
    "random": random_field,
}
"""Worlds by the name of their scenario."""


def scenario(name: str, seed: int) -> Field:
    """Return a world by the name of its scenario.

    Parameters
    ----------
    name : str
        One of ``SCENARIOS``.
    seed : int
        Seed of the random numbers, 0 or more: the same seed gives the same world.

    Returns
    -------
    Field
        The world.

    Raises
    ------
    ConfigError
        If there is no such scenario, or the seed is negative.
    """
    if name not in SCENARIOS:
        raise ConfigError(f"There is no scenario {name!r}; there are: {', '.join(SCENARIOS)}.")
    return SCENARIOS[name](checked_seed(seed))
