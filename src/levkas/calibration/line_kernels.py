"""Kernel of `lines`: raw lines of a push-broom camera to values, flags and sigma in one passage.

The numbers are those of `flatfield`, to the last bits of sums that stand in another order.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from levkas.calibration.flatfield import of_mean
from levkas.core.compiled import njit
from levkas.core.cube import Flag

SATURATED, BLACK, DEFECT, OUTSIDE = (
    np.uint8(f.value) for f in (Flag.SATURATED, Flag.BLACK, Flag.DEFECT, Flag.OUTSIDE)
)


@njit(cache=True, nogil=True)
def fill_share(out, signal, measured, freedom, share, gain, read, step):
    """Fill the variance of a mean, place by place."""
    for i in range(out.size):
        out[i] = of_mean(share, signal[i], np.float64(measured[i]), freedom, gain, read, step)


@njit
def gather(raw, at, apart, bands, codes):
    """Copy samples of a line from flat index `at` on to `codes`, bands innermost.

    `apart`: how far samples and bands lie from each other.
    """
    samples = codes.size // bands
    for k in range(samples):
        for b in range(bands):
            codes[k * bands + b] = raw[at + k * apart[0] + b * apart[1]]


class Tables(NamedTuple):
    """What is the same for all lines; arrays of samples·bands, bands innermost.

    `dark` in counts; `share_of_white`: what a count above dark is of the white's, 0 where there is no
    white; `factor`: what it is of the value; `white_noise`, `dark_noise`: variances of the means (the
    white's own dark counts with the white); `base`: flags of all lines; `lost`: indices where there is no
    white; `gain`, `read`: noise of one shot; `one_dark`: one dark serves both.
    """

    dark: Any
    share_of_white: Any
    factor: Any
    white_noise: Any
    dark_noise: Any
    base: Any
    lost: Any
    gain: float
    read: float
    one_dark: bool


class LineLimits(NamedTuple):
    """Codes that are saturated or clipped at black, mantissa bits that are rounded away; `squared`: variance instead of sigma."""

    saturation: float
    black: float
    value_drop: int
    sigma_drop: int
    squared: bool


@njit
def round_bits(numbers, drop):
    """Round float32 to fewer bits of mantissa: a half is added in the integers."""
    if drop == 0:
        return
    half, keep = np.uint32((1 << drop) >> 1), np.uint32((0xFFFFFFFF << drop) & 0xFFFFFFFF)
    bits = numbers.view(np.uint32)
    for i in range(bits.size):
        bits[i] = (bits[i] + half) & keep


@njit(cache=True, nogil=True, error_model="numpy")
def develop_lines(start, stop, raw, apart, tables, limits, out):
    """Fill lines `start` to `stop` of values, flags and, where its size says so, sigma.

    `raw` is flat, uint8 or uint16; `apart`: how far lines, samples and bands lie from each other in it;
    `out`: (values, flags, sigma), (lines, samples·bands).
    """
    values, flags, sigma = out
    bands, codes = apart[3], np.empty(values.shape[1], raw.dtype)
    for y in range(start, stop):
        gather(raw, y * apart[0], apart[1:3], bands, codes)
        develop_line(codes, tables, limits, values[y], flags[y])
        round_bits(values[y], limits.value_drop)
        if sigma.size:
            spread_of_line(codes, tables, sigma[y])
            round_bits(sigma[y], limits.sigma_drop)
            if limits.squared:
                for i in range(codes.size):
                    sigma[y, i] *= sigma[y, i]
        for i in tables.lost:
            values[y, i] = 0.0
            flags[y, i] |= DEFECT | OUTSIDE
            if sigma.size:
                sigma[y, i] = np.nan


@njit
def develop_line(codes, tables, limits, values, flags):
    """Write values and flags of one line."""
    dark, factor, base = tables.dark, tables.factor, tables.base
    saturation, black = limits.saturation, limits.black
    for i in range(codes.size):
        code = np.float64(codes[i])
        values[i] = (code - dark[i]) * factor[i]
        full = SATURATED if code >= saturation else np.uint8(0)
        flags[i] = base[i] | full | (BLACK if code <= black else np.uint8(0))


@njit
def spread_of_line(codes, tables, sigma):
    """Write sigma of one line: of its shot, of the mean of the white and of the dark."""
    dark, share_of_white, factor = tables.dark, tables.share_of_white, tables.factor
    white_noise, dark_noise = tables.white_noise, tables.dark_noise
    gain, read, one_dark = tables.gain, tables.read, 1.0 if tables.one_dark else 0.0
    for i in range(codes.size):
        signal = np.float64(codes[i]) - dark[i]
        r = signal * share_of_white[i]
        rest = 1.0 - one_dark * r
        variance = read + gain * max(signal, 0.0)
        variance += r * r * white_noise[i] + rest * rest * dark_noise[i]
        sigma[i] = np.sqrt(max(np.float32(variance * (factor[i] * factor[i])), np.float32(0.0)))
