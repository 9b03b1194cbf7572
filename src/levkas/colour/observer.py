"""The CIE 1931 2° standard observer and illuminant D65, and the other tables of `colour/data`.

They are files here because colour-science, which the tests compare them with, takes seconds to import:
`cie_1931_observer_d65.csv` (CIE 018:2019 at every fifth nanometre; ISO/CIE 11664-2),
`cie_daylight.csv` (components of daylight, CIE 015:2018) and `cie_illuminants.csv` (CIE 015:2018).
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

DATA = Path(__file__).parent / "data"


@cache
def read_table(name: str) -> np.ndarray:
    """Return the numbers of a table, (rows, columns); the first column is the wavelength, nm."""
    rows = np.loadtxt(DATA / name, delimiter=",", skiprows=1, encoding="utf-8")
    rows.flags.writeable = False
    return rows


def tables() -> np.ndarray:
    """Return the tables, (81, 5): wavelength in nm from 380 to 780 by 5, x̄, ȳ, z̄, D65."""
    return read_table("cie_1931_observer_d65.csv")


@cache
def tables_by_nm() -> np.ndarray:
    """Return the tables by 1 nm, (401, 5): functions by cubic spline, D65 linear as CIE 15 has it.

    Examples
    --------
    >>> tables_by_nm()[175].tolist()
    [555.0, 0.5120501, 1.0, 0.005749999, 102.023]
    """
    from scipy.interpolate import CubicSpline

    rows = tables()
    grid = np.arange(rows[0, 0], rows[-1, 0] + 1)
    functions = CubicSpline(rows[:, 0], rows[:, 1:4])(grid)
    light = np.interp(grid, rows[:, 0], rows[:, 4])
    fine = np.column_stack([grid, np.maximum(functions, 0), light])
    fine.flags.writeable = False
    return fine
