"""Spectral cubes shown under any light, as to an eye that is used to it, or beside a D65 display.

XYZ from reflectance and the light's spectrum (`levkas.colour.srgb.xyz_weights`), then sRGB. Adapted, white looks
white; not adapted, it has the light's own colour.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from levkas.colour.srgb import SRGB_TO_XYZ, Rendering, xyz_weights

if TYPE_CHECKING:
    from collections.abc import Sequence

    from levkas.colour.illuminants import Light

BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)


def relighting_matrix(
    wavelengths: Sequence[float] | np.ndarray, light: Light, *, adapted: bool = True
) -> np.ndarray:
    """Return the matrix from narrow bands to linear sRGB under a light.

    Returns
    -------
    matrix : ndarray, (bands, 3), float32
        ``linear = reflectance @ matrix``; adapted, reflectance 1 in all bands gives 1, 1, 1.
    """
    weights = xyz_weights(wavelengths, light)
    if adapted:
        weights = weights @ adaptation(weights.sum(0), SRGB_TO_XYZ.sum(1)).T
    return np.asarray(weights @ np.linalg.inv(SRGB_TO_XYZ).T, np.float32)


def relight(
    values: np.ndarray,
    wavelengths: Sequence[float] | np.ndarray,
    light: Light,
    *,
    adapted: bool = True,
) -> np.ndarray:
    """Show reflectance as it looks under a light.

    Examples
    --------
    >>> relight(np.ones((1, 3)), [450, 550, 650], "A").tolist()
    [[255, 255, 255]]
    >>> bool(relight(np.full((1, 3), 0.5), [450, 550, 650], "A", adapted=False)[0, 2] < 120)
    True
    """
    return Rendering(relighting_matrix(wavelengths, light, adapted=adapted), "", True)(values)


def adaptation(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return Bradford's matrix from XYZ under one white to XYZ under another, (3, 3).

    >>> white = np.array([1.09850, 1.0, 0.35585])
    >>> (adaptation(white, np.ones(3)) @ white).round(6).tolist()
    [1.0, 1.0, 1.0]
    """
    gains = (BRADFORD @ target) / (BRADFORD @ source)
    matrix: np.ndarray = np.linalg.inv(BRADFORD) @ (gains[:, None] * BRADFORD)
    return matrix
