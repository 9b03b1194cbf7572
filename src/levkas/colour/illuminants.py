"""CIE daylight at any colour temperature, and illuminants A and E: the lights that filters simulate.

Kept here because colour-science, which the tests compare them with, takes seconds to import.
"""

from __future__ import annotations

from functools import cache

import numpy as np

# nm, S0, S1, S2 (CIE 015:2018, at every tenth nanometre; linear between them, as CIE has it).
DAYLIGHT = """
300 0.04 0.02 0
310 6 4.5 2
320 29.6 22.4 4
330 55.3 42 8.5
340 57.3 40.6 7.8
350 61.8 41.6 6.7
360 61.5 38 5.3
370 68.8 42.4 6.1
380 63.4 38.5 3
390 65.8 35 1.2
400 94.8 43.4 -1.1
410 104.8 46.3 -0.5
420 105.9 43.9 -0.7
430 96.8 37.1 -1.2
440 113.9 36.7 -2.6
450 125.6 35.9 -2.9
460 125.5 32.6 -2.8
470 121.3 27.9 -2.6
480 121.3 24.3 -2.6
490 113.5 20.1 -1.8
500 113.1 16.2 -1.5
510 110.8 13.2 -1.3
520 106.5 8.6 -1.2
530 108.8 6.1 -1
540 105.3 4.2 -0.5
550 104.4 1.9 -0.3
560 100 0 0
570 96 -1.6 0.2
580 95.1 -3.5 0.5
590 89.1 -3.5 2.1
600 90.5 -5.8 3.2
610 90.3 -7.2 4.1
620 88.4 -8.6 4.7
630 84 -9.5 5.1
640 85.1 -10.9 6.7
650 81.9 -10.7 7.3
660 82.6 -12 8.6
670 84.9 -14 9.8
680 81.3 -13.6 10.2
690 71.9 -12 8.3
700 74.3 -13.3 9.6
710 76.4 -12.9 8.5
720 63.3 -10.6 7
730 71.7 -11.6 7.6
740 77 -12.2 8
750 65.2 -10.2 6.7
760 47.7 -7.8 5.2
770 68.6 -11.2 7.4
780 65 -10.4 6.8
790 66 -10.6 7
800 61 -9.7 6.4
810 53.3 -8.3 5.5
820 58.9 -9.3 6.1
830 61.9 -9.8 6.5
"""
SECOND_RADIATION = 1.438776877e7
"""Planck's c2, nm·K (2019 SI)."""


@cache
def _daylight_table() -> np.ndarray:
    return np.array(DAYLIGHT.split(), float).reshape(-1, 4)


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
    table = _daylight_table()
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
