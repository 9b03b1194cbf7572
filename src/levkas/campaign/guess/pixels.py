"""What the numbers of one frame tell of it: how dark, how even, how many bits, what mosaic."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

LARGEST_TILE = 5
LEAST_SPAN = 0.06
"""Phases of a mosaic differ by more of their mean; rows and columns of a plain sensor do not."""
BLOCKS = 24
CODES = 1 << 16


@dataclass(frozen=True)
class Statistics:
    """Numbers of one frame.

    Parameters
    ----------
    mean, low, high : float
        Mean, and 1st and 99th percentiles, counts.
    top, top_count : int
        Highest code and how many samples have it.
    step : int
        Largest number that divides every code; 16 where 12 bits stand at the upper end of 16.
    unevenness : float
        Spread of block means (5th to 95th percentile) over their median.
    texture : float
        Median spread inside blocks over the median level, neighbours of one phase compared.
    phases : dict
        Tile side p → (p, p) means, for sides 2 to 5.
    thumbnail : ndarray, (n, m), float64
        Block means.
    """

    mean: float
    low: float
    high: float
    top: int
    top_count: int
    step: int
    unevenness: float
    texture: float
    phases: dict[int, np.ndarray]
    thumbnail: np.ndarray


def describe_pixels(values: np.ndarray) -> Statistics:
    """Describe one frame.

    Parameters
    ----------
    values : ndarray, (height, width), any real dtype
        Counts.

    Examples
    --------
    >>> frame = np.full((60, 60), 4080, np.uint16)
    >>> frame[::2, ::2] = 1600
    >>> told = describe_pixels(frame)
    >>> told.top, told.step, find_mosaic(told.phases)
    (4080, 80, 2)
    """
    plane = np.asarray(values)
    counts = plane.astype(np.float32)
    low, high = (float(v) for v in np.percentile(counts, (1, 99)))
    top = plane.max(initial=0)
    block = block_means(counts, 1 + min(counts.shape) // BLOCKS)
    level = float(np.median(block)) or 1.0
    p5, p95 = np.percentile(block, (5, 95))
    return Statistics(
        mean=float(counts.mean(dtype=np.float64)),
        low=low,
        high=high,
        top=int(top),
        top_count=int(np.count_nonzero(plane == top)),
        step=_step(plane),
        unevenness=float(p95 - p5) / abs(level),
        texture=_texture(counts) / abs(level),
        phases={side: phase_means(counts, side) for side in range(2, LARGEST_TILE + 1)},
        thumbnail=block,
    )


def phase_means(values: np.ndarray, side: int) -> np.ndarray:
    """Return the mean of each phase of a tile of `side` x `side` sensels, (side, side)."""
    height, width = (n // side * side for n in values.shape)
    tiles = values[:height, :width].reshape(height // side, side, width // side, side)
    return np.asarray(tiles.mean(axis=(0, 2), dtype=np.float64))


def find_mosaic(phases: dict[int, np.ndarray], *, dark: float = 0.0) -> int:
    """Return the side of the mosaic's tile that phase means show, 0 for none.

    Parameters
    ----------
    phases : dict
        As `Statistics.phases`, of a bright frame.
    dark : float
        Level without light, counts.

    Examples
    --------
    >>> flat = {p: np.ones((p, p)) for p in (2, 3, 4, 5)}
    >>> find_mosaic(flat), find_mosaic(flat | {3: np.arange(1.0, 10).reshape(3, 3)})
    (0, 3)
    >>> find_mosaic({p: np.full((p, p), np.nan) for p in (2, 3, 4, 5)})
    0
    """
    spans = {
        # A frame no brighter than its dark shows noise, not colours.
        side: float(np.ptp(means)) / max(means.mean() - dark, 0.1 * means.mean(), 1e-9)
        for side, means in phases.items()
    }
    # A frame smaller than a tile has no mean of every phase.
    spans = {side: span for side, span in spans.items() if np.isfinite(span)}
    best = max(spans.values(), default=0.0)
    if best < LEAST_SPAN:
        return 0
    # A tile of 4 shows what one of 2 is: the smallest that shows nearly all of it is meant.
    return next(side for side in sorted(spans) if spans[side] > 0.8 * best)


def bits_of(top: int, step: int) -> int:
    """Return the fewest bits, of those that sensors have, that hold codes up to `top`.

    >>> bits_of(4095, 1), bits_of(65520, 16), bits_of(5000, 1)
    (12, 12, 14)
    """
    shift = max(step, 1).bit_length() - 1
    return next((bits for bits in (8, 10, 12, 14) if top >> shift < 1 << bits), 16)


def is_same_scene(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two thumbnails show the same, up to noise and a few percent of brightness."""
    if one.shape != other.shape:
        return False
    a, b = one - one.mean(), other - other.mean()
    size = float(np.sqrt((a * a).mean() * (b * b).mean()))
    level = max(abs(float(one.mean())), abs(float(other.mean())), 1e-9)
    if abs(float(one.mean() - other.mean())) > 0.1 * level:
        return False
    return size < 0.02 * level or float((a * b).mean()) > 0.97 * size


def block_means(values: np.ndarray, side: int) -> np.ndarray:
    """Return the means of blocks of `side` x `side`, the rest at the edges left out."""
    side = max(1, min(side, *values.shape))
    height, width = (n // side for n in values.shape)
    blocks = values[: height * side, : width * side].reshape(height, side, width, side)
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float64))


def _texture(values: np.ndarray) -> float:
    """Median absolute difference of sensels 60 apart, a multiple of every tile's side, within a block."""
    step = 60 if min(values.shape) > 180 else 2
    across = np.abs(values[:, step:] - values[:, :-step])
    return float(np.median(across)) if across.size else 0.0


def _step(values: np.ndarray) -> int:
    if values.dtype.kind not in "ui" or values.dtype.itemsize > 2:
        return 1
    codes = np.unique(values)
    return max(1, int(np.gcd.reduce(codes.astype(np.int64)))) if codes.size > 1 else 1
