"""Zarr v3 stores, one an object, one group a layer, opened by xarray with labelled bands.

A group holds ``values``, ``flags`` and, where the noise is known, ``sigma``, all (y, x, band), and
the coordinates ``band``, ``wavelength`` and ``fwhm``. Every chunk carries a checksum.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.cube import Band, Flag
from levkas.core.files import Folder, publishing, write_changed
from levkas.core.json_safe import to_json
from levkas.database.layout import SIGMA
from levkas.database.manifest import is_partial, list_files

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

DIMENSIONS = ("y", "x", "band")
SQUEEZE: dict[str, Any] = {"cname": "lz4", "clevel": 5, "shuffle": "bitshuffle"}
"""Bits of one weight side by side: what is left is noise, which no slower codec makes smaller."""
BAND_CHUNK, NARROW, SIDE, WIDE_SIDE = 16, 8, 128, 256
SHARD_TARGET, SHARD_LIMIT = 64 << 20, 256_000_000
SLAB_LIMIT, LEAST_ROWS = 128 << 20, 16
"""Whole rows of chunks are written at once: those of a long scan with many bands are made lower."""
ROOT = {"attributes": {}, "zarr_format": 3, "node_type": "group"}


def chunks_of(shape: tuple[int, int, int]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Choose chunks and shards for a (height, width, bands) array of 4-byte numbers.

    A chunk of about 1 MB holds a few bands of a square, so that a spectrum needs few chunks and a
    band a small part of all; a shard is a slab of whole rows where that stays below the limit.

    Examples
    --------
    >>> chunks_of((1040, 1392, 33))
    ((128, 128, 11), (256, 1408, 33))
    """
    height, width, bands = shape
    groups = -(-bands // BAND_CHUNK)
    depth = -(-bands // groups)
    side = SIDE if depth >= NARROW else WIDE_SIDE
    tall, wide = side, side
    while 4 * tall * width * bands > SLAB_LIMIT and tall > LEAST_ROWS:
        tall, wide = tall // 2, wide * 2
    chunk = (min(tall, height), min(wide, width), depth)
    unit = 4 * chunk[0] * chunk[1] * chunk[2]
    across = min(-(-width // chunk[1]), max(1, SHARD_LIMIT // (unit * groups)))
    deep = min(groups, max(1, SHARD_LIMIT // (unit * across)))
    down = min(-(-height // chunk[0]), max(1, SHARD_TARGET // (unit * across * deep)))
    return chunk, (chunk[0] * down, chunk[1] * across, chunk[2] * deep)


class LayerWriter:
    """Takes the rows of a layer from top to bottom, in blocks of any height."""

    def __init__(self, arrays: Mapping[str, Any], shape: tuple[int, int, int], slab: int) -> None:
        self._arrays, self._shape, self._slab = arrays, shape, slab
        self._row = self._filled = 0
        self._buffers: dict[str, np.ndarray] = {}

    def write_rows(
        self, values: np.ndarray, flags: np.ndarray, sigma: np.ndarray | None = None
    ) -> None:
        """Append rows, each array (rows, width, bands).

        Raises ValueError where sigma is missing or not expected, or the rows are more than the layer has.
        """
        blocks = {"values": values, "flags": flags} | ({} if sigma is None else {"sigma": sigma})
        if blocks.keys() != self._arrays.keys() or any(
            b.shape != values.shape for b in blocks.values()
        ):
            expected = {name: values.shape for name in self._arrays}
            found = {name: block.shape for name, block in blocks.items()}
            raise ValueError(f"a layer of {expected} was given {found}")
        start, count = 0, len(values)
        if self._row + self._filled + count > self._shape[0]:
            raise ValueError(f"more rows than the {self._shape[0]} of the layer")
        while start < count:
            take = min(self._slab - self._filled, count - start)
            self._take({name: block[start : start + take] for name, block in blocks.items()}, take)
            start += take

    def _take(self, blocks: Mapping[str, np.ndarray], take: int) -> None:
        # A shard is always written once and whole: so its bytes do not depend on the blocks.
        end = self._row + self._filled + take == self._shape[0]
        if self._filled == 0 and (take == self._slab or end):
            self._write(blocks, take)
            return
        if not self._buffers:
            size = (self._slab, *self._shape[1:])
            self._buffers = {name: np.empty(size, a.dtype) for name, a in self._arrays.items()}
        for name, block in blocks.items():
            self._buffers[name][self._filled : self._filled + take] = block
        self._filled += take
        if end or self._filled == self._slab:
            height, self._filled = self._filled, 0
            self._write({name: b[:height] for name, b in self._buffers.items()}, height)

    def _write(self, blocks: Mapping[str, np.ndarray], height: int) -> None:
        for name, block in blocks.items():
            self._arrays[name][self._row : self._row + height] = block
        self._row += height

    def close(self) -> None:
        """Raise ValueError where rows are missing."""
        if self._row != self._shape[0]:
            raise ValueError(f"{self._row + self._filled} rows written of {self._shape[0]}")


@contextlib.contextmanager
def writing_layer(
    root: str | Path,
    name: str,
    *,
    shape: tuple[int, int, int],
    bands: Sequence[Band],
    attributes: Mapping[str, Any],
    sigma: bool = True,
) -> Iterator[LayerWriter]:
    """Write a layer by blocks of rows; it takes its place when the block ends well.

    Parameters
    ----------
    root : path
        ``OBJECT.zarr``.
    name : str
        As `layer_name` gives it.
    shape : (height, width, bands)
    attributes : mapping
        Of the values: quantity, object, camera, setup, px_per_mm.
    sigma : bool
        Whether sigma is written too.

    Raises WriteRefused where the disk refuses; the layer that was there is still there.
    """
    import zarr

    root = Path(root)
    # Without an index: what is written next would outdate it.
    write_changed(root / "zarr.json", to_json(ROOT).encode())
    chunks, shards = chunks_of(shape)
    with publishing(root / name) as folder:
        group = zarr.create_group(folder_store(folder), zarr_format=3)
        facts = {k: v for k, v in attributes.items() if v is not None}
        kinds: dict[str, tuple[Any, Any, Mapping[str, Any]]] = {
            "values": (np.float32, nan, {**facts, **({SIGMA: True} if sigma else {})}),
            "flags": (np.uint8, int(Flag.OUTSIDE), flag_attributes()),
            "sigma": (np.float32, nan, {"long_name": "one standard deviation of the random part"}),
        }
        arrays = {
            key: group.create_array(
                key,
                shape=shape,
                dtype=dtype,
                chunks=chunks,
                shards=shards,
                filters=[],
                compressors=codecs_of(dtype),
                fill_value=fill,
                attributes={**more, "coordinates": "wavelength fwhm"},
                dimension_names=DIMENSIONS,
                config={"write_empty_chunks": True},
            )
            for key, (dtype, fill, more) in kinds.items()
            if sigma or key != "sigma"
        }
        _write_coordinates(group, bands)
        writer = LayerWriter(arrays, shape, shards[0])
        yield writer
        writer.close()


def write_index(root: str | Path) -> Path:
    """Consolidate the metadata of all layers in the store's root, so that xarray reads one file.

    Call it when the last layer of an object is written; writing one more drops the index again. An
    index that says the same already is left alone.
    """
    root = Path(root)
    entries = {}
    for name in list_files(root):
        if name.endswith("/zarr.json") and not is_partial(name):
            with contextlib.suppress(FileNotFoundError):  # taken away by a build beside this one
                entries[name.removesuffix("/zarr.json")] = json.loads((root / name).read_bytes())
    entries = dict(sorted(entries.items(), key=lambda entry: Path(entry[0])))
    index = {"kind": "inline", "must_understand": False, "metadata": entries}
    path = root / "zarr.json"
    write_changed(path, to_json({**ROOT, "consolidated_metadata": index}).encode())
    return path


def flag_attributes() -> dict[str, Any]:
    """Return the meaning of the flag bits as the CF conventions spell it."""
    flags = list(Flag)
    meanings = " ".join(str(flag.name).lower() for flag in flags)
    return {"flag_masks": [int(flag) for flag in flags], "flag_meanings": meanings}


def _write_coordinates(group: Any, bands: Sequence[Band]) -> None:
    coordinates: dict[str, tuple[Any, Any, np.ndarray]] = {
        "band": (str, "", np.array([b.label for b in bands], dtype=object)),
        "wavelength": (np.float64, nan, np.array([b.wavelength for b in bands])),
        "fwhm": (np.float64, nan, np.array([b.fwhm for b in bands])),
    }
    for name, (dtype, fill, numbers) in coordinates.items():
        array = group.create_array(
            name,
            shape=numbers.shape,
            dtype=dtype,
            chunks=numbers.shape,
            filters="auto" if dtype is str else [],
            compressors=codecs_of(dtype),
            fill_value=fill,
            attributes={} if name == "band" else {"units": "nm"},
            dimension_names=("band",),
            config={"write_empty_chunks": True},
        )
        array[...] = numbers


def codecs_of(kind: Any) -> list[Any]:
    """Return the codecs of an array's chunks, a checksum among them; `kind` is its dtype, or str."""
    from zarr.codecs import BloscCodec, Crc32cCodec

    size = 1 if kind is str else np.dtype(kind).itemsize
    return [BloscCodec(typesize=size, **SQUEEZE), Crc32cCodec()]


def folder_store(folder: Folder) -> Any:
    """Return a Zarr store that writes into a folder being built."""
    from zarr.storage import LocalStore

    class FolderStore(LocalStore):
        """Every write goes through the one module that writes."""

        async def set(self, key: str, value: Any) -> None:
            await asyncio.to_thread(self.set_sync, key, value)

        async def set_if_not_exists(self, key: str, value: Any) -> None:
            await asyncio.to_thread(self.set_sync, key, value)

        def set_sync(self, key: str, value: Any) -> None:
            folder.write_bytes(key, value.as_buffer_like())

    return FolderStore(folder.path)
