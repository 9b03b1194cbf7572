"""Black levels of a file that are no single number: by phase of a pattern, by row, by column.

DNG 1.7, tags BlackLevel, BlackLevelRepeatDim, BlackLevelDeltaH, BlackLevelDeltaV: the black of a sensel is the level of
its place in the repeated pattern, plus the delta of its column, plus the delta of its row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from levkas.readers.tiff_directories import numbers_of

MOST_PERIOD = 64
"""Rows or columns after which a pattern of levels repeats; sensors have 1, 2, 4 or 6."""


@dataclass(frozen=True)
class BlackLevels:
    """Black of every sensel of a frame, counts: a pattern that repeats from the top left one, and what is added to rows and columns.

    >>> BlackLevels(((60.0, 64.0),), rows=(0.0, 1.0)).plane((2, 3)).tolist()
    [[60.0, 64.0, 60.0], [61.0, 65.0, 61.0]]
    """

    pattern: tuple[tuple[float, ...], ...]
    rows: tuple[float, ...] = ()
    columns: tuple[float, ...] = ()

    @property
    def mean(self) -> float:
        """Over the frame, counts."""
        return float(sum(np.mean(part) for part in self._parts if len(part)))

    @property
    def most(self) -> float:
        """The highest that it may be, counts."""
        return float(sum(max(part) for part in self._parts if len(part)))

    @property
    def _parts(self) -> tuple[tuple[float, ...], ...]:
        return tuple(n for row in self.pattern for n in row), self.rows, self.columns

    @property
    def varies(self) -> bool:
        """Whether two sensels have levels that differ."""
        return any(len(set(part)) > 1 for part in self._parts)

    def distance(self, other: BlackLevels) -> float:
        """Return the most that a sensel's black may differ in two files of one frame size, counts.

        >>> BlackLevels(((60.0, 64.0),)).distance(BlackLevels(((64.0, 60.0),)))
        4.0
        """
        sizes = [(len(one.pattern), len(one.pattern[0])) for one in (self, other)]
        size = tuple(int(np.lcm(*side)) for side in zip(*sizes, strict=True))
        bare = (BlackLevels(one.pattern).plane(size) for one in (self, other))
        apart = float(np.abs(np.subtract(*bare)).max())
        for a, b in ((self.rows, other.rows), (self.columns, other.columns)):
            if a and b and len(a) != len(b):
                return float("inf")
            apart += float(np.abs(np.subtract(a or 0.0, b or 0.0)).max())
        return apart

    def plane(self, shape: Sequence[int]) -> np.ndarray:
        """Return the black of every sensel of a frame of (height, width, …), (height, width), float32."""
        height, width = shape[:2]
        high, wide = len(self.pattern), len(self.pattern[0])
        plane = np.tile(np.array(self.pattern, np.float32), (-(-height // high), -(-width // wide)))
        plane = plane[:height, :width].copy()
        if self.rows:
            plane += np.array(self.rows, np.float32)[:, None]
        if self.columns:
            plane += np.array(self.columns, np.float32)
        return plane


def black_facts(
    page: Any, visible: Sequence[int], *, top: float | None = None, mean: float | None = None
) -> dict[str, Any]:
    """Return `black`, `blacks` and `black_unclear` of a page's tags, as `Facts` has them.

    `visible`, (top, left, bottom, right) px, is what is read of the page; at `top` counts a sensel is full: no black lies
    there; `mean` is the black as another decoder understands the tags, compared where levels repeat after two sensels.
    """
    tags = page.tags
    levels, period = numbers_of(tags, "BlackLevel"), numbers_of(tags, "BlackLevelRepeatDim")
    rows, columns = (numbers_of(tags, f"BlackLevelDelta{name}") for name in "VH")
    if not (levels or rows or columns):
        return {"black": None}
    high, wide = (int(n) for n in period) if len(period) == 2 else (1, 1)
    if not 0 < high <= MOST_PERIOD or not 0 < wide <= MOST_PERIOD:
        return _unclear(f"BlackLevelRepeatDim = {high} {wide}")
    levels = levels or (0.0,)
    if len(set(levels)) == 1:
        levels = levels[:1] * (high * wide)
    if len(levels) != high * wide:
        return _unclear(f"BlackLevel has {len(levels)} numbers for {high} x {wide} sensels")
    area = tuple(int(n) for n in numbers_of(tags, "ActiveArea"))
    area = area if len(area) == 4 else (0, 0, page.imagelength, page.imagewidth)
    for name, delta, count in (("V", rows, area[2] - area[0]), ("H", columns, area[3] - area[1])):
        if len(delta) not in (0, count):
            return _unclear(f"BlackLevelDelta{name} has {len(delta)} numbers for {count} lines")
    pattern = tuple(levels[y * wide : (y + 1) * wide] for y in range(high))
    blacks = BlackLevels(pattern, rows, columns)
    if blacks.varies and tuple(visible) != area:
        return _unclear(f"levels of the area {area}, and a frame of {tuple(visible)}")
    if top is not None and blacks.most >= top:
        return _unclear(f"a black of {blacks.most:g}, and the sensor is full at {top:g}")
    if mean is not None and max(high, wide) <= 2 and abs(blacks.mean - mean) > 1:
        return _unclear(f"a mean black of {blacks.mean:g} by the tags, of {mean:g} by LibRaw")
    return {"black": blacks.mean, "blacks": blacks if blacks.varies else None}


def _unclear(why: str) -> dict[str, Any]:
    return {"black": None, "black_unclear": why}
