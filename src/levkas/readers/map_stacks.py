"""Stacks of maps as programs for X-ray fluorescence write them: Ripple, and HDF5 of PyMca.

- Ripple: a text ``.rpl`` of keys and values (width, height, depth, offset, data-length, data-type, byte-order, record-by), and beside it the
  numbers, ``.raw``, of the same name.
- HDF5 of PyMca, ``.h5``: each map a data set of a group ``…/results/parameters``. It needs h5py.
"""

from __future__ import annotations

from math import prod
from pathlib import Path
from typing import Any

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


def read_ripple_facts(path: Path) -> Facts:
    """Return the facts of a Ripple stack by its .rpl; raises UnreadableCapture."""
    return _open_ripple(path)[0]


def read_ripple(path: Path) -> np.ndarray:
    """Read a Ripple stack, (lines, samples, maps), native byte order."""
    facts, offset, dtype, by_map = _open_ripple(path)
    lines, samples, maps = facts.shape
    check_memory(path, prod(facts.shape), dtype.itemsize)
    with decoding(path, "stack of maps"):
        values = np.fromfile(ripple_data(path), dtype, prod(facts.shape), offset=offset)
        stored = values.reshape((maps, lines, samples) if by_map else facts.shape)
    found = np.moveaxis(stored, 0, -1) if by_map else stored
    return np.ascontiguousarray(found, dtype.newbyteorder("="))


def ripple_data(path: Path) -> Path:
    """Return the file of the numbers beside an .rpl, whatever the case of its suffix."""
    return next(
        (p for p in (path.with_suffix(".raw"), path.with_suffix(".RAW")) if p.is_file()),
        path.with_suffix(".raw"),
    )


def _open_ripple(path: Path) -> tuple[Facts, int, np.dtype[Any], bool]:
    """Return the facts, the bytes before the first number, its type, and whether map follows map."""
    keys: dict[str, str] = {}
    with decoding(path, "header of the stack"), path.open("rb") as file:
        head = file.read(MOST_HEADER).decode("latin-1")
    for line in head.splitlines():
        parts = line.replace(",", "\t").split(None, 1)
        if len(parts) == 2:
            keys.setdefault(parts[0].strip().lower(), parts[1].strip().lower())
    shape = tuple(_whole(path, keys, key) for key in ("height", "width", "depth"))
    kind = RIPPLE_TYPES.get(keys.get("data-type", ""), "")
    size = _whole(path, keys, "data-length")
    order, record = keys.get("byte-order", "dont-care"), keys.get("record-by", "dont-care")
    if size not in RIPPLE_SIZES.get(kind, ()):
        found = f"{keys.get('data-type')} of {size} bytes"
        raise _refused(path, "data-type, data-length", found, "signed, unsigned or float of 1 to 8")
    if size > 1 and order not in ORDERS:
        raise _refused(path, "byte-order", order, " or ".join(ORDERS))
    if record not in ("image", "vector") and shape[2] > 1:
        raise _refused(
            path, "record-by", record, "image (map after map) or vector (pixel after pixel)"
        )
    offset = _whole(path, keys, "offset") if "offset" in keys else 0
    dtype, data = np.dtype(f"{ORDERS.get(order, '|')}{kind}{size}"), ripple_data(path)
    check_size(path, shape, field="width, height, maps")
    needed, there = offset + prod(shape) * size, data.stat().st_size if data.is_file() else 0
    if there < needed:
        what = f"{data.name} beside it is truncated or missing"
        raise truncated(path, what, "width, height, maps", f"{there} bytes", f"{needed} bytes")
    return (
        Facts(path, "ripple", shape, dtype.newbyteorder("=").name),
        offset,
        dtype,
        record != "vector",
    )


def _refused(path: Path, field: str, found: str, expected: str) -> Exception:
    fix = "Correct the .rpl."
    return unreadable(
        path, f"`{field}` is not understood", field=field, found=found, expected=expected, fix=fix
    )


def _whole(path: Path, keys: dict[str, str], key: str) -> int:
    text = keys.get(key, "")
    if text.isascii() and text.isdigit() and len(text) < 16:
        return int(text)
    raise _refused(path, key, text or "no such key", "a whole number")


# --- HDF5 of PyMca


def read_hdf5_facts(path: Path) -> Facts:
    """Return the facts of the maps in an HDF5 file of PyMca, or of the cube in one of another program; raises UnreadableCapture."""
    if not list_hdf5(path, RESULTS):
        return read_hdf5_cube_facts(path)
    names, shape = _maps_of_hdf5(path)
    check_memory(path, prod(shape), 8)
    labels = tuple(name.rpartition("/")[2] for name in names)
    return Facts(path, "hdf5", shape, "float32", band_names=labels)


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
