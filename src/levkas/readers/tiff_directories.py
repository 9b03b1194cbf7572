"""Directories of a TIFF, walked before any library follows them, and which of its pages are images."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO, NamedTuple

from levkas.readers.facts import refused

MOST_PAGES = MOST_TAGS = 4096
SUBFILE_TYPE, WIDTH, LENGTH, REDUCED, MASK = 254, 256, 257, 1, 4
"""Tags NewSubfileType, ImageWidth and ImageLength, and the first one's bits for previews and masks."""
BITS = {3: 16, 4: 32, 16: 64}
"""Of a SHORT, a LONG, a LONG8."""
WAVELENGTHS = 65000
"""Tag of the first band page, or of every one, of a spectral TIFF; what stands before it is a render."""
PREVIEW = 4
"""Of the largest page: a page of a fourth of its pixels or less, half a side, is a preview or a step of a pyramid. Bands of
one camera have one size; twice or half the number separates the same pages."""


class Directory(NamedTuple):
    """Declared by one directory: NewSubfileType, size in px, and whether it lists wavelengths."""

    kind: int
    width: int
    height: int
    spectral: bool = False

    @property
    def pixels(self) -> int:
        """Number of its pixels."""
        return self.width * self.height


def images_among(directories: Sequence[Directory]) -> list[int]:
    """Return the indices of the pages that are images: no previews, pyramids or masks, and of a spectral TIFF no render.

    Pages that say so are no images, and pages of no more than a fourth of the pixels of the largest.

    >>> images_among([Directory(0, 160, 120), Directory(0, 4000, 3000), Directory(1, 2000, 1500)])
    [1]
    """
    plain = [i for i, one in enumerate(directories) if not one.kind & (REDUCED | MASK)]
    most = max((directories[i].pixels for i in plain), default=0)
    images = [i for i in plain if PREVIEW * directories[i].pixels > most] or plain
    first = next((i for i in images if directories[i].spectral), 0)
    return [i for i in images if i >= first]


def directories_of(path: Path) -> list[Directory]:
    """Return every directory in the chain; some hundred bytes a page are read.

    Raises UnreadableCapture where the chain leaves the file, or turns back on itself: a decoder would follow it for ever.
    """
    with path.open("rb") as handle:
        size = handle.seek(0, 2)
        handle.seek(0)
        order = "<" if handle.read(2) == b"II" else ">"
        big = _unpacked(path, handle, order + "H") == 43
        handle.seek(8 if big else 4)
        offset = _unpacked(path, handle, order + ("Q" if big else "I"))
        found: dict[int, Directory] = {}
        walked = 0
        while offset:
            at = f"byte {offset}"
            if offset >= size:
                raise refused(path, "cut", at, field="next directory", expected=f"below {size}")
            # Directories stand side by side: laid over one another, each costs a reader as much of the file again.
            if offset in found or walked > size:
                raise refused(path, "loop", at)
            if len(found) >= MOST_PAGES:
                raise refused(path, "pages", f"over {MOST_PAGES}", most=MOST_PAGES)
            found[offset], following = _directory(path, handle, offset, order, big)
            walked += handle.tell() - offset
            offset = following
    return list(found.values())


def _directory(
    path: Path, handle: BinaryIO, offset: int, order: str, big: bool
) -> tuple[Directory, int]:
    """Return the directory at `offset`, and where the next one is (0: none)."""
    handle.seek(offset)
    count = _unpacked(path, handle, order + ("Q" if big else "H"))
    if not 0 < count <= MOST_TAGS:
        raise refused(path, "tags", f"{count} tags", most=MOST_TAGS)
    entry = struct.Struct(order + ("HHQQ" if big else "HHII"))
    data = handle.read(count * entry.size)
    if len(data) < count * entry.size:
        raise _cut(path, handle)
    tags = {code: (form, value) for code, form, _, value in entry.iter_unpack(data)}

    def number(code: int) -> int:
        form, value = tags.get(code, (0, 0))
        room = 64 if big else 32
        wide = min(BITS.get(form, room), room)
        # A value stands left in its field: a SHORT has to be read as one.
        return int(value >> (room - wide) if order == ">" else value & ((1 << wide) - 1))

    directory = Directory(number(SUBFILE_TYPE), number(WIDTH), number(LENGTH), WAVELENGTHS in tags)
    return directory, _unpacked(path, handle, order + ("Q" if big else "I"))


def _unpacked(path: Path, handle: BinaryIO, form: str) -> int:
    data = handle.read(struct.calcsize(form))
    if len(data) < struct.calcsize(form):
        raise _cut(path, handle)
    return int(struct.unpack(form, data)[0])


def _cut(path: Path, handle: BinaryIO) -> Exception:
    found = f"{handle.seek(0, 2)} bytes"
    expected = "all tags of the page, and where the next one is"
    return refused(path, "cut", found, field="directory", expected=expected)
