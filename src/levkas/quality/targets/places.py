"""Places of a picture at which lightings are compared, as in Figure 4 of [mirhashemi2019]_."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

SIDE = 160
"""Of a close-up, px, at most a third of the shorter side of the picture."""
PLACES = 4


def choose_places(pictures: Sequence[np.ndarray]) -> tuple[int, list[tuple[int, int]]]:
    """Choose places to compare: where pictures differ most, and where they have most detail.

    Parameters
    ----------
    pictures : sequence of ndarray, (h, w, 3), uint8
        Of one size.

    Returns
    -------
    side : int
        Of a close-up, px.
    corners : list of (x, y)
        Their top left pixels; none laps over another.
    """
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
