"""Compressions of TIFF strips, and the sizes that strips say of themselves.

A strip of JPEG, JPEG 2000 or JPEG XL is a whole image file with a size of its own, and decoders
believe that one: 300 bytes in a page of 8 x 8 pixels can ask for 4 GB.
"""

from __future__ import annotations

from math import prod
from pathlib import Path
from typing import Any

from levkas.readers.facts import COPY_AGAIN, unreadable

JPEG = (6, 7, 33007)
JPEG_2000 = (33003, 33005, 34712)
JPEG_XL = (50002, 52546)
OWN_SIZE = (*JPEG, *JPEG_2000, *JPEG_XL)
CODECS = {
    1: "none", 5: "LZW", 8: "deflate", 32946: "deflate", 32773: "PackBits", 34925: "LZMA",
    34926: "Zstandard", 50000: "Zstandard", **dict.fromkeys(JPEG, "JPEG"),
    **dict.fromkeys(JPEG_2000, "JPEG 2000"), **dict.fromkeys(JPEG_XL, "JPEG XL"),
}  # fmt: skip
"""Codes of the tag Compression that are read."""
SLACK = 4096
"""Bytes by which a strip may exceed twice its pixels: tables of JPEG, tails of writers."""
MOST_SCANS = 64
JXL_RATIOS = ((1, 1), (12, 10), (4, 3), (3, 2), (16, 9), (5, 4), (2, 1))
"""Width over height in the short form of a JPEG XL size."""


def check_frames(path: Path, tiff: Any, page: Any) -> None:
    """Refuse strips that say another size than their page does.

    Raises
    ------
    UnreadableCapture
        ``E_SIZE``, before any strip is decoded.
    """
    most = 4 * prod(page.chunks) + SLACK
    for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True):
        tiff.filehandle.seek(offset)
        samples, scans = frame_of(tiff.filehandle.read(count), page.compression)
        if samples > most or scans > MOST_SCANS:
            raise unreadable(
                path,
                "a strip or tile says another size than its page",
                code="E_SIZE",
                field="StripByteCounts",
                found=f"{samples} samples in {scans} scans",
                expected=f"at most {most} samples in {MOST_SCANS} scans",
                fix=COPY_AGAIN,
            )


def frame_of(data: bytes, compression: int) -> tuple[int, int]:
    """Return the samples and scans that a strip declares; 0 samples where it has no header.

    Examples
    --------
    >>> frame_of(bytes.fromhex("ffd8 ffc0 000b 08 0010 0020 01 011100"), 7)
    (512, 0)
    >>> frame_of(bytes.fromhex("ff0a 4f 00"), 50002)
    (4096, 1)
    """
    if compression in JPEG_2000:
        return _jpeg_2000(data), 1
    if compression in JPEG_XL:
        return _jpeg_xl(data), 1
    at, samples = 2, 0
    while at + 10 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4])
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = (int.from_bytes(data[at + i : at + i + 2]) for i in (5, 7))
            samples = max(samples, height * width * max(1, data[at + 9]))
        at += 1 if marker == 0xFF else 2 + length
    return samples, data.count(b"\xff\xda")


def _jpeg_2000(data: bytes) -> int:
    start = data.find(b"\xff\x4f\xff\x51")
    if start < 0 or len(data) < start + 42:
        return 0
    numbers = [int.from_bytes(data[start + i : start + i + 4]) for i in (8, 12, 16, 20)]
    channels = int.from_bytes(data[start + 40 : start + 42])
    return max(0, numbers[0] - numbers[2]) * max(0, numbers[1] - numbers[3]) * channels


def _jpeg_xl(data: bytes) -> int:
    """Samples of one channel, from the SizeHeader of ISO/IEC 18181-1."""
    start = data.find(b"\xff\x0a")
    if start < 0:
        return 0
    bits, at = int.from_bytes(data[start + 2 : start + 14], "little"), 0

    def take(count: int) -> int:
        nonlocal at
        value = (bits >> at) & ((1 << count) - 1)
        at += count
        return value

    small = take(1)

    def side() -> int:
        return 8 * (take(5) + 1) if small else 1 + take((9, 13, 18, 30)[take(2)])

    height = side()
    ratio = take(3)
    if not ratio:
        return height * side()
    across, down = JXL_RATIOS[ratio - 1]
    return height * (height * across // down)
