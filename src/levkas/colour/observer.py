"""The CIE 1931 2° standard observer and illuminant D65, and the other tables of `colour/data`.

`data/SOURCES.md` names the source of each; colour-science, 100 MB that take seconds to import, is what the tests
compare them with.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

DATA = Path(__file__).parent / "data"


@cache
def read_table(name: str) -> np.ndarray:
    """Return the numbers of a table, (rows, columns), without its head."""
    rows = np.loadtxt(DATA / name, delimiter=",", skiprows=1, encoding="utf-8")
    rows.flags.writeable = False
    return rows


def read_names(name: str) -> list[str]:
    """Return the names of the columns of a table."""
    with (DATA / name).open(encoding="utf-8") as file:
        return file.readline().strip().split(",")


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
