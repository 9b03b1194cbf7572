"""Pixels read when they are asked for, from a Zarr group or a spectral TIFF; never zeros for gaps."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from math import nan, prod
from pathlib import Path
from typing import Any

import numpy as np
from xarray.backends import BackendArray
from xarray.core import indexing

from levkas.core.cube import Band
from levkas.core.problems import Problem, Refused
from levkas.core.text import LARGEST_TABLE, read_json
from levkas.database.catalogue import DatabaseRefused
from levkas.database.containment import check_inside
from levkas.database.tiff_pages import DAMAGE, TiffPages, open_pages

MOST_SAMPLES = 1 << 26
"""Of a chunk, which is decoded as a whole."""


class Pixels(BackendArray):
    """The (y, x, band) numbers of one file or group, as xarray's lazy indexing wants them."""

    path: Path
    shape: tuple[int, ...]
    dtype: np.dtype

    def __getitem__(self, key: Any) -> Any:
        support = indexing.IndexingSupport.OUTER
        return indexing.explicit_indexing_adapter(key, self.shape, support, self._read)

    def _read(self, key: tuple[Any, ...]) -> np.ndarray:
        """Read the outer product of three integers, slices or arrays."""
        places = [_places(part, size) for part, size in zip(key, self.shape, strict=True)]
        if any(len(p) == 0 for p in places):
            block = np.empty([len(p) for p in places], self.dtype)
        else:
            block = self._block(*places)
        whole = tuple(0 if isinstance(part, (int, np.integer)) else slice(None) for part in key)
        return block[whole]

    def _block(self, rows: np.ndarray, columns: np.ndarray, bands: np.ndarray) -> np.ndarray:
        raise NotImplementedError


def _places(part: Any, size: int) -> np.ndarray:
    if isinstance(part, slice):
        return np.arange(size)[part]
    return np.atleast_1d(np.asarray(part)) % size


def _span(places: np.ndarray) -> tuple[int, int]:
    return int(places.min()), int(places.max()) + 1


class ZarrPixels(Pixels):
    """An array of a layer's group."""

    def __init__(self, path: Path, root: Path) -> None:
        import zarr

        self.path, self._root = path, root
        check_description(path)
        try:
            self._array = zarr.open_array(str(path), mode="r", zarr_format=3)
        except DAMAGE as error:
            raise DatabaseRefused(_damaged(path / "zarr.json", error)) from error
        self.shape, self.dtype = self._array.shape, np.dtype(self._array.dtype)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.path, self._root)

    def _block(self, rows: np.ndarray, columns: np.ndarray, bands: np.ndarray) -> np.ndarray:
        spans = [_span(places) for places in (rows, columns, bands)]
        self._check_shards(spans)
        try:
            if all(
                len(p) == b - a for p, (a, b) in zip((rows, columns, bands), spans, strict=True)
            ):
                block = np.asarray(self._array[tuple(slice(a, b) for a, b in spans)])
                offsets = [p - a for p, (a, _) in zip((rows, columns, bands), spans, strict=True)]
                if all(np.all(np.diff(p) > 0) for p in offsets):
                    return block
                return block[np.ix_(*offsets)]
            return np.asarray(self._array.oindex[rows, columns, bands])
        except DAMAGE as error:
            raise DatabaseRefused(_damaged(self.path, error)) from error

    def _check_shards(self, spans: list[tuple[int, int]]) -> None:
        # Zarr takes a missing shard for one that was never written, and gives the fill value.
        shards = self._array.shards or self._array.chunks
        ranges = [range(a // s, (b - 1) // s + 1) for (a, b), s in zip(spans, shards, strict=True)]
        for place in product(*ranges):
            shard = self.path.joinpath("c", *map(str, place))
            if not shard.is_file():
                problem = Problem(
                    "E_TRUNCATED",
                    "a part of the layer is missing",
                    str(shard),
                    fix="Build it again.",
                )
                raise DatabaseRefused(problem)
            check_inside(self._root, shard)


class TiffPixels(Pixels):
    """The band pages of a spectral TIFF; of each band only the strips that are needed are read."""

    def __init__(self, pages: TiffPages) -> None:
        self._pages, self.path = pages, pages.path
        self.shape, self.dtype = pages.shape, pages.dtype

    def __reduce__(self) -> tuple[Any, ...]:
        return _reopen_tiff, (self._pages.path,)

    def _block(self, rows: np.ndarray, columns: np.ndarray, bands: np.ndarray) -> np.ndarray:
        start, stop = _span(rows)
        block = self._pages.read(start, stop, [int(b) for b in bands])
        return block[np.ix_(rows - start, columns)]


def _reopen_tiff(path: Path) -> TiffPixels:
    return TiffPixels(open_pages(path))


@dataclass(frozen=True)
class Group:
    """What a layer's group says: its arrays with their attributes, and its bands."""

    arrays: tuple[str, ...]
    attributes: dict[str, dict[str, Any]]
    bands: tuple[Band, ...]


def read_group(path: Path) -> Group:
    """Read the description of a layer's Zarr group.

    Raises
    ------
    DatabaseRefused
    """
    try:
        attributes = {
            name: _attributes(path / name)
            for name in ("values", "flags", "sigma")
            if (path / name / "zarr.json").is_file()
        }
        columns = [_read_whole(path / name) for name in ("band", "wavelength", "fwhm")]
        bands = [
            Band(str(label), _number(wavelength), _number(width))
            for label, wavelength, width in zip(*columns, strict=True)
        ]
    except DAMAGE as error:
        raise DatabaseRefused(_damaged(path, error)) from error
    return Group(tuple(attributes), attributes, tuple(bands))


def _read_whole(path: Path) -> np.ndarray:
    """Read a small array of a group: as Levkas writes it within a tenth of the time that zarr takes."""
    import zarr

    check_description(path)
    found = _decode_whole(path)
    if found is not None:
        return found
    return np.asarray(zarr.open_array(str(path), mode="r", zarr_format=3)[:])


def _decode_whole(path: Path) -> np.ndarray | None:
    """Decode the only chunk of an array; None where it is of another form, or damaged: zarr says how."""
    try:
        from google_crc32c import value as crc32c
        from numcodecs import blosc
        from numcodecs.vlen import VLenUTF8

        record = read_json(path / "zarr.json")
        data = (path / "c" / "0").read_bytes()
        first, *packing = [codec["name"] for codec in record["codecs"]]
        endian = record["codecs"][0].get("configuration", {}).get("endian", "little")
        whole = record["chunk_grid"]["configuration"]["chunk_shape"] == record["shape"]
        good = crc32c(data[:-4]) == int.from_bytes(data[-4:], "little")
        if not (whole and good and packing == ["blosc", "crc32c"]):
            return None
        if int.from_bytes(data[4:8], "little") > LARGEST_TABLE:
            return None
        raw = blosc.decompress(data[:-4])
        if (first, record["data_type"]) == ("vlen-utf8", "string"):
            values = VLenUTF8().decode(raw)
        elif (first, record["data_type"], endian) == ("bytes", "float64", "little"):
            values = np.frombuffer(raw, "<f8")
        else:
            return None
    except (Refused, ImportError, OSError, ValueError, KeyError, TypeError, RuntimeError):
        return None
    return values if list(values.shape) == record["shape"] else None


def check_description(path: Path) -> None:
    """Refuse an array whose description cannot be read, or asks for chunks that no memory holds.

    Parameters
    ----------
    path : Path
        Folder of an array of Zarr 3.

    Raises
    ------
    DatabaseRefused
    """
    place = path / "zarr.json"
    try:
        record = read_json(place)
        shape, grid = record["shape"], record["chunk_grid"]["configuration"]["chunk_shape"]
        codecs = [codec.get("configuration") or {} for codec in record["codecs"]]
        inner = [codec.get("chunk_shape", grid) for codec in codecs]
        for sides in (shape, grid, *inner):
            if len(sides) != len(shape) or any(type(n) is not int or n < 0 for n in sides):
                raise ValueError("a shape is not numbers of pixels")
        largest = max(prod(sides) for sides in (*inner, shape if len(shape) < 2 else ()))
        if largest > MOST_SAMPLES:
            raise ValueError(f"a chunk of {largest} samples; at most {MOST_SAMPLES}")
    except Refused as refused:
        raise DatabaseRefused(*refused.problems) from None
    except DAMAGE as error:
        raise DatabaseRefused(_damaged(place, error)) from error


def _attributes(path: Path) -> dict[str, Any]:
    record = read_json(path / "zarr.json")["attributes"]
    return {key: value for key, value in record.items() if key != "coordinates"}


def _number(value: Any) -> float:
    return nan if np.isnan(value) else float(value)


def _damaged(path: Path, error: BaseException) -> Problem:
    reason = " ".join(str(error).split())[:200] or type(error).__name__
    return Problem(
        "E_UNREADABLE",
        f"a part of the layer is damaged: {reason}",
        file=str(path),
        fix="Copy the database anew, or build it again.",
    )
