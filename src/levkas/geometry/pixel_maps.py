"""Where every grid pixel falls in the source, from a few places at which the maps are evaluated.

A map is evaluated on a lattice of nodes, interpolated to order 5 down the rows, and laid as cubics along segments of
them; the middles of its cells are checked against the map itself, and the lattice is made finer until the largest
error is below `TOLERANCE_PX`, or where the map steps at a ledge below `STEP_SHARE` of that step. Maps that no lattice
follows (folds, places without an answer) are evaluated at every pixel.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import ceil, floor
from typing import TYPE_CHECKING

import numpy as np

from levkas.core.threads import each
from levkas.geometry.depth_step import DepthStepShift

if TYPE_CHECKING:
    from scipy.sparse import csr_array

    from levkas.geometry.transforms import Transform

TOLERANCE_PX = 1e-4
STEP_SHARE = 1 / 50
"""Where a ledge lies is known to pixels: what it displaces need not be laid out more exactly. Along a slope of 30 px
so much is a third of a pixel of its place."""
LATTICES = ((128, 32), (32, 16), (8, 8), (4, 4), (2, 2))
"""Distance of nodes and length of segments, grid px."""
NODES = 6
AT_ONCE = 8
"""Bands whose maps are laid side by side: their tables are held together."""
CHECKS, FEW = 400, 50
"""Check points on either axis, at most: fewer would miss the slope of a ledge. `FEW` of them, looked at first, show that
most lattices do not serve."""
ASIDE = 4
"""Distance of nodes, grid px, from which on a px beside the middle is still far from them."""
COARSE, COARSER = 1.1, 1.5
"""Source px per grid px: from the first on the kernel is widened against aliasing, from the second on by the whole
scale; between them gradually, so that bands of nearly one scale are treated alike."""
SMALL = 4096
"""Grids of at most so many pixels are evaluated whole."""
BLOCK = 16
"""Rows evaluated at once where no lattice serves: always the same ones, so that a tile's bytes do not depend on where
it begins."""
FAR = -float(1 << 30)


@dataclass(frozen=True, eq=False)
class Lattice:
    """The map of one band, or of all, laid out.

    `table`, (rows, segments, 10): coefficients of 1, t, t², t³ of x and of y along a segment of `segment` grid px, source
    px, and the scales along x and y, source px per grid px, of which `coarsest` is the largest. None: the map is
    evaluated at every pixel. `error`: largest distance to the map at the check points, px.
    """

    transform: Transform
    table: np.ndarray | None
    segment: int
    error: float
    coarsest: float

    @property
    def widest(self) -> float:
        """Scale that kernels are never widened beyond: what a lattice may lie above its nodes."""
        return self.coarsest * (2.0 if self.table is None else 1.1)


@dataclass(frozen=True, eq=False)
class PixelMap:
    """Maps on a grid of `shape` (height, width), laid out by `lay`: one for all bands (`bands` None), or one each."""

    shape: tuple[int, int]
    bands: int | None
    lattices: tuple[Lattice, ...]

    @property
    def error(self) -> float:
        """Largest distance of the lattices to the maps at the check points, px."""
        return max(lattice.error for lattice in self.lattices)


def lay(transforms: Transform | Sequence[Transform], shape: tuple[int, int]) -> PixelMap:
    """Lay maps, grid px → source px, out on a grid of `shape` (height, width): one for all bands, or one each.

    >>> from levkas.geometry.transforms import Affine
    >>> lay(Affine.scaling(0.5), (800, 600)).lattices[0].table.shape
    (8, 19, 10)
    """
    height, width = (int(n) for n in shape)
    if height < 1 or width < 1:
        raise ValueError(f"a grid of {width} x {height} px has no pixel")
    bands = len(transforms) if isinstance(transforms, Sequence) else None
    return PixelMap((height, width), bands, tuple(lay_bands(transforms, (height, width))))


def lay_bands(
    transforms: Transform | Sequence[Transform], shape: tuple[int, int]
) -> Iterator[Lattice]:
    """Yield the lattices of `lay`: of all bands where they share one map, else of each.

    Tables of a scan's bands can take more memory than its pixels: no more than `AT_ONCE` are held here.
    """
    maps = transforms if isinstance(transforms, Sequence) else [transforms]
    if not maps:
        raise ValueError("there is no transform: give one for all bands, or one for each")
    first = _lay_band(maps[0], shape)
    # Bands of a capture are bent alike: a lattice too coarse for the first is not tried for others.
    lattices = [rung for rung in LATTICES if rung[1] <= first.segment] or LATTICES
    yield first
    del first
    if all(one is maps[0] for one in maps):
        return
    for start in range(1, len(maps), AT_ONCE):
        some = each(lambda one: _lay_band(one, shape, lattices), maps[start : start + AT_ONCE])
        while some:
            yield some.pop(0)


def _lay_band(
    transform: Transform, shape: tuple[int, int], lattices: Sequence[tuple[int, int]] = LATTICES
) -> Lattice:
    height, width = shape
    coarsest = 1.0
    for step, segment in lattices:
        counts = [max(NODES, ceil((n - 1) / step) + 1) for n in shape]
        y, x = (np.linspace(0, n - 1, count) for n, count in zip(shape, counts, strict=True))
        nodes = _map_raster(transform, x, y).reshape(*counts, 2)
        coarsest = max(1.0, _coarsest(nodes, x, y))
        if height * width <= SMALL or min(shape) < NODES:
            break
        if not _is_near(nodes):
            continue
        table = _table(nodes, shape, segment)
        error = _error(transform, table, shape, segment, (x, y), _tolerance(transform, coarsest))
        if error is not None:
            coarsest = max(coarsest, float(table[..., 8:].max()))
            return Lattice(transform, table, segment, error, coarsest)
    return Lattice(transform, None, 1, 0.0, coarsest)


def _map_raster(transform: Transform, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return where the places of a raster lie, (rows x columns, 2)."""
    places = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    with np.errstate(all="ignore"):
        return np.asarray(transform(places), float)


def _is_near(found: np.ndarray) -> bool:
    return bool(np.isfinite(found).all() and np.abs(found).max() <= -FAR / 4)


# --- a lattice's error and scale --------------------------------------------------------------


def _error(
    transform: Transform,
    table: np.ndarray,
    shape: tuple[int, int],
    segment: int,
    nodes: tuple[np.ndarray, np.ndarray],
    tolerance: float,
) -> float | None:
    """Return the largest error of a table at the middles of cells; None where it is too large."""
    x, y = (_checks(n) for n in nodes)
    for every in (CHECKS // FEW, 1):
        few = x[::every], y[::every]
        found = _map_raster(transform, *few)
        if not _is_near(found):
            return None
        error = float(np.abs(_evaluate(table, shape, segment, *few) - found).max())
        if error > tolerance:
            return None
    return error


def _tolerance(transform: Transform, scale: float) -> float:
    """Return how far a lattice may lie from a map, source px."""
    steps = getattr(transform, "steps", (transform,))
    depth_steps = [step.most for step in steps if isinstance(step, DepthStepShift)]
    return max([TOLERANCE_PX, *(STEP_SHARE * most * scale for most in depth_steps)])


def _checks(nodes: np.ndarray) -> np.ndarray:
    """Whole px at the middle of cells, the outermost ones among them: there the error is largest.

    Every other one is a px aside: what lines do in step with the nodes would show at neither.
    """
    middles = np.round((nodes[1:] + nodes[:-1]) / 2)
    if len(middles) > 2 and nodes[1] - nodes[0] >= ASIDE:
        middles[1:-1:2] += 1
    middles = np.unique(middles)
    return middles[np.unique(np.linspace(0, len(middles) - 1, CHECKS).round().astype(int))]


def _coarsest(nodes: np.ndarray, x: np.ndarray, y: np.ndarray) -> float:
    """Return the largest scale between neighbouring nodes, source px per grid px."""
    scale = 0.0
    for axis in range(2):
        steps = [
            np.diff(nodes[..., axis], axis=k) / (n[1] - n[0] if n[1] > n[0] else np.inf)
            for k, n in enumerate((y, x))
        ]
        along, down = (float(np.nanmax(np.abs(s))) if np.isfinite(s).any() else 0.0 for s in steps)
        scale = max(scale, float(np.hypot(along, down)))
    return scale


# --- tables -----------------------------------------------------------------------------------


def lagrange(places: np.ndarray, count: int) -> csr_array:
    """Return weights, (n, count), that interpolate `places` among `count` equidistant nodes, 1 apart, by six of them each."""
    from scipy.sparse import csr_array

    first = np.clip(np.floor(places).astype(int) - NODES // 2 + 1, 0, count - NODES)
    weights = np.ones((len(places), NODES))
    for i in range(NODES):
        for j in range(NODES):
            if j != i:
                weights[:, i] *= (places - first - j) / (i - j)
    nodes = (first[:, None] + np.arange(NODES)).ravel()
    ends = np.arange(0, len(nodes) + 1, NODES)
    return csr_array((weights.ravel(), nodes, ends), shape=(len(places), count))


def _table(nodes: np.ndarray, shape: tuple[int, int], segment: int) -> np.ndarray:
    """Lay cubics along the segments of each row of nodes, through places at their thirds; return (rows, segments, 10)."""
    (height, width), (rows, columns) = shape, nodes.shape[:2]
    thirds = (
        np.arange(3 * ceil(width / segment) + 1) * (segment / 3) * ((columns - 1) / (width - 1))
    )
    along = lagrange(thirds, columns) @ nodes.transpose(1, 0, 2).reshape(columns, -1)
    along = along.reshape(-1, rows, 2).transpose(1, 0, 2)
    p, q, u, v = along[:, :-1:3], along[:, 1::3], along[:, 2::3], along[:, 3::3]
    table = np.empty((*p.shape[:2], 10))
    table[..., 0:8:4] = p
    slopes = (
        (18 * q - 11 * p - 9 * u + 2 * v) / (2 * segment),
        4.5 * (2 * p - 5 * q + 4 * u - v) / segment**2,
        4.5 * (3 * q - p - 3 * u + v) / segment**3,
    )
    for k, slope in enumerate(slopes, 1):
        # What is left of rounding would make a copy of whole pixels an interpolation.
        table[..., k:8:4] = np.where(np.abs(slope) * segment**k >= 1e-9, slope, 0.0)
    row, middle, step = np.arange(rows), (q + u) / 2, (height - 1) / (rows - 1)
    above, below = np.maximum(row - 1, 0), np.minimum(row + 1, rows - 1)
    down = (middle[below] - middle[above]) / ((below - above) * step)[:, None, None]
    table[..., 8:] = np.hypot((v - p) / segment, down)
    return table


def _evaluate(
    table: np.ndarray, shape: tuple[int, int], segment: int, x: np.ndarray, y: np.ndarray
) -> np.ndarray:
    """Return where a table puts a raster of whole grid px, (rows x columns, 2)."""
    which, within = np.divmod(x.astype(int), segment)
    cubics = _between_rows(table, y, shape[0])[:, which, :8].reshape(len(y), len(x), 2, 4)
    t, (a, b, c, d) = within[:, None], np.moveaxis(cubics, -1, 0)
    return np.asarray(a + t * (b + t * (c + t * d))).reshape(-1, 2)


def _between_rows(table: np.ndarray, y: np.ndarray, height: int) -> np.ndarray:
    """Return a table's segments at grid rows `y` of `height`, as the table has them."""
    rows = len(table)
    weights = lagrange(y * ((rows - 1) / (height - 1)), rows)
    return np.asarray(weights @ table.reshape(rows, -1)).reshape(len(y), *table.shape[1:])


def exact_table(lattice: Lattice, shape: tuple[int, int], start: int, stop: int) -> np.ndarray:
    """Evaluate the map at every pixel of rows `start` to `stop`, blocks of `BLOCK` rows.

    The table is that of a `Lattice`, a segment a pixel; far away where there is no answer.
    """
    width = shape[1]
    table = np.zeros((stop - start, width, 10))
    for low in range(start - start % BLOCK, stop, BLOCK):
        high = min(low + BLOCK, shape[0])
        above, below = max(low - 1, 0), min(high + 1, shape[0])
        here = slice(max(low, start) - start, min(high, stop) - start)
        part = slice(max(low, start) - above, min(high, stop) - above)
        with np.errstate(all="ignore"):
            rows, columns = np.arange(float(above), below), np.arange(float(width))
            places = _map_raster(lattice.transform, columns, rows).reshape(-1, width, 2)
            far = ~(np.abs(places) < -FAR / 4).all(-1)
            for axis in range(2):
                p = places[..., axis]
                slopes = [np.gradient(p, axis=k) if p.shape[k] > 1 else 0 * p for k in (0, 1)]
                scale = np.nan_to_num(np.hypot(*slopes), nan=1.0, posinf=1.0)
                table[here, :, 8 + axis] = scale[part]
                table[here, :, 4 * axis] = np.where(far, FAR, p)[part]
    return table


# --- what resampling takes from a lattice -----------------------------------------------------


def widths(scales: np.ndarray) -> np.ndarray:
    """Return how many times as wide a kernel is to be at `scales`, source px per grid px.

    >>> widths(np.array([0.5, 1.1, 1.3, 1.5, 2.8])).tolist()
    [1.0, 1.0, 1.25, 1.5, 2.8]
    """
    between = 1 + (scales - COARSE) * ((COARSER - 1) / (COARSER - COARSE))
    return np.maximum(1.0, np.minimum(scales, between))


def row_reach(
    lattice: Lattice, shape: tuple[int, int], start: int, stop: int
) -> tuple[float, float]:
    """Return least and largest source y of the grid rows `start` to `stop`; NaN where there is none."""
    if lattice.table is None:
        y = exact_table(lattice, shape, start, stop)[:, :, 4]
        y = y[y != FAR]
        return (float(y.min()), float(y.max())) if y.size else (np.nan, np.nan)
    down = lattice.table[:, :, 4:8]
    a, b, c, d = np.moveaxis(_between_rows(down, np.arange(start, stop), shape[0]), -1, 0)
    n = lattice.segment
    # A cubic stays between the least and the largest of its Bézier points.
    ends = (a, a + b * n / 3, a + 2 * b * n / 3 + c * n**2 / 3, a + n * (b + n * (c + n * d)))
    return float(min(e.min() for e in ends)), float(max(e.max() for e in ends))


def tap_rows(least: float, most: float, reach: float, height: int) -> tuple[int, int]:
    """Return the source rows, first and one past the last, that taps around y can stand on."""
    if not least <= most:
        return 0, 0
    low, high = max(floor(least - reach) - 1, 0), min(ceil(most + reach) + 2, height)
    return (low, high) if low < high else (0, 0)
