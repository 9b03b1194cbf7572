"""Cubes in files of arrays: HDF5 (``.h5``, ``.hdf5``, MATLAB 7.3) and MATLAB 5 (``.mat``), one cube a file with its wavelengths beside it.

Which axis is that of the bands is known by the wavelengths; of MATLAB files without them by MATLAB's own order, (lines, samples, bands).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import prod
from pathlib import Path

import numpy as np

from levkas.readers.arrays import DAMAGE, list_hdf5, read_hdf5
from levkas.readers.facts import Facts, check_memory, check_ratio, check_size, unreadable

WAVELENGTHS = (
    *("wavelengths", "wavelength", "wavelengths_nm", "wavelength_nm", "wl", "wvl", "lambda"),
    *("wave", "waves", "wavenm", "centers", "centres", "bands"),
)
"""Names of the list of wavelengths, lower case, what is usual first; ``bands`` in files of the spectral recovery challenges."""
SHORTEST_UM, LONGEST_UM = 0.1, 20.0
"""Wavelengths in this range are micrometres: 100 to 20,000 nm."""
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

    Raises
    ------
    UnreadableCapture
        Where it has no array of three axes or several, or the axis of the bands is not known; ``E_MISSING`` without h5py.
    """
    return _find_hdf5(path).facts(path, "hdf5-cube")


def read_hdf5_cube(path: Path) -> np.ndarray:
    """Read the cube of an HDF5 file, (lines, samples, bands)."""
    cube = _find_hdf5(path)
    cube.facts(path, "hdf5-cube")
    return np.ascontiguousarray(read_hdf5(path, cube.name, cube.shape).transpose(cube.axes))


def read_mat_facts(path: Path) -> Facts:
    """Return the facts of the cube in a MAT-file of version 5.

    Raises
    ------
    UnreadableCapture
        As of `read_hdf5_cube_facts`.
    """
    return _find_mat(path).facts(path, "mat")


def read_mat(path: Path) -> np.ndarray:
    """Read the cube of a MAT-file of version 5, (lines, samples, bands)."""
    cube = _find_mat(path)
    cube.facts(path, "mat")
    return np.ascontiguousarray(_load(path, cube.name).transpose(cube.axes))


def _find_hdf5(path: Path) -> _Cube:
    with path.open("rb") as file:
        reverse = file.read(len(MATLAB_73)) == MATLAB_73
    shapes = list_hdf5(path)
    name = _only_cube(path, shapes)
    waves = next(
        (read_hdf5(path, key, shapes[key]).ravel() for key in _lists_of_wavelengths(shapes, name)),
        None,
    )
    import h5py  # `list_hdf5` has refused where it is not installed

    with h5py.File(path, "r") as opened:
        dtype = opened[name].dtype.name
    return _cube(path, name, shapes[name], dtype, waves, matlab=reverse, reverse=reverse)


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
    return _cube(path, name, shapes[name], dtype, waves, matlab=True, reverse=False)


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
    path: Path,
    name: str,
    shape: tuple[int, ...],
    dtype: str,
    waves: np.ndarray | None,
    *,
    matlab: bool,
    reverse: bool,
) -> _Cube:
    """Name the axes of a cube; `reverse` where the file has MATLAB's axes the other way round, as HDF5 shows them."""
    centres = _nanometres(waves) if waves is not None else None
    order = (2, 1, 0) if reverse else (0, 1, 2)
    fitting = [axis for axis in order if centres and shape[axis] == len(centres)]
    if len(fitting) != 1 and not matlab:
        raise unreadable(
            path,
            "it is not known which axis of the cube is that of the bands",
            field="format",
            found=f"{name} of {' x '.join(map(str, shape))}, "
            + ("no list of wavelengths" if not centres else f"{len(centres)} wavelengths"),
            expected="a list of wavelengths beside it, as long as one axis",
            fix=FIX,
        )
    band = fitting[0] if len(fitting) == 1 else order[2]
    lines, samples = (axis for axis in order if axis != band)
    if centres and shape[band] != len(centres):
        centres = None
    return _Cube(name, shape, (lines, samples, band), centres, dtype)


def _nanometres(waves: np.ndarray) -> tuple[float, ...] | None:
    """Return wavelengths in nm, of micrometres too; None where the numbers are none.

    >>> _nanometres(np.array([0.4, 0.55])), _nanometres(np.array([1, 2, 3]))
    ((400.0, 550.0), None)
    """
    values = np.asarray(waves, float)
    if not np.all(np.isfinite(values)) or len(np.unique(values)) < len(values) or values.min() <= 0:
        return None
    whole = bool(np.all(values == np.round(values)))
    if values.min() >= SHORTEST_UM and values.max() <= LONGEST_UM and not whole:
        values = np.round(values * 1000, 6)
    return tuple(values.tolist()) if values.min() >= 1000 * SHORTEST_UM else None
