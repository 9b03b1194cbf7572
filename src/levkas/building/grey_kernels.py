"""Compiled loop over all bands of a pixel."""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def mean_of_seen(values, flags, unseen):
    """Return the mean of each pixel's bands, (h, w) float64, 0 where one is `unseen`; and where none is."""
    height, width, bands = values.shape
    mean, seen = np.zeros((height, width)), np.ones((height, width), np.bool_)
    for y in range(height):
        for x in range(width):
            total = 0.0
            for b in range(bands):
                total += values[y, x, b]
                if flags[y, x, b] & unseen:
                    seen[y, x] = False
            if seen[y, x]:
                mean[y, x] = total / bands
    return mean, seen
