"""Spectra of lamps and filters, and what cameras and eyes integrate of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from levkas.colour.illuminants import illuminant, planck
from levkas.colour.observer import tables
from levkas.core.text import TextRefused, read_text
from levkas.planning.tables import PlanRefused, value_problem
from levkas.readers.spectra import are_spectra, parse_spectra

if TYPE_CHECKING:
    from pathlib import Path

    from levkas.planning.tables import SpectrumKeys

GRID = np.concatenate([np.arange(300.0, 1100.0, 2.0), np.arange(1100.0, 2501.0, 20.0)])
"""Wavelengths of every plan, nm: fine where cameras see, coarse where there is only heat."""
LUMENS_PER_WATT = 683.002


@dataclass(frozen=True, eq=False)
class Spectrum:
    """A table over wavelength, with where it is known.

    Parameters
    ----------
    values : ndarray, (n,)
        At `GRID`: relative power, or transmittance 0 to 1; 0 outside `known` for light, the last
        value held for a filter.
    known : (first, last)
        nm.
    """

    name: str
    values: np.ndarray
    known: tuple[float, float]


@cache
def steps() -> np.ndarray:
    """Return the width of each wavelength of `GRID`, nm: the trapezium rule as weights."""
    return np.gradient(GRID)


def integrate(values: np.ndarray) -> float:
    """Return the integral over wavelength of values at `GRID`.

    >>> round(integrate(np.where((GRID >= 400) & (GRID <= 700), 1.0, 0.0)))
    302
    """
    return float(np.asarray(values) @ steps())


@cache
def eye() -> np.ndarray:
    """Return V(λ) at `GRID`: the ȳ of the CIE 1931 observer."""
    rows = tables()
    # Linear between fifth nanometres: a spline would load scipy for a part in ten thousand.
    return np.interp(GRID, rows[:, 0], rows[:, 2], left=0, right=0)


def tristimulus(power: np.ndarray) -> np.ndarray:
    """Return X, Y, Z of a spectrum at `GRID`, (3,)."""
    rows = tables()
    observer = np.stack([np.interp(GRID, rows[:, 0], c, left=0, right=0) for c in rows[:, 1:4].T])
    return observer @ (power * steps())


def colour_temperature(power: np.ndarray) -> tuple[float, float]:
    """Return the correlated colour temperature in K and Duv of a spectrum at `GRID`.

    Notes
    -----
    The nearest point of the Planckian locus in CIE 1960 u, v, found by halving; Duv is positive
    above it (greenish). Colour-science's `uv_to_CCT_Ohno2013` differs by less than 1 K.

    Examples
    --------
    >>> temperature, duv = colour_temperature(planck(GRID, 3000.0))
    >>> round(temperature), abs(round(duv, 4))
    (3000, 0.0)
    """
    u, v = _uv(tristimulus(power))
    low, high = 1000.0, 20_000.0
    for _ in range(7):
        tried = np.geomspace(low, high, 15)
        places = np.array([_uv(tristimulus(planck(GRID, t))) for t in tried])
        near = int(np.hypot(places[:, 0] - u, places[:, 1] - v).argmin())
        low, high = tried[max(near - 1, 0)], tried[min(near + 1, 14)]
    away = np.hypot(places[near, 0] - u, places[near, 1] - v)
    return float(tried[near]), float(np.copysign(away, v - places[near, 1]))


def _uv(xyz: np.ndarray) -> tuple[float, float]:
    x, y, z = xyz
    below = x + 15 * y + 3 * z
    return 4 * x / below, 6 * y / below


def unevenness(power: np.ndarray) -> float:
    """Return the largest over the smallest power from 400 to 720 nm, of a spectrum at `GRID`."""
    inside = power[(GRID >= 400) & (GRID <= 720)]
    return float(inside.max() / max(inside.min(), 1e-12))


def read_spectrum(name: str, keys: SpectrumKeys, root: Path, *, file: str) -> Spectrum:
    """Return a spectrum that a setup file declares.

    Parameters
    ----------
    keys : SpectrumKeys
        Exactly one of `planck_k`, `cie`, `csv`.
    root : path
        Folder of the setup file.
    file : str
        The setup file, for messages.
    """
    field = f"spectra.{name}"
    given = [k for k in ("planck_k", "cie", "csv") if getattr(keys, k) is not None]
    if len(given) != 1:
        raise PlanRefused(
            value_problem(
                file, field, "a spectrum is one of planck_k, cie, csv",
                ", ".join(given) or "none of them", "exactly one",
            )
        )  # fmt: skip
    if keys.planck_k is not None:
        return Spectrum(name, planck(GRID, keys.planck_k), (GRID[0], GRID[-1]))
    if keys.cie is not None:
        found = illuminant(keys.cie)
        if found is None:
            raise PlanRefused(
                value_problem(
                    file, f"{field}.cie", "there is no such illuminant", keys.cie, "A, D50, D65 …"
                )
            )
        return _on_grid(name, *found)
    assert keys.csv is not None
    w, table, _ = read_table(root / keys.csv, field=f"{field}.csv", file=file)
    return _on_grid(name, w, table[:, 0])


def _on_grid(name: str, wavelengths: np.ndarray, values: np.ndarray) -> Spectrum:
    known = (float(wavelengths[0]), float(wavelengths[-1]))
    held = np.interp(GRID, wavelengths, values)
    return Spectrum(name, held, known)


def read_table(path: Path, *, field: str, file: str) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Read a CSV of wavelength in nm and one or more columns.

    Returns
    -------
    wavelengths : ndarray, (n,), nm, ascending
    table : ndarray, (n, columns)
    labels : list of str
        Of the columns; empty without a header.
    """
    try:
        table, head = parse_spectra(
            read_text(path, "a CSV of wavelength in nm and a column of values")
        )
    except TextRefused as refused:
        raise PlanRefused(*refused.problems) from None
    except ValueError as error:
        raise PlanRefused(
            value_problem(
                file, field, f"{path.name} is no table of numbers", str(error)[:80], "a CSV"
            )
        ) from None
    filled = ~np.isnan(table).all(axis=0)  # a comma at the end of every row makes no column
    table, labels = table[:, filled], [h for h, f in zip(head, filled, strict=False) if f][1:]
    if not are_spectra(table) or not np.isfinite(table).all() or (table[:, 1:] < 0).any():
        raise PlanRefused(
            value_problem(file, field, f"{path.name} is no table over wavelength", f"{len(table)} rows",
                  "two rows or more of wavelengths, all distinct, and values of 0 or more")
        )  # fmt: skip
    low, high = table[0, 0], table[-1, 0]
    if high < 100 or low > 3000:
        what, found = f"{path.name} is not over nanometres", f"{low:g} to {high:g}"
        raise PlanRefused(value_problem(file, field, what, found, "wavelengths in nm"))
    return table[:, 0], table[:, 1:], labels
