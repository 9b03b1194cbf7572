"""Fine detail of frames: whether a frame shows anything, and whether two frames show the same at the same place.

Bands of one painting share their edges whatever their contrast, even where an ink vanishes; two paintings do not,
and a dark or white has none. A frame is made into the roots of its gradients in blocks, less their mean over a
neighbourhood; frames are compared tile by tile, after the one small shift that several lenses may have.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from levkas.core.blocks import block_means

SIDE = 256
"""Blocks along the longer side; at half or twice as many the same frames are distinguished."""
RIM = 50
"""A fiftieth of each side is left out at every edge: masks and bad lines of a sensor are the same in all its frames."""
AROUND = 31
"""Blocks of the neighbourhood whose mean is taken off: the light's fall, and borders between dark and bright parts."""
LIGHT_SIDE, ORDER = 24, 4
"""Means along a side, and the order of the polynomial through them."""
TILES, LEAST_TILE = 8, 6
"""Tiles along a side, and the least side of one, blocks."""
REACH = 0.06
"""Share of a side by which two frames may be shifted; five lenses a few cm apart are 0.05 apart at 2 m."""
UNEVEN, RELATED, NOISE = 1.0, 0.08, 1.5
"""Spread of a tile's blocks (10th to 90th percentile over the median), and correlation of neighbours, from which it shows
more than noise: noise has 0.5 to 0.8, by Rayleigh's distribution, and 0; both grow by `NOISE` over the root of the
number of blocks. Strokes have 1.5 to 5; what fades in the infrared still goes on from block to block, by 0.1 to 0.6."""
ALIKE = 0.35
"""Correlation from which two tiles show the same. Of eight bands of a page 0.4 to 0.99, of other paintings about 0."""
ALL, FEW = 0.7, 0.4
"""Share of the tiles with structure that must be alike in frames of one object, and that may be in frames of two:
paintings of one size before one background have their outlines in common."""
MOST_CHANCE = 0.5
"""Share of tiles alike at other shifts that is counted off; a pattern that repeats has more."""
FEWEST = 6
"""Tiles with structure in both frames, without which frames are not compared."""


class Detail(NamedTuple):
    """Fine detail of a frame.

    Parameters
    ----------
    root : ndarray, (at most 256, at most 256), float32
        Roots of the gradients' means over blocks.
    rest : ndarray, same shape as `root`
        Less the mean of a neighbourhood.
    side : int
        Of a block, px of the mosaic's tile or of the frame, halved.
    """

    root: np.ndarray
    rest: np.ndarray
    side: int


class Likeness(NamedTuple):
    """Comparison of two frames: tiles with structure in both, those that are alike, all tiles, and the share that is
    alike by chance: at other shifts."""

    structured: int
    alike: int
    tiles: int
    chance: float = 0.0

    @property
    def is_same(self) -> bool | None:
        """Whether both show the same; None where they do not decide it."""
        if self.structured < FEWEST:
            return None
        share = (self.alike / self.structured - self.chance) / (1 - self.chance)
        return True if share >= ALL else False if share <= FEW else None

    @property
    def common(self) -> float:
        """Share of the frame in which both show the same."""
        return self.alike / max(self.tiles, 1)


def find_detail(
    values: np.ndarray, *, period: int = 0, along_lines: bool = False, step: float = 0.0
) -> Detail:
    """Return the fine detail of a frame.

    Parameters
    ----------
    values : ndarray, (height, width), any real dtype
        Counts.
    period : int
        Side of the mosaic's tile, whose mean is taken first; 0 for none.
    along_lines : bool
        Whether only differences from line to line count: columns of a push-broom scan are sensels.
    step : float
        Counts from one code to the next: finer differences are rounding.

    Returns
    -------
    detail : Detail
        Nothing of a frame of fewer than 12 blocks a side.
    """
    from scipy.ndimage import uniform_filter

    rim = [n // RIM for n in values.shape]
    plane = np.asarray(values[rim[0] : values.shape[0] - rim[0], rim[1] : values.shape[1] - rim[1]])
    plane = np.nan_to_num(plane.astype(np.float32), posinf=0.0, neginf=0.0)
    tile = max(period, 1)
    plane = block_means(plane, 1 if along_lines else tile, tile)
    if min(plane.shape) < 2 * LEAST_TILE:
        return Detail(np.zeros((0, 0), np.float32), np.zeros((0, 0), np.float32), 1)
    plane = plane - _light(plane)
    # Differences of no pixel in common: noise in one says nothing of that in the next.
    height, width = (n // 2 * 2 for n in plane.shape)
    a, b, c, d = (plane[i:height:2, j:width:2] for i in (0, 1) for j in (0, 1))
    steep = np.abs(a - c) + np.abs(b - d) if along_lines else np.hypot(a - d, b - c)
    steep = np.hypot(steep, step / tile)
    side = -(-max(steep.shape) // SIDE)
    root = np.sqrt(block_means(steep, 1 if along_lines else side, side))
    rest = root - uniform_filter(root, AROUND)
    return Detail(root, rest, side)


def _light(plane: np.ndarray) -> np.ndarray:
    """Return the polynomial of order 4 through a frame: the fall of the light, whose slope is no detail."""
    small = block_means(plane, *(-(-n // LIGHT_SIDE) for n in plane.shape))
    axes = [np.polynomial.chebyshev.chebvander(np.linspace(-1, 1, n), ORDER) for n in small.shape]
    fit = np.linalg.pinv(axes[0]) @ small @ np.linalg.pinv(axes[1]).T
    whole = [np.polynomial.chebyshev.chebvander(np.linspace(-1, 1, n), ORDER) for n in plane.shape]
    return np.asarray(whole[0] @ fit @ whole[1].T, np.float32)


def structured_share(detail: Detail) -> float:
    """Return the share of a frame's tiles that show more than noise.

    Examples
    --------
    >>> noise = np.random.default_rng(0).normal(2000, 20, (243, 324))
    >>> painted = noise + np.kron(np.random.default_rng(1).uniform(0, 900, (27, 36)), np.ones((9, 9)))
    >>> structured_share(find_detail(noise)) < 0.05, structured_share(find_detail(painted)) > 0.9
    (True, True)
    """
    structured = _structured(detail)
    return sum(structured) / max(len(structured), 1)


def compare_detail(one: Detail, other: Detail) -> Likeness:
    """Compare two frames of one size tile by tile, at the shift where they agree best.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> ink, other = (np.kron(rng.uniform(0, 900, (243 // n, 324 // n)), np.ones((n, n))) for n in (9, 27))
    >>> frames = [find_detail(2000 + f + rng.normal(0, 20, f.shape)) for f in (ink, -0.3 * ink, other)]
    >>> compare_detail(*frames[:2]).is_same, bool(compare_detail(*frames[1:]).is_same)
    (True, False)
    """
    if one.root.shape != other.root.shape or not one.root.size:
        return Likeness(0, 0, 0)
    from scipy.ndimage import uniform_filter

    # Over three blocks: by less than one two frames are shifted always.
    smooth = [uniform_filter(detail.rest, 3) for detail in (one, other)]
    shift = _shift(*smooth)
    root, rest = (np.roll(part, shift, (0, 1)) for part in (other.root, other.rest))
    moved = Detail(root, rest, other.side)
    both = np.array(_structured(one)) & np.array(_structured(moved))
    alike = both & _alike(smooth[0], np.roll(smooth[1], shift, (0, 1)))
    height, width = one.root.shape
    far = [(height // 2, 0), (0, width // 2), (height // 3, width // 3), (height // 2, width // 2)]
    by_chance = [_alike(smooth[0], np.roll(smooth[1], away, (0, 1)))[both] for away in far]
    chance = float(np.mean(by_chance)) if both.any() else 0.0
    return Likeness(int(both.sum()), int(alike.sum()), len(both), min(chance, MOST_CHANCE))


def _alike(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    pairs = zip(_tiles(one), _tiles(other), strict=True)
    return np.array([_correlation(a, b) > ALIKE for a, b in pairs])


def show_the_same(details: Sequence[Detail]) -> bool | None:
    """Return whether all of some frames show one object, each at least what another shows; None where they do not decide it.

    A frame without structure decides nothing.
    """
    same = {
        (i, j): compare_detail(details[i], details[j]).is_same
        for i in range(len(details))
        for j in range(i + 1, len(details))
    }
    if _reached({pair for pair, found in same.items() if found}) == len(details):
        return True
    return False if all(found is False for found in same.values()) else None


def _reached(pairs: Collection[tuple[int, int]]) -> int:
    """Count what is linked with the first, by any number of links."""
    known, last = {0}, 0
    while len(known) > last:
        last = len(known)
        known |= {n for pair in pairs if not known.isdisjoint(pair) for n in pair}
    return len(known)


def _shift(one: np.ndarray, other: np.ndarray) -> tuple[int, int]:
    """Return by how many blocks (y, x) `other` must be shifted to agree best with `one`, within `REACH`."""
    product = np.fft.rfft2(one) * np.conj(np.fft.rfft2(other))
    agreement = np.fft.irfft2(product, one.shape)
    height, width = one.shape
    y, x = round(REACH * height), round(REACH * width)
    near = np.roll(agreement, (y, x), (0, 1))[: 2 * y + 1, : 2 * x + 1]
    row, column = np.unravel_index(int(near.argmax()), near.shape)
    return int(row) - y, int(column) - x


def _tiles(blocks: np.ndarray) -> list[np.ndarray]:
    height, width = blocks.shape
    rows, columns = (max(1, min(TILES, n // LEAST_TILE)) for n in (height, width))
    return [
        blocks[
            i * height // rows : (i + 1) * height // rows,
            j * width // columns : (j + 1) * width // columns,
        ]
        for i in range(rows)
        for j in range(columns)
    ]


def _structured(detail: Detail) -> list[bool]:
    """Whether each tile shows more than noise: by its spread, or because it goes on from block to block."""
    if not detail.root.size:
        return []
    found = []
    for root, rest in zip(_tiles(detail.root), _tiles(detail.rest), strict=True):
        low, middle, high = np.percentile(root, (10, 50, 90))
        pairs = (
            (rest[1:], rest[:-1]),
            (rest[:, 1:], rest[:, :-1]),
            (rest[1:, 1:], rest[:-1, :-1]),
            (rest[1:, :-1], rest[:-1, 1:]),
        )
        spread = (high - low) / max(middle, 1e-9) * detail.side
        related = sum(_correlation(a, b) for a, b in pairs) / len(pairs)
        chance = NOISE / np.sqrt(root.size)
        found.append(bool(spread > UNEVEN + chance or related > max(RELATED, chance)))
    return found


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    a, b = one - one.mean(), other - other.mean()
    return float((a * b).sum() / max(float(np.sqrt((a * a).sum() * (b * b).sum())), 1e-12))
