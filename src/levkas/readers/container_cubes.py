"""Cubes in files of arrays: HDF5 (``.h5``, ``.hdf5``, MATLAB 7.3) and MATLAB 5 (``.mat``), one cube a file with its wavelengths beside it.

Which axis is that of the bands is known by the wavelengths; of MATLAB files without them by MATLAB's own order, (lines, samples, bands).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from levkas.readers.arrays import DAMAGE, list_hdf5, read_hdf5
from levkas.readers.facts import Facts, check_memory, check_ratio, check_size, unreadable
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
FIX = "Save it as ENVI, or with one array of three axes and its wavelengths as `wavelengths`."


@dataclass(frozen=True)
class _Cube:
    """Where the cube of a file lies: the name of the array, its shape, its axes (lines, samples, bands), its wavelengths in nm."""

    name: str
    shape: tuple[int, ...]
    axes: tuple[int, int, int]
    wavelengths: tuple[float, ...] | None
    dtype: str

    def facts(self, path: Path, kind: str) -> Facts:
        shape = tuple(self.shape[axis] for axis in self.axes)
        check_size(path, shape, field="lines, samples, bands")
        check_memory(path, prod(shape), 8)
        return Facts(path, kind, shape, self.dtype, wavelengths=self.wavelengths)


def read_hdf5_cube_facts(path: Path) -> Facts:
    """Return the facts of the cube in an HDF5 file.

    Raises UnreadableCapture where it has no array of three axes or several, or the axis of the bands is not known.
    """
    return _find_hdf5(path).facts(path, "hdf5-cube")


def read_hdf5_cube(path: Path) -> np.ndarray:
    """Read the cube of an HDF5 file, (lines, samples, bands)."""
    cube = _find_hdf5(path)
    cube.facts(path, "hdf5-cube")
    stored = cube.shape[::-1] if _is_matlab(path) else cube.shape
    values = read_hdf5(path, cube.name, stored)
    values = values.T if _is_matlab(path) else values
    return np.ascontiguousarray(values.transpose(cube.axes))


def read_mat_facts(path: Path) -> Facts:
    """Return the facts of the cube in a MAT-file of version 5; raises as `read_hdf5_cube_facts`."""
    return _find_mat(path).facts(path, "mat")


def read_mat(path: Path) -> np.ndarray:
    """Read the cube of a MAT-file of version 5, (lines, samples, bands)."""
    cube = _find_mat(path)
    cube.facts(path, "mat")
    return np.ascontiguousarray(_load(path, cube.name).transpose(cube.axes))


def _is_matlab(path: Path) -> bool:
    """Whether a file is MATLAB 7.3, whose axes HDF5 shows the other way round."""
    with path.open("rb") as file:
        return file.read(len(MATLAB_73)) == MATLAB_73


def _find_hdf5(path: Path) -> _Cube:
    shapes, matlab = list_hdf5(path), _is_matlab(path)
    name = _only_cube(path, shapes)
    waves = next(
        (read_hdf5(path, key, shapes[key]).ravel() for key in _lists_of_wavelengths(shapes, name)),
        None,
    )
    import h5py  # `list_hdf5` has refused where it is not installed

    with h5py.File(path, "r") as opened:
        dtype = opened[name].dtype.name
    shape = shapes[name][::-1] if matlab else shapes[name]
    return _cube(path, name, shape, dtype, waves, matlab=matlab)


def _find_mat(path: Path) -> _Cube:
    from scipy.io import whosmat

    try:
        listed = whosmat(path, appendmat=False)
    except DAMAGE as error:
        raise _damaged(path, error) from None
    shapes = {str(name): tuple(map(int, shape)) for name, shape, kind in listed if kind in CLASSES}
    name = _only_cube(path, shapes)
    dtype = next(CLASSES[kind] for key, _, kind in listed if key == name)
    size = prod(shapes[name]) * np.dtype(dtype).itemsize
    check_ratio(path, size, path.stat().st_size, ratio=LARGEST_RATIO)
    waves = next((_load(path, key).ravel() for key in _lists_of_wavelengths(shapes, name)), None)
    return _cube(path, name, shapes[name], dtype, waves)


def _load(path: Path, name: str) -> np.ndarray:
    from scipy.io import loadmat

    try:
        found = np.asarray(
            loadmat(path, variable_names=[name], appendmat=False, mat_dtype=True)[name]
        )
    except DAMAGE as error:
        raise _damaged(path, error) from None
    if found.dtype.kind not in "buif":
        raise _damaged(path, TypeError(f"{name} has numbers of the kind {found.dtype}"))
    return found


def _damaged(path: Path, error: BaseException) -> Exception:
    reason = " ".join(str(error).split())[:160] or type(error).__name__
    return unreadable(path, "the MATLAB file cannot be read", found=reason, fix=FIX)


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


def _cube(
    path: Path, name: str, shape: tuple[int, ...], dtype: str, waves: Any, *, matlab: bool = True
) -> _Cube:
    """Name the axes of a cube; of MATLAB's without wavelengths, (lines, samples, bands) as they are given here."""
    found = None
    if waves is not None and len(set(waves.tolist())) == len(waves):
        found = read_centres([float(one) for one in waves]).nm
    fitting = [axis for axis in range(3) if found and shape[axis] == len(found)]
    if len(fitting) != 1 and not matlab:
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
    centres = found if found and shape[band] == len(found) else None
    return _Cube(name, shape, (lines, samples, band), centres, dtype)
