"""Rounding to the digits kept: 16 significant bits of a value, 8 of its sigma.

A value's step is at most 1/65536 of it, a hundredth of the noise of the best single shot; what
lies below is noise that no codec makes smaller. Sums of a thousand pixels do not see it either.
Sigma, which nobody knows to 1 %, is right to 0.4 %.
"""

from __future__ import annotations

import numpy as np

from levkas.core.compiled import njit
from levkas.core.machine import tile_rows

MANTISSA = 23
VALUE_DROP = MANTISSA - 15
SIGMA_DROP = MANTISSA - 7
"""Bits of float32 that are zero."""
ROWS = 256


def round_values(values: np.ndarray, *, out: np.ndarray | None = None) -> np.ndarray:
    """Round float32 to 16 significant bits; NaN and infinity stay. `out` may be `values` itself.

    Examples
    --------
    >>> round_values(np.float32([0.1, 4095.0, 65535.0])).tolist()
    [0.10000038146972656, 4095.0, 65535.0]
    """
    return _rounded(values, VALUE_DROP, out, False)


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
def _all_round(bits, rest):  # type: ignore[no-untyped-def]
    infinite = np.uint32(0x7F800000)
    loose = 0
    for word in bits:
        loose += (word & infinite) != infinite and (word & rest) != 0
    return loose == 0
