"""Resampling: every pixel and band of a grid interpolated once, with its flags and its variance."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from math import ceil, nan
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.cache_lines import empty
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

KERNELS = {"cubic": (0, 2.0), "lanczos3": (1, 3.0), "linear": (2, 1.0)}
"""Number and reach, in taps."""
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
    transforms: Maps,
    shape: tuple[int, int],
    *,
    flags: np.ndarray | None = None,
    variance: np.ndarray | None = None,
    kernel: str = "cubic",
    rows: tuple[int, int] | None = None,
    held: tuple[int, int] | None = None,
    fill: float = nan,
    threads: int | None = None,
    out: Warped | None = None,
) -> Warped:
    """Resample a source on a grid, each pixel and band interpolated once.

    Parameters
    ----------
    source : ndarray, (h, w) or (h, w, bands), float32, uint16 or uint8
        Pixels that are not finite are taken as not there.
    transforms : Transform, sequence of Transform, or PixelMap
        Grid px → source px: one for all bands, or one each. Where the same maps are used again, for
        tiles, `levkas.geometry.pixel_maps.lay` them once.
    shape : (height, width) of the grid
    flags : ndarray, uint8, and variance : ndarray, float32, optional
        As large as `source`. Variance in its unit squared.
    kernel : str
        ``"cubic"`` (Keys, a = −0.5: 4 x 4 pixels), ``"lanczos3"`` (6 x 6), ``"linear"``.
    rows : (start, stop), optional
        Grid rows wanted; default all.
    held : (first row, height), optional
        Where `source` is a part of a taller image of that height: `source_rows` says which.
    fill : float
        Value and variance where there is nothing.
    threads : int, optional
        Default: the processors this process may use.
    out : Warped, optional
        Arrays to write to, C-contiguous, instead of new ones.

    Returns
    -------
    warped : Warped
        Rows `start` to `stop`. The same bytes for any rows, bands taken together, and threads.

    Raises
    ------
    ValueError
        Where sizes or types do not fit, or rows of the source are wanted that are not held.

    Notes
    -----
    Footprint: a pixel of the source covers half a pixel around its centre; what falls outside
    −0.5 … w − 0.5 is OUTSIDE and `fill`. Taps that the edge of the image cuts off are left out, and
    the others weighted so that a ramp is still met exactly.

    Kernels are exact on a ramp: Lanczos' weights are brought to sum 1 and to their place. Where the
    grid is coarser than the source, the kernel is widened by the length of a grid step in source
    pixels, along x and y apart (exact where the axes are parallel, wide enough elsewhere); by all
    of it from 1.5 px on, not at all below 1.1 px.

    Flags: the pixel that the place lies on hands its flags on; another one that weighs at least
    1/32 of the heaviest hands on its own and NEAR. A pixel that is not there (not finite, OUTSIDE)
    is left out: what lies on it is OUTSIDE and `fill`; what only touches it is interpolated
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
    from levkas import warping_kernels as kernels

    flat = source.ndim == 2
    planes, frame = _planes(kernels, source, flags, variance, held)
    given = transforms.bands if isinstance(transforms, PixelMap) else None
    if not isinstance(transforms, PixelMap) and isinstance(transforms, Sequence):
        given = len(transforms)
    if given not in (None, frame.bands):
        raise ValueError(f"{given} transforms for a source of {frame.bands} bands")
    if kernel not in KERNELS:
        raise ValueError(f"unknown kernel {kernel!r}; known: {', '.join(KERNELS)}")
    start, stop = _checked_rows(rows, shape[0])
    count = threads or count_threads()
    warped = _result((stop - start, shape[1], frame.bands), variance is not None, out)
    shared = [a for a in (source, flags, variance) if a is not None]
    for target in (warped.values, warped.flags, warped.variance):
        if target is not None and any(np.may_share_memory(target, a) for a in shared):
            raise ValueError("`out` is in the memory of what is read")
    if planes.flags.size:
        _find_suspects(kernels, planes, frame, count)
    result = kernels.Result(
        warped.values.reshape(-1),
        planes.variance[:0] if warped.variance is None else warped.variance.reshape(-1),
        warped.flags.reshape(-1),
        start,
        float(fill),
    )
    absent = sum(
        _run_lattice(kernels, lattice, shape, planes, frame, result, kernel, (start, stop), count)
        for lattice in _lattices(transforms, shape)
    )
    if absent:
        raise ValueError(
            f"rows {start} to {stop} of the grid need more than the source rows held, {frame.top} to "
            f"{frame.top + frame.held}; `source_rows` says which"
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
    *,
    kernel: str = "cubic",
) -> tuple[int, int]:
    """Return the source rows, first and one past the last, that grid rows are interpolated from.

    Parameters
    ----------
    transforms, shape, rows, kernel
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
        scale = lattice.widest if _is_wide(lattice, kernel) else 1.0
        least, most = row_reach(lattice, pixel_map.shape, start, stop)
        found.append(tap_rows(least, most, KERNELS[kernel][1] * scale, height))
    found = [(low, high) for low, high in found if low < high]
    return (min(f[0] for f in found), max(f[1] for f in found)) if found else (0, 0)


def _is_wide(lattice: Lattice, kernel: str) -> bool:
    return kernel != "cubic" or lattice.coarsest > COARSE


def _checked_rows(rows: tuple[int, int] | None, height: int) -> tuple[int, int]:
    start, stop = (0, height) if rows is None else (int(rows[0]), int(rows[1]))
    if not 0 <= start < stop <= height:
        raise ValueError(f"rows {start} to {stop} of a grid of {height} rows")
    return start, stop


def _planes(
    kernels: Any,
    source: np.ndarray,
    flags: np.ndarray | None,
    variance: np.ndarray | None,
    held: tuple[int, int] | None,
) -> tuple[Any, Any]:
    """Check the source arrays and lay them flat."""
    if source.ndim not in (2, 3) or 0 in source.shape:
        raise ValueError(f"source of shape {source.shape}; (h, w) or (h, w, bands) is wanted")
    if source.dtype not in (np.float32, np.uint16, np.uint8):
        raise ValueError(f"source of {source.dtype}; float32, uint16 or uint8 is wanted")
    for name, twin in (("flags", flags), ("variance", variance)):
        if twin is not None and twin.shape != source.shape:
            raise ValueError(f"{name} of shape {twin.shape} for a source of {source.shape}")
    if flags is not None and flags.dtype != np.uint8:
        raise ValueError(f"flags of {flags.dtype}; uint8 is wanted")
    rows, width = source.shape[:2]
    top, height = (0, rows) if held is None else held
    if not 0 <= top <= height - rows:
        raise ValueError(f"{rows} rows from {top} on do not fit in an image of {height} rows")
    values = source.astype(np.uint16) if source.dtype == np.uint8 else source
    planes = kernels.Planes(
        np.ascontiguousarray(values).reshape(-1),
        np.empty(0, np.float32)
        if variance is None
        else np.ascontiguousarray(variance, np.float32).reshape(-1),
        np.empty(0, np.uint8) if flags is None else np.ascontiguousarray(flags).reshape(-1),
        np.empty(0 if flags is None else rows * width, np.uint8),
        np.empty(0 if flags is None else rows * width, np.uint8),
    )
    bands = source.shape[2] if source.ndim == 3 else 1
    return planes, kernels.Frame(top, rows, height, width, bands)


def _result(shape: tuple[int, int, int], noisy: bool, out: Warped | None) -> Warped:
    if out is None:
        variance = empty(shape, np.float32) if noisy else None
        return Warped(empty(shape, np.float32), np.zeros(shape, np.uint8), variance)
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


def _find_suspects(kernels: Any, planes: Any, frame: Any, threads: int) -> None:
    for find in (kernels.find_suspects, kernels.find_around):

        def work(start: int, stop: int, find: Callable[..., None] = find) -> int:
            find(start, stop, planes, frame)
            return 0

        _in_threads(work, (0, frame.held), threads)


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


def _run_lattice(
    kernels: Any,
    lattice: Lattice,
    shape: tuple[int, int],
    planes: Any,
    frame: Any,
    result: Any,
    kernel: str,
    rows: tuple[int, int],
    threads: int,
) -> int:
    """Resample the bands of one lattice; return how many taps were not in memory."""
    from levkas import wide_kernels

    wide_rows: Callable[..., Any] = wide_kernels.wide_rows
    wide = _is_wide(lattice, kernel)
    channels = 10 if wide else 8
    count = frame.bands if lattice.count is None else lattice.count
    blocks = [rows]
    if lattice.table is None:
        chosen = BLOCK_BYTES // (80 * shape[1] * len(lattice.transforms))
        step = tile_rows(chosen, rows[1] - rows[0])
        blocks = [(r, min(r + step, rows[1])) for r in range(rows[0], rows[1], step)]
    absent = 0
    for block in blocks:
        exact = lattice.table is None
        table = exact_table(lattice, shape, *block) if lattice.table is None else lattice.table
        table = table[:, :, :channels].copy()
        if wide:
            table[:, :, 8:] = widths(table[:, :, 8:])
        nodes = kernels.Nodes(table, *shape, block[0], lattice.segment, exact)
        given = (nodes, planes, frame, result, lattice.first, count)

        def work(start: int, stop: int, given: tuple[Any, ...] = given) -> int:
            if wide:
                return int(wide_rows(start, stop, *given, KERNELS[kernel][0], lattice.widest))
            return int(kernels.cubic_rows(start, stop, *given))

        absent += _in_threads(work, block, threads)
    return absent
