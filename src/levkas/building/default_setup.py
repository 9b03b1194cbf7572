"""A camera's layer under its default setup: what its layers under others are compared with, row by row."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from levkas.core.cube import Flag
from levkas.quality.image_quality.glare import setup_gains

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from levkas.building.scans import Scan
    from levkas.database.tiff_pages import TiffPages
    from levkas.geometry.transforms import Transform

COMPARED = 20_000
"""Pixels of a scan's pictures from which the ratio of two setups is taken, evenly over the layer."""
UNKNOWN = Flag.OUTSIDE | Flag.SATURATED


@dataclass(frozen=True)
class DefaultLayer:
    """A published layer on the same grid, read some rows at a time.

    Parameters
    ----------
    values, flags : TiffPages
    """

    values: TiffPages
    flags: TiffPages

    @classmethod
    def open(cls, values: Path, flags: Path, shape: tuple[int, int, int]) -> DefaultLayer | None:
        """Open a layer's files; None where there is none of that (height, width, bands)."""
        from levkas.database.tiff_pages import open_pages

        if not (values.is_file() and flags.is_file()):
            return None
        layer = cls(open_pages(values), open_pages(flags))
        return layer if layer.values.shape == layer.flags.shape == shape else None

    def rows(self, start: int = 0, stop: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return values and flags of some rows, (rows, width, bands)."""
        return self.values.read(start, stop), self.flags.read(start, stop)


def gains_of_scan(layer: DefaultLayer, scan: Scan, maps: Sequence[Transform]) -> np.ndarray:
    """Return `setup_gains` of a scan before its rows are resampled: of its pictures.

    A pixel of the pictures is compared with the mean of as many grid pixels as it covers.

    Parameters
    ----------
    maps : sequence of Transform
        Grid px → native px, one a band.
    """
    height, width, _ = layer.values.shape
    side = _side(maps[0], (height, width), scan.factor)
    tall, wide = height // side, width // side
    step = max(1, int(np.sqrt(tall * wide / COMPARED)))
    across, down = np.arange(0, wide, step), np.arange(0, tall, step)
    paint, known = _means(layer, down, across, side)
    x, y = np.meshgrid(*(n * side + (side - 1) / 2 for n in (across, down)))
    places = np.stack([x.ravel(), y.ravel()], 1)
    values, flags = np.zeros(paint.shape, np.float32), np.full(paint.shape, Flag.OUTSIDE, np.uint8)
    for band, (one, image) in enumerate(zip(maps, scan.images(), strict=True)):
        # NaN, where a place is not known, is beyond any edge.
        spots = np.rint(np.nan_to_num((one(places) + 0.5) / scan.factor - 0.5, nan=-9)).astype(int)
        inside = ((spots >= 0) & (spots < image.values.shape[::-1])).all(1)
        column, row = spots[inside].T
        mask = inside.reshape(paint.shape[:2])
        values[mask, band] = image.values[row, column]
        flags[mask, band] = np.where(image.valid[row, column], 0, Flag.OUTSIDE)
    return setup_gains(values, flags, paint, known)


def _side(one: Transform, shape: tuple[int, int], factor: int) -> int:
    """Return how many grid pixels a pixel of the pictures is wide, in the grid's middle."""
    x, y = shape[1] / 2, shape[0] / 2
    a, b, c = one(np.array([[x, y], [x + 1, y], [x, y + 1]]))
    pixels = float(np.sqrt(np.linalg.norm(b - a) * np.linalg.norm(c - a)))
    most = min(shape)
    return int(np.clip(round(factor / pixels), 1, most)) if pixels > 0 else 1


def _means(
    layer: DefaultLayer, down: np.ndarray, across: np.ndarray, side: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the means of blocks of `side` x `side` px, and flags; one is not known where a pixel is not."""
    values, flags = [], []
    wide = (int(across[-1]) + 1) * side
    for row in down:
        part, marks = layer.rows(row * side, (row + 1) * side)
        shape = (side, wide // side, side, part.shape[2])
        lost = ((marks[:, :wide] & UNKNOWN) != 0).reshape(shape).any((0, 2))
        values.append(np.nan_to_num(part[:, :wide]).reshape(shape).mean((0, 2))[across])
        flags.append(np.where(lost, np.uint8(Flag.OUTSIDE), np.uint8(0))[across])
    return np.stack(values), np.stack(flags)
