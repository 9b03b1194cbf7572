"""A large line scan on the grid: some rows at a time, from the few lines that they need."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import ceil
from typing import TYPE_CHECKING, Any, BinaryIO, Protocol

import numpy as np

from levkas.calibration.templates import CalibrationRefused
from levkas.core.cube import Cube, CubeRows, Flag
from levkas.core.files import spooling
from levkas.core.machine import tile_rows
from levkas.core.problems import Problem
from levkas.core.rounding import round_root, round_values
from levkas.core.threads import made_ahead
from levkas.geometry.pixel_maps import PixelMap, lay
from levkas.geometry.resample import Warped, source_rows, warp
from levkas.geometry.transforms import Affine, Composed
from levkas.stages.shared_noise import shared_by_strips

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from levkas.core.cube import Band
    from levkas.geometry.transforms import Transform

BUFFER_BYTES, ASKEW_BYTES = 300_000_000, 3_600_000_000
"""Of calibrated lines and of grid rows, together, the next ones being read meanwhile; and of a scan that lies askew."""
SAMPLE_BYTES = 9
MOST_ROWS, LEAST_ROWS, TURNED_ROWS = 256, 8, 32
"""Of the grid: in a strip whose maps are laid at once, and in a piece on the disk."""


class ScanRefused(CalibrationRefused):
    """A scan that lies so that it cannot be streamed."""


class CalibratedLines(Protocol):
    """A scan whose lines are calibrated when they are needed: (lines, samples, bands)."""

    @property
    def shape(self) -> tuple[int, int, int]: ...
    @property
    def bands(self) -> tuple[Band, ...]: ...
    @property
    def quantity(self) -> str: ...
    @property
    def has_sigma(self) -> bool: ...
    @property
    def measured(self) -> dict[str, dict[str, Any]]: ...

    def blocks(self, start: int, stop: int) -> Iterator[Cube]:
        """Yield lines `start` to `stop`, some at a time."""
        ...


class BufferedLines:
    """Stretches of calibrated lines: lines that a stretch has in common with the one before are not calibrated again.

    `shared`, (samples,), is how much more variance columns keep when they are resampled.
    """

    def __init__(self, scan: CalibratedLines, shared: np.ndarray | None = None) -> None:
        self._scan, self._shared = scan, shared
        self._last: tuple[int, Cube] | None = None

    def hold(self, start: int, stop: int) -> Cube:
        """Return lines `start` to `stop`; sigma is replaced by its square."""
        shape, known = (stop - start, *self._scan.shape[1:]), self._scan.has_sigma
        sigma = np.empty(shape, np.float32) if known else None
        arrays = np.empty(shape, np.float32), np.empty(shape, np.uint8), sigma
        lines, fresh = Cube(*arrays, self._scan.bands, self._scan.quantity), start
        if self._last is not None:
            first, before = self._last
            if first <= start < first + len(before.values):
                fresh = min(first + len(before.values), stop)
                _lay_lines(_rows_of(before, start - first, fresh - first), lines, 0)
            self._last = None
            del before  # its memory goes before more is taken
        for cube in self._scan.blocks(fresh, stop):
            _lay_lines(cube, lines, fresh - start)
            if lines.sigma is not None:
                rows = slice(fresh - start, fresh - start + len(cube.values))
                np.square(lines.sigma[rows], out=lines.sigma[rows])
                if self._shared is not None:
                    lines.sigma[rows] *= self._shared[:, None]
            fresh += len(cube.values)
            del cube  # before the next lines are made
        self._last = start, lines
        return lines


def _lay_lines(part: Cube, lines: Cube, at: int) -> None:
    """Copy a part to lines `at` on."""
    rows = slice(at, at + len(part.values))
    lines.values[rows], lines.flags[rows] = part.values, part.flags
    if lines.sigma is not None and part.sigma is not None:
        lines.sigma[rows] = part.sigma


def _rows_of(cube: Cube, start: int, stop: int) -> Cube:
    """Return rows `start` to `stop` of a cube, in its memory."""
    rows = slice(start, stop)
    sigma = None if cube.sigma is None else cube.sigma[rows]
    return replace(cube, values=cube.values[rows], flags=cube.flags[rows], sigma=sigma)


def resample_scan(
    scan: CalibratedLines, maps: Sequence[Transform], size: tuple[int, int], *, spool: Path
) -> CubeRows:
    """Return the grid's rows, each pixel and band interpolated once, as they are taken.

    Where the scan lies on its side, columns are interpolated and turned by way of a file. The strips
    that maps are laid on follow from sizes and maps alone, never from the machine: so the values are
    the same for any number of rows that are worked on at a time (a strip, or $LEVKAS_TILE).

    Raises ScanRefused, ``E_SIZE`` where a few rows, or columns, need more lines than may be held.

    Parameters
    ----------
    maps : sequence of Transform
        Grid px → native px, one a band.
    size : (width, height) of the grid
    spool : path
        A folder for that file.
    """
    swap = Affine(np.array([[0.0, 1, 0], [1, 0, 0]]))
    turned = {id(one): Composed(swap, one) for one in maps}
    sideways, across = [turned[id(one)] for one in maps], (size[1], size[0])
    rows = _rows_at_once(scan, maps, size, BUFFER_BYTES)
    columns = 0 if rows else _rows_at_once(scan, sideways, across, BUFFER_BYTES)
    if not rows and not columns:
        rows = _rows_at_once(scan, maps, size, ASKEW_BYTES)
    if not rows and not columns:
        raise ScanRefused(
            Problem(
                "E_SIZE",
                "the scan is tilted relative to the grid: some rows or columns of the grid need too many of its lines",
                field="grid.rotate",
                fix="Rotate the grid so that the lines of the scan follow its rows or columns.",
            )
        )
    seams = next((one["strips"] for one in scan.measured.values() if "strips" in one), ())
    shared = shared_by_strips(seams, scan.shape[1], maps, across) if seams else None
    if rows:
        blocks = _in_rows(scan, maps, size, rows, shared)
    else:
        blocks = _in_rows(scan, sideways, across, columns, shared)
        blocks = _turned(blocks, scan, size[1], spool)
    return CubeRows(blocks, (*across, len(scan.bands)), scan.bands, scan.quantity, scan.has_sigma)


@dataclass(frozen=True, eq=False)
class _Tile:
    """Rows of the grid that are worked on at once.

    `parts` are the strips that they lie in: its first row, its maps, and the rows within it.
    """

    top: int
    stop: int
    low: int
    high: int
    parts: tuple[tuple[int, PixelMap, tuple[int, int]], ...]


def _in_rows(
    scan: CalibratedLines,
    maps: Sequence[Transform],
    size: tuple[int, int],
    strip: int,
    shared: np.ndarray | None,
) -> Iterator[Cube]:
    width, height = size
    step = tile_rows(strip, height)
    tops = range(0, height, step)
    laid: dict[int, PixelMap] = {}
    held = BufferedLines(scan, shared)

    def read(top: int) -> tuple[_Tile, Cube | None]:
        tile = _tile(scan, maps, size, (top, min(top + step, height)), strip, laid)
        return tile, held.hold(tile.low, tile.high) if tile.low < tile.high else None

    # The lines of the next rows are calibrated while these are written.
    for tile, lines in made_ahead(map(read, tops)):
        if lines is None:
            yield _nothing(scan, tile.stop - tile.top, width)
        else:
            yield _resampled(scan, lines, tile, width)
        del lines


def _tile(
    scan: CalibratedLines,
    maps: Sequence[Transform],
    size: tuple[int, int],
    rows: tuple[int, int],
    strip: int,
    laid: dict[int, PixelMap],
) -> _Tile:
    """Lay the maps of the strips that some rows lie in; `laid` has those of the tile before."""
    width, height = size
    (top, stop), parts, spans = rows, [], []
    for first in range(top - top % strip, stop, strip):
        last = min(first + strip, height)
        if first not in laid:
            laid[first] = _lay(maps, (last - first, width), first)
        within = max(top, first) - first, min(stop, last) - first
        shape = (last - first, width)
        spans.append(source_rows(laid[first], shape, within, scan.shape[0]))
        parts.append((first, laid[first], within))
    for passed in [first for first in laid if first != parts[-1][0]]:
        del laid[passed]
    spans = [span for span in spans if span[0] < span[1]]
    low, high = (min(s[0] for s in spans), max(s[1] for s in spans)) if spans else (0, 0)
    return _Tile(top, stop, low, high, tuple(parts))


def _resampled(scan: CalibratedLines, lines: Cube, tile: _Tile, width: int) -> Cube:
    """Resample; in place of sigma `lines` have its square."""
    shape = (tile.stop - tile.top, width, scan.shape[2])
    variance = lines.sigma
    values, flags = np.empty(shape, np.float32), np.empty(shape, np.uint8)
    sigma = None if variance is None else np.empty(shape, np.float32)
    for first, pixel_map, rows in tile.parts:
        here = slice(first + rows[0] - tile.top, first + rows[1] - tile.top)
        warp(
            lines.values,
            pixel_map,
            pixel_map.shape,
            flags=lines.flags,
            variance=variance,
            rows=rows,
            held=(tile.low, scan.shape[0]),
            out=Warped(values[here], flags[here], None if sigma is None else sigma[here]),
        )
    if sigma is not None:
        sigma = round_root(sigma, out=sigma)
    return Cube(round_values(values, sigma, out=values), flags, sigma, scan.bands, scan.quantity)


def _rows_at_once(
    scan: CalibratedLines, maps: Sequence[Transform], size: tuple[int, int], most: int
) -> int:
    """Return how many grid rows make a strip; 0 where even a few need lines of more than `most` bytes."""
    width, height = size
    _, samples, bands = scan.shape
    rows = min(MOST_ROWS, height)
    while True:
        tops = {0, (height - rows) // 2, height - rows}
        laid = [_lay(maps[:1], (rows, width), top) for top in tops]
        spans = [source_rows(one, (rows, width), (0, rows), scan.shape[0]) for one in laid]
        held = max(high - low for low, high in spans) * samples + rows * width
        if held * bands * SAMPLE_BYTES <= most:
            return rows
        if rows <= LEAST_ROWS:
            return 0
        rows = ceil(rows / 2)


def _turned(
    columns: Iterator[Cube], scan: CalibratedLines, height: int, spool: Path
) -> Iterator[Cube]:
    """Put columns on the disk in pieces, and yield rows."""
    bands, step = scan.shape[2], tile_rows(TURNED_ROWS, height)
    pieces: list[list[tuple[int, tuple[int, int, int], bool]]] = []
    with spooling(spool, "turned.spool") as handle:
        for block in columns:
            row: list[tuple[int, tuple[int, int, int], bool]] = []
            for top in range(0, height, step):
                part = slice(top, min(top + step, height))
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


def _lay(maps: Sequence[Transform], shape: tuple[int, int], top: int) -> PixelMap:
    """Lay the maps on some rows from `top` on."""
    down = Affine(np.array([[1.0, 0, 0], [0, 1, top]]))
    shifted: dict[int, Transform] = {}
    for one in maps:
        shifted.setdefault(id(one), Composed(down, one))
    return lay([shifted[id(one)] for one in maps], shape)


def _nothing(scan: CalibratedLines, rows: int, width: int) -> Cube:
    shape = (rows, width, scan.shape[2])
    empty = np.full(shape, np.nan, np.float32)
    sigma = empty.copy() if scan.has_sigma else None
    return Cube(empty, np.full(shape, Flag.OUTSIDE, np.uint8), sigma, scan.bands, scan.quantity)
