"""Spectral cubes shown under any light: XYZ from reflectance and the light's spectrum, then sRGB.

With S the light, X = Σ S x̄ R / Σ S ȳ over 1 nm (CIE 15), bands interpolated linearly as
`levkas.colour.srgb` does under D65. Adapted, white looks white, as to an eye that is used to the light;
not adapted, it has the light's own colour beside a D65 display.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np

from levkas.colour.illuminants import SECOND_RADIATION, planck
from levkas.colour.observer import tables_by_nm
from levkas.colour.srgb import SRGB_TO_XYZ, Rendering

if TYPE_CHECKING:
    from collections.abc import Sequence

    Light = str | tuple[np.ndarray, np.ndarray]

BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)
LIGHT_A = 2848 * SECOND_RADIATION / 1.435e7
"""Temperature of illuminant A, K: by definition 2848 K with c2 of 1931 (CIE 15)."""


def light_on_grid(light: Light) -> np.ndarray:
    """Return a light's relative power from 380 to 780 nm by 1.

    Parameters
    ----------
    light : str or (wavelengths (n,), power (n,))
        ``"D65"``, ``"A"``, ``"E"``, a black body such as ``"4000 K"``, or a measured spectrum, nm; beyond
        its ends it keeps its first and last value.

    Returns
    -------
    power : ndarray, (401,)

    Raises
    ------
    ValueError
        Where the name is not known, or the spectrum has no power.

    Examples
    --------
    >>> power = light_on_grid("A")
    >>> round(float(power[180] / power[20]), 3)  # 560 nm over 400 nm: 100 over 14.708
    6.799
    """
    rows = tables_by_nm()
    grid = rows[:, 0]
    if not isinstance(light, str):
        wavelengths, levels = (np.asarray(part, float) for part in light)
        power = np.interp(grid, wavelengths, levels)
    elif light.upper() == "D65":
        power = rows[:, 4]
    elif light.upper() == "E":
        power = np.ones(len(grid))
    elif light.upper() == "A":
        power = _black_body(grid, LIGHT_A)
    elif kelvin := re.fullmatch(r"(\d+(?:\.\d+)?)\s*K", light.strip()):
        power = _black_body(grid, float(kelvin.group(1)))
    else:
        raise ValueError(f"no light {light!r}; there are D65, A, E, and black bodies: 4000 K")
    if not np.isfinite(power).all() or power.min() < 0 or power.sum() <= 0:
        raise ValueError("a light needs power >= 0 at all wavelengths, and more than 0 at some")
    return power


def white_of(light: Light) -> np.ndarray:
    """Return XYZ of a perfect diffuser under a light, Y = 1.

    >>> white_of("E").round(3).tolist()
    [1.0, 1.0, 1.0]
    """
    table = _table(light)
    return np.asarray(table.sum(0))


def xyz_weights_under(wavelengths: Sequence[float] | np.ndarray, light: Light) -> np.ndarray:
    """Weigh narrow bands to XYZ under a light.

    Parameters
    ----------
    wavelengths : (bands,), nm
        In any order.
    light : as in `light_on_grid`

    Returns
    -------
    weights : ndarray, (bands, 3)
        ``XYZ = reflectance @ weights``; a perfect diffuser has Y = 1.
    """
    centres = np.asarray(wavelengths, float)
    order = np.argsort(centres, kind="stable")
    grid, table = tables_by_nm()[:, 0], _table(light)
    weights = np.empty((len(centres), 3))
    for place, band in enumerate(order):
        weights[band] = np.interp(grid, centres[order], np.eye(len(centres))[place]) @ table
    return weights


def relight(
    values: np.ndarray,
    wavelengths: Sequence[float] | np.ndarray,
    light: Light,
    *,
    adapted: bool = True,
) -> np.ndarray:
    """Show reflectance as it looks under a light.

    Parameters
    ----------
    values : ndarray, (…, bands)
        Reflectance; NaN is black.
    wavelengths : (bands,), nm
    light : as in `light_on_grid`
    adapted : bool
        Whether the eye is used to the light (Bradford), or sees it beside D65.

    Returns
    -------
    rgb : ndarray, (…, 3), uint8
        sRGB.

    Examples
    --------
    >>> relight(np.ones((1, 3)), [450, 550, 650], "A").tolist()
    [[255, 255, 255]]
    >>> bool(relight(np.full((1, 3), 0.5), [450, 550, 650], "A", adapted=False)[0, 2] < 120)
    True
    """
    weights = xyz_weights_under(wavelengths, light)
    if adapted:
        weights = weights @ adaptation(white_of(light), SRGB_TO_XYZ.sum(1)).T
    matrix = (weights @ np.linalg.inv(SRGB_TO_XYZ).T).astype(np.float32)
    return Rendering(matrix, "", True)(values)


def adaptation(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return Bradford's matrix from XYZ under one white to XYZ under another, (3, 3).

    >>> white = np.array([1.09850, 1.0, 0.35585])
    >>> (adaptation(white, np.ones(3)) @ white).round(6).tolist()
    [1.0, 1.0, 1.0]
    """
    gains = (BRADFORD @ target) / (BRADFORD @ source)
    matrix: np.ndarray = np.linalg.inv(BRADFORD) @ (gains[:, None] * BRADFORD)
    return matrix


def _table(light: Light) -> np.ndarray:
    """Observer times light, (401, 3), the sum over Y one."""
    rows = tables_by_nm()
    weights = rows[:, 1:4] * light_on_grid(light)[:, None]
    return np.asarray(weights / weights[:, 1].sum())


def _black_body(wavelengths: np.ndarray, kelvin: float) -> np.ndarray:
    if not 500 <= kelvin <= 100_000:
        raise ValueError(f"a black body of {kelvin:g} K is outside the range of 500 to 100000 K")
    return np.asarray(planck(wavelengths, kelvin))
