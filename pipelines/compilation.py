"""Compiled loops: hides numba and the options that all kernels share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numba

# A product and the sum that follows are rounded once
FUSED: frozenset[str] = frozenset({"contract"})
# ... and sums of many terms are taken in any order
REASSOCIATED: frozenset[str] = frozenset({"contract", "reassoc"})

_OPTIONS = {"cache": True, "nogil": True, "error_model": "numpy"}


def compiled(function: Callable[..., Any]) -> Any:
    """Compile a function at its first call, and keep the machine code for later processes.

    Parameters
    ----------
    function : callable
        Loops over arrays and scalars, in the part of Python that numba knows. Division by zero
        gives infinity or NaN, as with NumPy. Runs without Python's lock.

    Returns
    -------
    callable
        The same function, compiled.
    """
    return numba.njit(**_OPTIONS)(function)


def compiled_with(
    *,
    fastmath: frozenset[str] = frozenset(),
    inline: Literal["never", "always"] = "never",
) -> Callable[[Callable[..., Any]], Any]:
    """Like ``compiled``, with options.

    Parameters
    ----------
    fastmath : frozenset of str
        Freedoms in floating-point arithmetic: ``FUSED``, ``REASSOCIATED``, or none.
    inline : str
        "always" puts the function into its callers instead of calling it.

    Returns
    -------
    callable
        The decorator.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        options = {**_OPTIONS, "fastmath": set(fastmath), "inline": inline}
        return numba.njit(**options)(function)

    return decorate
