"""The least of HDF5 that a MAT-file of version 7.3 needs: a root group of contiguous arrays.

After the HDF5 File Format Specification 3.0: superblock 2, object headers 2, links in the root's own
header, checksums by Jenkins' lookup3. No HDF5 library is needed, and the bytes are always the same.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from levkas.core.files import replacing

USER_BLOCK = 512
"""MATLAB's own header stands before the HDF5 file; addresses count from behind it."""
MATLAB = b"MATLAB 7.3 MAT-file, written by levkas"
NOWHERE = 0xFFFFFFFFFFFFFFFF
FLOATS = {
    np.dtype("<f4"): (b"single", 31, (0, 32, 23, 8, 0, 23, 127)),
    np.dtype("<f8"): (b"double", 63, (0, 64, 52, 11, 0, 52, 1023)),
}
"""MATLAB's name, place of the sign, and places and sizes of exponent and mantissa."""
LINK_INFO, GROUP_INFO, LINK, DATASPACE, DATATYPE, FILL, LAYOUT, ATTRIBUTE = (
    *(0x02, 0x0A, 0x06, 0x01, 0x03, 0x05, 0x08, 0x0C),
)


@dataclass(frozen=True)
class Variable:
    """One array as MATLAB sees it: its size in MATLAB's order, and its numbers, first index fastest.

    Parameters
    ----------
    size : tuple of int
    dtype : "<f4" or "<f8"
    blocks : iterable of bytes-like
        Together all numbers.
    """

    size: tuple[int, ...]
    dtype: np.dtype
    blocks: Iterable[bytes | memoryview]

    @property
    def bytes(self) -> int:
        """Size of the numbers."""
        return int(np.prod(self.size)) * self.dtype.itemsize


def write_mat73(path: Path, variables: Mapping[str, Variable]) -> None:
    """Write a MAT-file of version 7.3; raises WriteRefused.

    Notes
    -----
    Layout: user block, superblock (48 bytes), header of the root, headers of the arrays, numbers.
    """
    headers = {name: _array_header(v, 0) for name, v in variables.items()}
    place = 48 + len(_root_header(dict.fromkeys(variables, 0)))
    homes, numbers = {}, {}
    for name in variables:
        homes[name], place = place, place + len(headers[name])
    for name, variable in variables.items():
        place = -(-place // 8) * 8
        numbers[name], place = place, place + variable.bytes
    with replacing(path, bytes_needed=USER_BLOCK + place) as handle:
        handle.write(MATLAB.ljust(116) + bytes(8) + b"\x00\x02IM")
        handle.write(bytes(USER_BLOCK - 128) + _superblock(USER_BLOCK + place))
        handle.write(_root_header(homes))
        for name, variable in variables.items():
            handle.write(_array_header(variable, numbers[name]))
        for name, variable in variables.items():
            handle.write(bytes(USER_BLOCK + numbers[name] - handle.tell()))
            for block in variable.blocks:
                handle.write(block)


def _superblock(end: int) -> bytes:
    data = b"\x89HDF\r\n\x1a\n" + bytes([2, 8, 8, 0])
    data += struct.pack("<QQQQ", USER_BLOCK, NOWHERE, end, 48)
    return data + struct.pack("<I", lookup3(data))


def _root_header(homes: Mapping[str, int]) -> bytes:
    messages = [
        (LINK_INFO, bytes([0, 0]) + struct.pack("<QQ", NOWHERE, NOWHERE)),
        (GROUP_INFO, bytes([0, 0])),
    ]
    for name, home in homes.items():
        label = name.encode("ascii")
        messages.append((LINK, bytes([1, 0, len(label)]) + label + struct.pack("<Q", home)))
    return _header(messages)


def _array_header(variable: Variable, place: int) -> bytes:
    matlab, sign, layout = FLOATS[variable.dtype]
    # Its dimensions are MATLAB's reversed: there the last index is fastest.
    size = struct.pack(f"<{len(variable.size)}Q", *reversed(variable.size))
    number = bytes([0x11, 0x20, sign, 0]) + struct.pack("<I", variable.dtype.itemsize)
    number += struct.pack("<HHBBBBI", *layout)
    text = bytes([0x13, 0, 0, 0]) + struct.pack("<I", len(matlab))
    scalar = bytes([2, 0, 0, 0])
    name = b"MATLAB_class\0"
    attribute = bytes([3, 0]) + struct.pack("<HHHB", len(name), len(text), len(scalar), 0)
    return _header(
        [
            (DATASPACE, bytes([2, len(variable.size), 0, 1]) + size),
            (DATATYPE, number),
            (FILL, bytes([3, 0x0A])),
            (LAYOUT, bytes([3, 1]) + struct.pack("<QQ", place, variable.bytes)),
            (ATTRIBUTE, attribute + name + text + scalar + matlab),
        ]
    )


def _header(messages: Iterable[tuple[int, bytes]]) -> bytes:
    body = b"".join(struct.pack("<BHB", kind, len(data), 0) + data for kind, data in messages)
    data = b"OHDR" + bytes([2, 2]) + struct.pack("<I", len(body)) + body
    return data + struct.pack("<I", lookup3(data))


def lookup3(data: bytes) -> int:
    """Return Bob Jenkins' lookup3 hash (hashlittle, initial value 0), 32 bits.

    Examples
    --------
    >>> hex(lookup3(b"")), hex(lookup3(b"Four score and seven years ago"))
    ('0xdeadbeef', '0x17770551')
    """
    a = b = c = (0xDEADBEEF + len(data)) & 0xFFFFFFFF
    last = max(0, (len(data) - 1) // 12 * 12)
    for at in range(0, last, 12):
        x, y, z = struct.unpack_from("<III", data, at)
        a, b, c = _mix((a + x) & 0xFFFFFFFF, (b + y) & 0xFFFFFFFF, (c + z) & 0xFFFFFFFF)
    if not data:
        return c
    x, y, z = struct.unpack("<III", data[last:].ljust(12, b"\0"))
    return _finish((a + x) & 0xFFFFFFFF, (b + y) & 0xFFFFFFFF, (c + z) & 0xFFFFFFFF)


def _turned(value: int, bits: int) -> int:
    return ((value << bits) | (value >> (32 - bits))) & 0xFFFFFFFF


def _mix(a: int, b: int, c: int) -> tuple[int, int, int]:
    for bits in (4, 6, 8, 16, 19, 4):
        a = ((a - c) & 0xFFFFFFFF) ^ _turned(c, bits)
        c = (c + b) & 0xFFFFFFFF
        a, b, c = b, c, a
    return a, b, c


def _finish(a: int, b: int, c: int) -> int:
    for bits in (14, 11, 25, 16, 4, 14, 24):
        c = ((c ^ b) - _turned(b, bits)) & 0xFFFFFFFF
        a, b, c = b, c, a
    return b
