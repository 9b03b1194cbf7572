"""Pixels read when they are needed, from a Zarr group or a spectral TIFF; never zeros for gaps."""

from __future__ import annotations

from functools import cached_property
from itertools import product
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from xarray.backends import BackendArray
from xarray.core import indexing

from levkas.core.problems import Problem, Refused
from levkas.core.text import read_json
from levkas.database.catalogue import DatabaseRefused
from levkas.database.containment import check_inside
from levkas.database.remote import RemotePath, zarr_store
from levkas.database.tiff_pages import DAMAGE, TiffPages, open_pages

if TYPE_CHECKING:
    import zarr

MOST_SAMPLES = 1 << 26
"""Of a chunk, which is decoded as a whole."""
CODECS = frozenset(
    ["bytes", "vlen-utf8", "transpose", "blosc", "zstd", "gzip", "crc32c", "sharding_indexed"]
)
"""Of Zarr arrays that are read; Levkas writes five of them."""
MOST_CODECS = 32
KINDS = frozenset(
    [*(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
     "bool", "float16", "float32", "float64", "string"]
)  # fmt: skip
"""Types of Zarr arrays that are read."""


class LazyArray(BackendArray):
    """An array of one file or group, for `xarray.core.indexing.LazilyIndexedArray`."""

    path: Path
    shape: tuple[int, ...]
    dtype: np.dtype

    def _places(self, key: tuple[Any, ...]) -> list[np.ndarray]:
        """Return the rows, columns and bands that a key selects, rising."""
        return [np.atleast_1d(np.arange(n)[k]) for n, k in zip(self.shape, key, strict=True)]

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        support = indexing.IndexingSupport.OUTER
        return indexing.explicit_indexing_adapter(key, self.shape, support, self._read)

    def _read(self, key: tuple[Any, ...]) -> np.ndarray:
        """Read the outer product of integers, slices of positive step and rising arrays."""
        raise NotImplementedError


class ZarrArray(LazyArray):
    """An array of a layer's group; shards that are missing or lie elsewhere are refused.

    Raises DatabaseRefused where its description is damaged, or declares chunks that no memory holds.
    """

    def __init__(self, path: Path, root: Path) -> None:
        self.path, self._root = path, root
        facts = read_description(path)
        try:
            kind = facts["data_type"]
            self.dtype = np.dtype(object if kind == "string" else kind)
            self.attributes = dict(facts.get("attributes", {}))
        except DAMAGE as error:
            raise DatabaseRefused(_damaged(path / "zarr.json", error)) from error
        self.shape = tuple(facts["shape"])

    @cached_property
    def _array(self) -> zarr.Array[Any]:
        import zarr

        try:
            if isinstance(self.path, RemotePath):
                with self.path.store.requesting(self.path.key):
                    store = zarr_store(self.path)
                    return zarr.open_array(store, path=self.path.key, mode="r", zarr_format=3)
            return zarr.open_array(str(self.path), mode="r", zarr_format=3)
        except DAMAGE as error:
            raise DatabaseRefused(_damaged(self.path / "zarr.json", error)) from error

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.path, self._root)

    def _read(self, key: tuple[Any, ...]) -> np.ndarray:
        places = self._places(key)
        try:
            if isinstance(self.path, RemotePath):
                with self.path.store.requesting(self.path.key):
                    return np.asarray(self._array.oindex[key])
            if all(len(p) for p in places):
                self._check_shards([(int(p[0]), int(p[-1])) for p in places])
            return np.asarray(self._array.oindex[key])
        except DAMAGE as error:
            raise DatabaseRefused(_damaged(self.path, error)) from error

    def _check_shards(self, spans: list[tuple[int, int]]) -> None:
        # Zarr takes a missing shard for one that was never written, and gives the fill value.
        shards = self._array.shards or self._array.chunks
        ranges = [range(a // s, b // s + 1) for (a, b), s in zip(spans, shards, strict=True)]
        for place in product(*ranges):
            shard = self.path.joinpath("c", *map(str, place))
            if not shard.is_file():
                what, fix = "a part of the layer is missing", "Build it again."
                raise DatabaseRefused(Problem("E_TRUNCATED", what, str(shard), fix=fix))
            check_inside(self._root, shard)


class TiffPixels(LazyArray):
    """The band pages of a spectral TIFF; of each band only the strips that are needed are read."""

    def __init__(self, pages: TiffPages) -> None:
        self._pages, self.path = pages, pages.path
        self.shape, self.dtype = pages.shape, pages.dtype

    def __reduce__(self) -> tuple[Any, ...]:
        return _reopen_tiff, (self.path,)

    def _read(self, key: tuple[Any, ...]) -> np.ndarray:
        rows, columns, bands = self._places(key)
        start, stop = (int(rows[0]), int(rows[-1]) + 1) if len(rows) else (0, 0)
        block = self._pages.read(start, stop, bands.tolist())[np.ix_(rows - start, columns)]
        return block[tuple(0 if isinstance(k, int | np.integer) else slice(None) for k in key)]


def _reopen_tiff(path: Path) -> TiffPixels:
    return TiffPixels(open_pages(path))


def is_described(path: Path) -> bool:
    """Whether a folder is a group or an array of Zarr 3."""
    return (path / "zarr.json").is_file()


def read_description(path: Path) -> dict[str, Any]:
    """Read the description of an array of Zarr 3.

    Raises DatabaseRefused where it cannot be read, or declares chunks that no memory holds.
    """
    place = path / "zarr.json"
    try:
        record = read_json(place)
        shape, grid = record["shape"], record["chunk_grid"]["configuration"]["chunk_shape"]
        _require_accepted(record)
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
    return record


def _require_accepted(record: dict[str, Any]) -> None:
    """Refuse codecs and extensions that no list here has: plug-ins of other packages may do anything; raises ValueError."""
    codecs = list(record["codecs"])
    for codec in codecs:  # those within shards are added as they are met
        if codec["name"] not in CODECS or len(codecs) > MOST_CODECS:
            raise ValueError(f"its codec {str(codec['name'])[:80]!r} is not accepted")
        inner = codec.get("configuration") or {}
        codecs += [*inner.get("codecs", ()), *inner.get("index_codecs", ())]
    if record["chunk_grid"]["name"] != "regular" or record.get("storage_transformers"):
        raise ValueError("its chunks lie in no regular grid, or behind a transformer")
    if record["data_type"] not in KINDS:
        raise ValueError(f"its type {str(record['data_type'])[:80]!r} is not accepted")


def _damaged(path: Path, error: BaseException) -> Problem:
    reason = " ".join(str(error).split())[:200] or type(error).__name__
    return Problem(
        "E_UNREADABLE",
        f"a part of the layer is damaged: {reason}",
        file=str(path),
        fix="Copy the database again, or build it again.",
    )
