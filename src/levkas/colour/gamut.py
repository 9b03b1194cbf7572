"""The CIELAB gamut of spectral cubes: which cells of 1 ΔE their pixels fill, as in Figure 12.

CIELAB after ISO/CIE 11664-4, under D65 and for the 2° observer.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from levkas.colour.observer import read_table
from levkas.colour.relighting import adaptation
from levkas.colour.srgb import SRGB_TO_XYZ, encode_srgb, xyz_weights

if TYPE_CHECKING:
    from collections.abc import Sequence

    from levkas.colour.illuminants import Light

__all__ = [
    *("VIEWS", "delta_e_2000", "gamut_cells", "lab_colours", "lab_of", "munsell_lab"),
    *("spectral_angle", "xyz_to_lab"),
]

WHITE = SRGB_TO_XYZ.sum(1)
EPSILON, KAPPA = 216 / 24389, 24389 / 27
C_XY = (0.31006, 0.31616)
"""Chromaticity of illuminant C, under which Munsell's colours are specified."""
VIEWS = {"a": ("a*", "b*", 1, 2), "b": ("a*", "L*", 1, 0), "c": ("b*", "L*", 2, 0)}
"""The three views of Figure 12: names of the axes, and their columns of (L, a, b)."""


def xyz_to_lab(xyz: np.ndarray, white: np.ndarray = WHITE) -> np.ndarray:
    """Return CIELAB of XYZ, (…, 3).

    Examples
    --------
    >>> xyz_to_lab(0.184187 * WHITE).round(3).tolist()
    [50.0, 0.0, 0.0]
    """
    ratio = np.asarray(xyz, float) / white
    f = np.where(ratio > EPSILON, np.cbrt(ratio), (KAPPA * ratio + 16) / 116)
    x, y, z = np.moveaxis(f, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], -1)


def lab_of(
    values: np.ndarray, wavelengths: Sequence[float] | np.ndarray, light: Light = "D65"
) -> np.ndarray:
    """Return CIELAB of reflectance under a light, its white that of the light, (…, bands) → (…, 3); NaN stays NaN.

    >>> lab_of(np.ones(3), [450, 550, 650], "A").round(6).tolist()
    [100.0, 0.0, 0.0]
    """
    weights = xyz_weights(wavelengths, light)
    # einsum, unlike a matrix product, sums in one order for any number of threads.
    xyz = np.stack([np.einsum("...b,b->...", np.asarray(values, float), w) for w in weights.T], -1)
    return xyz_to_lab(xyz, WHITE if light == "D65" else weights.sum(0))


def gamut_cells(lab: np.ndarray, *, step: float = 1.0) -> np.ndarray:
    """Return the cells that some colours fill.

    Parameters
    ----------
    lab : ndarray, (…, 3)
        NaN is left out.
    step : float
        Side of a cell, ΔE.

    Examples
    --------
    >>> gamut_cells(np.array([[50.2, 0.1, 0.4], [49.9, -0.2, 0.0], [70, 5, 5]])).tolist()
    [[50.0, 0.0, 0.0, 2.0], [70.0, 5.0, 5.0, 1.0]]
    """
    flat = np.asarray(lab, float).reshape(-1, 3)
    flat = flat[np.isfinite(flat).all(1)]
    cells, counts = np.unique(np.rint(flat / step), axis=0, return_counts=True)
    return np.column_stack([cells * step + 0.0, counts])


def lab_colours(lab: np.ndarray) -> np.ndarray:
    """Return the sRGB colours of CIELAB under D65, (n, 3) → (n, 3) uint8; what is out of range is clipped."""
    lightness, a, b = np.moveaxis(np.asarray(lab, float), -1, 0)
    y = (lightness + 16) / 116
    f = np.stack([y + a / 500, y, y - b / 200], -1)
    ratio = np.where(f**3 > EPSILON, f**3, (116 * f - 16) / KAPPA)
    return encode_srgb(ratio * WHITE @ np.linalg.inv(SRGB_TO_XYZ).T)


def munsell_lab() -> np.ndarray:
    """Return CIELAB under D65 of the real colours of the Munsell renotation, (2734, 3)."""
    table = read_table("munsell_real.csv")
    x, y, luminance = table[:, 0], table[:, 1], table[:, 2] / 100
    xyz = np.stack([x / y, np.ones(len(y)), (1 - x - y) / y], 1) * luminance[:, None]
    white = np.array([C_XY[0] / C_XY[1], 1.0, (1 - sum(C_XY)) / C_XY[1]])
    return xyz_to_lab(xyz @ adaptation(white, WHITE).T)


def delta_e_2000(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return ΔE2000 of CIELAB colours, as CIE 142-2001 has it (Sharma, Wu and Dalal 2005, 10.1002/col.20070).

    >>> [round(float(d), 4) for d in delta_e_2000(np.array([[50, 2.6772, -79.7751]]), np.array([[50, 0, -82.7485]]))]
    [2.0425]
    """
    from skimage.color import deltaE_ciede2000

    return np.asarray(deltaE_ciede2000(a, b), float)


def spectral_angle(estimated: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return the angle between spectra, (…,), radians.

    Kruse et al. 1993 (10.1016/0034-4257(93)90013-N).

    >>> round(float(np.degrees(spectral_angle(np.array([1.0, 0.0]), np.array([1.0, 1.0])))), 6)
    45.0
    """
    lengths = np.linalg.norm(estimated, axis=-1) * np.linalg.norm(measured, axis=-1)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.arccos(np.clip((estimated * measured).sum(-1) / lengths, -1, 1)))
