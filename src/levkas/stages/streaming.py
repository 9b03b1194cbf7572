"""A large line scan on the grid: some rows at a time, from the few lines that they need."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import ceil
from typing import TYPE_CHECKING, BinaryIO, Protocol

import numpy as np

from levkas.calibration.templates import CalibrationRefused
from levkas.core.cube import UNRELIABLE, Cube, CubeRows, Flag, is_flagged
from levkas.core.files import spooling
from levkas.core.machine import tile_rows
from levkas.core.problems import Problem
from levkas.core.rounding import round_root, round_values
from levkas.core.threads import made_ahead
from levkas.geometry.pixel_maps import PixelMap, lay
from levkas.geometry.resample import Warped, source_rows, warp
from levkas.geometry.transforms import Affine, Composed
from levkas.quality.image_quality.glare import setup_gains
from levkas.stages.native_cubes import CalibratedCapture
from levkas.stages.shared_noise import shared_by_strips

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from levkas.geometry.transforms import Transform
    from levkas.stages.capture_statistics import DefaultLayer

BUFFER_BYTES, ASKEW_BYTES = 300_000_000, 3_600_000_000
"""Of calibrated lines and of grid rows, together, the next ones being read meanwhile; and of a scan that lies askew."""
SAMPLE_BYTES = 9
MOST_ROWS, LEAST_ROWS, TURNED_ROWS = 256, 8, 32
"""Of the grid: in a strip whose maps are laid at once, and in a piece on the disk."""
COMPARED = 20_000
"""Pixels of a scan's pictures from which the ratio of two setups is taken, evenly over the layer."""


class ScanRefused(CalibrationRefused):
    """A scan that lies so that it cannot be streamed."""


def tilted(what: str) -> ScanRefused:
    """Return the refusal of a scan, or of a pass of it, of which rows of the grid need too many lines."""
    return ScanRefused(
        Problem(
            "E_SIZE",
            f"{what} is tilted relative to the grid: some rows or columns of the grid need too many of its lines",
            field="grid.rotate",
            fix="Rotate the grid so that the lines of the scan follow its rows or columns.",
        )
    )


class CalibratedLines(CalibratedCapture, Protocol):
    """A line scan of one sensor whose lines are calibrated whenever they are needed."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """(lines, samples, bands)."""

    @property
    def has_sigma(self) -> bool:
        """Whether the noise is known."""

    def blocks(self, start: int, stop: int) -> Iterator[Cube]:
        """Yield lines `start` to `stop`, some at a time."""


class BufferedLines:
    """Two stretches of calibrated lines in turn: while one is read from, the next one is filled.

    Lines that both have are copied, not calibrated again. What `hold` returned last but one is
    written over. `shared`, (samples,), is how much more variance columns keep when they are resampled.
    """

    def __init__(self, scan: CalibratedLines, shared: np.ndarray | None = None) -> None:
        self._scan, self._shared = scan, shared
        self._rooms: list[Cube] = []
        self._last: tuple[int, int, Cube] | None = None

    def hold(self, start: int, stop: int) -> Cube:
        """Return lines `start` to `stop`; sigma is replaced by its square."""
        lines = _rows_of(self._room(stop - start), 0, stop - start)
        fresh = start
        if self._last is not None:
            first, end, before = self._last
            if first <= start < end:
                fresh = min(end, stop)
                old = _rows_of(before, start - first, fresh - first)
                lines.values[: fresh - start] = old.values
                lines.flags[: fresh - start] = old.flags
                if lines.sigma is not None:
                    lines.sigma[: fresh - start] = old.sigma
        for cube in self._scan.blocks(fresh, stop):
            rows = slice(fresh - start, fresh - start + len(cube.values))
            fresh += len(cube.values)
            lines.values[rows], lines.flags[rows] = cube.values, cube.flags
            if lines.sigma is not None and cube.sigma is not None:
                np.square(cube.sigma, out=lines.sigma[rows])
                if self._shared is not None:
                    lines.sigma[rows] *= self._shared[:, None]
            del cube  # before the next lines are made
        self._last = start, stop, lines
        return lines

    def _room(self, lines: int) -> Cube:
        """Return the room that is free, as large as requested."""
        room = self._rooms.pop(0) if len(self._rooms) == 2 else None
        if room is None or len(room.values) < lines:
            room = None  # the smaller one goes before the larger one comes
            shape = (lines, *self._scan.shape[1:])
            sigma = np.empty(shape, np.float32) if self._scan.has_sigma else None
            arrays = np.empty(shape, np.float32), np.empty(shape, np.uint8), sigma
            room = Cube(*arrays, self._scan.bands, self._scan.quantity)
        self._rooms.append(room)
        return room


def _rows_of(cube: Cube, start: int, stop: int) -> Cube:
    """Return rows `start` to `stop` of a cube, in its memory."""
    rows = slice(start, stop)
    sigma = None if cube.sigma is None else cube.sigma[rows]
    return replace(cube, values=cube.values[rows], flags=cube.flags[rows], sigma=sigma)


def gains_of_scan(
    layer: DefaultLayer, scan: CalibratedCapture, maps: Sequence[Transform]
) -> np.ndarray:
    """Return `setup_gains` of a scan before its rows are resampled: of its pictures.

    A pixel of the pictures is compared with the mean of as many grid pixels as it covers.

    Parameters
    ----------
    maps : sequence of Transform
        Grid px → native px, one a band.
    """
    height, width, _ = layer.values.shape
    side = _side(maps[0], (height, width), scan.factor)
    tall, wide = height // side, width // side
    step = max(1, int(np.sqrt(tall * wide / COMPARED)))
    across, down = np.arange(0, wide, step), np.arange(0, tall, step)
    paint, known = _means(layer, down, across, side)
    x, y = np.meshgrid(*(n * side + (side - 1) / 2 for n in (across, down)))
    places = np.stack([x.ravel(), y.ravel()], 1)
    values, flags = np.zeros(paint.shape, np.float32), np.full(paint.shape, Flag.OUTSIDE, np.uint8)
    for band, (one, image) in enumerate(zip(maps, scan.images(), strict=True)):
        # NaN, where a place is not known, is beyond any edge.
        spots = np.rint(np.nan_to_num((one(places) + 0.5) / scan.factor - 0.5, nan=-9)).astype(int)
        inside = ((spots >= 0) & (spots < image.values.shape[::-1])).all(1)
        column, row = spots[inside].T
        mask = inside.reshape(paint.shape[:2])
        values[mask, band] = image.values[row, column]
        flags[mask, band] = np.where(image.valid[row, column], 0, Flag.OUTSIDE)
    return setup_gains(values, flags, paint, known)


def _side(one: Transform, shape: tuple[int, int], factor: int) -> int:
    """Return how many grid pixels a pixel of the pictures is wide, in the grid's middle."""
    x, y = shape[1] / 2, shape[0] / 2
    a, b, c = one(np.array([[x, y], [x + 1, y], [x, y + 1]]))
    pixels = float(np.sqrt(np.linalg.norm(b - a) * np.linalg.norm(c - a)))
    most = min(shape)
    return int(np.clip(round(factor / pixels), 1, most)) if pixels > 0 else 1


def _means(
    layer: DefaultLayer, down: np.ndarray, across: np.ndarray, side: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the means of blocks of `side` x `side` px, and flags; one is not known where a pixel is not."""
    values, flags = [], []
    wide = (int(across[-1]) + 1) * side
    for row in down:
        part, marks = layer.rows(row * side, (row + 1) * side)
        shape = (side, wide // side, side, part.shape[2])
        lost = is_flagged(marks[:, :wide], UNRELIABLE).reshape(shape).any((0, 2))
        values.append(np.nan_to_num(part[:, :wide]).reshape(shape).mean((0, 2))[across])
        flags.append(np.where(lost, np.uint8(Flag.OUTSIDE), np.uint8(0))[across])
    return np.stack(values), np.stack(flags)


def resample_scan(
    scan: CalibratedLines, maps: Sequence[Transform], size: tuple[int, int], *, spool: Path
) -> CubeRows:
    """Return the grid's rows, each pixel and band interpolated once, as they are taken.

    Where the scan lies on its side, columns are interpolated and turned by way of a file. The strips
    that maps are laid on follow from sizes and maps alone, never from the machine: so the values are
    the same for any number of rows that are worked on at a time (a strip, or $LEVKAS_TILE).

    Parameters
    ----------
    scan : CalibratedLines
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
    swap = Affine(np.array([[0.0, 1, 0], [1, 0, 0]]))
    turned = {id(one): Composed(swap, one) for one in maps}
    sideways, across = [turned[id(one)] for one in maps], (size[1], size[0])
    rows = _rows_at_once(scan, maps, size, BUFFER_BYTES)
    columns = 0 if rows else _rows_at_once(scan, sideways, across, BUFFER_BYTES)
    if not rows and not columns:
        rows = _rows_at_once(scan, maps, size, ASKEW_BYTES)
    if not rows and not columns:
        raise tilted("the scan")
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
