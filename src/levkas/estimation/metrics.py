"""Errors of estimated spectra: RMSE, goodness of fit, spectral angle, MRAE, R², ΔE2000.

Spectra are (…, bands), reflectance; the first argument is estimated, the second measured.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from levkas.colour.gamut import delta_e_2000, spectral_angle, xyz_to_lab
from levkas.colour.srgb import observer_under, visible_coverage, xyz_weights

__all__ = ["delta_e", "gfc", "mrae", "r2", "rmse", "sees_colour", "spectral_angle"]

MRAE_FLOOR = 0.01
"""Reflectance below which errors are relative to it: those of black paint would rule otherwise."""
LEAST_COVERAGE = 0.9
"""Of the visible weight, for a colour difference to mean something."""


def rmse(estimated: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return the root mean square error over bands, (…,).

    Errors of 0.3 and 0.4 have a mean square of 0.125:

    >>> round(float(rmse(np.array([0.5, 0.5]), np.array([0.2, 0.9]))) ** 2, 12)
    0.125
    """
    return np.asarray(np.sqrt(np.square(estimated - measured).mean(-1)))


def gfc(estimated: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return the goodness-of-fit coefficient |⟨ŷ, y⟩| / (|ŷ| |y|), (…,); NaN for a spectrum of zeros.

    Romero, García-Beltrán and Hernández-Andrés 1997 (10.1364/JOSAA.14.001007); 0.999 is good, 0.9999
    excellent. (3, 4) and (4, 3) have 24 / 25:

    >>> float(gfc(np.array([3.0, 4.0]), np.array([4.0, 3.0])))
    0.96
    """
    product = np.abs((estimated * measured).sum(-1))
    with np.errstate(invalid="ignore"):
        return np.asarray(
            product / (np.linalg.norm(estimated, axis=-1) * np.linalg.norm(measured, axis=-1))
        )


def mrae(estimated: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return the mean relative absolute error, (…,), relative to no less than `MRAE_FLOOR`.

    Errors of 0.1 at 0.5 and of 0.001 at 0.005, taken for 0.01: a fifth and a tenth.

    >>> round(float(mrae(np.array([0.6, 0.006]), np.array([0.5, 0.005]))), 6)
    0.15
    """
    return np.asarray((np.abs(estimated - measured) / np.maximum(measured, MRAE_FLOOR)).mean(-1))


def r2(estimated: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return the coefficient of determination of each band, (n, bands) → (bands,); NaN for a constant band.

    Squares of errors sum to 0.02, those about the mean 0.5 to 0.5:

    >>> float(r2(np.array([[0.1], [0.9]]), np.array([[0.0], [1.0]])).round(6)[0])
    0.96
    """
    about_mean = np.square(measured - measured.mean(0)).sum(0)
    with np.errstate(invalid="ignore", divide="ignore"):
        left = np.square(estimated - measured).sum(0) / about_mean
    return np.asarray(np.where(about_mean > 0, 1 - left, np.nan))


def sees_colour(wavelengths: Sequence[float] | np.ndarray) -> bool:
    """Return whether bands at `wavelengths`, nm, cover enough of the visible for ΔE."""
    return visible_coverage(wavelengths) >= LEAST_COVERAGE


def delta_e(
    estimated: np.ndarray,
    measured: np.ndarray,
    wavelengths: Sequence[float] | np.ndarray,
    illuminant: str = "D65",
) -> np.ndarray:
    """Return ΔE2000 of the colours of spectra under a light, 2° observer, (…,).

    Parameters
    ----------
    wavelengths : (bands,), nm
    illuminant : str
        As in `levkas.colour.illuminants.light_on_grid`: D65, A.

    Examples
    --------
    Between neutral greys ΔE2000 is ΔL* / S_L; a reflectance of 0.184187 has L* = 50:

    >>> bands = np.arange(400, 701, 10)
    >>> grey, white = np.full(31, 0.184187), np.ones(31)
    >>> round(float(delta_e(grey, white, bands, "A")), 2)  # 50 / (1 + 0.015·25² / √(20 + 25²))
    36.52
    """
    weights, white = xyz_weights(wavelengths, illuminant), observer_under(illuminant)[1].sum(0)
    labs = [
        xyz_to_lab(np.maximum(np.asarray(values, float), 0) @ weights, white)
        for values in (estimated, measured)
    ]
    return delta_e_2000(*labs)
