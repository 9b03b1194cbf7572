"""Matrices turned over in memory, block by block, which NumPy does number by number; pictures thinned to blocks."""

from __future__ import annotations

import numpy as np

_SAME_SIZE = {1: np.uint8, 2: np.uint16, 4: np.int32, 8: np.float64}


def transpose(matrix: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
    """Return the transpose of a matrix of any type, bit for bit, byte order kept.

    `out` is written to, and returned; it may be a part of a larger array whose rows lie apart.

    >>> transpose(np.array([[1, 2, 3]], ">u2")).tolist()
    [[1], [2], [3]]
    """
    import cv2

    if out is None:
        out = np.empty(matrix.shape[::-1], matrix.dtype)
    if out.shape != matrix.shape[::-1] or out.dtype != matrix.dtype:
        raise ValueError(f"no transpose of {matrix.shape} {matrix.dtype}: {out.shape} {out.dtype}")
    kind = _SAME_SIZE.get(matrix.dtype.itemsize)
    if kind is None or not matrix.size or not (_has_rows(matrix) and _has_rows(out)):
        out[...] = matrix.T
    else:
        cv2.transpose(matrix.view(kind), dst=out.view(kind))
    return out


def _has_rows(matrix: np.ndarray) -> bool:
    """Return whether the numbers of a row lie side by side, and rows one after another."""
    apart, step = matrix.strides
    return bool(step == matrix.itemsize and apart >= matrix.shape[1] * step)


def block_means(plane: np.ndarray, tall: int, wide: int | None = None) -> np.ndarray:
    """Return the means of blocks of `tall` rows and as many columns, or `wide`; the rest at the edges is left out.

    >>> block_means(np.arange(12.0).reshape(3, 4), 2).tolist()
    [[2.5, 4.5]]
    """
    wide = tall if wide is None else wide
    rows, columns = plane.shape[0] // tall, plane.shape[1] // wide
    blocks = plane[: rows * tall, : columns * wide].reshape(rows, tall, columns, wide)
    return np.asarray(blocks.mean(axis=(1, 3)))
