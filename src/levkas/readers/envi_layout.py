"""Where an ENVI header says that each number lies, and whether its data are that long."""

from __future__ import annotations

import re
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from levkas.readers.envi_header import Fields, number_of, text_of, whole_of
from levkas.readers.facts import check_size, unreadable

DATA_TYPES = {
    1: "u1", 2: "i2", 3: "i4", 4: "f4", 5: "f8", 12: "u2", 13: "u4", 14: "i8", 15: "u8",
}  # fmt: skip
MOST_SAMPLES = 1 << 44
"""A line scan is read in blocks, so only nonsense is refused; its data must be there anyway."""
SHIFTED = 1 << 16
"""Bytes by which data may exceed their header and still look like an unsaid header offset."""


@dataclass(frozen=True)
class Layout:
    """Order, type and place of the numbers in a data file.

    Parameters
    ----------
    shape : tuple of int
        (lines, samples, bands).
    interleave : str
        ``"bil"``, ``"bip"`` or ``"bsq"``.
    dtype : dtype
        With the byte order of the file.
    offset : int
        Bytes before the first number.
    """

    shape: tuple[int, int, int]
    interleave: str
    dtype: np.dtype[Any]
    offset: int

    @property
    def end(self) -> int:
        """Bytes that the data file must have."""
        return self.offset + prod(self.shape) * self.dtype.itemsize


def layout_of(path: Path, fields: Fields) -> Layout:
    """Return the layout that a header declares; raises UnreadableCapture for one that is not read.

    A missing `byte order` is 0 and a missing `header offset` is 0, as many vendors leave them out.
    """
    lines, samples, bands = (whole_of(path, fields, key) for key in ("lines", "samples", "bands"))
    check_size(
        path,
        (lines, samples, bands),
        most=MOST_SAMPLES,
        field="lines, samples, bands",
        fix="Mend the header: no scan is as large.",
    )
    _check_plain(path, fields)
    return Layout(
        shape=(lines, samples, bands),
        interleave=_interleave(path, fields, bands),
        dtype=_dtype(path, fields),
        offset=whole_of(path, fields, "header offset", least=0, default=0),
    )


def check_length(header: Path, data: Path, layout: Layout) -> None:
    """Refuse data that are longer or shorter than their header says, and name the likely field."""
    found = data.stat().st_size
    if found == layout.end:
        return
    field, fix = _explain(found, layout)
    lines, samples, bands = layout.shape
    raise unreadable(
        data,
        "the data do not fit their header",
        code="E_TRUNCATED" if found < layout.end else "E_SIZE",
        field=f"{header.name}: {field}",
        found=f"{found} bytes",
        expected=f"{layout.end} bytes for {lines} lines x {samples} samples x {bands} bands",
        fix=fix,
    )


def _explain(found: int, layout: Layout) -> tuple[str, str]:
    """Return the one field that would explain the size, and what to do about it."""
    lines, samples, bands = layout.shape
    room = found - layout.offset
    if room <= 0:
        return "header offset", "The data end before the offset: `header offset = 0` is usual."
    types = [c for c, t in DATA_TYPES.items() if prod(layout.shape) * int(t[1]) == room]
    if types:
        return "data type", f"Data type {' or '.join(map(str, types))} would fit."
    units = {"lines": samples * bands, "bands": lines * samples, "samples": lines * bands}
    order = ("bands", "lines", "samples") if layout.interleave == "bsq" else tuple(units)
    for key in order:
        count, rest = divmod(room, units[key] * layout.dtype.itemsize)
        if count > 0 and rest == 0:
            fits = f"`{key} = {count}` would fit: mend the header, or copy the scan again."
            return key, fits
    if 0 < found - layout.end <= SHIFTED:
        start = layout.offset + found - layout.end
        return "header offset", f"If the data start later, write `header offset = {start}`."
    return "lines, samples, bands or data type", "Mend the header, or copy the scan again."


def _interleave(path: Path, fields: Fields, bands: int) -> str:
    text = text_of(fields, "interleave").lower()
    if text in ("bil", "bip", "bsq"):
        return text
    if not text and bands == 1:
        return "bsq"  # one band: all orders are the same
    raise unreadable(
        path,
        "unknown interleave",
        field="interleave",
        found=text or None,
        expected="bil, bip or bsq",
        fix="Write `interleave = bil`, bip or bsq.",
    )


def _dtype(path: Path, fields: Fields) -> np.dtype[Any]:
    code = whole_of(path, fields, "data type")
    if code not in DATA_TYPES:
        raise unreadable(
            path,
            "samples of this type cannot be read",
            field="data type",
            found=f"{code}, complex numbers" if code in (6, 9) else code,
            expected=", ".join(map(str, DATA_TYPES)),
            fix="Save the cube again as whole numbers or floats.",
        )
    order = whole_of(path, fields, "byte order", least=0, default=0)
    if order > 1:
        raise unreadable(
            path, "unknown byte order", field="byte order", found=order, expected="0 or 1"
        )
    return np.dtype("<>"[order] + DATA_TYPES[code])


def _check_plain(path: Path, fields: Fields) -> None:
    """Refuse compressed data and gaps between lines or bands: they would read shifted."""
    if whole_of(path, fields, "file compression", least=0, default=0):
        raise unreadable(
            path,
            "the data are compressed",
            field="file compression",
            found=1,
            expected=0,
            fix="Save the cube again without compression.",
        )
    for key in ("major frame offsets", "minor frame offsets"):
        text = text_of(fields, key)
        if any(number_of(v) != 0 for v in re.split(r"[,\s]+", text) if v):
            raise unreadable(
                path,
                "gaps between lines or bands are not read",
                field=key,
                found=text,
                expected="0, 0",
                fix="Save the cube again without frame offsets.",
            )
