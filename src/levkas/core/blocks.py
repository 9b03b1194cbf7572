"""Thinning of frames to blocks."""

from __future__ import annotations

import numpy as np


def block_means(plane: np.ndarray, tall: int, wide: int | None = None) -> np.ndarray:
    """Return the means of blocks of `tall` rows and as many columns, or `wide`; the rest at the edges is left out.

    >>> block_means(np.arange(12.0).reshape(3, 4), 2).tolist()
    [[2.5, 4.5]]
    """
    wide = tall if wide is None else wide
    rows, columns = plane.shape[0] // tall, plane.shape[1] // wide
    blocks = plane[: rows * tall, : columns * wide].reshape(rows, tall, columns, wide)
    return np.asarray(blocks.mean(axis=(1, 3)))
