"""Matrices turned over in memory, block by block, which NumPy does number by number."""

from __future__ import annotations

import numpy as np

_SAME_SIZE = {1: np.uint8, 2: np.uint16, 4: np.int32, 8: np.float64}


def transpose(matrix: np.ndarray) -> np.ndarray:
    """Return the transpose of a matrix, C order, bit for bit, byte order kept.

    Parameters
    ----------
    matrix : ndarray, (a, b), of any type

    Returns
    -------
    ndarray, (b, a)

    Examples
    --------
    >>> transpose(np.array([[1, 2, 3]], ">u2")).tolist()
    [[1], [2], [3]]
    """
    import cv2

    kind = _SAME_SIZE.get(matrix.dtype.itemsize)
    if kind is None or not matrix.size:
        return np.ascontiguousarray(matrix.T)
    turned = cv2.transpose(np.ascontiguousarray(matrix).view(kind))
    return turned.reshape(matrix.shape[::-1]).view(matrix.dtype)
