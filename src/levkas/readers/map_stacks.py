"""Stacks of maps as programs for X-ray fluorescence write them: Ripple, XRF Explorer's .dms, and PyMca's tables.

- Ripple: a text ``.rpl`` of keys and values (width, height, depth, offset, data-length, data-type, byte-order, record-by), and beside it the
  numbers, ``.raw``, of the same name.
- ``.dms`` of XRF Explorer (github.com/olive-groves/xrf-explorer): a line that is not used, a line ``WIDTH HEIGHT MAPS``, float32 map after map, little-endian, and
  a name a line.
- HDF5 of PyMca, ``.h5``: each map a data set of a group ``…/results/parameters``. It needs h5py.
- Tables of PyMca, ``.csv``: columns ``row`` and ``column`` and one a map, separated by semicolon, comma or tab; a line a pixel, row by row.
"""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from math import prod
from pathlib import Path

import numpy as np

from levkas.readers.arrays import list_hdf5, read_hdf5
from levkas.readers.container_cubes import read_hdf5_cube, read_hdf5_cube_facts
from levkas.readers.facts import Facts, check_memory, check_size, decoding, truncated, unreadable

MOST_HEADER = 1 << 16
"""Bytes of the header of a stack, or of the names at its end."""
LARGEST_TABLE = 1 << 30
"""Bytes of a table; one of 1,000 x 1,000 px and 20 maps has 200 MB."""
RIPPLE_TYPES = {"signed": "i", "unsigned": "u", "float": "f"}
RIPPLE_SIZES = {"i": (1, 2, 4, 8), "u": (1, 2, 4, 8), "f": (4, 8)}
ORDERS = {"little-endian": "<", "big-endian": ">"}
SEPARATORS = ";,\t"
RESULTS = "results/parameters"
"""End of the name of the group in which PyMca writes the maps of a fit."""
NOT_MAPS = ("s(", "chisq")
"""What columns of PyMca begin with that are no maps: standard deviations and the quality of the fit."""


@dataclass(frozen=True)
class Stack:
    """One opened binary stack.

    Parameters
    ----------
    facts : Facts
        `shape` is (lines, samples, maps).
    data : Path
    offset : int
        Bytes before the first number.
    layout : str
        Type of a stored number with its byte order.
    by_map : bool
        Whether map follows map; else the values of a pixel lie together.
    """

    facts: Facts
    data: Path
    offset: int
    layout: str
    by_map: bool

    def read(self) -> np.ndarray:
        """Read all, (lines, samples, maps), native byte order."""
        lines, samples, maps = self.facts.shape
        dtype = np.dtype(self.layout)
        check_memory(self.facts.path, prod(self.facts.shape), dtype.itemsize)
        with decoding(self.data, "stack of maps"), self.data.open("rb") as file:
            file.seek(self.offset)
            values = np.fromfile(file, dtype, prod(self.facts.shape))
            stored = values.reshape((maps, lines, samples) if self.by_map else self.facts.shape)
        found = np.moveaxis(stored, 0, -1) if self.by_map else stored
        return np.ascontiguousarray(found, dtype.newbyteorder("="))


# --- Ripple


def read_ripple_facts(path: Path) -> Facts:
    """Return the facts of a Ripple stack by its .rpl.

    Raises
    ------
    UnreadableCapture
    """
    return _open_ripple(path).facts


def read_ripple(path: Path) -> np.ndarray:
    """Read a Ripple stack, (lines, samples, maps)."""
    return _open_ripple(path).read()


def ripple_data(path: Path) -> Path:
    """Return the file of the numbers beside an .rpl, whatever the case of its suffix."""
    return next(
        (p for p in (path.with_suffix(".raw"), path.with_suffix(".RAW")) if p.is_file()),
        path.with_suffix(".raw"),
    )


def _open_ripple(path: Path) -> Stack:
    keys: dict[str, str] = {}
    for line in _head(path).decode("latin-1").splitlines():
        parts = line.replace(",", "\t").split(None, 1)
        if len(parts) == 2:
            keys.setdefault(parts[0].strip().lower(), parts[1].strip().lower())
    shape = tuple(_whole(path, keys, key) for key in ("height", "width", "depth"))
    kind = RIPPLE_TYPES.get(keys.get("data-type", ""), "")
    size = _whole(path, keys, "data-length")
    if size not in RIPPLE_SIZES.get(kind, ()):
        raise unreadable(
            path,
            "the type of the numbers is not known",
            field="data-type, data-length",
            found=f"{keys.get('data-type')} of {size} bytes",
            expected="signed or unsigned of 1, 2, 4 or 8 bytes, or float of 4 or 8",
        )
    order = keys.get("byte-order", "dont-care")
    if size > 1 and order not in ORDERS:
        raise unreadable(
            path,
            "the order of the bytes is not declared",
            field="byte-order",
            found=order,
            expected=" or ".join(ORDERS),
            fix="Write it into the .rpl.",
        )
    record = keys.get("record-by", "dont-care")
    if record not in ("image", "vector") and shape[2] > 1:
        raise unreadable(
            path,
            "the order of the numbers is not declared",
            field="record-by",
            found=record,
            expected="image (map after map) or vector (pixel after pixel)",
            fix="Write it into the .rpl.",
        )
    offset = _whole(path, keys, "offset") if "offset" in keys else 0
    return _stack(
        path,
        ripple_data(path),
        offset,
        f"{ORDERS.get(order, '|')}{kind}{size}",
        shape,
        record != "vector",
    )


def _whole(path: Path, keys: dict[str, str], key: str) -> int:
    text = keys.get(key, "")
    if text.isascii() and text.isdigit() and len(text) < 16:
        return int(text)
    raise unreadable(
        path,
        f"`{key}` is not a whole number",
        field=key,
        found=text or "no such key",
        expected="a whole number",
    )


# --- .dms


def read_dms_facts(path: Path) -> Facts:
    """Return the facts of a .dms stack.

    Raises
    ------
    UnreadableCapture
    """
    return _open_dms(path).facts


def read_dms(path: Path) -> np.ndarray:
    """Read a .dms stack, (lines, samples, maps)."""
    return _open_dms(path).read()


def _open_dms(path: Path) -> Stack:
    lines = _head(path).split(b"\n", 2)
    sides = lines[1].split() if len(lines) == 3 else []
    if len(sides) != 3 or not all(side.isdigit() and len(side) < 16 for side in sides):
        raise unreadable(
            path,
            "the second line does not declare a size",
            field="width, height, maps",
            found=repr(lines[1][:40] if len(lines) > 1 else b""),
            expected="three whole numbers",
        )
    width, height, maps = (int(side) for side in sides)
    offset = len(lines[0]) + len(lines[1]) + 2
    end = offset + 4 * width * height * maps
    names: tuple[str, ...] = ()
    with path.open("rb") as file:
        file.seek(end)
        tail = file.read(MOST_HEADER).decode("utf-8", "replace")
        names = tuple(name.strip() for name in tail.splitlines() if name.strip())
    return _stack(path, path, offset, "<f4", (height, width, maps), True, names)


# --- HDF5 of PyMca


def read_hdf5_facts(path: Path) -> Facts:
    """Return the facts of the maps in an HDF5 file of PyMca, or of the cube in one of another program.

    Raises
    ------
    UnreadableCapture
    """
    if not list_hdf5(path, RESULTS):
        return read_hdf5_cube_facts(path)
    names, shape = _maps_of_hdf5(path)
    check_memory(path, prod(shape), 8)
    labels = tuple(name.rpartition("/")[2] for name in names)
    return Facts(path, "hdf5", shape, "float32", band_names=_named(labels, len(labels)))


def read_hdf5_maps(path: Path) -> np.ndarray:
    """Read the maps in an HDF5 file of PyMca, (lines, samples, maps) float32, or the cube in one of another program."""
    if not list_hdf5(path, RESULTS):
        return read_hdf5_cube(path)
    names, shape = _maps_of_hdf5(path)
    check_memory(path, prod(shape), 8)
    out = np.empty(shape, np.float32)
    for k, name in enumerate(names):
        out[..., k] = read_hdf5(path, name, shape[:2])
    return out


def _maps_of_hdf5(path: Path) -> tuple[list[str], tuple[int, ...]]:
    """Return the full names of the maps, and (lines, samples, maps)."""
    found = {name: shape for name, shape in list_hdf5(path, RESULTS).items() if len(shape) == 2}
    groups = sorted({name.rpartition("/")[0] for name in found})
    if len(groups) != 1 or len(set(found.values())) != 1:
        raise unreadable(
            path,
            "HDF5 is read where PyMca wrote maps into it",
            field="format",
            found=", ".join(groups[:4]) or f"HDF5 without a group {RESULTS}",
            expected=f"one group {RESULTS} with maps of one size",
            fix="Save the maps as ENVI, as a TIFF with one page per map, or as a table from PyMca.",
        )
    shape = (*next(iter(found.values())), len(found))
    check_size(path, shape, field="lines, samples, maps")
    return list(found), shape


# --- tables of PyMca


def read_table_facts(path: Path) -> Facts:
    """Return the facts of a table by its first and last line.

    Raises
    ------
    UnreadableCapture
    """
    names, separator, columns = _columns(path)
    with path.open("rb") as file:
        size = file.seek(0, io.SEEK_END)
        file.seek(max(0, size - MOST_HEADER))
        last = file.read().decode("latin-1").strip().splitlines()[-1].split(separator)
    try:
        height, width = (int(float(cell)) + 1 for cell in last[:2])
    except ValueError:
        height = width = 0
    shape = (height, width, len(names))
    check_size(path, shape, field="row, column")
    if size > LARGEST_TABLE:
        raise unreadable(
            path,
            "the table is too large",
            code="E_SIZE",
            found=f"{size} bytes",
            expected=f"at most {LARGEST_TABLE}",
        )
    check_memory(path, prod(shape), 8)
    left = columns - 2 - len(names)
    notes = (
        (f"{left} columns with standard deviations or the quality of the fit are not read",)
        if left
        else ()
    )
    return Facts(path, "table", shape, "float32", band_names=_named(names, len(names)), notes=notes)


def read_table(path: Path) -> np.ndarray:
    """Read a table, (lines, samples, maps) float32."""
    facts = read_table_facts(path)
    names, separator, _ = _columns(path)
    assert facts.band_names is None or len(facts.band_names) == len(names)
    header = _header(path, separator)
    wanted = [0, 1, *(i for i, name in enumerate(header) if i > 1 and _is_map(name))]
    with decoding(path, "table of maps"):
        rows = np.loadtxt(
            path,
            np.float64,
            delimiter=separator,
            skiprows=1,
            usecols=wanted,
            ndmin=2,
            encoding="latin-1",
        )
    height, width, maps = facts.shape
    places = np.stack(np.meshgrid(np.arange(height), np.arange(width), indexing="ij"), -1)
    if not np.array_equal(rows[:, :2], places.reshape(-1, 2)):
        raise truncated(
            path,
            "the table does not list every pixel once, row by row",
            "row, column",
            f"{len(rows)} lines",
            f"{height} x {width} pixels",
        )
    return rows[:, 2:].astype(np.float32).reshape(height, width, maps)


def _is_map(name: str) -> bool:
    return not name.lower().startswith(NOT_MAPS)


def _columns(path: Path) -> tuple[tuple[str, ...], str, int]:
    """Return the names of the maps of a table, its separator, and how many columns it has."""
    first = _head(path).decode("latin-1").partition("\n")[0]
    separator = next((one for one in SEPARATORS if one in first), ",")
    header = _header(path, separator)
    names = tuple(name for name in header[2:] if _is_map(name))
    if [name.lower() for name in header[:2]] != ["row", "column"] or not names:
        raise unreadable(
            path,
            "this is no table of maps",
            field="columns",
            found=first[:80],
            expected="row;column;NAME;… as PyMca writes it",
            fix="Export the maps as TIFF, ENVI or a table from PyMca.",
        )
    return names, separator, len(header)


def _header(path: Path, separator: str) -> list[str]:
    first = _head(path).decode("latin-1").partition("\n")[0]
    cells = next(csv.reader([first.strip("\r")], delimiter=separator), [])
    return [cell.strip().strip('"') for cell in cells]


# --- common


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(MOST_HEADER)
    except OSError as error:
        raise unreadable(path, "the file cannot be opened", found=str(error)) from error


def _named(names: tuple[str, ...], count: int) -> tuple[str, ...] | None:
    """Return names where there are as many as maps, all different; None otherwise."""
    return names if len(names) == count and len(set(names)) == count else None


def _stack(
    path: Path,
    data: Path,
    offset: int,
    layout: str,
    shape: tuple[int, ...],
    by_map: bool,
    names: tuple[str, ...] = (),
) -> Stack:
    """Return a stack whose size was checked against its data."""
    check_size(path, shape, field="width, height, maps")
    needed = offset + prod(shape) * np.dtype(layout).itemsize
    try:
        size = data.stat().st_size
    except OSError as error:
        raise unreadable(
            path,
            "the numbers of the stack are not there",
            found=str(error),
            expected=data.name,
            fix=f"Put {data.name} beside {path.name}.",
        ) from error
    if size < needed:
        raise truncated(
            data,
            "the stack is truncated",
            "width, height, maps",
            f"{size} bytes",
            f"{needed} bytes",
        )
    dtype = np.dtype(layout)
    facts = Facts(
        path,
        "dms" if path == data else "ripple",
        shape,
        dtype.newbyteorder("=").name,
        band_names=_named(names, shape[2]),
    )
    return Stack(facts, data, offset, layout, by_map)
