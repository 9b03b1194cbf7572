"""Tone curves that files state of their codes: sRGB, a gamma, an ICC profile that is not linear."""

from __future__ import annotations

import struct
import zlib
from itertools import islice

LINEAR = 0.02
"""By which a gamma, or the middle of a curve, may differ from 1, or from a half, and count as linear."""
LONGEST_PROFILE = 4 << 20
CURVES = (b"rTRC", b"gTRC", b"bTRC", b"kTRC")


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
        curved = has_curve(profile)
        return f"the profile {name.decode('latin-1')[:60]}" if curved else None
    if b"sRGB" in chunks:
        return "sRGB"
    gamma = int.from_bytes(chunks.get(b"gAMA", b"")[:4]) / 1e5
    return f"gamma {gamma:.3g}" if gamma and abs(gamma - 1) > LINEAR else None


def has_curve(profile: bytes) -> bool:
    """Whether an ICC profile has a tone curve that is not a straight line; not of one without any.

    >>> has_curve(b"")
    False
    """
    if len(profile) < 132:
        return False
    (count,) = struct.unpack_from(">I", profile, 128)
    for at in islice(range(132, len(profile) - 11, 12), min(count, 100)):
        name, start, size = struct.unpack_from(">4sII", profile, at)
        if name in CURVES and _is_curved(profile[start : start + size]):
            return True
    return False


def _is_curved(curve: bytes) -> bool:
    """Whether a `curv` or `para` element is not a straight line, ICC.1:2010, 10.5 and 10.15."""
    kind, rest = curve[:4], curve[8:]
    if kind == b"para" and len(rest) >= 8:
        (gamma,) = struct.unpack_from(">i", rest, 4)
        return abs(gamma / 65536 - 1) > LINEAR
    if kind != b"curv" or len(rest) < 4:
        return False
    (count,) = struct.unpack_from(">I", rest)
    table = rest[4 : 4 + 2 * count]
    if count == 1 and len(table) == 2:
        return abs(int.from_bytes(table) / 256 - 1) > LINEAR
    if count < 3 or len(table) < 2 * count:
        return False
    middle = (count - 1) // 2
    value = int.from_bytes(table[2 * middle : 2 * middle + 2]) / 65535
    return abs(value - middle / (count - 1)) > LINEAR
