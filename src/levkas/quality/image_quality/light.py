"""Light on the object's plane, from a measured white: map, contours, profiles (Figure 6b)."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from levkas.core.compiled import njit
from levkas.core.problems import Problem, Refused

if TYPE_CHECKING:
    from collections.abc import Sequence

LONGEST = 48
"""Blocks along the longer side of a map."""
DROP = 0.1
"""The paper's: inside the highlighted area the light drops by 10 %."""


class LightRefused(Refused):
    """A white from which the light cannot be measured."""


class LightField(NamedTuple):
    """How even the light is.

    Parameters
    ----------
    levels : ndarray, (rows, columns)
        White above dark in blocks of `step` px, over its greatest.
    step : int
        Side of a block, native px.
    size : (width, height)
        Of the white, native px.
    rectangle : (x, y, width, height)
        Largest upright one in which no block is below 1 − `drop` of the brightest block in it,
        native px.
    uniformity : float
        Least over greatest level of the whole field, 0 … 1.
    peak : float
        White above dark in the brightest block, counts.
    """

    levels: np.ndarray
    step: int
    size: tuple[int, int]
    rectangle: tuple[int, int, int, int]
    drop: float
    uniformity: float
    peak: float = float("nan")

    @property
    def bits(self) -> tuple[float, float]:
        """Bits between black and white in the brightest block, and in the darkest.

        The flat field stretches the corners to the same white: it leaves them that many levels.
        """
        return float(np.log2(self.peak)), float(np.log2(self.peak * max(self.uniformity, 1e-9)))

    @property
    def share(self) -> float:
        """Of the field that the rectangle takes."""
        return self.rectangle[2] * self.rectangle[3] / (self.size[0] * self.size[1])

    @property
    def profiles(self) -> tuple[np.ndarray, np.ndarray]:
        """Levels along the middle row and the middle column."""
        rows, columns = self.levels.shape
        return self.levels[rows // 2], self.levels[:, columns // 2]


def light_field(white: np.ndarray, *, saturated: np.ndarray | None = None) -> LightField:
    """Return the light field that a white shows.

    Parameters
    ----------
    white : ndarray, (h, w)
        Counts above dark of one channel; of a mosaic one phase, or all. One line of a line
        scanner is a field one block high.
    saturated : ndarray of bool like `white`, optional

    Notes
    -----
    What is measured is light times vignetting of the lens, which flat-fielding divides out together.

    Examples
    --------
    >>> field = light_field(np.tile(np.linspace(0.8, 1.0, 480), (240, 1)))
    >>> field.levels.shape, field.rectangle, round(field.uniformity, 2)
    ((24, 48), (150, 0, 240, 240), 0.8)
    """
    plane = np.asarray(white, np.float64)
    if saturated is not None and np.mean(saturated) > 0.01:
        raise LightRefused(
            Problem(
                "E_WHITE_SATURATED",
                "the white is saturated: it does not show how even the light is",
                found=f"{100 * float(np.mean(saturated)):.1f} % of the pixels",
                expected="at most 1 %",
                fix="Capture the white with less exposure: its peak at 85 % of saturation.",
            )
        )
    step = max(1, -(-max(plane.shape) // LONGEST))
    levels = _blocks(plane, step)
    if not np.isfinite(levels).all() or levels.min() <= 0:
        raise LightRefused(
            Problem(
                "E_WHITE_DARK",
                "the white is not above dark everywhere",
                found=f"{np.nanmin(levels):.3g} counts in the darkest block",
                fix="Capture a white board that fills the frame, with the lamps on.",
            )
        )
    peak = float(levels.max())
    levels = levels / peak
    x, y, width, height = _largest_rectangle(levels, 1 - DROP)
    right, bottom = min((x + width) * step, plane.shape[1]), min((y + height) * step, len(plane))
    rectangle = (x * step, y * step, right - x * step, bottom - y * step)
    size = (plane.shape[1], plane.shape[0])
    return LightField(levels, step, size, rectangle, DROP, float(levels.min()), peak)


def _blocks(plane: np.ndarray, step: int) -> np.ndarray:
    """Means of blocks; those of the last row and column may be smaller."""
    starts = [np.arange(0, n, step) for n in plane.shape]
    sums = np.add.reduceat(np.add.reduceat(plane, starts[0], 0), starts[1], 1)
    sizes = [np.minimum(step, n - s) for n, s in zip(plane.shape, starts, strict=True)]
    return np.asarray(sums / np.outer(*sizes))


@njit(cache=True)
def _largest_rectangle(levels, least):  # type: ignore[no-untyped-def]
    """Return the largest rectangle (x, y, width, height) in which min >= least · max.

    Exact and brute: rows from `top` to `bottom` are folded into their least and greatest, and the
    longest run of columns follows with two pointers.
    """
    rows, columns = levels.shape
    best, found = 0, (0, 0, 0, 0)
    low, high = np.empty(columns), np.empty(columns)
    for top in range(rows):
        if (rows - top) * columns <= best:
            break
        low[:], high[:] = np.inf, -np.inf
        for bottom in range(top, rows):
            for x in range(columns):
                low[x], high[x] = min(low[x], levels[bottom, x]), max(high[x], levels[bottom, x])
            tall = bottom - top + 1
            if tall * columns <= best:
                continue
            left, wide = _longest_run(low, high, least)
            if wide * tall > best:
                best, found = wide * tall, (left, top, wide, tall)
    return found


@njit
def _longest_run(low, high, least):  # type: ignore[no-untyped-def]
    """Return (start, length) of the longest run of columns with min(low) >= least · max(high)."""
    best, where, start = 0, 0, 0
    for end in range(len(low)):
        while start <= end:
            dark, bright = low[start], high[start]
            for x in range(start + 1, end + 1):
                dark, bright = min(dark, low[x]), max(bright, high[x])
            if dark >= least * bright:
                break
            start += 1
        if end - start + 1 > best:
            best, where = end - start + 1, start
    return where, best


SIDE = 160
"""Of a close-up, px, at most a third of the shorter side of the picture."""
PLACES = 4


def choose_places(pictures: Sequence[np.ndarray]) -> tuple[int, list[tuple[int, int]]]:
    """Choose places to compare: where pictures differ most, and where they have most detail."""
    stack = np.stack([p.astype(np.float32).mean(2) for p in pictures])
    height, width = stack.shape[1:]
    side = max(8, min(SIDE, height // 3, width // 3))
    apart = np.ptp(stack, axis=0)
    detail = np.abs(np.diff(stack[0], axis=1, append=0)) + np.abs(
        np.diff(stack[0], axis=0, append=0)
    )
    detail[:, -1] = detail[-1] = 0
    corners: list[tuple[int, int]] = []
    for number in range(PLACES):
        x, y = _highest(apart if number < PLACES // 2 else detail, side, corners)
        if x < 0:
            break
        corners.append((x, y))
    return side, corners


def _highest(of: np.ndarray, side: int, taken: Sequence[tuple[int, int]]) -> tuple[int, int]:
    """Top left of the window of the greatest sum that laps over none that is taken."""
    step = max(1, side // 4)
    total = np.pad(of, ((1, 0), (1, 0))).cumsum(0, dtype=np.float64).cumsum(1)
    best, found = -1.0, (-1, -1)
    for y in range(0, of.shape[0] - side + 1, step):
        for x in range(0, of.shape[1] - side + 1, step):
            if any(abs(x - a) < side and abs(y - b) < side for a, b in taken):
                continue
            value = (
                total[y + side, x + side] - total[y, x + side] - total[y + side, x] + total[y, x]
            )
            if value > best:
                best, found = float(value), (x, y)
    return found
