"""Black levels of a file that differ by the phase of a pattern: DNG 1.7, tags BlackLevel and BlackLevelRepeatDim."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from levkas.readers.exif import numbers_of

MOST_PERIOD = 64
"""Rows or columns after which a pattern of levels repeats; sensors have 1, 2, 4 or 6."""


@dataclass(frozen=True)
class BlackLevels:
    """Black of every sensel of a frame, counts: a pattern that repeats from the top left one.

    >>> BlackLevels(((60.0, 64.0),)).plane((2, 3)).tolist()
    [[60.0, 64.0, 60.0], [60.0, 64.0, 60.0]]
    """

    pattern: tuple[tuple[float, ...], ...]

    @property
    def varies(self) -> bool:
        """Whether two sensels have levels that differ."""
        return len({level for row in self.pattern for level in row}) > 1

    def distance(self, other: BlackLevels) -> float:
        """Return the most that a sensel's black may differ in two files of one frame size, counts.

        >>> BlackLevels(((60.0, 64.0),)).distance(BlackLevels(((64.0, 60.0),)))
        4.0
        """
        sizes = [(len(one.pattern), len(one.pattern[0])) for one in (self, other)]
        size = tuple(int(np.lcm(*side)) for side in zip(*sizes, strict=True))
        return float(np.abs(self.plane(size) - other.plane(size)).max())

    def plane(self, shape: Sequence[int]) -> np.ndarray:
        """Return the black of every sensel of a frame of (height, width, …), (height, width), float32."""
        height, width = shape[:2]
        high, wide = len(self.pattern), len(self.pattern[0])
        tiles = -(-height // high), -(-width // wide)
        return np.tile(np.array(self.pattern, np.float32), tiles)[:height, :width].copy()


def black_facts(
    page: Any, visible: Sequence[int], *, top: float | None = None, mean: float | None = None
) -> dict[str, Any]:
    """Return `black`, `blacks` and `black_unclear` of a page's tags, as `Facts` has them.

    `visible`, (top, left, bottom, right) px, is what is read of the page; at `top` counts a sensel is full: no black lies
    there; `mean` is the black as another decoder understands the tags, compared where levels repeat after two sensels.
    """
    tags = page.tags
    levels, period = numbers_of(tags, "BlackLevel"), numbers_of(tags, "BlackLevelRepeatDim")
    if any(map(any, (numbers_of(tags, f"BlackLevelDelta{name}") for name in "VH"))):
        return _unclear("BlackLevelDeltaV or -H, a black by row or column")
    if not levels:
        return {"black": None}
    high, wide = (int(n) for n in period) if len(period) == 2 else (1, 1)
    if not 0 < high <= MOST_PERIOD or not 0 < wide <= MOST_PERIOD:
        return _unclear(f"BlackLevelRepeatDim = {high} {wide}")
    if len(set(levels)) == 1:
        levels = levels[:1] * (high * wide)
    if len(levels) != high * wide:
        return _unclear(f"BlackLevel has {len(levels)} numbers for {high} x {wide} sensels")
    area = tuple(int(n) for n in numbers_of(tags, "ActiveArea"))
    area = area if len(area) == 4 else (0, 0, page.imagelength, page.imagewidth)
    blacks = BlackLevels(tuple(levels[y * wide : (y + 1) * wide] for y in range(high)))
    black = float(np.mean(levels))
    if blacks.varies and tuple(visible) != area:
        return _unclear(f"levels of the area {area}, and a frame of {tuple(visible)}")
    if top is not None and max(levels) >= top:
        return _unclear(f"a black of {max(levels):g}, and the sensor is full at {top:g}")
    if mean is not None and max(high, wide) <= 2 and abs(black - mean) > 1:
        return _unclear(f"a mean black of {black:g} by the tags, of {mean:g} by LibRaw")
    return {"black": black, "blacks": blacks if blacks.varies else None}


def _unclear(why: str) -> dict[str, Any]:
    return {"black": None, "black_unclear": why}
