"""Libraries of spectra: ENVI `.sli`, as the USGS library has them too, and CSV."""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from levkas.core.files import write_bytes, write_text
from levkas.core.text import read_text
from levkas.readers.envi import DATA_TYPES
from levkas.readers.envi_header import find_data, find_header, parse_header
from levkas.readers.facts import check_memory, unreadable
from levkas.readers.spectra import are_spectra, parse_spectra
from levkas.readers.wavelengths import read_centres

if TYPE_CHECKING:
    import xarray

EXPECTED = "an ENVI spectral library (.sli or its .hdr), or a CSV"
NM_FROM = 100.0
"""Wavelengths of text below it are µm: no library has nanometres that short."""
Library = tuple[np.ndarray, np.ndarray, list[str]]
"""Wavelengths (n,), nm; values (spectra, n); names."""


def read_spectra(path: str | Path) -> xarray.DataArray:
    """Read a library of spectra: ENVI's ``.sli`` or its header; a CSV of wavelength and a column a spectrum.

    Returns reflectance, (spectrum, wavelength), float64, 1.0 = perfect diffuser, NaN where there is none; `wavelength`, nm,
    rises; `spectrum` has the names. Raises UnreadableCapture where the file is none of these, is cut, or has no wavelengths.

    >>> path = folder / "blue.csv"
    >>> _ = path.write_text("nm,azurite\\n400,0.2\\n500,0.3\\n")
    >>> read_spectra(path).sel(spectrum="azurite").interp(wavelength=450).item()
    0.25
    """
    import xarray

    path = Path(path)
    envi = path.suffix.lower() in (".sli", ".hdr")
    nm, values, names = _read_sli(path) if envi else _read_text(path)
    order = np.argsort(nm, kind="stable")
    facts = {"units": "nm", "standard_name": "radiation_wavelength"}
    return xarray.DataArray(
        values[:, order],
        {"spectrum": names, "wavelength": ("wavelength", nm[order], facts)},
        ("spectrum", "wavelength"),
        name="reflectance",
        attrs={"units": "1", "source": path.name},
    )


def write_spectra(path: str | Path, spectra: xarray.DataArray) -> list[Path]:
    """Write a library of spectra, as `read_spectra` returns them: ``.sli`` with its header for ENVI, or ``.csv``.

    One spectrum alone may be (wavelength,). Returns the files, the header last; raises ValueError of another suffix or other
    dimensions, WriteRefused where the disk refuses.

    >>> import xarray
    >>> one = xarray.DataArray([0.2, 0.3], {"wavelength": [400.0, 500.0]}, ("wavelength",), name="azurite")
    >>> [made.name for made in write_spectra(folder / "blue.sli", one)]
    ['blue.sli', 'blue.hdr']
    """
    path = Path(path)
    if "spectrum" not in spectra.dims:
        named = spectra.coords["spectrum"].item() if "spectrum" in spectra.coords else spectra.name
        spectra = spectra.drop_vars("spectrum", errors="ignore")
        spectra = spectra.expand_dims(spectrum=[named or "1"])
    table = spectra.transpose("spectrum", "wavelength")
    nm, names = table["wavelength"].values, [str(name) for name in table["spectrum"].values]
    if path.suffix.lower() == ".csv":
        text = io.StringIO()
        rows = csv.writer(text, lineterminator="\n")
        rows.writerow(["nm", *names])
        rows.writerows([at, *column] for at, column in zip(nm, table.values.T, strict=True))
        write_text(path, text.getvalue().replace("nan", ""))
        return [path]
    if path.suffix.lower() != ".sli":
        raise ValueError(f"a library of spectra is written as .sli or .csv, not {path.suffix!r}")
    plain = [re.sub(r"[{},\n]", " ", name).strip() for name in names]
    lines = [
        *("ENVI", f"samples = {len(nm)}", f"lines = {len(names)}", "bands = 1"),
        *("header offset = 0", "file type = ENVI Spectral Library", "data type = 5"),
        *("interleave = bsq", "byte order = 0", "wavelength units = Nanometers"),
        f"wavelength = {{{', '.join(repr(float(at)) for at in nm)}}}",
        f"spectra names = {{{', '.join(plain)}}}",
    ]
    header = path.with_suffix(".hdr")
    write_bytes(path, np.ascontiguousarray(table.values, "<f8").tobytes())
    write_text(header, "\n".join([*lines, ""]))
    return [path, header]


def _read_sli(path: Path) -> Library:
    beside = path if path.suffix.lower() == ".hdr" else find_header(path)
    if beside is None:
        raise _refused(path, "the library has no header beside it", "none", f"{path.stem}.hdr")
    header = parse_header(beside)
    samples, lines = header.whole("samples"), header.whole("lines")
    kind = DATA_TYPES.get(header.whole("data type"))
    if kind is None or header.whole("bands", default=1) != 1:
        found = f"data type {header.text('data type')}, {header.text('bands')} bands"
        raise _refused(path, "this is no spectral library", found, "numbers, one band")
    dtype = np.dtype((">" if header.text("byte order") == "1" else "<") + kind)
    offset = header.whole("header offset", least=0, default=0)
    needed = offset + samples * lines * dtype.itemsize
    data = find_data(header, needed)
    if (size := data.stat().st_size) < needed:
        raise _refused(data, "the library is cut", f"{size} bytes", f"{needed} bytes")
    check_memory(data, samples * lines, 8)
    values = np.fromfile(data, dtype, samples * lines, offset=offset).reshape(lines, samples)
    numbers = [number for number in header.numbers("wavelength") if number is not None]
    nm = read_centres(numbers, header.text("wavelength units")).nm or ()
    if len(nm) != samples:
        found = f"{len(numbers)} wavelengths"
        raise _refused(path, "the library has no wavelengths", found, f"{samples} in nm or µm")
    named = header.fields.get("spectra names") or ()
    names = [named] if isinstance(named, str) else list(named)
    if len(names) != lines:
        names = [f"spectrum {number}" for number in range(1, lines + 1)]
    return np.array(nm), values / (header.number("reflectance scale factor") or 1.0), names


def _read_text(path: Path) -> Library:
    text = read_text(path, EXPECTED)
    try:
        table, head = parse_spectra(text)
        if not are_spectra(table):
            raise ValueError("no wavelengths that rise in the first column")
    except ValueError as error:
        raise _refused(path, "these are no spectra", str(error)) from None
    count = table.shape[1] - 1
    alone = [path.stem] if count == 1 else [f"spectrum {n}" for n in range(1, count + 1)]
    scale = 1000.0 if table[-1, 0] < NM_FROM else 1.0
    return table[:, 0] * scale, table[:, 1:].T, head[1:] or alone


def _refused(path: Path, what: str, found: str, expected: str = EXPECTED) -> Exception:
    return unreadable(path, what, found=found, expected=expected)
