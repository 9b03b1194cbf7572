"""How arrays are handed to the kernels: C-contiguous rows, flags as bytes."""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike


def as_rows(array: np.ndarray, kind: DTypeLike | None = np.float32) -> np.ndarray:
    """Return (h, w) or (h, w, b) as (h, w·b) of dtype `kind` (None: its own); a view if it can be.

    >>> as_rows(np.zeros((2, 3, 4))).shape
    (2, 12)
    """
    return np.ascontiguousarray(array, kind).reshape(array.shape[0], -1)


def as_marks(mask: np.ndarray) -> np.ndarray:
    """Return a boolean mask as (h, w·b) bytes that share its memory.

    >>> as_marks(np.array([[True, False]])).tolist()
    [[1, 0]]
    """
    return as_rows(mask, bool).view(np.uint8)
