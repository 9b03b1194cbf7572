"""Arrays in containers of other programs: .npy, .npz, HDF5 and MATLAB 5, each by a list of what is accepted.

A container may name other files, decompress without end, or run what a plug-in does. Of each only plain numbers of a
declared shape are read, from the file itself, and their size is known before memory is taken for them.
"""

from __future__ import annotations

import math
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from levkas.core.problems import Problem
from levkas.core.text import check_file
from levkas.readers.facts import (
    FREE_BYTES,
    LibraryMissing,
    UnreadableCapture,
    check_memory,
    refused,
    unreadable,
)

NUMBERS = "biuf"
"""Kinds of numpy's types that are read: bool, integers, floating point."""
WIDEST = 8
"""Bytes of a number."""
MOST_MEMBERS = 64
"""Of an .npz; the largest model of Levkas has 11."""
MOST_LINKS, DEEPEST_GROUP = 20_000, 8
"""Links of an HDF5 file that are looked at, and groups within groups; results of PyMca have some hundred in five."""
STORED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
SHUFFLE, DEFLATE = 2, 1
"""Filters of HDF5 that are undone here; others, plug-ins among them, are refused."""
DAMAGE = (
    *(OSError, ValueError, KeyError, TypeError, RuntimeError, EOFError, MemoryError),
    *(NotImplementedError, OverflowError, zipfile.BadZipFile, zlib.error, AttributeError),
)
"""What damaged containers lead their libraries to."""
FIX = "Write the file again with its original program."
Shape = tuple[int | None, ...]


def read_npy(path: Path, shape: Shape) -> np.ndarray:
    """Read an array as ``numpy.save`` writes it, of a given shape; None for a side of any length.

    Raises UnreadableCapture where it is of another shape, of no numbers, or cut; none of it is read then.
    """
    with reading(path, "an array as numpy.save writes it"):
        stored = np.load(path, mmap_mode="r", allow_pickle=False)
        _check(path, stored, shape)
        return np.array(stored)


def read_npz(path: Path, *, most: int) -> dict[str, np.ndarray]:
    """Read arrays as ``numpy.savez`` writes them, by name; `most` bytes of all of them, decompressed."""
    with reading(path, "arrays as numpy.savez writes them"), zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        declared = sum(member.file_size for member in members)
        if len(members) > MOST_MEMBERS or declared > most:
            raise ValueError(f"{len(members)} members of {declared} bytes; at most {most}")
        if any(member.compress_type not in STORED for member in members):
            raise ValueError("a member is compressed by an unknown method")
        with np.load(path, allow_pickle=False) as arrays:  # reads no more than members declare
            return {name: arrays[name] for name in arrays.files}


def read_hdf5(path: Path, name: str, shape: Shape) -> np.ndarray:
    """Read one data set of an HDF5 file, such as a MAT-file of version 7.3; `shape` as of `read_npy`.

    Accepted are a hard link, plain numbers, and bytes that lie in the file itself: in one piece, or in chunks that are all
    there, as they are or behind shuffle and deflate. External files, links and virtual data sets could lead to any file
    of this computer, and are refused, as are all other filters. Raises ``E_MISSING`` without h5py.
    """
    h5py = _h5py(path)
    with reading(path, f"an HDF5 file or MATLAB 7.3 with {name!r}"), h5py.File(path, "r") as file:
        link = file.get(name, getlink=True)
        found = file[name] if isinstance(link, h5py.HardLink) else None
        if not isinstance(found, h5py.Dataset):
            raise ValueError(f"{name!r} is no data set of this file")
        _check(path, found, shape)
        if found.external or found.is_virtual:
            raise ValueError(f"the numbers of {name!r} lie in another file")
        if found.chunks:
            return _join_chunks(found)
        if found.size and found.id.get_storage_size() != found.nbytes:
            raise ValueError(f"{name!r} has no numbers")
        return np.asarray(found[()])


def list_hdf5(path: Path, group: str = "") -> dict[str, tuple[tuple[int, ...], str]]:
    """Return shape and type of the data sets of numbers in all groups of an HDF5 file whose name ends with `group`, by full name.

    Only hard links are followed: others could lead to any file of this computer. Raises ``E_MISSING`` without h5py.
    """
    h5py = _h5py(path)
    found: dict[str, tuple[tuple[int, ...], str]] = {}
    left = MOST_LINKS

    def walk(parent: Any, name: str, depth: int) -> None:
        nonlocal left
        for key in parent:
            left -= 1
            if left < 0:
                raise ValueError(f"more than {MOST_LINKS} links")
            if not isinstance(parent.get(key, getlink=True), h5py.HardLink):
                continue
            one = parent[key]
            numbers = getattr(getattr(one, "dtype", None), "kind", "") in tuple(NUMBERS)
            if isinstance(one, h5py.Group) and depth < DEEPEST_GROUP:
                walk(one, f"{name}/{key}", depth + 1)
            elif numbers and (not group or name.endswith(f"/{group}")):
                found[f"{name}/{key}"] = one.shape, one.dtype.name

    with reading(path, "an HDF5 file"), h5py.File(path, "r") as file:
        walk(file, "", 0)
    return found


def _h5py(path: Path) -> Any:
    try:
        import h5py
    except ImportError:
        why = "HDF5 and MATLAB 7.3 need h5py, which is not installed"
        fix = "Run: pip install 'levkas[export]', or save it as .npy."
        raise LibraryMissing(Problem("E_MISSING", why, str(path), fix=fix)) from None
    return h5py


def _join_chunks(data: Any) -> np.ndarray:
    plan, sides = data.id.get_create_plist(), data.chunks
    filters = [plan.get_filter(k)[0] for k in range(plan.get_nfilters())]
    if unknown := [code for code in filters if code not in (SHUFFLE, DEFLATE)]:
        raise ValueError(f"it is compressed by filter {unknown[0]}; save it with gzip, or without")
    held = math.prod(sides) * data.dtype.itemsize
    if held > max(8 * data.nbytes, FREE_BYTES):
        raise ValueError(f"a chunk of {sides} for {data.shape}")
    out = np.empty(data.shape, data.dtype)
    starts = (range(0, whole, side) for whole, side in zip(data.shape, sides, strict=True))
    for start in np.stack(np.meshgrid(*starts, indexing="ij"), -1).reshape(-1, len(sides)):
        mask, raw = data.id.read_direct_chunk(tuple(int(at) for at in start))
        for place in reversed(range(len(filters))):
            if mask >> place & 1:
                continue
            if filters[place] == DEFLATE:
                raw = zlib.decompressobj().decompress(raw, held + 1)
            else:
                raw = np.frombuffer(raw, np.uint8).reshape(data.dtype.itemsize, -1).T.tobytes()
        if len(raw) != held:
            raise ValueError(f"a chunk of {len(raw)} bytes, not {held}")
        block = np.frombuffer(raw, data.dtype).reshape(sides)
        part = out[tuple(slice(at, at + side) for at, side in zip(start, sides, strict=True))]
        part[...] = block[tuple(slice(n) for n in part.shape)]
    return out


def _check(path: Path, array: Any, expected: Shape) -> None:
    """Refuse an array of no plain numbers, of another shape, or that does not fit in memory."""
    dtype, found = array.dtype, array.shape
    if dtype.kind not in NUMBERS or dtype.itemsize > WIDEST or dtype.hasobject:
        raise refused(path, "array", dtype, code="E_UNREADABLE", expected="plain numbers")
    if len(found) != len(expected) or any(
        want not in (None, side) for side, want in zip(found, expected, strict=True)
    ):
        sides = " x ".join("n" if side is None else str(side) for side in expected)
        shape = " x ".join(map(str, found)) or "a single number"
        raise refused(path, "array", shape, code="E_SIZE", expected=sides)
    check_memory(path, array.size, dtype.itemsize)


@contextmanager
def reading(path: Path, expected: str) -> Iterator[None]:
    """Turn what damaged containers lead their libraries to into refusals."""
    check_file(path, expected)
    try:
        yield
    except UnreadableCapture:
        raise
    except DAMAGE as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        what = f"{path.name} cannot be read: {reason}"
        raise unreadable(path, what, expected=expected, fix=FIX) from error
