"""Darks of a sensor over exposures: level, dark current, fixed pattern."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from levkas.calibration.darks import SAME_TIME
from levkas.quality.emva1288.blocks import Blocks


@dataclass(frozen=True)
class Dark:
    """Counts without light at one exposure.

    Parameters
    ----------
    level, temporal, fixed : ndarray, (blocks,), or float
        Mean, variance of one shot with rounding, variance from sensel to sensel; NaN if not known.
    band : str, optional
        Of a tunable filter; None: it serves all.
    """

    level: np.ndarray | float
    temporal: np.ndarray | float
    fixed: np.ndarray | float
    exposure_s: float | None = None
    band: str | None = None

    @classmethod
    def of_blocks(cls, blocks: Blocks) -> Dark:
        """Return a dark that was not clipped, without the blocks that hold hot sensels."""
        sound = np.where(np.isfinite(blocks.spatial), 0.0, np.nan)
        fixed = blocks.spatial - blocks.temporal / blocks.shots
        level, temporal = blocks.mean + sound, blocks.temporal + sound
        return cls(level, temporal, fixed, blocks.exposure_s, blocks.band)


def mean_of(values: np.ndarray | float) -> float:
    """Return the mean over blocks that are known; NaN where none is."""
    known = np.atleast_1d(values)[np.isfinite(np.atleast_1d(values))]
    return float(known.mean()) if known.size else float("nan")


def dark_line(darks: Sequence[Dark]) -> tuple[float, float]:
    """Return black at no time and counts a second; NaN a second where times do not differ by half."""
    times = np.array([d.exposure_s if d.exposure_s else np.nan for d in darks])
    level = np.array([mean_of(d.level) for d in darks])
    known = np.isfinite(times) & np.isfinite(level)
    if np.count_nonzero(known) < 2 or times[known].max() < 2 * times[known].min():
        return float(level[0]), float("nan")
    slope, start = np.polyfit(times[known], level[known], 1)
    return float(start), float(slope)


class DarkModel:
    """Dark level and fixed pattern under lit stacks: of their own band and exposure, else lines over exposures.

    Level = black + current·t, and the fixed pattern's variance = a + b·t², as current differs from sensel
    to sensel.
    """

    def __init__(self, darks: Sequence[Dark]) -> None:
        self.darks = sorted(darks, key=lambda dark: dark.exposure_s or 0.0)
        noisy = (dark for dark in self.darks if np.isfinite(mean_of(dark.temporal)))
        self.first = next(noisy, self.darks[0])
        self.black, self.current = dark_line(self.darks)

    def own(self, band: str | None, exposure_s: float | None) -> Dark | None:
        """Return the dark of an exposure: of the band, else one that serves all, else of another band."""
        alike = [d for d in self.darks if same_time(d.exposure_s, exposure_s)]
        order = {band: 0, None: 1}
        return min(alike, key=lambda d: order.get(d.band, 2)) if alike else None

    def lacks(self, stack: Blocks) -> bool:
        """Return whether a stack has no dark of its exposure, and none can be interpolated."""
        timed = stack.exposure_s and any(d.exposure_s for d in self.darks)
        known = self.own(stack.band, stack.exposure_s) is not None or np.isfinite(self.current)
        return bool(timed) and not known

    def under(self, band: str | None, exposure_s: float | None) -> np.ndarray | float:
        """Return the counts without light, block by block or as one."""
        own = self.own(band, exposure_s)
        if own is not None:
            return own.level
        near = self._nearest(self.darks, band, exposure_s)
        rest = ((exposure_s or 0.0) - (near.exposure_s or 0.0)) * self.current
        timed = exposure_s and near.exposure_s and np.isfinite(rest)
        return near.level + (rest if timed else 0.0)

    def signal(self, stack: Blocks) -> np.ndarray:
        """Return the counts above dark of a stack, block by block."""
        return np.asarray(stack.mean - self.under(stack.band, stack.exposure_s))

    def dark_signal(self, stack: Blocks) -> np.ndarray | float:
        """Return the counts of dark current in a stack beyond those in `first`: they have shot noise as light has."""
        times = (stack.exposure_s, self.first.exposure_s)
        if not all(times) or same_time(*times):
            return 0.0
        return mean_of(self.under(stack.band, stack.exposure_s)) - mean_of(self.first.level)

    def fixed(self, stack: Blocks) -> float:
        """Return the variance from sensel to sensel without light; 0 where no dark shows it."""
        known = [d for d in self.darks if np.isfinite(mean_of(d.fixed))]
        if not known:
            return 0.0
        near = self._nearest(known, stack.band, stack.exposure_s)
        squares = [d.exposure_s**2 for d in known if d.exposure_s]
        alone = len(squares) < len(known) or max(squares) < 4 * min(squares)
        if alone or not stack.exposure_s or same_time(near.exposure_s, stack.exposure_s):
            return mean_of(near.fixed)
        slope, start = np.polyfit(squares, [mean_of(d.fixed) for d in known], 1)
        return max(float(start + slope * stack.exposure_s**2), 0.0)

    def _nearest(self, darks: Sequence[Dark], band: str | None, exposure_s: float | None) -> Dark:
        order = {band: 0, None: 1}

        def apart(dark: Dark) -> tuple[float, int]:
            if not dark.exposure_s or not exposure_s:
                return 0.0, order.get(dark.band, 2)
            return abs(float(np.log(dark.exposure_s / exposure_s))), order.get(dark.band, 2)

        return min(darks, key=apart)


def same_time(one: float | None, other: float | None) -> bool:
    """Return whether two exposures are known, and one.

    >>> same_time(0.1, 0.1005), same_time(None, None)
    (True, False)
    """
    return bool(one and other) and abs(float(one) / float(other) - 1) <= SAME_TIME  # type: ignore[arg-type]
