"""Pixels read when they are needed, from a Zarr group or a spectral TIFF; never zeros for gaps."""

from __future__ import annotations

from contextlib import nullcontext
from functools import cached_property
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
from levkas.database.remote import RemotePath
from levkas.database.tiff_pages import DAMAGE, TiffPages, open_pages

if TYPE_CHECKING:
    import zarr

MOST_SAMPLES = 1 << 26
"""Of a chunk, which is decoded as a whole."""
CODECS = frozenset(
    ["bytes", "vlen-utf8", "transpose", "blosc", "zstd", "gzip", "crc32c", "sharding_indexed"]
)
"""Of Zarr arrays that are read; Levkas writes five of them. Plug-ins of other packages may do anything."""
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
        check_inside(root, path / "zarr.json")
        facts = _read_description(path / "zarr.json")
        self.dtype = np.dtype(object if facts["data_type"] == "string" else facts["data_type"])
        self.attributes, self.shape = dict(facts.get("attributes", {})), tuple(facts["shape"])

    @cached_property
    def _array(self) -> zarr.Array[Any]:
        import zarr

        name = self.path.relative_to(self._root).as_posix()
        try:
            return zarr.open_array(_store(self._root), path=name, mode="r", zarr_format=3)
        except DAMAGE as error:
            raise DatabaseRefused(_damaged(self.path / "zarr.json", error)) from error

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.path, self._root)

    def _read(self, key: tuple[Any, ...]) -> np.ndarray:
        try:
            return np.asarray(self._array.oindex[key])
        except DAMAGE as error:
            raise DatabaseRefused(_damaged(self.path, error)) from error


def _store(root: Path | RemotePath) -> Any:
    """Return the store of a database as Zarr reads it; a shard that is missing is refused: Zarr takes it for one that was never written."""
    from zarr.storage import LocalStore, ObjectStore, WrapperStore

    class WholeStore(WrapperStore[Any]):
        async def get(self, key: str, prototype: Any, byte_range: Any = None) -> Any:
            check_inside(root, root / key)
            remote = isinstance(root, RemotePath)
            try:
                with root.store.requesting(key) if remote else nullcontext():
                    found = await super().get(key, prototype, byte_range)
            except FileNotFoundError:
                found = None
            if found is None and not key.endswith("zarr.json"):
                what, fix = "a part of the layer is missing", "Build it again."
                raise DatabaseRefused(Problem("E_TRUNCATED", what, str(root / key), fix=fix))
            return found

    if isinstance(root, RemotePath):
        return WholeStore(ObjectStore(root.store.objects, read_only=True))
    return WholeStore(LocalStore(root, read_only=True))


class TiffPixels(LazyArray):
    """The band pages of a spectral TIFF; of each band only the strips that are needed are read."""

    def __init__(self, pages: TiffPages) -> None:
        self._pages, self.path = pages, pages.path
        self.shape, self.dtype = pages.shape, pages.dtype

    def __reduce__(self) -> tuple[Any, ...]:
        return _reopen_tiff, (self.path,)

    def _read(self, key: tuple[Any, ...]) -> np.ndarray:
        rows, columns, bands = (
            np.atleast_1d(np.arange(n)[k]) for n, k in zip(self.shape, key, strict=True)
        )
        start, stop = (int(rows[0]), int(rows[-1]) + 1) if len(rows) else (0, 0)
        block = self._pages.read(start, stop, bands.tolist())[np.ix_(rows - start, columns)]
        return block[tuple(0 if isinstance(k, int | np.integer) else slice(None) for k in key)]


def _reopen_tiff(path: Path) -> TiffPixels:
    return TiffPixels(open_pages(path))


def is_described(path: Path) -> bool:
    """Whether a folder is a group or an array of Zarr 3."""
    return (path / "zarr.json").is_file()


def _read_description(path: Path) -> dict[str, Any]:
    """Read zarr.json of an array; refuses chunks that no memory holds, and codecs and extensions that no list here has."""
    try:
        record = read_json(path)
        if record["data_type"] not in KINDS:
            raise ValueError(f"its type {str(record['data_type'])[:80]!r} is not accepted")
        codecs = list(record["codecs"])
        for codec in codecs:  # those within shards are added as they are met
            if codec["name"] not in CODECS or len(codecs) > MOST_CODECS:
                raise ValueError(f"its codec {str(codec['name'])[:80]!r} is not accepted")
            inner = codec.get("configuration") or {}
            codecs += [*inner.get("codecs", ()), *inner.get("index_codecs", ())]
        if record["chunk_grid"]["name"] != "regular" or record.get("storage_transformers"):
            raise ValueError("its chunks lie in no regular grid, or behind a transformer")
        shape, grid = record["shape"], record["chunk_grid"]["configuration"]["chunk_shape"]
        facts = [codec.get("configuration") or {} for codec in record["codecs"]]
        inner = [one.get("chunk_shape", grid) for one in facts]
        for sides in (shape, grid, *inner):
            if len(sides) != len(shape) or any(type(n) is not int or n < 0 for n in sides):
                raise ValueError("a shape is not numbers of pixels")
        largest = max(prod(sides) for sides in (*inner, shape if len(shape) < 2 else ()))
        if largest > MOST_SAMPLES:
            raise ValueError(f"a chunk of {largest} samples; at most {MOST_SAMPLES}")
    except Refused as refused:
        raise DatabaseRefused(*refused.problems) from None
    except DAMAGE as error:
        raise DatabaseRefused(_damaged(path, error)) from error
    return record


def _damaged(path: Path, error: BaseException) -> Problem:
    reason = " ".join(str(error).split())[:200] or type(error).__name__
    what, fix = f"a part of the layer is damaged: {reason}", "Copy the database again."
    return Problem("E_UNREADABLE", what, str(path), fix=fix)
