"""Where other programs put the origin of a picture, and how to get from there to pixel centres.

A point in the middle of the top left pixel is (0, 0) here. The same point is

======== ============= =====================================================
origin   coordinates   who
======== ============= =====================================================
centre   (0, 0)        BigWarp, Hugin, ITK and elastix, napari
corner   (0.5, 0.5)    Butterfly Registrator (a Qt scene)
y up     (0.5, -0.5)   QGIS: corner, x right, y up, so that rows are negative
one      (1, 1)        MATLAB: centres, counted from one
======== ============= =====================================================

Taking one for the other moves a picture by half a pixel, or by one; between two cameras of a
different sampling the half pixels do not even cancel: 0.5 px of a 3900 px wide picture and 0.5 px of
a 1392 px wide one differ by 0.5·(1 − 1392/3900) = 0.32 px of the reference.
"""

from __future__ import annotations

import numpy as np

#: origin: (scale of x and y, coordinates of the centre of the top left pixel)
ORIGINS: dict[str, tuple[tuple[float, float], tuple[float, float]]] = {
    "centre": ((1.0, 1.0), (0.0, 0.0)),
    "corner": ((1.0, 1.0), (0.5, 0.5)),
    "corner, y up": ((1.0, -1.0), (0.5, -0.5)),
    "one": ((1.0, 1.0), (1.0, 1.0)),
}


def from_origin(points: np.ndarray, origin: str) -> np.ndarray:
    """Bring points of another program to centres at integers, y down.

    Examples
    --------
    >>> from_origin(np.array([[1.5, -0.75], [10.5, -3.0]]), "corner, y up").tolist()
    [[1.0, 0.25], [10.0, 2.5]]
    """
    scale, first = (np.array(v) for v in ORIGINS[origin])
    return (np.asarray(points, np.float64).reshape(-1, 2) - first) * scale


def to_origin(points: np.ndarray, origin: str) -> np.ndarray:
    """Bring points with centres at integers to the origin of another program.

    Examples
    --------
    >>> to_origin(np.array([[0.0, 0.0]]), "one").tolist()
    [[1.0, 1.0]]
    """
    scale, first = (np.array(v) for v in ORIGINS[origin])
    return np.asarray(points, np.float64).reshape(-1, 2) * scale + first
