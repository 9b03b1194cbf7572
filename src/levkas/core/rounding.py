"""Rounding to the digits that carry information: a step of 1/16 to 1/8 of a value's sigma, and sigma to 8 significant bits.

What lies below is noise that no codec makes smaller, [pence2010]_ (10.1086/656249). A step q adds q²/12 to the variance: at
most 1/768 of sigma², 0.07 % in the mean over sizes of sigma; sigma is right to 0.4 %. The noise, eight steps or more, dithers it, so that means of many
pixels have no bias. A value without a sigma, or of a very small one, keeps 16 significant bits: 1/65536 of it.
"""

from __future__ import annotations

import numpy as np

from levkas.core.compiled import njit
from levkas.core.machine import tile_rows

MANTISSA = 23
VALUE_DROP = MANTISSA - 15
SIGMA_DROP = MANTISSA - 7
"""Bits of float32 that are zero."""
FINER = 3
"""The step is the power of two at most sigma, divided by two so many times."""
ROWS = 256


def round_values(
    values: np.ndarray, sigma: np.ndarray | None = None, *, out: np.ndarray | None = None
) -> np.ndarray:
    """Round float32 to a step of 1/16 to 1/8 of their sigma, and to 16 significant bits; NaN and infinity stay.

    Parameters
    ----------
    values : ndarray
    sigma : ndarray, optional
        Of the same shape; where it is 0 or not finite the significant bits alone count.
    out : ndarray, optional
        May be `values` itself.

    Examples
    --------
    >>> round_values(np.float32([0.1, 4095.0, 65535.0])).tolist()
    [0.10000038146972656, 4095.0, 65535.0]

    The largest power of two within 0.01 is 1/128: the step is 1/1024, and 0.1 is 102.4 steps.

    >>> (1024 * round_values(np.float32([0.1, 0.1]), np.float32([0.01, 0.0]))).tolist()
    [102.0, 102.400390625]
    """
    result = _rounded(values, VALUE_DROP, out, False)
    if sigma is None:
        return result
    step = tile_rows(ROWS, len(result))
    for row in range(0, len(result), step):
        into = result[row : row + step]
        rounded = np.ascontiguousarray(into)
        steps = np.array(sigma[row : row + step], np.float32, order="C")
        _round_to_noise(rounded.reshape(-1), steps.reshape(-1))
        if rounded is not into:
            into[...] = rounded
    return result


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


def _rounded(values: np.ndarray, drop: int, out: np.ndarray | None, root: bool) -> np.ndarray:
    result = np.empty(values.shape, np.float32) if out is None else out
    half, keep = np.uint32(1 << (drop - 1)), np.uint32(0xFFFFFFFF << drop & 0xFFFFFFFF)
    step = tile_rows(ROWS, len(values))
    for row in range(0, len(values), step):  # a cube's worth of temporaries is too much
        part, into = values[row : row + step], result[row : row + step]
        rounded = into if into.flags.c_contiguous else np.empty(into.shape, np.float32)
        if rounded is not part:
            rounded[...] = part
        _round(rounded.reshape(-1), half, keep, root)
        if rounded is not into:
            into[...] = rounded
    return result


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
def _round_to_noise(numbers, sigma):  # type: ignore[no-untyped-def]
    # Sigma becomes the steps, in its own place.
    # A power of two is its exponent alone. Adding 1.5 · 2^23 and taking it away rounds to the nearest whole number, ties to
    # even, of what is below 2^22; what is larger has no digits below a step, as what is not finite.
    least, most = np.uint32((FINER + 1) << MANTISSA), np.uint32(0xFE << MANTISSA)
    whole, largest = np.float32(1.5 * 2**23), np.float32(2**22)
    powers = sigma.view(np.uint32)
    for i in range(len(powers)):
        exponent = powers[i] & np.uint32(0x7F800000)
        exponent = exponent if exponent < most else np.uint32(0)
        powers[i] = max(exponent, least) - np.uint32(FINER << MANTISSA)
    for i in range(len(numbers)):
        step = sigma[i]
        found = numbers[i] / step
        numbers[i] = ((found + whole) - whole) * step if abs(found) < largest else numbers[i]


@njit(cache=True)
def _all_round(bits, rest):  # type: ignore[no-untyped-def]
    infinite = np.uint32(0x7F800000)
    loose = 0
    for word in bits:
        loose += (word & infinite) != infinite and (word & rest) != 0
    return loose == 0
