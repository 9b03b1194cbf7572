"""Pictures for the screen: eight bits, a pyramid of halves, tiles on demand.

A picture of 100 million pixels takes 133 MB; it is read some rows at a time."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from levkas.database.tiff_pages import TiffPages

Mapper = Callable[[np.ndarray], np.ndarray]

TILE_PX = 256
ROWS = 512
SAMPLED_BLOCKS = 12
STRETCH_PERCENT = (0.5, 99.5)
LATTICE_PX = 16
JPEG_LEVEL = 88


class ShownPicture:
    """A grey picture and its copies at half, a quarter, … of its sampling.

    Parameters
    ----------
    pixels : ndarray, (h, w), uint8
    """

    def __init__(self, pixels: np.ndarray) -> None:
        self.pixels = pixels

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        return self.pixels.shape[1], self.pixels.shape[0]

    @cached_property
    def levels(self) -> list[np.ndarray]:
        """The picture, then each time at half the sampling, to at most one tile."""
        made = [self.pixels]
        while max(made[-1].shape) > TILE_PX:
            made.append(_halved(made[-1]))
        return made

    def tile(self, level: int, column: int, row: int) -> np.ndarray:
        """Return a tile, at most 256 px a side, of a level; raises IndexError outside."""
        if not 0 <= level < len(self.levels):
            raise IndexError(level)
        part = self.levels[level][row * TILE_PX :, column * TILE_PX :][:TILE_PX, :TILE_PX]
        if column < 0 or row < 0 or not part.size:
            raise IndexError((column, row))
        return part

    def sample(self, points: np.ndarray, step: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """Return values at (…, 2) px, float32, and whether they lie inside.

        `step` is about how many px lie between neighbours: larger ones are read from a reduced copy.
        """
        import cv2

        level = int(np.clip(np.floor(np.log2(max(step, 1.0) + 1e-6)), 0, len(self.levels) - 1))
        values = self.levels[level]
        at = (np.asarray(points, float) + 0.5) / 2**level - 0.5
        height, width = values.shape
        with np.errstate(invalid="ignore"):
            inside = ((at > -0.5) & (at < np.array([width, height]) - 0.5)).all(-1)
        if not inside.any():
            return np.zeros(at.shape[:-1], np.float32), inside
        # OpenCV reads no pictures beyond 32,767 px: only what is needed is shown to it.
        low = np.maximum(np.floor(at[inside].min(0)).astype(int) - 2, 0)
        high = np.minimum(np.ceil(at[inside].max(0)).astype(int) + 3, [width, height])
        part = np.ascontiguousarray(values[low[1] : high[1], low[0] : high[0]])
        place = np.where(inside[..., None], at - low, 0).astype(np.float32)
        how = cv2.INTER_CUBIC if level == 0 and step < 1.5 else cv2.INTER_LINEAR
        warped = cv2.remap(
            part.astype(np.float32), place[..., 0], place[..., 1], how,
            borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        return np.where(inside, np.clip(warped, 0, 255), 0).astype(np.float32), inside


def warped_tile(
    picture: ShownPicture, forward: Mapper, size: tuple[int, int], level: int, column: int, row: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return a tile of a picture brought into a frame of `size`, (h, w) uint8, and where it is known.

    Parameters
    ----------
    forward : Transform, or any function of (n, 2) points
        Px of the frame → px of `picture`.
    level, column, row : int
        Of the frame's own tiles.

    Raises
    ------
    IndexError
        Where the frame has no such tile.
    """
    step = 2**level
    width, height = (-(-side // step) for side in size)
    if level < 0 or level > 16 or not 0 <= column * TILE_PX < width:
        raise IndexError((level, column))
    if not 0 <= row * TILE_PX < height:
        raise IndexError((level, row))
    across = min(TILE_PX, width - column * TILE_PX)
    down = min(TILE_PX, height - row * TILE_PX)
    x = (np.arange(across) + column * TILE_PX + 0.5) * step - 0.5
    y = (np.arange(down) + row * TILE_PX + 0.5) * step - 0.5
    at = place_on_lattice(forward, x, y)
    scale = _spacing(at)
    values, inside = picture.sample(at, scale)
    return np.rint(values).astype(np.uint8), inside


def place_on_lattice(forward: Mapper, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Map a grid of px, (h, w, 2), through a lattice 16 px apart and linear between: smooth maps are."""
    columns = np.unique(np.r_[np.arange(0, len(x), LATTICE_PX), len(x) - 1])
    rows = np.unique(np.r_[np.arange(0, len(y), LATTICE_PX), len(y) - 1])
    nodes = np.stack(np.meshgrid(x[columns], y[rows]), -1)
    mapped = forward(nodes.reshape(-1, 2)).reshape(nodes.shape)
    full = np.empty((len(y), len(x), 2))
    for axis in (0, 1):
        along = np.stack(
            [np.interp(np.arange(len(x)), columns, line) for line in mapped[..., axis]]
        )
        below = np.searchsorted(rows, np.arange(len(y)), side="right") - 1
        below = np.minimum(below, max(len(rows) - 2, 0))
        above = np.minimum(below + 1, len(rows) - 1)
        span = np.maximum(rows[above] - rows[below], 1)
        share = ((np.arange(len(y)) - rows[below]) / span)[:, None]
        full[..., axis] = along[below] * (1 - share) + along[above] * share
    return full


def encode(values: np.ndarray, inside: np.ndarray | None = None) -> tuple[bytes, str]:
    """Return a tile's bytes and their media type: JPEG, or PNG with what is unknown transparent."""
    import imagecodecs

    if inside is None or inside.all():
        pixels = np.ascontiguousarray(values)
        return bytes(imagecodecs.jpeg_encode(pixels, level=JPEG_LEVEL)), "image/jpeg"
    alpha = np.dstack([values, np.where(inside, 255, 0).astype(np.uint8)])
    return bytes(imagecodecs.png_encode(np.ascontiguousarray(alpha), level=1)), "image/png"


def read_picture(path: Path, page: int) -> ShownPicture:
    """Read one page of a calibrated TIFF as a picture of eight bits.

    Raises
    ------
    TiffRefused
    """
    from levkas.database.tiff_pages import open_pages

    pages = open_pages(path)
    height, width = pages.shape[:2]
    low, high = _limits(pages, page, height)
    pixels = np.empty((height, width), np.uint8)
    for start in range(0, height, ROWS):
        part = np.asarray(pages.read_page(page, start, start + ROWS), np.float32)
        tone = np.clip((np.nan_to_num(part, nan=low) - low) / (high - low), 0, 1)
        pixels[start : start + ROWS] = np.rint(255 * np.sqrt(tone))
    return ShownPicture(pixels)


def _limits(pages: TiffPages, page: int, height: int) -> tuple[float, float]:
    """Percentiles of some blocks of rows, all over the picture."""
    starts = np.unique(np.linspace(0, max(height - 16, 0), SAMPLED_BLOCKS).astype(int))
    parts = [np.asarray(pages.read_page(page, int(s), int(s) + 16), np.float32) for s in starts]
    known = np.concatenate([part[np.isfinite(part)] for part in parts])
    if not len(known):
        return 0.0, 1.0
    low, high = np.percentile(known, STRETCH_PERCENT)
    return float(low), float(max(high, low + 1e-6))


def _halved(image: np.ndarray) -> np.ndarray:
    """Mean of blocks of 2 x 2; an odd last row or column is repeated."""
    height, width = image.shape
    halved = np.empty((-(-height // 2), -(-width // 2)), np.uint8)
    for start in range(0, height, 2 * ROWS):
        part = image[start : start + 2 * ROWS].astype(np.uint16)
        if part.shape[0] % 2:
            part = np.vstack([part, part[-1:]])
        if width % 2:
            part = np.hstack([part, part[:, -1:]])
        total = part[::2, ::2] + part[1::2, ::2] + part[::2, 1::2] + part[1::2, 1::2]
        halved[start // 2 : start // 2 + total.shape[0]] = (total + 2) // 4
    return halved


def _spacing(at: np.ndarray) -> float:
    """Px of the picture between neighbours of a mapped grid; the smaller of both directions."""
    steps = [np.hypot(*np.moveaxis(np.diff(at, axis=axis), -1, 0)) for axis in (0, 1)]
    known = [float(np.nanmedian(s)) for s in steps if s.size and np.isfinite(s).any()]
    return min(known) if known else 1.0
