"""Compiled loops: hides numba, the options that all kernels share, and how they are optimised."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, Literal

# A product and the sum that follows are rounded once
FUSED: frozenset[str] = frozenset({"contract"})
# ... and sums of many terms are taken in any order
REASSOCIATED: frozenset[str] = frozenset({"contract", "reassoc"})

# Without `no_cfunc_wrapper` each kernel is compiled a second time, for callers in C
_OPTIONS = {"cache": True, "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
_REPORTS: list[Callable[[int], None]] = []
_KERNELS: list[Any] = []  # of the modules imported so far


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
    return _kept(_njit()(**_OPTIONS)(function))


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
        return _kept(_njit()(**options)(function))

    return decorate


@cache
def _njit() -> Any:
    """Import numba, of which commands that compute nothing have no need."""
    import numba
    from numba.core import event

    event.Listener.register(_Compilations)
    event.register("numba:compile", _Compilations(numba.config))
    return numba.njit


def watch_compilation(report: Callable[[int], None]) -> None:
    """Have a function called before each compilation: of kernels that no earlier process kept.

    Parameters
    ----------
    report : callable
        Takes the number of kernels that this process has compiled, those inside others excepted.
    """
    _REPORTS.append(report)


def load_kernels(package: str = "spheremark") -> int:
    """Load the machine code that earlier processes kept, so that first calls need not.

    Parameters
    ----------
    package : str
        Kernels of this package and those below it, of modules imported so far.

    Returns
    -------
    int
        Signatures loaded. A kernel without code on disk is left to its first call.
    """
    n = 0
    for kernel in [one for one in _KERNELS if f"{one.__module__}.".startswith(f"{package}.")]:
        cache, codegen = kernel._cache, kernel.targetctx.codegen()
        known = cache._cache_file._load_index()  # numba has no public function
        for signature, *_ in known:
            if cache._index_key(signature, codegen) in known:  # else of another processor
                kernel.compile(signature)
                n += 1
    return n


def compile_in_memory() -> None:
    """Keep nothing that is compiled from now on, and have all that compiling needs in memory."""
    import numba
    from numba.core.caching import NullCache

    numba.njit(lambda x: x + 1)(1)
    for kernel in _KERNELS:
        kernel._cache = NullCache()


def _kept(kernel: Any) -> Any:
    """Enter a kernel into the list of kernels."""
    _KERNELS.append(kernel)
    return kernel


class _Compilations:
    """Follows what is compiled; optimises a kernel in full only where Python calls it.

    LLVM optimises a kernel again as a part of each kernel that calls it. For the inner ones the
    first level is enough: the code of the outermost is the same, in two thirds of the time.
    """

    def __init__(self, config: Any) -> None:
        self._config = config
        self._levels = [config.OPT]  # before, and of the kernels being compiled, outermost first
        self._inner_level = min(config.OPT, type(config.OPT)(1))
        self._is_ours = False
        self._n_compiled = 0

    def notify(self, event: Any) -> None:
        """Set the level of a kernel that begins, or restore that of the kernel around it."""
        if not event.is_start:
            self._levels.pop()
        elif len(self._levels) == 1:
            self._is_ours = event.data["dispatcher"].py_func.__module__.startswith("spheremark.")
            self._levels.append(self._levels[0])
            self._report()
        else:
            self._levels.append(self._inner_level if self._is_ours else self._levels[-1])
        self._config.OPT = self._levels[-1]

    def _report(self) -> None:
        """Report the kernels compiled so far."""
        if self._is_ours:
            for report in _REPORTS:
                report(self._n_compiled)
            self._n_compiled += 1
