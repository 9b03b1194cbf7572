"""Errors of estimated spectra: RMSE and ΔE2000.

Spectra are (…, bands), reflectance; the first argument is estimated, the second measured.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from levkas.colour.gamut import delta_e_2000, xyz_to_lab
from levkas.colour.srgb import observer_under, visible_coverage, xyz_weights

LEAST_COVERAGE = 0.9
"""Of the visible weight, for a colour difference to mean something."""


def rmse(estimated: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return the root mean square error over bands, (…,).

    Errors of 0.3 and 0.4 have a mean square of 0.125:

    >>> round(float(rmse(np.array([0.5, 0.5]), np.array([0.2, 0.9]))) ** 2, 12)
    0.125
    """
    return np.asarray(np.sqrt(np.square(estimated - measured).mean(-1)))


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
