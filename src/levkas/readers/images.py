"""PNG and JPEG captures."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from io import BytesIO
from math import prod
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from levkas.readers.encoding import gamma_of_png
from levkas.readers.exif import read_exif
from levkas.readers.facts import (
    Facts,
    check_expansion,
    check_memory,
    check_ratio,
    check_size,
    decoding,
    truncated,
    unreadable,
)

PNG = b"\x89PNG\r\n\x1a\n"
PNG_SAMPLES = {0: 1, 2: 3, 3: 3, 4: 1, 6: 3}
"""Samples that count, by colour type: palettes become colours, alpha is dropped."""
WITH_ALPHA = (4, 6)
ALPHA = "an alpha channel (transparency) is not used"
DEFLATE_RATIO = 1040
LONGEST_CHUNK = 64 << 20
READ_CHUNKS = (b"IHDR", b"sBIT", b"eXIf", b"gAMA", b"sRGB", b"iCCP")
JPEG = b"\xff\xd8\xff"
SCAN, END = b"\xff\xda", b"\xff\xd9"
JPEG_RATIO = 4000
JPEG_EXPANSION = 150
"""Bytes of a large JPEG from one stored byte; one even colour is 200 to 1, a painting before black less than 100."""
MOST_SCANS = 64
"""Scans of a progressive JPEG; encoders write about ten, and each goes through the whole image."""
JPEG_CODES = (6, 7, 33007)
"""Of the TIFF tag Compression."""


# --- PNG --------------------------------------------------------------------------------------


def read_png_facts(path: Path) -> Facts:
    """Return size, depth and, where an eXIf chunk has them, exposure and date; no pixel is decoded.

    Notes
    -----
    sBIT holds the bits of a sample before it was scaled to the stored depth, so the sensor is full at
    (2^sBIT − 1) · 2^(depth − sBIT): 65520, not 4095, for 12 bits in 16.
    """
    with decoding(path, "PNG"):
        head, chunks, stored = _png_chunks(path)
    width, height, depth, colour = struct.unpack(">IIBB", head[:10])
    if colour not in PNG_SAMPLES or depth not in (1, 2, 4, 8, 16):
        raise unreadable(
            path,
            "the PNG header is damaged",
            field="IHDR",
            found=f"{depth} bits, type {colour}",
            expected="1, 2, 4, 8 or 16 bits of type 0, 2, 3, 4 or 6",
        )
    samples, itemsize = PNG_SAMPLES[colour], max(depth // 8, 1)
    shape = (height, width) if samples == 1 else (height, width, 3)
    check_size(path, shape)
    check_ratio(path, prod(shape) * itemsize, stored, ratio=DEFLATE_RATIO)
    check_expansion(path, prod(shape), itemsize, stored)
    full = max(depth, 8)
    bits = min(chunks.get(b"sBIT", b"")[:samples], default=full)
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
        notes=(ALPHA,) if colour in WITH_ALPHA else (),
        encoded=gamma_of_png(chunks),
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
            message, expected = "the file is truncated", "an IEND chunk at the end"
            raise truncated(path, message, "IEND", f"{len(data)} bytes", expected)
        values = np.asarray(imagecodecs.png_decode(data))
    if values.ndim == 3:
        values = values[..., 0] if len(facts.shape) == 2 else values[..., :3]
    return _as_declared(path, values, facts)


def _as_declared(path: Path, values: np.ndarray, facts: Facts) -> np.ndarray:
    if values.shape != facts.shape or values.dtype != facts.dtype:
        found = f"{values.shape} {values.dtype}"
        raise unreadable(path, "the image does not match its header", found=found)
    return np.ascontiguousarray(values)


def _png_chunks(path: Path) -> tuple[bytes, dict[bytes, bytes], int]:
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
            if name in READ_CHUNKS and length < LONGEST_CHUNK:
                wanted[name] = handle.read(length)
                head = wanted[b"IHDR"] if len(wanted[b"IHDR"]) == 13 else b""
                handle.seek(4, 1)
            else:
                handle.seek(length + 4, 1)
    field, expected = "IDAT" if head else "IHDR", "an IHDR chunk first, then pixels in IDAT"
    raise truncated(path, "the file is truncated", field, f"{size} bytes", expected)


# --- JPEG -------------------------------------------------------------------------------------


def read_jpeg_facts(path: Path) -> Facts:
    """Return size and EXIF facts of a JPEG; no pixel is decoded."""
    with decoding(path, "JPEG"):
        return _jpeg_header(path)[0]


def read_jpeg(path: Path) -> np.ndarray:
    """Decode a JPEG, (h, w) or (h, w, 3) red, green, blue, uint8.

    Damage inside the coded data cannot be distinguished from an image: JPEG has no checksum. What is cut
    short is refused.
    """
    import imagecodecs

    with decoding(path, "JPEG"):
        facts, scan = _jpeg_header(path)
        check_memory(path, prod(facts.shape), 1)
        data = path.read_bytes()
        if data.rfind(END) < scan:
            expected = "an end-of-image marker after the scan"
            message = "the file is truncated"
            raise truncated(path, message, "scan", f"{len(data)} bytes", expected)
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
        return _as_declared(path, np.asarray(imagecodecs.jpeg8_decode(data)), facts)


def _jpeg_header(path: Path) -> tuple[Facts, int]:
    """Return the facts and where the first scan begins."""
    exif, frame = b"", None
    with path.open("rb") as handle:
        size = handle.seek(0, 2)
        for marker, content in jpeg_segments(handle):
            if marker == 0xDA and frame:
                return _jpeg_facts(path, frame, exif, size), handle.tell()
            if marker == 0xE1 and content.startswith(b"Exif\0\0"):
                exif = exif or content[6:]
            frame = frame or jpeg_frame(marker, content)
    field, expected = "scan" if frame else "frame header", "a frame header and a scan"
    raise truncated(path, "the file is truncated", field, f"{size} bytes", expected)


def _jpeg_facts(path: Path, frame: tuple[int, int, int, int], exif: bytes, size: int) -> Facts:
    bits, height, width, samples = frame
    if samples not in (1, 3) or bits != 8:
        raise unreadable(
            path,
            "this kind of JPEG is not supported",
            field="frame header",
            found=f"{samples} components of {bits} bits",
            expected="gray or three colours of 8 bits",
            fix="Export it again as an RGB JPEG or a TIFF.",
        )
    shape = (height, width) if samples == 1 else (height, width, 3)
    check_size(path, shape)
    check_ratio(path, prod(shape), size, ratio=JPEG_RATIO)
    check_expansion(path, prod(shape), 1, size, most=JPEG_EXPANSION)
    more = read_exif(BytesIO(exif)) if exif else {}
    return Facts(path=path, kind="jpeg", shape=shape, dtype="uint8", bits=8, encoded="JPEG", **more)


def jpeg_segments(handle: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """Yield (marker, content) of a JPEG's segments, at last its first scan without content; end at damage."""
    handle.seek(2)
    while True:
        two = handle.read(2)
        while two == b"\xff\xff":  # fill bytes may come before a marker
            two = two[1:] + handle.read(1)
        length = handle.read(2)
        if len(two) < 2 or two[0] != 0xFF or len(length) < 2:
            return
        count = 0 if two == SCAN else int.from_bytes(length) - 2
        content = handle.read(count) if count > 0 else b""
        if count < 0 or len(content) < count:
            return
        yield two[1], content
        if two == SCAN:
            return


def jpeg_frame(marker: int, content: bytes) -> tuple[int, int, int, int] | None:
    """Return (bits, height, width, components) where a segment is a frame header, else None."""
    if not 0xC0 <= marker <= 0xCF or marker in (0xC4, 0xC8, 0xCC) or len(content) < 6:
        return None
    bits, height, width, components = struct.unpack_from(">BHHB", content)
    return bits, height, width, components


def jpeg_size(data: bytes) -> tuple[int, int]:
    """Return the samples and scans that a strip of JPEG declares; 0 samples without a header.

    >>> jpeg_size(bytes.fromhex("ffd8 ffc0 000b 08 0010 0020 01 011100"))
    (512, 0)
    """
    frames = (jpeg_frame(*segment) for segment in jpeg_segments(BytesIO(data)))
    samples = max((prod(frame[1:]) for frame in frames if frame), default=0)
    return samples if data.startswith(b"\xff\xd8") else 0, data.count(SCAN)
