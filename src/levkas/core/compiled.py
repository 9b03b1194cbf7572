"""Numba's decorators, with kept machine code that is dropped when a source has changed.

Numba keeps what it compiled beside a module and looks only at the time of that module: what a
kernel inlines from another file, or a renamed class among its arguments, would stay as it was
after an update. Whatever a kernel calls has been imported before it, so code older than any source
of kernels imported so far is compiled again.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numba
from numba.core import event

from levkas.core.progress import COMPILING

OPTIONS = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
"""Of every kernel alike: what numba itself compiles for one then serves the next."""

_newest = 0.0


class _Compiling(event.Listener):
    """Keeps `COMPILING`: events of numba for what is compiled, none for what is loaded."""

    def on_start(self, event: event.Event) -> None:
        COMPILING.add(1)

    def on_end(self, event: event.Event) -> None:
        COMPILING.add(-1)


event.register("numba:compile", _Compiling())


def njit(function: Any = None, **options: Any) -> Any:
    """Compile a function as `numba.njit` does; with `cache=True` only current code is loaded.

    Without `cache=True` it can be called by other kernels only: what calls it from Python is left out,
    a tenth of the time to compile.
    """
    kept = bool(options.get("cache"))

    def compiled(function: Any) -> Any:
        _drop_old_code(function, kept=kept)
        return numba.njit(**{**OPTIONS, "no_cpython_wrapper": not kept, **options})(function)

    return compiled if function is None else compiled(function)


def _drop_old_code(function: Any, *, kept: bool) -> None:
    global _newest
    source = Path(function.__code__.co_filename)
    try:
        _newest = max(_newest, source.stat().st_mtime)
        if not kept:
            return
        folder = Path(str(numba.njit(cache=True)(function).stats.cache_path))
        name = f"{source.stem}.{function.__qualname__}-{function.__code__.co_firstlineno}"
        for index in folder.glob(f"{name}.*.nbi"):
            if index.stat().st_mtime < _newest:
                index.unlink()
    except (OSError, RuntimeError):  # A folder that others write, or none: numba judges by itself.
        return
