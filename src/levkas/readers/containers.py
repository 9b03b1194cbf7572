"""Cubes in files of arrays, HDF5 (``.h5``, ``.hdf5``, MATLAB 7.3) and MATLAB 5 (``.mat``), and stacks of maps of X-ray fluorescence.

- A cube: one array of three axes, its wavelengths beside it. Which axis is that of the bands is known by them; of MATLAB
  files without them by MATLAB's own order, (lines, samples, bands).
- PyMca's HDF5: each map a data set of a group ``…/results/parameters``.
- Ripple: a text ``.rpl`` of keys and values, and beside it the numbers, ``.raw``, of the same name.
"""

from __future__ import annotations

from collections.abc import Callable
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from levkas.readers.arrays import list_hdf5, read_hdf5, reading
from levkas.readers.facts import (
    Facts,
    check_memory,
    check_ratio,
    check_size,
    decoding,
    refused,
)
from levkas.readers.wavelengths import read_centres

WAVELENGTHS = (
    *("wavelengths", "wavelength", "wavelengths_nm", "wavelength_nm", "wl", "wvl", "lambda"),
    *("wave", "waves", "wavenm", "centers", "centres", "bands"),
)
"""Names of the list of wavelengths, lower case, what is usual first; ``bands`` in files of the spectral recovery challenges."""
LONGEST_LIST = 10_000
MATLAB_73 = b"MATLAB 7.3 MAT-fil"
LARGEST_RATIO = 1100
"""Of deflate, which MATLAB packs variables with: no more than 1032 to 1."""
CLASSES = {
    "double": "float64",
    "single": "float32",
    **{f"{sign}int{n}": f"{sign}int{n}" for sign in ("", "u") for n in (8, 16, 32, 64)},
}
"""MATLAB's classes of numbers, and numpy's."""
RESULTS = "results/parameters"
"""End of the name of the group in which PyMca writes the maps of a fit."""
MOST_HEADER = 1 << 16
"""Bytes of the header of a Ripple stack."""
RIPPLE_TYPES = {"signed": "i", "unsigned": "u", "float": "f"}
RIPPLE_SIZES = {"i": (1, 2, 4, 8), "u": (1, 2, 4, 8), "f": (4, 8)}
ORDERS = {"little-endian": "<", "big-endian": ">"}


Listed = dict[str, tuple[tuple[int, ...], str]]
"""Shape and type of the arrays of a file, by their names."""
Cube = tuple[str, tuple[int, int, int], Facts]
"""Where the cube of a file lies: the name of the array, its axes (lines, samples, bands), and its facts."""


# --- HDF5: the maps of PyMca, or one cube --------------------------------------------------------


def read_hdf5_facts(path: Path) -> Facts:
    """Return the facts of the maps in an HDF5 file of PyMca, or of the cube in one of another program; raises UnreadableCapture."""
    if not (maps := list_hdf5(path, RESULTS)):
        return _cube_of_hdf5(path)[2]
    names, shape = _stack_of(path, maps)
    labels = tuple(name.rpartition("/")[2] for name in names)
    return Facts(path, "hdf5", shape, "float32", band_names=labels)


def read_hdf5_frame(path: Path) -> np.ndarray:
    """Read the maps in an HDF5 file of PyMca, (lines, samples, maps) float32, or the cube in one of another program."""
    if not (maps := list_hdf5(path, RESULTS)):
        name, axes, facts = _cube_of_hdf5(path)
        shape = tuple(facts.shape[axes.index(axis)] for axis in range(3))
        matlab = _is_matlab(path)
        values = read_hdf5(path, name, shape[::-1] if matlab else shape)
        return np.ascontiguousarray((values.T if matlab else values).transpose(axes))
    names, shape = _stack_of(path, maps)
    out = np.empty(shape, np.float32)
    for k, name in enumerate(names):
        out[..., k] = read_hdf5(path, name, shape[:2])
    return out


def _stack_of(path: Path, maps: Listed) -> tuple[list[str], tuple[int, ...]]:
    """Return the full names of PyMca's maps, and (lines, samples, maps)."""
    found = {name: shape for name, (shape, _) in maps.items() if len(shape) == 2}
    groups = sorted({name.rpartition("/")[0] for name in found})
    if len(groups) != 1 or len(set(found.values())) != 1:
        expected = f"one group {RESULTS} with maps of one size"
        raise refused(path, "cube", ", ".join(groups[:4]), expected=expected)
    shape = (*next(iter(found.values())), len(found))
    check_size(path, shape, field="lines, samples, maps")
    check_memory(path, prod(shape), 8)
    return list(found), shape


def _is_matlab(path: Path) -> bool:
    """Whether a file is MATLAB 7.3, whose axes HDF5 shows the other way round."""
    with path.open("rb") as file:
        return file.read(len(MATLAB_73)) == MATLAB_73


def _cube_of_hdf5(path: Path) -> Cube:
    listed, matlab = list_hdf5(path), _is_matlab(path)
    turned = {n: (s[::-1], d) for n, (s, d) in listed.items()} if matlab else listed
    return _find_cube(path, "hdf5-cube", turned, lambda n: read_hdf5(path, n, listed[n][0]), matlab)


# --- MATLAB 5 ---------------------------------------------------------------------------------


def read_mat_facts(path: Path) -> Facts:
    """Return the facts of the cube in a MAT-file of version 5; raises UnreadableCapture."""
    return _cube_of_mat(path)[2]


def read_mat(path: Path) -> np.ndarray:
    """Read the cube of a MAT-file of version 5, (lines, samples, bands)."""
    name, axes, _ = _cube_of_mat(path)
    return np.ascontiguousarray(_load(path, name).transpose(axes))


def _cube_of_mat(path: Path) -> Cube:
    from scipy.io import whosmat

    with reading(path, "a MATLAB file"):
        found = whosmat(path, appendmat=False)
    listed = {
        str(n): (tuple(map(int, s)), CLASSES[kind]) for n, s, kind in found if kind in CLASSES
    }
    needed = max((prod(s) * np.dtype(dtype).itemsize for s, dtype in listed.values()), default=0)
    check_ratio(path, needed, path.stat().st_size, ratio=LARGEST_RATIO)
    return _find_cube(path, "mat", listed, lambda name: _load(path, name), True)


def _load(path: Path, name: str) -> np.ndarray:
    from scipy.io import loadmat

    with reading(path, "a MATLAB file"):
        options = {"variable_names": [name], "appendmat": False, "mat_dtype": True}
        found = np.asarray(loadmat(path, **options)[name])
        if found.dtype.kind not in "buif":
            raise TypeError(f"{name} has numbers of the kind {found.dtype}")
        return found


# --- which array is the cube, and which axis that of its bands -----------------------------------


def _find_cube(
    path: Path, kind: str, listed: Listed, read: Callable[[str], np.ndarray], known: bool
) -> Cube:
    """Find the only array of three axes, and its bands by a list of wavelengths beside it, else by an order that is `known`."""
    cubes = [name for name, (shape, _) in listed.items() if len(shape) == 3 and min(shape) > 0]
    if len(cubes) != 1:
        found = ", ".join((cubes or list(listed))[:6]) or "no array of numbers"
        raise refused(path, "cube", found, expected="one array of three axes")
    name = cubes[0]
    shape, dtype = listed[name]
    lists = {n: prod(s) for n, (s, _) in listed.items() if 1 < max(s, default=0) == prod(s)}
    named = {n: n.rpartition("/")[2].lower() for n, size in lists.items() if size in shape}
    fitting = [n for n in named if named[n] in WAVELENGTHS and lists[n] <= LONGEST_LIST]
    centres = None
    if fitting:
        waves = read(min(fitting, key=lambda n: (WAVELENGTHS.index(named[n]), n))).ravel().tolist()
        centres = read_centres(waves).nm if len(set(waves)) == len(waves) else None
    among = [axis for axis in range(3) if centres and shape[axis] == len(centres)]
    if len(among) != 1 and not known:
        found = f"{name} of {' x '.join(map(str, shape))}, {len(centres or ())} wavelengths"
        expected = "a list of wavelengths beside it, as long as one axis, that of the bands"
        raise refused(path, "cube", found, expected=expected)
    band = among[0] if len(among) == 1 else 2
    lines, samples = (axis for axis in range(3) if axis != band)
    if centres and len(centres) != shape[band]:
        centres = None
    size = shape[lines], shape[samples], shape[band]
    check_size(path, size, field="lines, samples, bands")
    check_memory(path, prod(size), 8)
    return name, (lines, samples, band), Facts(path, kind, size, dtype, wavelengths=centres)


# --- Ripple -----------------------------------------------------------------------------------


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
    beside = path.with_suffix(".raw"), path.with_suffix(".RAW")
    return next((p for p in beside if p.is_file()), beside[0])


def _open_ripple(path: Path) -> tuple[Facts, int, np.dtype[Any], bool]:
    """Return the facts, the bytes before the first number, its type, and whether map follows map."""
    keys: dict[str, str] = {}
    with decoding(path, "header of the stack"), path.open("rb") as file:
        head = file.read(MOST_HEADER).decode("latin-1")
    for line in head.splitlines():
        parts = line.replace(",", "\t").split(None, 1)
        if len(parts) == 2:
            keys.setdefault(parts[0].strip().lower(), parts[1].strip().lower())

    def whole(key: str) -> int:
        text = keys.get(key, "")
        if text.isascii() and text.isdigit() and len(text) < 16:
            return int(text)
        raise refused(path, "Ripple", text or "no such key", key=key, expected="a whole number")

    shape = whole("height"), whole("width"), whole("depth")
    kind, size = RIPPLE_TYPES.get(keys.get("data-type", ""), ""), whole("data-length")
    order, record = keys.get("byte-order", "dont-care"), keys.get("record-by", "dont-care")
    if size not in RIPPLE_SIZES.get(kind, ()):
        found, expected = f"{keys.get('data-type')} of {size} bytes", "signed, unsigned or float"
        words = {"key": "data-type, data-length", "expected": f"{expected} of 1 to 8"}
        raise refused(path, "Ripple", found, **words)
    if size > 1 and order not in ORDERS:
        raise refused(path, "Ripple", order, key="byte-order", expected=" or ".join(ORDERS))
    if record not in ("image", "vector") and shape[2] > 1:
        expected = "image (map after map) or vector (pixel after pixel)"
        raise refused(path, "Ripple", record, key="record-by", expected=expected)
    offset = whole("offset") if "offset" in keys else 0
    dtype, data = np.dtype(f"{ORDERS.get(order, '|')}{kind}{size}"), ripple_data(path)
    check_size(path, shape, field="width, height, maps")
    needed, there = offset + prod(shape) * size, data.stat().st_size if data.is_file() else 0
    if there < needed:
        words = {"field": "width, height, maps", "expected": f"{needed} bytes"}
        raise refused(path, "cut", f"{there} bytes in {data.name}", **words)
    facts = Facts(path, "ripple", shape, dtype.newbyteorder("=").name)
    return facts, offset, dtype, record != "vector"
