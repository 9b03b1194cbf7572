"""Types of kernel arguments, stated so that each kernel is compiled once."""

from __future__ import annotations

from typing import Any

from numba import types


def readonly(kind: Any, dimensions: int = 2) -> types.Array:
    """Return the type of a C-contiguous array that a kernel only reads.

    Writeable arrays fit it too; left to itself numba compiles anew for each mix of the two.
    """
    return types.Array(kind, dimensions, "C", readonly=True)
