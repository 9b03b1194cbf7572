"""Where the object lies before its background.

The outline of a panel is a step in depth, casts a shadow and shows the panel's side: it is the
strongest edge in the picture, and the one that lies about where the paint is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

MARGIN_PX = 4
LEAST_RIM = 0.6
LEAST_OBJECT = 0.1
#: An outline is told by corners from which it strays by no more than this share of the longer side.
OUTLINE_SHARE = 0.01


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


def describe_mask(body: np.ndarray, region: Sequence[float] | None) -> dict[str, Any]:
    """Return what of the reference is compared, JSON-ready.

    Parameters
    ----------
    body : ndarray of bool, (h, w)
        Of `find_object`.
    region : (x, y, width, height), reference px, optional
        As it was asked for.

    Returns
    -------
    mask : dict
        ``automatic``: whether an object was told from its background; ``share`` of the frame that it takes;
        ``outline``: its corners, (n, 2) reference px, empty where nothing was told apart; ``region``.

    Examples
    --------
    >>> body = np.zeros((60, 80), bool)
    >>> body[10:50, 10:70] = True
    >>> describe_mask(body, None)["outline"]
    [[10, 10], [10, 49], [69, 49], [69, 10]]
    """
    import cv2

    found: dict[str, Any] = {"automatic": False, "share": 1.0, "outline": []}
    found["region"] = None if region is None else [float(v) for v in region]
    if body.all():
        return found
    outlines, _ = cv2.findContours(
        body.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE
    )
    if not outlines:
        return found | {"automatic": True, "share": 0.0}
    corners = cv2.approxPolyDP(
        max(outlines, key=cv2.contourArea), OUTLINE_SHARE * max(body.shape), True
    )
    return found | {
        "automatic": True,
        "share": round(float(body.mean()), 4),
        "outline": corners.reshape(-1, 2).tolist(),
    }
