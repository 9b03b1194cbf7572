"""EXIF: how a frame was exposed and by which camera, in every container that carries it.

Tags and their values are those of Exif 2.32 (CIPA DC-008-2019), table 4 to 8; APEX is its annex C.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from datetime import datetime
from math import isfinite
from typing import Any, BinaryIO

import numpy as np

from levkas.readers.orientation import UPRIGHT

MOST_READS = 50_000
"""Reads of one file's EXIF, maker notes left out; cameras write some hundred numbers."""
OVERFLOW = 65535
"""PhotographicSensitivity of a camera whose sensitivity is in the tags of 32 bits."""
SENSITIVITIES = (
    *("ISOSpeedRatings", "PhotographicSensitivity", "RecommendedExposureIndex"),
    *("StandardOutputSensitivity", "ISOSpeed"),
)
"""In the order of what cameras show as ISO; the rational ExposureIndex is the last."""
BALANCE = {0: "auto", 1: "manual"}
"""Values of the tag WhiteBalance."""
RATIONAL = (5, 10)
"""Types of TIFF tags."""
LARGEST_APEX = 30
"""1/2^30 s, and f/32768."""
ZERO_DAYS = ("0001-01-01", "1601-01-01", "1904-01-01", "1970-01-01", "1980-01-01")
"""Days at which the clocks of .NET, Windows, Macintosh, Unix and DOS are at zero: what writes a date that it does not know."""
UNNAMED = {"StandardOutputSensitivity": "Tag 0x8831", "CameraSerialNumber": "Tag 0xC62F"}
"""Tags that exifread names by their number."""


def read_exif(stream: BinaryIO) -> dict[str, Any]:
    """Return `exif_facts` of a whole TIFF-like file or JPEG, or of the bare TIFF block of a JPEG's or PNG's EXIF chunk.

    Damaged EXIF gives what could be read: no pixel depends on it.
    """
    import exifread

    try:
        tags = exifread.process_file(_BoundedReads(stream), details=False)  # type: ignore[arg-type]
    except Exception:  # exifread raises whatever a damaged header leads it to
        tags = {}

    def find(name: str) -> Any:
        own = UNNAMED.get(name, name)
        # TIFF/EP raws keep exposure in the main directory.
        found = (tags.get(f"{where} {each}") for where in ("EXIF", "Image") for each in (name, own))
        values = next((tag.values for tag in found if tag is not None), None)
        return values[0] if isinstance(values, list) and values else values

    return exif_facts(find)


class _BoundedReads:
    """A file that may be read from `MOST_READS` times, a kilobyte each, and ends then.

    EXIF directories within directories may list the same thousand entries a thousand times over: 64 kB of them take
    exifread a minute.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream, self._left = stream, MOST_READS
        self.seek, self.tell = stream.seek, stream.tell

    def read(self, size: int = -1) -> bytes:
        if self._left < 0:
            raise ValueError(f"EXIF of more than {MOST_READS} numbers")
        data = self._stream.read(size)
        self._left -= 1 + len(data) // 1000
        return data


def exif_facts(find: Callable[[str], Any]) -> dict[str, Any]:
    """Return exposure, sensitivity, date, camera, lens and orientation as fields of `Facts`; None where EXIF does not say.

    `find` returns the value of a tag by its name, from any directory, or None. f/5.6 and 1/32 s, as APEX 5 and 5:

    >>> tags = {"ApertureValue": (5, 1), "ShutterSpeedValue": (5, 1), "RecommendedExposureIndex": 100}
    >>> found = exif_facts(tags.get)
    >>> round(found["f_number"], 2), found["exposure_s"], found["iso"]
    (5.66, 0.03125, 100.0)
    """

    def text(*names: str) -> str | None:
        return next((found for name in names if (found := exif_text(find(name)))), None)

    def first(name: str) -> Any:
        value = find(name)
        return value[0] if isinstance(value, list | tuple) and value else value

    def code(name: str) -> int:
        return value if isinstance(value := first(name), int) else -1

    def power_of_two(name: str, step: float) -> float | None:
        # None of 0, as lenses without contacts have it, and of absurd values.
        apex = finite_number(find(name))
        return 2.0 ** (step * apex) if apex and abs(apex) <= LARGEST_APEX else None

    # ISO of the 16 bits that every camera writes, unless these are full, else of the tags beside them.
    speeds = [positive_number(first(name)) for name in SENSITIVITIES]
    speeds.append(positive_number(find("ExposureIndex")))
    known = [speed for speed in speeds if speed]
    control, orientation = finite_number(find("GainControl")), code("Orientation")
    return {
        "exposure_s": positive_number(find("ExposureTime"))
        or power_of_two("ShutterSpeedValue", -1.0),
        "iso": next((speed for speed in known if speed != OVERFLOW), known[0] if known else None),
        "gain": None if control is None else (("GainControl", f"{control:g}"),),
        "captured": iso_date(text("DateTimeOriginal", "DateTime"), find("OffsetTimeOriginal")),
        "make": text("Make"),
        "model": text("Model"),
        "serial": text("BodySerialNumber", "CameraSerialNumber"),
        "f_number": positive_number(find("FNumber")) or power_of_two("ApertureValue", 0.5),
        "focal_mm": positive_number(find("FocalLength")),
        "lens": text("LensModel"),
        "white_balance": BALANCE.get(code("WhiteBalance")),
        "orientation": orientation if orientation in UPRIGHT else None,
    }


def exif_text(value: Any) -> str | None:
    """Return a text of EXIF without the blanks and zeros that cameras fill it up with; None for an empty one.

    >>> exif_text("NIKON D80  \\0"), exif_text("   ")
    ('NIKON D80', None)
    """
    if isinstance(value, bytes):
        value = value.decode("ascii", "replace")
    return " ".join(str(value if value is not None else "").replace("\0", " ").split()) or None


def iso_date(value: Any, offset: Any = None) -> str | None:
    """Return an EXIF date as ISO 8601, None for the empty dates that cameras write, and where a clock is at its zero.

    >>> iso_date("2019:02:08 17:43:35", "+01:00")
    '2019-02-08T17:43:35+01:00'
    >>> iso_date("0000:00:00 00:00:00"), iso_date("1970:01:01 00:00:00")
    (None, None)
    """
    found = re.match(r"\s*(\d{4})[:-](\d\d)[:-](\d\d)[ T](\d\d:\d\d:\d\d)", str(value or ""))
    if not found:
        return None
    text = f"{found[1]}-{found[2]}-{found[3]}T{found[4]}"
    if text[:10] in ZERO_DAYS:
        return None
    try:
        datetime.fromisoformat(text)
    except ValueError:
        return None
    zone = re.fullmatch(r"\s*([+-]\d\d:\d\d)[\s\0]*", str(offset or ""))
    return text + (zone[1] if zone else "")


def finite_number(value: Any) -> float | None:
    """Return a finite number from a number, a rational, text, or the first of several."""
    try:
        if isinstance(value, tuple | list):
            value = float(value[0]) / float(value[1]) if len(value) == 2 else value[0]
        number = float(value)
    except (TypeError, ValueError, IndexError, ZeroDivisionError, OverflowError):
        return None
    return number if isfinite(number) else None


def positive_number(value: Any) -> float | None:
    """Return what `finite_number` does, None where it is not above 0."""
    number = finite_number(value)
    return number if number is not None and number > 0 else None


# --- tags of a TIFF, which may be damaged: no pixel depends on them ------------------------------


def value_of(tags: Any, name: str | int) -> Any:
    """Return a tag's value, None where it is absent or cannot be read."""
    try:
        if isinstance(name, str):  # for which tifffile would look through all tags
            from tifffile import TIFF

            name = next((code for code in TIFF.TAGS.getall(name, []) if code in tags), -1)
        return tags[name].value if name in tags else None
    except Exception:  # a damaged directory leads tifffile to many kinds of errors
        return None


def numbers_of(tags: Any, name: str | int) -> tuple[float, ...]:
    """Return a tag's finite numbers, rationals divided; none where it holds text, or nothing."""
    value = value_of(tags, name)
    if value is None or isinstance(value, str | bytes):
        return ()
    try:
        numbers = [float(v) for v in np.atleast_1d(np.asarray(value, float)).ravel()]
    except (TypeError, ValueError):
        return ()
    if int(tags[name].dtype) in RATIONAL:
        pairs = zip(numbers[::2], numbers[1::2], strict=False)
        numbers = [top / bottom for top, bottom in pairs if bottom]
    return tuple(n for n in numbers if isfinite(n))
