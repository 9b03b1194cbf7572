"""JPEG 2000 captures, ISO/IEC 15444-1: .jp2 with its boxes, and a codestream by itself."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from math import prod
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from levkas.readers.encoding import LONGEST_PROFILE, has_curve
from levkas.readers.exif import read_exif
from levkas.readers.facts import (
    Facts,
    check_expansion,
    check_memory,
    check_size,
    decoding,
    truncated,
    unreadable,
)
from levkas.readers.images import ALPHA

JP2 = b"\0\0\0\x0cjP  \r\n\x87\n"
CODESTREAM = b"\xff\x4f\xff\x51"
"""Start of the codestream, and of its size."""
END = b"\xff\xd9"
EXIF = b"JpgTiffExif->JP2"
"""Of a box `uuid`."""
COLOURS = {16: "sRGB", 17: "sRGB"}
"""Tone curves by EnumCS; 17 is grey."""
MOST_BOXES = 10_000
MOST_TILES = 10_000
"""Tiles of a codestream: the decoder holds a record of each. 10,000 of 256 x 256 px are 655 Mpx."""
LONGEST_BOX = LONGEST_PROFILE


@dataclass(frozen=True)
class _Layout:
    """What the boxes of a file hold: where its codestream lies, its colours, its Exif, its size in bytes."""

    start: int
    end: int
    colour: bytes = b""
    exif: bytes = b""
    palette: bool = False


def read_jpeg2000_facts(path: Path) -> Facts:
    """Return size, depth, tone curve and, where a box has them, exposure and date; no pixel is decoded.

    Raises
    ------
    UnreadableCapture
        Where the file is cut short or damaged, or holds what is no photograph: signed or unlike components, a palette.
    """
    with decoding(path, "JPEG 2000"):
        return _open(path)[0]


def read_jpeg2000(path: Path) -> np.ndarray:
    """Decode a JPEG 2000, (h, w) or (h, w, 3) red, green, blue, uint8 or uint16.

    Damage inside the coded data cannot be told from an image: there is no checksum. What is cut short is refused.
    """
    import imagecodecs

    with decoding(path, "JPEG 2000"):
        facts, layout = _open(path)
        check_memory(path, prod(facts.shape), np.dtype(facts.dtype).itemsize)
        with path.open("rb") as handle:
            handle.seek(layout.start)
            data = handle.read(layout.end - layout.start)
        if not data.endswith(END):
            message, expected = "the file is truncated", "an end-of-codestream marker"
            raise truncated(path, message, "codestream", f"{len(data)} bytes", expected)
        values = np.asarray(imagecodecs.jpeg2k_decode(data))
    if values.ndim == 3:
        values = values[..., 0] if len(facts.shape) == 2 else values[..., :3]
    if values.shape != facts.shape or values.dtype != facts.dtype:
        found = f"{values.shape} {values.dtype}"
        raise unreadable(path, "the image does not match its header", found=found)
    return np.ascontiguousarray(values)


def _open(path: Path) -> tuple[Facts, _Layout]:
    with path.open("rb") as handle:
        size = handle.seek(0, 2)
        handle.seek(0)
        whole = handle.read(len(JP2)) != JP2
        layout = _Layout(0, size) if whole else _layout(path, handle, size)
        handle.seek(layout.start)
        head = handle.read(42)
        count = int.from_bytes(head[40:42])
        parts = handle.read(3 * count)
    if not head.startswith(CODESTREAM) or len(parts) < 3 * max(count, 1):
        raise truncated(
            path, "the file is truncated", "SIZ", f"{size} bytes", "the size of the image first"
        )
    return _facts(path, layout, head, parts, size), layout


def _facts(path: Path, layout: _Layout, head: bytes, parts: bytes, size: int) -> Facts:
    right, bottom, left, top, *tile = struct.unpack_from(">8I", head, 8)
    count = len(parts) // 3
    depths, steps = set(parts[::3]), {*parts[1::3], *parts[2::3]}
    bits = max(depths) + 1
    if count > 4 or len(depths) > 1 or steps != {1} or bits > 16 or layout.palette:
        shown = "a palette" if layout.palette else f"{count} components of {bits & 127} bits"
        raise unreadable(
            path,
            "this kind of JPEG 2000 is not supported",
            field="SIZ",
            found=shown + ("" if steps == {1} else ", some of them smaller"),
            expected="grey or three colours of one depth, 1 to 16 bits without sign",
            fix="Export it again as an RGB JPEG 2000 or a TIFF.",
        )
    shape = (bottom - top, right - left) + ((3,) if count > 2 else ())
    check_size(path, shape)
    itemsize = 1 if bits <= 8 else 2
    check_expansion(path, prod(shape[:2]) * count, itemsize, size)
    if not tile[0] or not tile[1] or -(-right // tile[0]) * -(-bottom // tile[1]) > MOST_TILES:
        raise unreadable(
            path,
            "the declared size of the tiles is not plausible",
            code="E_SIZE",
            field="SIZ",
            found=f"tiles of {tile[0]} x {tile[1]} px",
            expected=f"at most {MOST_TILES} tiles",
            fix="Save it again in larger tiles, or as a TIFF.",
        )
    more: dict[str, Any] = read_exif(BytesIO(layout.exif)) if layout.exif else {}
    return Facts(
        path=path,
        kind="jpeg2000",
        shape=shape,
        dtype="uint8" if itemsize == 1 else "uint16",
        bits=bits,
        encoded=_encoded(path, layout.colour),
        notes=(ALPHA,) if count in (2, 4) else (),
        **more,
    )


def _encoded(path: Path, colour: bytes) -> str | None:
    """Return the tone curve of a box `colr`: an EnumCS, or an ICC profile."""
    if colour[:1] == b"\x01" and len(colour) >= 7:
        number = int.from_bytes(colour[3:7])
        if number not in COLOURS:
            raise unreadable(
                path,
                "this kind of JPEG 2000 is not supported",
                field="colr",
                found=f"colour space {number}",
                expected="sRGB or grey, or an ICC profile",
                fix="Export it again as an RGB JPEG 2000 or a TIFF.",
            )
        return COLOURS[number]
    return "its ICC profile" if has_curve(colour[3:]) else None


def _layout(path: Path, handle: BinaryIO, size: int) -> _Layout:
    colour = exif = b""
    palette = False
    for kind, start, end in _boxes(path, handle, 0, size):
        if kind == b"jp2h":
            for inner, first, last in _boxes(path, handle, start, end):
                palette |= inner == b"pclr"
                if inner == b"colr" and not colour:
                    colour = _content(handle, first, last)
        elif kind == b"uuid" and not exif:
            content = _content(handle, start, end)
            exif = content[16:] if content.startswith(EXIF) else b""
        elif kind == b"jp2c":
            return _Layout(start, end, colour, exif, palette)
    raise truncated(path, "the file is truncated", "jp2c", f"{size} bytes", "a codestream")


def _content(handle: BinaryIO, start: int, end: int) -> bytes:
    handle.seek(start)
    return handle.read(min(end - start, LONGEST_BOX))


def _boxes(path: Path, handle: BinaryIO, start: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Yield (type, start, end) of the content of each box between two places of a file."""
    for _ in range(MOST_BOXES):
        if start + 8 > end:
            return
        handle.seek(start)
        head = handle.read(16)
        length, first = int.from_bytes(head[:4]), start + 8
        if length == 1:
            length, first = int.from_bytes(head[8:16]), start + 16
        last = end if length == 0 else start + length
        if last < first or last > end:
            name = head[4:8].decode("latin-1")
            found = f"{end - start} of {length} bytes"
            raise truncated(path, "the file is truncated", name, found, "whole boxes")
        yield head[4:8], first, last
        start = last
