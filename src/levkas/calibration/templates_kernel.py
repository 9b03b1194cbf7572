"""Running sums of `templates` over shots, one pass; arrays are (h, w) views.

Rows are independent, so the bytes do not depend on the threads.
"""

from __future__ import annotations

import numpy as np

from levkas.core.compiled import njit
from levkas.core.threads import in_threads


@njit(cache=True)
def add_codes(start, stop, frame, totals, marks, limits):  # type: ignore[no-untyped-def]
    """Add whole codes to Σx (uint32) and Σx² (uint64), both exact; mark those beyond (high, low)."""
    (total, squares), (saturated, black), (high, low) = totals, marks, limits
    for y in range(start, stop):
        for x in range(frame.shape[1]):
            code = np.uint64(frame[y, x])
            total[y, x] += np.uint32(code)
            squares[y, x] += code * code
            saturated[y, x] |= np.float32(frame[y, x]) >= high
            black[y, x] |= np.float32(frame[y, x]) <= low


@njit(cache=True)
def add_reals(start, stop, frame, before, totals, marks, limits):  # type: ignore[no-untyped-def]
    """Update mean and Σ(x − mean)² by Welford's step; mark values beyond (high, low)."""
    (mean, spread), (saturated, black), (high, low) = totals, marks, limits
    for y in range(start, stop):
        for x in range(frame.shape[1]):
            value = np.float64(frame[y, x])
            step = value - mean[y, x]
            mean[y, x] += step / (before + 1)
            spread[y, x] += step * (value - mean[y, x])
            saturated[y, x] |= value >= high
            black[y, x] |= value <= low


def finish_codes(
    total: np.ndarray, squares: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and variance of one shot from exact sums of `count` shots."""
    mean, variance = np.empty(total.shape, np.float32), np.empty(total.shape, np.float32)
    in_threads(_finish, len(total), total, squares, count, mean, variance)
    return mean, variance


@njit(cache=True)
def _finish(start, stop, total, squares, count, mean, variance):  # type: ignore[no-untyped-def]
    freedom = count * (count - 1.0)
    for y in range(start, stop):
        for x in range(total.shape[1]):
            sums = np.uint64(total[y, x])
            mean[y, x] = np.float64(sums) / count
            variance[y, x] = np.float64(squares[y, x] * np.uint64(count) - sums * sums) / freedom


def finish_reals(
    centre: np.ndarray, spread: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and variance of one shot from Welford's sums."""
    variance = np.empty(spread.shape, np.float32)
    np.divide(spread, count - 1.0, out=variance, casting="same_kind")
    return centre.astype(np.float32), variance
