"""What the values of an ENVI cube mean: which hold nothing, what reflectance 1.0 is, which bands are bad."""

from __future__ import annotations

from typing import Any

import numpy as np

from levkas.readers.envi_header import EnviHeader, check_list
from levkas.readers.nodata import nodata_of

GAINS = (
    *("data gain values", "data offset values"),
    *("data reflectance gain values", "data reflectance offset values"),
)
"""Factors and offsets to radiance or reflectance: raw counts are calibrated by dark and white instead."""


def value_facts(header: EnviHeader, dtype: np.dtype[Any], bands: int) -> dict[str, Any]:
    """Return `nodata`, `reflectance_scale`, `bad_bands` and `notes`, as `Facts` has them.

    Raises UnreadableCapture: E_BAND_COUNT where a list has another length than the bands.

    Examples
    --------
    >>> from pathlib import Path
    >>> header = EnviHeader(Path("a.hdr"), {"data ignore value": "-9999", "bbl": ["1", "0"]})
    >>> found = value_facts(header, np.dtype("i2"), 2)
    >>> found["nodata"], found["bad_bands"]
    (-9999.0, (1,))
    """
    nodata, notes = nodata_of(header.text("data ignore value"), dtype, "data ignore value")
    bad = _bad_bands(header, bands)
    return {
        "nodata": nodata,
        "reflectance_scale": _scale(header, bands),
        "bad_bands": bad,
        "notes": tuple(notes + _gains(header)),
    }


def _scale(header: EnviHeader, bands: int) -> tuple[float, ...] | None:
    """Return the value of reflectance 1.0 in every band; None where the header has none."""
    key = "reflectance scale factor"
    numbers = header.numbers(key) if header.fields.get(key) else []
    found = [n for n in numbers if n is not None and n > 0]
    if not found or len(found) < len(numbers):
        return None
    check_list(header, key, len(found), bands, one=True)
    return tuple(found * bands if len(found) == 1 else found)


def _bad_bands(header: EnviHeader, bands: int) -> tuple[int, ...] | None:
    """Return the indices of bands whose multiplier in the bad bands list is 0."""
    numbers = header.numbers("bbl") if header.fields.get("bbl") else []
    if not numbers:
        return None
    check_list(header, "bbl", len(numbers), bands)
    return tuple(i for i, number in enumerate(numbers) if number == 0) or None


def _gains(header: EnviHeader) -> list[str]:
    """Report which gains and offsets of the header are not applied; nothing of those without effect."""
    there = []
    for key in GAINS:
        numbers = header.numbers(key) if header.fields.get(key) else []
        neutral = 0.0 if "offset" in key else 1.0
        if any(number != neutral for number in numbers):
            there.append(f"`{key}`")
    return [f"{' and '.join(there)} of the header are not applied"] if there else []
