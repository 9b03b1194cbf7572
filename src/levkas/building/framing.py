"""The object's bounding box in a frame: where the painting ends and the background begins."""

from __future__ import annotations

import numpy as np

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
