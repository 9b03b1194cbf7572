"""Kernel of `lines`: raw lines of a push-broom camera to values, flags and sigma in one passage.

Number for number what `flattening` makes of them: the same operations in the same order.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np
from numba import njit

from levkas.calibration.flattening import PRIOR
from levkas.cube import Flag

SATURATED, BLACK, DEFECT, OUTSIDE = (
    np.uint8(f.value) for f in (Flag.SATURATED, Flag.BLACK, Flag.DEFECT, Flag.OUTSIDE)
)
TILE = 32
"""Samples whose bands are turned to lie innermost at once."""


@njit(cache=True, nogil=True)
def one_shot(signal, measured, freedom, gain, read):
    """Variance of one shot of one place, as in `flattening`."""
    if gain < 0.0:
        return measured if freedom > 0.0 else 0.0
    model = read + gain * max(signal, 0.0)
    return (freedom * measured + PRIOR * model) / (freedom + PRIOR)


@njit(cache=True, nogil=True)
def fill_share(out, signal, measured, freedom, share, gain, read):
    """Fill the variance of a mean, place by place."""
    for i in range(out.size):
        out[i] = share * one_shot(signal[i], np.float64(measured[i]), freedom, gain, read)


@njit(cache=True, nogil=True)
def develop_lines(
    start, stop, raw, dark, lit, scale, shares, base, noise, limits, drop, values, flags, sigma
):
    """Fill rows `start` to `stop` of values, flags and, where its size says so, sigma.

    Parameters
    ----------
    raw : (lines, samples, bands), uint8 or uint16, any strides
    dark, lit, scale : (samples·bands,), float32, float64, float64
        Counts; white above its dark; reflectance of the white times the ratio of exposures.
    shares : (3, samples·bands), float64
        Variances of the means of white, dark and the white's dark.
    base : (samples·bands,), uint8
        Flags that hold for all lines.
    noise : (gain, read, share of a shot, 1 where one dark serves both)
    limits : (saturation, clipped at black), codes
    drop : int
        Mantissa bits of sigma that are rounded away.
    """
    samples, bands = raw.shape[1:]
    high, low = limits
    gain, read, share, shared = noise
    half = np.uint32(1 << (drop - 1))
    keep = np.uint32((0xFFFFFFFF << drop) & 0xFFFFFFFF)
    codes = np.empty((TILE, bands), np.float32)
    spread = np.empty(bands, np.float32)
    for y in range(start, stop):
        for x0 in range(0, samples, TILE):
            count = min(TILE, samples - x0)
            for b in range(bands):
                for k in range(count):
                    codes[k, b] = raw[y, x0 + k, b]
            for k in range(count):
                x = x0 + k
                i = x * bands
                for b in range(bands):
                    code = codes[k, b]
                    flag = base[i + b]
                    flag |= SATURATED if code >= high else np.uint8(0)
                    flag |= BLACK if code <= low else np.uint8(0)
                    signal = np.float64(code) - np.float64(dark[i + b])
                    known = lit[i + b] > 0.0
                    value = np.float32(signal / lit[i + b] * scale[i + b])
                    values[y, x, b] = value if known else np.float32(0)
                    flags[y, x, b] = flag if known else flag | DEFECT | OUTSIDE
                if sigma.size == 0:
                    continue
                for b in range(bands):
                    signal = np.float64(codes[k, b]) - np.float64(dark[i + b])
                    r = signal / lit[i + b]
                    shot = share * one_shot(signal, 0.0, 0.0, gain, read)
                    if shared:
                        total = shot + r * r * shares[0, i + b] + (1.0 - r) ** 2 * shares[1, i + b]
                    else:
                        total = (
                            shot + shares[1, i + b] + r * r * (shares[0, i + b] + shares[2, i + b])
                        )
                    part = np.float32(total * (scale[i + b] / lit[i + b]) ** 2)
                    spread[b] = np.sqrt(max(part, np.float32(0)))
                bits = spread.view(np.uint32)
                for b in range(bands):
                    bits[b] = (bits[b] + half) & keep
                for b in range(bands):
                    sigma[y, x, b] = spread[b] if lit[i + b] > 0.0 else np.float32(np.nan)
