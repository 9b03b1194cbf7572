"""ENVI cubes, read in blocks of lines with plain reads."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from levkas.readers.envi_header import (
    Fields,
    exposure_facts,
    find_data,
    find_header,
    number_of,
    parse_header,
    text_of,
    whole_of,
)
from levkas.readers.facts import Facts, check_memory, check_size, unreadable
from levkas.readers.text import what_stands_at

__all__ = ["DATA_TYPES", "EnviFile", "open_envi", "read_envi", "read_envi_facts"]

NANOMETRES = {
    "nm": 1.0, "nanometer": 1.0, "nanometre": 1.0, "um": 1e3, "µm": 1e3, "μm": 1e3,
    "micrometer": 1e3, "micrometre": 1e3, "micron": 1e3, "mm": 1e6, "millimeter": 1e6,
    "millimetre": 1e6, "m": 1e9, "meter": 1e9, "metre": 1e9, "angstrom": 0.1, "å": 0.1,
}  # fmt: skip


@dataclass(frozen=True)
class EnviFile:
    """One opened cube: its facts, and its lines when they are asked for.

    Parameters
    ----------
    facts : Facts
        `path` is the header, `shape` is (lines, samples, bands).
    data : Path
    offset : int
        Bytes before the first sample.
    layout : str
        Type of a stored sample with its byte order, such as ``">u2"``.
    header : dict
        Every field of the header: keys in lower case, text or lists of text.
    scale : float or None
        What reflectance 1.0 stands for in the file (`reflectance scale factor`).
    ignore : float or None
        Value of samples that hold nothing (`data ignore value`); NaN where the header says so.
    """

    facts: Facts
    data: Path
    offset: int
    layout: str
    header: Fields = field(repr=False)
    scale: float | None = None
    ignore: float | None = None

    def read(self) -> np.ndarray:
        """Read all, (lines, samples, bands), native byte order."""
        return self.read_lines(0, self.facts.shape[0])

    def read_lines(self, start: int, stop: int, *, turned: bool = True) -> np.ndarray:
        """Read lines `start` to `stop` − 1, (stop − start, samples, bands), native byte order.

        Bands are innermost in memory, or where `turned` is false as they are in the file.

        Raises
        ------
        UnreadableCapture
            Where the data end early.
        ValueError
            For lines that are not there.
        """
        lines, samples, bands = self.facts.shape
        if not 0 <= start <= stop <= lines:
            raise ValueError(f"lines {start} to {stop} of {lines}")
        count, dtype = stop - start, np.dtype(self.layout)
        if self.facts.interleave == "bsq":
            stored = np.empty((bands, count, samples), dtype)
            starts = [(band * lines + start) * samples for band in range(bands)]
            out = stored.transpose(1, 2, 0)
        else:
            shape = (count, bands, samples) if self.facts.interleave == "bil" else None
            stored = np.empty(shape or (count, samples, bands), dtype)
            starts = [start * samples * bands]
            out = stored.transpose(0, 2, 1) if shape else stored
        self._fill(stored.reshape(len(starts), -1), starts)
        out = np.ascontiguousarray(out) if turned else out
        return out if out.dtype.isnative else out.byteswap(inplace=True).view(dtype.newbyteorder())

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
                        raise self._short(handle.tell(), len(left))
        except OSError as error:
            raise unreadable(self.data, "the data cannot be read", found=str(error)) from error

    def _short(self, end: int, missing: int) -> Exception:
        return unreadable(
            self.data,
            "the data end early",
            code="E_TRUNCATED",
            found=f"{end} bytes",
            expected=f"{end + missing} bytes",
        )


def open_envi(path: str | Path) -> EnviFile:
    """Open a cube by its header or its data file; sizes are checked, no pixel is read.

    Raises
    ------
    UnreadableCapture
        Where a needed field is missing or absurd, or the data do not fit the header.
    """
    path = Path(path)
    header = path if path.suffix.lower() == ".hdr" else find_header(path)
    if header is None or what_stands_at(header) != "a file":
        raise unreadable(
            path,
            "the cube has no header",
            found="no such file",
            expected=f"{path.stem}.hdr beside it",
            fix="Put the header beside its data, under the same name.",
        )
    fields = parse_header(header)
    layout = layout_of(header, fields)
    try:
        data = find_data(header, fields, layout.end) if path == header else path
        check_length(header, data, layout)
    except OSError as error:
        raise unreadable(path, "the data cannot be opened", found=str(error)) from error
    _, samples, bands = layout.shape
    # A spectral library holds a spectrum a line: its samples are the wavelengths.
    centres = samples if "library" in text_of(fields, "file type").lower() else bands
    facts = Facts(
        path=header,
        kind="envi",
        shape=layout.shape,
        dtype=layout.dtype.newbyteorder("=").name,
        bits=8 * layout.dtype.itemsize if layout.dtype.kind == "u" else None,
        saturation=number_of(text_of(fields, "data ceiling")) or None,
        captured=_date(fields),
        model=text_of(fields, "sensor type") or None,
        wavelengths=_wavelengths(header, fields, "wavelength", centres),
        fwhm=_wavelengths(header, fields, "fwhm", centres),
        band_names=_names(fields, bands),
        interleave=layout.interleave,
        **exposure_facts(header, fields, bands),
    )
    ignore = text_of(fields, "data ignore value")
    return EnviFile(
        facts=facts,
        data=data,
        offset=layout.offset,
        layout=layout.dtype.str,
        header=fields,
        scale=number_of(text_of(fields, "reflectance scale factor")) or None,
        ignore=float("nan") if ignore.lower() == "nan" else number_of(ignore),
    )


def read_envi_facts(path: Path) -> Facts:
    """Return the facts of a cube."""
    return open_envi(path).facts


def read_envi(path: Path) -> np.ndarray:
    """Read a whole cube, (lines, samples, bands); refuses one that does not fit in memory."""
    cube = open_envi(path)
    check_memory(path, prod(cube.facts.shape), np.dtype(cube.layout).itemsize)
    return cube.read()


def _wavelengths(path: Path, fields: Fields, key: str, bands: int) -> tuple[float, ...] | None:
    """Return a list of the header in nm; None where it is not there or counts something else."""
    raw = fields.get(key)
    if not raw:
        return None
    values = [number_of(v) for v in (raw if isinstance(raw, list) else raw.split(","))]
    numbers = [v for v in values if v is not None]
    if len(values) != bands or len(numbers) != bands:
        raise unreadable(
            path,
            f"the list of {key} does not fit the bands",
            code="E_BAND_COUNT",
            field=key,
            found=f"{len(numbers)} numbers",
            expected=f"{bands}",
            fix="Write one number a band, or take the list out.",
        )
    centres = [number_of(v) or 0.0 for v in fields.get("wavelength") or raw]
    convert = _to_nanometres(text_of(fields, "wavelength units").lower(), max(centres))
    return tuple(round(convert(v), 6) for v in numbers) if convert else None


def _to_nanometres(unit: str, top: float) -> Callable[[float], float] | None:
    """Return the way from a unit to nm; a unit that nobody knows is micrometres below 100."""
    factor = NANOMETRES.get(unit) or NANOMETRES.get(unit.rstrip("s"))
    if unit in ("index", "wavenumber", "wavenumbers", "ghz", "mhz", "1/cm", "cm-1"):
        return None
    if factor is None:
        factor = 1e3 if top < 100 else 1.0
    return lambda value: value * factor


def _names(fields: Fields, bands: int) -> tuple[str, ...] | None:
    names = fields.get("band names")
    return tuple(names) if isinstance(names, list) and len(names) == bands else None


def _date(fields: Fields) -> str | None:
    for key in ("acquisition time", "acquisition date", "date"):
        found = re.search(r"\d{4}-[01]\d-[0-3]\d(?:[T ]\d\d:\d\d:\d\d)?", text_of(fields, key))
        if found:
            return found[0].replace(" ", "T")
    return None


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
