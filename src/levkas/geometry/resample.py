"""Resampling: every pixel and band of a grid interpolated once, with its flags and its variance."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from math import ceil
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.machine import count_threads, tile_rows
from levkas.geometry.pixel_maps import (
    COARSE,
    Lattice,
    PixelMap,
    exact_table,
    lay,
    lay_runs,
    row_reach,
    tap_rows,
    widths,
)

if TYPE_CHECKING:
    from levkas.geometry.transforms import Transform

    Maps = Transform | Sequence[Transform] | PixelMap

REACH = 2.0
"""Of the kernel, source px."""
LANES = 16
"""Bands with maps of their own that the kernel takes together."""
MAP_BYTES = 1 << 28
BLOCK_BYTES = 1 << 26
"""Most memory of the maps of one block of rows, where no lattice serves."""


@dataclass(frozen=True, eq=False)
class Warped:
    """What `warp` gives.

    Parameters
    ----------
    values : ndarray, (rows, width, bands), float32
    flags : ndarray, (rows, width, bands), uint8
        Bit field of `levkas.core.cube.Flag`.
    variance : ndarray, (rows, width, bands), float32, or None
    """

    values: np.ndarray
    flags: np.ndarray
    variance: np.ndarray | None


def warp(
    source: np.ndarray,
    transforms: Maps | Mapping[str, Transform],
    shape: tuple[int, int],
    *,
    flags: np.ndarray | None = None,
    variance: np.ndarray | None = None,
    rows: tuple[int, int] | None = None,
    held: tuple[int, int] | None = None,
    out: Warped | None = None,
) -> Warped:
    """Resample a picture or cube on a grid, each pixel and band interpolated once.

    Parameters
    ----------
    source : ndarray, (h, w) or (h, w, bands), float32, uint16 or uint8
        Values in any unit. Pixels that are not finite are taken as not there.
    transforms : Transform, sequence or mapping of Transform, or PixelMap
        Grid px → source px: one for all bands, or one for each, as `Registration.transforms` has them. Where the same maps are used again, for
        tiles, `levkas.geometry.pixel_maps.lay` them once.
    shape : (height, width) of the grid, px
    flags : ndarray like `source`, uint8, optional
        Bits of `levkas.Flag`.
    variance : ndarray like `source`, float32, optional
        In the unit of `source` squared.
    rows : (start, stop), optional
        Grid rows wanted; default all.
    held : (first row, height), optional
        Where `source` is a part of a taller image of that height: `source_rows` says which.
    out : Warped, optional
        Arrays to write to, C-contiguous, instead of new ones.

    Returns
    -------
    warped : Warped
        `values`, `flags` and `variance` of rows `start` to `stop`, (rows, width) or (rows, width, bands);
        the same bytes for any rows and threads. NaN, flagged OUTSIDE, where there is nothing.

    Raises
    ------
    ValueError
        Where sizes or types do not fit (float64 is refused: `source.astype(np.float32)`), or rows of the source are wanted that are not held.

    Notes
    -----
    Cubic convolution, a = −0.5, over 4 x 4 pixels ([keys1981]_, doi:10.1109/TASSP.1981.1163711).

    Footprint: a pixel of the source covers half a pixel around its centre; what falls outside
    −0.5 … w − 0.5 is OUTSIDE and NaN. Taps that the edge of the image cuts off are left out, and
    the others weighted so that a ramp is still met exactly.

    Where the grid is coarser than the source, the kernel is widened by the length of a grid step in
    source pixels, along x and y apart (exact where the axes are parallel, wide enough elsewhere); by
    all of it from 1.5 px on, not at all below 1.1 px. A ramp is met exactly at any scale.

    Flags: the pixel that the place lies on hands its flags on; another one that weighs at least
    1/32 of the heaviest hands on its own and NEAR. A pixel that is not there (not finite, OUTSIDE)
    is left out: what lies on it is OUTSIDE and NaN; what only touches it is interpolated
    linearly from those that are there, and NEAR. Variances add with the squared weights; what
    neighbours have in common by the interpolation is not kept.

    Examples
    --------
    >>> from levkas.geometry.transforms import Affine
    >>> ramp = np.arange(8, dtype=np.float32) + np.zeros((8, 1), np.float32)
    >>> half = Affine(np.array([[1.0, 0, 0.5], [0, 1, 0]]))
    >>> warp(ramp, half, (1, 8)).values[0]
    array([0.5, 1.5, 2.5, 3.5, 4.5, 5.5, 6.5, 7.5], dtype=float32)
    """
    if isinstance(source, np.ma.MaskedArray):
        raise ValueError("a masked source; give source.filled(np.nan), float32")
    source, shape = np.asarray(source), _checked_shape(shape)
    flat = source.ndim == 2
    held_from = _check(source, flags, variance, held)
    values, marks, noise = _cube(source), _cube(flags), _cube(variance)
    bands = 1 if flat else source.shape[2]
    maps = _checked_maps(transforms, bands)
    start, stop = _checked_rows(rows, shape[0])
    warped = _result((stop - start, shape[1], bands), variance is not None, out)
    shared = [a for a in (source, flags, variance) if a is not None]
    for target in (warped.values, warped.flags, warped.variance):
        if target is not None and any(np.may_share_memory(target, a) for a in shared):
            raise ValueError("`out` is in the memory of what is read")
    kernel = _Kernel.of((values, marks, noise), held_from, warped, start)
    absent = sum(kernel.run(lattice, shape, (start, stop)) for lattice in _lattices(maps, shape))
    if absent:
        raise ValueError(
            f"rows {start} to {stop} of the grid need more than the source rows held, {held_from[0]} "
            f"to {held_from[0] + len(source)}; see `source_rows`"
        )
    return _squeezed(warped) if flat and out is None else warped


def _lattices(transforms: Maps, shape: tuple[int, int]) -> Iterator[Lattice]:
    """Lay the maps of some bands at a time: those of a scan can take more memory than its pixels."""
    shape = (int(shape[0]), int(shape[1]))
    if isinstance(transforms, PixelMap):
        if transforms.shape != shape:
            raise ValueError(f"the maps were laid on a grid of {transforms.shape}, not {shape}")
        yield from transforms.lattices
    else:
        yield from lay_runs(transforms, shape, MAP_BYTES)


def source_rows(
    transforms: Maps,
    shape: tuple[int, int],
    rows: tuple[int, int],
    height: int,
) -> tuple[int, int]:
    """Return the source rows, first and one past the last, that grid rows are interpolated from.

    Parameters
    ----------
    transforms, shape, rows
        As for `warp`.
    height : int
        Of the whole source.

    Returns
    -------
    first, stop : int
        (0, 0) where the rows see nothing of the source; then any part of it will do.

    Examples
    --------
    >>> from levkas.geometry.transforms import Affine
    >>> source_rows(Affine.scaling(2.0), (500, 500), (100, 110), 1000)
    (195, 225)
    """
    pixel_map = transforms if isinstance(transforms, PixelMap) else lay(transforms, shape)
    start, stop = _checked_rows(rows, shape[0])
    found = []
    for lattice in pixel_map.lattices:
        scale = lattice.widest if lattice.coarsest > COARSE else 1.0
        least, most = row_reach(lattice, pixel_map.shape, start, stop)
        found.append(tap_rows(least, most, REACH * scale, height))
    found = [(low, high) for low, high in found if low < high]
    return (min(f[0] for f in found), max(f[1] for f in found)) if found else (0, 0)


def _checked_maps(transforms: Maps | Mapping[str, Transform], bands: int) -> Maps:
    """Return the map of all bands, or a list with one for each; those of a mapping in its order."""
    maps: Any = list(transforms.values()) if isinstance(transforms, Mapping) else transforms
    if isinstance(maps, PixelMap):
        given = maps.bands
    else:
        given = len(maps) if isinstance(maps, Sequence) else None
        for one in [maps] if given is None else maps:
            if not callable(one):
                raise ValueError(f"a transform is not a map of points: {type(one).__name__}")
    if given not in (None, bands):
        raise ValueError(f"{given} transforms for a source of {bands} bands")
    found: Maps = maps
    return found


def _checked_shape(shape: tuple[int, int]) -> tuple[int, int]:
    if len(shape) != 2 or min(shape) < 1:
        raise ValueError(f"a grid of shape {shape}; (height, width) above 0 is wanted")
    return int(shape[0]), int(shape[1])


def _checked_rows(rows: tuple[int, int] | None, height: int) -> tuple[int, int]:
    start, stop = (0, height) if rows is None else (int(rows[0]), int(rows[1]))
    if not 0 <= start < stop <= height:
        raise ValueError(f"rows {start} to {stop} of a grid of {height} rows")
    return start, stop


def _check(
    source: np.ndarray,
    flags: np.ndarray | None,
    variance: np.ndarray | None,
    held: tuple[int, int] | None,
) -> tuple[int, int]:
    """Check the arrays of the source; return its first row and the height of the whole image."""
    if source.ndim not in (2, 3) or 0 in source.shape:
        raise ValueError(f"source of shape {source.shape}; (h, w) or (h, w, bands) is wanted")
    if source.dtype not in (np.float32, np.uint16, np.uint8):
        raise ValueError(
            f"source of {source.dtype}; float32, uint16 or uint8 is wanted: source.astype(np.float32)"
        )
    for name, twin in (("flags", flags), ("variance", variance)):
        if twin is not None and twin.shape != source.shape:
            raise ValueError(f"{name} of shape {twin.shape} for a source of {source.shape}")
    if flags is not None and flags.dtype != np.uint8:
        raise ValueError(f"flags of {flags.dtype}; uint8 is wanted")
    top, height = (0, len(source)) if held is None else held
    if not 0 <= top <= height - len(source):
        raise ValueError(
            f"{len(source)} rows from {top} on do not fit in an image of {height} rows"
        )
    return top, height


def _cube(array: np.ndarray | None) -> np.ndarray | None:
    if array is None:
        return None
    return np.ascontiguousarray(array[..., None] if array.ndim == 2 else array)


def _result(shape: tuple[int, int, int], noisy: bool, out: Warped | None) -> Warped:
    if out is None:
        variance = np.empty(shape, np.float32) if noisy else None
        return Warped(np.empty(shape, np.float32), np.zeros(shape, np.uint8), variance)
    wanted = [(out.values, np.float32), (out.flags, np.uint8)]
    if noisy != (out.variance is not None):
        raise ValueError("`out` has a variance where none is wanted, or none where one is")
    if out.variance is not None:
        wanted.append((out.variance, np.float32))
    for array, dtype in wanted:
        if array.shape != shape or array.dtype != dtype or not array.flags.c_contiguous:
            raise ValueError(f"`out` is {array.shape} {array.dtype}; {shape} is wanted")
    out.flags[:] = 0
    return out


def _squeezed(warped: Warped) -> Warped:
    variance = None if warped.variance is None else warped.variance[..., 0]
    return Warped(warped.values[..., 0], warped.flags[..., 0], variance)


@dataclass(frozen=True, eq=False)
class _Kernel:
    """The compiled loops, and the arrays of one call of `warp` as they take them."""

    loops: Any
    source: Any
    result: Any
    threads: int

    @classmethod
    def of(
        cls,
        cubes: tuple[Any, Any, Any],
        held: tuple[int, int],
        warped: Warped,
        start: int,
    ) -> _Kernel:
        """Take values, flags and variance of the source, the latter two or None."""
        from levkas.geometry import resample_kernels as loops

        values, flags, variance = cubes
        threads, no_noise = count_threads(), np.empty((0, 0, 0), np.float32)
        if values.dtype == np.uint8:
            values = values.astype(np.uint16)
        suspect = np.empty((0, 0) if flags is None else values.shape[:2], np.uint8)
        if flags is not None:
            _in_threads(
                lambda low, high: loops.find_suspects(low, high, flags, suspect) or 0,
                (0, len(flags)),
                threads,
            )
        source = loops.SourceFrame(
            values,
            no_noise if variance is None else variance.astype(np.float32, copy=False),
            np.empty((0, 0, 0), np.uint8) if flags is None else flags,
            suspect,
            *held,
        )
        noise = no_noise if warped.variance is None else warped.variance
        result = loops.Result(warped.values, noise, warped.flags, start)
        return cls(loops, source, result, threads)

    def run(self, lattice: Lattice, shape: tuple[int, int], rows: tuple[int, int]) -> int:
        """Resample the bands of one lattice; return how often a source row was not held."""
        blocks, exact = [rows], lattice.table is None
        if exact:
            chosen = BLOCK_BYTES // (80 * shape[1] * len(lattice.transforms))
            step = tile_rows(chosen, rows[1] - rows[0])
            blocks = [(r, min(r + step, rows[1])) for r in range(rows[0], rows[1], step)]
        return sum(self._run_block(lattice, shape, block, exact) for block in blocks)

    def _run_block(
        self, lattice: Lattice, shape: tuple[int, int], rows: tuple[int, int], exact: bool
    ) -> int:
        table = exact_table(lattice, shape, *rows) if lattice.table is None else lattice.table
        if table.ndim == 3:
            table = table[..., None]
        # Fewer maps than the kernel takes at once: the last one again.
        maps = max(table.shape[3], LANES) if lattice.count is not None else 1
        table = table[:, :, :, np.minimum(np.arange(maps), table.shape[3] - 1)]
        wide = lattice.coarsest > COARSE
        table = np.ascontiguousarray(table[:, :, : 10 if wide else 8])
        if wide:
            table[:, :, 8:] = widths(table[:, :, 8:])
        nodes = self.loops.Nodes(table, *shape, rows[0], lattice.segment, exact, lattice.widest)
        args: tuple[Any, ...] = (nodes, self.source, self.result)
        loop = self.loops.shared_rows
        if lattice.count is not None:
            loop, args = self.loops.own_rows, (*args, lattice.first, lattice.count)
        return _in_threads(lambda low, high: loop(low, high, *args), rows, self.threads)


def _in_threads(work: Callable[[int, int], int], rows: tuple[int, int], threads: int) -> int:
    """Add up what ``work(start, stop)`` gives on blocks of rows.

    Threads of our own around kernels without the interpreter's lock: numba's parallel loops end the
    process where two threads enter them at once.
    """
    count = rows[1] - rows[0]
    # Some rows together: what they share of the source is read once.
    least = min(8, ceil(count / threads))
    step = tile_rows(min(64, max(least, ceil(count / (4 * threads)))), count)
    starts = range(rows[0], rows[1], step)
    if threads == 1 or len(starts) == 1:
        return sum(work(start, min(start + step, rows[1])) for start in starts)
    with ThreadPoolExecutor(threads) as pool:
        return sum(pool.map(lambda start: work(start, min(start + step, rows[1])), starts))
