"""Stray light: the share of a picture that lens, camera body and room spread widely over all of it.

A camera records y = (1 − s) x + s·B x of the light x: a share s is blurred widely, the rest is not. B is a Gaussian of one width; where
none is known, it is the mean of the view. Real stray light has tails of other forms: the model is as good as its width is near to theirs.
"""

from __future__ import annotations

import numpy as np

ROUNDS = 3
"""Of the correction: each leaves a share s of what the round before left; 0.1³ of 10 %."""
CELLS = 4.0
"""Blocks in the standard deviation of the blur, which is made of their means: B x is right to 1 % of the white, and to 2 % with half as many."""


def spread_light(plane: np.ndarray, width_px: float | None = None) -> np.ndarray:
    """Return what stray light shows at every pixel, B x.

    Parameters
    ----------
    plane : ndarray, (h, w)
        NaN where nothing is known: left out, as what lies beyond the frame.
    width_px : float, optional
        Standard deviation of the blur, px; None: the mean of the view.

    Returns
    -------
    spread : ndarray, (h, w), float64

    Examples
    --------
    >>> half = np.repeat([[0.0, 1.0]], 50, 1).repeat(20, 0)
    >>> spread_light(half)[0, :2].tolist(), spread_light(half, 10.0)[10, [0, 49, 99]].round(2).tolist()
    ([0.5, 0.5], [0.0, 0.48, 1.0])
    """
    import cv2

    known = np.isfinite(plane)
    if not known.any():
        return np.full(plane.shape, np.nan)
    mean = float(plane.mean(where=known, dtype=float))
    if width_px is None:
        return np.full(plane.shape, mean)
    side = max(1, int(width_px / CELLS))
    height, width = plane.shape
    extra = (0, -height % side), (0, -width % side)
    parts = [np.where(known, plane, 0.0), known.astype(np.float64)]
    blurred = []
    for part in parts:
        wide = np.pad(part, extra)
        blocks = wide.reshape(wide.shape[0] // side, side, wide.shape[1] // side, side)
        small, sigma = blocks.mean(axis=(1, 3)), width_px / side
        reach = 2 * int(4 * sigma) + 1  # px: beyond four standard deviations is one part in 10,000
        small = cv2.GaussianBlur(
            small, (reach, reach), sigma, borderType=cv2.BORDER_CONSTANT | cv2.BORDER_ISOLATED
        )
        large = cv2.resize(small, wide.shape[::-1], interpolation=cv2.INTER_LINEAR)
        blurred.append(large[:height, :width])
    light, weight = blurred
    return np.divide(light, weight, out=np.full(plane.shape, mean), where=weight > 1e-6)


def correct_stray_light(
    values: np.ndarray,
    share: float,
    width_px: float | None = None,
    *,
    light: np.ndarray | float = 1.0,
) -> np.ndarray:
    """Return one band without its stray light.

    Parameters
    ----------
    values : ndarray, (h, w)
        Reflectance, or counts above dark.
    share : float, 0 to 0.5
        Share s of the light that is spread.
    width_px : float, optional
        As of `spread_light`.
    light : ndarray, (h, w) or one that broadcasts to it
        The white above dark that `values` were divided by: the white has stray light of its own, and where the light
        is dim it weighs more.

    Returns
    -------
    corrected : ndarray, (h, w), like `values`; NaN where they are.

    Notes
    -----
    x = (y − s·B x)/(1 − s), begun with x = y: van Cittert's rounds, as [bitlis2013]_ correct stray light by a parametric blur.

    Examples
    --------
    >>> x = np.tile([0.02, 0.9], (8, 20))
    >>> y = 0.9 * x + 0.1 * x.mean()
    >>> correct_stray_light(y, 0.1).round(3)[0, :2].tolist()
    [0.02, 0.9]
    """
    light = np.broadcast_to(np.asarray(light, float), values.shape)
    recorded = values * np.where(light > 0, light, np.nan)
    made, white = (_without(one, share, width_px) for one in (recorded, light))
    corrected = np.where(white > 0, made / np.where(white > 0, white, 1.0), np.nan)
    return np.where(np.isfinite(corrected), corrected, values).astype(values.dtype)


def _without(recorded: np.ndarray, share: float, width_px: float | None) -> np.ndarray:
    found = recorded
    for _ in range(ROUNDS):
        found = (recorded - share * spread_light(found, width_px)) / (1 - share)
    return found
