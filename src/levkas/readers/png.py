"""PNG captures: samples as stored, alpha and colour profiles left aside."""

from __future__ import annotations

import struct
from io import BytesIO
from math import prod
from pathlib import Path
from typing import Any

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

SIGNATURE = b"\x89PNG\r\n\x1a\n"
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
        handle.seek(len(SIGNATURE))
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
