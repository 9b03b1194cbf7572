"""Kernel of `mosaic`: apply stencils to values, variance and flags in one pass."""

from __future__ import annotations

import numba
import numpy as np
from numba import types

from levkas.calibration.numba_types import readonly
from levkas.core.cube import Flag

NEAR = np.uint8(Flag.NEAR.value)

_REAL, _BYTE, _INDEX = readonly(types.float32), readonly(types.uint8), readonly(types.int64, 1)
_CUBE = types.float32[:, :, ::1]


@numba.njit(
    [
        types.Tuple((_CUBE, types.uint8[:, :, ::1], _CUBE))(
            *(_REAL, _BYTE, _REAL, types.boolean, _INDEX, _INDEX, _INDEX, _INDEX, _INDEX),
            *(readonly(types.float64, 1), readonly(types.uint8, 1), types.int64, types.int64),
        )
    ],
    parallel=True,
    cache=True,
)
def weigh(  # type: ignore[no-untyped-def]
    values, flags, variance, known, rows, columns, start, dy, dx, weight, own, channels, reach
):
    """Return Σwv, flags and, where `known`, Σw²u², all (h, w, channels).

    A tap on the place itself hands its flags on as they are. Any other flagged tap sets NEAR, and
    hands on its bits too where it is of the same channel (`own`).
    """
    height, width = values.shape
    kinds = np.int64(0)
    for x in range(width):
        kinds = max(kinds, columns[x] + 1)
    marked = np.zeros(height, np.bool_)
    for y in numba.prange(height):
        for x in range(width):
            if flags[y, x]:
                marked[y] = True
                break
    made = np.empty((height, width, channels), np.float32)
    noted = np.zeros((height, width, channels), np.uint8)
    spread = np.empty((height if known else 0, width, channels), np.float32)
    for y in numba.prange(height):
        near = False
        for v in range(max(0, y - reach), min(height, y + reach + 1)):
            near |= marked[v]
        for x in range(width):
            first = (rows[y] * kinds + columns[x]) * channels
            for k in range(channels):
                begin, end = start[first + k], start[first + k + 1]
                total = 0.0
                for i in range(begin, end):
                    total += weight[i] * values[y + dy[i], x + dx[i]]
                made[y, x, k] = total
                if known:
                    total = 0.0
                    for i in range(begin, end):
                        total += weight[i] * weight[i] * variance[y + dy[i], x + dx[i]]
                    spread[y, x, k] = total
                if near:
                    flag = np.uint8(0)
                    for i in range(begin, end):
                        bits = flags[y + dy[i], x + dx[i]]
                        if bits and dy[i] == 0 and dx[i] == 0 and own[i]:
                            flag |= bits
                        elif bits:
                            flag |= NEAR | (bits if own[i] else np.uint8(0))
                    noted[y, x, k] = flag
    return made, noted, spread
