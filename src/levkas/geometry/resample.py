"""Resampling: every pixel and band of a grid interpolated once, with its flags and its variance."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.machine import tile_rows
from levkas.core.threads import in_threads
from levkas.core.transpose import transpose
from levkas.geometry.pixel_maps import (
    COARSE,
    Lattice,
    PixelMap,
    exact_table,
    lay,
    lay_bands,
    row_reach,
    tap_rows,
    widths,
)

if TYPE_CHECKING:
    from levkas.geometry.transforms import Transform

    Maps = Transform | Sequence[Transform] | PixelMap

REACH = 2.0
"""Of the kernel, source px."""
TAPS = 16
"""Values of the source that one of the grid is a sum of, where the kernel is not widened."""
PLANES = 16
"""Bands with maps of their own that are held as planes at a time: a cache line of float32."""
BLOCK_BYTES = 1 << 26
"""Most memory of the map of one block of rows, where no lattice serves."""


@dataclass(frozen=True, eq=False)
class Warped:
    """What `warp` gives, (rows, width, bands): float32, bits of `Flag` in uint8, and float32 or None."""

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

    `source` is (h, w) or (h, w, bands), float32, uint16 or uint8, in any unit; pixels that are not finite are not there.
    `flags` and `variance` (in the unit squared) have its shape. `transforms`, grid px → source px, are one for all bands or
    one for each, as `Registration.transforms` has them; for tiles `levkas.geometry.pixel_maps.lay` them once. `shape` is
    (height, width) of the grid, `rows` (start, stop) those wanted, all by default. Where `source` is a part of a taller
    image, `held` is its first row and the height of that: `source_rows` says which. `out` has C-contiguous arrays to write to.

    The result is of rows `start` to `stop`, without bands of a picture; the same bytes for any rows and threads. NaN, flagged
    OUTSIDE, where there is nothing. Raises ValueError where sizes or types do not fit (float64 is refused:
    ``source.astype(np.float32)``), or rows of the source are wanted that are not held.

    Cubic convolution, a = −0.5, over 4 x 4 pixels ([keys1981]_, doi:10.1109/TASSP.1981.1163711). A pixel of the
    source covers half a pixel around its centre; what falls outside −0.5 … w − 0.5 is OUTSIDE. Taps that the edge
    cuts off are left out, and the others weighted so that a ramp is still met exactly. Where the grid is coarser than
    the source, the kernel is widened by the length of a grid step in source pixels, along x and y apart; by all of it
    from 1.5 px on, not at all below 1.1 px.

    The pixel that the place lies on hands its flags on; another one that weighs at least 1/32 of the heaviest hands
    on its own and NEAR. What lies on a pixel that is not there (not finite, OUTSIDE) is OUTSIDE; what only touches it
    is interpolated linearly from those that are there, and NEAR. Variances add with the squared weights; what
    neighbours have in common by the interpolation is not kept.

    >>> from levkas.geometry.transforms import Affine
    >>> ramp = np.arange(8, dtype=np.float32) + np.zeros((8, 1), np.float32)
    >>> half = Affine(np.array([[1.0, 0, 0.5], [0, 1, 0]]))
    >>> warp(ramp, half, (1, 8)).values[0]
    array([0.5, 1.5, 2.5, 3.5, 4.5, 5.5, 6.5, 7.5], dtype=float32)
    """
    if isinstance(source, np.ma.MaskedArray):
        raise ValueError("a masked source; give source.filled(np.nan), float32")
    if len(shape) != 2 or min(shape) < 1:
        raise ValueError(f"a grid of shape {shape}; (height, width) above 0 is wanted")
    source, shape = np.asarray(source), (int(shape[0]), int(shape[1]))
    top, height = _check(source, flags, variance, held)
    flat = source.ndim == 2
    frame = _Frame(_cube(source), _cube(flags), _cube(variance), top, height)
    bands = frame.values.shape[2]
    maps = _checked_maps(transforms, bands, shape)
    start, stop = _checked_rows(rows, shape[0])
    warped = _result((stop - start, shape[1], bands), variance is not None, out)
    for target in (warped.values, warped.flags, warped.variance):
        read = [a for a in (source, flags, variance) if a is not None and target is not None]
        if any(np.may_share_memory(target, a) for a in read):  # type: ignore[arg-type]
            raise ValueError("`out` is in the memory of what is read")
    lattices = iter(maps.lattices) if isinstance(maps, PixelMap) else lay_bands(maps, shape)
    if _is_one(maps):
        absent = _resample(next(lattices), shape, (start, stop), frame, warped)
    else:
        absent = _resample_planes(lattices, shape, (start, stop), frame, warped)
    if absent:
        raise ValueError(
            f"rows {start} to {stop} of the grid need more than the source rows held, {top} "
            f"to {top + len(source)}; see `source_rows`"
        )
    if not flat or out is not None:
        return warped
    noise = None if warped.variance is None else warped.variance[..., 0]
    return Warped(warped.values[..., 0], warped.flags[..., 0], noise)


def source_rows(
    transforms: Maps, shape: tuple[int, int], rows: tuple[int, int], height: int
) -> tuple[int, int]:
    """Return the rows of a source `height` high, first and one past the last, that grid rows are interpolated from.

    (0, 0) where they see nothing of the source; then any part of it will do.

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


# --- what is given, checked -------------------------------------------------------------------


def _is_one(maps: Any) -> bool:
    """Return whether all bands have one map."""
    if isinstance(maps, PixelMap):
        return len(maps.lattices) == 1
    return not isinstance(maps, Sequence) or all(one is maps[0] for one in maps)


def _checked_maps(transforms: Any, bands: int, shape: tuple[int, int]) -> Maps:
    """Return the map of all bands, or a list with one for each; those of a mapping in its order."""
    maps = list(transforms.values()) if isinstance(transforms, Mapping) else transforms
    if isinstance(maps, PixelMap):
        given = maps.bands
        if maps.shape != shape:
            raise ValueError(f"the maps were laid on a grid of {maps.shape}, not {shape}")
    else:
        given = len(maps) if isinstance(maps, Sequence) else None
        for one in [maps] if given is None else maps:
            if not callable(one):
                raise ValueError(f"a transform is not a map of points: {type(one).__name__}")
    if given not in (None, bands):
        raise ValueError(f"{given} transforms for a source of {bands} bands")
    return maps  # type: ignore[no-any-return]


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
        raise ValueError(f"source of {source.dtype}: give float32, uint16 or uint8")
    for name, twin in (("flags", flags), ("variance", variance)):
        if twin is not None and twin.shape != source.shape:
            raise ValueError(f"{name} of shape {twin.shape} for a source of {source.shape}")
    if flags is not None and flags.dtype != np.uint8:
        raise ValueError(f"flags of {flags.dtype}; uint8 is wanted")
    top, height = (0, len(source)) if held is None else held
    if not 0 <= top <= height - len(source):
        raise ValueError(f"{len(source)} rows from {top} on do not fit in {height} rows")
    return top, height


def _cube(array: np.ndarray | None) -> Any:
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


# --- the work ---------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Frame:
    """Values, flags and variance of a source, (rows, width, bands), the latter two or None.

    Its first row is row `top` of an image of `height` rows.
    """

    values: np.ndarray
    flags: np.ndarray | None
    variance: np.ndarray | None
    top: int
    height: int


def _resample_planes(
    lattices: Iterator[Lattice],
    shape: tuple[int, int],
    rows: tuple[int, int],
    frame: _Frame,
    warped: Warped,
) -> int:
    """Resample every band through its own map, some at a time as planes; return as `_resample` does."""
    absent, bands = 0, frame.values.shape[2]
    for first in range(0, bands, PLANES):
        some = slice(first, min(first + PLANES, bands))
        cubes = (frame.values, frame.flags, frame.variance)
        given = [None if cube is None else _planes(cube[..., some]) for cube in cubes]
        part = _result(
            (some.stop - first, *warped.values.shape[:2]), frame.variance is not None, None
        )
        made = [part.values, part.flags, part.variance]
        for k in range(some.stop - first):
            source, target = (
                [None if planes is None else planes[k][..., None] for planes in three]
                for three in (given, made)
            )
            one = _Frame(*source, frame.top, frame.height)  # type: ignore[arg-type, call-arg]
            absent += _resample(next(lattices), shape, rows, one, Warped(*target))  # type: ignore[arg-type]
        for planes, cube in zip(made, (warped.values, warped.flags, warped.variance), strict=True):
            if planes is not None and cube is not None:
                _turn_over(planes, cube[..., some], back=True)
    return absent


def _planes(cube: np.ndarray) -> np.ndarray:
    """Return a cube's bands as planes, (bands, rows, width)."""
    planes = np.empty((cube.shape[2], *cube.shape[:2]), cube.dtype)
    _turn_over(planes, cube, back=False)
    return planes


def _turn_over(planes: np.ndarray, cube: np.ndarray, *, back: bool) -> None:
    """Write the bands of a cube to planes, (bands, rows, width), or `back`."""
    bands = len(planes)

    def turn(start: int, stop: int) -> None:
        pair = cube[start:stop].reshape(-1, bands), planes[:, start:stop].reshape(bands, -1)
        transpose(*(pair[::-1] if back else pair))

    in_threads(turn, len(cube), worth=cube.size)


def _resample(
    lattice: Lattice, shape: tuple[int, int], rows: tuple[int, int], frame: _Frame, warped: Warped
) -> int:
    """Resample all bands through one map; return how often a source row was not held."""
    from levkas.geometry import resample_kernels as loops

    no_noise = np.empty((0, 0, 0), np.float32)
    values, flags, variance = frame.values, frame.flags, frame.variance
    source = loops.SourceFrame(
        values.astype(np.uint16) if values.dtype == np.uint8 else values,
        no_noise if variance is None else variance.astype(np.float32, copy=False),
        np.empty((0, 0, 0), np.uint8) if flags is None else flags,
        _suspects(flags),
        frame.top,
        frame.height,
    )
    noise = no_noise if warped.variance is None else warped.variance
    result = loops.Result(warped.values, noise, warped.flags, rows[0])
    step = rows[1] - rows[0]
    if lattice.table is None:
        step = tile_rows(BLOCK_BYTES // (80 * shape[1]), step)
    absent = 0
    for start in range(*rows, step):
        stop = min(start + step, rows[1])
        nodes = _nodes(lattice, shape, (start, stop))
        parts = in_threads(
            lambda a, b, y=start, n=nodes: loops.resample_rows(y + a, y + b, n, source, result),
            stop - start,
            worth=TAPS * warped.values[0].size * (stop - start),
        )
        absent += sum(parts)
    return absent


def _suspects(flags: np.ndarray | None) -> np.ndarray:
    """Return the flags that any band of a pixel has, (rows, width); empty where there are none."""
    from levkas.geometry import resample_kernels as loops

    if flags is None:
        return np.empty((0, 0), np.uint8)
    if flags.shape[2] == 1:
        return flags[..., 0]
    suspect = np.empty(flags.shape[:2], np.uint8)
    in_threads(loops.find_suspects, len(flags), flags, suspect)
    return suspect


def _nodes(lattice: Lattice, shape: tuple[int, int], rows: tuple[int, int]) -> Any:
    """Return the map on some rows of the grid as the compiled loop takes it."""
    from levkas.geometry import resample_kernels as loops

    exact, wide = lattice.table is None, lattice.coarsest > COARSE
    table = exact_table(lattice, shape, *rows) if lattice.table is None else lattice.table
    table = table[:, :, : 10 if wide else 8].copy()
    if wide:
        table[:, :, 8:] = widths(table[:, :, 8:])
    return loops.Nodes(table, *shape, rows[0], lattice.segment, exact, lattice.widest)
