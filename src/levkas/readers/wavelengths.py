"""Wavelengths as files state them, in nanometres: units of length, wavenumber, frequency and energy."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

RANGE_NM = (150.0, 20_000.0)
"""Of cameras that see reflected light: vacuum ultraviolet, which air absorbs, to thermal infrared. Centres beyond are in
another unit, or no wavelengths; a limit half as far off would let micrometres pass for nanometres only below 0.3 nm."""
SPEED_NM_S = 299_792_458e9
ELECTRONVOLT_NM = 1_239.841984
"""h c of 1 eV (CODATA 2018)."""
LENGTHS = {
    "nm": 1.0, "nanometer": 1.0, "nanometre": 1.0, "um": 1e3, "µm": 1e3, "μm": 1e3,
    "micrometer": 1e3, "micrometre": 1e3, "micron": 1e3, "mm": 1e6, "millimeter": 1e6,
    "millimetre": 1e6, "cm": 1e7, "centimeter": 1e7, "centimetre": 1e7, "m": 1e9, "meter": 1e9,
    "metre": 1e9, "angstrom": 0.1, "ångström": 0.1, "å": 0.1,
}  # fmt: skip
"""Nanometres in a unit of length."""
RECIPROCALS = {
    "wavenumber": 1e7, "1/cm": 1e7, "cm-1": 1e7, "cm^-1": 1e7, "cm⁻¹": 1e7,
    "hz": SPEED_NM_S, "mhz": SPEED_NM_S / 1e6, "ghz": SPEED_NM_S / 1e9, "thz": SPEED_NM_S / 1e12,
    "ev": ELECTRONVOLT_NM,
}  # fmt: skip
"""Wavelength times number, nm, of units that grow as wavelengths fall."""
NO_LENGTHS = ("index", "kev", "date", "time")
NARROWEST_NM = 0.05
"""Widths of bands that are smaller are in another unit: gratings and filters of cameras have 0.3 nm or more."""
_NUMBER = r"(?<![\w.,/+–-])(\d+(?:\.\d+)?)"
_NAMED = re.compile(
    _NUMBER + r"\s*(nm|nanomet(?:er|re)s?|um|µm|μm|micromet(?:er|re)s?|microns?|cm-1)(?![\w/])",
    re.IGNORECASE,
)
LONGEST_NAME = 400


class Centres(NamedTuple):
    """Wavelengths of bands, in nm, or why there are none.

    `note`: in which unit they were taken, where that is not the one that the file states; `unclear`: what it states that
    cannot be wavelengths.
    """

    nm: tuple[float, ...] | None = None
    fwhm: tuple[float, ...] | None = None
    note: str = ""
    unclear: str = ""


def read_centres(
    values: Sequence[float], unit: str = "", fwhm: Sequence[float] | None = None
) -> Centres:
    """Bring wavelengths and widths of bands to nanometres: in the stated unit where all centres lie within 150 to 20,000 nm.

    Else, and without a unit, they are nanometres or micrometres: no number lies in that range by both. Bands that are
    numbered have none.

    >>> read_centres([0.4, 1.0], "Nanometers")
    Centres(nm=(400.0, 1000.0), fwhm=None, note='wavelengths of 0.4 to 1 Nanometers are taken as micrometres', unclear='')
    >>> read_centres([25_000, 10_000], "Wavenumber").nm, read_centres([0.05, 0.09], "nm").unclear
    ((400.0, 1000.0), 'wavelengths of 0.05 to 0.09 nm')
    """
    known = unit.strip(" {}()").lower()
    if not values or known in NO_LENGTHS or not any(values):
        return Centres()
    units = LENGTHS | RECIPROCALS
    stated = next((name for name in (known, known.rstrip("s")) if name in units), "")
    stated = {1.0: "nanometre", 1e3: "micrometre"}.get(LENGTHS.get(stated, 0.0), stated)
    numbered = list(values) in ([*range(len(values))], [*range(1, len(values) + 1)])
    for name in dict.fromkeys((stated, "nanometre", "micrometre")):
        if numbered and name != stated:
            return Centres()
        if name and all(map(is_plausible, centres := [_nm(v, name) for v in values])):
            span = f"wavelengths of {min(values):g} to {max(values):g} {unit}".rstrip()
            note = f"{span} are taken as {name}s" if stated and name != stated else ""
            nm = tuple(round(v, 6) for v in centres)
            return Centres(nm, _widths(values, centres, name, fwhm), note)
    return Centres(unclear=f"wavelengths of {min(values):g} to {max(values):g} {unit}".rstrip())


def is_plausible(nm: float) -> bool:
    """Whether a wavelength can be that of a camera's band."""
    return RANGE_NM[0] <= nm <= RANGE_NM[1]


def centres_in_names(names: Sequence[str]) -> tuple[float, ...] | None:
    """Return the wavelengths in the names of bands, nm; None where not each has one of its own.

    Numbers behind a slash or dash are widths, or ends of ranges, and are none.

    >>> centres_in_names(["Band 1 (400.0 nm)", "Band 2 (0.55 µm)"])
    (400.0, 550.0)
    >>> centres_in_names(["450", "550"]), centres_in_names(["525/50 nm", "600 nm"]), centres_in_names(["1", "2"])
    ((450.0, 550.0), None, None)
    """
    if not names or any(len(name) > LONGEST_NAME for name in names):
        return None
    found = tuple(nm for name in names if (nm := _centre_in(name) or bare_centre(name)) is not None)
    return found if len(found) == len(names) == len(set(found)) else None


def _centre_in(name: str) -> float | None:
    found = _NAMED.findall(name)
    (nm,) = (read_centres([float(found[0][0])], found[0][1]).nm if len(found) == 1 else None) or (
        None,
    )
    return nm


def bare_centre(name: str) -> float | None:
    """Return a wavelength without a unit that stands alone, or in brackets at the end, nm; a band's own number is none.

    >>> bare_centre("Band 1 (450.0)"), bare_centre("0.45"), bare_centre("3")
    (450.0, 450.0, None)
    """
    found = re.fullmatch(r"(?:.*\()?\s*(\d{3,}(?:\.\d+)?|\d+\.\d+)\s*\)?", name.strip())
    (nm,) = (read_centres([float(found[1])]).nm if found else None) or (None,)
    return nm


def _nm(value: float, unit: str) -> float:
    if unit in LENGTHS:
        return value * LENGTHS[unit]
    return RECIPROCALS[unit] / value if value > 0 else 0.0


def _widths(
    values: Sequence[float], centres: Sequence[float], unit: str, fwhm: Sequence[float] | None
) -> tuple[float, ...] | None:
    """Return widths in nm; None where there are none that can be widths of these bands."""
    if not fwhm or len(fwhm) != len(values):
        return None
    if unit in RECIPROCALS:  # |dλ| = λ dν/ν
        return tuple(round(c * w / v, 6) for v, c, w in zip(values, centres, fwhm, strict=True))
    for name in (unit, "nanometre", "micrometre"):
        widths = [w * LENGTHS[name] for w in fwhm]
        if all(NARROWEST_NM <= w <= c for w, c in zip(widths, centres, strict=True)):
            return tuple(round(w, 6) for w in widths)
    return None
