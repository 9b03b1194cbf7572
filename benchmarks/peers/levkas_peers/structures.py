"""Corners and faces: the points that dual-bootstrap ICP aligns [yang2007]_.

A face is a place on an edge, with its normal; it is matched across the edge only. A corner is matched
in both directions. Both are found by the structure tensor, at several scales, and thinned so that no
part of a picture has all of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SCALES = (1.0, 2.0)
"""Sigma of the derivatives, px."""
MOST_FACES, MOST_CORNERS = 3000, 800
"""A scale."""
CELLS = 24
LEAST_SHARE = 0.02
"""Of the strongest edges of a picture, below which a gradient is no edge."""


@dataclass(frozen=True)
class Structures:
    """Faces and corners of one picture.

    Parameters
    ----------
    faces, corners : ndarray, (n, 2), px
    normals : ndarray, (n, 2)
        Unit vectors across the edge of each face, of either sign.
    """

    faces: np.ndarray
    normals: np.ndarray
    corners: np.ndarray


def find_structures(values: np.ndarray, valid: np.ndarray) -> Structures:
    """Find faces and corners.

    Parameters
    ----------
    values, valid : ndarray, (h, w), float and bool
    """
    from scipy.ndimage import distance_transform_edt, gaussian_filter

    level = float(values[valid].mean()) if valid.any() else 0.0
    filled = np.where(valid, values, level).astype(np.float64)
    room = distance_transform_edt(np.pad(valid, 1))[1:-1, 1:-1]
    faces, normals, corners = [], [], []
    for sigma in SCALES:
        gx, gy = (gaussian_filter(filled, sigma, order=o) for o in ((0, 1), (1, 0)))
        usable = room > 3 * sigma
        places, across = _faces(gx, gy, usable)
        faces.append(places)
        normals.append(across)
        corners.append(_corners(gx, gy, sigma, usable))
    return Structures(np.concatenate(faces), np.concatenate(normals), np.concatenate(corners))


def _faces(gx: np.ndarray, gy: np.ndarray, usable: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Maxima of the gradient along itself, to a part of a pixel."""
    from scipy.ndimage import map_coordinates

    size = np.hypot(gx, gy)
    strong = (
        usable & (size > LEAST_SHARE * np.percentile(size[usable], 99)) if usable.any() else usable
    )
    y, x = np.nonzero(strong)
    normal = np.stack([gx[y, x], gy[y, x]], 1) / size[y, x][:, None]
    here = np.stack([x, y], 1).astype(float)
    before, after = (
        map_coordinates(size, (here + s * normal)[:, ::-1].T, order=1, mode="nearest")
        for s in (-1, 1)
    )
    middle = size[y, x]
    peak = (middle >= before) & (middle > after)
    bend = before - 2 * middle + after
    shift = np.where(bend < 0, 0.5 * (before - after) / np.where(bend < 0, bend, -1), 0.0)
    keep = np.flatnonzero(peak)
    keep = keep[_spread(here[keep], middle[keep], size.shape, MOST_FACES)]
    return here[keep] + np.clip(shift[keep], -1, 1)[:, None] * normal[keep], normal[keep]


def _corners(gx: np.ndarray, gy: np.ndarray, sigma: float, usable: np.ndarray) -> np.ndarray:
    """Maxima of the smaller eigenvalue of the structure tensor, to a part of a pixel."""
    from scipy.ndimage import gaussian_filter, maximum_filter

    a, b, c = (gaussian_filter(v, 2 * sigma) for v in (gx * gx, gx * gy, gy * gy))
    least = (a + c) / 2 - np.hypot((a - c) / 2, b)
    peak = (least == maximum_filter(least, size=2 * int(2 * sigma) + 1)) & usable
    peak[[0, -1]] = peak[:, [0, -1]] = False
    y, x = np.nonzero(peak & (least > 0))
    chosen = _spread(np.stack([x, y], 1), least[y, x], least.shape, MOST_CORNERS)
    y, x = y[chosen], x[chosen]
    parts = []
    for low, high in ((least[y, x - 1], least[y, x + 1]), (least[y - 1, x], least[y + 1, x])):
        bend = low - 2 * least[y, x] + high
        parts.append(np.where(bend < 0, 0.5 * (low - high) / np.where(bend < 0, bend, -1), 0.0))
    return np.stack([x, y], 1) + np.clip(np.stack(parts, 1), -1, 1)


def _spread(
    points: np.ndarray, strength: np.ndarray, shape: tuple[int, ...], most: int
) -> np.ndarray:
    """Indices of the strongest of every cell, `most` in all."""
    if len(points) <= most:
        return np.arange(len(points))
    h, w = shape[:2]
    cell = (points[:, 1] * CELLS // h).astype(int) * CELLS + (points[:, 0] * CELLS // w).astype(int)
    order = np.lexsort((-strength, cell))
    place = np.empty(len(points), int)
    starts = np.searchsorted(cell[order], np.arange(CELLS * CELLS))
    place[order] = np.arange(len(points)) - starts[cell[order]]
    return np.sort(np.lexsort((-strength, place))[:most])
