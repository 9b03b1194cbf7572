"""Cubes in files of arrays, HDF5 (``.h5``, ``.hdf5``, MATLAB 7.3) and MATLAB 5 (``.mat``), and stacks of maps of X-ray fluorescence.

- A cube: one array of three axes, its wavelengths beside it. Which axis is that of the bands is known by them; of MATLAB
  files without them by MATLAB's own order, (lines, samples, bands).
- PyMca's HDF5: each map a data set of a group ``…/results/parameters``.
- Ripple: a text ``.rpl`` of keys and values, and beside it the numbers, ``.raw``, of the same name.
"""

from __future__ import annotations

from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from levkas.readers.arrays import list_hdf5, read_hdf5, reading
from levkas.readers.facts import (
    Facts,
    check_memory,
    check_ratio,
    check_size,
    decoding,
    truncated,
    unreadable,
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
FIX = "Save it as ENVI, or with one array of three axes and its wavelengths as `wavelengths`."


class _Cube(NamedTuple):
    """Where the cube of a file lies: the name of the array, its axes (lines, samples, bands), and its facts."""

    name: str
    axes: tuple[int, int, int]
    facts: Facts


# --- HDF5: the maps of PyMca, or one cube --------------------------------------------------------


def read_hdf5_facts(path: Path) -> Facts:
    """Return the facts of the maps in an HDF5 file of PyMca, or of the cube in one of another program; raises UnreadableCapture."""
    if not list_hdf5(path, RESULTS):
        return _find_hdf5(path).facts
    names, shape = _maps_of(path)
    check_memory(path, prod(shape), 8)
    labels = tuple(name.rpartition("/")[2] for name in names)
    return Facts(path, "hdf5", shape, "float32", band_names=labels)


def read_hdf5_frame(path: Path) -> np.ndarray:
    """Read the maps in an HDF5 file of PyMca, (lines, samples, maps) float32, or the cube in one of another program."""
    if not list_hdf5(path, RESULTS):
        cube = _find_hdf5(path)
        shape = list_hdf5(path)[cube.name][0]
        values = read_hdf5(path, cube.name, shape)
        values = values.T if _is_matlab(path) else values
        return np.ascontiguousarray(values.transpose(cube.axes))
    names, shape = _maps_of(path)
    check_memory(path, prod(shape), 8)
    out = np.empty(shape, np.float32)
    for k, name in enumerate(names):
        out[..., k] = read_hdf5(path, name, shape[:2])
    return out


def _maps_of(path: Path) -> tuple[list[str], tuple[int, ...]]:
    """Return the full names of PyMca's maps, and (lines, samples, maps)."""
    listed = list_hdf5(path, RESULTS)
    found = {name: shape for name, (shape, _) in listed.items() if len(shape) == 2}
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


def _is_matlab(path: Path) -> bool:
    """Whether a file is MATLAB 7.3, whose axes HDF5 shows the other way round."""
    with path.open("rb") as file:
        return file.read(len(MATLAB_73)) == MATLAB_73


def _find_hdf5(path: Path) -> _Cube:
    listed, matlab = list_hdf5(path), _is_matlab(path)
    shapes = {name: shape for name, (shape, _) in listed.items()}
    name = _only_cube(path, shapes)
    lists = _lists_of_wavelengths(shapes, name)
    waves = read_hdf5(path, lists[0], shapes[lists[0]]).ravel() if lists else None
    shape, dtype = listed[name]
    shape = shape[::-1] if matlab else shape
    axes, centres = _axes_of(path, name, shape, waves, known=matlab)
    return _Cube(name, axes, _cube_facts(path, "hdf5-cube", shape, axes, dtype, centres))


# --- MATLAB 5 ---------------------------------------------------------------------------------


def read_mat_facts(path: Path) -> Facts:
    """Return the facts of the cube in a MAT-file of version 5; raises UnreadableCapture."""
    return _find_mat(path).facts


def read_mat(path: Path) -> np.ndarray:
    """Read the cube of a MAT-file of version 5, (lines, samples, bands)."""
    cube = _find_mat(path)
    return np.ascontiguousarray(_load(path, cube.name).transpose(cube.axes))


def _find_mat(path: Path) -> _Cube:
    from scipy.io import whosmat

    with reading(path, "a MATLAB file"):
        listed = whosmat(path, appendmat=False)
    shapes = {str(name): tuple(map(int, shape)) for name, shape, kind in listed if kind in CLASSES}
    name = _only_cube(path, shapes)
    dtype = next(CLASSES[kind] for key, _, kind in listed if key == name)
    size = prod(shapes[name]) * np.dtype(dtype).itemsize
    check_ratio(path, size, path.stat().st_size, ratio=LARGEST_RATIO)
    lists = _lists_of_wavelengths(shapes, name)
    waves = _load(path, lists[0]).ravel() if lists else None
    axes, centres = _axes_of(path, name, shapes[name], waves, known=True)
    return _Cube(name, axes, _cube_facts(path, "mat", shapes[name], axes, dtype, centres))


def _load(path: Path, name: str) -> np.ndarray:
    from scipy.io import loadmat

    with reading(path, "a MATLAB file"):
        options = {"variable_names": [name], "appendmat": False, "mat_dtype": True}
        found = np.asarray(loadmat(path, **options)[name])
        if found.dtype.kind not in "buif":
            raise TypeError(f"{name} has numbers of the kind {found.dtype}")
        return found


# --- which array is the cube, and which axis that of its bands -----------------------------------


def _only_cube(path: Path, shapes: dict[str, tuple[int, ...]]) -> str:
    cubes = [name for name, shape in shapes.items() if len(shape) == 3 and min(shape) > 0]
    if len(cubes) != 1:
        raise unreadable(
            path,
            "the file has not one cube" if cubes else "the file has no cube",
            field="format",
            found=", ".join(cubes[:6]) or ", ".join(list(shapes)[:6]) or "no array of numbers",
            expected="one array of three axes",
            fix=FIX,
        )
    return cubes[0]


def _lists_of_wavelengths(shapes: dict[str, tuple[int, ...]], cube: str) -> list[str]:
    """Return the names of lists that are called as wavelengths are and are as long as an axis of the cube, what is usual first."""
    plain = {name: name.rpartition("/")[2].lower() for name in shapes}
    fitting = [
        name
        for name, shape in shapes.items()
        if plain[name] in WAVELENGTHS
        and 1 < max(shape, default=0) == prod(shape) <= LONGEST_LIST
        and prod(shape) in shapes[cube]
    ]
    return sorted(fitting, key=lambda name: (WAVELENGTHS.index(plain[name]), name))


def _axes_of(
    path: Path, name: str, shape: tuple[int, ...], waves: Any, *, known: bool
) -> tuple[tuple[int, int, int], tuple[float, ...] | None]:
    """Return the axes (lines, samples, bands) of a cube, in this order where it is `known`, and its wavelengths."""
    found = None
    if waves is not None and len(set(waves.tolist())) == len(waves):
        found = read_centres([float(one) for one in waves]).nm
    fitting = [axis for axis in range(3) if found and shape[axis] == len(found)]
    if len(fitting) != 1 and not known:
        raise unreadable(
            path,
            "it is not known which axis of the cube is that of the bands",
            field="format",
            found=f"{name} of {' x '.join(map(str, shape))}, {len(found or ())} wavelengths",
            expected="a list of wavelengths beside it, as long as one axis",
            fix=FIX,
        )
    band = fitting[0] if len(fitting) == 1 else 2
    lines, samples = (axis for axis in range(3) if axis != band)
    return (lines, samples, band), found if found and shape[band] == len(found) else None


def _cube_facts(
    path: Path,
    kind: str,
    stored: tuple[int, ...],
    axes: tuple[int, int, int],
    dtype: str,
    centres: tuple[float, ...] | None,
) -> Facts:
    shape = tuple(stored[axis] for axis in axes)
    check_size(path, shape, field="lines, samples, bands")
    check_memory(path, prod(shape), 8)
    return Facts(path, kind, shape, dtype, wavelengths=centres)


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
        raise _not_understood(path, key, text or "no such key", "a whole number")

    shape = whole("height"), whole("width"), whole("depth")
    kind, size = RIPPLE_TYPES.get(keys.get("data-type", ""), ""), whole("data-length")
    order, record = keys.get("byte-order", "dont-care"), keys.get("record-by", "dont-care")
    if size not in RIPPLE_SIZES.get(kind, ()):
        found, expected = f"{keys.get('data-type')} of {size} bytes", "signed, unsigned or float"
        raise _not_understood(path, "data-type, data-length", found, f"{expected} of 1 to 8")
    if size > 1 and order not in ORDERS:
        raise _not_understood(path, "byte-order", order, " or ".join(ORDERS))
    if record not in ("image", "vector") and shape[2] > 1:
        expected = "image (map after map) or vector (pixel after pixel)"
        raise _not_understood(path, "record-by", record, expected)
    offset = whole("offset") if "offset" in keys else 0
    dtype, data = np.dtype(f"{ORDERS.get(order, '|')}{kind}{size}"), ripple_data(path)
    check_size(path, shape, field="width, height, maps")
    needed, there = offset + prod(shape) * size, data.stat().st_size if data.is_file() else 0
    if there < needed:
        what = f"{data.name} beside it is truncated or missing"
        raise truncated(path, what, "width, height, maps", f"{there} bytes", f"{needed} bytes")
    facts = Facts(path, "ripple", shape, dtype.newbyteorder("=").name)
    return facts, offset, dtype, record != "vector"


def _not_understood(path: Path, field: str, found: str, expected: str) -> Exception:
    more = {"found": found, "expected": expected, "fix": "Correct the .rpl."}
    return unreadable(path, f"`{field}` is not understood", field=field, **more)
