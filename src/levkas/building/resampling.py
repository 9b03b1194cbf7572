"""Every band of one capture on the grid, each pixel interpolated once."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from levkas.core.cube import Cube, Flag

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from levkas.building.native import Native
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


def grey_of(values: np.ndarray, flags: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean of the registered bands, (h, w), and the pixels that every band saw."""
    from levkas.building.grey_kernels import mean_of_seen

    seen: tuple[np.ndarray, np.ndarray] = mean_of_seen(values, flags, np.uint8(Flag.OUTSIDE))
    return seen


def read_grey(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return `grey_of` of a published layer."""
    from levkas.database.spectral_tiff import read_tiff_pages

    values = read_tiff_pages(path)
    return grey_of(values, read_tiff_pages(path.with_name(path.stem + ".flags.tif")))


def shrink_map(full: np.ndarray) -> np.ndarray:
    """Return an SSIM map as bytes, 0 to 255 for 0 to 1, at most `LONGEST_MAP` px long."""
    step = max(1, -(-max(full.shape) // LONGEST_MAP))
    height, width = (n // step * step for n in full.shape)
    blocks = np.nan_to_num(full[:height, :width]).reshape(height // step, step, width // step, step)
    return np.asarray(np.round(255 * np.clip(blocks.mean((1, 3)), 0, 1)), np.uint8)


def count_flags(flags: np.ndarray) -> np.ndarray:
    """Return how often each of the 256 codes occurs."""
    counts = np.zeros(256, np.int64)
    for row in flags:  # bincount turns what it counts into 64-bit numbers
        counts += np.bincount(row.reshape(-1), minlength=256)
    return counts


def describe_flags(counts: np.ndarray) -> dict[str, float]:
    """Return the share of pixels and bands under each flag, by its name, from `count_flags`."""
    codes = np.arange(256)
    total = max(int(counts.sum()), 1)
    return {
        flag.name.lower(): float(counts[(codes & flag.value) != 0].sum() / total)
        for flag in Flag
        if flag.name
    }


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
