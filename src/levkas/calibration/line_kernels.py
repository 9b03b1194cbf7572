"""Kernel of `lines`: raw lines of a push-broom camera to values, flags and sigma in one passage.

What `flatfield` makes of them, to the last bits of sums that stand in another order.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np
from numba import njit

from levkas.calibration.flatfield import of_mean
from levkas.core.cube import Flag
from levkas.double_lanes import (
    doubles,
    load_doubles,
    mark_least,
    mark_most,
    narrowed,
    positive,
    root,
    round_bits,
)
from levkas.lanes import join, load_marks, look, put, store, store_marks
from levkas.squares import SIDE, turn_square

HELPERS = "02ce2d93991e4bd6"
"""Digest of what is inlined from other files: numba keeps machine code as long as this file is the same."""

SATURATED, BLACK, DEFECT, OUTSIDE = (
    np.uint8(f.value) for f in (Flag.SATURATED, Flag.BLACK, Flag.DEFECT, Flag.OUTSIDE)
)
TILE, LINES = 64, 16
"""Samples whose bands are turned to lie innermost at once; lines that share what is known of them."""


@njit(cache=True, nogil=True)
def fill_share(out, signal, measured, freedom, share, gain, read, step):
    """Fill the variance of a mean, place by place."""
    for i in range(out.size):
        out[i] = of_mean(share, signal[i], np.float64(measured[i]), freedom, gain, read, step)


@njit
def gather(raw, at, apart, count, bands, codes):
    """Copy `count` samples of a line from flat index `at` on to `codes`, bands innermost.

    `apart`: how far samples and bands lie from each other.
    """
    if apart[0] == bands and apart[1] == 1:
        for c in range(count * bands):
            put(codes, c, look(raw, at + c))
    elif apart[0] != 1 or count < TILE or bands < SIDE:
        for k in range(count):
            for b in range(bands):
                put(codes, k * bands + b, look(raw, at + k * apart[0] + b * apart[1]))
    else:
        for block in range(0, bands, SIDE):
            b = min(block, bands - SIDE)  # the last ones twice
            for k in range(0, TILE, SIDE):
                turn_square(raw, at + k + b * apart[1], apart[1], codes, k * bands + b, bands)


@njit(cache=True, nogil=True, error_model="numpy")
def develop_lines(
    start,
    stop,
    raw,
    apart,
    shape,
    dark,
    share_of_white,
    factor,
    shares,
    base,
    noise,
    lost,
    limits,
    drops,
    squared,
    values,
    flags,
    sigma,
):
    """Fill rows `start` to `stop` of values, flags and, where its size says so, sigma.

    Parameters
    ----------
    raw : flat, uint8 or uint16
    apart : (line, sample, band)
        How far those lie from each other in `raw`.
    shape : (samples, bands)
    dark, share_of_white, factor : (samples·bands + 16,), float64
        Counts; what a count above dark is of the white's, 0 where there is no white; and what it is
        of the value.
    shares : (2, samples·bands + 16), float64
        Variances of the means of white and of dark, the white's dark counted with the white where it
        is another one.
    base : (samples·bands + 16,), uint8
        Flags that hold for all lines.
    noise : (gain, read, share of a shot, 1 where one dark serves both)
    lost : indices of samples·bands
        Where there is no white.
    limits : (saturation, clipped at black), codes
    drops : (int, int)
        Mantissa bits of values and of sigma that are rounded away.
    squared : bool
        Whether the square of sigma takes its place.
    values, flags, sigma : (lines·samples·bands,)
        Where a line has fewer than sixteen numbers, sixteen more.
    """
    samples, bands = shape
    codes = np.empty(TILE * bands + SIDE, raw.dtype)
    tables = dark, share_of_white, factor, shares[0], shares[1], base
    for y0 in range(start, stop, LINES):
        for left in range(0, samples, TILE):
            x0 = max(0, min(left, samples - TILE))  # the last ones twice
            count = min(TILE, samples)
            size, i = count * bands, x0 * bands
            for y in range(y0, min(y0 + LINES, stop)):
                gather(raw, y * apart[0] + x0 * apart[1], apart[1:], count, bands, codes)
                to = (y * samples + x0) * bands
                for block in range(0, size, SIDE):
                    c = max(0, min(block, size - SIDE))
                    develop_sixteen(
                        codes, c, tables, i + c, noise, limits, drops, squared,
                        values, flags, sigma, to + c,
                    )  # fmt: skip
    for i in lost:
        for y in range(start, stop):
            to = y * samples * bands + i
            values[to] = 0.0
            flags[to] |= DEFECT | OUTSIDE
            if sigma.size:
                sigma[to] = np.nan


@njit
def develop_sixteen(
    codes, c, tables, i, noise, limits, drops, squared, values, flags, sigma, to
):  # fmt: skip
    """Calibrate sixteen codes from `c` on, whose tables begin at `i`; write from `to` on."""
    dark, share_of_white, factor, white_share, dark_share, base = tables
    gain, read, share, shared = noise
    code = load_doubles(codes, c)
    marks = join(mark_least(code, limits[0], SATURATED), mark_most(code, limits[1], BLACK))
    store_marks(flags, to, join(load_marks(base, i), marks))
    signal = code - load_doubles(dark, i)
    half, keep = np.uint32((1 << drops[0]) >> 1), np.uint32((0xFFFFFFFF << drops[0]) & 0xFFFFFFFF)
    times = load_doubles(factor, i)
    store(values, to, round_bits(narrowed(signal * times), half, keep))
    if sigma.size:
        r = signal * load_doubles(share_of_white, i)
        model = doubles(read) + doubles(gain) * positive(signal)
        total = doubles(share) * model + r * r * load_doubles(white_share, i)
        if shared:
            rest = doubles(1.0) - r
            total = total + rest * rest * load_doubles(dark_share, i)
        else:
            total = total + load_doubles(dark_share, i)
        spread = root(positive(narrowed(total * (times * times))))
        half, keep = (
            np.uint32(1 << (drops[1] - 1)),
            np.uint32((0xFFFFFFFF << drops[1]) & 0xFFFFFFFF),
        )
        spread = round_bits(spread, half, keep)
        store(sigma, to, spread * spread if squared else spread)
