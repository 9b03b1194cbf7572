"""Zarr v3 stores, one an object, one group a layer, opened by xarray with labelled bands.

A group holds ``values``, ``flags`` and, where the noise is known, ``sigma``, all (y, x, band), and the coordinates ``band``,
``wavelength`` and ``fwhm``. Every chunk carries a checksum.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Iterator, Mapping, Sequence
from math import nan
from pathlib import Path
from typing import Any

import numpy as np

from levkas.core.cube import Band, Flag
from levkas.core.files import Folder, publishing, write_changed
from levkas.core.json_safe import to_json
from levkas.database.layout import SIGMA
from levkas.database.manifest import is_partial, list_files
from levkas.database.spectral_tiff import RowPieces

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
    """Takes the rows of a layer from top to bottom, in blocks of any height.

    A shard is always written once and whole: so its bytes do not depend on the blocks.
    """

    def __init__(self, arrays: Mapping[str, Any], shape: tuple[int, int, int], slab: int) -> None:
        self._arrays = arrays
        self._pieces = {name: RowPieces(shape, a.dtype, slab) for name, a in arrays.items()}

    def write_rows(
        self, values: np.ndarray, flags: np.ndarray, sigma: np.ndarray | None = None
    ) -> None:
        """Append rows, each array (rows, width, bands); raises ValueError where sigma is missing or not expected."""
        blocks = {"values": values, "flags": flags} | ({} if sigma is None else {"sigma": sigma})
        if blocks.keys() != self._arrays.keys():
            raise ValueError(f"a layer of {[*self._arrays]} was given {[*blocks]}")
        for name, block in blocks.items():
            for first, piece in self._pieces[name].take(block):
                self._arrays[name][first : first + len(piece)] = piece

    def check_whole(self) -> None:
        for pieces in self._pieces.values():
            pieces.check_whole()


@contextlib.contextmanager
def writing_layer(
    root: Path,
    name: str,
    *,
    shape: tuple[int, int, int],
    bands: Sequence[Band],
    attributes: Mapping[str, Any],
    sigma: bool = True,
) -> Iterator[LayerWriter]:
    """Write a layer, as `layer_name` calls it, of ``OBJECT.zarr``; it takes its place when the block ends well.

    `attributes` are those of the values: quantity, object, camera, setup, px_per_mm. Raises WriteRefused where the disk
    refuses; the layer that was there is still there.
    """
    import zarr

    # Without an index: what is written next would outdate it.
    write_changed(root / "zarr.json", to_json(ROOT).encode())
    chunks, shards = chunks_of(shape)
    facts = {k: v for k, v in attributes.items() if v is not None} | (
        {SIGMA: True} if sigma else {}
    )
    of_sigma = {"long_name": "one standard deviation of the random part"}
    kinds: dict[str, tuple[Any, Any, dict[str, Any]]] = {
        "values": (np.float32, nan, facts),
        "flags": (np.uint8, int(Flag.OUTSIDE), flag_attributes()),
        **({"sigma": (np.float32, nan, of_sigma)} if sigma else {}),
    }
    beside = {"coordinates": "wavelength fwhm"}
    labels = {
        "band": np.array([band.label for band in bands], object),
        "wavelength": np.array([band.wavelength for band in bands], np.float64),
        "fwhm": np.array([band.fwhm for band in bands], np.float64),
    }
    with publishing(root / name) as folder:
        group = zarr.create_group(folder_store(folder), zarr_format=3)
        of_pixels = {"chunks": chunks, "shards": shards}
        arrays = {
            key: _create(group, key, dtype, shape, facts | beside, fill_value=fill, **of_pixels)
            for key, (dtype, fill, facts) in kinds.items()
        }
        for key, column in labels.items():
            kind, fill, more = (
                (str, "", {}) if key == "band" else (np.float64, nan, {"units": "nm"})
            )
            size = column.shape
            array = _create(group, key, kind, size, more, fill_value=fill, chunks=size)
            array[...] = column
        writer = LayerWriter(arrays, shape, shards[0])
        yield writer
        writer.check_whole()


def _create(
    group: Any, name: str, kind: Any, shape: tuple[int, ...], facts: Mapping[str, Any], **more: Any
) -> Any:
    return group.create_array(
        name,
        shape=shape,
        dtype=kind,
        filters="auto" if kind is str else [],
        compressors=codecs_of(kind),
        attributes=facts,
        dimension_names=DIMENSIONS if len(shape) == 3 else ("band",),
        config={"write_empty_chunks": True},
        **more,
    )


def write_index(root: Path) -> Path:
    """Consolidate the metadata of all layers in the store's root, so that xarray reads one file.

    Call it when the last layer of an object is written; writing one more drops the index again.
    """
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
    meanings = " ".join(str(flag.name).lower() for flag in Flag)
    return {"flag_masks": [int(flag) for flag in Flag], "flag_meanings": meanings}


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
