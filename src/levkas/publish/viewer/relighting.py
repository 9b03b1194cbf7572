"""Spectra to sRGB under another illuminant, with chromatic adaptation.

With S the light's spectrum, XYZ = Σ S x̄ R / Σ S ȳ; its white is then brought to that of D65 by the
Bradford transform, so that a perfect diffuser stays white and only what the light does to the
paints is seen.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from levkas.colour.observer import read_table, tables_by_nm
from levkas.colour.relighting import adaptation
from levkas.colour.srgb import SRGB_TO_XYZ

if TYPE_CHECKING:
    from collections.abc import Sequence

ILLUMINANTS = {
    "D50": "D50, daylight in the morning",
    "A": "A, incandescent lamp",
    "LED-B3": "LED-B3, white LED of 4100 K",
    "FL2": "FL2, fluorescent tube",
}
"""CIE illuminants beside D65, columns of `cie_illuminants.csv`, and what they are."""


def relighting_matrix(wavelengths: Sequence[float] | np.ndarray, illuminant: str) -> np.ndarray:
    """Return the matrix from narrow bands to linear sRGB under an illuminant.

    Parameters
    ----------
    wavelengths : (bands,), nm
    illuminant : str
        A name of `ILLUMINANTS`.

    Returns
    -------
    matrix : ndarray, (bands, 3), float32
        ``linear = reflectance @ matrix``; reflectance 1 in all bands gives 1, 1, 1.
    """
    centres = np.asarray(wavelengths, float)
    order = np.argsort(centres, kind="stable")
    grid = tables_by_nm()[:, 0]
    hats = np.stack([np.interp(grid, centres[order], row) for row in np.eye(len(centres))])
    weights = np.empty((len(centres), 3))
    weights[order] = hats @ observer_under(illuminant)
    adapted = weights @ adaptation(weights.sum(0), SRGB_TO_XYZ.sum(1)).T
    return (adapted @ np.linalg.inv(SRGB_TO_XYZ).T).astype(np.float32)


@cache
def observer_under(illuminant: str) -> np.ndarray:
    """Return the CIE 1931 2° observer times a light, (401, 3), 380 to 780 nm; Y sums to 1."""
    rows, table = tables_by_nm(), read_table("cie_illuminants.csv")
    column = 1 + list(ILLUMINANTS).index(illuminant)
    power = np.interp(rows[:, 0], table[:, 0], table[:, column])
    weights = rows[:, 1:4] * power[:, None]
    return weights / weights[:, 1].sum()
