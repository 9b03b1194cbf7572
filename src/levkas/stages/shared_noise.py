"""Noise that neighbouring pixels share because they were interpolated before: resampling averages it less than Σw²u² says."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from levkas.calibration.mosaic import interpolate, method_of
from levkas.geometry.resample import warp
from levkas.geometry.transforms import Affine

if TYPE_CHECKING:
    from levkas.geometry.transforms import Transform

NOISE_PX, LEAST_SHARED = 320, 1.04
"""Side of the noise that is resampled to see what neighbours share: it gives variances to 1 %; a factor below is chance."""
NOISES, REACH, MOST_REACH, CHANCE = 4, 4.0, 16, 0.006
"""Fields of noise whose products are averaged; pixels of the sensor, and most of the grid, over which noise is shared; a correlation
that is one of chance, three of its standard deviations."""


class Mosaic(NamedTuple):
    """What `calibration.mosaic.demosaic` made a cube of: pattern, method, order of the channels."""

    pattern: Sequence[Sequence[str]]
    method: str | None
    channels: Sequence[str]


@cache
def _white_noise(seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).standard_normal((NOISE_PX, NOISE_PX)).astype(np.float32)
    noise.flags.writeable = False
    return noise


def _interpolated(seed: int, mosaic: Mosaic) -> tuple[np.ndarray, np.ndarray]:
    """Return white noise of a mosaic once demosaiced, and Σw²u², (h, w, bands)."""
    noise = _white_noise(seed)
    table, method = method_of(*mosaic)
    none = np.zeros(noise.shape, np.uint8)
    values, _, variance = interpolate(noise, none, np.ones_like(noise), table, method)
    assert variance is not None
    return values, variance


def shared_noise(mosaic: Mosaic, maps: Sequence[Transform], shape: tuple[int, int]) -> np.ndarray:
    """Return how much larger the variance of resampled values is than of independent ones, (bands,), >= 1.

    White noise of a mosaic is interpolated as the values were, and warped by `maps`, grid px → native px, one a band, as they are in
    the middle of the grid, (rows, columns): the mean of its squares over that of Σw²u².
    """
    return _over_independent(*_interpolated(0, mosaic), maps, shape)


def neighbour_correlation(
    maps: Sequence[Transform], shape: tuple[int, int], mosaic: Mosaic | None = None
) -> np.ndarray:
    """Return the correlation of the noise of a pixel of the grid with that of its neighbours, (2r + 1, 2r + 1), 1 in the middle.

    White noise of the sensor is made what the values are, demosaiced and warped by the middle band's map as in the middle of the
    grid; the mean of its products. r is as many pixels as four of the sensor span, 16 at most.
    """
    one = [maps[len(maps) // 2]]
    slope = one[0].jacobian(np.array([[shape[1], shape[0]]]) / 2)[0]
    scale = float(np.sqrt(abs(np.linalg.det(slope))))
    reach = int(np.clip(np.ceil(REACH / max(scale, 1e-6)), 1, MOST_REACH))
    noises = [_white_noise(seed) for seed in range(NOISES)]
    if mosaic is not None:
        band = len(mosaic.channels) // 2
        noises = [_interpolated(seed, mosaic)[0][..., band] for seed in range(NOISES)]
    fields = np.nan_to_num(_warped_locally(np.stack(noises, axis=-1), one, shape)[0])
    inner = fields[reach:-reach, reach:-reach]
    whole, middle = (np.fft.rfft2(v, fields.shape[:2], (0, 1)) for v in (fields, inner))
    product = np.sum(whole * np.conj(middle), axis=-1)
    total = np.fft.irfft2(product, fields.shape[:2])[: 2 * reach + 1, : 2 * reach + 1]
    found = np.round(total / total[reach, reach], 4)
    found[np.abs(found) < CHANCE] = 0.0
    return np.asarray(found)


def _over_independent(
    values: np.ndarray, variance: np.ndarray, maps: Sequence[Transform], shape: tuple[int, int]
) -> np.ndarray:
    """Return the mean square of noise (h, w, bands) warped as in the middle of a grid over that of Σw²u², (bands,)."""
    warped, warped_variance = _warped_locally(values, maps, shape, variance)
    predicted = np.nan_to_num(np.asarray(warped_variance))
    valid = np.isfinite(warped) & (predicted > 0)
    squares, expected = (
        np.where(valid, part, 0).sum((0, 1), dtype=np.float64) for part in (warped**2, predicted)
    )
    ratio = squares / np.maximum(expected, 1e-12)
    return np.where(ratio > LEAST_SHARED, ratio, 1.0).astype(np.float32)


def _warped_locally(
    values: np.ndarray,
    maps: Sequence[Transform],
    shape: tuple[int, int],
    variance: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray | None]:
    """Warp noise (h, w, bands) as maps do in the middle of a grid; return it and its Σw²u²."""
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
    warped = warp(values, local if len(local) > 1 else local[0], (side, side), variance=variance)
    return warped.values, warped.variance
