"""JPEG captures: photographs; EXIF orientation is ignored."""

from __future__ import annotations

import re
import struct
from datetime import datetime
from io import BytesIO
from math import isfinite, prod
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from levkas.readers.facts import (
    COPY_AGAIN,
    Facts,
    check_expansion,
    check_memory,
    check_ratio,
    check_size,
    decoding,
    unreadable,
)

JPEG = b"\xff\xd8\xff"
NO_FRAME = (0xC4, 0xC8, 0xCC)  # tables and an extension, among the markers of frames
LARGEST_RATIO = 4000
LARGEST_EXPANSION = 150
"""Of a large one; one even colour is 200 to 1, a painting before black less than 100."""
MOST_SCANS = 64
"""Of a progressive JPEG; encoders write about ten, and each goes through the whole image."""
SCAN = b"\xff\xda"
END = b"\xff\xd9"


def read_jpeg_facts(path: Path) -> Facts:
    """Return size and EXIF facts of a JPEG; no pixel is decoded."""
    with decoding(path, "JPEG"):
        return _walk(path)[0]


def read_jpeg(path: Path) -> np.ndarray:
    """Decode a JPEG, (h, w) or (h, w, 3) red, green, blue, uint8.

    Damage inside the coded data cannot be told from an image: JPEG has no checksum. What is cut
    short is refused.
    """
    import imagecodecs

    with decoding(path, "JPEG"):
        facts, scan = _walk(path)
        check_memory(path, prod(facts.shape), 1)
        data = path.read_bytes()
        if data.rfind(END) < scan:
            raise unreadable(
                path,
                "the file ends before its image does",
                code="E_TRUNCATED",
                found=f"{len(data)} bytes",
                expected="an end-of-image marker after the scan",
                fix=COPY_AGAIN,
            )
        if (scans := data.count(SCAN, scan - 4)) > MOST_SCANS:
            raise unreadable(
                path,
                "the JPEG has too many scans to be a photograph",
                code="E_SIZE",
                field="scan",
                found=f"{scans} scans",
                expected=f"at most {MOST_SCANS}",
                fix="Save it again as a plain JPEG or a PNG.",
            )
        values = np.asarray(imagecodecs.jpeg8_decode(data))
    if values.shape != facts.shape or values.dtype != np.uint8:
        raise unreadable(path, "the JPEG is not what its header says", found=str(values.shape))
    return np.ascontiguousarray(values)


def _walk(path: Path) -> tuple[Facts, int]:
    """Return the facts and where the first scan begins, marker by marker."""
    exif: bytes | None = None
    frame: tuple[int, int, int, int] | None = None
    with path.open("rb") as handle:
        size = handle.seek(0, 2)
        handle.seek(2)
        while True:
            marker = _next_marker(handle.read(2), handle)
            length = handle.read(2)
            if marker is None or len(length) < 2:
                break
            content = struct.unpack(">H", length)[0] - 2
            if marker == 0xDA and frame:
                return _facts(path, frame, exif, size), handle.tell()
            if content < 0 or handle.tell() + content > size:
                break
            body = handle.read(content)
            if marker == 0xE1 and body.startswith(b"Exif\0\0"):
                exif = exif or body[6:]
            elif 0xC0 <= marker <= 0xCF and marker not in NO_FRAME and not frame:
                frame = struct.unpack(">BHHB", body[:6])
    raise unreadable(
        path,
        "the file ends before its image does",
        code="E_TRUNCATED",
        field="scan" if frame else "frame header",
        found=f"{size} bytes",
        expected="a frame header and a scan",
        fix=COPY_AGAIN,
    )


def _next_marker(two: bytes, handle: BinaryIO) -> int | None:
    """Return the marker that begins here; fill bytes 0xFF may come before it."""
    while len(two) == 2 and two == b"\xff\xff":
        two = two[1:] + handle.read(1)
    return two[1] if len(two) == 2 and two[0] == 0xFF else None


def _facts(path: Path, frame: tuple[int, int, int, int], exif: bytes | None, size: int) -> Facts:
    bits, height, width, samples = frame
    if samples not in (1, 3) or bits != 8:
        raise unreadable(
            path,
            "this kind of JPEG is not read",
            field="frame header",
            found=f"{samples} components of {bits} bits",
            expected="gray or three colours of 8 bits",
            fix="Export it again as an RGB JPEG or a TIFF.",
        )
    shape = (height, width) if samples == 1 else (height, width, 3)
    check_size(path, shape)
    check_ratio(path, height * width * samples, size, ratio=LARGEST_RATIO)
    check_expansion(path, height * width * samples, 1, size, most=LARGEST_EXPANSION)
    more = read_exif(BytesIO(exif)) if exif else {}
    return Facts(path=path, kind="jpeg", shape=shape, dtype="uint8", bits=8, **more)


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


PNG = b"\x89PNG\r\n\x1a\n"
SAMPLES = {0: 1, 2: 3, 3: 3, 4: 1, 6: 3}
"""Samples that count, by colour type: palettes become colours, alpha is dropped."""
DEFLATE_RATIO = 1040
LONGEST_CHUNK = 64 << 20


def read_png_facts(path: Path) -> Facts:
    """Return size, depth and, where an eXIf chunk has them, exposure and date; no pixel is decoded.

    Notes
    -----
    sBIT says how many bits a sample had before it was scaled to the stored depth, so the sensor is
    full at (2^sBIT − 1) · 2^(depth − sBIT): 65520, not 4095, for 12 bits in 16.
    """
    with decoding(path, "PNG"):
        head, chunks, stored = _chunks(path)
    width, height, depth, colour = struct.unpack(">IIBB", head[:10])
    if colour not in SAMPLES or depth not in (1, 2, 4, 8, 16):
        raise unreadable(
            path,
            "the PNG header is damaged",
            field="IHDR",
            found=f"{depth} bits, type {colour}",
            expected="1, 2, 4, 8 or 16 bits of type 0, 2, 3, 4 or 6",
        )
    shape = (height, width) if SAMPLES[colour] == 1 else (height, width, 3)
    check_size(path, shape)
    check_ratio(
        path, height * width * SAMPLES[colour] * max(depth // 8, 1), stored, ratio=DEFLATE_RATIO
    )
    check_expansion(path, prod(shape), max(depth // 8, 1), stored)
    full = max(depth, 8)
    bits = min(chunks.get(b"sBIT", b"")[: SAMPLES[colour]], default=full)
    if not 0 < bits < full or depth < 8 or colour == 3:
        bits = full
    more: dict[str, Any] = read_exif(BytesIO(chunks[b"eXIf"])) if b"eXIf" in chunks else {}
    return Facts(
        path=path,
        kind="png",
        shape=shape,
        dtype="uint16" if depth == 16 else "uint8",
        bits=bits,
        saturation=float((2**bits - 1) << (full - bits)) if bits < full else None,
        **more,
    )


def read_png(path: Path) -> np.ndarray:
    """Decode a PNG, (h, w) or (h, w, 3), uint8 or uint16; every chunk's checksum is verified."""
    import imagecodecs

    facts = read_png_facts(path)
    check_memory(path, prod(facts.shape), np.dtype(facts.dtype).itemsize)
    with decoding(path, "PNG"):
        data = path.read_bytes()
        if b"IEND" not in data[-4096:]:
            raise unreadable(
                path,
                "the file ends before its image does",
                code="E_TRUNCATED",
                field="IEND",
                found=f"{len(data)} bytes",
                expected="an IEND chunk at the end",
                fix=COPY_AGAIN,
            )
        values = np.asarray(imagecodecs.png_decode(data))
    if values.ndim == 3:
        values = values[..., 0] if len(facts.shape) == 2 else values[..., :3]
    if values.shape != facts.shape or values.dtype != facts.dtype:
        raise unreadable(path, "the PNG is not what its header says", found=str(values.shape))
    return np.ascontiguousarray(values)


def _chunks(path: Path) -> tuple[bytes, dict[bytes, bytes], int]:
    """Return the header, the small chunks before the first pixel, and the size of the file."""
    wanted: dict[bytes, bytes] = {}
    with path.open("rb") as handle:
        size = handle.seek(0, 2)
        handle.seek(len(PNG))
        head = b""
        while (start := handle.read(8)) and len(start) == 8:
            length, name = struct.unpack(">I4s", start)
            if name == b"IDAT" and head:
                return head, wanted, size
            if (name == b"IHDR") != (not head) or handle.tell() + length > size:
                break
            if name in (b"IHDR", b"sBIT", b"eXIf") and length < LONGEST_CHUNK:
                content = handle.read(length)
                wanted[name] = content
                head = wanted[b"IHDR"] if len(wanted[b"IHDR"]) == 13 else b""
                handle.seek(4, 1)
            else:
                handle.seek(length + 4, 1)
    raise unreadable(
        path,
        "the file ends before its image does",
        code="E_TRUNCATED",
        field="IHDR" if not head else "IDAT",
        found=f"{size} bytes",
        expected="an IHDR chunk first, then pixels in IDAT",
        fix=COPY_AGAIN,
    )
