"""Grey pictures of layers: the mean of all bands where every band has a value."""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

from pathlib import Path

import numpy as np

from levkas.core.compiled import njit
from levkas.core.cube import Flag
from levkas.database.spectral_tiff import read_tiff_pages


def grey_of(values: np.ndarray, flags: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean of the bands, (h, w) float64, 0 where one is outside; and where none is."""
    grey: tuple[np.ndarray, np.ndarray] = _mean_inside(values, flags, np.uint8(Flag.OUTSIDE))
    return grey


def read_grey(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return `grey_of` of a published layer."""
    flags = read_tiff_pages(path.with_name(path.stem + ".flags.tif"))
    return grey_of(read_tiff_pages(path), flags)


@njit(cache=True)
def _mean_inside(values, flags, outside):
    height, width, bands = values.shape
    mean, inside = np.zeros((height, width)), np.ones((height, width), np.bool_)
    for y in range(height):
        for x in range(width):
            total = 0.0
            for b in range(bands):
                total += values[y, x, b]
                if flags[y, x, b] & outside:
                    inside[y, x] = False
            if inside[y, x]:
                mean[y, x] = total / bands
    return mean, inside
