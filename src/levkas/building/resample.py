"""Every band of one capture on the grid, each pixel interpolated once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from levkas.core.cube import Cube, Flag
from levkas.quality.image_quality.glare import setup_gains

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from levkas.building.native_cubes import Native
    from levkas.building.scans import Scan
    from levkas.database.tiff_pages import TiffPages
    from levkas.geometry.grid import Grid
    from levkas.geometry.transforms import Transform

LONGEST_MAP = 640
"""Longest side of an SSIM map on a page, px."""
NOISE_PX = 320
"""Side of the noise that is resampled to see what neighbours share: it tells variances to 1 %."""
LEAST_SHARED = 1.04
"""Less is chance."""


class Mosaic(NamedTuple):
    """What `calibration.mosaic.demosaic` made a cube of: pattern, method, order of the channels."""

    pattern: Sequence[Sequence[str]]
    method: str | None
    channels: Sequence[str]


def shrink_map(full: np.ndarray) -> np.ndarray:
    """Return an SSIM map as bytes, 0 to 255 for 0 to 1, at most `LONGEST_MAP` px long."""
    step = max(1, -(-max(full.shape) // LONGEST_MAP))
    height, width = (n // step * step for n in full.shape)
    blocks = np.nan_to_num(full[:height, :width]).reshape(height // step, step, width // step, step)
    return np.asarray(np.round(255 * np.clip(blocks.mean((1, 3)), 0, 1)), np.uint8)


def resample(
    native: Native,
    transforms: dict[str, Transform],
    grid: Grid,
    sigma_of: Callable[[str], np.ndarray | None],
    *,
    mosaics: Mapping[str, Mosaic] | None = None,
) -> Cube:
    """Return the capture on the grid; orientation, crop, scale and registration are one map.

    `sigma_of` gives the sigma of a sensor, and gives it away. `mosaics` are the sensors that were
    demosaiced: neighbours of theirs share noise.
    """
    from levkas.core.rounding import round_root, round_values
    from levkas.geometry.resample import warp
    from levkas.geometry.transforms import Composed

    shape = (grid.size[1], grid.size[0])
    parts = []
    for sensor, cube in native.cubes.items():
        maps = [Composed(grid.transform, transforms[band.label]) for band in cube.bands]
        sigma = sigma_of(sensor)
        # In place: a scan's sigma is most of a gigabyte.
        variance = None if sigma is None else np.square(sigma, out=sigma)
        if variance is not None and mosaics and sensor in mosaics:
            variance *= shared_noise(mosaics[sensor], maps, shape)
        warped = warp(cube.values, maps, shape, flags=cube.flags, variance=variance)
        found = warped.variance
        if found is not None:
            found = round_root(found, out=found)
        parts.append((round_values(warped.values, out=warped.values), warped.flags, found))
    values, flags, sigmas = zip(*parts, strict=True)
    known = [s for s in sigmas if s is not None]
    return Cube(
        _joined(values),
        _joined(flags),
        _joined(known) if len(known) == len(parts) else None,
        native.bands,
        native.quantity,
    )


def shared_noise(mosaic: Mosaic, maps: Sequence[Transform], shape: tuple[int, int]) -> np.ndarray:
    """Return how much larger the variance of resampled values is than of independent ones, (bands,), >= 1.

    Parameters
    ----------
    mosaic : Mosaic
        What made the values.
    maps : sequence of Transform
        Grid px → native px, one a band.
    shape : (rows, columns) of the grid

    Notes
    -----
    White noise of a mosaic is interpolated as the values were, and warped as they are in the middle of
    the grid: the mean of its squares over that of Σw²u².
    """
    from levkas.calibration.mosaic import interpolate, method_of
    from levkas.geometry.resample import warp
    from levkas.geometry.transforms import Affine

    noise = np.random.default_rng(0).standard_normal((NOISE_PX, NOISE_PX)).astype(np.float32)
    table, method = method_of(*mosaic)
    none = np.zeros(noise.shape, np.uint8)
    values, _, variance = interpolate(noise, none, np.ones_like(noise), table, method)
    middle = np.array([[shape[1], shape[0]]]) / 2
    slopes = [one.jacobian(middle)[0] for one in maps]
    starts = [np.modf(one(middle)[0])[0] + NOISE_PX // 2 for one in maps]
    reach = max(float(np.abs(slope).sum(1).max()) for slope in slopes)
    side = int(np.clip((NOISE_PX - 24) / max(reach, 1e-6), 1, NOISE_PX))
    corner = np.full(2, side // 2)
    local = [
        Affine(np.column_stack([slope, start - slope @ corner]))
        for slope, start in zip(slopes, starts, strict=True)
    ]
    made = warp(values, local, (side, side), variance=variance)
    told = np.nan_to_num(np.asarray(made.variance))
    seen = np.isfinite(made.values) & (told > 0)
    squares, expected = (
        np.where(seen, part, 0).sum((0, 1), dtype=np.float64) for part in (made.values**2, told)
    )
    ratio = squares / np.maximum(expected, 1e-12)
    return np.where(ratio > LEAST_SHARED, ratio, 1.0).astype(np.float32)


def _joined(parts: Sequence[np.ndarray]) -> np.ndarray:
    return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=2)


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
