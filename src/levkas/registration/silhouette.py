"""Where the object lies before its background.

The outline of a panel is a step in depth, casts a shadow and shows the panel's side: it is the
strongest edge in the picture, and the one that lies about where the paint is.
"""

from __future__ import annotations

import numpy as np

MARGIN_PX = 4
LEAST_RIM = 0.6
LEAST_OBJECT = 0.1


def find_object(image: np.ndarray, *, margin: int = MARGIN_PX) -> np.ndarray:
    """Return where the object is, (h, w) bool, `margin` px inside its outline.

    The background is what is as even as the frame's rim and connected to it. Where the rim is not
    even, or nothing is left, everything is object.

    Parameters
    ----------
    image : ndarray, (h, w)
        NaN where invalid.

    Examples
    --------
    >>> picture = np.zeros((60, 80))
    >>> picture[10:50, 10:70] = 1
    >>> found = find_object(picture)
    >>> bool(found[30, 40]), bool(found[10, 10]), bool(find_object(np.ones((60, 80))).all())
    (True, False, True)
    """
    from scipy import ndimage

    everything = np.ones(image.shape, bool)
    known = np.isfinite(image)
    if not known.any():
        return everything
    smooth = ndimage.gaussian_filter(np.where(known, image, np.median(image[known])), 1.5)
    rim = everything.copy()
    width = max(3, min(image.shape) // 100)
    rim[width:-width, width:-width] = False
    level = np.median(smooth[rim])
    spread = 1.4826 * np.median(np.abs(smooth[rim] - level))
    low, high = np.percentile(smooth, (1, 99))
    if not high > low:
        return everything
    even = np.abs(smooth - level) < max(5 * spread, 0.04 * (high - low))
    patches, _ = ndimage.label(even)
    touching = np.unique(patches[rim & even])
    ground = np.isin(patches, touching[touching > 0])
    if (ground & rim).sum() < LEAST_RIM * rim.sum():
        return everything
    bodies, count = ndimage.label(ndimage.binary_opening(~ground, iterations=2))
    if not count:
        return everything
    body = ndimage.binary_fill_holes(bodies == 1 + np.bincount(bodies.ravel())[1:].argmax())
    if body.mean() < LEAST_OBJECT:
        return everything
    return ndimage.binary_erosion(body, iterations=margin) if margin else body
