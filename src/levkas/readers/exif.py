"""Exposure, sensitivity, date and model, as EXIF has them."""

from __future__ import annotations

import re
from datetime import datetime
from math import isfinite
from typing import Any, BinaryIO

MOST_READS = 50_000
"""Numbers that are read of one file's EXIF, maker notes left out; cameras write some hundred."""
# A preference order: IFD names as exifread writes them. TIFF/EP raws keep exposure in the main IFD.
EXPOSURE = ("EXIF ExposureTime", "Image ExposureTime")
ISO = ("EXIF ISOSpeedRatings", "Image ISOSpeedRatings", "EXIF ISOSpeed")
DATE = ("EXIF DateTimeOriginal", "Image DateTimeOriginal", "Image DateTime")


def read_exif(stream: BinaryIO) -> dict[str, Any]:
    """Return exposure_s, iso, captured and model; None where EXIF does not say.

    Parameters
    ----------
    stream : binary file
        A whole TIFF-like file or JPEG, or the bare TIFF block of a JPEG's or PNG's EXIF chunk.
        Damaged EXIF gives what could be read: no pixel depends on it.
    """
    import exifread

    try:
        tags = exifread.process_file(_Counted(stream), details=False)  # type: ignore[arg-type]
    except Exception:  # exifread raises whatever a damaged header leads it to
        tags = {}

    def first(names: tuple[str, ...]) -> Any:
        return next((tags[n] for n in names if n in tags), None)

    model = str(tags.get("Image Model", "")).strip(" \0")
    return {
        "exposure_s": _number(first(EXPOSURE)),
        "iso": _number(first(ISO)),
        "captured": iso_date(first(DATE), tags.get("EXIF OffsetTimeOriginal")),
        "model": model or None,
    }


class _Counted:
    """A file that may be read from `MOST_READS` times, a kilobyte each, and ends then.

    Directories of EXIF within directories may say the same thousand entries a thousand times over: 64 kB
    of them take exifread a minute.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream, self._left = stream, MOST_READS

    def read(self, size: int = -1) -> bytes:
        if self._left < 0:
            raise ValueError(f"EXIF of more than {MOST_READS} numbers")
        data = self._stream.read(size)
        self._left -= 1 + len(data) // 1000
        return data

    def seek(self, place: int, start: int = 0) -> int:
        return self._stream.seek(place, start)

    def tell(self) -> int:
        return self._stream.tell()


def iso_date(value: Any, offset: Any = None) -> str | None:
    """Return an EXIF date as ISO 8601, None for the empty dates that cameras write.

    Examples
    --------
    >>> iso_date("2019:02:08 17:43:35", "+01:00")
    '2019-02-08T17:43:35+01:00'
    >>> iso_date("0000:00:00 00:00:00") is None
    True
    """
    found = re.match(r"\s*(\d{4})[:-](\d\d)[:-](\d\d)[ T](\d\d:\d\d:\d\d)", str(value or ""))
    if not found:
        return None
    text = f"{found[1]}-{found[2]}-{found[3]}T{found[4]}"
    try:
        datetime.fromisoformat(text)
    except ValueError:
        return None
    zone = re.fullmatch(r"\s*([+-]\d\d:\d\d)[\s\0]*", str(offset or ""))
    return text + (zone[1] if zone else "")


def _number(tag: Any) -> float | None:
    values = getattr(tag, "values", None)
    try:
        number = float(values[0]) if values else 0.0
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if isfinite(number) and number > 0 else None
