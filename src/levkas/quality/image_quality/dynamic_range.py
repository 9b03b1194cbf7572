"""The scene's own range against the sensor's, in stops (section 2.2 of [mirhashemi2019]_).

A scene spans log2(brightest/darkest) of what it sends to the sensor, a sensor log2(full/noise in the
dark). Where the scene spans more, its darkest parts drown or its brightest saturate.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from levkas.core.cube import Flag, is_flagged

if TYPE_CHECKING:
    from collections.abc import Sequence

DARKEST, BRIGHTEST = 0.1, 99.9
"""Percentiles that stand for the darkest and the brightest point: single pixels are noise."""
LOOKED_AT = 100_000
ROUNDING = 12**-0.5
"""Counts: the noise of whole codes, however dark the scene."""
LOST = Flag.OUTSIDE | Flag.DEFECT


class BandRange(NamedTuple):
    """One band of a scene.

    Parameters
    ----------
    stops : float
        log2 of brightest over darkest; a lower bound where `clipped` is not 0.
    low, high : float
        Reflectance or counts of the darkest and brightest parts.
    clipped : float
        Share of pixels that saturate: the scene goes on above.
    noise, snr : float
        Median sigma, and median of value over sigma; NaN where the noise is not known.
    """

    band: str
    stops: float
    low: float
    high: float
    clipped: float
    noise: float
    snr: float


def scene_ranges(
    values: np.ndarray,
    flags: np.ndarray,
    sigma: np.ndarray | None,
    labels: Sequence[str],
    *,
    counts: bool = False,
) -> list[BandRange]:
    """Return range, noise and signal-to-noise of every band of a scene.

    Parameters
    ----------
    values : ndarray, (h, w, bands)
        Reflectance, or counts above dark.
    flags : ndarray like `values`, uint8
        What is OUTSIDE or a DEFECT is left out.
    sigma : ndarray like `values`, or None
    labels : sequence of str
        Of the bands.
    counts : bool
        Whether the values are whole codes, or were interpolated between such.

    Notes
    -----
    The darkest is the 0.1 % point, and never below one sigma: less cannot be distinguished from no light.
    Of counts it is never below the noise of their rounding, 1/√12: 8 bits span 9.8 stops at most.

    Examples
    --------
    >>> ramp = np.geomspace(0.01, 0.64, 10_000).reshape(100, 100, 1)
    >>> round(scene_ranges(ramp, np.zeros(ramp.shape, np.uint8), None, ["G"])[0].stops, 1)
    6.0
    """
    step = max(1, int(np.sqrt(values.shape[0] * values.shape[1] / LOOKED_AT)))
    thin = np.s_[::step, ::step]
    planes, codes = (np.moveaxis(cube[thin], 2, 0).copy() for cube in (values, flags))
    noises = None if sigma is None else np.moveaxis(sigma[thin], 2, 0).copy()
    found = []
    for i, label in enumerate(labels):
        bits = codes[i]
        good = ~is_flagged(bits, LOST) & np.isfinite(planes[i])
        noise = None if noises is None else noises[i][good].astype(float)
        least = ROUNDING if counts else 0.0
        found.append(_one(label, planes[i][good].astype(float), bits[good], noise, least))
    return found


def sensel_noise(
    values: np.ndarray, flags: np.ndarray, variance: np.ndarray, table: np.ndarray
) -> list[tuple[float, float]]:
    """Return noise and signal-to-noise of the sensels of each channel of a mosaic.

    Interpolated values are left out: their sigma also holds the detail that was not sampled, which
    more light does not reduce.

    Parameters
    ----------
    values, flags, variance : ndarray, (h, w)
        Of the mosaic after the flat field.
    table : ndarray, (rows, columns), int
        Channel at each place of the pattern.

    Examples
    --------
    >>> flat, none = np.full((4, 4), 0.5), np.zeros((4, 4), np.uint8)
    >>> sensel_noise(flat, none, flat / 1250, np.array([[0, 1], [1, 2]]))[1]
    (0.02, 25.0)
    """
    rows, columns = table.shape
    good = ~is_flagged(flags, LOST) & np.isfinite(values) & np.isfinite(variance)
    found = []
    for channel in range(int(table.max()) + 1):
        phases = [np.s_[y::rows, x::columns] for y, x in np.argwhere(table == channel)]
        level, spread = (
            np.concatenate([plane[phase][good[phase]] for phase in phases])
            for plane in (values, variance)
        )
        noise = np.sqrt(spread.astype(float))
        ratio = level / np.maximum(noise, 1e-12)
        known = noise.size > 0 and bool(noise.any())
        found.append(
            (float(np.median(noise)), float(np.median(ratio))) if known else (np.nan, np.nan)
        )
    return found


def _one(
    label: str, values: np.ndarray, bits: np.ndarray, noise: np.ndarray | None, least: float
) -> BandRange:
    nan = float("nan")
    if not values.size:
        return BandRange(label, nan, nan, nan, 0.0, nan, nan)
    low, high = np.percentile(values, [DARKEST, BRIGHTEST])
    low = max(low, least)
    spread = ratio = nan
    if noise is not None and noise.any():
        dark = values <= np.percentile(values, 5)
        low = max(low, float(np.median(noise[dark])))
        spread = float(np.median(noise))
        ratio = float(np.median(values / np.maximum(noise, 1e-12)))
    stops = float(np.log2(high / low)) if low > 0 and high > 0 else nan
    clipped = float(np.mean(is_flagged(bits, Flag.SATURATED)))
    return BandRange(label, stops, float(low), float(high), clipped, spread, ratio)


def sensor_stops(full: float, read_noise: float) -> float:
    """Return the sensor's range in stops: counts from black to saturation over its noise in the dark.

    >>> round(sensor_stops(45_000, 32.0), 1)  # the paper's example
    10.5
    """
    return float(np.log2(full / read_noise)) if full > 0 and read_noise > 0 else float("nan")
