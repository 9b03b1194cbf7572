"""Grey pictures of layers: the mean of all bands where every band has a value."""

from __future__ import annotations

from math import ceil, sqrt
from pathlib import Path

import numpy as np

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
    values, flags = (a[-first % step :: step, ::step] for a in (values, flags))
    height, width, bands = values.shape
    total, inside = np.zeros((height, width)), np.ones((height, width), bool)
    for band in range(bands):  # in this order, whatever the number of rows
        total += values[..., band]
        inside &= (flags[..., band] & np.uint8(Flag.OUTSIDE)) == 0
    return np.where(inside, total / bands, 0.0).astype(np.float32), inside


def grey_step(height: int, width: int) -> int:
    """Return of how many pixels of a layer a side one is in its grey picture."""
    return ceil(sqrt(height * width / MOST_SAMPLES))


def read_grey(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the grey picture of a published layer, as `grey_of` makes it of every `grey_step`-th pixel."""
    values, flags = open_pages(path), open_pages(path.with_name(path.stem + ".flags.tif"))
    height, width, _ = values.shape
    step = grey_step(height, width)
    tops = range(0, height, ROWS)
    blocks = ([one.read(top, top + ROWS) for one in (values, flags)] for top in tops)
    parts = [grey_of(v, f, top, step) for top, (v, f) in zip(tops, blocks, strict=True)]
    mean, inside = zip(*parts, strict=True)
    return np.concatenate(mean), np.concatenate(inside)
