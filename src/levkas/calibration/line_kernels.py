"""Kernel of `lines`: raw lines of a push-broom camera to values, flags and sigma in one passage.

What `flattening` makes of them, to the last bits of sums that stand in another order.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np
from numba import njit

from levkas.calibration.flattening import PRIOR
from levkas.cube import Flag
from levkas.lanes import look, put

SATURATED, BLACK, DEFECT, OUTSIDE = (
    np.uint8(f.value) for f in (Flag.SATURATED, Flag.BLACK, Flag.DEFECT, Flag.OUTSIDE)
)
TILE, LINES, GROUP = 64, 4, 16
"""Samples whose bands are turned to lie innermost at once; lines that share what is known of them;
bands that are turned in one go."""


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


@njit
def turn(raw, y, x0, count, codes):
    """Copy `count` samples of a line from `x0` on to `codes`, bands innermost."""
    bands = raw.shape[2]
    for b0 in range(0, bands, GROUP):
        last = min(b0 + GROUP, bands)
        for k in range(count):
            for b in range(b0, last):
                put(codes, k * bands + b, raw[y, x0 + k, b])


@njit(cache=True, nogil=True, error_model="numpy")
def develop_lines(
    start,
    stop,
    raw,
    dark,
    share_of_white,
    factor,
    shares,
    base,
    noise,
    limits,
    drops,
    values,
    flags,
    sigma,
):
    """Fill rows `start` to `stop` of values, flags and, where its size says so, sigma.

    Parameters
    ----------
    raw : (lines, samples, bands), uint8 or uint16, any strides
    dark, share_of_white, factor : (samples·bands,), float64
        Counts; what a count above dark is of the white's, 0 where there is no white; and what it is
        of the value.
    shares : (3, samples·bands), float64
        Variances of the means of white and of dark, the white's dark counted with the white where it
        is another one; (scale / lit)².
    base : (samples·bands,), uint8
        Flags that hold for all lines.
    noise : (gain, read, share of a shot, 1 where one dark serves both)
    limits : (saturation, clipped at black), codes
    drops : (int, int)
        Mantissa bits of values and of sigma that are rounded away.
    values, flags, sigma : (lines·samples·bands,)
    """
    samples, bands = raw.shape[1:]
    high, low = limits
    gain, read, share, shared = noise
    half = np.uint32(1 << (drops[1] - 1))
    keep = np.uint32((0xFFFFFFFF << drops[1]) & 0xFFFFFFFF)
    half_step = np.uint32((1 << drops[0]) >> 1)
    kept = np.uint32((0xFFFFFFFF << drops[0]) & 0xFFFFFFFF)
    codes = np.empty(TILE * bands, raw.dtype)
    spread = np.empty(bands, np.float32)
    bits = spread.view(np.uint32)
    value = np.empty(bands, np.float32)
    value_bits = value.view(np.uint32)
    white_share, dark_share, square = shares[0], shares[1], shares[2]
    for y0 in range(start, stop, LINES):
        for x0 in range(0, samples, TILE):
            count = min(TILE, samples - x0)
            for y in range(y0, min(y0 + LINES, stop)):
                turn(raw, y, x0, count, codes)
                for k in range(count):
                    i, to, c = (x0 + k) * bands, (y * samples + x0 + k) * bands, k * bands
                    for b in range(bands):
                        code = np.float32(look(codes, c + b))
                        flag = look(base, i + b) | (SATURATED if code >= high else np.uint8(0))
                        put(flags, to + b, flag | (BLACK if code <= low else np.uint8(0)))
                    for b in range(bands):
                        signal = np.float64(look(codes, c + b)) - look(dark, i + b)
                        put(value, b, np.float32(signal * look(factor, i + b)))
                        if sigma.size:
                            r = signal * look(share_of_white, i + b)
                            model = read + gain * max(signal, 0.0)
                            total = share * model + r * r * look(white_share, i + b)
                            if shared:
                                total += (1.0 - r) * (1.0 - r) * look(dark_share, i + b)
                            else:
                                total += look(dark_share, i + b)
                            part = np.float32(total * look(square, i + b))
                            put(spread, b, np.sqrt(max(part, np.float32(0))))
                    for b in range(bands):
                        put(value_bits, b, (look(value_bits, b) + half_step) & kept)
                    for b in range(bands):
                        put(values, to + b, look(value, b))
                    if sigma.size:
                        for b in range(bands):
                            put(bits, b, (look(bits, b) + half) & keep)
                        for b in range(bands):
                            put(sigma, to + b, look(spread, b))
    for i in range(samples * bands):
        if share_of_white[i] > 0.0:
            continue
        for y in range(start, stop):
            to = y * samples * bands + i
            values[to] = 0.0
            flags[to] |= DEFECT | OUTSIDE
            if sigma.size:
                sigma[to] = np.nan
