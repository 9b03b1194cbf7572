"""A large line scan on the grid: some rows at a time, from the few lines that they need."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from math import ceil
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from levkas.building.measuring import add_counts, flag_and_count, ranges_of
from levkas.building.resampling import count_flags, grey_of
from levkas.cube import Band, Cube, Flag
from levkas.database.layers import round_sigma
from levkas.files import spooling
from levkas.pixelmap import PixelMap, lay
from levkas.problems import Problem, Refused
from levkas.transforms import Affine, Composed
from levkas.warping import source_rows, warp

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from levkas.building.places import Places
    from levkas.building.scans import Scan
    from levkas.database.credits import Credits
    from levkas.discovery import Capture
    from levkas.transforms import Transform

HELD_BYTES = 300_000_000
"""Of calibrated lines and of grid rows, together; the next ones are read meanwhile."""
SAMPLE_BYTES = 9
THINNED = 16
"""Of a large scan every sixteenth pixel a side is kept in mind for its range and noise."""
MOST_ROWS, LEAST_ROWS, TURNED_ROWS = 256, 8, 32


class ScanRefused(Refused):
    """A scan that lies so that it cannot be streamed."""


def write_scan(scan: Scan, capture: Capture, places: Places, credits: Credits) -> list[Path]:
    """Write the calibrated lines as `native.write_native` would; the scan keeps its pictures of them."""
    from levkas.building.scans import Reducer
    from levkas.database.layers import Layer
    from levkas.database.spooling import SpooledTiffs
    from levkas.files import make_folder

    sensor = capture.sensors[0].name
    base = places.native(capture.object, capture.camera, capture.setup, sensor, kind="")
    make_folder(base.parent)
    layer = Layer(capture.object, capture.camera, capture.setup, credits=credits)
    reducer = Reducer(scan)
    with SpooledTiffs(base, scan.shape, sigma=scan.has_sigma) as tiffs:
        for cube in scan.blocks():
            tiffs.write_rows(cube)
            reducer.add(cube)
        scan.pictures[:] = reducer.images()
        return tiffs.finish(layer, scan.bands, scan.quantity)


@dataclass
class Passing:
    """What is noted of a layer's rows while they pass by: grey, where all was seen, flags, glare."""

    mean: list[np.ndarray] = field(default_factory=list)
    seen: list[np.ndarray] = field(default_factory=list)
    flags: np.ndarray = field(default_factory=lambda: np.zeros(256, np.int64))
    glare: dict[str, int] = field(default_factory=dict)
    thin: list[Cube] = field(default_factory=list)

    def noting(self, blocks: Iterable[Cube]) -> Iterator[Cube]:
        """Flag glare in the rows, and pass them on."""
        for cube in blocks:
            add_counts(self.glare, flag_and_count(cube))
            self.thin.append(_thinned(cube))
            mean, seen = grey_of(cube.values, cube.flags)
            self.mean.append(mean)
            self.seen.append(seen)
            self.flags += count_flags(cube.flags)
            yield cube

    @property
    def grey(self) -> tuple[np.ndarray, np.ndarray]:
        """As `resampling.grey_of` gives it for all rows."""
        return np.concatenate(self.mean), np.concatenate(self.seen)

    def ranges(self, bands: Sequence[Band]) -> list[dict[str, Any]]:
        """As `measuring.ranges_of` gives it, of every sixteenth pixel a side."""
        values, flags = (
            np.concatenate([getattr(c, n) for c in self.thin]) for n in ("values", "flags")
        )
        sigmas = [cube.sigma for cube in self.thin if cube.sigma is not None]
        sigma = np.concatenate(sigmas) if len(sigmas) == len(self.thin) else None
        return ranges_of(values, flags, sigma, bands)


def _thinned(cube: Cube) -> Cube:
    """Every sixteenth pixel a side of some rows, in memory of its own."""
    rows = np.s_[::THINNED, ::THINNED]
    sigma = None if cube.sigma is None else cube.sigma[rows].copy()
    return Cube(cube.values[rows].copy(), cube.flags[rows].copy(), sigma, cube.bands, cube.quantity)


def resample_scan(
    scan: Scan, maps: Sequence[Transform], size: tuple[int, int], *, spool: Path
) -> Iterator[Cube]:
    """Yield the grid's rows from top to bottom, each pixel and band interpolated once.

    Where the scan lies on its side, columns are interpolated and turned by way of a file. What is
    done together follows from sizes and maps alone, never from the machine.

    Parameters
    ----------
    scan : Scan
    maps : sequence of Transform
        Grid px → native px, one a band.
    size : (width, height) of the grid
    spool : path
        A folder for that file.

    Raises
    ------
    ScanRefused
        ``E_SIZE`` where a few rows, or columns, need more lines than may be held.
    """
    rows = _rows_at_once(scan, maps, size)
    if rows:
        yield from _in_rows(scan, maps, size, rows)
        return
    swap = Affine(np.array([[0.0, 1, 0], [1, 0, 0]]))
    turned = {id(one): Composed(swap, one) for one in maps}
    sideways, across = [turned[id(one)] for one in maps], (size[1], size[0])
    columns = _rows_at_once(scan, sideways, across)
    if not columns:
        raise ScanRefused(
            Problem(
                "E_SIZE",
                "the scan lies askew: a few rows or columns of the grid need too many of its lines",
                str(scan.opened.facts.path),
                "grid.rotate",
                fix="Turn the grid so that the scan's lines run along its rows or columns.",
            )
        )
    yield from _turned(_in_rows(scan, sideways, across, columns), scan, size[1], spool)


def _in_rows(
    scan: Scan, maps: Sequence[Transform], size: tuple[int, int], rows: int
) -> Iterator[Cube]:
    width, height = size
    tops = range(0, height, rows)

    def read(top: int) -> tuple[PixelMap, int, Cube | None]:
        pixel_map, low, high = _lay(scan, maps, (min(rows, height - top), width), top)
        return pixel_map, low, scan.lines(low, high) if low < high else None

    # The lines of the next rows are calibrated while these are written.
    with ThreadPoolExecutor(1, thread_name_prefix="ahead") as ahead:
        coming = ahead.submit(read, 0)
        for top in tops:
            pixel_map, low, lines = coming.result()
            if top + rows < height:
                coming = ahead.submit(read, top + rows)
            shape = (min(rows, height - top), width)
            if lines is None:
                yield _nothing(scan, *shape)
            else:
                yield _resampled(scan, lines, pixel_map, shape, low)
            del lines


def _resampled(
    scan: Scan, lines: Cube, pixel_map: PixelMap, shape: tuple[int, int], low: int
) -> Cube:
    variance = None if lines.sigma is None else np.square(lines.sigma, out=lines.sigma)
    warped = warp(
        lines.values,
        pixel_map,
        shape,
        flags=lines.flags,
        variance=variance,
        held=(low, scan.shape[0]),
    )
    sigma = warped.variance
    if sigma is not None:
        sigma = round_sigma(np.sqrt(sigma, out=sigma), out=sigma)
    return Cube(warped.values, warped.flags, sigma, scan.bands, scan.quantity)


def _rows_at_once(scan: Scan, maps: Sequence[Transform], size: tuple[int, int]) -> int:
    """Return how many grid rows are done together; 0 where even a few need too many lines."""
    width, height = size
    _, samples, bands = scan.shape
    rows = min(MOST_ROWS, height)
    while True:
        tops = {0, (height - rows) // 2, height - rows}
        spans = [_lay(scan, maps[:1], (rows, width), top)[1:] for top in tops]
        held = max(high - low for low, high in spans) * samples + rows * width
        if held * bands * SAMPLE_BYTES <= HELD_BYTES:
            return rows
        if rows <= LEAST_ROWS:
            return 0
        rows = ceil(rows / 2)


def _turned(columns: Iterator[Cube], scan: Scan, height: int, spool: Path) -> Iterator[Cube]:
    """Put columns on the disk in pieces, and yield rows."""
    bands = scan.shape[2]
    pieces: list[list[tuple[int, tuple[int, int, int], bool]]] = []
    with spooling(spool, "turned.spool") as handle:
        for block in columns:
            row: list[tuple[int, tuple[int, int, int], bool]] = []
            for top in range(0, height, TURNED_ROWS):
                part = slice(top, min(top + TURNED_ROWS, height))
                arrays = [block.values, block.flags]
                arrays += [] if block.sigma is None else [block.sigma]
                shape = (part.stop - top, len(block.values), bands)
                row.append((handle.tell(), shape, block.sigma is not None))
                for array in arrays:
                    handle.write(np.ascontiguousarray(array[:, part].transpose(1, 0, 2)).data)
            pieces.append(row)
        for number in range(len(pieces[0])):
            parts = [_read_piece(handle, *row[number]) for row in pieces]
            values, flags, sigmas = zip(*parts, strict=True)
            known = [sigma for sigma in sigmas if sigma is not None]
            yield Cube(
                np.concatenate(values, axis=1),
                np.concatenate(flags, axis=1),
                np.concatenate(known, axis=1) if known else None,
                scan.bands,
                scan.quantity,
            )


def _read_piece(
    handle: BinaryIO, start: int, shape: tuple[int, int, int], noisy: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    handle.seek(start)
    count = shape[0] * shape[1] * shape[2]

    def take(dtype: type) -> np.ndarray:
        size = count * np.dtype(dtype).itemsize
        return np.frombuffer(handle.read(size), dtype).reshape(shape)

    values, flags = take(np.float32), take(np.uint8)
    return values, flags, take(np.float32) if noisy else None


def _lay(
    scan: Scan, maps: Sequence[Transform], shape: tuple[int, int], top: int
) -> tuple[PixelMap, int, int]:
    """Lay the maps on some rows, and say from which lines these come."""
    down = Affine(np.array([[1.0, 0, 0], [0, 1, top]]))
    shifted: dict[int, Transform] = {}
    for one in maps:
        shifted.setdefault(id(one), Composed(down, one))
    pixel_map = lay([shifted[id(one)] for one in maps], shape)
    low, high = source_rows(pixel_map, shape, (0, shape[0]), scan.shape[0])
    return pixel_map, low, high


def _nothing(scan: Scan, rows: int, width: int) -> Cube:
    shape = (rows, width, scan.shape[2])
    empty = np.full(shape, np.nan, np.float32)
    sigma = empty.copy() if scan.has_sigma else None
    return Cube(empty, np.full(shape, Flag.OUTSIDE, np.uint8), sigma, scan.bands, scan.quantity)
