"""JSON from outside, held to what every later step can take: depth, text in UTF-8, float64."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from typing import Any, TypeVar

_DEPTH_MAX = 32  # of lists and objects within one another; our own files have six
_TOO_DEEP = f"it is nested more than {_DEPTH_MAX} levels deep"
_SHOWN = 40  # characters of a text in a message
_T = TypeVar("_T")


def read_json(text: str) -> Any:
    """Read JSON that is not nested too deeply, and whose values can be kept.

    Parameters
    ----------
    text : str
        The JSON; a mark of its byte order may be in front.

    Returns
    -------
    object
        Its value.

    Raises
    ------
    ValueError
        If it is no JSON, or ``require_shallow`` refuses its value.
    """
    try:
        return require_shallow(json.loads(text.lstrip("\ufeff")))
    except RecursionError as error:
        raise ValueError(_TOO_DEEP) from error


def require_shallow(value: _T) -> _T:
    """Return a value of JSON that is not nested too deeply, and that can be kept.

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
        If it has more than 32 levels of lists and objects, a key or a text that UTF-8 cannot
        encode (half of a surrogate pair), or a whole number beyond those of float64.
    """
    level: list[object] = [value]
    for _ in range(_DEPTH_MAX + 1):
        for one in level:
            _require_kept(one)
        level = [inner for outer in level for inner in _inside(outer)]
        if not level:
            return value
    raise ValueError(_TOO_DEEP)


def _require_kept(value: object) -> None:
    """Refuse a text without an encoding in UTF-8, and a whole number that is no float64."""
    if isinstance(value, int) and abs(value) > sys.float_info.max:
        raise ValueError(f"it holds a whole number beyond {sys.float_info.max:.1e}")
    if not isinstance(value, str):
        return
    try:
        value.encode()
    except UnicodeEncodeError as error:
        raise ValueError(
            f"its text {value[:_SHOWN]!r} holds half of a surrogate pair "
            f"({value[error.start]!r}); give the whole character"
        ) from error


def _inside(value: object) -> Iterable[object]:
    """Return the members of a list, or the keys and values of an object."""
    if isinstance(value, dict):
        return (*value, *value.values())
    return value if isinstance(value, list) else ()
