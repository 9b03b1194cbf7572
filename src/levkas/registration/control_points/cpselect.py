"""Points of MATLAB's Control Point Selection Tool (`cpselect`), in a MAT file of level 5.

Either ``movingPoints`` and ``fixedPoints`` (n × 2; before R2012b ``input_points`` and
``base_points``), or the structure ``cpstruct`` of the whole tool, whose predicted points are left out.
Intrinsic coordinates: x right, y down, the centre of the first pixel at (1, 1).
Sources: MathWorks' documentation of `cpselect`, `cpstruct2pairs` and "Export Control Points to the
Workspace"; "MAT-File Format", level 5, for the elements.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from math import prod
from typing import Any

import numpy as np

from levkas.registration.control_points.points import (
    ControlPoints,
    from_origin,
    to_origin,
    unreadable,
)

NAMES = (("fixedPoints", "movingPoints"), ("base_points", "input_points"))
HEADER = b"MATLAB 5.0 MAT-file, written by Levkas"
#: Bytes of all variables, and how deep one may lie in others.
LARGEST_CONTENT, DEEPEST = 64 << 20, 8
#: Types of elements, of stored numbers and text, and classes of arrays, by their numbers in the format.
COMPRESSED, MATRIX = 15, 14
TYPES = {
    1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8",
}  # fmt: skip
TEXTS = {2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
CELL, STRUCTURE, CHARACTERS = 1, 2, 4
NUMERIC = range(6, 16)


def recognises(data: bytes) -> bool:
    """Tell whether it is a MAT file of level 5 (or of 7.3, which is refused when read)."""
    return data[:6] == b"MATLAB" or data[:8] == b"\x89HDF\r\n\x1a\n"


def read(data: bytes) -> ControlPoints:
    """Read exported points, or the structure of the tool; moving is the target, fixed the reference."""
    if data[:8] == b"\x89HDF\r\n\x1a\n" or data.startswith(b"MATLAB 7.3"):
        raise unreadable("a MAT file of version 7.3", "level 5: save(file, '-v7')")
    variables = read_variables(data)
    for fixed, moving in NAMES:
        if fixed in variables and moving in variables:
            return ControlPoints(
                _places(variables[fixed], fixed),
                _places(variables[moving], moving),
                names=_names(variables.get("names")),
                weights=_switch(variables, "weights"),
                enabled=_switch(variables, "enabled"),
                check=_switch(variables, "check"),
            )
    for value in variables.values():
        if isinstance(value, dict) and "inputBasePairs" in value:
            return _tool(value)
    raise unreadable(", ".join(variables)[:80] or "no variables", "movingPoints and fixedPoints")


def _places(value: Any, name: str) -> np.ndarray:
    points = _numbers(value, name)
    if points.size and (points.ndim != 2 or points.shape[1] != 2):
        raise unreadable(f"{name} of {points.shape}", "n rows of x, y")
    return from_origin(points, "one")


def _switch(variables: dict[str, Any], name: str) -> np.ndarray | None:
    return _numbers(variables[name], name) if name in variables else None


def _names(value: Any) -> tuple[str, ...]:
    return tuple(map(str, value)) if isinstance(value, list) else ()


def _numbers(value: Any, name: str) -> np.ndarray:
    if not isinstance(value, np.ndarray):
        raise unreadable(f"{name} is {type(value).__name__}", "numbers")
    return value


def _tool(tool: dict[str, Any]) -> ControlPoints:
    """Valid pairs of a cpstruct: those of `inputBasePairs` that no one predicted."""
    moving, fixed = (_places(tool.get(k), k) for k in ("inputPoints", "basePoints"))
    pairs = _numbers(tool["inputBasePairs"], "inputBasePairs")
    if pairs.size % 2 or not np.isfinite(pairs).all():
        raise unreadable(f"inputBasePairs of {pairs.shape}", "n rows of two numbers")
    keep = [
        (int(i) - 1, int(b) - 1)
        for i, b in pairs.reshape(-1, 2)
        if 1 <= i <= len(moving) and 1 <= b <= len(fixed)
    ]
    guessed = [_marked(tool.get(k)) for k in ("isInputPredicted", "isBasePredicted")]
    keep = [(i, b) for i, b in keep if i not in guessed[0] and b not in guessed[1]]
    return ControlPoints([fixed[b] for _, b in keep], [moving[i] for i, _ in keep])


def _marked(value: Any) -> set[int]:
    return set(np.flatnonzero(value)) if isinstance(value, np.ndarray) else set()


def write(points: ControlPoints) -> tuple[bytes, ...]:
    """Write `movingPoints` and `fixedPoints`, with names, weights and switches beside them."""
    from scipy.io import savemat

    names = np.empty((len(points), 1), object)
    names[:, 0] = points.names
    stream = io.BytesIO()
    savemat(
        stream,
        {
            "movingPoints": to_origin(points.target, "one"),
            "fixedPoints": to_origin(points.reference, "one"),
            "names": names,
            "weights": points.weights[:, None],
            "enabled": points.enabled[:, None],
            "check": points.check[:, None],
        },
    )
    return (HEADER.ljust(116) + stream.getvalue()[116:],)  # scipy writes the time of day there


# --- variables of a MAT file, each length checked


def read_variables(data: bytes) -> dict[str, Any]:
    """Return the variables of a file by their names.

    Numbers become arrays, text a str, cells a list in MATLAB's order, a structure of one element a dict; what
    else there is becomes None. scipy's reader ends the whole process on some damaged files (a segmentation
    fault, seen with 1.15), so that files of other people are read here.

    Raises
    ------
    PointsRefused
        Where a length does not fit, or there is more than `LARGEST_CONTENT` bytes of content.
    """
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    if order is None:
        raise unreadable("no byte order mark", "a MAT file of level 5")
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
            raise unreadable("a truncated variable", "a whole MAT file")
        yield kind, data[start : start + size]
        at += step
    if any(data[at:]):
        raise unreadable("a truncated variable", "a whole MAT file")


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
