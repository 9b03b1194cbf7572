"""Kernels of `templates`: running sums over shots, one pass, rows in parallel.

Arrays are (h, w) views; rows are independent, so the bytes do not depend on the threads.
"""

from __future__ import annotations

import numpy as np
from numba import types

from levkas.core.compiled import njit, prange

_BYTES, _REALS = types.uint8[:, ::1], types.float64[:, ::1]


@njit(
    [
        types.void(
            types.Array(code, 2, "C", readonly=True),
            types.uint32[:, ::1],
            types.uint64[:, ::1],
            *(_BYTES, _BYTES, types.float64, types.float64),
        )
        for code in (types.uint8, types.uint16)
    ],
    parallel=True,
    cache=True,
)
def add_codes(frame, total, squares, saturated, black, high, low):  # type: ignore[no-untyped-def]
    """Add whole codes to Σx (uint32) and Σx² (uint64), both exact; mark clipped ones."""
    height, width = frame.shape
    for y in prange(height):
        for x in range(width):
            code = np.uint64(frame[y, x])
            total[y, x] += np.uint32(code)
            squares[y, x] += code * code
            saturated[y, x] |= np.float32(frame[y, x]) >= high
            black[y, x] |= np.float32(frame[y, x]) <= low


@njit(
    [
        types.void(
            types.Array(real, 2, "C", readonly=True),
            types.int64,
            *(_REALS, _REALS, _BYTES, _BYTES, types.float64, types.float64),
        )
        for real in (types.float32, types.float64)
    ],
    parallel=True,
    cache=True,
)
def add_reals(  # type: ignore[no-untyped-def]
    frame, before, mean, spread, saturated, black, high, low
):
    """Update mean and Σ(x − mean)² by Welford's step; mark clipped values."""
    height, width = frame.shape
    for y in prange(height):
        for x in range(width):
            value = np.float64(frame[y, x])
            step = value - mean[y, x]
            mean[y, x] += step / (before + 1)
            spread[y, x] += step * (value - mean[y, x])
            saturated[y, x] |= value >= high
            black[y, x] |= value <= low


_PAIR = types.UniTuple(types.float32[:, ::1], 2)


@njit(
    [
        _PAIR(
            types.Array(types.uint32, 2, "C", readonly=True),
            types.Array(types.uint64, 2, "C", readonly=True),
            types.int64,
        )
    ],
    parallel=True,
    cache=True,
)
def finish_codes(total, squares, count):  # type: ignore[no-untyped-def]
    """Return mean and variance of one shot from exact sums of `count` shots."""
    height, width = total.shape
    mean = np.empty((height, width), np.float32)
    variance = np.empty((height, width), np.float32)
    n = np.uint64(count)
    for y in prange(height):
        for x in range(width):
            s = np.uint64(total[y, x])
            mean[y, x] = s / count
            variance[y, x] = np.float64(n * squares[y, x] - s * s) / (count * (count - 1.0))
    return mean, variance


@njit(
    [
        _PAIR(
            types.Array(types.float64, 2, "C", readonly=True),
            types.Array(types.float64, 2, "C", readonly=True),
            types.int64,
        )
    ],
    parallel=True,
    cache=True,
)
def finish_reals(centre, spread, count):  # type: ignore[no-untyped-def]
    """Return mean and variance of one shot from Welford's sums."""
    height, width = centre.shape
    mean = np.empty((height, width), np.float32)
    variance = np.empty((height, width), np.float32)
    for y in prange(height):
        for x in range(width):
            mean[y, x] = centre[y, x]
            variance[y, x] = spread[y, x] / (count - 1.0)
    return mean, variance
