"""A layer written row by row: pages of bands, which a file holds one after the other, by way of a spool.

The files are those that `layers.write_tiffs` and `layers.write_layer` make of the whole cube, byte
for byte; only a few rows of them are in memory.
"""

from __future__ import annotations

import errno
from collections.abc import Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from levkas.colour.srgb import counts_white, find_rendering
from levkas.core.files import spooling, together
from levkas.database.catalogue import Entry
from levkas.database.layers import (
    Layer,
    centres_of,
    describe_bands,
    entry_of_layer,
    facts_of_values,
    rounded,
)
from levkas.database.preview import write_preview
from levkas.database.spectral_tiff import (
    GROUP,
    TiffHeader,
    encode_strips,
    strip_rows,
    write_encoded_pages,
)
from levkas.database.store import writing_layer

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from levkas.colour.srgb import Rendering
    from levkas.core.cube import Band, Cube
    from levkas.database.store import LayerWriter

KINDS = {"values": "", "flags": ".flags", "sigma": ".sigma"}
DTYPES = {"values": np.float32, "flags": np.uint8, "sigma": np.float32}
THREADS = 2
"""That compress strips."""


class PageSpool:
    """Strips of band pages: taken from rows of all bands, given back band by band.

    Parameters
    ----------
    handle : binary file, for reading and writing
    shape : (height, width, bands)
    dtype : numpy dtype
    pool : ThreadPoolExecutor
        For compression; the bytes are the same for any number of threads.
    """

    def __init__(
        self,
        handle: BinaryIO,
        shape: tuple[int, int, int],
        dtype: Any,
        pool: ThreadPoolExecutor,
    ) -> None:
        self._handle, self.shape, self._pool = handle, shape, pool
        self._rows = strip_rows(shape[1], dtype)
        self._places = np.zeros((shape[2], -(-shape[0] // self._rows), 2), np.int64)
        self._held = np.empty((min(self._rows, shape[0]), *shape[1:]), dtype)
        self._strip = self._filled = self._end = 0

    def write_rows(self, block: np.ndarray) -> None:
        """Take rows, (rows, width, bands), from top to bottom."""
        start = 0
        while start < len(block):
            missing = min(self._rows, self.shape[0] - self._strip * self._rows) - self._filled
            part = block[start : start + missing]
            if len(part) == missing and not self._filled:
                self._keep(part)
            else:
                self._held[self._filled : self._filled + len(part)] = part
                self._filled += len(part)
                if len(part) == missing:
                    self._keep(self._held[: self._filled])
                    self._filled = 0
            start += len(part)

    def _keep(self, strip: np.ndarray) -> None:
        bands = self.shape[2]

        def encode(start: int) -> list[bytes]:
            return encode_strips(strip, start, min(start + GROUP, bands))

        starts = range(0, bands, GROUP)
        for start, group in zip(starts, self._pool.map(encode, starts), strict=True):
            for band, encoded in enumerate(group, start):
                self._handle.write(encoded)
                self._places[band, self._strip] = self._end, len(encoded)
                self._end += len(encoded)
        self._strip += 1

    def pages(self) -> Generator[list[bytes], None, None]:
        """Yield the strips of each band.

        Raises ValueError where rows are missing.
        """
        if self._filled or self._strip != self._places.shape[1]:
            raise ValueError(f"{self._strip} strips of {self._places.shape[1]} were written")
        # The strips of a page lie far apart: a buffer would read all between them, for each page anew.
        self._handle.flush()
        plain = getattr(self._handle, "raw", self._handle)
        for places in self._places.tolist():
            yield [_read(plain, start, size) for start, size in places]

    def drop(self) -> None:
        """Give the disk back what was spooled; no page can be had any more."""
        self._handle.seek(0)
        self._handle.truncate()


def _read(handle: BinaryIO, start: int, size: int) -> bytes:
    handle.seek(start)
    found = handle.read(size)
    while len(found) < size:
        if not (more := handle.read(size - len(found))):
            raise OSError(errno.EIO, f"{len(found)} bytes of {size} could be read back")
        found += more
    return found


def _kinds(sigma: bool) -> list[str]:
    return [kind for kind in KINDS if sigma or kind != "sigma"]


class SpooledTiffs:
    """Values, flags and, where it is known, sigma of one layer or sensor, written row by row.

    To be used as a context; `finish` writes the files.
    """

    def __init__(self, base: Path, shape: tuple[int, int, int], *, sigma: bool) -> None:
        self.base, self.shape, self._kinds = base, shape, _kinds(sigma)
        self._spools: dict[str, PageSpool] = {}

    def __enter__(self) -> SpooledTiffs:
        with ExitStack() as stack:
            pool = stack.enter_context(ThreadPoolExecutor(THREADS))
            for kind in self._kinds:
                name = f"{self.base.name}{KINDS[kind]}.spool"
                handle = stack.enter_context(spooling(self.base.parent, name))
                self._spools[kind] = PageSpool(handle, self.shape, DTYPES[kind], pool)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def write_rows(self, cube: Cube) -> None:
        """Take rows of all arrays."""
        for kind, spool in self._spools.items():
            spool.write_rows(getattr(cube, kind))

    def finish(
        self,
        layer: Layer,
        bands: Sequence[Band],
        quantity: str,
        *,
        rgb: np.ndarray | None = None,
        rendering: str = "",
    ) -> list[Path]:
        """Write the files and return them; raises WriteRefused."""
        facts = layer.attributes(quantity, bands)
        more = {
            "values": facts_of_values(facts, rendering, sigma="sigma" in self._kinds),
            "flags": {**facts, "quantity": "flags"},
            "sigma": {**facts, "quantity": f"sigma of {quantity}"},
        }
        written = []
        for kind, spool in self._spools.items():
            path = self.base.with_name(f"{self.base.name}{KINDS[kind]}.tif")
            header = TiffHeader(
                self.shape[:2],
                centres_of(bands, layer.centroids),
                describe_bands(bands, more[kind]),
                dtype=DTYPES[kind],
                rgb=rgb if kind == "values" else None,
                px_per_mm=facts.get("px_per_mm"),
                credits=layer.credits,
            )
            write_encoded_pages(path, spool.pages(), header)
            spool.drop()  # the next pages may need its space
            written.append(path)
        return written


@dataclass
class _Rows:
    """Writes rows to the files of a layer, one block at a time, and paints them in its picture.

    The store is filled by a thread of its own, `beside` the pages.
    """

    beside: ThreadPoolExecutor
    tiffs: SpooledTiffs
    store: LayerWriter
    rendering: Rendering
    picture: np.ndarray
    shown: float | None
    _row: int = 0

    def write(self, block: Cube) -> None:
        rows = rounded(block)
        stored = self.beside.submit(self.store.write_rows, rows.values, rows.flags, rows.sigma)
        self.tiffs.write_rows(rows)
        if self.shown is None:
            self.shown = counts_white(rows.values, self.rendering)
        end = self._row + len(rows.values)
        self.picture[self._row : end] = self.rendering(rows.values, white=self.shown)
        self._row = end
        stored.result()


@dataclass(frozen=True)
class RowsLayer:
    """What `write_rows` found out while the rows of a layer went by."""

    entry: Entry
    files: tuple[Path, ...]


def write_rows(
    database: str | Path,
    layer: Layer,
    blocks: Iterable[Cube],
    *,
    size: tuple[int, int],
    bands: Sequence[Band],
    quantity: str,
    sigma: bool,
    verdict: str = "accept",
    white: float | None = None,
    before: Callable[[], object] | None = None,
) -> RowsLayer:
    """Write a layer as `write_layer` does, its rows from top to bottom as they come.

    Parameters
    ----------
    blocks : iterable of Cube
        Rows of the grid, any number at a time.
    size : (width, height) of the grid
    bands, quantity, sigma
        Of the layer; whether sigma is known.
    white : float, optional
        Count shown as white; default: by what is brightest in the first rows that come.
    before : callable, optional
        As of `levkas.core.files.together`.

    Raises
    ------
    WriteRefused
        Where the disk refuses; all files are then the old ones, unless it refuses a name.
    """
    database = Path(database)
    base = database / "objects" / layer.object / layer.stem
    shape = (size[1], size[0], len(bands))
    rendering = find_rendering(bands)
    picture = np.zeros((size[1], size[0], 3), np.uint8)
    root = database / "zarr" / f"{layer.object}.zarr"
    attributes = {"quantity": quantity, **layer.attributes(quantity, bands)}
    shown = 1.0 if quantity == "reflectance" else white
    with (
        together(before),
        SpooledTiffs(base, shape, sigma=sigma) as tiffs,
        writing_layer(
            root, layer.name, shape=shape, bands=bands, attributes=attributes, sigma=sigma
        ) as store,
    ):
        # The next rows are made while these are compressed and written.
        with (
            ThreadPoolExecutor(1, thread_name_prefix="store") as beside,
            ThreadPoolExecutor(1, thread_name_prefix="rows") as behind,
        ):
            passing = _Rows(beside, tiffs, store, rendering, picture, shown)
            job = None
            for block in blocks:
                if job is not None:
                    job.result()
                job = behind.submit(passing.write, block)
                del block
            if job is not None:
                job.result()
        shown = passing.shown
        text = rendering.description
        if quantity != "reflectance":
            text += f"; counts, {shown:g} shown as white"
        written = tiffs.finish(layer, bands, quantity, rgb=picture, rendering=text)
        png = base.with_name(base.name + ".png")
        scale = None if isnan(layer.px_per_mm) else layer.px_per_mm
        write_preview(png, picture, description=text, px_per_mm=scale)
        written.append(png)
    written += sorted(p for p in (root / layer.name).rglob("*") if p.is_file())
    return RowsLayer(entry_of_layer(layer, shape, quantity, verdict, written[0]), tuple(written))
