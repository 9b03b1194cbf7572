"""Where the painting stands in its frame, and the grid that follows from it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from levkas.campaign.campaign import GridKeys
    from levkas.geometry.grid import Grid
    from levkas.registration import BandImage

SMALLEST_SHARE = 0.05
"""Below this share of the frame a bright region is no painting."""


def bounding_box(grey: np.ndarray, valid: np.ndarray | None = None) -> tuple[int, int, int, int]:
    """Bounding box of the object on a plain background.

    A painting has contrast of its own, a background has not: the brightness and the local
    contrast are both thresholded by Otsu's method, small islands are dropped, and the box
    around the largest connected region is taken.

    Parameters
    ----------
    grey : ndarray, (h, w)
        Mean of bands, any unit.
    valid : ndarray of bool, (h, w), optional

    Returns
    -------
    region : (x, y, width, height)
        The whole frame where no object stands out from a background.

    Examples
    --------
    >>> image = np.zeros((60, 80)); image[10:50, 20:70] = 1.0
    >>> bounding_box(image)
    (20, 10, 50, 40)
    """
    import cv2

    height, width = grey.shape
    whole = (0, 0, width, height)
    image = np.nan_to_num(np.asarray(grey, np.float64))
    if valid is not None:
        image = np.where(valid, image, 0.0)
    low, high = np.percentile(image, (0.5, 99.5))
    if not high > low:
        return whole
    tone = np.sqrt(np.clip((image - low) / (high - low), 0, 1))
    bytes_ = np.round(255 * tone).astype(np.uint8)
    cut, _ = cv2.threshold(bytes_, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    border = np.concatenate([bytes_[0], bytes_[-1], bytes_[:, 0], bytes_[:, -1]])
    # A dark painting on a dark cloth: what is clearly above the border's own spread is object too.
    floor = np.median(border) + 4 * max(1.0, 1.4826 * np.median(np.abs(border - np.median(border))))
    mask = (bytes_ > min(cut, floor)).astype(np.uint8)
    kernel = np.ones((3, 3), np.uint8)
    mask = cv2.morphologyEx(
        cv2.morphologyEx(mask, cv2.MORPH_OPEN, kernel), cv2.MORPH_CLOSE, kernel, iterations=3
    )
    count, _, statistics, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    if count < 2:
        return whole
    best = 1 + int(
        np.argmax(statistics[1:, cv2.CC_STAT_WIDTH] * statistics[1:, cv2.CC_STAT_HEIGHT])
    )
    x, y, w, h = (int(v) for v in statistics[best, :4])
    return (x, y, w, h) if w * h >= SMALLEST_SHARE * width * height else whole


def frame_object(
    image: BandImage, keys: GridKeys | None, size_mm: tuple[float, float] | None
) -> tuple[Grid, float | None, tuple[float, float, float, float] | None]:
    """Return the grid, its sampling in px per mm where known, and the region to register by.

    Parameters
    ----------
    image : BandImage
        The reference band.
    keys : GridKeys, optional
        The table [grid]; None: the reference band's own frame, whole.
    size_mm : (width, height), optional
        Of the object, upright; with its bounding box it gives the sampling.

    Returns
    -------
    grid : Grid
    sampling : float or None
        Grid px per mm.
    region : (x, y, width, height), reference px, or None
        The declared region, turned back; None where none is declared.
    """
    from levkas.geometry.grid import Grid

    width, height = image.size
    mirror, rotate = (keys.mirror, keys.rotate) if keys else (False, 0.0)
    turned = Grid((width, height), mirror=mirror, rotate=rotate)
    region = keys.region if keys else None
    box = None
    if region == "auto" or size_mm is not None:
        box = _box_in(turned, image)
    chosen = box if region == "auto" else region
    grid = Grid(
        (width, height),
        mirror=mirror,
        rotate=rotate,
        region=chosen,
        output=keys.size if keys else None,
    )
    sampling = (
        _sampling(grid, turned, box, size_mm) if box is not None and size_mm is not None else None
    )
    return grid, sampling, _turned_back(turned, region) if isinstance(region, tuple) else None


def _box_in(turned: Grid, image: BandImage) -> tuple[float, float, float, float]:
    """The object's bounding box in the turned frame at native scale."""
    x, y, w, h = bounding_box(image.values, image.valid)
    corners = np.array([[x, y], [x + w - 1, y], [x + w - 1, y + h - 1], [x, y + h - 1]], float)
    placed = turned.transform.inverse(corners)
    low, high = np.floor(placed.min(0)), np.ceil(placed.max(0))
    return float(low[0]), float(low[1]), float(high[0] - low[0] + 1), float(high[1] - low[1] + 1)


def _turned_back(
    turned: Grid, region: tuple[float, float, float, float]
) -> tuple[float, float, float, float]:
    """The box in reference px around a region of the turned frame."""
    x, y, w, h = region
    corners = np.array([[x, y], [x + w - 1, y], [x + w - 1, y + h - 1], [x, y + h - 1]], float)
    placed = turned.transform(corners)
    low, high = placed.min(0), placed.max(0)
    return float(low[0]), float(low[1]), float(high[0] - low[0] + 1), float(high[1] - low[1] + 1)


def _sampling(
    grid: Grid, turned: Grid, box: tuple[float, float, float, float], size_mm: tuple[float, float]
) -> float:
    """Grid px per mm from the object's box and its size; the longer sides belong together."""
    sides, real = np.sort(np.array(box[2:])), np.sort(np.array(size_mm, float))
    native = float(np.exp(np.log(sides / real).mean()))
    step = grid.transform.jacobian(np.zeros((1, 2)))[0]
    return native / float(np.sqrt(abs(np.linalg.det(step))))
