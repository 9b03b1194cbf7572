"""Bands made ready for dense registration: even noise, small holes filled, large ones left open."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np

from levkas.machine import count_threads
from levkas.registration.prediction import rooted

if TYPE_CHECKING:
    from levkas.registration.images import BandImage

LARGE_HOLE = 7
MOST_THREADS = 4


def images_of(bands: Sequence[BandImage]) -> dict[str, np.ndarray]:
    """Return label → square root of the image, NaN where invalid."""
    with ThreadPoolExecutor(count_threads(MOST_THREADS)) as pool:
        return dict(zip([band.label for band in bands], pool.map(_picture, bands), strict=True))


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
    framed = np.pad(hole.astype(np.uint8), side, constant_values=1)
    opened = np.asarray(cv2.morphologyEx(framed, cv2.MORPH_OPEN, kernel))
    large = opened[side:-side, side:-side] > 0
    small = hole & ~large
    if not small.any():
        return image
    known = np.where(hole, 0, image).astype(np.float32)
    weight = cv2.GaussianBlur((~hole).astype(np.float32), (0, 0), LARGE_HOLE / 2)
    filling = cv2.GaussianBlur(known, (0, 0), LARGE_HOLE / 2) / np.maximum(weight, 1e-6)
    return np.where(small & (weight > 1e-3), filling, image).astype(np.float32)
