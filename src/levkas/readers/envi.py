"""ENVI cubes, read in blocks of lines with plain reads."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from levkas.core.text import what_stands_at
from levkas.core.transpose import transpose
from levkas.readers.envi_facts import header_facts
from levkas.readers.envi_header import EnviHeader, Fields, find_data, find_header, parse_header
from levkas.readers.facts import Facts, check_memory, check_size, refused, unreadable
from levkas.readers.nodata import without_nodata

__all__ = ["DATA_TYPES", "EnviFile", "open_envi", "read_envi", "read_envi_facts"]

DATA_TYPES = {
    1: "u1", 2: "i2", 3: "i4", 4: "f4", 5: "f8", 12: "u2", 13: "u4", 14: "i8", 15: "u8",
}  # fmt: skip
MOST_SAMPLES = 1 << 44
"""A line scan is read in blocks, so only nonsense is refused; its data must be there anyway."""
SHIFTED = 1 << 16
"""Bytes by which data may exceed their header and still look like an unsaid header offset."""


@dataclass(frozen=True)
class EnviFile:
    """One opened cube: its facts, and its lines on request.

    `facts.path` is the header, `facts.shape` (lines, samples, bands); samples of type `layout`, with its byte order, such
    as ``">u2"``, stand in `data` behind `offset` bytes; `header` has every field, keys in lower case.
    """

    facts: Facts
    data: Path
    offset: int
    layout: str
    header: Fields = field(repr=False)

    def read(self) -> np.ndarray:
        """Read all, (lines, samples, bands), native byte order."""
        return self.read_lines(0, self.facts.shape[0])

    def read_lines(self, start: int, stop: int) -> np.ndarray:
        """Read lines `start` to `stop` − 1, (stop − start, samples, bands), native byte order, bands innermost.

        Where the header has a `data ignore value` they are floats, NaN for it. Raises UnreadableCapture where the data are
        truncated.
        """
        lines, samples, bands = self.facts.shape
        if not 0 <= start <= stop <= lines:
            raise ValueError(f"lines {start} to {stop} of {lines}")
        count, dtype = stop - start, np.dtype(self.layout)
        if self.facts.interleave == "bsq":
            stored = np.empty((bands, count * samples), dtype)
            self._fill(stored, [(band * lines + start) * samples for band in range(bands)])
            out = transpose(stored).reshape(count, samples, bands)
        else:
            out = np.empty((count, samples, bands), dtype)
            self._fill(out.reshape(1, -1), [start * samples * bands])
            if self.facts.interleave == "bil":
                lying = out.reshape(count, bands, samples)
                out = np.stack([transpose(line) for line in lying]) if count else out
        if not out.dtype.isnative:
            out = out.byteswap(inplace=True).view(dtype.newbyteorder())
        return without_nodata(out, self.facts.nodata)

    def _fill(self, blocks: np.ndarray, starts: list[int]) -> None:
        """Fill each row of `blocks` with the samples from its start on, counted in samples."""
        size = blocks.dtype.itemsize
        try:
            with self.data.open("rb", buffering=0) as handle:
                for block, start in zip(blocks, starts, strict=True):
                    left = memoryview(block.view(np.uint8))
                    handle.seek(self.offset + start * size)
                    # One read gives at most 2 GiB on Linux, and less from some network drives.
                    while left and (got := handle.readinto(left)):
                        left = left[got:]
                    if left:
                        found, needed = f"{handle.tell()} bytes", handle.tell() + len(left)
                        words = {"field": "data", "expected": f"{needed} bytes"}
                        raise refused(self.data, "cut", found, **words)
        except OSError as error:
            raise unreadable(self.data, "the data cannot be read", found=str(error)) from error


def open_envi(path: str | Path) -> EnviFile:
    """Open a cube by its header or its data file; sizes are checked, no pixel is read.

    Raises UnreadableCapture where a needed field is missing or absurd, or the data do not fit the header.
    """
    path = Path(path)
    beside = path if path.suffix.lower() == ".hdr" else find_header(path)
    if beside is None or what_stands_at(beside) != "a file":
        raise refused(path, "no header", "no such file", stem=path.stem)
    header = parse_header(beside)
    layout = _layout_of(header)
    try:
        data = find_data(header, layout.end) if path == beside else path
        _check_length(header, data, layout)
    except OSError as error:
        raise unreadable(path, "the data cannot be opened", found=str(error)) from error
    _, samples, bands = layout.shape
    facts = Facts(
        path=beside,
        kind="envi",
        shape=layout.shape,
        dtype=layout.dtype.newbyteorder("=").name,
        bits=8 * layout.dtype.itemsize if layout.dtype.kind == "u" else None,
        interleave=layout.interleave,
        **header_facts(header, layout.dtype, samples, bands),
    )
    return EnviFile(facts, data, layout.offset, layout.dtype.str, header.fields)


def read_envi_facts(path: Path) -> Facts:
    """Return the facts of a cube."""
    return open_envi(path).facts


def read_envi(path: Path) -> np.ndarray:
    """Read a whole cube, (lines, samples, bands); refuses one that does not fit in memory."""
    cube = open_envi(path)
    check_memory(path, prod(cube.facts.shape), np.dtype(cube.layout).itemsize)
    return cube.read()


# --- layout -----------------------------------------------------------------------------------


class Layout(NamedTuple):
    """Order, type with its byte order, and place of the numbers in a data file; `shape` is (lines, samples, bands)."""

    shape: tuple[int, int, int]
    interleave: str
    dtype: np.dtype[Any]
    offset: int

    @property
    def end(self) -> int:
        """Bytes that the data file must have."""
        return self.offset + prod(self.shape) * self.dtype.itemsize


def _layout_of(header: EnviHeader) -> Layout:
    """Return the layout that a header declares; raises UnreadableCapture for one that is not read.

    A missing `byte order` is 0 and a missing `header offset` is 0, as many vendors leave them out.
    """
    lines, samples, bands = (header.whole(key) for key in ("lines", "samples", "bands"))
    check_size(
        header.path,
        (lines, samples, bands),
        most=MOST_SAMPLES,
        field="lines, samples, bands",
        fix="Correct the header: no scan is so large.",
    )
    packed = header.whole("file compression", least=0, default=0)
    interleave = header.text("interleave").lower() or ("bsq" if bands == 1 else "")
    code = header.whole("data type")
    order = header.whole("byte order", least=0, default=0)
    known = ", ".join(map(str, DATA_TYPES))
    for key, found, right, expected in (
        ("file compression", packed, (0,), "0: data that are not compressed"),
        ("interleave", interleave, ("bil", "bip", "bsq"), "bil, bip or bsq"),
        ("data type", code, DATA_TYPES, f"{known}: whole numbers or floats, none complex"),
        ("byte order", order, (0, 1), "0 for little-endian, 1 for big-endian numbers"),
    ):
        if found not in right:  # type: ignore[operator]
            raise refused(header.path, "layout", found or "nothing", key=key, expected=expected)
    dtype = np.dtype("<>"[order] + DATA_TYPES[code])
    offset = header.whole("header offset", least=0, default=0)
    return Layout((lines, samples, bands), interleave, dtype, offset)


def _check_length(header: EnviHeader, data: Path, layout: Layout) -> None:
    """Refuse data that are longer or shorter than their header declares, and name the likely field."""
    found = data.stat().st_size
    if found == layout.end:
        return
    field, fix = _likely_field(found, layout)
    lines, samples, bands = layout.shape
    words = {
        "code": "E_TRUNCATED" if found < layout.end else "E_SIZE",
        "field": f"{header.path.name}: {field}",
        "expected": f"{layout.end} bytes for {lines} lines x {samples} samples x {bands} bands",
    }
    raise refused(data, "length", f"{found} bytes", fix=fix, **words)


def _likely_field(found: int, layout: Layout) -> tuple[str, str]:
    """Return the one field that would explain the size, and what to do about it."""
    lines, samples, bands = layout.shape
    room = found - layout.offset
    if room <= 0:
        return "header offset", "The data end before the offset: `header offset = 0` is usual."
    types = [c for c, t in DATA_TYPES.items() if prod(layout.shape) * int(t[1]) == room]
    if types:
        return "data type", f"Data type {' or '.join(map(str, types))} would match."
    units = {"lines": samples * bands, "bands": lines * samples, "samples": lines * bands}
    order = ("bands", "lines", "samples") if layout.interleave == "bsq" else tuple(units)
    for key in order:
        count, rest = divmod(room, units[key] * layout.dtype.itemsize)
        if count > 0 and rest == 0:
            fits = f"`{key} = {count}` would match: correct the header, or copy the scan again."
            return key, fits
    if 0 < found - layout.end <= SHIFTED:
        start = layout.offset + found - layout.end
        return "header offset", f"If the data start later, write `header offset = {start}`."
    return "lines, samples, bands or data type", "Correct the header, or copy the scan again."
