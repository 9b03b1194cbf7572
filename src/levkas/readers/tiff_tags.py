"""What the tags of a TIFF page say of its samples, its camera and its band."""

from __future__ import annotations

import re
from math import isfinite
from typing import Any

import numpy as np

from levkas.readers.exif import iso_date

GRAY = {0: "zero is white", 1: "gray", 2: "colours", 32803: "mosaic", 34892: "linear"}
JPEG = (6, 7, 33007, 34892)
YCBCR = 6
RATIONAL = (5, 10)  # types of tags
MICASENSE_FULL = 65520.0
"""MicaSense cameras count 12 bits and store them times 16; no tag says so."""


def colours_of(page: Any) -> str | None:
    """Return what the samples are, None where they are no counts (palette, CMYK, CIELAB)."""
    if "PhotometricInterpretation" not in page.tags:
        return "gray"
    photometric = int(page.photometric)
    if photometric == YCBCR and page.compression in JPEG:
        return "colours"  # the decoder gives red, green, blue
    return GRAY.get(photometric)


def describe(page: Any) -> dict[str, Any]:
    """Return the levels, pattern, exposure, date, camera and band of a page, as fields of Facts."""
    tags = page.tags
    exif = _value(tags, "ExifTag")
    exif = exif if isinstance(exif, dict) else {}

    def find(*names: str) -> Any:
        for name in names:
            value = _value(tags, name)
            value = exif.get(name) if value is None else value
            if value is not None:
                return value
        return None

    blacks, whites = _levels(tags, "BlackLevel"), _levels(tags, "WhiteLevel")
    model, make = _text(find("Model")), _text(find("Make"))
    wavelength, fwhm, name = camera_band(_value(tags, "XMP") or b"")
    saturation = min(whites) if whites else None
    if make == "MicaSense" and wavelength and saturation is None and page.bitspersample == 16:
        saturation = MICASENSE_FULL
    return {
        "black": sum(blacks) / len(blacks) if blacks else None,
        "blacks": blacks if len(blacks) == 4 and len(set(blacks)) > 1 else None,
        "saturation": saturation,
        "pattern": _bayer(find("CFAPattern"), find("CFARepeatPatternDim")),
        "exposure_s": _number(find("ExposureTime")),
        "iso": _number(find("ISOSpeedRatings", "PhotographicSensitivity", "ISOSpeed")),
        "captured": iso_date(find("DateTimeOriginal", "DateTime"), find("OffsetTimeOriginal")),
        "model": model,
        "wavelengths": (wavelength,) if wavelength else None,
        "fwhm": (fwhm,) if fwhm else None,
        "band_names": (name,) if name else None,
    }


def camera_band(xmp: bytes | str) -> tuple[float | None, float | None, str | None]:
    """Return centre and width (nm) and name of the band that MicaSense and others put in XMP.

    Examples
    --------
    >>> camera_band(b"<Camera:CentralWavelength>475</Camera:CentralWavelength>")
    (475.0, None, None)
    """
    text = xmp.decode("utf-8", "replace") if isinstance(xmp, bytes) else str(xmp)

    def find(name: str) -> str | None:
        found = re.search(rf"Camera:{name}(?:=\"|>)\s*([^<\"]+)", text)
        return found[1].strip() if found else None

    return _number(find("CentralWavelength")), _number(find("WavelengthFWHM")), find("BandName")


def _value(tags: Any, name: str) -> Any:
    """Value of a tag, None where it is not there or cannot be read: no pixel depends on these."""
    try:
        return tags[name].value if name in tags else None
    except Exception:  # a damaged EXIF directory leads tifffile to many kinds of errors
        return None


def _levels(tags: Any, name: str) -> tuple[float, ...]:
    value = _value(tags, name)
    if value is None or isinstance(value, str | bytes):
        return ()
    numbers = [float(v) for v in np.atleast_1d(np.asarray(value, float)).ravel()]
    if int(tags[name].dtype) in RATIONAL:
        pairs = zip(numbers[::2], numbers[1::2], strict=False)
        numbers = [top / bottom for top, bottom in pairs if bottom]
    return tuple(n for n in numbers if isfinite(n))


def _number(value: Any) -> float | None:
    """Return a positive number from a number, a rational, text, or the first of several."""
    try:
        if isinstance(value, tuple | list) and len(value) == 2:
            value = float(value[0]) / float(value[1])
        elif isinstance(value, tuple | list):
            value = value[0]
        number = float(value)
    except (TypeError, ValueError, IndexError, ZeroDivisionError, OverflowError):
        return None
    return number if isfinite(number) and number > 0 else None


def _text(value: Any) -> str | None:
    if isinstance(value, bytes):
        value = value.decode("ascii", "replace")
    return (str(value).strip(" \0") or None) if value else None


def _bayer(pattern: Any, dims: Any) -> str | None:
    """Return a 2x2 pattern as letters; codes are 0 red, 1 green, 2 blue."""
    try:
        if dims is not None and [int(d) for d in np.atleast_1d(dims)] != [2, 2]:
            return None
        codes = [int(c) for c in pattern] if isinstance(pattern, bytes | tuple | list) else []
    except (TypeError, ValueError):
        return None
    return "".join("RGB"[c] for c in codes) if len(codes) == 4 and max(codes) < 3 else None
