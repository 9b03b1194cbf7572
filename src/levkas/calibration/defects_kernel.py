"""Kernel of `defects`: the median of the sound sensels around each defective one."""

from __future__ import annotations

import numba
import numpy as np
from numba import types

from levkas.calibration.numba_types import readonly
from levkas.core.cube import Flag

DEFECT, NEAR = np.uint8(Flag.DEFECT.value), np.uint8(Flag.NEAR.value)
RINGS = 4
ENOUGH = 3  # sound neighbours for a median; fewer only where no larger ring has more

_OUT = types.Tuple((types.float32[::1], types.float32[::1], types.uint8[::1]))


@numba.njit(
    [
        _OUT(
            readonly(types.float32, 3),
            readonly(types.uint8, 3),
            readonly(types.int64),
            types.int64,
            types.int64,
        )
    ],
    parallel=True,
    cache=True,
)
def mend(values, flags, where, rows, columns):  # type: ignore[no-untyped-def]
    """Return median, variance of prediction and extra flags for each (y, x, band) of `where`."""
    height, width, _ = values.shape
    n = where.shape[0]
    numbers = np.empty(n, np.float32)
    spreads = np.empty(n, np.float32)
    marks = np.zeros(n, np.uint8)
    for i in numba.prange(n):
        y, x, band = where[i, 0], where[i, 1], where[i, 2]
        sound = np.empty((2 * RINGS + 1) ** 2, np.float64)
        count = 0
        for ring in range(1, RINGS + 1):
            for v in range(-ring, ring + 1):
                for h in range(-ring, ring + 1):
                    if max(abs(v), abs(h)) != ring:
                        continue
                    at, across = y + v * rows, x + h * columns
                    if at < 0 or at >= height or across < 0 or across >= width:
                        continue
                    flag = flags[at, across, band]
                    value = values[at, across, band]
                    if flag & DEFECT or value != value:
                        continue
                    sound[count] = value
                    count += 1
                    if flag:
                        marks[i] |= NEAR
            if count >= ENOUGH:
                break
        if count == 0:
            numbers[i] = np.nan
            spreads[i] = np.nan
            continue
        numbers[i] = np.median(sound[:count])
        mean = sound[:count].mean()
        spread = 0.0
        for k in range(count):
            spread += (sound[k] - mean) ** 2
        spreads[i] = spread / (count - 1) * (1 + 1 / count) if count > 1 else np.nan
    return numbers, spreads, marks
