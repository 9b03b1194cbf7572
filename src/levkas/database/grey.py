"""Grey pictures of layers: the mean of all bands where every band has a value."""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

from math import ceil, sqrt
from pathlib import Path

import numpy as np

from levkas.core.compiled import njit
from levkas.core.cube import Flag
from levkas.database.tiff_pages import open_pages

MOST_SAMPLES = 60_000_000
"""Pixels of a grey picture: of a larger layer every so-many-th pixel a side makes it."""
ROWS = 256


def grey_of(
    values: np.ndarray, flags: np.ndarray, first: int = 0, step: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean of the bands, (h, w) float32, 0 where one is outside; and where none is.

    Of every `step`-th pixel a side of a layer, of which these are the rows from `first` on.
    """
    part = np.s_[-first % step :: step, ::step]
    values, flags = (np.ascontiguousarray(a[part]) for a in (values, flags))
    grey: tuple[np.ndarray, np.ndarray] = _mean_inside(values, flags, np.uint8(Flag.OUTSIDE))
    return grey


def grey_step(height: int, width: int) -> int:
    """Return of how many pixels of a layer a side one is in its grey picture."""
    return ceil(sqrt(height * width / MOST_SAMPLES))


def read_grey(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the grey picture of a published layer, as `grey_of` makes it of every `grey_step`-th pixel."""
    values, flags = open_pages(path), open_pages(path.with_name(path.stem + ".flags.tif"))
    height, width, _ = values.shape
    step = grey_step(height, width)
    tops = range(0, height, ROWS)
    parts = [
        grey_of(values.read(top, top + ROWS), flags.read(top, top + ROWS), top, step)
        for top in tops
    ]
    mean, inside = zip(*parts, strict=True)
    return np.concatenate(mean), np.concatenate(inside)


@njit(cache=True)
def _mean_inside(values, flags, outside):
    height, width, bands = values.shape
    mean = np.zeros((height, width), np.float32)
    inside = np.ones((height, width), np.bool_)
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
