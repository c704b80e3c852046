"""How deeply JSON from outside may be nested, so that no reader of it recurses without bound."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeVar

_DEPTH_MAX = 32  # of lists and objects within one another; our own files have six
_T = TypeVar("_T")


def require_shallow(value: _T) -> _T:
    """Return a value of JSON that is not nested too deeply.

    Parameters
    ----------
    value : object
        What ``json.loads`` returned.

    Returns
    -------
    object
        The value.

    Raises
    ------
    ValueError
        If it has more than 32 levels of lists and objects.
    """
    level: list[object] = [value]
    for _ in range(_DEPTH_MAX + 1):
        level = [inner for outer in level for inner in _inside(outer)]
        if not level:
            return value
    raise ValueError(f"it is nested more than {_DEPTH_MAX} levels deep")


def _inside(value: object) -> Iterable[object]:
    """Return the members of a list or an object."""
    if isinstance(value, dict):
        return value.values()
    return value if isinstance(value, list) else ()
