"""ENVI cubes with the headers that vendors really write, read in blocks of lines."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from levkas.readers.facts import Facts, check_size, unreadable

LONGEST_HEADER = 8 << 20
DATA_SUFFIXES = (".raw", ".dat", ".img", ".bil", ".bip", ".bsq", ".cube", ".sli", "")
DATA_TYPES = {
    1: "u1", 2: "i2", 3: "i4", 4: "f4", 5: "f8", 12: "u2", 13: "u4", 14: "i8", 15: "u8",
}  # fmt: skip
NANOMETRES = {
    "nm": 1.0, "nanometers": 1.0, "nanometer": 1.0, "nanometres": 1.0,
    "um": 1e3, "micrometers": 1e3, "micrometer": 1e3, "micrometres": 1e3, "microns": 1e3, "µm": 1e3,
}  # fmt: skip


@dataclass(frozen=True)
class EnviFile:
    """One opened cube: its facts, and its lines when they are asked for."""

    facts: Facts
    data: Path
    offset: int
    layout: str
    header: dict[str, Any]

    @cached_property
    def _dtype(self) -> np.dtype[Any]:
        return np.dtype(self.layout)

    def read(self) -> np.ndarray:
        """Read all, (lines, samples, bands), native byte order."""
        return self.read_lines(0, self.facts.shape[0])

    def read_lines(self, start: int, stop: int) -> np.ndarray:
        """Read lines ``start`` to ``stop`` − 1, (stop − start, samples, bands), with plain reads.

        Raises UnreadableCapture where the data end early, ValueError for lines that are not there.
        """
        lines, samples, bands = self.facts.shape
        if not 0 <= start <= stop <= lines:
            raise ValueError(f"lines {start} to {stop} of {lines}")
        count, item = stop - start, self._dtype.itemsize
        if self.facts.interleave == "bsq":
            out = np.empty((count, samples, bands), self._dtype)
            for band in range(bands):
                at = self.offset + ((band * lines + start) * samples) * item
                out[..., band] = self._block(at, count * samples).reshape(count, samples)
        else:
            flat = self._block(
                self.offset + start * samples * bands * item, count * samples * bands
            )
            if self.facts.interleave == "bip":
                out = flat.reshape(count, samples, bands)
            else:
                out = np.ascontiguousarray(flat.reshape(count, bands, samples).transpose(0, 2, 1))
        return out.astype(self._dtype.newbyteorder("="), copy=False)

    def _block(self, at: int, count: int) -> np.ndarray:
        block = np.empty(count, self._dtype)
        with self.data.open("rb") as handle:
            handle.seek(at)
            got = handle.readinto(memoryview(block).cast("B")) if count else 0
        if got != block.nbytes:
            raise unreadable(
                self.data,
                "the data end early",
                code="E_TRUNCATED",
                found=f"{at + (got or 0)} bytes",
                expected=f"{at + block.nbytes} bytes",
            )
        return block


def find_header(path: str | Path) -> Path | None:
    """Return the header of a data file: ``NAME.hdr`` or ``NAME.raw.hdr``; None where there is none."""
    path = Path(path)
    names = [path.name + ".hdr", path.name + ".HDR"]
    if path.suffix:
        names += [path.stem + ".hdr", path.stem + ".HDR"]
    for name in names:
        if (path.parent / name).is_file():
            return path.parent / name
    return None


def find_data(header: Path) -> Path:
    """Return the data file of a header; raises UnreadableCapture where none or several fit."""
    stem = header.with_suffix("")
    candidates = [stem] if stem.suffix else []
    candidates += [stem.with_name(stem.name + s) for s in DATA_SUFFIXES]
    candidates += [stem.with_name(stem.name + s.upper()) for s in DATA_SUFFIXES if s]
    for candidate in candidates:
        if candidate.is_file() and candidate != header:
            return candidate
    raise unreadable(
        header,
        "the header has no data file beside it",
        code="E_UNREADABLE",
        expected=f"{stem.name} with one of {', '.join(s for s in DATA_SUFFIXES if s)}, or without a suffix",
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
    if header is None or not header.is_file():
        raise unreadable(path, "the cube has no header", expected=f"{path.stem}.hdr")
    data = find_data(header) if path == header else path
    fields = parse_header(header)
    lines, samples, bands = (_whole(header, fields, key) for key in ("lines", "samples", "bands"))
    interleave = str(fields.get("interleave", "bsq")).lower()
    code = _whole(header, fields, "data type")
    if interleave not in ("bil", "bip", "bsq"):
        raise unreadable(
            header,
            "unknown interleave",
            field="interleave",
            found=interleave,
            expected="bil, bip or bsq",
        )
    if code not in DATA_TYPES:
        raise unreadable(
            header,
            "samples of this type cannot be read",
            field="data type",
            found=code,
            expected=", ".join(map(str, DATA_TYPES)),
        )
    order = ">" if str(fields.get("byte order", "0")).strip() == "1" else "<"
    offset = int(_number(fields.get("header offset", 0)) or 0)
    check_size(header, (lines, samples, bands))
    layout = order + DATA_TYPES[code]
    dtype = np.dtype(layout)
    _check_length(
        header,
        data,
        offset,
        lines * samples * bands * dtype.itemsize,
        dtype.itemsize * samples * bands,
    )
    wavelengths = _wavelengths(header, fields, "wavelength", bands)
    facts = Facts(
        path=header,
        kind="envi",
        shape=(lines, samples, bands),
        dtype=dtype.newbyteorder("=").name,
        bits=8 * dtype.itemsize if dtype.kind == "u" else None,
        saturation=_number(fields.get("data ceiling")) or _number(fields.get("ceiling")),
        exposure_s=_exposure(fields),
        captured=_date(fields),
        model=str(fields["sensor type"]) if "sensor type" in fields else None,
        wavelengths=wavelengths,
        fwhm=_wavelengths(header, fields, "fwhm", bands),
        band_names=_names(fields, bands),
        interleave=interleave,
    )
    return EnviFile(facts, data, offset, layout, fields)


def parse_header(path: Path) -> dict[str, Any]:
    """Parse an ENVI header: keys in lower case, ``{…}`` as lists of str, comments left out.

    Raises UnreadableCapture where it is no ENVI header at all.
    """
    try:
        if path.stat().st_size > LONGEST_HEADER:
            raise unreadable(
                path,
                "the header is too long to be one",
                code="E_SIZE",
                found=f"{path.stat().st_size} bytes",
            )
        text = path.read_bytes().decode("utf-8-sig", "replace")
    except OSError as error:
        raise unreadable(path, "the header cannot be opened", found=str(error)) from error
    rows = [line for line in text.splitlines() if not line.lstrip().startswith(";")]
    if not rows or not rows[0].strip().upper().startswith("ENVI"):
        raise unreadable(
            path,
            "this is no ENVI header",
            found=(rows or [""])[0][:40],
            expected="a first line ENVI",
        )
    fields: dict[str, Any] = {}
    key, parts = "", []
    for row in rows[1:]:
        if key:
            parts.append(row)
        else:
            name, equals, value = row.partition("=")
            if not equals:
                continue
            name, value = re.sub(r"\s+", " ", name.strip().lower()), value.strip()
            if not value.startswith("{"):
                fields[name] = value.strip("\"' ")
                continue
            key, parts = name, [value]
        if "}" in parts[-1]:
            inner = "\n".join(parts).partition("{")[2].rpartition("}")[0]
            fields[key] = [v.strip("\"' \t\r\n") for v in re.split(r"[,\n]", inner) if v.strip()]
            key = ""
    if key:
        raise unreadable(path, "a list in the header has no end", field=key, expected="a closing }")
    return fields


def _whole(path: Path, fields: dict[str, Any], key: str) -> int:
    value = _number(fields.get(key))
    if value is None or value != int(value) or value < 1:
        raise unreadable(
            path,
            f"the header does not say its {key}",
            field=key,
            found=fields.get(key),
            expected="a whole number > 0",
        )
    return int(value)


def _number(value: Any) -> float | None:
    try:
        number = float(str(value).strip())
    except ValueError:
        return None
    return number if np.isfinite(number) else None


def _check_length(header: Path, data: Path, offset: int, needed: int, line: int) -> None:
    found = data.stat().st_size
    if found == offset + needed:
        return
    if found > offset + needed and found - offset - needed < line:
        return  # a few bytes of padding or a footer harm nobody
    short = found < offset + needed
    likely = (
        "lines, or the scan was cut short"
        if (found - offset) % line == 0
        else "data type, samples or bands"
    )
    raise unreadable(
        data,
        "the data do not fit their header",
        code="E_TRUNCATED" if short else "E_SIZE",
        field=f"{header.name}: {likely}",
        found=f"{found} bytes",
        expected=f"{offset + needed} bytes",
        fix="Copy the scan again, or mend the header.",
    )


def _wavelengths(
    path: Path, fields: dict[str, Any], key: str, bands: int
) -> tuple[float, ...] | None:
    raw = fields.get(key)
    if not isinstance(raw, list):
        return None
    values = [_number(v) for v in raw]
    if len(values) != bands or None in values:
        raise unreadable(
            path,
            f"the list of {key} does not fit the bands",
            code="E_BAND_COUNT",
            field=key,
            found=f"{len(values)} numbers",
            expected=f"{bands}",
        )
    numbers = np.array(values, float)
    unit = str(fields.get("wavelength units", "")).strip().lower()
    centres = (
        [_number(v) for v in fields.get("wavelength", [])]
        if isinstance(fields.get("wavelength"), list)
        else []
    )
    top = max((c for c in centres if c), default=float(numbers.max(initial=0)))
    factor = NANOMETRES.get(unit, 1e3 if 0 < top < 100 else 1.0)
    return tuple(float(round(v * factor, 6)) for v in numbers)


def _names(fields: dict[str, Any], bands: int) -> tuple[str, ...] | None:
    names = fields.get("band names")
    return tuple(names) if isinstance(names, list) and len(names) == bands else None


def _exposure(fields: dict[str, Any]) -> float | None:
    """Integration time in s; vendors write it as `tint` or `integration time`, in ms."""
    for key in ("tint", "integration time", "exposure", "shutter"):
        value = _number(fields.get(key))
        if value is not None and value > 0:
            return value / 1e3
    return None


def _date(fields: dict[str, Any]) -> str | None:
    for key in ("acquisition time", "acquisition date", "date"):
        found = re.search(r"\d{4}-\d\d-\d\d(?:[T ]\d\d:\d\d:\d\d)?", str(fields.get(key, "")))
        if found:
            return found.group(0).replace(" ", "T")
    return None
