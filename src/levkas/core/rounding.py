"""Rounding to the digits kept: of a value those above its noise, at most 16 significant bits; 8 of its sigma.

Digits below the noise are noise, which no codec makes smaller. Where sigma is known, a value is rounded to a multiple of a
step that is the largest power of two of at most sigma/10, whatever its neighbours are: the error, spread evenly over a step,
adds step²/12 <= sigma²/1200, 0.08 %, to the variance of one value and, being independent from pixel to pixel, not more to
that of a mean. Noise of several steps dithers it, so that means are not biased (Widrow & Kollár 2008,
doi:10.1017/CBO9780511754661; steps by the noise as Pence et al. 2010, doi:10.1086/656249). Where the step would be finer
than 16 significant bits, and where sigma is not known, a value has these. Sigma, which nobody knows to 1 %, is right to 0.4 %.
"""

from __future__ import annotations

import numpy as np

from levkas.core.compiled import njit
from levkas.core.machine import tile_rows
from levkas.core.threads import in_threads

MANTISSA = 23
VALUE_DROP, SIGMA_DROP = MANTISSA - 15, MANTISSA - 7
"""Bits of float32 that are zero."""
STEP_PER_SIGMA = 0.1
"""Largest step of a value: twice as large adds up to 0.33 % to its variance, half as large 0.02 % for one more bit a value."""
MOST_STEPS = 1 << 15
"""Beyond so many, steps are finer than 16 significant bits."""
INFINITE = np.uint32(0x7F800000)
"""All bits of the exponent of float32."""
BLOCK_SAMPLES = 1 << 16
"""Worked on at a time: a cube's worth of temporaries is too much."""


def round_values(
    values: np.ndarray, sigma: np.ndarray | None = None, *, out: np.ndarray | None = None
) -> np.ndarray:
    """Round float32 to its noise, or to 16 significant bits where these are coarser; NaN and infinity stay.

    `sigma`, of the same shape, is the random part as it is stored: so a reader can tell the step. Values whose sigma is 0,
    NaN or infinite have 16 significant bits. `out` may be `values` itself.

    >>> round_values(np.float32([0.1, 4095.0, 65535.0])).tolist()
    [0.10000038146972656, 4095.0, 65535.0]

    A tenth of 0.01 lies between 1/1024 and 1/512: the step is 1/1024, and 0.1 is 102.4 of them.

    >>> float(round_values(np.float32([0.1]), np.float32([0.01]))[0] * 1024)
    102.0
    """
    return _by_rows(values, out, VALUE_DROP, sigma)


def round_sigma(sigma: np.ndarray, *, out: np.ndarray | None = None) -> np.ndarray:
    """Round float32 to 8 significant bits; NaN and infinity stay. `out` may be `sigma` itself.

    >>> round_sigma(np.float32([0.1, np.inf])).tolist()
    [0.10009765625, inf]
    """
    return _by_rows(sigma, out, SIGMA_DROP)


def round_root(variance: np.ndarray, *, out: np.ndarray | None = None) -> np.ndarray:
    """Return `round_sigma` of the root; of a variance below zero it is 0."""
    return _by_rows(variance, out, SIGMA_DROP, root=True)


def is_rounded(values: np.ndarray, drop: int) -> bool:
    """Return whether the last `drop` bits of all finite numbers are zero."""
    for row in range(0, len(values), 256):
        part = np.ascontiguousarray(values[row : row + 256], np.float32)
        if not np.array_equal(_by_rows(part, None, drop).view(np.uint32), part.view(np.uint32)):
            return False
    return True


def _by_rows(
    values: np.ndarray,
    out: np.ndarray | None,
    drop: int,
    sigma: np.ndarray | None = None,
    *,
    root: bool = False,
) -> np.ndarray:
    """Write the rounded values to `out`, some rows at a time."""
    result = np.empty(values.shape, np.float32) if out is None else out
    height = len(result)
    step = tile_rows(max(1, BLOCK_SAMPLES // max(1, result[:1].size)), max(1, height))

    def work(start: int, stop: int) -> None:
        for row in range(start, stop, step):
            rows = slice(row, min(row + step, stop))
            part = np.array(values[rows], np.float32, order="C")
            if root:
                part[part < 0] = 0
                np.sqrt(part, out=part)
            if sigma is None:
                _round(part.reshape(-1), drop)
            else:
                noise = np.ascontiguousarray(sigma[rows], np.float32)
                _round_to_noise(part.reshape(-1), noise.reshape(-1), drop)
            result[rows] = part

    in_threads(work, height, worth=result.size)
    return result


@njit(cache=True)
def _round(numbers, drop):  # type: ignore[no-untyped-def]
    # Adding a half in the integers carries into the exponent where it has to.
    half, keep = np.uint32(1 << (drop - 1)), np.uint32(0xFFFFFFFF << drop & 0xFFFFFFFF)
    bits = numbers.view(np.uint32)
    for i in range(len(bits)):
        whole = bits[i]
        finite = (whole & INFINITE) != INFINITE
        bits[i] = ((whole + half) & keep) if finite else whole


@njit(cache=True)
def _round_to_noise(numbers, sigma, drop):  # type: ignore[no-untyped-def]
    plain = numbers.copy()
    _round(plain, drop)
    tenth, most = np.float32(STEP_PER_SIGMA), np.float32(MOST_STEPS)
    for i in range(len(numbers)):
        power = np.uint32(np.float32(sigma[i] * tenth).view(np.uint32) & INFINITE)
        step = power.view(np.float32)  # an exponent alone: a power of two
        count = np.float32(numbers[i] / step)
        coarse = abs(count) < most and power != INFINITE
        numbers[i] = np.float32(np.rint(count) * step) if coarse else plain[i]
