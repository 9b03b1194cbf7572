"""Kernels of `flatfield`: one pass over the pixels for values and flags, one for variance.

Arrays are (h, w) views; one of height or width 1 stands for all rows or columns.
"""

from __future__ import annotations

import numba
import numpy as np
from numba import types

from levkas.calibration.noise_fit import HIDES, WORKED_OUT
from levkas.calibration.numba_types import readonly
from levkas.core.cube import Flag

PRIOR = 60.0  # a noise model weighs as much as this many degrees of freedom of a stack
SATURATED, BLACK, DEFECT = (np.uint8(f.value) for f in (Flag.SATURATED, Flag.BLACK, Flag.DEFECT))

_REAL, _BYTE = readonly(types.float32), readonly(types.uint8)
_SCALAR, _TABLE = types.float64, readonly(types.float64)


@numba.njit(
    [
        types.Tuple((types.float32[:, ::1], types.uint8[:, ::1]))(
            *(_REAL, _REAL, _REAL, _REAL, _TABLE, _BYTE, _BYTE, _BYTE, _BYTE)
        )
    ],
    parallel=True,
    cache=True,
)
def flatten(  # type: ignore[no-untyped-def]
    shot, dark, white, white_dark, table, saturated, white_saturated, black, bad
):
    """Return values (shot − dark)/(white − white_dark) · table, and flags.

    `table` is repeated over the pixels: white reflectance times the ratio of exposures.
    """
    height, width = shot.shape
    values = np.empty((height, width), np.float32)
    flags = np.empty((height, width), np.uint8)
    for y in numba.prange(height):
        dy, wy, vy = y % dark.shape[0], y % white.shape[0], y % white_dark.shape[0]
        sy, by, ty = y % white_saturated.shape[0], y % bad.shape[0], y % table.shape[0]
        dx, wx, vx = dark.shape[1] > 1, white.shape[1] > 1, white_dark.shape[1] > 1
        sx, bx = white_saturated.shape[1] > 1, bad.shape[1] > 1
        columns, tx = table.shape[1], 0
        for x in range(width):
            lit = np.float64(white[wy, x * wx]) - np.float64(white_dark[vy, x * vx])
            value = np.float64(shot[y, x]) - np.float64(dark[dy, x * dx])
            flag = SATURATED if saturated[y, x] or white_saturated[sy, x * sx] else np.uint8(0)
            if black[y, x]:
                flag |= BLACK
            if bad[by, x * bx]:
                flag |= DEFECT
            if lit > 0.0 and value == value:
                values[y, x] = value / lit * table[ty, tx]
            else:
                values[y, x] = np.nan
                flag |= DEFECT
            flags[y, x] = flag
            tx += 1
            if tx == columns:
                tx = 0
    return values, flags


@numba.njit(cache=True, nogil=True)
def hidden(noise, step):  # type: ignore[no-untyped-def]
    """Return `noise_fit.hidden_rounding` of one value; 0 where the noise shows all of rounding."""
    if not noise < HIDES * step * step:
        return 0.0
    x, total = -4.0 * np.pi**2 * max(noise, 0.0) / (step * step), np.pi**2 / 6
    if x < 0.0:
        total = 0.0
        for k in range(1, 64):
            term = np.exp(x * k * k) / (k * k)
            total += term
            if term < 1e-6:
                break
    return step * step / (2.0 * np.pi**2) * total


@numba.njit(cache=True, nogil=True)
def of_mean(share, signal, measured, freedom, gain, read, step):  # type: ignore[no-untyped-def]
    """Return the variance of a mean, from a stack, the model, or both; `share` of one shot's is left.

    What rounding does to all shots alike is left whole. A variance that was worked out is taken as it is.
    """
    if freedom >= WORKED_OUT:
        return share * measured
    if gain < 0.0:
        return share * measured if freedom > 0.0 else 0.0
    if share == 0.0:
        return 0.0
    model = read + gain * max(signal, 0.0)
    alike = hidden(model - step * step / 12.0, step)
    shown = (freedom * measured + PRIOR * (model - alike)) / (freedom + PRIOR)
    return share * shown + alike


@numba.njit(
    [
        types.float32[:, ::1](
            *(_REAL, _REAL, _SCALAR, _SCALAR) * 4, types.boolean, _TABLE, *(_SCALAR,) * 4
        )
    ],
    parallel=True,
    cache=True,
)
def propagate(  # type: ignore[no-untyped-def]
    shot,
    shot_variance,
    shot_freedom,
    shot_share,
    dark,
    dark_variance,
    dark_freedom,
    dark_share,
    white,
    white_variance,
    white_freedom,
    white_share,
    white_dark,
    white_dark_variance,
    white_dark_freedom,
    white_dark_share,
    shared,
    table,
    gain,
    read,
    white_read,
    step,
):
    """Return the variance of `flatten`'s values; `shared`: one dark serves both.

    Each side is a mean, the variance of one shot of it, that variance's degrees of freedom (0: not
    measured) and the share of it that the mean keeps. `gain` < 0: there is no noise model. `read` is the
    variance without light of the object's exposure, `white_read` that of the white's.
    """
    height, width = shot.shape
    result = np.empty((height, width), np.float32)
    for y in numba.prange(height):
        dy, wy, vy = y % dark.shape[0], y % white.shape[0], y % white_dark.shape[0]
        dx, wx, vx = dark.shape[1] > 1, white.shape[1] > 1, white_dark.shape[1] > 1
        s1, d1 = shot_variance.shape[1] > 1, dark_variance.shape[1] > 1
        w1, v1 = white_variance.shape[1] > 1, white_dark_variance.shape[1] > 1
        s0, d0 = y % shot_variance.shape[0], y % dark_variance.shape[0]
        w0, v0 = y % white_variance.shape[0], y % white_dark_variance.shape[0]
        ty = y % table.shape[0]
        columns, tx = table.shape[1], 0
        for x in range(width):
            lit = np.float64(white[wy, x * wx]) - np.float64(white_dark[vy, x * vx])
            signal = np.float64(shot[y, x]) - np.float64(dark[dy, x * dx])
            scale = table[ty, tx]
            tx += 1
            if tx == columns:
                tx = 0
            if not lit > 0.0:
                result[y, x] = np.nan
                continue
            r = signal / lit
            shot_part = of_mean(
                shot_share, signal, shot_variance[s0, x * s1], shot_freedom, gain, read, step
            )
            white_part = of_mean(
                white_share, lit, white_variance[w0, x * w1], white_freedom, gain, white_read, step
            )
            dark_part = of_mean(
                dark_share, 0.0, dark_variance[d0, x * d1], dark_freedom, gain, read, step
            )
            if shared:
                total = shot_part + r * r * white_part + (1.0 - r) ** 2 * dark_part
            else:
                variance = white_dark_variance[v0, x * v1]
                under = of_mean(
                    white_dark_share, 0.0, variance, white_dark_freedom, gain, white_read, step
                )
                total = shot_part + dark_part + r * r * (white_part + under)
            result[y, x] = total * (scale / lit) ** 2
    return result
