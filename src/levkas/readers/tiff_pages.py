"""The chain of directories of a TIFF, walked before any library follows it."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

from levkas.readers.facts import COPY_AGAIN, unreadable

MOST_PAGES = 4096
MOST_TAGS = 4096
SUBFILE_TYPE = 254  # its value says whether a page is a preview or a mask
REDUCED, MASK = 1, 4


def full_pages(path: Path) -> list[int]:
    """Return which pages of a TIFF are images, as indices into its chain of directories.

    Previews, pyramid levels and masks are left out. The walk reads a few bytes a page.

    Raises
    ------
    UnreadableCapture
        As `kinds_of_pages`, and where there is no image.
    """
    kinds = kinds_of_pages(path)
    pages = [i for i, kind in enumerate(kinds) if not kind & (REDUCED | MASK)]
    if not pages:
        raise unreadable(
            path,
            "the TIFF holds no image",
            field="NewSubfileType",
            found=f"{len(kinds)} previews or masks" if kinds else "no pages",
            expected="at least one full-size page",
        )
    return pages


def kinds_of_pages(path: Path) -> list[int]:
    """Return NewSubfileType of every directory in the chain.

    Raises
    ------
    UnreadableCapture
        Where the chain leaves the file, or turns back on itself: a decoder would follow it for ever.
    """
    with path.open("rb") as handle:
        size = handle.seek(0, 2)
        handle.seek(0)
        order = "<" if handle.read(2) == b"II" else ">"
        big = _number(path, handle, order + "H") == 43
        handle.seek(8 if big else 4)
        offset = _number(path, handle, order + ("Q" if big else "I"))
        kinds: list[int] = []
        seen: set[int] = set()
        walked = 0
        while offset:
            # Directories stand side by side: laid over one another, each costs a reader as much
            # of the file again.
            if offset in seen or offset >= size or walked > size:
                raise _broken(path, offset, size)
            if len(kinds) >= MOST_PAGES:
                raise _too_many(path)
            seen.add(offset)
            kind, following = _directory(path, handle, offset, order, big)
            walked += handle.tell() - offset
            offset = following
            kinds.append(kind)
    return kinds


def _directory(path: Path, handle: BinaryIO, offset: int, order: str, big: bool) -> tuple[int, int]:
    """Return NewSubfileType of the directory at `offset`, and where the next one is (0: none)."""
    handle.seek(offset)
    count = _number(path, handle, order + ("Q" if big else "H"))
    if not 0 < count <= MOST_TAGS:
        raise unreadable(
            path,
            "a directory of the TIFF is damaged",
            field="number of tags",
            found=f"{count} tags",
            expected=f"1 to {MOST_TAGS}",
            fix=COPY_AGAIN,
        )
    entry = struct.Struct(order + ("HHQI4x" if big else "HHII"))
    data = handle.read(count * entry.size)
    if len(data) < count * entry.size:
        raise _cut(path, handle)
    # The value stands left in its field: a SHORT there has to be read as one.
    kind = next(
        (
            v >> (16 * (order == ">" and t == 3))
            for c, t, _, v in entry.iter_unpack(data)
            if c == SUBFILE_TYPE
        ),
        0,
    )
    return kind, _number(path, handle, order + ("Q" if big else "I"))


def _number(path: Path, handle: BinaryIO, form: str) -> int:
    data = handle.read(struct.calcsize(form))
    if len(data) < struct.calcsize(form):
        raise _cut(path, handle)
    number: int = struct.unpack(form, data)[0]
    return number


def _cut(path: Path, handle: BinaryIO) -> Exception:
    return unreadable(
        path,
        "the file ends inside a directory of the TIFF",
        code="E_TRUNCATED",
        field="directory",
        found=f"{handle.seek(0, 2)} bytes",
        expected="all tags of the page, and where the next one is",
        fix=COPY_AGAIN,
    )


def _too_many(path: Path) -> Exception:
    return unreadable(
        path,
        "the TIFF has too many pages",
        code="E_SIZE",
        field="pages",
        found=f"over {MOST_PAGES}",
        expected=f"at most {MOST_PAGES}",
        fix="Save the frames in several files.",
    )


def _broken(path: Path, offset: int, size: int) -> Exception:
    past = offset >= size
    return unreadable(
        path,
        "the file ends before its pages do"
        if past
        else "the pages of the TIFF go round in a circle or lie over one another",
        code="E_TRUNCATED" if past else "E_UNREADABLE",
        field="next directory",
        found=f"byte {offset}",
        expected=f"below {size}" if past else "a byte not yet visited",
        fix=COPY_AGAIN,
    )
