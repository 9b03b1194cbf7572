"""JPEG captures: photographs; EXIF orientation is ignored."""

from __future__ import annotations

import struct
from io import BytesIO
from math import prod
from pathlib import Path
from typing import BinaryIO

import numpy as np

from levkas.readers.exif import read_exif
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

SIGNATURE = b"\xff\xd8\xff"
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
