"""Strips and tiles of a DNG, checked before LibRaw sees them: one that it cannot start reads as zeros."""

from __future__ import annotations

import struct
from math import ceil
from pathlib import Path
from typing import BinaryIO

from levkas.readers.facts import COPY_AGAIN, unreadable

WIDTH, LENGTH, COMPRESSION, COLOURS, SAMPLES = 256, 257, 259, 262, 277
STRIPS, STRIP_ROWS, STRIP_BYTES = 273, 278, 279
TILE_WIDTH, TILE_LENGTH, TILES, TILE_BYTES = 322, 323, 324, 325
INNER, VERSION = 330, 50706  # directories within, and what makes a TIFF a DNG
LOSSLESS_JPEG, MOSAIC = 7, 32803
FRAMES = (0xC0, 0xC1, 0xC3)
"""Markers of JPEG frames that LibRaw decodes in a mosaic."""
SIZES = {1: "B", 3: "H", 4: "I", 13: "I"}
"""Types of tags that count: bytes, numbers of two and four bytes, and places of directories."""
MOST_DIRECTORIES, MOST_TAGS, MOST_PARTS, MOST_MARKERS = 16, 4096, 1 << 16, 64
WANTED = frozenset((
    WIDTH, LENGTH, COMPRESSION, COLOURS, SAMPLES, STRIPS, STRIP_ROWS, STRIP_BYTES, TILE_WIDTH, TILE_LENGTH,
    TILES, TILE_BYTES, INNER, VERSION,
))  # fmt: skip
Tags = dict[int, tuple[int, ...]]


def check_parts(path: Path) -> None:
    """Refuse a DNG of lossless JPEG whose mosaic lacks a strip or tile; what is none is passed over.

    LibRaw leaves zeros where a part is no JPEG; of other compressions it complains itself.

    Raises
    ------
    UnreadableCapture
        ``E_TRUNCATED`` where a part is missing, reaches past the end or does not begin as it should.
    """
    with path.open("rb") as handle:
        size = handle.seek(0, 2)
        handle.seek(0)
        head = handle.read(8)
        order = {b"II*\0": "<", b"MM\0*": ">"}.get(head[:4])
        if order is None or len(head) < 8:
            return
        found = _directories(handle, order, struct.unpack(order + "I", head[4:])[0])
        if not any(VERSION in tags for tags in found):
            return
        for tags in found:
            if tags.get(COLOURS) == (MOSAIC,) and tags.get(COMPRESSION) == (LOSSLESS_JPEG,):
                _check_mosaic(path, handle, tags, size)


def _directories(handle: BinaryIO, order: str, first: int) -> list[Tags]:
    """Return the tags of all directories, those within others too; each place is gone to once."""
    left, seen = [first], set[int]()
    found: list[Tags] = []
    while left and len(found) < MOST_DIRECTORIES:
        at = left.pop(0)
        if at in seen or not at:
            continue
        seen.add(at)
        tags, following = _tags(handle, order, at)
        found.append(tags)
        left += [following, *tags.get(INNER, ())[:MOST_DIRECTORIES]]
    return found


def _tags(handle: BinaryIO, order: str, at: int) -> tuple[Tags, int]:
    """Return the whole numbers of a directory by their tags, and where the next directory is."""
    handle.seek(at)
    data = handle.read(2)
    count = min(struct.unpack(order + "H", data)[0] if len(data) == 2 else 0, MOST_TAGS)
    data = handle.read(12 * count + 4)
    tags: Tags = {}
    for start in range(0, min(12 * count, len(data) - 11), 12):
        tag, kind, many = struct.unpack_from(order + "HHI", data, start)
        if tag not in WANTED or tag in tags or kind not in SIZES or many > MOST_PARTS:
            continue
        form = f"{order}{many}{SIZES[kind]}"
        values = data[start + 8 : start + 12]
        if struct.calcsize(form) > 4:
            handle.seek(struct.unpack(order + "I", values)[0])
            values = handle.read(struct.calcsize(form))
        if len(values) >= struct.calcsize(form):
            tags[tag] = struct.unpack_from(form, values)
    last = data[12 * count : 12 * count + 4]
    return tags, struct.unpack(order + "I", last)[0] if len(last) == 4 else 0


def _check_mosaic(path: Path, handle: BinaryIO, tags: Tags, size: int) -> None:
    def one(tag: int, default: int) -> int:
        return (tags.get(tag) or (default,))[0]

    width, length = one(WIDTH, 0), one(LENGTH, 0)
    tiled = TILES in tags
    across = one(TILE_WIDTH, 0) if tiled else width
    down = one(TILE_LENGTH, 0) if tiled else min(one(STRIP_ROWS, length), length)
    starts = tags.get(TILES if tiled else STRIPS, ())
    counts = tags.get(TILE_BYTES if tiled else STRIP_BYTES, ())
    if min(width, length, across, down) < 1:
        raise _lacking(
            path, f"parts of {across} x {down} in {width} x {length} pixels", "sizes > 0"
        )
    expected = ceil(width / across) * ceil(length / down)
    there = sum(s > 0 and c > 0 for s, c in zip(starts, counts, strict=False))
    if there < max(expected, len(starts)):
        raise _lacking(path, f"{there} with data", f"{max(expected, len(starts))}")
    end = max(s + c for s, c in zip(starts, counts, strict=False))
    if max(end, sum(counts)) > size:
        raise _lacking(path, f"{size} bytes", f"at least {max(end, sum(counts))} bytes")
    for number, (start, count) in enumerate(zip(starts, counts, strict=False)):
        left = length - number // ceil(width / across) * down
        least = across * (down if tiled else min(down, left)) * one(SAMPLES, 1)
        if (found := _samples(handle, start, start + count)) < least:
            raise _lacking(path, f"{found} samples in part {number}", f"{least} in a JPEG")


def _samples(handle: BinaryIO, start: int, end: int) -> int:
    """Return how many samples a JPEG says that it has; 0 for what is none."""
    handle.seek(start)
    found = 0
    if handle.read(2) != b"\xff\xd8":
        return 0
    for _ in range(MOST_MARKERS):
        head = handle.read(4)
        if handle.tell() > end or len(head) < 4 or head[0] != 0xFF:
            return 0
        body = handle.read(struct.unpack(">H", head[2:])[0] - 2 if head[2:] > b"\0\2" else 0)
        if head[1] in FRAMES and len(body) >= 6:
            bits, down, across, channels = struct.unpack_from(">BHHB", body)
            found = down * across * channels if 2 <= bits <= 16 else 0
        if head[1] == 0xDA:
            return found
    return 0


def _lacking(path: Path, found: str, expected: str) -> Exception:
    return unreadable(
        path,
        "a strip or tile of the camera raw is not there",
        code="E_TRUNCATED",
        field="offsets and byte counts",
        found=found,
        expected=expected,
        fix=COPY_AGAIN,
    )
