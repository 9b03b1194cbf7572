"""CIE daylight at any colour temperature, and illuminants A and E: the lights that filters simulate."""

from __future__ import annotations

import numpy as np

from levkas.colour.observer import read_table

SECOND_RADIATION = 1.438776877e7
"""Planck's c2, nm·K (2019 SI)."""


def planck(wavelengths: np.ndarray, kelvin: float) -> np.ndarray:
    """Return the relative power of a black body, 1 at 560 nm.

    Parameters
    ----------
    wavelengths : ndarray, (n,), nm
    kelvin : float
        Temperature, > 0.

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
    """Return a phase of daylight by its correlated colour temperature, 4,000 to 25,000 K.

    D50 is 5,002.8 K and D65 6,503.6 K, for the radiation constant was corrected since.

    Returns
    -------
    wavelengths : ndarray, (54,), nm
        300 to 830.
    power : ndarray, (54,)
        100 at 560 nm.

    Raises
    ------
    ValueError
        Outside 4,000 to 25,000 K.

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

    A, E and D50, D55, D65, D75 are computed; any other is looked up in colour-science.

    Returns
    -------
    wavelengths, power : ndarray, (n,)
        nm; relative.

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
    if wanted in ("D50", "D55", "D65", "D75"):
        return daylight(100 * int(wanted[1:]) * 1.4388 / 1.4380)
    import colour

    known = colour.SDS_ILLUMINANTS
    found = next((known[k] for k in known if k.upper() == wanted), None)
    return None if found is None else (np.asarray(found.wavelengths), np.asarray(found.values))
