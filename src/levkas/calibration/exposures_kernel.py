"""Kernel of `exposures`: add one exposure to the weighted sums of a merge."""

from __future__ import annotations

import numba
import numpy as np
from numba import types

from levkas.calibration.numba_types import readonly

_REAL, _BYTE = readonly(types.float32), readonly(types.uint8)
_SUM, _SCALAR = types.float64[:, ::1], types.float64


@numba.njit(
    [
        types.void(
            *(_REAL, _REAL, _BYTE, _BYTE, _REAL, _SUM, _SUM, types.uint8[:, ::1]),
            *(_SCALAR,) * 7,
        )
    ],
    parallel=True,
    cache=True,
)
def add_exposure(  # type: ignore[no-untyped-def]
    mean, dark, saturated, black, rate, total, weights, clipped,
    time, limit, offset, gain, read, share, dark_share
):  # fmt: skip
    """Add w·(mean − dark − offset)/time to `total` and w to `weights`, where not saturated.

    w = time²/(share·(gain·rate·time + read) + dark_share·read), or `time` where `gain` < 0.
    `clipped` keeps whether the last exposure that counted was clipped at black.
    """
    height, width = mean.shape
    for y in numba.prange(height):
        dy, dx = y % dark.shape[0], dark.shape[1] > 1
        for x in range(width):
            if saturated[y, x] or mean[y, x] > limit:
                continue
            signal = np.float64(mean[y, x]) - np.float64(dark[dy, x * dx]) - offset
            weight = time
            if gain >= 0.0:
                light = gain * max(np.float64(rate[y, x]), 0.0) * time
                weight = time * time / (share * (light + read) + dark_share * read)
            total[y, x] += weight * signal / time
            weights[y, x] += weight
            clipped[y, x] = black[y, x]
