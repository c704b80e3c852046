"""Compiled loops: hides numba, the options that all kernels share, and how they are optimised."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numba
from numba.core import event

# A product and the sum that follows are rounded once
FUSED: frozenset[str] = frozenset({"contract"})
# ... and sums of many terms are taken in any order
REASSOCIATED: frozenset[str] = frozenset({"contract", "reassoc"})

# Without `no_cfunc_wrapper` each kernel is compiled a second time, for callers in C
_OPTIONS = {"cache": True, "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}


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


class _OptimiseOnce(event.Listener):  # type: ignore[misc]  # numba ships no types
    """Optimises a kernel in full only where Python calls it.

    LLVM optimises a kernel again as a part of each kernel that calls it. For the inner ones the
    first level is enough: the code of the outermost is the same, in two thirds of the time.
    """

    def __init__(self) -> None:
        self._levels: list[Any] = []  # of the kernels that are being compiled, outermost first
        self._is_ours = False

    def on_start(self, event: Any) -> None:
        """Lower the level for what is compiled on behalf of a kernel of this package."""
        if not self._levels:
            module = event.data["dispatcher"].py_func.__module__
            self._is_ours = module.startswith("spheremark.")
        elif self._is_ours:
            numba.config.OPT = _INNER_LEVEL
        self._levels.append(numba.config.OPT)

    def on_end(self, event: Any) -> None:  # noqa: ARG002  the protocol of numba
        """Restore the level of the kernel around it."""
        self._levels.pop()
        numba.config.OPT = self._levels[-1] if self._levels else _LEVEL


_LEVEL = numba.config.OPT
_INNER_LEVEL = min(_LEVEL, type(_LEVEL)(1))
event.register("numba:compile", _OptimiseOnce())
