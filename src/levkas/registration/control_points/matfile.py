"""Variables of a MAT file of level 5: numbers, text, cells and structures, each length checked.

scipy's reader ends the whole process on some damaged files (a segmentation fault, seen with 1.15), so
files that other people send are read here. Numbers become arrays, text a str, cells a list in MATLAB's
order, a structure of one element a dict; what else there is becomes None.
Source: MathWorks, "MAT-File Format", level 5.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from math import prod
from typing import Any

import numpy as np

from levkas.registration.control_points.text import unreadable

LARGEST_CONTENT = 64 << 20
DEEPEST = 8
COMPRESSED, MATRIX = 15, 14
TYPES = {
    1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8",
}  # fmt: skip
TEXTS = {2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
CELL, STRUCTURE, CHARACTERS = 1, 2, 4
NUMERIC = range(6, 16)


def read_variables(data: bytes) -> dict[str, Any]:
    """Return the variables of a file by their names.

    Raises
    ------
    PointsRefused
        Where a length does not fit, or there is more than `LARGEST_CONTENT` bytes of content.
    """
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    if order is None:
        raise unreadable("no mark of the byte order", "a MAT file of level 5")
    left, found = LARGEST_CONTENT, {}
    for kind, body in _elements(data[128:], order):
        if kind == COMPRESSED:
            body = _inflate(body, left)
            left -= len(body)
            kind, body = next(_elements(body, order), (0, b""))
        if kind == MATRIX:
            name, value = _matrix(body, order, 0)
            found[name] = value
    return found


def _inflate(body: bytes, most: int) -> bytes:
    try:
        out = zlib.decompressobj().decompress(body, most + 1)
    except zlib.error as error:
        raise unreadable(str(error), "a whole MAT file") from error
    if len(out) > most:
        raise unreadable("more content", f"at most {LARGEST_CONTENT >> 20} MiB of variables")
    return out


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Yield (type, content) of the elements of `data`, one after another."""
    at = 0
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(order + "II", data, at)
        if kind >> 16:  # up to four bytes stand in the tag itself
            kind, size, start, step = kind & 0xFFFF, kind >> 16, at + 4, 8
            if size > 4:
                raise unreadable(f"{size} bytes in a small element", "at most 4")
        else:
            start, step = at + 8, 8 + size + (0 if kind == COMPRESSED else -size % 8)
        if start + size > len(data):
            raise unreadable("a variable that ends before its time", "a whole MAT file")
        yield kind, data[start : start + size]
        at += step
    if any(data[at:]):
        raise unreadable("a variable that ends before its time", "a whole MAT file")


def _matrix(data: bytes, order: str, depth: int) -> tuple[str, Any]:
    if not data:
        return "", np.zeros((0, 0))
    if depth > DEEPEST:
        raise unreadable("variables within variables", f"at most {DEEPEST} deep")
    parts = _elements(data, order)
    flags, sizes, name = (next(parts, (0, b""))[1] for _ in range(3))
    if len(flags) < 4 or len(sizes) % 4 or len(sizes) < 8:
        raise unreadable("a variable without its class or size", "a whole MAT file")
    kind = struct.unpack_from(order + "I", flags)[0] & 0xFF
    shape = struct.unpack(f"{order}{len(sizes) // 4}i", sizes)
    # No element takes less than a byte; an empty array may still have a side of any length.
    if min(shape) < 0 or max(prod(shape), *shape) > len(data):
        raise unreadable(f"a variable of {shape}", "a size that its content has")
    return name.decode("latin-1"), _value(kind, shape, parts, order, depth)


def _value(
    kind: int, shape: tuple[int, ...], parts: Iterator[tuple[int, bytes]], order: str, depth: int
) -> Any:
    if kind == CELL:
        return [_matrix(body, order, depth + 1)[1] for _, body in parts]
    if kind == STRUCTURE:
        return _structure(shape, parts, order, depth)
    stored, body = next(parts, (9, b""))
    if kind == CHARACTERS:
        endless = TEXTS.get(stored, "latin-1")
        code = endless if endless[-1] in "81" else endless + ("-le" if order == "<" else "-be")
        return body.decode(code, "replace")
    if kind not in NUMERIC or stored not in TYPES:
        return None
    values = np.frombuffer(
        body[: len(body) // int(TYPES[stored][1]) * int(TYPES[stored][1])], order + TYPES[stored]
    )
    if values.size != prod(shape):
        raise unreadable(f"{values.size} values", f"{prod(shape)}, as its size {shape} says")
    return values.reshape(shape, order="F").astype(float)


def _structure(
    shape: tuple[int, ...], parts: Iterator[tuple[int, bytes]], order: str, depth: int
) -> dict[str, Any] | None:
    (_, length), (_, names) = next(parts, (0, b"")), next(parts, (0, b""))
    step = struct.unpack_from(order + "i", length)[0] if len(length) >= 4 else 0
    if step <= 0 or prod(shape) != 1:
        return None
    keys = [
        names[i : i + step].split(b"\0")[0].decode("latin-1") for i in range(0, len(names), step)
    ]
    return {
        k: _matrix(body, order, depth + 1)[1] for k, (_, body) in zip(keys, parts, strict=False)
    }
