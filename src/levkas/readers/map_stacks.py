"""Stacks of maps as programs for X-ray fluorescence write them: Ripple, and HDF5 of PyMca.

- Ripple: a text ``.rpl`` of keys and values (width, height, depth, offset, data-length, data-type, byte-order, record-by), and beside it the
  numbers, ``.raw``, of the same name.
- HDF5 of PyMca, ``.h5``: each map a data set of a group ``…/results/parameters``. It needs h5py.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import prod
from pathlib import Path

import numpy as np

from levkas.readers.arrays import list_hdf5, read_hdf5
from levkas.readers.container_cubes import read_hdf5_cube, read_hdf5_cube_facts
from levkas.readers.facts import Facts, check_memory, check_size, decoding, truncated, unreadable

MOST_HEADER = 1 << 16
"""Bytes of the header of a stack."""
RIPPLE_TYPES = {"signed": "i", "unsigned": "u", "float": "f"}
RIPPLE_SIZES = {"i": (1, 2, 4, 8), "u": (1, 2, 4, 8), "f": (4, 8)}
ORDERS = {"little-endian": "<", "big-endian": ">"}
RESULTS = "results/parameters"
"""End of the name of the group in which PyMca writes the maps of a fit."""


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
            fix="Save the maps as ENVI, or as a TIFF with one page per map.",
        )
    shape = (*next(iter(found.values())), len(found))
    check_size(path, shape, field="lines, samples, maps")
    return list(found), shape


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
    facts = Facts(path, "ripple", shape, dtype.newbyteorder("=").name)
    return Stack(facts, data, offset, layout, by_map)
