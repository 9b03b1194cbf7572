"""Rounding to the digits kept: of a value those above its noise, at most 16 significant bits; 8 of its sigma.

Digits below the noise are noise, which no codec makes smaller. Where sigma is known, a value is rounded to a multiple of a step
that is the largest power of two of at most sigma/10, whatever its neighbours are: the error, spread evenly over a step, adds
step²/12 <= sigma²/1200, 0.08 %, to the variance of one value and, being independent from pixel to pixel, not more to that of a mean.
Noise of several steps dithers it, so that means are not biased (Widrow & Kollár 2008, doi:10.1017/CBO9780511754661; steps by the
noise as Pence et al. 2010, doi:10.1086/656249). Where the step would be finer than 16 significant bits, and
where sigma is not known, a value has these. Sigma, which nobody knows to 1 %, is right to 0.4 %.
"""

from __future__ import annotations

import numpy as np

from levkas.core.compiled import njit
from levkas.core.machine import tile_rows
from levkas.core.threads import in_threads

MANTISSA = 23
VALUE_DROP = MANTISSA - 15
SIGMA_DROP = MANTISSA - 7
"""Bits of float32 that are zero."""
STEP_PER_SIGMA = 0.1
"""Largest step of a value: twice as large adds up to 0.33 % to its variance, half as large 0.02 % for one more bit a value."""
ROWS = 256


def round_values(
    values: np.ndarray, sigma: np.ndarray | None = None, *, out: np.ndarray | None = None
) -> np.ndarray:
    """Round float32 to its noise, or to 16 significant bits where these are coarser; NaN and infinity stay.

    Parameters
    ----------
    values : ndarray, any shape, float32
    sigma : ndarray, same shape, float32, optional
        Random part, one standard deviation, as it is stored: so a reader can tell the step. Values whose sigma is 0, NaN or
        infinite have 16 significant bits.
    out : ndarray, optional
        May be `values` itself.

    Examples
    --------
    >>> round_values(np.float32([0.1, 4095.0, 65535.0])).tolist()
    [0.10000038146972656, 4095.0, 65535.0]

    A tenth of 0.01 lies between 1/1024 and 1/512: the step is 1/1024, and 0.1 is 102.4 of them.

    >>> float(round_values(np.float32([0.1]), np.float32([0.01]))[0] * 1024)
    102.0
    """
    return _rounded(values, VALUE_DROP, out, False, sigma)


def round_sigma(sigma: np.ndarray, *, out: np.ndarray | None = None) -> np.ndarray:
    """Round float32 to 8 significant bits; NaN and infinity stay. `out` may be `sigma` itself.

    Examples
    --------
    >>> round_sigma(np.float32([0.1, np.inf])).tolist()
    [0.10009765625, inf]
    """
    return _rounded(sigma, SIGMA_DROP, out, False)


def round_root(variance: np.ndarray, *, out: np.ndarray | None = None) -> np.ndarray:
    """Return `round_sigma` of the root; of a variance below zero it is 0."""
    return _rounded(variance, SIGMA_DROP, out, True)


def is_rounded(values: np.ndarray, drop: int) -> bool:
    """Return whether the last `drop` bits of all finite numbers are zero."""
    for row in range(0, len(values), ROWS):
        part = np.ascontiguousarray(values[row : row + ROWS], np.float32)
        if not _all_round(part.reshape(-1).view(np.uint32), np.uint32((1 << drop) - 1)):
            return False
    return True


def _rounded(
    values: np.ndarray,
    drop: int,
    out: np.ndarray | None,
    root: bool,
    sigma: np.ndarray | None = None,
) -> np.ndarray:
    result = np.empty(values.shape, np.float32) if out is None else out
    in_threads(_round_rows, len(values), values, result, (drop, root), sigma)
    return result


def _round_rows(
    start: int,
    stop: int,
    values: np.ndarray,
    result: np.ndarray,
    how: tuple[int, bool],
    sigma: np.ndarray | None,
) -> None:
    drop, root = how
    half, keep = np.uint32(1 << (drop - 1)), np.uint32(0xFFFFFFFF << drop & 0xFFFFFFFF)
    step = tile_rows(ROWS, len(values))
    for row in range(start, stop, step):  # a cube's worth of temporaries is too much
        rows = slice(row, min(row + step, stop))
        part, into = values[rows], result[rows]
        rounded = into if into.flags.c_contiguous else np.empty(into.shape, np.float32)
        if result is not values or rounded is not into:
            rounded[...] = part
        if sigma is None:
            _round(rounded.reshape(-1), half, keep, root)
        else:
            noise = np.ascontiguousarray(sigma[rows], np.float32)
            _round_to_noise(rounded.reshape(-1), noise.reshape(-1), half, keep)
        if rounded is not into:
            into[...] = rounded


@njit(cache=True)
def _round(numbers, half, keep, root):  # type: ignore[no-untyped-def]
    # In its own place: with two arrays that may be one, no eight numbers are done at once.
    # Adding a half in the integers carries into the exponent where it has to.
    infinite = np.uint32(0x7F800000)
    bits = numbers.view(np.uint32)
    if root:
        for i in range(len(numbers)):
            number = numbers[i]
            numbers[i] = np.sqrt(np.float32(0.0) if number < 0.0 else number)
    for i in range(len(bits)):
        whole = bits[i]
        finite = (whole & infinite) != infinite
        bits[i] = ((whole + half) & keep) if finite else whole


@njit(cache=True)
def _round_to_noise(numbers, sigma, half, keep):  # type: ignore[no-untyped-def]
    infinite = np.uint32(0x7F800000)
    part, most = np.float32(STEP_PER_SIGMA), np.float32(1 << 15)
    words = numbers.view(np.uint32)
    for i in range(len(numbers)):
        number, word = numbers[i], words[i]
        largest = np.float32(sigma[i] * part)
        power = np.uint32(largest.view(np.uint32) & infinite)  # an exponent alone: a power of two
        step = power.view(np.float32)
        count = np.float32(number / step)
        whole = np.uint32((word + half) & keep)
        plain = whole.view(np.float32) if (word & infinite) != infinite else number
        # Beyond 2^15 steps they are finer than 16 significant bits; of ties the even one.
        coarse = abs(count) < most and power != infinite
        numbers[i] = np.float32(np.rint(count) * step) if coarse else plain


@njit(cache=True)
def _all_round(bits, rest):  # type: ignore[no-untyped-def]
    infinite = np.uint32(0x7F800000)
    loose = 0
    for word in bits:
        loose += (word & infinite) != infinite and (word & rest) != 0
    return loose == 0
