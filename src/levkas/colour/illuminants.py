"""Spectra of lights: black bodies, CIE daylight at any colour temperature, and the illuminants of CIE 015:2018."""

from __future__ import annotations

import re

import numpy as np

from levkas.colour.observer import read_names, read_table, tables_by_nm

Light = str | tuple[np.ndarray, np.ndarray]
"""The name of a light, or its wavelengths, nm, and relative power."""

SECOND_RADIATION = 1.438776877e7
"""Planck's c2, nm·K (2019 SI)."""


def planck(wavelengths: np.ndarray, kelvin: float) -> np.ndarray:
    """Return the relative power of a black body, 1 at 560 nm.

    Examples
    --------
    Halogen has four times as much red as blue:

    >>> np.round(planck(np.array([450.0, 560.0, 650.0]), 3000.0), 2).tolist()
    [0.37, 1.0, 1.55]
    """
    w = np.asarray(wavelengths, float)
    with np.errstate(over="ignore"):
        return (560 / w) ** 5 * (
            np.expm1(SECOND_RADIATION / (560 * kelvin)) / np.expm1(SECOND_RADIATION / (w * kelvin))
        )


def daylight(kelvin: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a phase of daylight by its correlated colour temperature, 4,000 to 25,000 K: nm, 300 to 830, and power, 100 at 560 nm.

    D50 is 5,002.8 K and D65 6,503.6 K, for the radiation constant was corrected since.

    Notes
    -----
    CIE 015:2018, section 4.1.2; M1 and M2 rounded to three decimals as there.
    """
    if not 4000 <= kelvin <= 25_000:
        raise ValueError(f"daylight is defined from 4,000 to 25,000 K, got {kelvin:g} K")
    t = 1e3 / kelvin
    x = (
        ((-4.6070 * t + 2.9678) * t + 0.09911) * t + 0.244063
        if kelvin <= 7000
        else ((-2.0064 * t + 1.9018) * t + 0.24748) * t + 0.237040
    )
    y = (-3.0 * x + 2.870) * x - 0.275
    below = 0.0241 + 0.2562 * x - 0.7341 * y
    first = round((-1.3515 - 1.7703 * x + 5.9114 * y) / below, 3)
    second = round((0.0300 - 31.4424 * x + 30.0717 * y) / below, 3)
    table = read_table("cie_daylight.csv")  # linear between its rows, as CIE has it
    return table[:, 0], table[:, 1] + first * table[:, 2] + second * table[:, 3]


def illuminant(name: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Return a CIE illuminant by its name, or None where there is none such.

    A, E and phases of daylight (D40 to D99) are computed; B, C, FL, HP, LED and ID are tables, 380 to 780 nm.

    Examples
    --------
    >>> wavelengths, power = illuminant("D65")
    >>> round(float(power[wavelengths == 560][0]), 3), float(wavelengths[-1])
    (100.0, 830.0)
    """
    wanted = name.upper()
    if wanted == "A":
        w = np.arange(300.0, 831.0, 5.0)
        # A is by definition 2848 K with c2 of 1931.
        raised = np.expm1(1.435e7 / (2848 * 560)) / np.expm1(1.435e7 / (2848 * w))
        return w, 100 * (560 / w) ** 5 * raised
    if wanted == "E":
        w = np.arange(300.0, 831.0, 5.0)
        return w, np.full(len(w), 100.0)
    if re.fullmatch(r"D[4-9]\d", wanted):
        return daylight(100 * int(wanted[1:]) * 1.4388 / 1.4380)
    names = read_names("cie_illuminants.csv")
    if wanted not in names[1:]:
        return None
    table = read_table("cie_illuminants.csv")
    return table[:, 0], table[:, names.index(wanted)]


def light_on_grid(light: Light) -> np.ndarray:
    """Return a light's relative power from 380 to 780 nm by 1.

    Parameters
    ----------
    light : str or (wavelengths (n,), power (n,))
        A name of `illuminant`, a black body such as ``"4000 K"``, or a measured spectrum, nm; beyond
        its ends it keeps its first and last value.

    Examples
    --------
    >>> power = light_on_grid("A")
    >>> round(float(power[180] / power[20]), 3)  # 560 nm over 400 nm: 100 over 14.708
    6.799
    """
    rows = tables_by_nm()
    grid = rows[:, 0]
    if isinstance(light, str) and light.upper() == "D65":
        return rows[:, 4]
    if isinstance(light, str) and (kelvin := re.fullmatch(r"(\d+(?:\.\d+)?)\s*K", light.strip())):
        return _black_body(grid, float(kelvin.group(1)))
    known = illuminant(light) if isinstance(light, str) else light
    if known is None:
        raise ValueError(
            f"no light {light!r}; there are D40 to D99, A, C, E, FL1, LED-B1 …, and black bodies: 4000 K"
        )
    wavelengths, levels = (np.asarray(part, float) for part in known)
    power = np.interp(grid, wavelengths, levels)
    if not np.isfinite(power).all() or power.min() < 0 or power.sum() <= 0:
        raise ValueError("a light needs power >= 0 at all wavelengths, and more than 0 at some")
    return power


def _black_body(wavelengths: np.ndarray, kelvin: float) -> np.ndarray:
    if not 500 <= kelvin <= 100_000:
        raise ValueError(f"a black body of {kelvin:g} K is outside the range of 500 to 100000 K")
    return np.asarray(planck(wavelengths, kelvin))
