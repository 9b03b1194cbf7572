"""RGB spaces of masters: eciRGB v2 and ProPhoto, their curves, and their ICC profiles.

Both have the white of D50, so that a profile is its primaries and one curve: ICC.1:2001-04, matrix/TRC.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

D50 = np.array([0.9642, 1.0, 0.8249])
"""White of the profile connection space, ICC.1."""
EPSILON, KAPPA = 216 / 24389, 24389 / 27
GAMMA = 461 / 256
"""Of ProPhoto, 1.8 as the u8Fixed8 of a profile holds it: pixels are encoded by what the profile states."""
ENTRIES = 4096


@dataclass(frozen=True)
class WorkingSpace:
    """An RGB space.

    Parameters
    ----------
    name : str
    primaries : (3, 2)
        Chromaticities x, y of red, green and blue.
    lightness : bool
        Whether its curve is CIE L* (eciRGB v2); else the gamma of `GAMMA`.

    Examples
    --------
    >>> SPACES["ecirgb"].encode(D50).tolist()
    [65535, 65535, 65535]
    >>> profile = SPACES["prophoto"].profile()
    >>> len(profile) == int.from_bytes(profile[:4], "big"), profile[36:40]
    (True, b'acsp')
    """

    name: str
    primaries: tuple[tuple[float, float], ...]
    lightness: bool

    @property
    def to_xyz(self) -> np.ndarray:
        """Matrix from linear RGB to XYZ under D50, (3, 3); rows sum to the white."""
        xyz = np.array([(x / y, 1.0, (1 - x - y) / y) for x, y in self.primaries]).T
        return np.asarray(xyz * np.linalg.solve(xyz, D50))

    def encode(self, xyz: np.ndarray) -> np.ndarray:
        """Encode XYZ under D50 (a perfect diffuser has Y = 1), (…, 3), as uint16; what is out of range is clipped, NaN is black."""
        linear = np.nan_to_num(np.asarray(xyz, float) @ np.linalg.inv(self.to_xyz).T)
        y = np.clip(linear, 0, 1)
        if self.lightness:
            curve = np.where(y > EPSILON, 1.16 * np.cbrt(y) - 0.16, KAPPA / 100 * y)
        else:
            curve = y ** (1 / GAMMA)
        return np.round(65535 * curve).astype(np.uint16)

    def profile(self) -> bytes:
        """Return the ICC profile, version 2, the same bytes at any time."""
        if self.lightness:
            v = np.linspace(0, 1, ENTRIES)
            y = np.where(v > 0.08, ((v + 0.16) / 1.16) ** 3, 100 / KAPPA * v)
            curve = (
                struct.pack(">4sII", b"curv", 0, ENTRIES)
                + np.round(65535 * y).astype(">u2").tobytes()
            )
        else:
            curve = struct.pack(">4sIIH", b"curv", 0, 1, round(256 * GAMMA))
        text = self.name.encode()
        described = struct.pack(">4sII", b"desc", 0, len(text) + 1) + text + bytes(1 + 8 + 3 + 67)
        columns = {
            tag: _xyz(column)
            for tag, column in zip((b"rXYZ", b"gXYZ", b"bXYZ"), self.to_xyz.T, strict=True)
        }
        tags = {
            b"desc": described,
            b"cprt": struct.pack(">4sI", b"text", 0) + b"No copyright\0",
            b"wtpt": _xyz(D50),
            **columns,
            **dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), curve),
        }
        return _pack(tags)


def _xyz(numbers: np.ndarray) -> bytes:
    return struct.pack(">4sI3i", b"XYZ ", 0, *(round(65536 * float(n)) for n in numbers))


def _pack(tags: dict[bytes, bytes]) -> bytes:
    """Return a profile of some tags; equal ones are stored once."""
    offset = 128 + 4 + 12 * len(tags)
    places: dict[bytes, int] = {}
    data = b""
    for content in tags.values():
        if content not in places:
            places[content] = offset + len(data)
            data += content + bytes(-len(content) % 4)
    table = struct.pack(">I", len(tags))
    table += b"".join(struct.pack(">4sII", tag, places[c], len(c)) for tag, c in tags.items())
    date = (2000, 1, 1, 0, 0, 0)
    head = struct.pack(
        ">I4sI4s4s4s6H4s",
        128 + len(table) + len(data),
        bytes(4),
        0x02400000,
        b"mntr",
        b"RGB ",
        b"XYZ ",
        *date,
        b"acsp",
    )
    head += bytes(28) + struct.pack(">3i", *(round(65536 * n) for n in D50))
    return head + bytes(128 - len(head)) + table + data


SPACES = {
    "ecirgb": WorkingSpace("eciRGB v2", ((0.67, 0.33), (0.21, 0.71), (0.14, 0.08)), True),
    "prophoto": WorkingSpace(
        "ProPhoto RGB", ((0.7347, 0.2653), (0.1596, 0.8404), (0.0366, 0.0001)), False
    ),
}
"""eciRGB v2: European Color Initiative, 2007; ProPhoto: ISO 22028-2 (ROMM RGB)."""
