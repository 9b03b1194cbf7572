"""Pictures of parts of one plane, joined on a grid: which part a pixel is taken from, and what parts differ by at the seams.

A pixel is taken from the part in which it lies deepest, px from the edge of its frame: there the lens bends and darkens least. Over
a few pixels about the seam, where two parts are equally deep, one fades into the other.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.cube import UNRELIABLE
from levkas.core.flags import Flag
from levkas.geometry.resample import Warped

if TYPE_CHECKING:
    from levkas.geometry.transforms import Transform

Box = tuple[int, int, int, int]
"""x, y of the first pixel of the grid, and x, y behind the last."""
FEATHER_PX = 16.0
"""Difference of depths, px, over which a part fades out: a seam half way between two frames is so many px wide on
either side. At half of it fine detail that lies a tenth of a pixel apart still shows as a line; twice as much makes more pixels a mean."""
NODES_PX = 16
"""Distance of the places, grid px, at which depth is computed; between them it is interpolated, to 0.1 px of a lens."""
AROUND = 64
"""Places along each side of a frame that say which pixels of the grid it covers."""
UNTRUSTED = UNRELIABLE | Flag.DEFECT
MOST_STEP, LEAST_PIXELS = 0.02, 2000
"""Mean difference at a seam, of the value, from which on it shows on even ground, and pixels of all bands that say so."""
WITHIN = 2.0
"""Times its standard uncertainty that a difference at a seam may be."""


def box_on_grid(transform: Transform, size: tuple[int, int], grid: tuple[int, int]) -> Box | None:
    """Return which pixels of a grid a frame may cover, by `transform`, grid px → px of the frame; None where it covers none.

    `size` and `grid` are (width, height) of the frame and of the grid.

    >>> from levkas.geometry.transforms import Affine
    >>> box_on_grid(Affine(np.array([[1.0, 0, -20], [0, 1, 5]])), (30, 20), (100, 100))
    (19, 0, 51, 16)
    """
    along = np.linspace(0.0, 1.0, AROUND)
    x, y = (a.ravel() for a in np.meshgrid(along, along))
    edge = (x % 1 == 0) | (y % 1 == 0)
    places = transform.inverse(np.stack([x, y], 1)[edge] * size - 0.5)
    places = places[np.isfinite(places).all(1)]
    if not len(places):
        return None
    left, top = np.maximum(np.floor(places.min(0)), 0).astype(int).tolist()
    right, bottom = np.minimum(np.ceil(places.max(0)) + 1, grid).astype(int).tolist()
    return (left, top, right, bottom) if left < right and top < bottom else None


def depth_in_frame(
    transform: Transform, size: tuple[int, int], box: Box, rows: tuple[int, int]
) -> np.ndarray:
    """Return how far from the edge of a frame of (width, height) `size` pixels of a grid lie, (rows, columns of the box), px of the frame, float32; below 0 outside of it.

    `transform` goes grid px → px of the frame. Nodes begin at the corner of the box, so that rows may be taken in any blocks.

    >>> from levkas.geometry.transforms import Affine
    >>> depth_in_frame(Affine.identity(), (9, 9), (0, 0, 4, 9), (4, 5)).tolist()
    [[0.5, 1.5, 2.5, 3.5]]
    """
    across, u = _cells(np.arange(box[0], box[2]) - box[0])
    down, v = _cells(np.arange(*rows) - box[1])
    first = int(down[0])
    y = np.arange(first, down[-1] + 2) * NODES_PX + box[1]
    x = np.arange(across[-1] + 2) * NODES_PX + box[0]
    nodes = transform(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2).astype(float))
    depth = np.full((len(down), len(across)), np.inf, np.float32)
    for axis in range(2):
        table = nodes[:, axis].reshape(len(y), len(x)).astype(np.float32)
        above, below = (
            (1 - u) * part[:, across] + u * part[:, across + 1]
            for part in (table[down - first], table[down - first + 1])
        )
        place = (1 - v[:, None]) * above + v[:, None] * below
        np.minimum(depth, place + np.float32(0.5), out=depth)
        np.minimum(depth, np.float32(size[axis] - 0.5) - place, out=depth)
    return np.where(np.isnan(depth), np.float32(-np.inf), depth)


def _cells(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    cells, rest = np.divmod(places, NODES_PX)
    return cells, (rest / NODES_PX).astype(np.float32)


@dataclass(frozen=True, eq=False)
class TilePart:
    """Some rows of a part on the grid: as `levkas.geometry.resample.warp` gives them, (rows, columns, bands)."""

    name: str
    columns: slice
    """Of the grid."""
    values: np.ndarray
    flags: np.ndarray
    variance: np.ndarray | None
    depth: np.ndarray
    """(rows, columns), float32, px."""
    sigma: float = 0.0
    """In grid px: how well the part is placed."""


def weights_of(parts: Sequence[TilePart], shape: tuple[int, int]) -> list[np.ndarray]:
    """Return how much each part counts at every pixel, 0 … 1: 1 where it is the deepest, 0 from `FEATHER_PX` less on."""
    deepest = np.zeros(shape, np.float32)
    for part in parts:
        here = deepest[:, part.columns]
        np.maximum(here, part.depth, out=here)
    shares = ((p.depth - deepest[:, p.columns]) / np.float32(FEATHER_PX) + 1 for p in parts)
    return [
        np.where(part.depth > 0, np.clip(share, 0, 1), np.float32(0))
        for part, share in zip(parts, shares, strict=True)
    ]


def join(
    parts: Sequence[TilePart], shape: tuple[int, int, int], seams: Seams | None = None
) -> Warped:
    """Join rows of parts, (rows, width, bands) `shape`; NaN and OUTSIDE where there is none. `seams` takes what parts differ by.

    Where the deepest part is saturated or has a defect, another one that is sound takes its place.
    """
    noisy = bool(parts) and all(part.variance is not None for part in parts)
    weights = weights_of(parts, shape[:2])
    there = [np.isfinite(p.values) & (p.flags & Flag.OUTSIDE == 0) for p in parts]
    sound = [ok & (p.flags & UNTRUSTED == 0) for ok, p in zip(there, parts, strict=True)]
    used = [np.where(ok, w[..., None], np.float32(0)) for ok, w in zip(sound, weights, strict=True)]
    if seams is not None:
        seams.add(parts, used)
    total = np.zeros(shape, np.float32)
    for part, share in zip(parts, used, strict=True):
        total[:, part.columns] += share
    _fill(parts, there, sound, used, total)
    values, flags = np.zeros(shape, np.float32), np.zeros(shape, np.uint8)
    variance = np.zeros(shape, np.float32) if noisy else None
    divisor = np.where(total > 0, total, np.float32(1))
    for part, share in zip(parts, used, strict=True):
        columns, counts = part.columns, share > 0
        share = share / divisor[:, columns]
        values[:, columns] += np.where(counts, share * np.nan_to_num(part.values), np.float32(0))
        flags[:, columns] |= np.where(counts, part.flags, np.uint8(0))
        if variance is not None and part.variance is not None:
            variance[:, columns] += np.where(counts, share * share * part.variance, np.float32(0))
    nothing = total <= 0
    values[nothing], flags[nothing] = np.nan, Flag.OUTSIDE
    if variance is not None:
        variance[nothing] = np.nan
    return Warped(values, flags, variance)


def _fill(
    parts: Sequence[TilePart],
    there: Sequence[np.ndarray],
    sound: Sequence[np.ndarray],
    used: Sequence[np.ndarray],
    total: np.ndarray,
) -> None:
    """Where no part counts, let the one that is there do so: a sound one before others, the deepest of them."""
    empty = total == 0
    if not empty.any():
        return
    best, ranks = np.full(total.shape, np.float32(-np.inf)), []
    for part, ok, good in zip(parts, there, sound, strict=True):
        rank = part.depth[..., None] + np.float32(1e6) * good
        ranks.append(np.where(ok & empty[:, part.columns], rank, np.float32(-np.inf)))
        here = best[:, part.columns]
        np.maximum(here, ranks[-1], out=here)
    for part, rank, share in zip(parts, ranks, used, strict=True):
        chosen = np.isfinite(rank) & (rank == best[:, part.columns])
        chosen &= total[:, part.columns] == 0  # the first of equal ones
        share[chosen] = 1
        total[:, part.columns][chosen] = 1


SHARES = (
    ("within", "within", 1, 4),
    ("ratio", "squares", 0.5, 3),
    ("ratio_noise", "random", 0.5, 3),
)
"""Of a record of a seam: name, sum, power of its mean, digits."""


@dataclass(eq=False)
class Seams:
    """Sums of what parts differ by where one fades into another, pair by pair, (bands,) each."""

    labels: tuple[str, ...]
    sums: dict[tuple[str, str], dict[str, np.ndarray]] = field(default_factory=dict)

    def add(self, parts: Sequence[TilePart], used: Sequence[np.ndarray]) -> None:
        """Take the pixels of some rows where two parts count, `used` (rows, columns, bands) each."""
        for (i, a), (j, b) in combinations(enumerate(parts), 2):
            low, high = max(a.columns.start, b.columns.start), min(a.columns.stop, b.columns.stop)
            if low >= high:
                continue
            mine, theirs = (
                np.s_[:, low - p.columns.start : high - p.columns.start] for p in (a, b)
            )
            both = (used[i][mine] > 0) & (used[j][theirs] > 0)
            if not both.any():
                continue
            found = _differences(a, b, mine, theirs)
            kept = self.sums.setdefault((a.name, b.name), {})
            for name, value in found.items():
                total = np.where(both, value, 0).sum((0, 1), dtype=np.float64)
                kept[name] = kept.get(name, 0.0) + total

    def records(self) -> list[dict[str, Any]]:
        """Return what was found of every pair, JSON-ready.

        ``pixels`` of all bands; ``within`` the share of them whose difference is within 2 standard uncertainties, of noise and
        place; ``ratio`` of the rms difference to that uncertainty, ``ratio_noise`` to noise alone; ``relative`` the mean
        difference over the mean value, by band.
        """
        return [self._record(pair, sums) for pair, sums in sorted(self.sums.items())]

    def _record(self, pair: tuple[str, str], sums: dict[str, np.ndarray]) -> dict[str, Any]:
        count = float(sums["pixels"].sum())
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = sums["difference"] / sums["value"]
        found: dict[str, Any] = {"tiles": list(pair), "pixels": int(count)}
        for name, key, power, digits in SHARES:
            known = key in sums and count > 0
            found[name] = round(float(sums[key].sum() / count) ** power, digits) if known else None
        found["relative"] = {
            label: round(float(value), 5) if np.isfinite(value) else None
            for label, value in zip(self.labels, relative, strict=True)
        }
        return found


def _differences(a: TilePart, b: TilePart, mine: Any, theirs: Any) -> dict[str, np.ndarray]:
    """Return what two parts differ by where their columns are the same, (rows, columns, bands) each."""
    first, second = a.values[mine], b.values[theirs]
    found = {
        "pixels": np.ones_like(first),
        "difference": second - first,
        "value": (first + second) / 2,
    }
    if a.variance is not None and b.variance is not None:
        square, random = (second - first) ** 2, a.variance[mine] + b.variance[theirs]
        placed = (a.sigma**2 + b.sigma**2) * _steepness(first)
        ratio = square / np.maximum(random + placed, np.float32(1e-20))
        found["squares"] = ratio
        found["random"] = square / np.maximum(random, np.float32(1e-20))
        found["within"] = (ratio <= WITHIN**2).astype(np.float32)
    return found


def mean_step(seam: Mapping[str, Any]) -> float:
    """Return by how much the second tile is brighter at a seam of `Seams.records`, of the value, in the mean over the bands.

    >>> round(mean_step({"relative": {"R": 0.03, "G": 0.01, "B": None}}), 3)
    0.02
    """
    return float(np.mean([v for v in seam["relative"].values() if v is not None] or [0.0]))


def describe_steps(seams: Iterable[Mapping[str, Any]]) -> list[str]:
    """Report of seams whose step shows."""
    return [
        f"parts {' and '.join(one['tiles'])} differ by {100 * abs(mean_step(one)):.1f} % where they meet: light, flat field, glare or "
        "the object changed between them"
        for one in seams
        if abs(mean_step(one)) > MOST_STEP and one["pixels"] >= LEAST_PIXELS
    ]


def _steepness(values: np.ndarray) -> np.ndarray:
    """Return the square of the gradient of (rows, columns, bands), per px, halved: of a shift along one axis."""
    total = np.zeros(values.shape, np.float32)
    for axis in range(2):
        if values.shape[axis] > 1:
            slope = np.nan_to_num(np.gradient(values, axis=axis))
            total += (slope * slope).astype(np.float32)
    return total
