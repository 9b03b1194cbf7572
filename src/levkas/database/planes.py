"""Bands of a cube as planes of their own: pages of a file hold a band, memory a pixel's spectrum."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from levkas.squares import SIDE, turn_square

if TYPE_CHECKING:
    from collections.abc import Iterator

HELPERS = "d3c870635e14436f"
"""Digest of what is inlined from other files: numba keeps machine code as long as this file is the same."""

GROUP = 16
"""Bands that are gathered in one passage over the memory: a line of the cache of float32."""
TILE = 64
"""Pixels whose bands are turned at once: what they take stays in the fastest cache."""


def planes_of(values: np.ndarray, *, group: int = GROUP) -> Iterator[np.ndarray]:
    """Yield the bands of a (height, width, bands) array as planes of their own."""
    for start in range(0, values.shape[2], group):
        yield from turned(values, start, min(start + group, values.shape[2]))


def turned(values: np.ndarray, start: int, stop: int) -> np.ndarray:
    """Return bands `start` to `stop` of (height, width, bands) as (bands, height, width).

    Examples
    --------
    >>> turned(np.arange(6).reshape(1, 3, 2), 0, 2).tolist()
    [[[0, 2, 4]], [[1, 3, 5]]]
    """
    height, width = values.shape[:2]
    out = np.empty((stop - start, height, width), values.dtype)
    plain = values.dtype.isnative and values.dtype.kind in "uif" and values.dtype.itemsize <= 8
    if plain and len(out) == SIDE <= width and values.flags.c_contiguous:
        _turn_squares(values.reshape(-1), start, values.shape, out.reshape(-1))
    elif plain:
        _turn(values, start, out)
    else:
        out[...] = np.moveaxis(values[:, :, start:stop], 2, 0)
    return out


@njit(nogil=True, cache=True)
def _turn(values, start, out):  # type: ignore[no-untyped-def]
    bands, height, width = out.shape
    for y in range(height):
        for x0 in range(0, width, TILE):
            last = min(x0 + TILE, width)
            for b in range(bands):
                for x in range(x0, last):
                    out[b, y, x] = values[y, x, start + b]


@njit(nogil=True, cache=True)
def _turn_squares(values, start, shape, out):  # type: ignore[no-untyped-def]
    height, width, bands = shape
    for y in range(height):
        for x0 in range(0, width, SIDE):
            x = min(x0, width - SIDE)  # the last ones twice
            turn_square(
                values, (y * width + x) * bands + start, bands, out, y * width + x, height * width
            )
