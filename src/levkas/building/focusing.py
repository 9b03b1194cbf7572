"""Focus, band by band, in native pixels: of cubes, and of scans whose lines only pass by."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.building.measuring import as_number
from levkas.core.cube import Flag

if TYPE_CHECKING:
    from collections.abc import Sequence

    from levkas.building.native import Native
    from levkas.core.cube import Band, Cube

MOST_BANDS = 24
"""Bands of a camera whose focus is measured, evenly over all; neighbours are alike."""
LOST = Flag.GLARE | Flag.SATURATED | Flag.OUTSIDE


def focus_of(native: Native) -> list[dict[str, Any]]:
    """Return the blur of the sharpest edges, band by band, before anything is resampled."""
    return [
        one
        for cube in native.cubes.values()
        for one in _focus_of(cube.values, cube.flags, cube.labels, step_of(len(cube.bands)))
    ]


def step_of(bands: int) -> int:
    """Return of how many bands one is measured."""
    return max(1, -(-bands // MOST_BANDS))


class Middle:
    """The middle of a scan, of the bands whose focus is measured, taken from its lines as they pass.

    Parameters
    ----------
    shape : (lines, samples, bands)
    bands : sequence of Band
    """

    def __init__(self, shape: tuple[int, int, int], bands: Sequence[Band]) -> None:
        from levkas.quality.image_quality.sharpness import middle_of

        self._rows, self._columns = middle_of(shape[:2])
        self._step = step_of(len(bands))
        self._labels = [band.label for band in bands][:: self._step]
        size = (self._rows.stop - self._rows.start, self._columns.stop - self._columns.start)
        self._values = np.empty((*size, len(self._labels)), np.float32)
        self._flags = np.empty(self._values.shape, np.uint8)
        self._line = 0

    def add(self, cube: Cube) -> None:
        """Take the next lines."""
        first, self._line = self._line, self._line + len(cube.values)
        low, high = max(first, self._rows.start), min(self._line, self._rows.stop)
        if low >= high:
            return
        part = np.s_[low - first : high - first, self._columns, :: self._step]
        here = slice(low - self._rows.start, high - self._rows.start)
        self._values[here], self._flags[here] = cube.values[part], cube.flags[part]

    def focus(self) -> list[dict[str, Any]]:
        """Return what `focus_of` gives of the whole scan."""
        return _focus_of(self._values, self._flags, self._labels, 1)


def _focus_of(
    values: np.ndarray, flags: np.ndarray, labels: Sequence[str], step: int
) -> list[dict[str, Any]]:
    from levkas.quality.image_quality.sharpness import band_sharpness

    found = band_sharpness(values, labels, step=step, left_out=(flags & LOST) != 0)
    return [
        {"band": one.band, "blur_px": as_number(one.blur_px), "edges": one.edges} for one in found
    ]
