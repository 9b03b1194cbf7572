"""PNG and JPEG captures: what their headers state, and the tone curves of pictures; pixels are decoded by `decoder`."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from math import prod
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from levkas.readers.decoder import decode
from levkas.readers.exif import read_exif
from levkas.readers.facts import (
    Facts,
    check_expansion,
    check_memory,
    check_size,
    decoding,
    refused,
    unreadable,
)

PNG = b"\x89PNG\r\n\x1a\n"
PNG_SAMPLES = {0: 1, 2: 3, 3: 3, 4: 1, 6: 3}
"""Samples that count, by colour type: palettes become colours, alpha is dropped."""
WITH_ALPHA = (4, 6)
ALPHA = "an alpha channel (transparency) is not used"
LONGEST_CHUNK = 64 << 20
READ_CHUNKS = (b"IHDR", b"sBIT", b"eXIf", b"gAMA", b"sRGB", b"iCCP")
JPEG = b"\xff\xd8\xff"
SCAN = b"\xff\xda"
JPEG_EXPANSION = 150
"""Bytes of a large JPEG from one stored byte; one even colour is 200 to 1, a painting before black less than 100."""
LINEAR = 0.02
"""By which a gamma, or the middle of a curve, may differ from 1, or from a half, and count as linear."""
LONGEST_PROFILE = 4 << 20
CURVES = (b"rTRC", b"gTRC", b"bTRC", b"kTRC")


def read_png(path: Path) -> np.ndarray:
    """Decode a PNG, (h, w) or (h, w, 3), uint8 or uint16; every chunk's checksum is verified."""
    return _decoded(path, read_png_facts(path))


def read_jpeg(path: Path) -> np.ndarray:
    """Decode a JPEG, (h, w) or (h, w, 3) red, green, blue, uint8; what is cut short is refused.

    Damage inside the coded data cannot be distinguished from an image: JPEG has no checksum.
    """
    with decoding(path, "JPEG"):
        facts, scan = _jpeg_header(path)
    return _decoded(path, facts, scan=scan)


def _decoded(path: Path, facts: Facts, **request: Any) -> np.ndarray:
    samples, itemsize = prod(facts.shape), np.dtype(facts.dtype).itemsize
    check_memory(path, samples, itemsize)
    # Four samples a pixel, where there is alpha or one is grey.
    needed = 4 * itemsize * prod(facts.shape[:2])
    _, values = decode(path, facts.kind, expected="a whole image", needed=needed, **request)
    if values.ndim == 3:
        values = values[..., 0] if len(facts.shape) == 2 else values[..., :3]
    if values.shape != facts.shape or values.dtype != facts.dtype:
        found = f"{values.shape} {values.dtype}"
        raise unreadable(path, "the image does not match its header", found=found)
    return np.ascontiguousarray(values)


# --- PNG --------------------------------------------------------------------------------------


def read_png_facts(path: Path) -> Facts:
    """Return size, depth and, where an eXIf chunk has them, exposure and date; no pixel is decoded.

    sBIT holds the bits of a sample before it was scaled to the stored depth, so the sensor is full at
    (2^sBIT − 1) · 2^(depth − sBIT): 65520, not 4095, for 12 bits in 16.
    """
    with decoding(path, "PNG"):
        head, chunks, stored = _png_chunks(path)
    width, height, depth, colour = struct.unpack(">IIBB", head[:10])
    if colour not in PNG_SAMPLES or depth not in (1, 2, 4, 8, 16):
        raise refused(path, "PNG", f"{depth} bits, type {colour}")
    samples, itemsize = PNG_SAMPLES[colour], max(depth // 8, 1)
    shape = (height, width) if samples == 1 else (height, width, 3)
    check_size(path, shape)
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


def _png_chunks(path: Path) -> tuple[bytes, dict[bytes, bytes], int]:
    """Return the header, the small chunks before the first pixel, and the size of the file."""
    wanted: dict[bytes, bytes] = {}
    with path.open("rb") as handle:
        size = handle.seek(0, 2)
        handle.seek(len(PNG))
        head = b""
        while len(start := handle.read(8)) == 8:
            length, name = struct.unpack(">I4s", start)
            if name == b"IDAT" and head:
                return head, wanted, size
            if (name == b"IHDR") != (not head) or handle.tell() + length > size:
                break
            if name in READ_CHUNKS and length < LONGEST_CHUNK:
                wanted[name] = handle.read(length)
                head = wanted[b"IHDR"] if len(wanted[b"IHDR"]) == 13 else b""
                length = 0
            handle.seek(length + 4, 1)
    field, expected = "IDAT" if head else "IHDR", "an IHDR chunk first, then pixels in IDAT"
    raise refused(path, "cut", f"{size} bytes", field=field, expected=expected)


# --- JPEG -------------------------------------------------------------------------------------


def read_jpeg_facts(path: Path) -> Facts:
    """Return size and EXIF facts of a JPEG; no pixel is decoded."""
    with decoding(path, "JPEG"):
        return _jpeg_header(path)[0]


def _jpeg_header(path: Path) -> tuple[Facts, int]:
    """Return the facts and where the first scan begins."""
    exif, frame = b"", None
    with path.open("rb") as handle:
        size = handle.seek(0, 2)
        for marker, content in jpeg_segments(handle):
            if marker == SCAN[1] and frame:
                return _jpeg_facts(path, frame, exif, size), handle.tell()
            if marker == 0xE1 and content.startswith(b"Exif\0\0"):
                exif = exif or content[6:]
            frame = frame or jpeg_frame(marker, content)
    field, expected = "scan" if frame else "frame header", "a frame header and a scan"
    raise refused(path, "cut", f"{size} bytes", field=field, expected=expected)


def _jpeg_facts(path: Path, frame: tuple[int, int, int, int], exif: bytes, size: int) -> Facts:
    bits, height, width, samples = frame
    if samples not in (1, 3) or bits != 8:
        raise refused(path, "JPEG", f"{samples} components of {bits} bits")
    shape = (height, width) if samples == 1 else (height, width, 3)
    check_size(path, shape)
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


# --- tone curves ------------------------------------------------------------------------------


def gamma_of_png(chunks: dict[bytes, bytes]) -> str | None:
    """Return the tone curve that the chunks of a PNG state, None where it is linear or they state none.

    >>> gamma_of_png({b"gAMA": (45455).to_bytes(4)}), gamma_of_png({b"gAMA": (100000).to_bytes(4)})
    ('gamma 0.455', None)
    """
    if b"iCCP" in chunks:
        name, _, packed = chunks[b"iCCP"].partition(b"\0")
        try:
            profile = zlib.decompressobj().decompress(packed[1:], LONGEST_PROFILE)
        except zlib.error:
            profile = b""
        return f"the profile {name.decode('latin-1')[:60]}" if has_curve(profile) else None
    if b"sRGB" in chunks:
        return "sRGB"
    gamma = int.from_bytes(chunks.get(b"gAMA", b"")[:4]) / 1e5
    return f"gamma {gamma:.3g}" if gamma and abs(gamma - 1) > LINEAR else None


def has_curve(profile: bytes) -> bool:
    """Whether an ICC profile has a tone curve that is not a straight line; not of one without any."""
    count = int.from_bytes(profile[128:132])
    for at in range(132, min(len(profile) - 11, 132 + 12 * min(count, 100)), 12):
        name, start, size = struct.unpack_from(">4sII", profile, at)
        if name in CURVES and _is_curved(profile[start : start + size]):
            return True
    return False


def _is_curved(curve: bytes) -> bool:
    """Whether a `curv` or `para` element is not a straight line, ICC.1:2010, 10.5 and 10.15."""
    kind, count, rest = curve[:4], int.from_bytes(curve[8:12]), curve[12:]
    if kind == b"para":
        return abs(int.from_bytes(rest[:4], signed=True) / 65536 - 1) > LINEAR
    if kind != b"curv" or len(rest) < 2 * count:
        return False
    if count == 1:
        return abs(int.from_bytes(rest[:2]) / 256 - 1) > LINEAR
    middle = (count - 1) // 2
    value = int.from_bytes(rest[2 * middle : 2 * middle + 2]) / 65535
    return count > 2 and abs(value - middle / (count - 1)) > LINEAR
