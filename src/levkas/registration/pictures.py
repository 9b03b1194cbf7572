"""Bands made ready for dense registration: even noise, small holes filled, large ones left open."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from levkas.core.threads import each
from levkas.registration.predictors import rooted

if TYPE_CHECKING:
    from levkas.registration.images import BandImage

LARGE_HOLE = 7


def images_of(bands: Sequence[BandImage]) -> dict[str, np.ndarray]:
    """Return label → square root of the image, NaN where invalid."""
    return dict(zip([band.label for band in bands], each(_picture, bands), strict=True))


def _picture(band: BandImage) -> np.ndarray:
    return rooted(_mended(np.where(band.valid, band.values, np.float32(np.nan))))


def _mended(image: np.ndarray) -> np.ndarray:
    """Fill holes that are too small to hide a place: sparks of gold, single defects.

    A window counts only where all of it is valid, so that a few scattered pixels would blind
    whole regions. What contains a block of `LARGE_HOLE` px stays NaN.
    """
    import cv2

    hole = np.isnan(image)
    if not hole.any() or hole.all():
        return image
    side = LARGE_HOLE
    kernel = np.ones((side, side), np.uint8)
    framed = np.pad(hole.view(np.uint8), side, constant_values=1)
    opened = np.asarray(cv2.morphologyEx(framed, cv2.MORPH_OPEN, kernel))
    small = np.flatnonzero(hole & (opened[side:-side, side:-side] == 0))
    reach = 3 * LARGE_HOLE // 2
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / (LARGE_HOLE / 2)) ** 2)
    mended = image.copy()
    mended.reshape(-1)[small] = _means_around(image, small, taps)
    return mended


@njit(nogil=True, cache=True)
def _means_around(image, places, taps):  # type: ignore[no-untyped-def]
    """Weighted mean of what is valid about each place, counted row by row; NaN where nothing is."""
    height, width = image.shape
    reach = len(taps) // 2
    out = np.empty(len(places), np.float32)
    for n in range(len(places)):
        total, weight = 0.0, 0.0
        row, column = places[n] // width, places[n] % width
        for y in range(max(row - reach, 0), min(row + reach + 1, height)):
            for x in range(max(column - reach, 0), min(column + reach + 1, width)):
                if np.isfinite(image[y, x]):
                    tap = taps[y - row + reach] * taps[x - column + reach]
                    total += tap * image[y, x]
                    weight += tap
        out[n] = total / weight if weight > 0.0 else np.nan
    return out
